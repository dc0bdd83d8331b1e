"""Signals that were cut off at the ends of their range, stuck, or logged in steps too coarse.

Judged as they were logged, where the flight knows it: what was resampled has no flat tops and no
steps, and suffers from them all the same.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from heli_jax.finding import Finding
from heli_jax.flights.flight import Flight
from heli_jax.flights.marks import mark_words
from heli_jax.flights.signal_facts import (
    DROP_SHARE,
    RAIL_SHARE,
    STUCK_SECONDS,
    SignalFacts,
    Stuck,
    at_rails,
)
from heli_jax.flights.strays import stray_words
from heli_jax.flights.table import sample_count
from heli_jax.identification.estimation.filter_error import REMEDY, noiseless, noiseless_words
from heli_jax.numerics.white_noise import noise_guess

_RAIL_LIMIT = f"share of the samples at a rail, {RAIL_SHARE}"
_CUT_OFF = 0.02
"""part of an output's samples at its rails from which on no model of them is adequate"""
_COARSE = 16
"""distinct values of a moving signal below which it is called coarse"""
_MOVES = 0.2
"""part of the samples at which an input moves, from which on it is no sequence of steps"""
_STUCK_LIMIT = f"seconds at one value while others change, {STUCK_SECONDS}"
_STRAY_LIMIT = "samples that no motion leads to, 0"
_MOST_NAMED = 4
"""signals in a sentence"""


class Rails(NamedTuple):
    """Parts of the samples at the ends of a signal's range, 0 where an end is none."""

    low: float
    high: float


def rails(x: Float[np.ndarray, " N"]) -> Rails:
    """How much of a signal rests at an end of its range, where samples pile up exactly.

    A signal that begins and ends at the same extreme rests there, and steps between a few values
    have no rail that samples could tell from a level.
    """
    at_low, at_high = at_rails(x)
    seen = max(int(np.isfinite(x).sum()), 1)
    return Rails(float(at_low.sum() / seen), float(at_high.sum() / seen))


type Facts = Mapping[tuple[str, str], SignalFacts]
"""of a flight's signals, by name and kind"""


def saturation(flights: Sequence[tuple[str, Flight]]) -> list[Finding]:
    """Signals that rest at an end of their range, the worst first.

    Args:
        flights: by what each is called.
    """
    saturated = []
    for label, flight in flights:
        for (name, kind), facts in flight.facts.items():
            if sum(facts.shares) > 0:
                saturated.append((sum(facts.shares), label, kind, name, facts))
    if not saturated:
        words = "no signal piles up at an end of its range."
        return [Finding("quality.saturation", "ok", words, 0.0, _RAIL_LIMIT)]
    saturated.sort(key=lambda f: -f[0])
    return [_saturated(*f) for f in saturated[:_MOST_NAMED]]


def cut_off(flights: Sequence[tuple[str, Facts]]) -> list[Finding]:
    """Outputs that rest at an end of their range; enough of them denies any model.

    Args:
        flights: what each is called, and the facts of its signals.
    """
    findings = []
    for label, of_signals in flights:
        for (name, kind), facts in of_signals.items():
            share = sum(facts.shares)
            if kind == "output" and share > 0:
                brief = f"{name} is cut off in {100 * share:.2g} % of its samples"
                found = _saturated(share, label, kind, name, facts)
                findings.append(found._replace(brief=brief, denies=share >= _CUT_OFF))
    return findings


def _saturated(total: float, label: str, kind: str, name: str, facts: SignalFacts) -> Finding:
    ends = [
        f"at its {word} value {rail.value:.4g} in {100 * share:.2g} % of the samples"
        for word, rail, share in zip(
            ("smallest", "largest"), (facts.low, facts.high), facts.shares, strict=True
        )
        if share
    ]
    does = "what it measured beyond is not in the log, and the model is fitted to the flat tops"
    if kind == "input":
        does = "if the log shows the command and not what acted, the model is driven by too much"
    if kind == "input" and len(ends) < 2:
        does = "if it was cut off there after it was logged, or the stick went on, inputs are wrong"
    text = f"{label}: {name} is {' and '.join(ends)}: {does}; leave these parts out."
    return Finding("quality.saturation", "doubt", text, round(total, 6), _RAIL_LIMIT, (name,))


