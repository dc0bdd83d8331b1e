"""Feedback: test whether inputs follow the response, through a pilot or a controller.

Innovations are the residuals of a multivariable ARX model of the record itself, so that a poor
model of the vehicle raises no alarm. Under feedback an input depends on past innovations; without
it, it does not (L. Ljung, System Identification, 2nd ed. 1999, 13.4 and 16.5). The part of each
input that its own past does not predict is correlated with sums of past innovations. The variance
of such a correlation is Bartlett's: the sum over all lags of the product of both autocorrelations
(L. D. Haugh, J. Am. Stat. Assoc. 71, 1976).

An output responds to the motion of a stick within the same sample, and the stick then moves on
from there. That is no feedback. Two tests exclude it:

- The innovations are also freed of the inputs up to their sample, in parts of a sample. This test
  misses only feedback within a sample.
- The input is freed of its own past in parts of a sample. This test sees feedback within a sample.

An input that is logged late follows the response too, and no correlation separates the two. With an
estimated negative delay the input is shifted earlier; otherwise the report names a late log as the
alternative.
"""

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import scipy.fft
import scipy.linalg
import scipy.special
from jaxtyping import Float

from heli_jax.dynamics.kinematics import is_kinematic
from heli_jax.flights.flight import Flight, labels
from heli_jax.identification.problem import Problem
from heli_jax.identification.validation.excitation import LEVEL

_NOTHING = 1e-7
"""Size of a sum over that for unrelated terms, below which it is rounding."""


def lag_blocks(longest: int) -> list[tuple[int, int]]:
    """Return groups of lags [samples] that grow with the lag.

    Feedback acts over many lags: their sum shows it where no single lag does.
    """
    blocks, first = [], 1
    while first <= longest:
        last = max(first, int(first * 1.5))
        blocks.append((first, min(last, longest)))
        first = last + 1
    return blocks


class Correlated(NamedTuple):
    """Results by column and block of lags."""

    p_value: Float[np.ndarray, "p b"]
    correlation: Float[np.ndarray, "p b"]


def correlations_with_sums(
    u: Float[np.ndarray, " N"], e: Float[np.ndarray, "N p"], blocks: Sequence[tuple[int, int]]
) -> Correlated:
    """Correlate u with the sums of each column of e over each block of lags.

    Both are NaN where missing, e in whole rows.
    """
    seen = np.isfinite(u) & np.isfinite(e).all(axis=1)
    u, e = np.where(seen, u, 0.0), np.where(seen[:, None], e, 0.0)
    n, N, (power, powers) = int(seen.sum()), u.size, (float(u @ u), np.sum(e**2, axis=0))
    correlated = Correlated(*np.zeros((2, e.shape[1], len(blocks))))
    correlated.p_value[:] = 1.0
    if not power > 0:
        return correlated
    of_u = _products_over_lags(u[:, None])[:, 0] / power
    sums = np.concatenate([np.zeros((1, e.shape[1])), np.cumsum(e, axis=0)])
    for b, (first, last) in enumerate(blocks):
        past = np.zeros_like(e)
        past[last:] = sums[last - first + 1 : N - first + 1] - sums[: N - last]
        own = _products_over_lags(past)
        size = np.sqrt(power * np.maximum(own[0], 0.0))
        moves = size > _NOTHING * np.sqrt(power * powers * (last - first + 1))
        correlation = u @ past * np.where(moves, 1.0 / np.where(moves, size, 1.0), 0.0)
        # Bartlett: autocorrelations beyond a few blocks are noise and would spoil the variance.
        lags = min(4 * (last - first + 1) + 20, N - 1)
        variance = 1.0 + 2.0 * (of_u[1 : lags + 1] @ own[1 : lags + 1]) / np.where(
            moves, own[0], 1.0
        )
        sd = np.sqrt(np.maximum(variance, 0.1) / n)
        p_value = 2.0 * scipy.special.ndtr(-np.abs(correlation) / sd)
        correlated.p_value[:, b] = np.where(moves, p_value, 1.0)
        correlated.correlation[:, b] = correlation
    return correlated


def _products_over_lags(x: Float[np.ndarray, "N p"]) -> Float[np.ndarray, "N p"]:
    """Return the products of each column with itself, by lag."""
    size = scipy.fft.next_fast_len(2 * len(x), real=True)
    return np.fft.irfft(np.abs(np.fft.rfft(x, size, axis=0)) ** 2, size, axis=0)[: len(x)]


# Residuals of ARX models. BIC selects the order; rows with a missing sample are left out.


_ORDERS = (2, 4, 8, 16)
"""Candidate orders of the ARX models."""
_PER_UNKNOWN = 8
"""Fewest samples per coefficient of a model."""
_RIDGE = 1e-12
"""Addition to the mean squares of past samples, which are about one."""


