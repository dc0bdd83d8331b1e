"""Frequency responses of the baseline and of the record itself, and the coherence of a
record: of each input with the others taken out, and where the model lets expect it.

A record shows coherence between an input and an output only where the one moves the other. Which
do, and in which band, the model says: of an output that an input hardly moves nothing is asked.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg

from heli_jax import naming
from heli_jax.analysis.linear import linearize
from heli_jax.analysis.operating_point import (
    EVERYWHERE,
    OperatingPoint,
    operating_point,
)
from heli_jax.analysis.spectra import (
    Spectra,
    partial_coherence,
    segment_transforms,
    size_of,
    without,
)
from heli_jax.dynamics.model import Model
from heli_jax.identification.equation_error.rls import Baseline
from heli_jax.identification.fit import Fit
from heli_jax.identification.result import Signals
from heli_jax.simulation.simulate import substeps_for

# Parameters of a model are a class of the user's own: they are annotated Any.

SEGMENTS = 8
"""fewer half-overlapping segments than this make no average"""
SHORTEST = 64
"""samples of a segment at least: fewer resolve nothing"""
_BELOW = 1.0 - 1e-9
"""a frequency counts as the lowest itself although rounding has it below"""
SIZEABLE = 0.1
"""part of an output's power that the model puts down to an input, from which on it is asked for"""
_MORE = 2
"""half-overlapping segments more for every further input: each takes a degree of freedom"""
_LONGEST = 4096
"""samples of a segment at most, unless the memory asks for more: further ones average better"""
_MEMORIES = 16
"""in a record at least, so that segments of one are enough for an average"""


class FittedFlight(NamedTuple):
    """A model at one of the flights that it was fitted to."""

    model: Model
    params: Any
    """its parameters, of this flight"""
    fit: Fit
    """what knows the gains and the time shift of the inputs"""
    signals: Signals


def sample_time(signals: Signals) -> float:
    """Time between samples [s]; 1 for a single sample, which has none."""
    return float(signals.times[1] - signals.times[0]) if signals.times.size > 1 else 1.0


def nuisance_factor(fit: Fit, input: str, omega: np.ndarray) -> np.ndarray:
    """The estimated gain and delay of an input as a factor (k,); 1 where neither was estimated."""
    # A shift [s] is common to all inputs, a gain belongs to one.
    gain, shift = fit.nuisance.get(f"gain {input}"), fit.nuisance.get("time_shift")
    factor = np.full(omega.shape, 1.0 if gain is None else gain.value, complex)
    return factor if shift is None else factor * np.exp(-1j * omega * shift.value)


def at_record(flight: FittedFlight) -> OperatingPoint:
    """Return the operating point of a record at which the model is linearised, with the
    estimated gains."""
    signals = flight.signals
    # What acts is gain times what was logged: the mean of the log would be another point.
    estimates = {n: flight.fit.nuisance.get(f"gain {n}") for n in signals.inputs}
    gains = {n: gain.value for n, gain in estimates.items() if gain is not None}
    inputs = {n: gains.get(n, 1.0) * np.asarray(u) for n, u in signals.inputs.items()}
    dt = sample_time(signals)
    return operating_point(
        flight.model,
        flight.params,
        inputs,
        signals.measured,
        dt,
        substeps=substeps_for(dt, flight.model.fastest),
    )


def linear_matrices(model: Model, params: Any, at: OperatingPoint) -> list[np.ndarray]:
    """A, B, C and D of the model linearised about a point."""
    return [np.asarray(M) for M in linearize(model, params, at.state, at.inputs).matrices]


def held(
    matrices: Sequence[np.ndarray], i: int, j: int, dt: float, omega: np.ndarray
) -> np.ndarray:
    """Hd(e^{i omega dt}) (k,) from input j, held over each sample, to output i.

    Args:
        dt: sample time [s].
        omega: (k,) [rad/s]
    """
    A, B, C, D = matrices
    n = A.shape[0]
    # The exponential of [[A, b], [0, 0]] dt is [[Ad, bd], [0, 1]]: no inverse of A, which an
    # integrator does not have (Van Loan 1978).
    both = np.zeros((n + 1, n + 1))
    both[:n, :n], both[:n, n] = A, B[:, j]
    both = scipy.linalg.expm(both * dt) if np.isfinite(both).all() else both * np.nan
    return _transfer(np.exp(1j * omega * dt), both[:n, :n], both[:n, n], C[i], D[i, j])


