"""Signals that were cut off at the ends of their range, or logged in steps too coarse."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from heli_jax.flights.flight import Flight
from heli_jax.identification.validation.finding import Finding

_FEW = 8
"""distinct values of a signal below which its extremes are no rails: steps between a few levels"""
_PILE = 5.0
"""times as many samples at an extreme as at the values beside it, for a rail. A sine logged in
steps has 3 times as many at its turning points as at the three values before"""
_RUN = 3
"""samples in a row at a rail, once at least"""
_VISITS = 2
"""times at least that a signal comes to a rail"""
_SHARE = 0.005
"""part of the samples at a rail from which on it is spoken of"""
_RAIL_LIMIT = f"share of the samples at a rail, {_SHARE}"
_COARSE = 16
"""distinct values of a moving signal below which it is called coarse"""
_MOVES = 0.2
"""part of the samples at which an input moves, from which on it is no sequence of steps"""
_LATTICE = 1e-3
"""of a step, by which differences of values may miss a multiple of it: units are converted"""
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
    return Rails(at_low.sum() / seen, at_high.sum() / seen)


def at_rails(x: Float[np.ndarray, " N"]) -> tuple[Bool[np.ndarray, " N"], Bool[np.ndarray, " N"]]:
    """The samples at the lower and at the upper rail; all False where there is none."""
    finite = x[np.isfinite(x)]
    levels, counts = np.unique(finite, return_counts=True)
    none = np.zeros(x.shape, bool)
    if levels.size < _FEW:
        return none, none
    low = x == levels[0] if _is_rail(finite, levels[0], counts) else none
    high = x == levels[-1] if _is_rail(finite, levels[-1], counts[::-1]) else none
    return low, high


def _is_rail(x: np.ndarray, rail: float, counts: np.ndarray) -> bool:
    """Whether samples pile up at an extreme; `counts` by distinct value, the extreme first."""
    at = x == rail
    if at[0] and at[-1]:
        return False
    edges = np.diff(np.concatenate([[0], at.astype(int), [0]]))
    begins, ends = np.flatnonzero(edges == 1), np.flatnonzero(edges == -1)
    # Beside the values next to it also those of all the signal: random steps are held unequally.
    usual = max(float(counts[1:4].mean()), float(np.median(counts[1:])))
    piled = counts[0] > _PILE * usual and counts[0] >= _SHARE * x.size
    return bool(piled and begins.size >= _VISITS and (ends - begins).max() >= _RUN)


def quantum(x: Float[np.ndarray, " N"]) -> float:
    """The step of which all differences of a signal's values are multiples; 0 if there is none."""
    levels = np.unique(x[np.isfinite(x)])
    if levels.size < 2:
        return 0.0
    steps = np.diff(levels)
    # Smaller differences are rounding of one value.
    steps = steps[steps > 1e-9 * (levels[-1] - levels[0])]
    step = float(steps.min())
    multiples = steps / step
    whole = np.abs(multiples - np.round(multiples)) <= _LATTICE * multiples
    return step if bool(np.all(whole)) else 0.0


def saturation(flights: Sequence[tuple[str, Flight]]) -> list[Finding]:
    """Signals that rest at an end of their range, the worst first.

    Args:
        flights: by what each is called.
    """
    found = []
    for label, flight in flights:
        for kind in ("input", "output"):
            for name, x in (flight.inputs if kind == "input" else flight.outputs).items():
                shares = rails(x)
                if max(shares) > 0:
                    found.append((sum(shares), label, kind, name, x, shares))
    if not found:
        words = "no signal piles up at an end of its range."
        return [
            Finding("saturation", "ok", words, 0.0, f"share of the samples at a rail, {_SHARE}")
        ]
    found.sort(key=lambda f: -f[0])
    return [_saturated(*f) for f in found[:_MOST_NAMED]]


def _saturated(
    total: float, label: str, kind: str, name: str, x: np.ndarray, shares: Rails
) -> Finding:
    ends = [
        f"at its {word} value {float(end(x)):.4g} in {100 * share:.2g} % of the samples"
        for word, end, share in (
            ("smallest", np.nanmin, shares.low),
            ("largest", np.nanmax, shares.high),
        )
        if share
    ]
    does = "what it measured beyond is not in the log, and the model is fitted to the flat tops"
    if kind == "input":
        does = "if the log shows the command and not what acted, the model is driven by too much"
    if kind == "input" and len(ends) < 2:
        does = "if it was cut off there after it was logged, or the stick went on, inputs are wrong"
    text = f"{label}: {name} is {' and '.join(ends)}: {does}; leave these parts out."
    return Finding("saturation", "doubt", text, round(total, 6), _RAIL_LIMIT)


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
        for name, y in flight.outputs.items():
            # Rounding to steps of q adds an error of q / sqrt(12), rms, where the signal moves by
            # more than a step from sample to sample or has noise of that size.
            step = quantum(y)
            ratio = step / 12**0.5 / float(noise[name])
            worst = max(worst, ratio if np.unique(y[np.isfinite(y)]).size > 1 else 0.0)
            stated = name in flight.sd
            if sentence := _coarse_output(name, y, step, ratio, stated):
                doubts.append((ratio, f"{label}: {sentence}"))
        doubts += [(0.0, f"{label}: {s}") for s in _coarse_inputs(flight)]
    if not doubts:
        words = "no output is logged in steps that show."
        if worst > 0:
            words = f"steps of the log are fine: rounding is at most {worst:.2g} of the noise."
        return [Finding("quantisation", "ok", words, worst, "rounding rms over noise sd, 1")]
    doubts.sort(key=lambda d: -d[0])
    return [
        Finding("quantisation", "doubt", words, ratio, "rounding rms over noise sd, 1")
        for ratio, words in doubts[:_MOST_NAMED]
    ]


def _coarse_output(name: str, y: np.ndarray, step: float, ratio: float, stated: bool) -> str:
    levels = np.unique(y[np.isfinite(y)]).size
    if levels == 1:
        return f"{name} has one value in the whole record: it is no measurement."
    if ratio > 1.0:
        remedy = (
            "the stated sd is too small for it"
            if stated
            else "the noise was guessed from the record, and steps hide it: state the output's sd"
        )
        return (
            f"{name} is logged in steps of {step:.3g}, whose rounding ({step / 12**0.5:.2g} rms) "
            f"is {ratio:.2g} times the noise that is assumed; {remedy}, at least "
            f"{step / 12**0.5:.2g}."
        )
    samples = int(np.isfinite(y).sum())
    # Hardly a value twice: there are few values because there are few samples.
    if levels < _COARSE and levels > 0.5 * samples:
        return f"the record has only {samples} samples of {name}."
    if levels < _COARSE:
        return f"{name} has only {levels} distinct values: it moves by few steps of the log."
    return ""


def _coarse_inputs(flight: Flight) -> list[str]:
    sentences = []
    for name, u in flight.inputs.items():
        levels = np.unique(u).size
        # Steps that are commanded have few values rightly.
        if 1 < levels < min(_COARSE, 0.5 * u.size) and np.mean(np.diff(u) != 0) > _MOVES:
            sentences.append(
                f"{name} moves at {100 * np.mean(np.diff(u) != 0):.0f} % of the samples between "
                f"only {levels} distinct values: steps of the log, not of the stick."
            )
    return sentences