def arx_residuals(
    y: Float[np.ndarray, "N p"], past: Float[np.ndarray, "N z"]
) -> Float[np.ndarray, "N p"] | None:
    """Return the residuals of an ARX model of y by a constant and earlier samples of `past`.

    NaN where a sample is missing; None if the record is too short.
    """
    longest, (N, z) = _ORDERS[-1], past.shape
    scale = np.nanstd(past, axis=0)
    past = (past - np.nanmean(past, axis=0)) / np.where(scale > 0, scale, 1.0)
    x = np.ones((N - longest, longest * z + 1))
    for k in range(longest):
        x[:, 1 + k * z : 1 + (k + 1) * z] = past[longest - k - 1 : N - k - 1]
    # The columns of a lower order come first.
    sizes, counted = [n * z + 1 for n in _ORDERS], np.isfinite(y[longest:]).all(axis=1)
    seen = [counted & np.isfinite(x[:, :k]).all(axis=1) for k in sizes]
    sizes = [k for k, r in zip(sizes, seen, strict=True) if r.sum() >= _PER_UNKNOWN * k]
    if not sizes:
        return None
    rows = seen[len(sizes) - 1]
    x, at = x[rows, : sizes[-1]], y[longest:][rows]
    at = at - np.mean(at, axis=0)
    m, p = at.shape
    # One factor serves all orders. A factor of the samples would take twenty times as long as one
    # of the products. The ridge is as large as the products' rounding.
    factor = np.linalg.cholesky(x.T @ x + _RIDGE * m * np.eye(sizes[-1]))
    along = scipy.linalg.solve_triangular(factor, x.T @ at, lower=True)
    unexplained = np.sum(at**2, axis=0) - np.cumsum(along**2, axis=0)
    # Rounding may make the power negative if the past predicts the signal exactly.
    criteria = [
        m * np.sum(np.log(np.maximum(unexplained[k - 1], 0.0) / m + 1e-300)) + p * k * np.log(m)
        for k in sizes
    ]
    k = sizes[int(np.argmin(criteria))]
    coefficients = scipy.linalg.solve_triangular(factor[:k, :k], along[:k], lower=True, trans=1)
    left = np.full(y.shape, np.nan)
    left[longest:][rows] = at - x[:, :k] @ coefficients
    return left


RATE = 50.0
"""Highest rate of the test [Hz]; feedback to a vehicle is slower than a quarter of it."""
_SLOW_RATE = 10.0
"""Rate at which slow feedback, such as a pilot's, shows through a sensor's noise [Hz]."""
_PARTS = 5
"""Largest number of parts into which an input is split within a sample of a lower rate."""
_LONGEST = 2.0
"""Longest lag of the test [s]."""
_MOST = 20_000
"""Largest number of samples that are used."""
_LEAST = 100
"""Shortest record that is tested [samples]."""
_JUMP, _ROUNDS = 5.0, 3
"""Smallest jump of an input over the median of its ARX residual, and rounds of removing jumps."""
_MOVES = 0.05
"""Least share of the samples at which an input moves, for feedback to be possible."""
_LONG_REST, _AT_REST = 20, 0.5
"""Shortest rest of an input [samples], and largest share of rests of an input that moves freely."""
_STILL = 1e-4
"""Share of an input's range below which a difference is no motion."""
_SEEN = 0.8
"""Least share of an output's samples that are measured."""


class Feedback(NamedTuple):
    """Result for one input of one flight. The names of the fields are keys of fit.json."""

    flight: str
    input: str
    output: str
    """Output whose past innovations the input follows most significantly."""
    correlation: float
    """Correlation of the unpredicted part of the input with these innovations."""
    lag: tuple[float, float]
    """Shortest and longest lag of these innovations [s]."""
    p_value: float
    """Probability of chance, for all tested inputs, outputs and lags of the record."""
    earlier: float = 0.0
    """Shift of the input to earlier times by its estimated delay [s]."""
    delay_known: bool = False
    """True if the input's delay was estimated; otherwise the input may also be logged late."""

    @property
    def present(self) -> bool:
        """True if the input follows the response."""
        return self.p_value < LEVEL


