"""Estimates with intervals from the Fourier sums of a stream, by maximum likelihood in frequency.

Each completed block is a record of `identification/estimation/frequency_error.py`: its ends are
projected out, and the noise's spectrum is estimated from the residual of all blocks. A call begins
at the estimates of the call before, and takes milliseconds.
"""

import dataclasses
import functools
import itertools
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from heli_jax import naming
from heli_jax.dynamics.jacobians import jacobians
from heli_jax.identification.estimation.data import data_of, start_vector
from heli_jax.identification.estimation.frequency_error import products_of_record
from heli_jax.identification.estimation.frequency_lines import (
    Matrices,
    Record,
    Sources,
    at_each_line,
    ends_of,
    modelled,
)
from heli_jax.identification.estimation.frequency_noise import (
    inverse_roots,
    smoothed,
    whitening_by,
)
from heli_jax.identification.estimation.residual import prior_rows
from heli_jax.identification.identifiability.verdict import Z95
from heli_jax.identification.problem import Problem
from heli_jax.identification.unknowns import transforms
from heli_jax.identification.unknowns.layout import Data, Layout, layout_of, unpack
from heli_jax.numerics.jitted import jitted
from heli_jax.simulation.discretize import discretize
from heli_jax.simulation.hold import delays_of
from heli_jax.stream.steps import LINES, State, blocks_of


