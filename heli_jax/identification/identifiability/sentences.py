"""The identifiability analysis in sentences; each names a way out that exists."""

import math
from collections.abc import Sequence

from heli_jax.identification.identifiability.verdict import (
    Group,
    SecondSolution,
    Unknown,
    Verdict,
    Weakest,
    connected,
)
from heli_jax.messages import listed

# Index is the number; from nine on all are called nine.
_NUMBERS = ("none", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine")
_STATED = 8.0 / 9.0
"""share of what is known of a parameter above which it is said that weak priors hold it: its sd
would be three times as large without them"""
_BY_PRIOR = 0.9
"""share of its prior above which a parameter is what the prior says"""


def sentences(verdict: Verdict) -> tuple[str, ...]:
    """What the data determine, what they do not, and what can be done, most important first."""
    v = verdict
    # At its bound the slope of what is searched through a tanh vanishes: that is no lack of effect.
    bound = {u.name: u for u in v.unknowns if u.at_bound}
    lines = [_at_bound(bound[n]) if n in bound else _without_effect(n) for n in v.without_effect]
    lines += _also_fits(v)
    lines += [_not_determined(group, v) for group in v.groups]
    # Each parameter is spoken of once, in the sentence that says most: what comes later leaves out
    # what an earlier one has named.
    told = {n for group in v.groups for n in group.names} | set(v.without_effect)
    told |= {n for other in v.second for n in other.changed}
    partners = [n for n in v.undetermined if n not in told]
    told |= set(partners)
    if partners:
        verb = "take part in that and are" if len(partners) > 1 else "takes part in that and is"
        lines.append(f"{listed(partners)} {verb} not determined either.")
    lines += [_at_bound(u) for name, u in bound.items() if name not in told]
    lines += _determined(v, told)
    # A pair whose members have both been spoken of needs no sentence of its own.
    covered = told | set(() if told else v.resting)
    if v.weakest is not None:
        lines.append(_hardly_separated(v.weakest, v))
        covered |= set(v.weakest.parts)
    lines += _correlated_pairs(v, covered)
    # The share s of the precision that weak priors have: without them the sd is (1 - s)^-1/2 times
    # as large. A share of 1 is what is not determined, which has its sentence.
    weak = {n: s for n, s in v.weak_share.items() if _STATED < s < 1.0 and n not in told}
    if weak:
        lines.append(
            "Without the weak priors of initial states, biases and input offsets (ten times the "
            f"signal) the sd of {listed(list(weak))} would be "
            f"{(1.0 - max(weak.values())) ** -0.5:.2g} times as large."
        )
    return tuple(lines)


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


def _determined(v: Verdict, told: set[str]) -> list[str]:
    """What the data determine, and what priors do."""
    if v.resting_groups and not told:
        return [_resting(group, v) for group in v.resting_groups]
    # To say that the data determine what the prior alone holds would be the worst mistake here: its
    # interval is as narrow as any.
    by_prior = [n for n, share in v.own_share.items() if share > _BY_PRIOR and n not in told]
    lines, well, wide = [], [], []
    for u in v.unknowns:
        # The bound's value is nobody's measurement.
        if u.name in told or u.name in by_prior or u.at_bound:
            continue
        factor = v.factors.get(u.name, 1.0)
        how = f" (95 % within a factor of {factor:.2g})" if factor > 1.0 else ""
        if not math.isfinite(factor):
            how = " (its 95 % interval reaches the end of its search)"
        # An interval that holds zero is no factor, and says of the sign that it is open.
        if u.name in v.through_zero:
            how = " (its 95 % interval holds zero)"
        (wide if u.name in v.factors else well).append(u.name + how)
    parts = [listed(well)] if well else []
    parts += [f"only roughly {listed(wide)}"] if wide else []
    if parts:
        lines.append(f"The data determine {', and '.join(parts)}.")
    if by_prior:
        rests, them = "rests on its prior", "it"
        if len(by_prior) > 1:
            rests, them = "rest on their priors", "them"
        lines.append(f"{listed(by_prior)} {rests}: the data say next to nothing of {them}.")
    return lines


def _correlated_pairs(v: Verdict, covered: set[str]) -> list[str]:
    """One sentence for every group of parameters that correlated pairs tie together."""
    pairs = [pair for pair in v.pairs if not {pair.first, pair.second} <= covered]
    lines = []
    for names in connected([{pair.first, pair.second} for pair in pairs]):
        inside = [pair for pair in pairs if pair.first in names]
        ordered = [n for n in v.names if n in names]
        correlations = f"correlation {inside[0].correlation:+.5f}"
        if len(inside) > 1:
            members = len(names) * (len(names) - 1) // 2
            count = f"all {members}" if len(inside) == members else f"{len(inside)} of {members}"
            sizes = [abs(pair.correlation) for pair in inside]
            correlations = (
                f"correlations of {count} pairs from {min(sizes):.5f} to {max(sizes):.5f} in size"
            )
        lines.append(
            f"{listed(ordered)} can hardly be told apart ({correlations}): {_way_out(ordered, v)}."
        )
    return lines


def _also_fits(v: Verdict) -> list[str]:
    """One sentence for each set of parameters that have several values."""
    here = {u.name: u.value for u in v.unknowns}
    by_names: dict[tuple[str, ...], list[SecondSolution]] = {}
    for other in v.second:
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


def _not_determined(group: Group, v: Verdict) -> str:
    names = group.names
    if group.combinations:
        only = listed([c.name for c in group.combinations])
        what = f"the data determine only {only} of {listed(names)}"
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
    if group.exchanged:
        what = f"{_exchangeable(group)}, so {what}"
    aliased = [u.name for u in v.unknowns if u.aliased and u.name in names]
    if aliased:
        moves = "moves" if len(aliased) == 1 else "move"
        what += (
            f", since {listed(aliased)} {moves} a mode past the Nyquist frequency, whose aliases "
            "fit as well"
        )
    # Not capitalize(): that would lower the names' capitals.
    what = what[0].upper() + what[1:] if what.startswith("the ") else what
    kinds = dict.fromkeys(n.kind for n in group.exchanged if n.kind in v.switches)
    switches = [f"fit.nuisance.{kind}" for kind in kinds]
    return f"{what}: {_way_out(names, v, group.count, switches)}."


def _exchangeable(group: Group) -> str:
    nuisances = dict.fromkeys(n.words for n in group.exchanged)
    return f"{listed([*group.names, *nuisances])} are exchangeable"


def _way_out(names: Sequence[str], v: Verdict, count: int = 1, switches: Sequence[str] = ()) -> str:
    """What can be done about parameters that the data do not tell apart.

    Args:
        names: the parameters, gains and the time shift concerned.
        v: which of them are parameters, and what remedies the model has.
        count: how many of them have to be known for the rest to be determined.
    """
    parameters = [u.name for u in v.unknowns if u.name in names and u.is_parameter]
    off = [*switches, *dict.fromkeys(s for s in map(_switch, names) if s)]
    # What costs nothing first: a switch, then what has to be known from elsewhere, then another
    # flight.
    ways = [f"switch off {listed(off, 'or')}"] if off else []
    # At most all of them: a direction may also run through gains and the time shift.
    number, which = min(count, len(parameters)), ", ".join(parameters)
    if len(parameters) == 1:
        ways += [f"fix {which}", f"give {'it' if len(names) == 1 else which} a prior"]
    elif number == 1:
        ways += [f"fix one of {which}", "give it a prior"]
    elif number > 1:
        ways += [f"fix {_NUMBERS[min(number, len(_NUMBERS) - 1)]} of {which}", "give them priors"]
    ways += dict.fromkeys(v.remedies[n] for n in parameters if n in v.remedies)
    return listed(ways, "or") if len(ways) < 3 else f"{', '.join(ways[:-1])}, or {ways[-1]}"


def _resting(group: Group, v: Verdict) -> str:
    # Only a parameter with a prior can hold the others up; the rest of the group leans on it.
    with_prior = [u.name for u in v.unknowns if u.prior > 0 and u.name in group.names]
    owners = f"the prior of {listed(with_prior)}" if with_prior else "the priors"
    one = len(group.names) == 1
    if group.combinations:
        only = listed([c.name for c in group.combinations])
        text = f"The data alone determine only {only}; {listed(group.names)}"
    else:
        text = f"The data alone do not determine {listed(group.names, 'or')}: "
        text += "it" if one else "they"
    text += f" {'rests' if one else 'rest'} on {owners}"
    return text + (f", since {_exchangeable(group)}." if group.exchanged else ".")


def _hardly_separated(weakest: Weakest, v: Verdict) -> str:
    words = ", ".join(f"{n} {part:+.2f}" for n, part in weakest.parts.items())
    # The direction is one of logarithms: parameters may move along it by these powers of a factor.
    names, combos = tuple(weakest.parts), weakest.combinations
    better = listed([c.name for c in combos]) if combos else "their combinations"
    return (
        f"They are hardly separated (condition number {v.condition:.1e}): the weakest "
        f"direction is ({words}) in log coordinates, and {better} "
        f"{'is' if len(combos) == 1 else 'are'} determined far better than {listed(names)}; "
        f"{_way_out(names, v)}."
    )
