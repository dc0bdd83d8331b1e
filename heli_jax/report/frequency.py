"""Frequency responses of a fit, of its baseline and of the record itself, on one phase branch."""

import math
from collections.abc import Callable
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
from heli_jax.analysis.spectral import OWN, leakage, spectra
from heli_jax.dynamics.model import Model
from heli_jax.identification.equation_error.baseline import Baseline
from heli_jax.identification.fit import Fit
from heli_jax.identification.result import Signals
from heli_jax.simulation.simulate import substeps_for

type Response = Callable[[np.ndarray], np.ndarray]

# Parameters of a model are a class of the user's own: they are annotated Any.

SEGMENTS = 8
"""fewer half-overlapping segments than this make no average"""
SHORTEST = 64
"""samples of a segment at least: fewer resolve nothing"""
_BELOW = 1.0 - 1e-9
"""a frequency counts as the lowest itself although rounding has it below"""
_LONGEST = 4096
"""samples of a segment at most, unless the memory asks for more: further ones average better"""
_MEMORIES = 16
"""in a record at least, so that segments of one are enough for an average"""


class Empirical(NamedTuple):
    """Output over input as the record shows it; arrays (k,)."""

    omega: np.ndarray
    """rad/s"""
    H: np.ndarray
    coherence: np.ndarray
    power: np.ndarray
    """spectral density of the input"""
    segments: int
    lowest: float = 0.0
    """rad/s that omega begins at where a mode is too slow for the segments, else 0"""


class FittedFlight(NamedTuple):
    """A model at one of the flights that it was fitted to."""

    model: Model
    params: Any
    """its parameters, of this flight"""
    fit: Fit
    """what knows the gains and the time shift of the inputs"""
    signals: Signals


def log_grid(low: float, high: float, n: int = 900) -> np.ndarray:
    """Frequencies (n,) [rad/s], equally spaced in the logarithm.

    Args:
        low: the first one [rad/s].
        high: the last one [rad/s].
        n: how many.
    """
    return np.geomspace(low, high, n)


def nuisance_factor(fit: Fit, input: str, omega: np.ndarray) -> np.ndarray:
    """The estimated gain and delay of an input as a factor (k,); 1 where neither was estimated.

    Args:
        fit: what may have estimated them.
        input: the input's name.
        omega: (k,) [rad/s]
    """
    # A shift [s] is common to all inputs, a gain belongs to one.
    gain, shift = fit.nuisance.get(f"gain {input}"), fit.nuisance.get("time_shift")
    factor = np.full(omega.shape, 1.0 if gain is None else gain.value, complex)
    return factor if shift is None else factor * np.exp(-1j * omega * shift.value)


def at_record(flight: FittedFlight) -> OperatingPoint:
    """Where the model is linearised for a record, with the gains that were estimated."""
    signals = flight.signals
    # What acts is gain times what was logged: the mean of the log would be another point.
    estimates = {n: flight.fit.nuisance.get(f"gain {n}") for n in signals.inputs}
    gains = {n: gain.value for n, gain in estimates.items() if gain is not None}
    inputs = {n: gains.get(n, 1.0) * np.asarray(u) for n, u in signals.inputs.items()}
    dt = float(signals.times[1] - signals.times[0]) if signals.times.size > 1 else 1.0
    return operating_point(
        flight.model,
        flight.params,
        inputs,
        signals.measured,
        dt,
        substeps=substeps_for(dt, flight.model.fastest),
    )


