"""Whether signals have the signs and units that they are said to have.

Two tests that need no fit. An angle is the integral of its rate, so the two have to move alike by
as much. And with start values of the right signs the simulated outputs move with the measured ones.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from heli_jax.dynamics.model import Model, axes_of
from heli_jax.finding import Finding
from heli_jax.flights.flight import Flight
from heli_jax.identification.problem import Problem
from heli_jax.identification.unknowns.initial_guess import labels
from heli_jax.identification.validation.metrics import autocorrelation, cross_correlation

_PAIRS = (("p", "phi"), ("q", "theta"), ("r", "psi"), ("r", "yaw"), ("p", "roll"), ("q", "pitch"))
"""rate and angle by the names that outputs have here, beside those of the model's axes"""
WITHIN = 0.5
"""[s] over which an angle and the integral of its rate are compared"""
PARTS = 10
"""so many of these parts of a record at least"""
_ALIKE = 0.8
"""correlation of the two from which on their sizes are compared"""
_FACTOR = 1.3
"""by which these may differ: coupled rotation and sensors that are off by a fifth"""
_SCALE = 1.12
"""by which they may differ for certain, by the interval of their factor: a sensor off by a tenth,
and of pitch and heading the cosine of the bank"""
_ROLL, _ROLL_SCALE = frozenset({"phi", "roll"}), 1.04
"""the same of the bank, whose rate is p but for what the tangent of the pitch angle lets in: that
goes with another motion, and changes no factor by more than a hundredth or two"""
_QUANTILE = 2.26
"""of Student's t with as many degrees of freedom as parts but one, for 95 %"""
_GAP = 0.3
"""[s] without a sample, over which nothing is put between"""
_DEGREE = 180.0 / np.pi
_NEARLY = 1.3
"""factor about 57.3 that is still degrees taken for radians"""

RATE_SCALE = "units.rate-scale"
AGAINST_START, RATE_AGAINST_ANGLE = "signs.against-start", "signs.rate-against-angle"
AGAINST = -0.3
"""correlation below which a simulated output moves against the measured one"""
_SURE = 3.0
"""times what chance makes of it"""
_LAG = 0.25
"""[s] to either side: later, a swing of the right sign looks like one of the wrong sign"""
_LARGER = 1.3
"""by how much the correlation of the wrong sign exceeds any of the right one"""
_MORE = 1.3
"""times as far an output is simulated to move in a flight that says more of it"""


def rate_against_angle(problem: Problem) -> list[Finding]:
    """A doubt for each angle that does not move as the integral of its rate does.

    Args:
        problem: the flights that are fitted, and the model, whose axes name rates and angles.
    """
    pairs = rates_and_angles(problem.model)
    flights = problem.training
    findings = []
    for label, flight in zip(labels(flights), flights, strict=True):
        for rate, angle in pairs:
            if rate in flight.outputs and angle in flight.outputs:
                findings += _of_pair(label, flight, rate, angle)
    return findings


def rates_and_angles(model: Model) -> list[tuple[str, str]]:
    """The outputs that are a rate and its angle, by the model's axes and by the names that they
    have here."""
    axes = [(a.rate, a.angle) for a in axes_of(model) if a.angle is not None]
    return list(dict.fromkeys([*axes, *_PAIRS]))


