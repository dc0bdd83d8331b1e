"""Feedback: do inputs follow the response, through a pilot or a controller?

Innovations are what a record's own past cannot predict of its outputs: the residuals of a
multivariable ARX model of the record itself, so that a poor model of the vehicle is no alarm.
Under feedback an input depends on past innovations (L. Ljung, System Identification, 2nd ed. 1999,
13.4 and 16.5); without it, it does not. Each input is freed of what its own past predicts, and the
rest is correlated with sums of past innovations. The variance of such a correlation between two
autocorrelated signals is Bartlett's: the sum over all lags of the product of both autocorrelations
(L. D. Haugh, J. Am. Stat. Assoc. 71, 1976).

An output answers to how a stick moves until it is measured, from where the stick goes on: that is
no feedback. So either the innovations are freed of the inputs until then as well, in parts of a
sample, which sees all but what is fed back at once; or the input is freed of its own past in parts
of a sample, which sees that.

An input that is logged late follows the response as well, though nobody closes a loop: no such
correlation tells the two apart. Where a delay was estimated and is negative, the input is taken so
much earlier; elsewhere a late log is named as the other reading.
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

_NOTHING = 1e-7
"""of the root of what a sum's power is at least where its terms are unrelated, below which it is
rounding"""


def lag_blocks(longest: int) -> list[tuple[int, int]]:
    """Lags in samples, in groups that grow with the lag: what follows the response does so over a
    while, and few sums over many lags see it where each lag by itself would not.
    """
    blocks, first = [], 1
    while first <= longest:
        last = max(first, int(first * 1.5))
        blocks.append((first, min(last, longest)))
        first = last + 1
    return blocks


class Correlated(NamedTuple):
    """By column and block of lags."""

    p_value: Float[np.ndarray, "p b"]
    correlation: Float[np.ndarray, "p b"]


def correlations_with_sums(
    u: Float[np.ndarray, " N"], e: Float[np.ndarray, "N p"], blocks: Sequence[tuple[int, int]]
) -> Correlated:
    """Correlate u with the sums of each column of e over each block of lags; both are NaN where
    missing, e in whole rows."""
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
        # From the first whole block on.
        past = np.zeros_like(e)
        past[last:] = sums[last - first + 1 : N - first + 1] - sums[: N - last]
        own = _products_over_lags(past)
        size = np.sqrt(power * np.maximum(own[0], 0.0))
        moves = size > _NOTHING * np.sqrt(power * powers * (last - first + 1))
        correlation = u @ past * np.where(moves, 1.0 / np.where(moves, size, 1.0), 0.0)
        # Bartlett: autocorrelations beyond a few blocks are noise, and only add to the variance's.
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
    """Products of each column with itself, by lag."""
    size = scipy.fft.next_fast_len(2 * len(x), real=True)
    return np.fft.irfft(np.abs(np.fft.rfft(x, size, axis=0)) ** 2, size, axis=0)[: len(x)]


# What the past of a record does not predict of it: the residuals of ARX models.
#
# The order is the one that BIC takes; where samples are missing, no row is used in which one
# stands.


_ORDERS = (2, 4, 8, 16)
"""of the ARX models, of which BIC takes one"""
_PER_UNKNOWN = 8
"""samples for each coefficient of a model, at least"""
_RIDGE = 1e-12
"""added to the mean squares of past samples, which are of the size of one"""


def arx_residuals(
    y: Float[np.ndarray, "N p"], past: Float[np.ndarray, "N z"]
) -> Float[np.ndarray, "N p"] | None:
    """Residuals of an ARX model of y by a constant and earlier samples of signals (their `past`);
    NaN where one is missing; None if the record is too short."""
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
    # One factor serves all orders. Of the products, not of the samples, which takes twenty times as
    # long; the ridge is what rounding leaves of products.
    factor = np.linalg.cholesky(x.T @ x + _RIDGE * m * np.eye(sizes[-1]))
    along = scipy.linalg.solve_triangular(factor, x.T @ at, lower=True)
    unexplained = np.sum(at**2, axis=0) - np.cumsum(along**2, axis=0)
    # What rounding leaves of a signal that its past predicts exactly may be below zero.
    criteria = [
        m * np.sum(np.log(np.maximum(unexplained[k - 1], 0.0) / m + 1e-300)) + p * k * np.log(m)
        for k in sizes
    ]
    k = sizes[int(np.argmin(criteria))]
    coefficients = scipy.linalg.solve_triangular(factor[:k, :k], along[:k], lower=True, trans=1)
    left = np.full(y.shape, np.nan)
    left[longest:][rows] = at - x[:, :k] @ coefficients
    return left


LEVEL = 0.01
"""of the test of a whole record: all inputs, outputs and lags together"""
RATE = 50.0
"""samples a second at most: no feedback that a vehicle flies by is faster than a quarter of that"""
_SLOW_RATE = 10.0
"""samples a second at which slow feedback, as a pilot's, shows through a sensor's noise"""
_PARTS = 5
"""of a sample at a lower rate, at most, into which the inputs within it are taken apart"""
_LONGEST = 2.0
"""lag up to which an input may follow [s]"""
_MOST = 20_000
"""samples that are looked at"""
_LEAST = 100
"""samples of a record to be tested"""
_JUMP, _ROUNDS = 5.0, 3
"""times the median size of what is unforeseen of an input, above which it is a jump; how often what
is left is looked at again"""
_MOVES = 0.05
"""part of the samples at which an input that may follow something moves, at least"""
_LONG_REST, _AT_REST = 20, 0.5
"""samples of one value in a row that are a rest between two motions, and the part of a record that
such rests take in one whose input was programmed"""
_STILL = 1e-4
"""of the range of an input, below which a difference is no motion"""
_SEEN = 0.8
"""part of the samples of an output that is used"""


class Feedback(NamedTuple):
    """Result for one input of one flight. The names of the fields are keys of fit.json."""

    flight: str
    input: str
    output: str
    """whose past innovations it follows most surely"""
    correlation: float
    """of the unforeseen part of the input with them"""
    lag: tuple[float, float]
    """[s] how long ago they were"""
    p_value: float
    """for all inputs, outputs and lags of the record that were tested"""
    earlier: float = 0.0
    """[s] how much earlier than logged the input was taken, as its estimated delay says"""
    delay_known: bool = False
    """whether its delay was estimated: else the input may also be logged late"""

    @property
    def present(self) -> bool:
        """True if the input follows the response."""
        return self.p_value < LEVEL


def feedback(
    flight: Flight, together: int = 1, earlier: Mapping[str, float] | None = None
) -> tuple[Feedback, ...]:
    """Return for each input that moves freely the past innovations that it follows most surely;
    nothing where the record is too short to tell.

    Args:
        together: number of flights that are tested side by side, for the p values.
        earlier: by input, how much earlier than logged it is to be taken [s]; none unless given.
    """
    # Half of a record at most: a delay beyond is none that it could show.
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
                    # Of several that are sure beyond all numbers the correlation decides.
                    found[name] = min(
                        found.get(name, one), one, key=lambda f: (f.p_value, f.correlation)
                    )
    return tuple(found.values())


def _rates_of(flight: Flight) -> tuple[float, ...]:
    """Samples a second at which a flight is looked at [Hz]."""
    # No faster than the inputs come, nor than half of the log: when a frame of a stick began within
    # a sample, and how it moved there, is not known, and an output that answers to it would pass
    # for news.
    frames = [0.5]
    for u in flight.inputs.values():
        at = np.flatnonzero(np.diff(u) != 0.0)
        frames += [1.0 / float(np.median(np.diff(at)))] if at.size > 1 else []
    fast = float(np.clip(min(frames) / flight.dt, _SLOW_RATE, RATE))
    return (fast, _SLOW_RATE) if fast > _SLOW_RATE else (fast,)


class _View(NamedTuple):
    """Signals of a flight at one rate, of which the past is compared with inputs."""

    free: dict[str, np.ndarray]
    """by input what its own past does not predict (N,)"""
    innovations: Float[np.ndarray, "N p"]
    outputs: tuple[str, ...]
    inputs: int
    """how many inputs move"""
    dt: float


def _views(flight: Flight, steps: Mapping[str, int], rate: float) -> list[_View]:
    """Two pairs of what is compared; none where all outputs stay or lack too much, the record is
    too short, or no input moves freely; arguments as of `_decimated`."""
    inputs, outputs, parts, dt = _decimated(flight, steps, rate)
    if not outputs or next(iter(outputs.values())).size < _LEAST:
        return []
    # Steps are slopes at a lower rate.
    quick, *_ = _decimated(flight, steps, RATE)
    moving = [n for n in inputs if _moves_freely(quick.get(n, inputs[n]))]
    free = {n: v for n in moving if (v := _unforeseen(inputs[n], inputs[n][:, None])) is not None}
    if not free:
        return []
    finer = {n: v for n in free if (v := _unforeseen(inputs[n], parts[n])) is not None}
    y = np.stack(list(outputs.values()), axis=1)
    u = np.stack(list(inputs.values()), axis=1)
    # From the past of all signals together. What one output alone cannot predict may well be the
    # answer to an input, and would pass for feedback. A sample's own inputs stand beside the
    # outputs before it.
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
    """Residual (N,) of an input after its own past (N, m), without its jumps; None if nothing is
    left.

    A pilot's test steps are larger than what he does about a gust, and would drown it. What is left
    out is chosen by the input alone, so that the test stays one.
    """
    left = arx_residuals(u[:, None], own)
    for _ in range(_ROUNDS):
        if left is None:
            return None
        size = float(np.nanmedian(np.abs(left)))
        calm = np.abs(left[:, 0]) <= _JUMP * size
        # An input that mostly stays where it is has no other motion than its jumps.
        if size <= 1e-9 * np.std(u):
            break
        left = arx_residuals(np.where(calm, u, np.nan)[:, None], own)
    if left is None or not np.nanstd(left) > 1e-9 * np.std(u):
        return None
    return left[:, 0]


def _moves_freely(u: Float[np.ndarray, " N"]) -> bool:
    """True if an input has motion that could follow something."""
    # A commanded input that stays for twenty samples and jumps follows nothing in between; no more
    # does one whose steps are rounded off, as a programmed doublet's: what an autoregression leaves
    # of its corners rings on into the rest, as it does in the response.
    # A command that passed a filter comes to rest by and by: runs of one value, or as good as one.
    ends = np.flatnonzero(np.abs(np.diff(u)) > _STILL * np.ptp(u))
    runs = np.diff(np.concatenate([[-1], ends, [u.size - 1]]))
    rests = float(np.sum(runs[runs >= _LONG_REST])) / u.size
    return bool(np.mean(np.diff(u) != 0.0) >= _MOVES) and rests <= _AT_REST


def _decimated(
    flight: Flight, earlier: Mapping[str, int], rate: float
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray], dict[str, np.ndarray], float]:
    """A flight averaged down: by name the inputs that move (N,), the outputs that are mostly seen
    (N,), means over parts of a sample (N, m) of these inputs, and the sample time [s].

    Args:
        earlier: by how many samples an input is taken earlier than logged, where it is.
        rate: samples a second at most [Hz].
    """
    every = max(1, int(np.ceil(1.0 / (flight.dt * rate) - 1e-9)))
    edges = np.rint(np.linspace(0, every, min(every, _PARTS) + 1)).astype(np.int64)

    def thinned(x: np.ndarray) -> np.ndarray:
        # Means of blocks and not every n-th sample: what is faster than the lower rate would come
        # back as something slow.
        return x.reshape(-1, every).mean(axis=1)  # NaN where one of them is missing

    def within(x: np.ndarray) -> np.ndarray:
        return np.add.reduceat(x.reshape(-1, every), edges[:-1], axis=1) / np.diff(edges)

    # What an input does after the end of its log is not known: all signals end there.
    cut = max(earlier.values(), default=0)

    def taken(x: np.ndarray, first: int) -> np.ndarray:
        # Of a very long record a part will do, and its regressors fit into memory.
        part = x[first : x.size - cut + first]
        return part[: min(part.size // every, _MOST) * every]

    inputs = {n: taken(u, earlier.get(n, 0)) for n, u in flight.inputs.items()}
    inputs = {n: u for n, u in inputs.items() if u.size and np.ptp(u) > 0}
    outputs = {n: thinned(taken(y, 0)) for n, y in flight.outputs.items()}
    # A record of less than one block leaves none.
    outputs = {
        n: y
        for n, y in outputs.items()
        if y.size and np.mean(np.isfinite(y)) >= _SEEN and np.nanstd(y) > 0
    }
    parts = {n: within(u) for n, u in inputs.items()}
    return {n: thinned(u) for n, u in inputs.items()}, outputs, parts, flight.dt * every


# Whether the inputs of a problem's flights follow the response.


def feedback_of(
    problem: Problem, delays: Mapping[str, tuple[float, float | None]] | None = None
) -> tuple[Feedback, ...]:
    """Test all fitted flights; nothing where sensors are compared with each other, of which none is
    a stick that anybody moves.

    Args:
        delays: value and sd of what a fit found, among it `time_shift` and the parameters that are
            delays [s]; None before a fit, and of one that did not arrive.
    """
    if is_kinematic(problem.model):
        return ()
    flights, made = problem.training, []
    for label, flight in zip(labels(flights), flights, strict=True):
        of_inputs = {n: _delay(problem, flight, n, delays or {}) for n in flight.inputs}
        # As early as its interval has it: what is left of a late log would still be an alarm. One
        # that may be zero is none: an input that is moved for nothing hides a fast controller.
        earlier = {n: 2.0 * sd - d for n, (d, sd, _) in of_inputs.items() if d + 2.0 * sd < 0}
        made += [
            one._replace(flight=label, delay_known=of_inputs[one.input][2])
            for one in feedback(flight, len(flights), earlier)
        ]
    return tuple(made)


def _delay(
    problem: Problem, flight: Flight, name: str, delays: Mapping[str, tuple[float, float | None]]
) -> tuple[float, float, bool]:
    """Delay of an input and its sd [s], as far as they are known, and True if it was estimated."""
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