def _transfer(
    points: np.ndarray, A: np.ndarray, b: np.ndarray, c: np.ndarray, d: float
) -> np.ndarray:
    """c (s I - A)^-1 b + d (k,) at points s (k,); NaN where A is not finite."""
    if not np.isfinite(A).all():
        return np.full(points.shape, np.nan, complex)
    # A system of equations at each frequency: the polynomials of a transfer function lose digits
    # with every further state.
    x = np.linalg.solve(points[:, None, None] * np.eye(len(A)) - A, b[None, :, None])
    return (c @ x)[:, 0] + d


def memory(
    model: Model, params: Any, at: OperatingPoint = EVERYWHERE, duration: float = math.inf
) -> float:
    """Four times the slowest time constant of the linearised model [s], integrators left out.

    About an operating point a mode that is remembered for more than a sixteenth of the record's
    `duration` [s] counts as an integrator as well: the drift of a hovering helicopter has time
    constants of minutes, and within a segment it is a trend, which is taken out.
    """
    A = linear_matrices(model, params, at)[0]
    if not np.isfinite(A).all():
        return 0.0
    size = np.abs(np.linalg.eigvals(A))
    least = 0.0 if at.state is None else _MEMORIES * 4.0 / duration
    # The eigenvalue of an integrator is zero but for rounding, and that against the largest one.
    size = size[(size > 1e-6 * np.max(size, initial=0.0)) & (size >= least)]
    return 4.0 / float(size.min()) if size.size else 0.0


def discrete(baseline: Baseline, omega: np.ndarray) -> np.ndarray:
    """Hd(e^{i omega dt}) (k,) of the recursive least squares, without the hold of its input."""
    # On the unit circle, as it was identified: its continuous form is an approximation where no
    # inverse of the hold exists.
    turns = omega * baseline.dt
    z, hold = np.exp(1j * turns), np.sinc(turns / (2.0 * np.pi)) * np.exp(-0.5j * turns)
    # A pole on the unit circle gives inf there, which no curve draws.
    with np.errstate(all="ignore"):
        return np.polyval(baseline.num, z) / np.polyval(baseline.den, z) / hold


def _needed(dt: float, memory: float) -> int:
    # A power of two, for the Fourier transform.
    return max(SHORTEST, 2 ** int(np.ceil(np.log2(max(memory / dt, 1.0)))))


class Segments(NamedTuple):
    """Half-overlapping segments of a record."""

    length: int
    """samples of each"""
    count: int
    lowest: float
    """rad/s from which on their averages hold; 0 where a segment holds the whole memory"""


def segments_of(samples: int, dt: float, memory: float, least: int = SEGMENTS) -> Segments | str:
    """The segments of a record, or why it is too short for any.

    As long as the memory where the record has enough of such; eight or more fit in the record
    otherwise. Where a slow mode is remembered for longer, the longest of which there are enough:
    they hold from two periods in a segment on (Tischler and Remple, 2012), since what is left of
    the slow mode within one is smooth, and is all but gone at that frequency.

    Args:
        dt: between two of them [s].
        memory: how long the vehicle remembers its input [s].
    """
    most = min(2 ** int(np.log2(max(samples / SEGMENTS, 1.0))), _LONGEST)
    length, lowest = max(_needed(dt, memory), most), 0.0
    if _count(samples, length) < least:
        # Half-overlapping segments take half of (their number + 1) lengths; an even length.
        length = samples // (least + 1) * 2
        lowest = 4.0 * np.pi / (length * dt) if length else 0.0
    if length < SHORTEST:
        return (
            f"expected {least} half-overlapping segments of {SHORTEST * dt:.3g} s, a record of "
            f"{SHORTEST * dt * (least + 1) / 2:.3g} s; got {samples * dt:.3g} s"
        )
    return Segments(length, _count(samples, length), lowest)


def _count(samples: int, length: int) -> int:
    return 1 + (samples - length) // (length // 2)


def phase(H: np.ndarray) -> np.ndarray:
    """Unwrapped phase (k,) [deg], begun between -270 and 90."""
    unwrapped = np.degrees(np.unwrap(np.angle(H)))
    first = unwrapped[0] if unwrapped.size else 0.0
    # Less 1e-6, so that rounding does not send a response that begins at +90 down to -270.
    return unwrapped - 360.0 * np.ceil((first - 90.0 - 1e-6) / 360.0)