def _of_pair(label: str, flight: Flight, rate: str, angle: str) -> list[Finding]:
    ratio = angle_over_rate(flight.outputs[angle], flight.outputs[rate], flight.dt)
    if ratio is None:
        return []
    smallest, largest = ratio
    size = float(np.sign(smallest) * np.sqrt(smallest * largest))
    backward, off = size < 0, abs(smallest) > _FACTOR or abs(largest) < 1.0 / _FACTOR
    if not (backward or off):
        return _of_scale(label, flight, rate, angle, ratio)
    distance = f"{abs(size):.3g} times as far as" if off else "as far as"
    alike = np.sign(smallest) * np.sqrt(smallest / largest)
    against = f", and against it (correlation {alike:+.2f})" if backward else ""
    reasons = ["one of the two has the wrong sign (invert)"] if backward else []
    if off and 1.0 / _NEARLY < max(abs(size), 1.0 / abs(size)) / _DEGREE < _NEARLY:
        reasons.append("one of the two is in degrees and read as radians, or the reverse (unit)")
    elif off:
        reasons.append("the unit or the scale of one of the two is wrong")
    words = (
        f"{label}: {angle} moves {distance} the integral of {rate}{against}: "
        f"{' and '.join(reasons)}."
    )
    criterion = f"change of the angle over that of the integrated rate, 1 within {_FACTOR:g}"
    # No model follows an angle that runs against its rate, or is in other units.
    degrees = 1.0 / _NEARLY < max(abs(size), 1.0 / abs(size)) / _DEGREE < _NEARLY
    brief = (
        f"{angle} runs against the integral of {rate}"
        if backward
        else f"{angle} moves {abs(size):.3g} times as far as the integral of {rate}"
    )
    code, denies = RATE_AGAINST_ANGLE, backward or degrees
    return [
        Finding(code, "doubt", words, size, criterion, (rate, angle), brief=brief, denies=denies)
    ]


def _of_scale(
    label: str, flight: Flight, rate: str, angle: str, ratio: tuple[float, float]
) -> list[Finding]:
    """A doubt where a rate is too large or too small for its angle by more than chance, the noise
    of either and a sensor's usual error explain."""
    smallest, largest = ratio
    changes = _changes(flight.outputs[angle], flight.outputs[rate], flight.dt)
    if changes is None:
        return []
    sd = _log_sd(*changes)
    low = float(np.exp(-_QUANTILE * sd)) / largest
    high = float(np.exp(_QUANTILE * sd)) / smallest
    most = _ROLL_SCALE if angle in _ROLL else _SCALE
    if low <= most and high >= 1.0 / most:
        return []
    size = 1.0 / float(np.sqrt(smallest * largest))
    words = (
        f"{label}: {rate} is {size:.3g} times the rate of {angle} (95 % {low:.3g} to {high:.3g}): "
        "the scale or the unit of one of the two is off, and a fit puts it into the machine."
    )
    criterion = f"the integrated rate's change over that of the angle, 1 within {most:g}"
    brief = f"{rate} is {size:.3g} times the rate of {angle}"
    return [Finding(RATE_SCALE, "doubt", words, size, criterion, (rate, angle), brief=brief)]


def _log_sd(first: np.ndarray, second: np.ndarray) -> float:
    """Standard deviation of the logarithm of the ratio of two records' sizes (N,), by leaving out
    one part after the other (the jackknife)."""
    squares = [[float(part @ part) for part in np.array_split(x, PARTS)] for x in (first, second)]
    left = [sum(of) - np.asarray(of) for of in squares]
    return jackknife_sd(0.5 * np.log(left[0] / left[1]))


def jackknife_sd(each: Sequence[float] | np.ndarray) -> float:
    """Standard deviation of what all parts of a record give together, by what is given without one
    part after the other.

    Args:
        each: without the first of the `PARTS` parts, without the second, and so on.
    """
    return float(np.sqrt((PARTS - 1) * np.var(each)))


def angle_over_rate(
    angle: Float[np.ndarray, " N"], rate: Float[np.ndarray, " N"], dt: float
) -> tuple[float, float] | None:
    """Between which factors an angle's changes are those of its integrated rate, whatever the noise
    of either; both negative where they go against one another, None where nothing can be told.

    Regressions of the one on the other and of the other on the one enclose the factor where both
    are noisy (Frisch, 1934).

    Args:
        angle: [rad], NaN where missing.
        rate: [rad/s], likewise.
        dt: [s].
    """
    changes = _changes(angle, rate, dt)
    if changes is None:
        return None
    sds = [float(np.std(v)) for v in changes]
    if not min(sds) > 0:
        return None
    alike = float(np.corrcoef(changes[0], changes[1])[0, 1])
    if abs(alike) < _ALIKE:
        return None
    size = float(np.sign(alike)) * sds[0] / sds[1]
    return size * abs(alike), size / abs(alike)


