"""The noise's spectrum before any model: what the inputs leave of the outputs, line by line.

Source: Brillinger, Time Series (1981), chapter 8, for regression of spectra; Pintelon and Schoukens
(2012), chapter 7, for the ends of a record as a smooth function of the frequency beside them.
"""

import jax
import numpy as np

from heli_jax.identification.estimation.frequency_records import lines_of, records_of
from heli_jax.identification.estimation.frequency_spectrum import (
    AVERAGES,
    averages,
    smoothed,
    whitening_of,
)
from heli_jax.identification.unknowns.layout import Data, Layout

_ALONE = 1e-9
"""of the inputs' power, below which two of them move as one, and of the outputs', below which
nothing is left"""


def whitening_without_model(layout: Layout, data: Data) -> tuple[np.ndarray, ...] | None:
    """By record what makes white (K, p, p) that which no response to the inputs explains.

    None where there are too few lines to tell. In a closed loop it is too small where feedback
    moves the inputs more than the excitation does.

    Args:
        layout: what the unknowns are.
        data: the numbers of the problem.
    """
    flights = jax.device_get(data.flights)
    lines = []
    for record in records_of(layout):
        flight = flights[record.flight]
        outputs = [flight.outputs[n] for n in layout.outputs[record.flight]]
        signals = np.stack([*outputs, *flight.inputs], axis=1)[record.first : record.last]
        lines.append(lines_of(signals))
    p = len(layout.outputs[0])
    powers = np.sum([np.sum(np.abs(v) ** 2, axis=0) for v in lines], axis=0)
    moving = p + np.flatnonzero(powers[p:] > 0)
    # A response changes over the lines that a spectrum is smoothed over, a mode's by much.
    order = next((q for q in (2, 1) if (q + 1) * (moving.size + 1) <= 0.5 * AVERAGES), 0)
    # What the ends of a record add is smooth over the lines around: a constant beside the inputs.
    size = np.sqrt(np.mean(powers[:p]) / sum(len(v) for v in lines))
    lines = [np.column_stack([v[:, :p], *_powers(v[:, moving], size, order)]) for v in lines]
    counts = tuple(sorted({len(v): sum(len(w) == len(v) for w in lines) for v in lines}.items()))
    spectra = smoothed(lines)
    left = {}
    for S in spectra:
        if id(S) in left:
            continue
        n, regressors = averages(len(S), counts), S.shape[1] - p
        if np.min(n) <= regressors + p:
            return None
        left[id(S)] = _left(S, p) * (n / (n - regressors))[:, None, None]
    return whitening_of(left[id(S)] for S in spectra)


def _powers(inputs: np.ndarray, size: float, order: int) -> list[np.ndarray]:
    """Inputs (K, m) and a constant, times powers of the frequency up to an order: locally a
    response that is a polynomial of it."""
    beside = np.column_stack([inputs, np.full(len(inputs), size)])
    f = np.arange(1, len(inputs) + 1)[:, None] / len(inputs)
    return [beside * f**q for q in range(order + 1)]


def _left(S: np.ndarray, p: int) -> np.ndarray:
    """Spectra (K, p, p) of the first p signals without what the others explain."""
    size = np.sqrt(np.real(np.einsum("kii->ki", S)))
    R = S / (size[:, :, None] * size[:, None, :])
    others = R[:, p:, p:] + _ALONE * np.eye(S.shape[1] - p)
    rest = R[:, :p, :p] - R[:, :p, p:] @ np.linalg.solve(others, R[:, p:, :p])
    rest = 0.5 * (rest + np.conj(np.swapaxes(rest, 1, 2))) + _ALONE * np.eye(p)
    return rest * size[:, :p, None] * size[:, None, :p]
