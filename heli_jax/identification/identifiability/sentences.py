"""The identifiability analysis in sentences; each names a way out that exists."""

import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple

from heli_jax.identification.identifiability.verdict import (
    Combination,
    Pair,
    SecondSolution,
    Unknown,
)

# Index is the number; from nine on all are called nine.
_NUMBERS = ("none", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine")
_STATED = 8.0 / 9.0
"""share of what is known of a parameter above which it is said that weak priors hold it: its sd
would be three times as large without them"""


_BY_PRIOR = 0.9
"""share of its prior above which a parameter is what the prior says"""


class Inseparable(NamedTuple):
    """Parameters that no rows tell apart, and how many of them would have to be known."""

    names: tuple[str, ...]
    count: int
    combinations: tuple[Combination, ...]
    """what is determined of them all the same"""
    nuisances: tuple[str, ...] = ()
    """what they are exchanged with where weak priors alone hold them, as 'the bias of p'"""
    switches: tuple[str, ...] = ()
    """nuisances that would determine them if they were switched off, as 'fit.nuisance.bias'"""


class Weakest(NamedTuple):
    """The least determined direction where all is determined, but hardly."""

    parts: dict[str, float]
    combinations: tuple[Combination, ...]
    condition: float


class Facts(NamedTuple):
    """What the sentences say."""

    unknowns: tuple[Unknown, ...]
    without_effect: tuple[str, ...]
    groups: tuple[Inseparable, ...]
    """what is not determined"""
    undetermined: tuple[str, ...]
    """also those that take a small part in it"""
    resting: tuple[Inseparable, ...]
    """where all is determined: what is so by the priors of parameters alone"""
    pairs: tuple[Pair, ...]
    weakest: Weakest | None
    weak_share: Mapping[str, float]
    """by name, the share of what is known that weak priors of nuisances contribute"""
    prior_share: Mapping[str, float]
    """by name, the share of what is known that its own prior contributes"""
    remedies: Mapping[str, str]
    """by name, a further way out, as 'add a run with a known inertia'"""
    roughly: Mapping[str, float] = MappingProxyType({})
    """by name, the factor to the ends of a 95 % interval that is wide; infinite of a time shift
    whose interval reaches the end of its search"""
    through_zero: tuple[str, ...] = ()
    """parameters of either sign whose 95 % interval holds zero"""
    second: tuple[SecondSolution, ...] = ()
    """other values that fit as well"""


def sentences(facts: Facts) -> tuple[str, ...]:
    """What the data determine, what they do not, and what can be done, most important first."""
    # At its bound the slope of what is searched through a tanh vanishes: that is no lack of effect.
    bound = {u.name: u for u in facts.unknowns if u.at_bound}
    lines = [
        _at_bound(bound[name]) if name in bound else _without_effect(name)
        for name in facts.without_effect
    ]
    lines += _also_fits(facts)
    lines += [_not_determined(group, facts) for group in facts.groups]
    # Each parameter is spoken of once, in the sentence that says most: what comes later leaves out
    # what an earlier one has named.
    in_groups = {n for group in facts.groups for n in group.names} | set(facts.without_effect)
    in_groups |= {n for other in facts.second for n in other.changed}
    partners = [n for n in facts.undetermined if n not in in_groups]
    not_determined = in_groups | set(partners)
    if partners:
        verb = "take part in that and are" if len(partners) > 1 else "takes part in that and is"
        lines.append(f"{listed(partners)} {verb} not determined either.")
    lines += [_at_bound(u) for u in facts.unknowns if u.at_bound and u.name not in not_determined]
    lines += _determined(facts, not_determined)
    # A pair whose members have both been spoken of needs no sentence of its own.
    covered = set(not_determined)
    if not not_determined:
        covered |= {n for group in facts.resting for n in group.names}
    if facts.weakest is not None:
        lines.append(_weakest(facts.weakest, facts))
        covered |= set(facts.weakest.parts)
    lines += _correlated_pairs(facts, covered)
    lines += _leaning_on_weak_priors(facts, not_determined)
    return tuple(lines)


def _determined(facts: Facts, not_determined: set[str]) -> list[str]:
    """What the data determine, and what priors do."""
    if facts.resting and not not_determined:
        return [_resting(group, facts) for group in facts.resting]
    shares = facts.prior_share.items()
    # To say that the data determine what the prior alone holds would be the worst mistake here: its
    # interval is as narrow as any.
    by_prior = [n for n, share in shares if share > _BY_PRIOR and n not in not_determined]
    by_data = [
        u.name
        for u in facts.unknowns
        # The bound's value is nobody's measurement.
        if not (u.name in not_determined or u.name in by_prior or u.at_bound)
    ]
    lines = [_by_data(by_data, facts)] if by_data else []
    return lines + _by_prior(by_prior)


def _by_data(names: list[str], facts: Facts) -> str:
    roughly, zero = facts.roughly, facts.through_zero
    # An interval that holds zero is no factor, and says of the sign that it is open.
    well = [n + _open_sign(n, zero) for n in names if n not in roughly]
    wide = [n + (_open_sign(n, zero) or _how_roughly(roughly[n])) for n in names if n in roughly]
    if not wide:
        return f"The data determine {listed(well)}."
    if not well:
        return f"The data determine only roughly {listed(wide)}."
    return f"The data determine {listed(well)}, and only roughly {listed(wide)}."


def _how_roughly(factor: float) -> str:
    # What is no logarithm has no factor: a time shift up to the end of its search.
    if not math.isfinite(factor):
        return " (its 95 % interval reaches the end of its search)"
    return f" (95 % within a factor of {factor:.2g})"


def _open_sign(name: str, through_zero: tuple[str, ...]) -> str:
    return " (its 95 % interval holds zero)" if name in through_zero else ""


def _correlated_pairs(facts: Facts, covered: set[str]) -> list[str]:
    """One sentence for every group of parameters that correlated pairs tie together."""
    pairs = [pair for pair in facts.pairs if not {pair.first, pair.second} <= covered]
    lines = []
    for names in _tied_together(pairs):
        inside = [pair for pair in pairs if pair.first in names]
        ordered = [u.name for u in facts.unknowns if u.name in names]
        correlations = f"correlation {inside[0].correlation:+.5f}"
        if len(inside) > 1:
            members = len(names) * (len(names) - 1) // 2
            count = f"all {members}" if len(inside) == members else f"{len(inside)} of {members}"
            sizes = [abs(pair.correlation) for pair in inside]
            correlations = (
                f"correlations of {count} pairs from {min(sizes):.5f} to {max(sizes):.5f} in size"
            )
        lines.append(
            f"{listed(ordered)} can hardly be told apart ({correlations}): "
            f"{way_out(tuple(ordered), facts, 1)}."
        )
    return lines


def _tied_together(pairs: list[Pair]) -> list[set[str]]:
    """The connected components of a graph whose edges are the pairs, in the pairs' order."""
    groups: list[set[str]] = []
    for pair in pairs:
        both = {pair.first, pair.second}
        touched = [group for group in groups if group & both]
        if not touched:
            groups.append(both)
            continue
        # A pair may join two groups that had nothing in common until now.
        touched[0].update(both, *touched[1:])
        groups = [group for group in groups if group not in touched[1:]]
    return groups


def _leaning_on_weak_priors(facts: Facts, not_determined: set[str]) -> list[str]:
    # The share s of the precision that weak priors have: without them the sd is (1 - s)^-1/2 times
    # as large. A share of 1 is what is not determined, which has its sentence.
    factors = {
        n: (1.0 - share) ** -0.5
        for n, share in facts.weak_share.items()
        if _STATED < share < 1.0 and n not in not_determined
    }
    if not factors:
        return []
    return [
        "Without the weak priors of initial states, biases and input offsets (ten times the "
        f"signal) the sd of {listed(list(factors))} would be {max(factors.values()):.2g} times "
        "as large."
    ]


def _by_prior(names: list[str]) -> list[str]:
    """What priors say and the data do not."""
    if not names:
        return []
    verb = "rests on its prior" if len(names) == 1 else "rest on their priors"
    them = "it" if len(names) == 1 else "them"
    return [f"{listed(names)} {verb}: the data say next to nothing of {them}."]


def listed(words: list[str] | tuple[str, ...], last: str = "and") -> str:
    """`a, b and c`"""
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} {last} {words[-1]}"