def feedback(
    flight: Flight, together: int = 1, earlier: Mapping[str, float] | None = None
) -> tuple[Feedback, ...]:
    """Return for each freely moving input the past innovations that it follows most significantly.

    The result is empty if the record is too short.

    Args:
        together: number of flights that are tested together, for the p-values.
        earlier: shift of each input to earlier times [s]; zero by default.
    """
    # A record cannot show a delay beyond half of its length.
    most, dt = flight.n_samples // 2, flight.dt
    steps = {n: min(math.ceil(s / dt - 1e-9), most) for n, s in (earlier or {}).items()}
    by_rate = [views for rate in _rates_of(flight) if (views := _views(flight, steps, rate))]
    found: dict[str, Feedback] = {}
    for views in by_rate:
        N = len(views[0].innovations)
        blocks = lag_blocks(max(1, min(round(_LONGEST / views[0].dt), N // 10)))
        seconds = [(first * views[0].dt, last * views[0].dt) for first, last in blocks]
        for view in views:
            # Bonferroni: one test in a hundred records fails by chance, not one in a hundred lags.
            count = len(views) * view.inputs * len(view.outputs) * len(blocks)
            for name, free in view.free.items():
                each = correlations_with_sums(free, view.innovations, blocks)
                for k, b in np.ndindex(each.p_value.shape):
                    one = Feedback(
                        flight.name or "flight 1",
                        name,
                        view.outputs[k],
                        float(each.correlation[k, b]),
                        seconds[b],
                        min(1.0, together * len(by_rate) * count * float(each.p_value[k, b])),
                        steps.get(name, 0) * dt,
                    )
                    # Several p-values may underflow to zero: then the correlation decides.
                    found[name] = min(
                        found.get(name, one), one, key=lambda f: (f.p_value, f.correlation)
                    )
    return tuple(found.values())


def _rates_of(flight: Flight) -> tuple[float, ...]:
    """Return the sampling rates at which a flight is tested [Hz]."""
    # Use no more than the inputs' rate and half of the log's. The log does not show how a stick
    # moved within a sample, so the response to this motion would count as an innovation.
    frames = [0.5]
    for u in flight.inputs.values():
        at = np.flatnonzero(np.diff(u) != 0.0)
        frames += [1.0 / float(np.median(np.diff(at)))] if at.size > 1 else []
    fast = float(np.clip(min(frames) / flight.dt, _SLOW_RATE, RATE))
    return (fast, _SLOW_RATE) if fast > _SLOW_RATE else (fast,)


class _View(NamedTuple):
    """Unpredicted parts of a flight's inputs and outputs at one rate."""

    free: dict[str, np.ndarray]
    """Part (N,) of each input that its own past does not predict."""
    innovations: Float[np.ndarray, "N p"]
    outputs: tuple[str, ...]
    inputs: int
    """Number of inputs that move."""
    dt: float


def _views(flight: Flight, steps: Mapping[str, int], rate: float) -> list[_View]:
    """Return the signals of both tests; arguments as in `_decimated`.

    The list is empty if no output moves and is measured, the record is too short, or no input moves
    freely.
    """
    inputs, outputs, parts, dt = _decimated(flight, steps, rate)
    if not outputs or next(iter(outputs.values())).size < _LEAST:
        return []
    # A lower rate turns steps into slopes: the highest rate shows whether an input moves freely.
    quick, *_ = _decimated(flight, steps, RATE)
    moving = [n for n in inputs if _moves_freely(quick.get(n, inputs[n]))]
    free = {n: v for n in moving if (v := _unforeseen(inputs[n], inputs[n][:, None])) is not None}
    if not free:
        return []
    finer = {n: v for n in free if (v := _unforeseen(inputs[n], parts[n])) is not None}
    y = np.stack(list(outputs.values()), axis=1)
    u = np.stack(list(inputs.values()), axis=1)
    # All signals together predict the outputs: otherwise the response to an input would look like
    # feedback. A sample's own inputs join the outputs before it.
    now = np.concatenate(list(parts.values()), axis=1)
    now = np.concatenate([now[1:], now[-1:]])
    given = arx_residuals(y, np.concatenate([y, now], axis=1))
    past = arx_residuals(y, np.concatenate([y, u], axis=1))
    names = tuple(outputs)
    pairs = ((free, given), (finer, past))
    return [_View(v, e, names, len(inputs), dt) for v, e in pairs if e is not None and v]


def _unforeseen(
    u: Float[np.ndarray, " N"], own: Float[np.ndarray, "N m"]
) -> Float[np.ndarray, " N"] | None:
    """Return the residual (N,) of an input after its own past (N, m), without jumps.

    None if nothing is left. A pilot's test steps are larger than the corrections of a gust and
    would hide them. The input alone selects the jumps, so that the test stays valid.
    """
    left = arx_residuals(u[:, None], own)
    for _ in range(_ROUNDS):
        if left is None:
            return None
        size = float(np.nanmedian(np.abs(left)))
        calm = np.abs(left[:, 0]) <= _JUMP * size
        # An input that mostly rests has only jumps.
        if size <= 1e-9 * np.std(u):
            break
        left = arx_residuals(np.where(calm, u, np.nan)[:, None], own)
    if left is None or not np.nanstd(left) > 1e-9 * np.std(u):
        return None
    return left[:, 0]


def _moves_freely(u: Float[np.ndarray, " N"]) -> bool:
    """True if an input has motion that could follow something."""
    # A programmed input with long rests follows nothing, whether its steps are sharp or rounded.
    # Its ARX residual at the corners rings on into the rest, as the response does.
    # A filtered command comes to rest slowly, so small differences count as rest.
    ends = np.flatnonzero(np.abs(np.diff(u)) > _STILL * np.ptp(u))
    runs = np.diff(np.concatenate([[-1], ends, [u.size - 1]]))
    rests = float(np.sum(runs[runs >= _LONG_REST])) / u.size
    return bool(np.mean(np.diff(u) != 0.0) >= _MOVES) and rests <= _AT_REST


def _decimated(
    flight: Flight, earlier: Mapping[str, int], rate: float
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray], dict[str, np.ndarray], float]:
    """Average a flight down to a lower rate.

    Return the moving inputs (N,), the outputs (N,) that are mostly measured, the inputs' means over
    parts of a sample (N, m), and the sample time [s].

    Args:
        earlier: shift of an input to earlier times [samples].
        rate: highest sampling rate [Hz].
    """
    every = max(1, int(np.ceil(1.0 / (flight.dt * rate) - 1e-9)))
    edges = np.rint(np.linspace(0, every, min(every, _PARTS) + 1)).astype(np.int64)

    def thinned(x: np.ndarray) -> np.ndarray:
        # Means of blocks avoid aliases of motion that is faster than the lower rate.
        return x.reshape(-1, every).mean(axis=1)  # NaN if a sample is missing

    def within(x: np.ndarray) -> np.ndarray:
        return np.add.reduceat(x.reshape(-1, every), edges[:-1], axis=1) / np.diff(edges)

    # A shifted input is unknown after the end of its log: all signals end there.
    cut = max(earlier.values(), default=0)

    def taken(x: np.ndarray, first: int) -> np.ndarray:
        # A part of a very long record suffices, and its regressors fit into memory.
        part = x[first : x.size - cut + first]
        return part[: min(part.size // every, _MOST) * every]

    inputs = {n: taken(u, earlier.get(n, 0)) for n, u in flight.inputs.items()}
    inputs = {n: u for n, u in inputs.items() if u.size and np.ptp(u) > 0}
    outputs = {n: thinned(taken(y, 0)) for n, y in flight.outputs.items()}
    outputs = {
        n: y
        for n, y in outputs.items()
        if y.size and np.mean(np.isfinite(y)) >= _SEEN and np.nanstd(y) > 0
    }
    parts = {n: within(u) for n, u in inputs.items()}
    return {n: thinned(u) for n, u in inputs.items()}, outputs, parts, flight.dt * every


# Feedback in the flights of a problem.


def feedback_of(
    problem: Problem, delays: Mapping[str, tuple[float, float | None]] | None = None
) -> tuple[Feedback, ...]:
    """Test all fitted flights for feedback; the result is empty for kinematic models.

    The inputs of a kinematic model are sensors, which nobody moves.

    Args:
        delays: estimate and sd by parameter, among them `time_shift` and the delays [s]; None
            before a fit, or if it did not converge.
    """
    if is_kinematic(problem.model):
        return ()
    flights, made = problem.training, []
    for label, flight in zip(labels(flights), flights, strict=True):
        of_inputs = {n: _delay(problem, flight, n, delays or {}) for n in flight.inputs}
        # Shift by the interval's early end: the rest of a late log would still raise an alarm.
        # A delay that may be zero shifts nothing: a needless shift would hide a fast controller.
        earlier = {n: 2.0 * sd - d for n, (d, sd, _) in of_inputs.items() if d + 2.0 * sd < 0}
        made += [
            one._replace(flight=label, delay_known=of_inputs[one.input][2])
            for one in feedback(flight, len(flights), earlier)
        ]
    return tuple(made)


def _delay(
    problem: Problem, flight: Flight, name: str, delays: Mapping[str, tuple[float, float | None]]
) -> tuple[float, float, bool]:
    """Return the known delay of an input and its sd [s], and True if it was estimated."""
    delay, variance, estimated = 0.0, 0.0, False
    own = dict(problem.model.delays).get(name)
    if own is not None and own not in delays:
        stated = flight.known.get(own)
        delay = float(getattr(problem.vehicle, own) if stated is None else stated)
    for parameter in ("time_shift", own):
        value, sd = delays.get(parameter or "", (0.0, None))
        if sd is not None:
            delay, variance, estimated = delay + value, variance + sd**2, True
    return delay, math.sqrt(variance), estimated
