"""The identifiability analysis in sentences; each names a way out that exists."""

import math
from collections.abc import Sequence

from heli_jax.identification.identifiability.verdict import (
    Group,
    SecondSolution,
    Unknown,
    Verdict,
    connected,
)
from heli_jax.messages import listed, sentence

# Index is the number; from nine on all are called nine.
_NUMBERS = ("none", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine")
_STATED = 8.0 / 9.0
"""share of what is known of a parameter above which it is said that weak priors hold it: its sd
would be three times as large without them"""
_BY_PRIOR = 0.9
"""share of its prior above which a parameter is what the prior says"""


def sentences(verdict: Verdict) -> tuple[str, ...]:
    """Sentences on what the data determine, what they do not, and what can be done."""
    v = verdict
    # At its bound the slope of what is searched through a tanh vanishes: that is no lack of effect.
    bound = {u.name: u for u in v.unknowns if u.at_bound}
    lines = [
        _at_bound(bound[n])
        if n in bound
        else sentence("verdict.without-effect", name=n, switch=_switch(n), fixed=not _switch(n))
        for n in v.without_effect
    ]
    lines += _also_fits(v)
    lines += [_not_determined(group, v) for group in v.groups]
    # Each parameter is spoken of once, in the sentence that says most: what comes later leaves out
    # what an earlier one has named.
    told = {n for group in v.groups for n in group.names} | set(v.without_effect)
    told |= {n for other in v.second for n in other.changed}
    partners = [n for n in v.undetermined if n not in told]
    told |= set(partners)
    if partners:
        lines.append(sentence("verdict.partners", names=partners))
    lines += [_at_bound(u) for name, u in bound.items() if name not in told]
    lines += _determined(v, told)
    # A pair whose members have both been spoken of needs no sentence of its own.
    covered = told | set(() if told else v.resting)
    if v.weakest is not None:
        names = list(v.weakest.parts)
        parts = ", ".join(f"{n} {part:+.2f}" for n, part in v.weakest.parts.items())
        better = [c.name for c in v.weakest.combinations]
        numbers = {"names": names, "parts": parts, "better": better, "condition": v.condition}
        lines.append(sentence("verdict.hardly-separated", **numbers, way_out=_way_out(names, v)))
        covered |= set(names)
    lines += _correlated_pairs(v, covered)
    # The share s of the precision that weak priors have: without them the sd is (1 - s)^-1/2 times
    # as large. A share of 1 is what is not determined, which has its sentence.
    weak = {n: s for n, s in v.weak_share.items() if _STATED < s < 1.0 and n not in told}
    if weak:
        times = (1.0 - max(weak.values())) ** -0.5
        lines.append(sentence("verdict.weak-priors", names=list(weak), times=times))
    return tuple(lines)


def _at_bound(u: Unknown) -> str:
    return sentence("verdict.at-bound", name=u.name, value=u.value)


def _switch(name: str) -> str:
    """The key that switches an unknown off that is no parameter; empty for parameters."""
    # A gain or a shift has no value in the configuration: it goes with its switch.
    if name.startswith("gain "):
        return "fit.nuisance.input_gain"
    return "fit.nuisance.time_shift" if name == "time_shift" else ""


def _determined(v: Verdict, told: set[str]) -> list[str]:
    """Sentences on what the data and the priors determine."""
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
        # An interval that holds zero is no factor, and says of the sign that it is open.
        zero = u.name in v.through_zero
        numbers = {
            "zero": zero,
            "end": not (zero or math.isfinite(factor)),
            "factor": f"{factor:.2g}" if 1.0 < factor < math.inf and not zero else "",
        }
        (wide if u.name in v.factors else well).append(
            sentence("verdict.with-interval", name=u.name, **numbers)
        )
    if well or wide:
        lines.append(sentence("verdict.determined", well=well, wide=wide, both=bool(well and wide)))
    if by_prior:
        lines.append(sentence("verdict.by-prior", names=by_prior))
    return lines


def _correlated_pairs(v: Verdict, covered: set[str]) -> list[str]:
    """One sentence for every group of parameters that correlated pairs tie together."""
    pairs = [pair for pair in v.pairs if not {pair.first, pair.second} <= covered]
    lines = []
    for names in connected([{pair.first, pair.second} for pair in pairs]):
        inside = [pair.correlation for pair in pairs if pair.first in names]
        ordered = [n for n in v.names if n in names]
        numbers = {
            "names": ordered,
            "count": len(inside),
            "all": len(names) * (len(names) - 1) // 2,
            "low": inside[0] if len(inside) == 1 else min(map(abs, inside)),
            "high": max(map(abs, inside)),
        }
        code = "verdict.hardly-apart" if len(inside) == 1 else "verdict.several-hardly-apart"
        lines.append(sentence(code, **numbers, way_out=_way_out(ordered, v)))
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
        values = "; or ".join(", ".join(f"{n} {one[n]:.4g}" for n in names) for one in sets)
        count = _NUMBERS[min(len(sets), len(_NUMBERS) - 1)]
        lines.append(sentence("verdict.also-fits", names=names, count=count, values=values))
    return lines


def _not_determined(group: Group, v: Verdict) -> str:
    names = group.names
    code = "verdict.no-part"
    if group.combinations:
        code = "verdict.only-combinations"
    elif len(names) == 1:
        code = "verdict.not-determined"
    elif group.count < len(names):
        # Slopes at one point tell how they trade off there; no number holds along the whole valley.
        code = "verdict.only-together"
    aliased = [u.name for u in v.unknowns if u.aliased and u.name in names]
    kinds = dict.fromkeys(n.kind for n in group.exchanged if n.kind in v.switches)
    return sentence(
        code,
        names=names,
        only=[c.name for c in group.combinations],
        exchanged=_exchanged(group),
        aliased=sentence("verdict.aliased", names=aliased),
        way_out=_way_out(names, v, group.count, [f"fit.nuisance.{kind}" for kind in kinds]),
    )


def _exchanged(group: Group) -> str:
    nuisances = dict.fromkeys(n.words for n in group.exchanged)
    return listed([*group.names, *nuisances]) if nuisances else ""


def _way_out(names: Sequence[str], v: Verdict, count: int = 1, switches: Sequence[str] = ()) -> str:
    """Remedies for parameters that the data do not separate, `count` of which have to be known."""
    parameters = [u.name for u in v.unknowns if u.name in names and u.is_parameter]
    # At most all of them: a direction may also run through gains and the time shift.
    number = min(count, len(parameters))
    off = [*switches, *dict.fromkeys(s for s in map(_switch, names) if s)]
    return sentence(
        "verdict.way-out",
        off=off,
        both=bool(off and parameters),
        which=", ".join(parameters),
        number=number,
        few=_NUMBERS[min(number, len(_NUMBERS) - 1)] if len(parameters) > 1 else "",
        further=list(dict.fromkeys(v.remedies[n] for n in parameters if n in v.remedies)),
    )


def _resting(group: Group, v: Verdict) -> str:
    # Only a parameter with a prior can hold the others up; the rest of the group leans on it.
    owners = [u.name for u in v.unknowns if u.prior > 0 and u.name in group.names]
    return sentence(
        "verdict.resting-combinations" if group.combinations else "verdict.resting",
        names=group.names,
        only=[c.name for c in group.combinations],
        owners=owners,
        others=not owners,
        exchanged=_exchanged(group),
    )