def stuck(flights: Sequence[tuple[str, Flight]]) -> list[Finding]:
    """Outputs that stay at one value while others move, and values that stand for none.

    Args:
        flights: by what each is called.
    """
    doubts: list[tuple[float, str]] = []
    for label, flight in flights:
        for (name, kind), facts in flight.facts.items():
            if facts.marks and kind == "output":
                words = f"{label}: {name} has {mark_words(facts.marks)}: taken as missing; look "
                doubts.append((0.0, f"{words}at what the log says of such values."))
            if facts.dropouts is not None and facts.dropped >= DROP_SHARE:
                words = dropout_words(label, flight, name, facts)
                doubts.append((facts.dropped * facts.size * facts.usual, words))
            doubts += [
                (length, f"{label}: {name} {words}") for length, words in _stays(facts.stretches)
            ]
    if not doubts:
        words = "no output stays at one value while others change."
        return [Finding("quality.stuck-output", "ok", words, 0.0, _STUCK_LIMIT)]
    doubts.sort(key=lambda f: -f[0])
    return [
        Finding("quality.stuck-output", "doubt", words, round(length, 6), _STUCK_LIMIT)
        for length, words in doubts[:_MOST_NAMED]
    ]


def _stays(stretches: Sequence[Stuck]) -> list[tuple[float, str]]:
    """What is said of the times at one value, the longest first, with how long it was [s]."""
    while_others = "while other signals change: it is no measurement there"
    lengths = [one.end - one.begin for one in stretches]
    if len(stretches) > _MOST_NAMED or any(length < STUCK_SECONDS for length in lengths):
        words = (
            f"stays at one value {len(stretches)} times, {sum(lengths):.3g} s in all, the longest "
            f"{lengths[0]:.3g} s from {stretches[0].begin:.4g} s on, {while_others}; leave these "
            "parts out, or empty their cells."
        )
        return [(sum(lengths), words)]
    return [
        (
            length,
            f"stays at {one.value:.4g} for {length:.3g} s from {one.begin:.4g} s on, "
            f"{while_others}; leave this part out.",
        )
        for one, length in zip(stretches, lengths, strict=True)
    ]


def dropout_words(label: str, flight: Flight, name: str, facts: SignalFacts) -> str:
    """A sentence on an output's dropouts, of which there are some."""
    assert facts.dropouts is not None
    value = facts.dropouts.value
    signals = flight.source.outputs if flight.source else {}
    logged = float(signals[name].from_si(np.array(value))) if name in signals else value
    words = f"{label}: {name} jumps to {value:.4g} and back, in {100 * facts.dropped:.2g} % of the"
    return (
        f"{words} samples: dropouts that are taken for measurements; state missing: {logged:.6g} "
        "beside its signal, or leave these parts out."
    )


def strays(flights: Sequence[tuple[str, Flight]]) -> list[Finding]:
    """Samples that may stand for no value and are kept, the most first.

    Args:
        flights: by what each is called.
    """
    stray = [
        (odd.times.size, f"{label}: {name} has {stray_words(odd)}: kept, and fitted as measured; ")
        for label, flight in flights
        for (name, _), facts in flight.facts.items()
        for odd in facts.strays
    ]
    if not stray:
        words = "no sample stands far outside of all others."
        return [Finding("quality.stray-samples", "ok", words, 0.0, _STRAY_LIMIT)]
    stray.sort(key=lambda f: -f[0])
    remedy = "empty these cells of the log, or give a window without them."
    return [
        Finding("quality.stray-samples", "doubt", words + remedy, float(count), _STRAY_LIMIT)
        for count, words in stray[:_MOST_NAMED]
    ]