def _also_fits(facts: Facts) -> list[str]:
    """One sentence for each set of parameters that have several values."""
    here = {u.name: u.value for u in facts.unknowns}
    by_names: dict[tuple[str, ...], list[SecondSolution]] = {}
    for other in facts.second:
        by_names.setdefault(other.changed, []).append(other)
    lines = []
    for names, others in by_names.items():
        sets = [here, *(other.values for other in others)]
        sets = [", ".join(f"{n} {values[n]:.4g}" for n in names) for values in sets]
        lines.append(
            f"{listed(names)} {'have' if len(names) > 1 else 'has'} "
            f"{_NUMBERS[min(len(sets), len(_NUMBERS) - 1)]} solutions that answer alike, two modes "
            f"exchanged: {'; or '.join(sets)}. The data do not tell which: "
            f"fix one of {', '.join(names)}, give it a prior, or bound it to one side; a lag such "
            "as a servo's can be measured by itself."
        )
    return lines


def _at_bound(u: Unknown) -> str:
    return (
        f"{u.name} is at its bound, {u.value:.3g}: the data want it beyond, and do not determine "
        "it there."
    )


def _without_effect(name: str) -> str:
    # A gain or a shift has no value in the configuration: it goes with its switch.
    switch = _switch(name)
    remedy = f"switch off {switch}" if switch else "fix it"
    return f"{name} has no effect on the measured outputs: {remedy}."


