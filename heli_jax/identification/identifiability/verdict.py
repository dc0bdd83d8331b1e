"""Result of the identifiability analysis, and its sentences."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from heli_jax.identification.unknowns.layout import FlightUnknown
from heli_jax.messages import listed, sentence

FACTOR = 10.0
"""A parameter whose 95 % interval reaches further than this factor to either side is not
identifiable, whatever the rank."""
Z95 = 1.959963984540054
"""97.5 % point of the standard normal distribution"""
_BY_PRIOR = 0.9
"""share of the priors above which the data are said to add nothing to a parameter's own prior"""


class Unknown(NamedTuple):
    """One free parameter in the analysis."""

    name: str
    value: float
    logarithmic: bool
    """True if its relative coordinate is log |value|"""
    scale: float
    """size of its prior or interval in that coordinate; 1 without either"""
    prior: float
    """1 / sd of its prior in that coordinate; 0 without one"""
    is_parameter: bool = True
    """False for gains and time shifts"""
    reference: float = 1.0
    """unit of its relative coordinate [the parameter's unit]"""
    symmetric: bool = False
    """True if it may have either sign; its interval is then symmetric about the value"""
    aliased: bool = False
    """True if it moves a mode whose aliases fit as well"""
    at_bound: bool = False
    """True if the estimate is at a stated bound"""

    @property
    def distance(self) -> float:
        """Distance from the value to zero in its relative coordinate; 1 if it keeps its sign."""
        return abs(self.value) / self.reference if self.symmetric else 1.0

    @property
    def per_log(self) -> float:
        """Factor that turns its relative coordinate into log |value|."""
        return 1.0 / self.distance if self.logarithmic else 1.0

    @property
    def sign(self) -> float:
        """-1 if its relative coordinate falls as the value rises."""
        return (float(np.sign(self.value)) or 1.0) if self.logarithmic else 1.0


class Combination(NamedTuple):
    """A product of powers, or a sum, that the data determine."""

    name: str
    exponents: dict[str, float]
    """by parameter; factors if it is a sum"""
    value: float
    sd: float
    lower95: float
    upper95: float
    kind: Literal["product", "sum"] = "product"

    @property
    def is_bounded(self) -> bool:
        """True if its 95 % interval is finite, and that of a product within the factor of ten."""
        if not all(map(math.isfinite, (self.value, self.sd, self.lower95, self.upper95))):
            return False
        if self.kind == "sum":
            return True
        return 0.0 < self.value <= FACTOR * self.lower95 and self.upper95 <= FACTOR * self.value


def exponents(product: str, names: Sequence[str]) -> Float[np.ndarray, " p"]:
    """Return the exponents of a product such as `a/Ixx` by name.

    Raises:
        ValueError: a factor is not among the names.
    """
    powers = np.zeros(len(names))
    for i, part in enumerate(product.split("/")):
        for name in part.split("*"):
            if name.strip() == "1" and i == 0:
                continue
            if name.strip() not in names:
                raise ValueError(
                    f"expected {', '.join(names)} or a product such as {'/'.join(names[:2])}, got "
                    f"{product!r:.60}"
                )
            powers[names.index(name.strip())] += -1.0 if i else 1.0
    return powers


class Pair(NamedTuple):
    """Two strongly correlated parameters."""

    first: str
    second: str
    correlation: float


class SecondSolution(NamedTuple):
    """Other values of the free parameters that fit as well."""

    values: dict[str, float]
    """of all that are free, SI"""
    changed: tuple[str, ...]
    """those whose value is another"""


class Group(NamedTuple):
    """Parameters that take part in the same null directions."""

    names: tuple[str, ...]
    count: int
    """of the null directions: as many parameters would have to be known"""
    combinations: tuple[Combination, ...]
    """combinations of them that the data determine"""
    exchanged: tuple[FlightUnknown, ...] = ()
    """nuisances that are exchangeable with them but for their weak priors"""