def _changes(
    angle: Float[np.ndarray, " N"], rate: Float[np.ndarray, " N"], dt: float
) -> tuple[np.ndarray, np.ndarray] | None:
    """By how much an angle and the integral of its rate change over `WITHIN`, without their means;
    None where nothing can be told."""
    both = angle_and_integral(angle, rate, dt)
    if both is None:
        return None
    first, second = (changes_within(v, dt) for v in both)
    return first, second


def changes_within(signal: Float[np.ndarray, " N"], dt: float) -> np.ndarray:
    """By how much a signal changes over `WITHIN`, without the mean.

    Args:
        signal: without a missing sample.
        dt: [s].
    """
    steps = max(1, round(WITHIN / dt))
    # Changes over half a second: a bias of the rate is in their mean alone, and noise of the angle
    # is not divided by a sample time.
    changes = signal[steps:] - signal[:-steps]
    return changes - changes.mean()


def integral(rate: Float[np.ndarray, " N"], dt: float) -> Float[np.ndarray, " N"]:
    """Of a signal with straight lines between its samples, from zero.

    Args:
        rate: without a missing sample.
        dt: [s].
    """
    return np.concatenate([np.zeros(1), np.cumsum(0.5 * dt * (rate[1:] + rate[:-1]))])


def angle_and_integral(
    angle: Float[np.ndarray, " N"], rate: Float[np.ndarray, " N"], dt: float
) -> tuple[np.ndarray, np.ndarray] | None:
    """An angle without turns and the integral of its rate (N,), with straight lines over short
    gaps; None where a gap is long or the record too short to compare the two.

    Args:
        angle: [rad], NaN where missing.
        rate: [rad/s], likewise.
        dt: [s].
    """
    whole = [filled(v, dt) for v in (angle, rate)]
    steps = max(1, round(WITHIN / dt))
    if whole[0] is None or whole[1] is None or angle.size < (PARTS + 1) * steps:
        return None
    # Headings jump by a turn where they pass south.
    turned = np.unwrap(whole[0])
    return turned, integral(whole[1], dt)


def filled(signal: np.ndarray, dt: float) -> np.ndarray | None:
    """A signal with straight lines over its short gaps; None where one is long.

    Args:
        signal: (N,), NaN where missing.
        dt: [s].
    """
    if np.count_nonzero(np.isfinite(signal)) < 2:
        return None
    values, known = over_gaps(signal, dt)
    return values if known.all() else None