def responses(
    model: Model,
    params: Any,
    output: str,
    input: str,
    dt: float,
    at: OperatingPoint = EVERYWHERE,
) -> tuple[Response, Response]:
    """H(i omega) and Hd(e^{i omega dt}) of the model linearised about a point, as functions.

    The second holds the input over each sample: this, and not the first, is what a sampled record
    can show.

    Args:
        model: what is linearised.
        params: its parameters.
        output: the output's name.
        input: the input's name.
        dt: sample time [s].
        at: about which point.
    """
    # One linearisation serves both, and NumPy evaluates them: a figure is no reason to compile.
    A, B, C, D = (np.asarray(M) for M in linearize(model, params, at.state, at.inputs).matrices)
    i = naming.names(model.Outputs).index(output)
    j = naming.names(model.Inputs).index(input)
    n = A.shape[0]
    # The exponential of [[A, b], [0, 0]] dt is [[Ad, bd], [0, 1]]: no inverse of A, which an
    # integrator does not have (Van Loan 1978).
    both = np.zeros((n + 1, n + 1))
    both[:n, :n], both[:n, n] = A, B[:, j]
    held = scipy.linalg.expm(both * dt) if np.isfinite(both).all() else both * np.nan

    def response(points: np.ndarray, A: np.ndarray, b: np.ndarray) -> np.ndarray:
        """The transfer function at some points, in s or in z.

        Args:
            points: s or z (k,), complex.
            A: (n, n), continuous or discrete.
            b: (n,), of the same kind.
        """
        return _transfer(points, A, b, C[i], D[i, j])

    delay = dict(model.delays).get(input)
    late = 0.0 if delay is None else float(np.asarray(getattr(params, delay)))

    def turned(omega: np.ndarray, points: np.ndarray, A: np.ndarray, b: np.ndarray) -> np.ndarray:
        """The same with the phase that the input's delay takes.

        Args:
            omega: (k,) [rad/s].
            points: s or z (k,) at these.
            A: (n, n), continuous or discrete.
            b: (n,), of the same kind.
        """
        return response(points, A, b) * np.exp(-1j * omega * late)

    return (
        lambda omega: turned(omega, 1j * omega, A, B[:, j]),
        lambda omega: turned(omega, np.exp(1j * omega * dt), held[:n, :n], held[:n, n]),
    )


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

    Args:
        model: what is linearised.
        params: its parameters.
        at: about which point.
        duration: of the record [s].
    """
    A = np.asarray(linearize(model, params, at.state, at.inputs).matrices.A)
    if not np.isfinite(A).all():
        return 0.0
    size = np.abs(np.linalg.eigvals(A))
    least = 0.0 if at.state is None else _MEMORIES * 4.0 / duration
    # The eigenvalue of an integrator is zero but for rounding, and that against the largest one.
    size = size[(size > 1e-6 * np.max(size, initial=0.0)) & (size >= least)]
    return 4.0 / float(size.min()) if size.size else 0.0


def discrete(baseline: Baseline, omega: np.ndarray) -> np.ndarray:
    """Hd(e^{i omega dt}) (k,) of the recursive least squares."""
    # On the unit circle, as it was identified: its continuous form is an approximation where no
    # inverse of the hold exists.
    z = np.exp(1j * omega * baseline.dt)
    # A pole on the unit circle gives inf there, which no curve draws.
    with np.errstate(all="ignore"):
        return np.polyval(baseline.num, z) / np.polyval(baseline.den, z)


def _needed(dt: float, memory: float) -> int:
    # A power of two, for the Fourier transform.
    return max(SHORTEST, 2 ** int(np.ceil(np.log2(max(memory / dt, 1.0)))))


class Segments(NamedTuple):
    """How a record is cut into half-overlapping segments."""

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
        samples: of the record.
        dt: between two of them [s].
        memory: how long the machine remembers its input [s].
        least: segments that make an average.
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


def empirical(u: np.ndarray, y: np.ndarray, dt: float, memory: float) -> Empirical | str:
    """Welch's cross-spectrum over the input's spectrum, or why the record does not allow it.

    Args:
        u: the input (N,).
        y: the output (N,).
        dt: sample time [s].
        memory: how long the machine remembers its input [s].
    """
    if not np.std(u) > 0:
        return "the input does not move"
    if np.isnan(y).any():
        return "samples are missing"
    # A segment shorter than the memory answers to what the stick did before it began: the average
    # is then biased at its lowest frequencies, however many segments there are.
    segments = segments_of(u.size, dt, memory)
    if isinstance(segments, str):
        return segments
    omega, Suu, Syy, Suy = spectra(u, y, dt, segments.length)
    # Where a signal has no power of its own the quotient is that of two window's sidelobes, which
    # are coherent as well; and of zero frequency the segments' straight lines left nothing.
    own = (Suu > OWN * leakage(Suu)) & (Syy > OWN * leakage(Syy))
    useful = (omega > 0) & (omega >= _BELOW * segments.lowest) & own & (Suu > 0) & (Syy > 0)
    omega, Suu, Syy, Suy = omega[useful], Suu[useful], Syy[useful], Suy[useful]
    coherence = np.abs(Suy) ** 2 / (Suu * Syy)
    return Empirical(omega, Suy / Suu, coherence, Suu, segments.count, segments.lowest)


def phase(H: np.ndarray) -> np.ndarray:
    """Unwrapped phase (k,) [deg], begun between -270 and 90."""
    unwrapped = np.degrees(np.unwrap(np.angle(H)))
    first = unwrapped[0] if unwrapped.size else 0.0
    # Less 1e-6, so that rounding does not send a response that begins at +90 down to -270.
    return unwrapped - 360.0 * np.ceil((first - 90.0 - 1e-6) / 360.0)