@dataclass(frozen=True, eq=False)
class Verdict:
    """Parameters and combinations that the data and the priors determine."""

    unknowns: tuple[Unknown, ...]
    """(q,)"""
    identifiable: bool
    rank: int
    """without the weak priors of nuisances, as `rank_without_priors`"""
    rank_without_priors: int
    singular_values: np.ndarray
    """(q,) of the whitened, scaled sensitivity, largest first"""
    null_directions: tuple[dict[str, float], ...]
    """unit vectors in relative coordinates that the data do not determine"""
    pairs: tuple[Pair, ...]
    without_effect: tuple[str, ...]
    undetermined: tuple[str, ...]
    """those in a null direction, and those with a second solution"""
    covariance: np.ndarray
    """(q, q) in relative coordinates, without the null directions"""
    correlation: np.ndarray
    prior_share: dict[str, float]
    """share (P R P)_ii / P_ii of the posterior variance P that the priors, whose information is R,
    explain; 1 if the data have no information"""
    groups: tuple[Group, ...]
    """of parameters that are not identifiable"""
    resting_groups: tuple[Group, ...]
    """of parameters that priors determine, and the data alone do not"""
    roughly: tuple[str, ...] = ()
    """identifiable parameters whose interval is wide or holds zero"""
    second: tuple[SecondSolution, ...] = ()
    """other values that fit as well"""
    remarks: tuple[str, ...] = ()
    """further sentences"""
    nothing_because: str = ""
    """sentence with the reason why nothing is determined, if so"""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the unknowns (q,)."""
        return tuple(u.name for u in self.unknowns)

    @property
    def condition(self) -> float:
        """Condition number of the whitened, scaled sensitivity."""
        largest, smallest = map(float, self.singular_values[[0, -1]])
        return largest / smallest if smallest > 0 else math.inf

    @property
    def combinations(self) -> tuple[Combination, ...]:
        """Combinations that the data determine in place of single parameters."""
        return tuple(c for g in (*self.groups, *self.resting_groups) for c in g.combinations)

    @property
    def not_identifiable(self) -> frozenset[str]:
        """The parameters that are undetermined or without effect."""
        return frozenset((*self.undetermined, *self.without_effect))

    @property
    def resting(self) -> tuple[str, ...]:
        """Parameters that are determined by priors, and not by the data alone."""
        return tuple(n for group in self.resting_groups for n in group.names)

    @property
    def exchangeable(self) -> tuple[str, ...]:
        """Nuisances, as 'flight 1/bias p', that are exchangeable with parameters."""
        groups = (*self.groups, *self.resting_groups)
        return tuple(dict.fromkeys(n.label for group in groups for n in group.exchanged))

    def nothing(self, because: str) -> "Verdict":
        """Return the verdict with no parameter determined, for a reason in a sentence."""
        return replace(
            self,
            identifiable=False,
            undetermined=tuple(n for n in self.names if n not in self.without_effect),
            pairs=(),
            groups=(),
            resting_groups=(),
            roughly=(),
            remarks=(),
            nothing_because=because,
        )

    @property
    def text(self) -> str:
        """The verdict in words."""
        return " ".join((*_sentences(self), *self.remarks))


def _sentences(v: Verdict) -> list[str]:
    """Return the sentences; each parameter is in one of them, but for strong correlations."""
    if v.nothing_because:
        return [v.nothing_because]
    # The slope of a bounded coordinate vanishes at the bound: that is no lack of effect.
    bound = [u.name for u in v.unknowns if u.at_bound]
    lines = [
        sentence("verdict.without-effect", name=n, way_out=_way_out([n]))
        for n in v.without_effect
        if n not in bound
    ]
    lines += [
        sentence("verdict.at-bound", name=u.name, value=u.value) for u in v.unknowns if u.at_bound
    ]
    for other in v.second:
        here = {u.name: u.value for u in v.unknowns}
        one, two = (
            [f"{n} {values[n]:.4g}" for n in other.changed] for values in (here, other.values)
        )
        lines.append(sentence("verdict.also-fits", names=other.changed, here=one, there=two))
    lines += [_not_determined(group, v) for group in v.groups]
    lines += [_resting(group, v) for group in v.resting_groups]
    named = {*v.not_identifiable, *bound, *v.resting}
    by_prior = [u.name for u in v.unknowns if u.prior and v.prior_share[u.name] > _BY_PRIOR]
    by_prior = [n for n in by_prior if n not in named]
    well = [n for n in v.names if n not in (*named, *by_prior, *v.roughly)]
    wide = [n for n in v.roughly if n not in (*named, *by_prior)]
    if well or wide:
        lines.append(sentence("verdict.determined", well=well, wide=wide, both=bool(well and wide)))
    if by_prior:
        lines.append(sentence("verdict.by-prior", names=by_prior))
    if pairs := [p for p in v.pairs if not {p.first, p.second} <= named]:
        words = [f"{p.first} with {p.second} ({p.correlation:+.5f})" for p in pairs]
        names = dict.fromkeys(n for p in pairs for n in (p.first, p.second))
        # The sd of one given the other is sqrt(1 - r^2) times as large; rounding may give r = 1.
        largest = max(abs(p.correlation) for p in pairs)
        factor = 1.0 / math.sqrt(max(1.0 - largest**2, 1e-12))
        way_out = _way_out([*names])
        lines.append(sentence("verdict.correlated", pairs=words, factor=factor, way_out=way_out))
    return lines


def _not_determined(group: Group, v: Verdict) -> str:
    """Return the sentence on a group that is not determined."""
    names, code = group.names, "verdict.not-determined"
    if group.combinations:
        code = "verdict.only-combinations"
    elif group.count < len(names):
        code = "verdict.only-together"
    aliased = [u.name for u in v.unknowns if u.aliased and u.name in names]
    return sentence(
        code,
        names=names,
        only=[c.name for c in group.combinations],
        exchanged=_exchanged(group),
        aliased=sentence("verdict.aliased", names=aliased),
        way_out=_way_out(names, group.count, group.exchanged),
    )


def _resting(group: Group, v: Verdict) -> str:
    """Return the sentence on a group that priors determine."""
    owners = [u.name for u in v.unknowns if u.prior > 0 and u.name in group.names]
    return sentence(
        "verdict.resting",
        names=group.names,
        only=[c.name for c in group.combinations],
        owners=owners,
        others=not owners,
        exchanged=_exchanged(group),
    )


def _exchanged(group: Group) -> str:
    nuisances = dict.fromkeys(n.words for n in group.exchanged)
    return listed([*group.names, *nuisances]) if nuisances else ""


def _way_out(
    names: tuple[str, ...] | list[str], count: int = 1, exchanged: tuple[FlightUnknown, ...] = ()
) -> str:
    """Return the remedy for parameters of which `count` have to be known."""
    # Gains, shifts and biases have a switch in the configuration and no value.
    kinds = [n.kind for n in exchanged if n.kind != "initial_state"]
    kinds += ["input_gain" for n in names if n.startswith("gain ")]
    kinds += [n for n in names if n == "time_shift"]
    parameters = [n for n in names if n != "time_shift" and not n.startswith("gain ")]
    off = [f"fit.nuisance.{kind}" for kind in dict.fromkeys(kinds)]
    number = min(count, len(parameters))
    few = number if number < len(parameters) else 0
    return sentence(
        "verdict.way-out", off=off, which=parameters, few=few, both=bool(off and parameters)
    )