def over_gaps(signal: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """A signal with straight lines over its gaps, and which samples (N,) are in no long one.

    Args:
        signal: (N,), NaN where missing, two samples or more known.
        dt: [s].
    """
    seen = np.flatnonzero(np.isfinite(signal))
    rows = np.arange(signal.size)
    ends = np.r_[0, seen, signal.size - 1]
    after = np.searchsorted(ends, rows, side="left")
    # Of the samples before and behind a row, or of the ends of the record.
    gap = ends[np.minimum(after, ends.size - 1)] - ends[np.maximum(after - 1, 0)]
    known = np.isfinite(signal) | (gap * dt <= _GAP)
    return np.interp(rows, seen, signal[seen]), known


def against_start(
    flights: Sequence[tuple[str, Flight]],
    simulated: Sequence[Mapping[str, np.ndarray]],
    sticks: Mapping[str, str] | None = None,
) -> list[Finding]:
    """A doubt for outputs that move against those simulated at the start values: for all that a
    stick moves together, or for one of them that others do not go with.

    A stick that only holds an output against gusts moves against it by feedback alone. So what
    another flight shows, in which it moves the output further and the right way, goes before it.

    Args:
        flights: by what each is called.
        simulated: by flight and output (N,), SI.
        sticks: by output the input that moves it, of `sticks_of`; without it any of them may.
    """
    findings = []
    by_flight = [_signs(f, run) for (_, f), run in zip(flights, simulated, strict=True)]
    for (label, flight), of_flight in zip(flights, by_flight, strict=True):
        counting = {n: s for n, s in of_flight.items() if _counts(n, s, by_flight)}
        signs = {n: s.correlation for n, s in counting.items()}
        groups: dict[str, dict[str, float]] = {}
        for name, c in signs.items():
            stick = (sticks or {}).get(name, " or ".join(flight.inputs))
            groups.setdefault(stick, {})[name] = c
        for stick, group in groups.items():
            findings += _of_stick(label, stick, group)
    return findings


def sticks_of(model: Model) -> dict[str, str]:
    """By output, named as its axis names it or as outputs are here, the input that turns the model
    about that axis."""
    sticks = {}
    for axis in axes_of(model):
        if axis.stick is not None:
            names = {axis.rate, axis.angle, *(a for r, a in _PAIRS if r == axis.rate)}
            sticks |= {name: axis.stick for name in names if name is not None}
    return sticks


class _Sign(NamedTuple):
    """How an output goes with the simulated one in a flight, where that is sure."""

    correlation: float
    size: float
    """standard deviation of the simulated one, SI"""


def _signs(flight: Flight, run: Mapping[str, np.ndarray]) -> dict[str, _Sign]:
    """By output of a flight, those that are sure."""
    return {
        name: _Sign(c, float(np.std(run[name])))
        for name, measured in flight.outputs.items()
        if (c := _surely(measured, run[name], flight.dt)) is not None
    }


def _counts(name: str, sign: _Sign, by_flight: Sequence[Mapping[str, _Sign]]) -> bool:
    """Whether no flight that says more of an output says that its sign is right."""
    others = (signs[name] for signs in by_flight if name in signs)
    return sign.correlation > 0 or not any(
        o.correlation > 0 and o.size > _MORE * sign.size for o in others
    )


def _of_stick(label: str, stick: str, signs: Mapping[str, float]) -> list[Finding]:
    """Of the outputs that one input moves, by the correlation of each with what is simulated."""
    turned = {n: c for n, c in signs.items() if c < 0}
    criterion = f"largest correlation of both, {AGAINST:g}"
    if turned and len(turned) == len(signs):
        names, size = " and ".join(turned), min(turned.values())
        whose = stick if len(turned) > 1 else f"{names} or {stick}"
        moves = "move against the measured ones"
        moves = moves if len(turned) > 1 else "moves against the measured one"
        words = (
            f"{label}: at the start values the simulated {names} {moves} (correlation "
            f"{', '.join(f'{c:+.2f}' for c in turned.values())}): {whose} has the wrong sign "
            f"(invert: true) or is another column, or the effect of {stick} has the wrong sign at "
            f"the start values. {_or_held(names)}"
        )
        return [Finding(AGAINST_START, "doubt", words, size, criterion, (*turned, stick))]
    others = [n for n in signs if n not in turned]
    return [
        Finding(
            AGAINST_START,
            "doubt",
            f"{label}: at the start values the simulated {name} moves against the measured one "
            f"(correlation {c:+.2f}), though {' and '.join(others)} "
            f"{'do' if len(others) > 1 else 'does'} not: {name} has the wrong sign "
            f"(invert: true) or is another column. {_or_held(name)}",
            c,
            criterion,
            (name,),
        )
        for name, c in turned.items()
    ]


def _or_held(outputs: str) -> str:
    return (
        f"An input that is not swept in this flight and holds {outputs} against gusts makes that "
        "by itself: then nothing is wrong."
    )


def _surely(measured: np.ndarray, simulated: np.ndarray, dt: float) -> float | None:
    """The correlation of the wrong sign, or else of the right one, where it is sure."""
    seen = np.isfinite(measured)
    if not np.max(np.abs(simulated)) < 1e100 or np.std(simulated) == 0 or seen.mean() < 0.5:
        return None
    lags = max(1, min(round(_LAG / dt), measured.size // 4))
    # Missing samples add nothing to the products and all of the simulation to their scale.
    c = cross_correlation(simulated, measured, lags) / np.sqrt(seen.mean())
    worst, best = float(np.min(c)), float(np.max(c))
    # Of two independent signals, by their autocorrelations (Bartlett, 1935).
    most = max(1, measured.size // 5)
    window = 1.0 - np.arange(most + 1) / (most + 1)
    both = window * autocorrelation(measured, most) * autocorrelation(simulated, most)
    chance = float(np.sqrt(max(both[0] + 2.0 * both[1:].sum(), 1e-12) / seen.sum()))
    least = max(-AGAINST, _SURE * chance)
    if -worst > least and -worst > _LARGER * best:
        return worst
    return best if best > least and best > -worst else None
