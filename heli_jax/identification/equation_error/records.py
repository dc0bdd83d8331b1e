"""Flights for regression: smoothed signals, their derivatives, and states from outputs.

A signal x is smoothed by a short kernel of unit area, w(s) = c (1 - s^2)^4. It is differentiated by
parts, (w * x)' = w' * x (modulating functions: M. Shinbrot, NACA TN 3288, 1954). A linear equation
x' = A x + B u holds exactly for the smoothed signals, for any width of the kernel.
"""

import itertools
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.polynomial import Polynomial

from heli_jax import naming
from heli_jax.dynamics.jacobians import jacobians
from heli_jax.dynamics.model import Model
from heli_jax.flights.flight import Flight
from heli_jax.flights.holds import without_jumps
from heli_jax.numerics.white_noise import noise_guess

ORDERS = 3
"""Number of derivatives: a signal, its first and its second derivative."""
_HALF_WIDTHS = (4, 6, 8, 12, 16, 24, 32, 48, 64)
"""Candidate half widths of the kernel [samples]."""
_MOST_LEFT_OUT = 0.05
"""Largest part of a signal's sd that smoothing may remove besides the noise."""
_BRIDGED = 3
"""Longest gap that is interpolated [samples]; longer gaps end a segment."""
_LOST = 2.5
"""Longest gap of a slow sensor that is interpolated [usual steps]: one lost sample, with jitter."""
_DETERMINED = 1e-8
"""Largest residual of a unit vector in the span of the measured outputs."""
_SEGMENTS = 20
"""Most segments of a flight (the longest count), because each adds initial values of hidden states.
"""
_RESOLVED = 4
"""Samples kept in a half width of the kernel."""

# The kernel and its first three derivatives vanish at the ends.
_SHAPE = Polynomial([1.0, 0.0, -1.0]) ** 4
_AREA = 2.0 * _SHAPE.integ()(1.0)
_KERNEL = tuple(p / _AREA for p in (_SHAPE.integ(), *map(_SHAPE.deriv, range(ORDERS))))
"""The kernel's integral, and its derivatives from the zeroth on."""


def margin(half: int) -> int:
    """Return the number of samples that smoothing removes at each end of a segment."""
    return half + 2  # two more for a delayed and held input


def shortest(half: int) -> int:
    """Return the samples of the shortest segment: three widths of the kernel between margins."""
    return 2 * margin(half) + 6 * half


def smoothed(
    y: Float[np.ndarray, " N"], dt: float, half: int, *, held: bool = False, late: float = 0.0
) -> Float[np.ndarray, "r n"]:
    """Return the smoothed signal and its derivatives per second, (3, N - 2 `margin`).

    Args:
        y: signal without missing samples.
        half: half width of the kernel [samples].
        held: True for an input with a zero-order hold, else it is linear between samples.
        late: delay [s].
    """
    # Whole samples of the delay shift the index; the weights contain the rest.
    whole, rest = divmod(late / dt, 1.0)
    y = y[np.clip(np.arange(y.size) - int(whole), 0, y.size - 1)]
    j = np.arange(-margin(half), margin(half) + 1) - rest
    s = j / half
    scale = float(half) ** -np.arange(ORDERS)[:, None]
    if held:
        # The kernel is integrated over each sample time, because weights at the samples would delay
        # a jump.
        weights = scale * np.stack(
            [_kernel(r, s) - _kernel(r, s - 1.0 / half) for r in range(ORDERS)]
        )
    else:
        weights = scale / half * np.stack([_kernel(r + 1, s) for r in range(ORDERS)])
        # The correction makes sums reproduce the derivatives of parabolas exactly.
        weights[0] /= weights[0].sum()
        weights[1] -= weights[1].sum() * weights[0]
        weights[1] /= -(weights[1] @ j)
        weights[2] -= weights[2].sum() * weights[0]
        weights[2] /= 0.5 * (weights[2] @ j**2)
    weights /= dt ** np.arange(ORDERS)[:, None]
    return np.stack([np.convolve(y, w, mode="valid") for w in weights])


def _kernel(which: int, s: np.ndarray) -> np.ndarray:
    return _KERNEL[which](np.clip(s, -1.0, 1.0))


def segments(outputs: Mapping[str, np.ndarray]) -> tuple[list[slice], dict[str, np.ndarray]]:
    """Return the segments without missing outputs, and the outputs with short gaps filled."""
    bridged = {name: _bridged(y) for name, y in outputs.items()}
    seen = np.all([np.isfinite(y) for y in bridged.values()], axis=0)
    return np.ma.clump_masked(np.ma.array(seen, mask=seen)), bridged


