"""Coherence of a record, of each input with the others taken out, and where to expect it.

A record shows coherence between an input and an output only where the one moves the other. Which
do, and in which band, the model says: of an output that an input hardly moves nothing is asked.
"""

from typing import Any, NamedTuple

import numpy as np
import scipy.linalg

from heli_jax import naming
from heli_jax.analysis.linear import linearize
from heli_jax.analysis.operating_point import OperatingPoint
from heli_jax.analysis.spectral import partial_coherence, segment_transforms, size_of, without
from heli_jax.dynamics.model import Model
from heli_jax.identification.fit import Fit
from heli_jax.identification.result import Signals
from heli_jax.report import frequency

SIZEABLE = 0.1
"""part of an output's power that the model puts down to an input, from which on it is asked for"""
_MORE = 2
"""half-overlapping segments more for every further input: each takes a degree of freedom"""


# Parameters of a model are a class of the user's own: they are annotated Any.


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
        """Whether the model lets expect that the output follows this input coherently."""
        return self.share >= SIZEABLE


def coherences(
    model: Model, params: Any, at: OperatingPoint, signals: Signals, fit: Fit
) -> dict[tuple[str, str], Coherence | str]:
    """By input and output of a flight: the partial coherence, or why there is none.

    Args:
        model: what was fitted.
        params: its parameters, of this flight.
        at: where it is linearised.
        signals: the flight, measured and simulated.
        fit: what knows the gains of the inputs.
    """
    dt = float(signals.times[1] - signals.times[0])
    memory = frequency.memory(model, params, at, dt * signals.times.size)
    # One that stands still explains nothing, and its rounding would count as an input to take out.
    moving = [n for n, u in signals.inputs.items() if np.std(u) > 0]
    results: dict[tuple[str, str], Coherence | str] = {
        (u, y): "the input does not move"
        for u in signals.inputs
        for y in signals.measured
        if u not in moving
    }
    # Linearised once for all pairs of input and output: it traces the whole model.
    matrices = [np.asarray(M) for M in linearize(model, params, at.state, at.inputs).matrices]
    for y in signals.measured:
        record = _spectra(signals, moving, y, dt, memory)
        if isinstance(record, str):
            results |= {(u, y): record for u in moving}
            continue
        i = naming.names(model.Outputs).index(y)
        for u in moving:
            j = naming.names(model.Inputs).index(u)
            H = _sampled(matrices, i, j, dt, record.omega)
            # What the model expects of the input as it was logged.
            H = H * frequency.nuisance_factor(fit, u, record.omega)
            results[u, y] = _coherence(record, moving.index(u), H)
    return results


class _Spectra(NamedTuple):
    """Fourier transforms of the half-overlapping segments of a record."""

    omega: np.ndarray
    """(k,) [rad/s], above zero and below the Nyquist frequency"""
    lowest: float
    """rad/s, see `frequency.Segments`"""
    inputs: np.ndarray
    """(k, segments, inputs)"""
    measured: np.ndarray
    """(k, segments)"""
    simulated: np.ndarray
    """(k, segments)"""


def _spectra(
    signals: Signals, moving: list[str], output: str, dt: float, memory: float
) -> _Spectra | str:
    y, model = signals.measured[output], signals.simulated[output]
    if np.isnan(y).any():
        return "samples are missing"
    if not np.isfinite(model).all():
        return "the simulation diverges"
    least = frequency.SEGMENTS + _MORE * (len(moving) - 1)
    segments = frequency.segments_of(y.size, dt, memory, least)
    if isinstance(segments, str):
        return segments
    channels = np.stack([*(signals.inputs[n] for n in moving), y, model])
    omega, transforms = segment_transforms(channels, dt, segments.length)
    # Without the mean, which was taken out, and Nyquist's frequency; two periods in a segment are
    # the second frequency above zero.
    first = 2 if segments.lowest else 1
    omega, transforms = omega[first:-1], transforms[first:-1]
    inputs, measured, simulated = transforms[..., :-2], transforms[..., -2], transforms[..., -1]
    return _Spectra(omega, segments.lowest, inputs, measured, simulated)


def _coherence(record: _Spectra, j: int, H: np.ndarray) -> Coherence:
    """Of input j, whose expected response is H (k,)."""
    others = np.delete(record.inputs, j, axis=2)
    alone = without(others, record.inputs[:, :, j])
    power = np.sum(np.abs(alone) ** 2, axis=1)
    # The power that the output owes to this input: where the model expects no response, noise may
    # have its way, and a plain mean over frequencies would be that of the noise.
    # Infinite where a pole lies on the unit circle at one of the frequencies: that one is left out.
    weights = np.nan_to_num(np.abs(H) ** 2 * power, posinf=0.0)
    # Over its own size: the squares of a simulation that diverged would be no numbers.
    size = size_of(record.simulated)
    total = float(np.sum(np.abs(record.simulated / size) ** 2))
    # By Parseval the sums over frequencies are powers, with the same factor above and below.
    share = float(np.sum(weights)) / size / size / total if total > 0 else 0.0
    # The simulated output has neither noise nor disturbance: its coherence is what could be seen.
    value, expected = (
        _mean(partial_coherence(others, record.inputs[:, :, j], y), weights)
        for y in (record.measured, record.simulated)
    )
    _, segments, others_count = others.shape
    return Coherence(value, expected, share, segments, others_count, record.lowest)


def _mean(coherence: np.ndarray, weights: np.ndarray) -> float:
    seen = np.isfinite(coherence) & (weights > 0)
    return float(np.average(coherence[seen], weights=weights[seen])) if seen.any() else 0.0


def _sampled(
    matrices: list[np.ndarray], i: int, j: int, dt: float, omega: np.ndarray
) -> np.ndarray:
    """Hd(e^{i omega dt}) (k,) from input j, held over each sample, to output i; zero where the
    linearised model is not finite."""
    A, B, C, D = matrices
    n = A.shape[0]
    # exp [[A, b], [0, 0]] dt = [[Ad, bd], [0, 1]] (Van Loan 1978): A may have integrators.
    both = np.zeros((n + 1, n + 1))
    both[:n, :n], both[:n, n] = A, B[:, j]
    if not (np.isfinite(both).all() and np.isfinite(C[i]).all()):
        return np.zeros(omega.shape, complex)
    held = scipy.linalg.expm(both * dt)
    z = np.exp(1j * omega * dt)[:, None, None]
    x = np.linalg.solve(z * np.eye(n) - held[:n, :n], held[None, :n, n:])
    return (C[i] @ x)[:, 0] + D[i, j]
