r"""Whether a model in frequency is adequate: does the excitation still explain its residual?

The residual of the right model knows nothing of what excites the machine: of the logged excitation
where inputs are taken by it, else of the inputs. In bands of a record's own lines the power that
follows the excitation is compared with what chance makes of it (Wilks, for complex normal errors).
Nothing is simulated, so that the verdict holds for unstable machines, and gusts raise the noise and
not the test. By instrument it is the test of overidentification (Sargan, 1958): more frequencies
than parameters have to agree.

Sources: Sargan (1958); Goodman (1963) for complex normal errors; Ljung, System Identification
(1999), 16.6, for residuals against inputs.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import numpy as np
import scipy.special
from jaxtyping import Complex, Float

from heli_jax.flights.flight import Flight
from heli_jax.identification.estimation.frequency_instrument import instruments_of
from heli_jax.identification.estimation.frequency_lines import (
    errors_of_lines,
    lines_of,
    records_of,
)
from heli_jax.identification.problem import Problem
from heli_jax.identification.unknowns.layout import Solution

LEVEL = 0.01
"""of the test of all outputs together"""
_FIRST, _GROWTH = 12, 1.15
"""lines of the lowest band, and how much wider the next one is"""


class Followed(NamedTuple):
    """What of an output's residual follows the excitation."""

    p_value: float
    explained: float
    """part of the output's power that follows the excitation which the model explains"""
    by_chance: float = 0.0
    """standard deviation of that part"""


def outputs_against_excitation(problem: Problem) -> dict[str, float]:
    """By output the probability that noise alone follows the excitation as much; outputs with gaps
    and of too few lines are left out.
    """
    by = instruments_of(problem)
    sums: dict[str, np.ndarray] = {}
    for flight in problem.training:
        drives = [flight.instruments[n] if n in by else u for n, u in flight.inputs.items()]
        drives = [v for v in drives if np.ptp(v) > 0]
        names = [n for n, y in flight.outputs.items() if np.isfinite(y).all() and np.ptp(y) > 0]
        if not drives or not names:
            continue
        X, measured = lines_of(np.stack(drives, 1)), [flight.outputs[n] for n in names]
        # What ends elsewhere than it began, as a slow mode does, has its leap at all lines: what is
        # left above a straight line between its ends is asked, too.
        above = [y - np.linspace(y[0], y[-1], y.size) for y in measured]
        both = [lines_of(np.stack(v, axis=1)) for v in (measured, above)]
        found = [_in_bands(y, y, np.ones((len(y), 1)), X) for y in both]
        for name, *statistics in zip(names, *found, strict=True):
            sums[name] = sums.get(name, np.zeros((2, 5))) + np.stack(statistics)
    return {
        # Of two questions about one record.
        name: min(1.0, 2.0 * float(np.min(scipy.special.chdtrc(s[:, 1], s[:, 0]))))
        for name, s in sums.items()
        if np.all(s[:, 1] > 0)
    }


def residual_against_excitation(problem: Problem, at: Solution) -> dict[str, Followed]:
    """By output what of its residual follows the excitation; outputs of too few lines are left out.

    Args:
        at: where a fit by frequency error ended.
    """
    errors = jax.device_get(errors_of_lines(*at).errors)
    by = instruments_of(problem) if at.data.flights[0].by_instrument is not None else ()
    return errors_against_excitation(problem.training, at, errors, by)


def errors_against_excitation(
    flights: Sequence[Flight],
    at: Solution,
    errors: Sequence[Complex[np.ndarray, "K p"]],
    by: Sequence[str],
) -> dict[str, Followed]:
    """By output what of errors follows the excitation; outputs of too few lines are left out.

    Args:
        flights: those of the layout, fitted or held out.
        at: where they are evaluated.
    """
    layout, _, noise, _ = at
    sums: dict[str, np.ndarray] = {}
    sizes: dict[int, np.ndarray] = {}
    for record, e, W in zip(records_of(layout), errors, noise.whitening, strict=True):
        flight, part = flights[record.flight], slice(record.first, record.last)
        names = layout.outputs[record.flight]
        drives = [flight.instruments[n] if n in by else u for n, u in flight.inputs.items()]
        drives = [v[part] for v in drives if np.ptp(v[part]) > 0]
        if not drives:
            continue
        X = lines_of(np.stack(drives, axis=1))
        y = lines_of(np.stack([flight.outputs[n][part] for n in names], axis=1))
        # Records of one length share their whitening.
        if id(W) not in sizes:
            root = np.linalg.inv(np.asarray(W))
            # Of one size over each band, as chance is taken to be: by the noise's own spectrum.
            sizes[id(W)] = np.sqrt(np.sum(np.abs(root) ** 2, axis=2))
        size = sizes[id(W)]
        for name, statistics in zip(names, _in_bands(e, y, size, X), strict=True):
            sums[name] = sums.get(name, np.zeros(5)) + statistics
    return {
        name: Followed(
            float(scipy.special.chdtrc(freedom, statistic)),
            float(1.0 - left / answer) if answer > 0 else 1.0,
            float(np.sqrt(variance) / answer) if answer > 0 else np.inf,
        )
        for name, (statistic, freedom, left, answer, variance) in sums.items()
        if freedom > 0
    }


def _in_bands(
    e: Complex[np.ndarray, "K p"],
    y: Complex[np.ndarray, "K p"],
    size: Float[np.ndarray, "K s"],
    X: Complex[np.ndarray, "K m"],
) -> Float[np.ndarray, "p 5"]:
    """By output the test's statistic and degrees of freedom, the powers that follow the excitation
    of the residual and of what was measured, less what chance makes, and the variance of the first
    by chance; of one size each, or (s = 1) all of the same."""
    first, lines = 0, float(max(_FIRST, 4 * X.shape[1]))
    total = np.zeros((e.shape[1], 5))
    while first + int(lines) <= len(e):
        band = slice(first, first + int(lines))
        n, first, lines = int(lines), band.stop, lines * _GROWTH
        over = 1.0 / size[band].T
        # All outputs side by side: each has excitations of its own size.
        Q, R = np.linalg.qr(X[None, band] * over[:, :, None])
        along = np.abs(np.einsum("pii->pi", R))
        kept = along > 1e-9 * np.max(along, axis=1, initial=0.0, keepdims=True)
        Q = np.where(kept[:, None, :], Q, 0.0)
        m = np.broadcast_to(np.sum(kept, axis=1), (e.shape[1],))
        both = np.stack([e[band].T * over, y[band].T * over], axis=2)
        whole = np.sum(np.abs(both) ** 2, axis=1)
        parts = np.sum(np.abs(np.conj(np.swapaxes(Q, 1, 2)) @ both) ** 2, axis=1)
        power, followed = whole[:, 0], parts[:, 0]
        asked = (m > 0) & (power > followed)
        share = followed / np.where(asked, power, np.inf)
        statistic = -(2.0 * n - m - 1.0) * np.log1p(-share)
        # Not the model's response: a wrong model's may be larger than anything that was measured.
        scale = np.mean(size[band] ** 2, axis=0)[:, None]
        per_line = np.maximum(whole - parts, 0.0) / (n - m)[:, None]
        chance = m[:, None] * per_line
        variance = m * (scale[:, 0] * per_line[:, 0]) ** 2
        statistics = np.column_stack([statistic, 2.0 * m, scale * (parts - chance), variance])
        total += np.where(asked[:, None], statistics, 0.0)
    return total
