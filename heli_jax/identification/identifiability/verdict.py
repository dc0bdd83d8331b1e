"""Verdict of the identifiability analysis: its data, and the sentences made of them."""

import math
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np

from heli_jax.identification.unknowns.layout import FlightUnknown
from heli_jax.messages import listed, sentence

# Rank alone is not enough: noise of any size leaves full rank, and an interval of three decades.
FACTOR = 10.0
"""A 95 % interval that reaches further than this factor to either side determines nothing."""
# The 97.5 % point of the standard normal distribution.
Z95 = 1.959963984540054
ILL_CONDITIONED = 1e4
"""condition number above which the verdict names the weakest direction, if all is determined"""
_BY_PRIOR = 0.9
"""share of the priors above which a parameter with a prior is what that says"""


class Unknown(NamedTuple):
    """One free parameter as the verdict sees it."""

    name: str
    value: float
    logarithmic: bool
    """whether its relative coordinate is log |value|"""
    scale: float
    """size of its prior or interval in that coordinate; 1 where it has neither"""
    prior: float
    """1 / sd of its prior in that coordinate; 0 without one"""
    is_parameter: bool = True
    """False for gains and time shifts"""
    reference: float = 1.0
    """one unit of its relative coordinate, in its own"""
    symmetric: bool = False
    """whether it may have either sign: its interval is then symmetric about the value, and
    determines nothing where it reaches further than log 10 times its size to either side"""
    aliased: bool = False
    """whether it moves a mode that the samples do not tell from its aliases"""
    at_bound: bool = False
    """whether it ended at its bound, so that the data want it beyond"""

    @property
    def distance(self) -> float:
        """Distance of zero from the value in its relative coordinate; 1 of one that keeps its
        sign."""
        return abs(self.value) / self.reference if self.symmetric else 1.0

    @property
    def per_log(self) -> float:
        """Factor that turns its relative coordinate into log |value|."""
        # In units of the reference it becomes that by the reference over the value.
        return 1.0 / self.distance if self.logarithmic else 1.0

    @property
    def sign(self) -> float:
        """-1 where its relative coordinate falls as the value rises: log |value| of a negative
        value."""
        return (float(np.sign(self.value)) or 1.0) if self.logarithmic else 1.0


class Combination(NamedTuple):
    """A product of powers, or a sum, that the data determine."""

    name: str
    exponents: dict[str, float]
    """by parameter; of a sum its factors"""
    value: float
    sd: float
    lower95: float
    upper95: float
    kind: Literal["product", "sum"] = "product"

    @property
    def is_bounded(self) -> bool:
        """True if its 95 % interval is one: of a product within the factor of ten, as of a
        parameter."""
        if not all(map(math.isfinite, (self.value, self.sd, self.lower95, self.upper95))):
            return False
        if self.kind == "sum":
            return True
        return 0.0 < self.value <= FACTOR * self.lower95 and self.upper95 <= FACTOR * self.value


class Pair(NamedTuple):
    """Two parameters that the data hardly tell apart."""

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
    """Parameters that no rows tell apart, and how many of them would have to be known."""

    names: tuple[str, ...]
    count: int
    combinations: tuple[Combination, ...]
    """what is determined of them all the same"""
    exchanged: tuple[FlightUnknown, ...] = ()
    """nuisances that they are exchanged with, where weak priors alone hold them"""


