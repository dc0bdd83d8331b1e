"""Excitation: the power of a signal that follows others, in bands of a record's lines.

In a narrow band a response is a constant gain. Least squares over the band's lines therefore gives
the power of a signal that follows others. The likelihood ratio is compared with chance (Wilks, for
complex normal errors). The results are

- the part of the outputs that follows the excitation: the logged excitation if inputs are taken by
  instrument, else the inputs;
- the part of a residual in frequency that follows it, which is zero for the right model. The test
  needs no simulation, so it is valid for unstable vehicles. By instrument it is the test of
  overidentification (Sargan, 1958).

Sources: Sargan (1958); Goodman (1963) for complex normal errors; Ljung, System Identification
(1999), 16.6, for residuals against inputs.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import scipy.special
from jaxtyping import Complex, Float

from heli_jax.flights.flight import Flight
from heli_jax.identification.estimation.frequency_instrument import filled, instruments_of
from heli_jax.identification.estimation.frequency_lines import (
    lines_of,
    records_of,
)
from heli_jax.identification.problem import Problem
from heli_jax.identification.unknowns.layout import Solution

LEVEL = 0.01
"""Significance level of all tests of one question together: outputs, inputs, lags and flights."""
_FIRST, _GROWTH = 12, 1.15
"""Lines of the lowest band, and ratio of the widths of one band and the next."""
_SEEN = 0.8
"""Least share of an output's samples that are measured; straight lines bridge gaps."""


class Followed(NamedTuple):
    """Part of a residual that follows the excitation."""

    p_value: float
    """Probability that noise follows as much by chance."""
    explained: float
    """Share that the model explains of the output's power that follows the excitation."""
    by_chance: float
    """Standard deviation of that share."""


def excitation_of(problem: Problem) -> dict[str, float]:
    """Return by output the probability that noise follows the excitation as much by chance.

    Outputs that rest or are mostly missing are left out. The result is empty if no input moves, or
    if the records are short.
    """
    by = instruments_of(problem)
    sums: dict[str, np.ndarray] = {}
    for flight in problem.training:
        X = _drives(flight, by)
        seen = {n: y for n, y in flight.outputs.items() if np.mean(np.isfinite(y)) >= _SEEN}
        measured = {n: filled(y) for n, y in seen.items()}
        measured = {n: y for n, y in measured.items() if np.ptp(y) > 0}
        if X is None or not measured:
            continue
        # A slow mode ends away from its start, and this jump is in all lines of the spectrum.
        # The test is therefore repeated without the straight line between the ends.
        above = [y - np.linspace(y[0], y[-1], y.size) for y in measured.values()]
        for k, v in enumerate((list(measured.values()), above)):
            lines = lines_of(np.stack(v, axis=1))[:, :, None]
            totals = _sums_over_bands(lines, X, np.ones((len(X), 1)))
            for name, statistics in zip(measured, totals, strict=True):
                sums.setdefault(name, np.zeros((2, 2)))[k] += statistics[:2]
    return {
        # Two tests of one record (Bonferroni).
        name: min(1.0, 2.0 * float(np.min(scipy.special.chdtrc(s[:, 1], s[:, 0]))))
        for name, s in sums.items()
        if np.all(s[:, 1] > 0)
    }


def _drives(
    flight: Flight, by: Sequence[str], part: slice = slice(None)
) -> Complex[np.ndarray, "K m"] | None:
    """Return the transform of the excitation in a part of a flight; None if nothing moves.

    The excitation is the logged one for inputs `by` instrument, else the inputs.
    """
    drives = [flight.instruments[n] if n in by else u for n, u in flight.inputs.items()]
    moving = [v[part] for v in drives if np.ptp(v[part]) > 0]
    return lines_of(np.stack(moving, axis=1)) if moving else None


def _band_slices(lines: int, m: int) -> Iterator[slice]:
    """Yield bands of lines, each wide enough for m excitations."""
    first, size = 0, float(max(_FIRST, 4 * m))
    while first + int(size) <= lines:
        yield slice(first, first + int(size))
        first, size = first + int(size), size * _GROWTH