class Coherence(NamedTuple):
    """One input and one output of a record."""

    value: float
    """mean of the partial coherence, weighted by the response that the model expects"""
    expected: float
    """the same of the simulated output"""
    share: float
    """of the simulated output's power, what the linearised model puts down to this input alone"""
    segments: int
    others: int
    """further inputs that move, whose part was taken out"""
    lowest: float = 0.0
    """rad/s from which on it is said where a mode is too slow for the segments, else 0"""

    @property
    def asked(self) -> bool:
        """True if the model predicts a coherent response of the output to this input."""
        return self.share >= SIZEABLE


def coherences(
    model: Model, params: Any, at: OperatingPoint, signals: Signals, fit: Fit
) -> dict[tuple[str, str], Coherence | str]:
    """By input and output of a flight: the partial coherence, or why there is none."""
    dt = sample_time(signals)
    memory_s = memory(model, params, at, dt * signals.times.size)
    # One that stands still explains nothing, and its rounding would count as an input to take out.
    moving = [n for n, u in signals.inputs.items() if np.ptp(u) > 0]
    results: dict[tuple[str, str], Coherence | str] = {
        (u, y): "the input does not move"
        for u in signals.inputs
        for y in signals.measured
        if u not in moving
    }
    # Linearised once for all pairs of input and output: it traces the whole model.
    matrices = linear_matrices(model, params, at)
    for y in signals.measured:
        record = _spectra(signals, moving, y, dt, memory_s)
        if isinstance(record, str):
            results |= {(u, y): record for u in moving}
            continue
        spectra, lowest = record
        i = naming.names(model.Outputs).index(y)
        for u in moving:
            j = naming.names(model.Inputs).index(u)
            H = held(matrices, i, j, dt, spectra.omega)
            # What the model expects of the input as it was logged.
            H = H * nuisance_factor(fit, u, spectra.omega)
            results[u, y] = _coherence(spectra, lowest, moving.index(u), H)
    return results


def _spectra(
    signals: Signals, moving: list[str], output: str, dt: float, memory: float
) -> tuple[Spectra, float] | str:
    """Moving inputs, output and simulation at inner frequencies, and the lowest one, see
    `Segments`."""
    y, model = signals.measured[output], signals.simulated[output]
    if np.isnan(y).any():
        return "samples are missing"
    if not np.isfinite(model).all():
        return "the simulation diverges"
    least = SEGMENTS + _MORE * (len(moving) - 1)
    segments = segments_of(y.size, dt, memory, least)
    if isinstance(segments, str):
        return segments
    channels = np.stack([*(signals.inputs[n] for n in moving), y, model])
    spectra = segment_transforms(channels, dt, segments.length)
    # Without the mean, which was taken out, and Nyquist's frequency; two periods in a segment are
    # the second frequency above zero.
    inner = slice(2 if segments.lowest else 1, -1)
    return spectra._replace(omega=spectra.omega[inner], X=spectra.X[inner]), segments.lowest


def _coherence(spectra: Spectra, lowest: float, j: int, H: np.ndarray) -> Coherence:
    """Return the coherence of input j, whose expected response is H (k,)."""
    inputs, measured, simulated = spectra.X[..., :-2], spectra.X[..., -2], spectra.X[..., -1]
    others = np.delete(inputs, j, axis=2)
    alone = without(others, inputs[:, :, j])
    power = np.sum(np.abs(alone) ** 2, axis=1)
    # The power that the output owes to this input: where the model expects no response, noise may
    # have its way, and a plain mean over frequencies would be that of the noise.
    # Infinite where a pole lies on the unit circle at one of the frequencies: that one is left out.
    weights = np.nan_to_num(np.abs(H) ** 2 * power, posinf=0.0)
    # Over its own size: the squares of a simulation that diverged would be no numbers.
    size = size_of(simulated)
    total = float(np.sum(np.abs(simulated / size) ** 2))
    # By Parseval the sums over frequencies are powers, with the same factor above and below.
    share = float(np.sum(weights)) / size / size / total if total > 0 else 0.0
    # The simulated output has neither noise nor disturbance: its coherence is what could be seen.
    value, expected = (
        _mean(partial_coherence(others, inputs[:, :, j], y), weights) for y in (measured, simulated)
    )
    _, segments, others_count = others.shape
    return Coherence(value, expected, share, segments, others_count, lowest)


def _mean(coherence: np.ndarray, weights: np.ndarray) -> float:
    seen = np.isfinite(coherence) & (weights > 0)
    return float(np.average(coherence[seen], weights=weights[seen])) if seen.any() else 0.0