def _bridged(y: Float[np.ndarray, " N"]) -> Float[np.ndarray, " N"]:
    seen = np.flatnonzero(np.isfinite(y))
    if not 1 < seen.size < y.size:
        return y
    from scipy.interpolate import PchipInterpolator

    # On a fast grid a slow sensor misses most samples.
    filled = PchipInterpolator(seen, y[seen], extrapolate=False)(np.arange(y.size))
    steps = np.diff(seen)
    long = steps > 1 + max(_BRIDGED, _LOST * float(np.median(steps)))
    filled[seen[0] : seen[-1]][np.repeat(long, steps)] = np.nan
    filled[seen] = y[seen]
    return filled


def kernel_width(flights: Sequence[Flight]) -> int:
    """Return the half width of the widest kernel that removes little but noise [samples]."""
    signals = []
    for flight in flights:
        parts, bridged = segments(flight.outputs)
        if parts:
            longest = max(parts, key=lambda s: s.stop - s.start)
            sd = {n: flight.sd.get(n) or noise_guess(y) for n, y in flight.outputs.items()}
            signals += [(y[longest], sd[n]) for n, y in bridged.items()]

    # A short record needs a narrow kernel.
    def passes(half: int) -> bool:
        inner = slice(margin(half), -margin(half))
        return all(
            y.size >= 8 * half
            and float(np.std(y[inner] - smoothed(y, 1.0, half)[0]))
            <= np.hypot(sd, _MOST_LEFT_OUT * float(np.std(y)))
            for y, sd in signals
        )

    return max([_HALF_WIDTHS[0], *itertools.takewhile(passes, _HALF_WIDTHS)])


@eqx.filter_jit
def _stacked(model: Model, names: tuple[str, ...], base: dict[str, Any], values: Array) -> Any:
    def matrix(values: Array) -> Array:
        params = model.Params(**{**base, **dict(zip(names, values, strict=True))})
        A, B, C, D = jacobians(model, params)
        return jnp.block([[A, B], [C, D]])

    return matrix(values), jax.jacfwd(matrix)(values)


def coefficients(
    model: Model, base: Mapping[str, float], names: Sequence[str], values: np.ndarray
) -> Float[np.ndarray, "r c 1+q"]:
    """Return [A B; C D] of a linear model, then its derivatives by the parameters `names`.

    Args:
        base: all parameters by name, SI.
        values: of `names` (q,), in place of those in `base`.

    Returns:
        (n + p, n + m, 1 + q): rows of states then outputs, columns of states then inputs.
    """
    dtype = jnp.result_type(float)
    of_base = {n: jnp.asarray(v, dtype) for n, v in base.items()}
    value, slope = _stacked(model, tuple(names), of_base, jnp.asarray(values, dtype))
    return np.concatenate([np.asarray(value)[..., None], np.asarray(slope)], axis=-1)


def generic(count: int) -> Float[np.ndarray, " q"]:
    """Return random numbers (count,) for which no terms cancel."""
    return np.random.default_rng(11).uniform(0.5, 1.5, count)


class Structure(NamedTuple):
    """States determined by measured outputs, and the equations to regress."""

    states: tuple[str, ...]
    signals: tuple[str, ...]
    """Measured outputs, then inputs: the columns of `shown`."""
    shown: dict[int, Float[np.ndarray, "r z"]]
    """Coefficients of each derivative of each signal, by state."""
    equations: tuple[str, ...]
    """States and outputs of `rows`."""
    rows: tuple[int, ...]
    """Rows of `coefficients` to regress: states, and outputs that determine no state."""

    @property
    def hidden(self) -> tuple[int, ...]:
        """States that no output determines."""
        return tuple(i for i in range(len(self.states)) if i not in self.shown)


def structure(model: Model, both: Float[np.ndarray, "r c q"], outputs: Sequence[str]) -> Structure:
    """Return the measured states and the equations to regress.

    A state is measured if outputs determine it with known coefficients. The derivative of a
    measured state, like the rate of an angle, is measured too.

    Args:
        both: `coefficients` at `generic` values of the free parameters, with their derivatives.
    """
    value, depends = both[..., 0], (both[..., 1:] != 0).any(axis=-1)
    states, inputs = naming.names(model.State), naming.names(model.Inputs)
    n, p, names = len(states), len(outputs), naming.names(model.Outputs)
    rows = [n + names.index(y) for y in outputs]
    # y - D u = C x is used if its coefficients are known. Other outputs are regressed.
    known = [i for i, row in enumerate(rows) if not depends[row].any()]
    right = np.zeros((len(known), ORDERS, p + len(inputs)))
    for k, i in enumerate(known):
        right[k, 0, i] = 1.0
        right[k, 0, p:] = -value[rows[i], n:]
    shown = _solved(value[[rows[i] for i in known], :n], right)
    # With measured k, x_i' - A_ik x_k - B_i u = A_ij x_j determines further states j.
    rest = [j for j in range(n) if j not in shown]
    equations = [i for i in shown if not depends[i].any() and np.any(value[i, rest] != 0)]
    sides = []
    for i in equations:
        # Rolling by one order gives the time derivative.
        side = np.roll(shown[i], 1, axis=0)
        side[0, :] = 0.0
        side -= sum(value[i, k] * shown[k] for k in shown)
        side[0, p:] -= value[i, n:]
        sides.append(side)
    if sides:
        # This is done only once because each derivative adds noise.
        more = _solved(value[np.ix_(equations, rest)], np.stack(sides))
        shown = {**shown, **{rest[j]: columns for j, columns in more.items()}}
    hidden = [i for i in range(n) if i not in shown]
    used = [i for i in shown if depends[i].any() or (value[i, hidden] != 0).any()]
    used = sorted(used) + [row for row in rows if depends[row].any()]
    every = (*states, *names)
    return Structure(states, (*outputs, *inputs), shown, tuple(every[i] for i in used), tuple(used))