def errors_against_excitation(
    flights: Sequence[Flight],
    at: Solution,
    errors: Sequence[Complex[np.ndarray, "K p"]],
    by: Sequence[str],
) -> dict[str, Followed]:
    """Return by output the part of errors that follows the excitation.

    Outputs with too few lines are left out.

    Args:
        flights: flights of the layout, fitted or held out.
        at: point at which they are evaluated.
    """
    layout, _, noise, _ = at
    sums: dict[str, np.ndarray] = {}
    for record, e, W in zip(records_of(layout), errors, noise.whitening, strict=True):
        flight, part = flights[record.flight], slice(record.first, record.last)
        names = layout.outputs[record.flight]
        X = _drives(flight, by, part)
        if X is None:
            continue
        y = lines_of(np.stack([flight.outputs[n][part] for n in names], axis=1))
        # The test assumes noise of constant power in each band: divide by the noise's spectrum.
        size = np.sqrt(np.sum(np.abs(np.linalg.inv(np.asarray(W))) ** 2, axis=2))
        # The measured output is the scale: the response of a wrong model may be larger.
        totals = _sums_over_bands(np.stack([e, y], axis=2), X, size)
        for name, statistics in zip(names, totals, strict=True):
            sums[name] = sums.get(name, np.zeros(5)) + statistics
    return {
        name: Followed(
            float(scipy.special.chdtrc(freedom, statistic)),
            float(1.0 - left / power) if power > 0 else 1.0,
            float(np.sqrt(variance) / power) if power > 0 else np.inf,
        )
        for name, (statistic, freedom, left, power, variance) in sums.items()
        if freedom > 0
    }


def _sums_over_bands(
    signals: Complex[np.ndarray, "K p c"],
    X: Complex[np.ndarray, "K m"],
    size: Float[np.ndarray, "K s"],
) -> Float[np.ndarray, "p c+3"]:
    """Regress signals on an excitation in each band.

    Return sums over the bands by output, in this order: the likelihood ratio of the first signal
    with and without the excitation; its degrees of freedom; for each signal the power that follows
    the excitation, less the power expected by chance; the variance of that of the first signal.

    Args:
        size: divisors of each output, or (s = 1) of all.
    """
    totals = np.zeros((signals.shape[1], signals.shape[2] + 3))
    for band in _band_slices(*X.shape):
        over, n = 1.0 / size[band].T, band.stop - band.start
        # Each output divides the excitation by its own size.
        Q, R = np.linalg.qr(X[None, band] * over[:, :, None])
        along = np.abs(np.einsum("pii->pi", R))
        kept = along > 1e-9 * np.max(along, axis=1, initial=0.0, keepdims=True)
        Q = np.where(kept[:, None, :], Q, 0.0)
        m = np.broadcast_to(np.sum(kept, axis=1), signals.shape[1:2])
        v = np.swapaxes(signals[band], 0, 1) * over[:, :, None]
        whole = np.sum(np.abs(v) ** 2, axis=1)
        parts = np.sum(np.abs(np.conj(np.swapaxes(Q, 1, 2)) @ v) ** 2, axis=1)
        # The unexplained power per line is the power expected by chance.
        per_line = np.maximum(whole - parts, 0.0) / (n - m)[:, None]
        scale = np.mean(size[band] ** 2, axis=0)
        testable = (m > 0) & (whole[:, 0] > parts[:, 0])
        share = parts[:, 0] / np.where(testable, whole[:, 0], np.inf)
        ratio = -(2.0 * n - m - 1.0) * np.log1p(-share)
        followed = scale[:, None] * (parts - m[:, None] * per_line)
        variance = m * (scale * per_line[:, 0]) ** 2
        each = np.column_stack([ratio, 2.0 * m, followed, variance])
        totals += np.where(testable[:, None], each, 0.0)
    return totals