def quantisation(
    flights: Sequence[tuple[str, Flight]], sd: Sequence[Mapping[str, Any]]
) -> list[Finding]:
    """Signals whose steps are coarse beside the noise, the worst first.

    Args:
        flights: by what each is called.
        sd: by flight and output the noise that is assumed, SI.
    """
    doubts, worst = [], 0.0
    for (label, flight), noise in zip(flights, sd, strict=True):
        facts = flight.facts
        for name in flight.outputs:
            logged = facts[name, "output"]
            rounding = _rounding(logged, flight.dt)
            ratio = rounding / float(noise[name])
            worst = max(worst, ratio if logged.levels > 1 else 0.0)
            stated = name in flight.sd
            if sentence := _coarse_output(name, logged, rounding, ratio, stated):
                doubts.append((ratio, f"{label}: {sentence}"))
        doubts += [
            (0.0, f"{label}: {sentence}")
            for name in flight.inputs
            if (sentence := _coarse_input(name, facts[name, "input"]))
        ]
    if not doubts:
        words = "no output is logged in steps that show."
        if worst > 0:
            words = f"steps of the log are fine: rounding is at most {worst:.2g} of the noise."
        return [
            Finding("quality.quantisation", "ok", words, worst, "rounding rms over noise sd, 1")
        ]
    doubts.sort(key=lambda d: -d[0])
    return [
        Finding("quality.quantisation", "doubt", words, ratio, "rounding rms over noise sd, 1")
        for ratio, words in doubts[:_MOST_NAMED]
    ]


def _rounding(facts: SignalFacts, dt: float) -> float:
    """The error of rounding, rms, that is left at a step of `dt` [s].

    Rounding to steps of q adds an error of q / sqrt(12), rms, where the signal moves by more than
    a step from sample to sample or has noise of that size. It is white then, and the low-pass
    filter before a lower rate takes its part of it; where a value stays for several samples, their
    error is one and the same, and nothing is averaged.
    """
    run = facts.usual / facts.moves if facts.moves > 0 else dt
    return facts.step / 12**0.5 * min(1.0, (run / dt) ** 0.5)


def _coarse_output(
    name: str, facts: SignalFacts, rounding: float, ratio: float, stated: bool
) -> str:
    if facts.levels == 1:
        return f"{name} has one value in the whole record: it is no measurement."
    if ratio > 1.0:
        remedy = (
            "the stated sd is too small for it"
            if stated
            else "the noise was guessed from the record, and steps hide it: state the output's sd"
        )
        return (
            f"{name} is logged in steps of {facts.step:.3g}, whose rounding ({rounding:.2g} rms) "
            f"is {ratio:.2g} times the noise that is assumed; {remedy}, at least {rounding:.2g}."
        )
    # Hardly a value twice: there are few values because there are few samples.
    if facts.levels < _COARSE and facts.levels > 0.5 * facts.size:
        return f"the record has only {sample_count(facts.size)} of {name}."
    if facts.levels < _COARSE:
        return f"{name} has only {facts.levels} distinct values: it moves by few steps of the log."
    return ""


def _coarse_input(name: str, facts: SignalFacts) -> str:
    # Steps that are commanded have few values rightly.
    if not (1 < facts.levels < min(_COARSE, 0.5 * facts.size) and facts.moves > _MOVES):
        return ""
    return (
        f"{name} moves at {100 * facts.moves:.0f} % of the samples between only {facts.levels} "
        "distinct values: steps of the log, not of the stick."
    )


# Outputs that have no noise of a sensor, as a finding.


_LIMIT = "white part over the output's sd, 1e-4"


def smoothed(flights: Sequence[tuple[str, Flight]], *, process_noise: bool) -> list[Finding]:
    """One sentence for each flight that has outputs without noise.

    Args:
        flights: by what each is called.
        process_noise: whether the method holds predictions against the noise of the outputs.
    """
    findings = []
    for label, flight in flights:
        without = {n: flight.outputs[n] for n in noiseless(flight.outputs)}
        if not without:
            continue
        part = max(noise_guess(y) / float(np.nanstd(y)) for y in without.values())
        words = f"{label}: {noiseless_words(without, flight.dt)}; nothing faster is in it."
        if process_noise:
            words = f"{words} {REMEDY}"
        findings.append(
            Finding("quality.smoothed", "doubt" if process_noise else "note", words, part, _LIMIT)
        )
    return findings