def _solved(
    left: Float[np.ndarray, "k n"], right: Float[np.ndarray, "k r z"]
) -> dict[int, Float[np.ndarray, "r z"]]:
    """Return the unknowns determined by left x = right, by index."""
    if not left.size:
        return {}
    inverse = np.linalg.pinv(left, rcond=1e-10)
    # An unknown is determined if its row of A^+ A is that of the identity.
    alone = np.abs(inverse @ left - np.eye(left.shape[1])).max(axis=1) < _DETERMINED
    solution = np.tensordot(inverse, right, axes=1)
    return {int(i): solution[i] for i in np.flatnonzero(alone)}


def hidden_constants(
    model: Model, base: Mapping[str, float], structures: Sequence[Structure]
) -> set[str]:
    """Return the parameters that are delays, or set eigenvalues of hidden states in the regression.

    Args:
        base: all parameters by name; NaN if not given, other values do not matter.
    """
    names = tuple(n for n in naming.names(model.Params) if not np.isnan(base[n]))
    both = coefficients(model, base, names, generic(len(names)))
    constants = set(dict(model.delays).values())
    for hidden in {s.hidden for s in structures}:
        block = both[np.ix_(hidden, hidden)]
        depends = block[..., 1:] != 0
        # An entry sets an eigenvalue if it is on the diagonal, or if constant entries close a loop
        # with it (a stiffness).
        plain = (block[..., 0] != 0) & ~depends.any(axis=-1)
        loop = np.linalg.matrix_power(np.eye(len(hidden)) + plain.T, len(hidden)) > 0
        constants |= {names[j] for j in np.flatnonzero((depends & loop[..., None]).any((0, 1)))}
    return constants


class Segment(NamedTuple):
    """Smoothed segment without gaps; arrays (signals, n), SI."""

    known: Float[np.ndarray, "k n"]
    """Measured states in the order of `Structure.shown`, then inputs."""
    left: Float[np.ndarray, "e n"]
    """Left-hand sides of the equations: derivatives per second, or outputs."""
    step: float
    """Time between samples [s]."""


class Record(NamedTuple):
    """A flight for regression."""

    known: Mapping[str, float]
    structure: Structure
    segments: tuple[Segment, ...]


def record(
    model: Model, flight: Flight, structure: Structure, half: int, late: Mapping[str, float]
) -> Record:
    """Return a flight smoothed by a kernel of half width `half` [samples], with inputs delayed by
    `late` [s]."""
    flight = without_jumps(flight)
    parts, bridged = segments(flight.outputs)
    parts = [p for p in parts if p.stop - p.start >= shortest(half)]
    parts = sorted(parts, key=lambda p: p.start - p.stop)[:_SEGMENTS]
    # Adjacent values of the smoothed signal are strongly correlated.
    every = max(1, half // _RESOLVED)
    inputs, shown, made = naming.names(model.Inputs), structure.shown, []
    for part in parts:
        signals = {n: smoothed(y[part], flight.dt, half) for n, y in bridged.items()}
        # A delayed input starts before the segment.
        length = part.stop - part.start
        before = np.clip(np.arange(part.start - length, part.stop), 0, None)
        for name in inputs:
            held, u = flight.hold[name] == "zero-order", flight.inputs[name][before]
            whole = smoothed(u, flight.dt, half, held=held, late=late.get(name, 0.0))
            signals[name] = whole[:, length:]
        z = np.stack([signals[name] for name in structure.signals])[..., ::every]
        states = [np.einsum("rz,zrn->n", c, z) for c in shown.values()]
        left = [
            np.einsum("rz,zrn->n", shown[i][:-1], z[:, 1:])
            if i in shown
            else z[structure.signals.index(name), 0]
            for i, name in zip(structure.rows, structure.equations, strict=True)
        ]
        known = np.array([*states, *z[len(bridged) :, 0]])
        made.append(Segment(known, np.array(left), flight.dt * every))
    return Record(flight.known, structure, tuple(made))