@dataclass(frozen=True, eq=False)
class Verdict:
    """The findings on what the data (with the priors) determine."""

    unknowns: tuple[Unknown, ...]
    """(q,)"""
    identifiable: bool
    # Both without the weak priors of nuisances, which would give full rank to anything.
    rank: int
    rank_without_priors: int
    singular_values: np.ndarray
    """(q,) of the whitened, scaled sensitivity, largest first"""
    null_directions: tuple[dict[str, float], ...]
    """unit vectors in relative coordinates along which nothing changes"""
    pairs: tuple[Pair, ...]
    without_effect: tuple[str, ...]
    undetermined: tuple[str, ...]
    """also those that take a small part in a direction that is not determined, and those that have
    other values as good"""
    covariance: np.ndarray
    """(q, q) in relative coordinates; the undetermined directions are left out of it"""
    correlation: np.ndarray
    prior_share: dict[str, float]
    """share (P R P)_ii / P_ii of the posterior variance P that the priors with the information R
    explain: its own, those of others, and the weak ones of the nuisances; 1 where the data say
    nothing"""
    groups: tuple[Group, ...]
    """what is not determined"""
    resting_groups: tuple[Group, ...]
    """what priors determine, and the data alone do not"""
    roughly: tuple[str, ...] = ()
    """parameters that are determined, with a wide interval, or one that holds zero"""
    second: tuple[SecondSolution, ...] = ()
    """other values that the data do not tell from these"""
    remarks: tuple[str, ...] = ()
    """further sentences"""
    nothing_because: str = ""
    """a sentence that tells why nothing is determined, whatever the numbers are"""

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
        """Combinations of parameters that the data determine, and not one by one."""
        return tuple(c for g in (*self.groups, *self.resting_groups) for c in g.combinations)

    @property
    def not_identifiable(self) -> frozenset[str]:
        """The parameters without a number: undetermined, or without effect."""
        return frozenset((*self.undetermined, *self.without_effect))

    @property
    def resting(self) -> tuple[str, ...]:
        """Parameters that are determined by priors, and not by the data alone."""
        return tuple(n for group in self.resting_groups for n in group.names)

    @property
    def exchangeable(self) -> tuple[str, ...]:
        """Nuisances, as 'flight 1/bias p', that make up for what is not determined."""
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
    """Return sentences on what the data determine, what they do not, and what can be done."""
    if v.nothing_because:
        return [v.nothing_because]
    # At its bound the slope of what is searched through a tanh vanishes: that is no lack of effect.
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
    # Each parameter is spoken of once: what comes later leaves out what an earlier one has named.
    told = {*v.without_effect, *bound, *(n for group in v.groups for n in group.names)}
    told |= {n for other in v.second for n in other.changed}
    if partners := [n for n in v.undetermined if n not in told]:
        lines.append(sentence("verdict.partners", names=partners))
    told |= {*partners, *v.resting}
    lines += [_resting(group, v) for group in v.resting_groups]
    # To say that the data determine what the prior alone holds would be the worst mistake here: its
    # interval is as narrow as any.
    by_prior = [u.name for u in v.unknowns if u.prior and v.prior_share[u.name] > _BY_PRIOR]
    by_prior = [n for n in by_prior if n not in told]
    well = [n for n in v.names if n not in (*told, *by_prior, *v.roughly)]
    wide = [n for n in v.roughly if n not in (*told, *by_prior)]
    if well or wide:
        lines.append(sentence("verdict.determined", well=well, wide=wide, both=bool(well and wide)))
    if by_prior:
        lines.append(sentence("verdict.by-prior", names=by_prior))
    if v.identifiable and v.condition > ILL_CONDITIONED and not v.resting_groups:
        weakest = np.linalg.eigh(v.covariance)[1][:, -1]
        parts = [
            f"{n} {part:+.2f}" for n, part in zip(v.names, weakest, strict=True) if abs(part) > 0.1
        ]
        lines.append(sentence("verdict.hardly-separated", parts=parts, condition=v.condition))
    if pairs := [p for p in v.pairs if not {p.first, p.second} <= told]:
        words = [f"{p.first} with {p.second} ({p.correlation:+.5f})" for p in pairs]
        names = dict.fromkeys(n for p in pairs for n in (p.first, p.second))
        lines.append(sentence("verdict.correlated", pairs=words, way_out=_way_out([*names])))
    return lines


def _not_determined(group: Group, v: Verdict) -> str:
    """Return the sentence on a group that is not determined."""
    names = group.names
    code = "verdict.not-determined"
    if group.combinations:
        code = "verdict.only-combinations"
    elif group.count < len(names):
        # Slopes at one point tell how they trade off there; no number holds along the whole valley.
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
    # Only a parameter with a prior can hold the others up; the rest of the group leans on it.
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
    """Return remedies for parameters that the data do not separate, `count` of which have to be
    known."""
    # A gain or a shift has no value in the configuration: it goes with its switch, as biases do.
    # A record in windows has no switch for initial states.
    kinds = [n.kind for n in exchanged if n.kind != "initial_state"]
    kinds += ["input_gain" for n in names if n.startswith("gain ")]
    kinds += [n for n in names if n == "time_shift"]
    parameters = [n for n in names if n != "time_shift" and not n.startswith("gain ")]
    off = [f"fit.nuisance.{kind}" for kind in dict.fromkeys(kinds)]
    # At most all of them: a direction may also run through gains and the time shift.
    number = min(count, len(parameters))
    few = number if number < len(parameters) else 0
    return sentence(
        "verdict.way-out", off=off, which=parameters, few=few, both=bool(off and parameters)
    )