class _Block(Record):
    """The lines of a block, at most `LINES`."""

    @property
    def lines(self) -> int:
        return min((self.samples - 1) // 2, LINES)


class Estimated(NamedTuple):
    """One estimate, in the unit of its parameter; a combination in SI."""

    value: float
    sd: float
    lower95: float
    upper95: float


class Known(NamedTuple):
    """Estimates of the blocks so far."""

    estimates: dict[str, Estimated]
    """Free parameters, gains and shift."""
    relative: Float[np.ndarray, "q q"]
    """Covariance relative to the values."""
    z: Float[np.ndarray, " q"]
    """Coordinates of the estimates, where the next call begins."""
    covariance: Float[np.ndarray, "q q"]
    """In these coordinates."""
    whitening: Complex[np.ndarray, "K p p"]
    """Inverse root of the noise's spectrum."""
    coherence: dict[tuple[str, str], float]
    """By input and output: part of the output's power that follows the input."""
    blocks: int
    """Blocks completed so far."""

    def of(self, name: str) -> Estimated | None:
        """Return the estimate of a parameter, of a product `a*If` or a quotient `a/If`; None if
        there is none."""
        if name in self.estimates:
            return self.estimates[name]
        mark = "/" if "/" in name else "*"
        pair, sign = name.split(mark), -1.0 if mark == "/" else 1.0
        if len(pair) != 2 or not all(n in self.estimates for n in pair):
            return None
        i, j = (list(self.estimates).index(n) for n in pair)
        C = self.relative
        sd = float(np.sqrt(max(C[i, i] + C[j, j] + 2.0 * sign * C[i, j], 0.0)))
        value = self.estimates[pair[0]].value * self.estimates[pair[1]].value ** sign
        factor = float(np.exp(min(Z95 * sd, 700.0)))
        return Estimated(value, abs(value) * sd, *sorted((value / factor, value * factor)))

    def sd_of(self, name: str) -> float:
        """Return the sd of an estimate over its value; infinite without one."""
        one = self.of(name)
        return one.sd / abs(one.value) if one is not None and one.value else np.inf

    def combinations(self) -> dict[str, Estimated]:
        """Return the products and quotients that are determined far better than their factors."""
        made, own = {}, np.sqrt(np.diag(self.relative))
        for (i, a), (j, b) in itertools.combinations(enumerate(self.estimates), 2):
            for name in (f"{b}/{a}", f"{a}*{b}"):
                one = self.of(name)
                if one is not None and one.sd < _BETTER * min(own[i], own[j]) * abs(one.value):
                    made[name] = one
        return made


_BETTER = 0.5
"""Relative sd of a product or quotient, over the smaller of its factors', up to which it is
listed."""


class _Frame(NamedTuple):
    """Parts of a problem that the estimates need."""

    layout: Layout
    data: Data
    linear: tuple[bool, ...]
    """True for each input that is linear between samples; () if none is."""


@functools.lru_cache(maxsize=8)
def _frame(problem: Problem) -> _Frame:
    """Return a problem without the unknowns of single flights, which blocks do not have."""
    flight, nuisance = problem.training[0], problem.nuisance
    bare = nuisance._replace(initial_state=False, bias=False, input_offset=False)
    of_lines = dataclasses.replace(
        problem,
        method="frequency-error",
        flights=(flight,),
        nuisance=bare,
        window=None,
        continuity=None,
        fixed_noise=(),
        instrument=(),
    )
    layout = layout_of(of_lines, of_lines.training)
    moving = tuple(flight.hold[n] == "linear" for n in naming.names(problem.model.Inputs))
    return _Frame(layout, data_of(of_lines, of_lines.training), moving if any(moving) else ())


class _Lines(NamedTuple):
    """Transforms of all blocks."""

    inputs: Complex[Array, "K m F"]
    outputs: Complex[Array, "K p F"]
    ends: Float[Array, "r m F"]
    """Inputs about the first sample of each block, less those about the next one's, over
    sqrt(N)."""


def _model(
    frame: _Frame, block: _Block, ahead: int, lines: _Lines, z: Float[Array, " q"]
) -> tuple[Matrices, Sources]:
    """Return the discretised model, and the transforms of what drives it."""
    layout, data, linear = frame
    u, flight = unpack(layout, data, z), data.flights[0]
    params = layout.model.Params(**{**data.base, **u.params, **flight.known})
    delays = delays_of(layout.model, params, u.shift, flight.dt)
    Ad, *taps = discretize(layout.model, params, flight.dt, delays, linear)
    _, _, C, D = jacobians(layout.model, params)
    names = naming.names(layout.model.Inputs)
    whole, rest = ([0] * len(names) for _ in range(2))
    if delays is not None:
        of = [delays.group(i) for i in range(len(names))]
        whole = [0 if g is None else delays.whole[g] for g in of]
        rest = [0.0 if g is None else delays.rest[g] for g in of]
    omega, kind = jnp.asarray(np.angle(block.z)), lines.inputs.dtype

    def turned(samples: Array) -> Array:
        angle = omega[:, None] * samples.astype(omega.dtype)
        return jax.lax.complex(jnp.cos(angle), jnp.sin(angle))

    def lagged(more: int) -> Array:
        """Return the transforms of the inputs as they were `more` samples before."""
        columns = []
        lags = np.arange(lines.ends.shape[0]) - ahead
        for i, n in enumerate(names):
            lag = whole[i] + more
            column = lines.inputs[:, i]
            if not (isinstance(lag, int) and lag == 0):
                # A shifted block begins and ends with other samples.
                sign = jnp.where((lags >= 1) & (lags <= lag), 1.0, 0.0)
                sign = jnp.where((lags <= 0) & (lags > lag), -1.0, sign)
                other = (sign[:, None] * lines.ends[:, i]).astype(kind)
                column = column + turned(jnp.asarray(lags)[None, :]) @ other
                column = turned(-jnp.asarray(lag)[None, None]) * column
            columns.append(column * u.gains[n].astype(kind) if n in u.gains else column)
        return jnp.stack(columns, axis=1)

    now = lagged(0)
    each = [(M, lag) for M, lag in zip(taps, (0, 1, -1), strict=True) if M is not None]
    U = jnp.concatenate([now if lag == 0 else lagged(lag) for _, lag in each], axis=1)
    held = now
    if delays is not None:
        shares = [
            r if linear and linear[i] else jnp.where(jnp.asarray(r) > 0, 1.0, 0.0)
            for i, r in enumerate(rest)
        ]
        share = jnp.stack([jnp.asarray(v, float) for v in shares])[None, :, None]
        share = share.astype(kind)
        held = share * lagged(1) + (1.0 - share) * now
    rows = np.asarray([naming.names(layout.model.Outputs).index(n) for n in layout.outputs[0]])
    B = jnp.concatenate([M for M, _ in each], axis=1)
    return Matrices(Ad, B, C[rows], D[rows]), Sources(U, held)


# Any: arrays of NumPy or JAX.
@jitted
def _products(
    frame: _Frame, block: tuple[int, int], lines: _Lines, W: Any, z: Any
) -> tuple[Array, Array, Array]:
    """Return e'e, J'e and J'J of whitened errors and priors."""
    record, ahead = _Block(0, 0, block[0]), block[1]

    def model(z: Array, by_instrument: bool) -> tuple[Matrices, Sources]:
        return _model(frame, record, ahead, lines, z)

    ee, Je, JJ, _ = products_of_record(model, z, record, W, lines.outputs)
    layout, data = frame.layout, frame.data
    r, J = prior_rows(layout, data, z), jax.jacfwd(partial(prior_rows, layout, data))(z)
    return ee + r @ r, Je + J.T @ r, JJ + J.T @ J


@jitted
def _errors(
    frame: _Frame, block: tuple[int, int], lines: _Lines, W: Any, z: Any
) -> tuple[Complex[Array, "K p F"], Matrices, Array]:
    """Return the errors without the effects of the ends, the model, and the part (K,) of the
    errors' power that these effects take."""
    record = _Block(0, 0, block[0])
    m, at = _model(frame, record, block[1], lines, z)
    ends = ends_of(m, record, W, at, lines.outputs)
    made = at_each_line(partial(modelled, m), ends.R, at._replace(ends=ends.inputs))
    return (
        lines.outputs - made,
        m,
        jnp.mean(jnp.sum(ends.Q**2, axis=1).reshape(record.lines, -1), 1),
    )


@jitted
def _values(frame: _Frame, z: Any) -> tuple[Array, Array]:
    """Return the parameters, gains and shift, and their derivatives by z."""

    def values(z: Array) -> Array:
        u = unpack(frame.layout, frame.data, z)
        shift = [] if u.shift is None else [u.shift]
        return jnp.stack([*u.params.values(), *u.gains.values(), *shift])

    return values(z), jnp.diagonal(jax.jacfwd(values)(z))


_ROUNDS, _STEPS = 8, 12
"""Most estimates of the noise's spectrum, and most steps for each."""
_FEW = 0.15
"""Widening of the intervals after one block, and the n-th part of it after n blocks: the weights
are estimated from the same blocks. Measured by experiments/stream.py."""
_MOST_LOST = 0.8
"""Largest part of a line's power that counts as taken by the ends."""
_STILL = 0.03
"""Change of all estimates [sd] that ends the search."""


def estimate(problem: Problem, state: State, before: Known | None = None) -> Known | None:
    """Return what the completed blocks determine; None without any.

    Args:
        problem: that of `init`.
        before: result of an earlier call.
    """
    done = blocks_of(state)
    if not done.count:
        return None
    frame, m = _frame(problem), len(naming.names(problem.model.Inputs))
    scale = 1.0 / np.sqrt(state.length)
    lines = _Lines(*map(jnp.asarray, (done.lines[:, :m], done.lines[:, m:], scale * done.ends)))
    block = (state.length, state.ahead)
    if before is None:
        z = np.asarray(start_vector(frame.layout, frame.data, problem))
        # As frequency error begins: each signal alone, as if all of it were noise.
        S = smoothed([done.lines[:, m:, i] for i in range(done.count)])[0]
        W = inverse_roots(S * np.eye(S.shape[1]))
    else:
        z, W = before.z, before.whitening
    for _ in range(_ROUNDS):
        began = z
        z, covariance = _search(frame, block, lines, W, z)
        errors, vehicle, lost = jax.device_get(_errors(frame, block, lines, W, z))
        # The ends take most of the power at the lowest lines, where gusts are.
        left = done.count * errors.shape[1] * np.sum(2.0 * (1.0 - lost))
        power = (1.0 - np.minimum(lost, _MOST_LOST)) * max(1.0 - z.size / left, 0.1)
        errors = errors / np.sqrt(power)[:, None, None]
        W = whitening_by(vehicle, [errors[:, :, i] for i in range(done.count)], state.length)[0]
        moved = (z - began) / np.sqrt(np.maximum(np.diag(covariance), 1e-300))
        if before is not None and np.max(np.abs(moved)) < _STILL:
            break
        before = before or Known({}, covariance, z, covariance, W, {}, 0)
    _, _, information = jax.device_get(_products(frame, block, lines, W, z))
    P = np.asarray(jax.jacfwd(partial(prior_rows, frame.layout, frame.data))(jnp.asarray(z)))
    data = (information - P.T @ P) / (1.0 + _FEW / done.count) ** 2
    covariance = _inverse(data + P.T @ P)
    return Known(
        *_named(frame, z, covariance),
        z,
        covariance,
        W,
        _coherence(problem, frame.layout.outputs[0], lines, done.count),
        int(state.blocks),
    )


def _inverse(information: np.ndarray) -> np.ndarray:
    """Return the inverse of a positive semidefinite matrix; huge where it is singular."""
    size = np.sqrt(_positive(np.diag(information)))
    values, vectors = np.linalg.eigh(information / np.outer(size, size))
    V = vectors / np.sqrt(np.maximum(values, 1e-14)) / size[:, None]
    return V @ V.T


def _positive(diagonal: np.ndarray) -> np.ndarray:
    """Return a diagonal without zeros, of unknowns without effect."""
    return np.maximum(diagonal, max(1e-16 * diagonal.max(), 1e-100))


def _search(
    frame: _Frame, block: tuple[int, int], lines: _Lines, W: np.ndarray, z: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the optimum from z with fixed noise, by Levenberg-Marquardt, and its covariance."""
    data = frame.data
    limits = np.array(
        [
            transforms.coordinate_limits(kind, *(np.asarray(v) for v in of))
            for kind, *of in zip(frame.layout.kinds, data.sign, data.low, data.high, strict=True)
        ]
    )
    k, damping = len(limits), 1e-4
    cost, g, H = jax.device_get(_products(frame, block, lines, W, z))
    for _ in range(_STEPS):
        D = np.diag(_positive(np.diag(H)))
        move = -np.linalg.solve(H + damping * D, g)
        trial = z + np.clip(move, -1.0, 1.0)
        trial[:k] = np.clip(trial[:k], *limits.T)
        tried = jax.device_get(_products(frame, block, lines, W, trial))
        if not tried[0] <= cost * (1.0 + 1e-12):
            damping = max(10.0 * damping, 1e-6)
            if damping > 1e8:
                break
            continue
        moved, gained = trial - z, cost - tried[0]
        z, (cost, g, H), damping = trial, tried, 0.1 * damping
        if moved @ H @ moved < 1e-4 or gained < 1e-9 * cost:
            break
    return z, _inverse(H)


def _named(
    frame: _Frame, z: np.ndarray, covariance: np.ndarray
) -> tuple[dict[str, Estimated], np.ndarray]:
    """Return the estimates by name, and their covariance relative to the values."""
    values, slopes = jax.device_get(_values(frame, z))
    sds = np.sqrt(np.diag(covariance))
    ends = [jax.device_get(_values(frame, z + side * Z95 * sds)[0]) for side in (-1.0, 1.0)]
    made = {
        n: Estimated(float(v), float(abs(s) * sd), *sorted((float(a), float(b))))
        for n, v, s, sd, a, b in zip(
            frame.layout.of_interest, values, slopes, sds, *ends, strict=True
        )
    }
    over = slopes / np.where(values == 0, np.inf, values)
    return made, covariance * np.outer(over, over)


_AVERAGES = 12
"""Least lines and blocks in a coherence."""


def _coherence(
    problem: Problem, outputs: tuple[str, ...], lines: _Lines, count: int
) -> dict[tuple[str, str], float]:
    """Return, by input and output, the part of the output's power that follows the input."""

    def hann(v: np.ndarray) -> np.ndarray:
        return v[1:-1] - 0.5 * (v[2:] + v[:-2])

    u, y = (hann(np.asarray(v)[..., :count]) for v in (lines.inputs, lines.outputs))
    width = -(-_AVERAGES // count)
    first = np.arange(0, len(u), width)

    def power(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return np.add.reduceat(np.sum(np.conj(a) * b, axis=-1), first, axis=0)

    made = {}
    for i, name in enumerate(naming.names(problem.model.Inputs)):
        for j, output in enumerate(outputs):
            uu, yy = (np.real(power(v, v)) for v in (u[:, i], y[:, j]))
            follows = np.abs(power(u[:, i], y[:, j])) ** 2 / np.where(uu > 0, uu, np.inf)
            made[name, output] = float(np.sum(follows) / max(np.sum(yy), 1e-300))
    return made
