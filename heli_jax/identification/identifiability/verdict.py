"""The result of the identifiability analysis: plain data, of which `sentences` makes words."""

import math
from collections.abc import Iterable, Mapping, Set
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np

from heli_jax.identification.unknowns.layout import FlightUnknown

# Rank alone is not enough: noise of any size leaves full rank, and an interval of three decades.
FACTOR = 10.0
"""A 95 % interval that reaches further than this factor to either side determines nothing."""
ROUGHLY = 0.5
"""sd in relative coordinates, as intervals are reported, above which a parameter is determined only
roughly: its 95 % interval reaches further than a factor of 2.7 to either side"""
# The 97.5 % point of the standard normal distribution.
Z95 = 1.959963984540054


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
    room: float = math.inf
    """from the value to the nearer end of a search that no configuration widens, that of a time
    shift, in its relative coordinate"""

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


class Weakest(NamedTuple):
    """The least determined direction where all is determined, but hardly."""

    parts: dict[str, float]
    combinations: tuple[Combination, ...]


@dataclass(frozen=True, eq=False)
class Verdict:
    """The findings on what the data (with the priors) determine."""

    unknowns: tuple[Unknown, ...]
    """(q,)"""
    identifiable: bool
    # Both without the weak priors of nuisances, which would give full rank to anything.
    rank: int
    rank_without_priors: int
    condition: float
    singular_values: np.ndarray
    """(q,) of the whitened, scaled sensitivity, largest first"""
    null_directions: tuple[dict[str, float], ...]
    """unit vectors in relative coordinates along which nothing changes"""
    combinations: tuple[Combination, ...]
    """what the data alone determine of parameters that they do not determine one by one"""
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
    own_share: dict[str, float]
    """share of the posterior precision by the unknown's own prior"""
    weak_share: dict[str, float]
    """the same by the weak priors of nuisances"""
    groups: tuple[Group, ...]
    """what is not determined"""
    resting_groups: tuple[Group, ...]
    """what priors determine, and the data alone do not"""
    factors: dict[str, float]
    """of what is determined, but with a wide interval, the factor to its ends; infinite where that
    reaches the end of its search"""
    weakest: Weakest | None
    """None where there is more to say than that"""
    remedies: Mapping[str, str]
    """by name, a further way out, as 'add a run with a known inertia'"""
    switches: frozenset[str]
    """the kinds of nuisances that may be switched off"""
    through_zero: tuple[str, ...] = ()
    """parameters that are determined, with an interval that holds zero: their sign is open"""
    second: tuple[SecondSolution, ...] = ()
    """other values that the data do not tell from these"""
    sentences: tuple[str, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the unknowns (q,)."""
        return tuple(u.name for u in self.unknowns)

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

    def nothing(self, sentence: str) -> "Verdict":
        """Return the verdict with no parameter determined, for a reason."""
        return replace(
            self,
            identifiable=False,
            combinations=(),
            pairs=(),
            undetermined=tuple(n for n in self.names if n not in self.without_effect),
            sentences=(sentence,),
            resting_groups=(),
            factors={},
            through_zero=(),
        )

    @property
    def text(self) -> str:
        """The verdict in words."""
        return " ".join(self.sentences)


def connected[T](sets: Iterable[Set[T]]) -> list[set[T]]:
    """Return the unions of those sets that share a member, directly or through others."""
    groups: list[set[T]] = []
    for one in sets:
        # One may join several groups that had nothing in common until now.
        touched = [group for group in groups if group & one]
        rest = [group for group in groups if not group & one]
        joined = set(one).union(*touched)
        groups = [*rest, joined] if joined else groups
    return groups