def _switch(name: str) -> str:
    """What switches an unknown off that is no parameter; empty for parameters."""
    if name.startswith("gain "):
        return "fit.nuisance.input_gain"
    return "fit.nuisance.time_shift" if name == "time_shift" else ""


def _not_determined(group: Inseparable, facts: Facts) -> str:
    names = group.names
    if group.combinations:
        what = (
            f"the data determine only {listed([c.name for c in group.combinations])} of "
            f"{listed(names)}"
        )
    elif len(names) == 1:
        what = f"the data do not determine {names[0]}"
    elif group.count < len(names):
        # Slopes at one point tell how they trade off there; no number holds along the whole valley.
        what = (
            f"the data determine {listed(names)} only together, since they trade off against each "
            "other"
        )
    else:
        what = f"the data determine no part of {listed(names)}"
    if group.nuisances:
        what = f"{listed([*names, *group.nuisances])} are exchangeable, so {what}"
    aliased = [u.name for u in facts.unknowns if u.aliased and u.name in names]
    if aliased:
        it = "it moves" if names == tuple(aliased[:1]) else f"{listed(aliased)} move"
        if len(aliased) == 1 and len(names) > 1:
            it = f"{aliased[0]} moves"
        what += f", since {it} a mode past the Nyquist frequency, whose aliases fit as well"
    # Not capitalize(): that would lower the names' capitals.
    what = what[0].upper() + what[1:] if what.startswith("the ") else what
    return f"{what}: {way_out(names, facts, group.count, group.switches)}."


def way_out(
    names: tuple[str, ...], facts: Facts, count: int, switches: tuple[str, ...] = ()
) -> str:
    """What can be done about parameters that the data do not tell apart.

    Args:
        names: the parameters, gains and the time shift concerned.
        facts: which of them are parameters, and what remedies the model has.
        count: how many of them have to be known for the rest to be determined.
        switches: nuisances whose absence would determine them too.
    """
    parameters = [u.name for u in facts.unknowns if u.name in names and u.is_parameter]
    off = [*switches, *dict.fromkeys(s for s in map(_switch, names) if s)]
    # What costs nothing first: a switch, then what has to be known from elsewhere, then another
    # flight.
    ways = [f"switch off {listed(off, 'or')}"] if off else []
    ways += _fix(parameters, len(names) == 1, count)
    ways += dict.fromkeys(facts.remedies[n] for n in parameters if n in facts.remedies)
    return listed(ways, "or") if len(ways) < 3 else f"{', '.join(ways[:-1])}, or {ways[-1]}"


def _fix(parameters: list[str], alone: bool, count: int) -> list[str]:
    """How many of the parameters to fix or to give priors; `alone` where nothing else is named, so
    that 'it' is plain."""
    if not parameters:
        return []
    if len(parameters) == 1:
        return [f"fix {parameters[0]}", f"give {'it' if alone else parameters[0]} a prior"]
    # At most all of them: a direction may also run through gains and the time shift.
    number, which = min(count, len(parameters)), ", ".join(parameters)
    if number == 1:
        return [f"fix one of {which}", "give it a prior"]
    return [f"fix {_NUMBERS[min(number, len(_NUMBERS) - 1)]} of {which}", "give them priors"]


def _resting(group: Inseparable, facts: Facts) -> str:
    # Only a parameter with a prior can hold the others up; the rest of the group leans on it.
    with_prior = [u.name for u in facts.unknowns if u.prior > 0 and u.name in group.names]
    owners = f"the prior of {listed(with_prior)}" if with_prior else "the priors"
    verb = "rests" if len(group.names) == 1 else "rest"
    if group.combinations:
        what = f"only {listed([c.name for c in group.combinations])}"
        text = f"The data alone determine {what}; {listed(group.names)} {verb} on {owners}"
    else:
        text = f"The data alone do not determine {listed(group.names, 'or')}: "
        text += f"{'it' if len(group.names) == 1 else 'they'} {verb} on {owners}"
    if group.nuisances:
        text += f", since {listed([*group.names, *group.nuisances])} are exchangeable"
    return text + "."


def _weakest(weakest: Weakest, facts: Facts) -> str:
    words = ", ".join(f"{n} {v:+.2f}" for n, v in weakest.parts.items())
    # The direction is one of logarithms: parameters may move along it by these powers of a factor.
    names, combos = tuple(weakest.parts), weakest.combinations
    better = listed([c.name for c in combos]) if combos else "their combinations"
    return (
        f"They are hardly separated (condition number {weakest.condition:.1e}): the weakest "
        f"direction is ({words}) in log coordinates, and {better} "
        f"{'is' if len(combos) == 1 else 'are'} determined far better than {listed(names)}; "
        f"{way_out(names, facts, 1)}."
    )
