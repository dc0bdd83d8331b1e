"""Flights made ready for regression: smoothed, segment by segment."""

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

# Signals smoothed by a short kernel, with the derivatives of what is smoothed.
#
# The kernel is w(s) = (1 - s^2)^4 over a few samples to either side, of unit area. A derivative is
# taken of the kernel and not of the samples, by parts: (w * x)' = w' * x. That is the method of
# modulating functions (M. Shinbrot, NACA TN 3288, 1954); it does what the local smoothing and
# differentiation of SIDPAC's `smoo` and `deriv` do (V. Klein and E. A. Morelli, Aircraft System
# Identification, 2006, ch. 11), and beyond that keeps a linear equation exact: x' = A x + B u holds
# for smoothed states, derivatives and inputs as it does for themselves, however much is smoothed.


ORDERS = 3
"""a signal, its first and its second derivative"""
HALF_WIDTHS = (4, 6, 8, 12, 16, 24, 32, 48, 64)
"""of the kernel, in samples, of which one is taken"""
_MOST_LEFT_OUT = 0.05
"""part of a signal's motion that smoothing may take away beside the noise"""
_BRIDGED = 3
"""missing samples in a row that a straight line replaces; more end a segment"""
_LOST = 2.5
"""usual steps of a slow sensor that a cubic bridges: one lost sample, with jitter"""
_FEWEST = 8
"""samples of a slow sensor through which a cubic is drawn"""
# Of the fourth power the kernel and its first three derivatives vanish at the ends. Sums over
# samples are then close to the integrals that integration by parts is about, for all derivatives
# that are taken here, and the parts at the ends are zero.
_SHAPE = Polynomial([1.0, 0.0, -1.0]) ** 4
_AREA = float(_SHAPE.integ()(1.0) - _SHAPE.integ()(-1.0))


def margin(half: int) -> int:
    """Samples at either end of a segment that smoothing takes away."""
    return half + 2  # two more: a delayed and held input reaches further back


def smoothed(y: Float[np.ndarray, " N"], dt: float, half: int) -> Float[np.ndarray, "r n"]:
    """A sampled signal smoothed, and its derivatives.

    Args:
        y: the samples (N,), all seen.
        dt: time between them [s].
        half: half width of the kernel in samples.

    Returns:
        (3, N - 2 `margin`) the smoothed signal and its derivatives per second.
    """
    return _convolved(y, _of_samples(dt, half, 0.0))


def smoothed_input(
    u: Float[np.ndarray, " N"], dt: float, half: int, *, held: bool, late: float = 0.0
) -> Float[np.ndarray, "r n"]:
    """An input smoothed, and its derivatives, as `smoothed` gives them.

    Args:
        u: the samples (N,).
        dt: time between them [s].
        half: half width of the kernel in samples.
        held: whether it stays between samples; else it follows a straight line.
        late: how late it acts [s].
    """
    whole = int(np.floor(late / dt))
    rest = late / dt - whole
    # Whole samples of the delay by index, the rest of it within the weights: so a delay changes the
    # smoothed input without steps. Before the record the input is taken to be as at its beginning.
    shifted = u[np.clip(np.arange(u.size) - whole, 0, u.size - 1)]
    # A held input jumps. Weights at the samples would put each jump in the middle of an interval,
    # half a sample late or early, and the regression would find that as a delay.
    weights = _of_held(dt, half, rest) if held else _of_samples(dt, half, rest)
    return _convolved(shifted, weights)


def _convolved(
    x: Float[np.ndarray, " N"], weights: Float[np.ndarray, "r w"]
) -> Float[np.ndarray, "r n"]:
    # Only where the whole kernel lies within the samples: at the ends a kernel cut off would no
    # longer keep the equations exact.
    return np.stack([np.convolve(x, w, mode="valid") for w in weights])


def _of_samples(dt: float, half: int, rest: float) -> Float[np.ndarray, "r w"]:
    """Weights of the samples around one of them: the kernel and its derivatives there."""
    j = np.arange(-margin(half), margin(half) + 1) - rest
    weights = np.stack([_kernel(r, j / half) * half ** -(r + 1.0) for r in range(ORDERS)])
    # The sum over samples is not quite the integral. So that a constant stays one and has no
    # derivatives, and a line and a parabola have theirs, the weights are put right by the kernel.
    weights[0] /= weights[0].sum()
    # In this order: each later row is cleared of what the rows before it would make of it.
    weights[1] -= weights[1].sum() * weights[0]
    weights[1] /= -(weights[1] @ j)
    weights[2] -= weights[2].sum() * weights[0]
    weights[2] /= 0.5 * (weights[2] @ j**2)
    return weights / dt ** np.arange(ORDERS)[:, None]


def _of_held(dt: float, half: int, rest: float) -> Float[np.ndarray, "r w"]:
    """Weights of the samples of a held input: the kernel's integrals over each sample time."""
    j = np.arange(-margin(half), margin(half) + 1) - rest
    weights = [
        (_kernel(r - 1, j / half) - _kernel(r - 1, (j - 1.0) / half)) * half**-r
        for r in range(ORDERS)
    ]
    return np.stack(weights) / dt ** np.arange(ORDERS)[:, None]


def _kernel(order: int, s: np.ndarray) -> np.ndarray:
    """The kernel's derivative of that order by s; -1 for its integral from the left."""
    inside = np.clip(s, -1.0, 1.0)
    if order < 0:
        integral = _SHAPE.integ()
        return (integral(inside) - integral(-1.0)) / _AREA
    # Zero at the ends up to the third derivative, so clipping makes no step there.
    return _SHAPE.deriv(order)(inside) / _AREA if order else _SHAPE(inside) / _AREA


def half_width(outputs: Mapping[str, np.ndarray], sd: Mapping[str, float]) -> int:
    """The widest kernel that takes away little more than noise of every output.

    Args:
        outputs: whole segments of samples (N,) by name.
        sd: of their measurement noise.
    """
    best = HALF_WIDTHS[0]
    for half in HALF_WIDTHS:
        inner = slice(margin(half), -margin(half))
        for name, y in outputs.items():
            # A wide kernel takes half a width away at either end of every segment: a short record
            # would be left with little to regress.
            if y.size < 8 * half:
                return best
            left = float(np.std(y[inner] - smoothed(y, 1.0, half)[0]))
            # What smoothing takes away should be noise. A little of the motion may go as well, and
            # the two add as independent variances do.
            if left > np.hypot(sd[name], _MOST_LEFT_OUT * float(np.std(y))):
                return best
        best = half
    return best


def segments(outputs: Mapping[str, np.ndarray]) -> tuple[list[slice], dict[str, np.ndarray]]:
    """Where all outputs are seen, and the outputs with short gaps bridged by straight lines.

    Args:
        outputs: samples (N,) by name, NaN where one is missing.
    """
    bridged = {name: _bridged(y) for name, y in outputs.items()}
    seen = np.all([np.isfinite(y) for y in bridged.values()], axis=0)
    edges = np.flatnonzero(np.diff(np.r_[False, seen, False].astype(int)))
    return [slice(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)], bridged


def _bridged(y: Float[np.ndarray, " N"]) -> Float[np.ndarray, " N"]:
    seen = np.flatnonzero(np.isfinite(y))
    if seen.size < 2:
        return y
    # NaN outside: a line between two samples is a guess with two ends, beyond the last there is
    # none.
    usual, allowed = float(np.median(np.diff(seen))), _BRIDGED
    filled = np.interp(np.arange(y.size), seen, y[seen], left=np.nan, right=np.nan)
    if usual > _BRIDGED and seen.size >= _FEWEST:
        # A slow sensor on a fast grid: a cubic from sample to sample. What is regressed is then no
        # faster than it, which is enough to begin with; the fit itself sees the samples alone.
        from scipy.interpolate import CubicSpline

        inside = slice(int(seen[0]), int(seen[-1]) + 1)
        filled[inside] = CubicSpline(seen, y[seen])(np.arange(inside.start, inside.stop))
        allowed = _LOST * usual
    for before, after in itertools.pairwise(seen):
        if after - before - 1 > allowed:
            filled[before + 1 : after] = np.nan
    return filled


# Which states of a linear model the measured outputs show, and which equations to regress.


# Params is a class of each model, hence Any.

_DETERMINED = 1e-8
"""part of a unit vector that may lie outside the span of what is measured"""


class Matrices(NamedTuple):
    """[A B; C D] with rows of states then outputs, columns of states then inputs."""

    value: Float[np.ndarray, "r c"]
    slope: Float[np.ndarray, "r c q"]
    """by the parameters"""


@eqx.filter_jit
def _stacked(model: Model, names: tuple[str, ...], base: dict[str, Any], values: Array) -> Any:
    def matrix(values: Array) -> Array:
        params = model.Params(**{**base, **dict(zip(names, values, strict=True))})
        A, B, C, D = jacobians(model, params)
        return jnp.block([[A, B], [C, D]])

    # Forward: a matrix has more entries than a model has parameters.
    return matrix(values), jax.jacfwd(matrix)(values)


def matrices(
    model: Model, base: Mapping[str, float], names: Sequence[str], values: np.ndarray
) -> Matrices:
    """The matrices of a linear model and their derivatives.

    Args:
        model: linear, with n states, m inputs and p outputs.
        base: all parameters by name, SI.
        names: those to differentiate by.
        values: theirs (q,), in place of those in `base`.
    """
    dtype = jnp.result_type(float)
    of_base = {n: jnp.asarray(v, dtype) for n, v in base.items()}
    value, slope = _stacked(model, tuple(names), of_base, jnp.asarray(values, dtype))
    return Matrices(np.asarray(value), np.asarray(slope))


class Structure(NamedTuple):
    """What a flight's measured outputs show of a model's states."""

    states: tuple[str, ...]
    signals: tuple[str, ...]
    """measured outputs, then inputs: the columns of `shown`"""
    shown: dict[int, Float[np.ndarray, "r z"]]
    """by state: the coefficients of each derivative of each signal that make it"""
    hidden: tuple[int, ...]
    """the states that nothing measured shows"""
    equations: tuple[str, ...]
    """the states and outputs of `rows`"""
    rows: tuple[int, ...]
    """of `Matrices` the equations to be regressed: of states, and of outputs that show none"""

    @property
    def n(self) -> int:
        """The number of states."""
        return len(self.states)


def structure(
    model: Model, value: Float[np.ndarray, "r c"], depends: np.ndarray, outputs: Sequence[str]
) -> Structure:
    """What is measured of the states, and which equations there are to regress.

    A state is measured where an output is that state, or where outputs are a linear image of it
    with known coefficients; or where it is the derivative of one, as a rate is of an angle.

    Args:
        model: linear.
        value: `Matrices.value` (r, c); where a free parameter is in an entry, any number.
        depends: whether a free parameter is in an entry (r, c).
        outputs: measured, by name.
    """
    states, inputs = naming.names(model.State), naming.names(model.Inputs)
    n, names = len(states), naming.names(model.Outputs)
    rows = [n + names.index(y) for y in outputs]
    signals = (*outputs, *inputs)
    # y - D u = C x, with coefficients that are known.
    # An output with a free parameter in its row shows no state: what it shows depends on what is to
    # be found. It becomes an equation to be regressed instead.
    known = [i for i, row in enumerate(rows) if not depends[row].any()]
    right = np.zeros((len(known), ORDERS, len(signals)))
    for k, i in enumerate(known):
        right[k, 0, i] = 1.0
        right[k, 0, len(outputs) :] = -value[rows[i], n:]
    left = value[[rows[i] for i in known], :n]
    shown = _solved(left, right)
    shown = _by_derivatives(value, depends, shown, n, len(outputs))
    hidden = tuple(i for i in range(n) if i not in shown)
    used = [i for i in range(n) if i in shown and _matters(value, depends, i, hidden)]
    used += [row for row in rows if depends[row].any()]
    equations = tuple((*states, *names)[i] for i in used)
    return Structure(states, signals, shown, hidden, equations, tuple(used))


def _matters(value: np.ndarray, depends: np.ndarray, row: int, hidden: tuple[int, ...]) -> bool:
    return bool(depends[row].any() or (value[row, list(hidden)] != 0).any())


def _solved(
    left: Float[np.ndarray, "k n"], right: Float[np.ndarray, "k r z"]
) -> dict[int, Float[np.ndarray, "r z"]]:
    """The unknowns that left x = right determines, by index."""
    if not left.size:
        return {}
    inverse = np.linalg.pinv(left, rcond=1e-10)
    spanned = inverse @ left
    # Where a row of A^+ A is that of the identity, this unknown is determined, whatever the others
    # are: a record with few outputs shows some states and not the rest.
    alone = np.abs(spanned - np.eye(left.shape[1])).max(axis=1) < _DETERMINED
    solution = np.tensordot(inverse, right, axes=1)
    return {int(i): solution[i] for i in np.flatnonzero(alone)}


def _by_derivatives(
    value: np.ndarray, depends: np.ndarray, shown: dict[int, np.ndarray], n: int, p: int
) -> dict[int, np.ndarray]:
    """The states that the equations of the shown ones give, where these know all else."""
    rest = [i for i in range(n) if i not in shown]
    rows = [i for i in shown if not depends[i].any() and np.any(value[i, rest] != 0)]
    if not rows:
        return shown
    right = []
    for i in rows:
        # x_i' - A_ik x_k - B_i u = A_ij x_j with the shown k and the others j.
        # One order up, which is the time derivative of what shows the state. The highest order
        # comes round to the front and is dropped: `_solved` has left it empty.
        side = np.roll(shown[i], 1, axis=0)
        side[0, :] = 0.0
        side = side - sum(value[i, k] * shown[k] for k in shown)
        side[0, p:] -= value[i, n:]
        right.append(side)
    # Once only: each derivative more has so much more noise.
    more = _solved(value[np.ix_(rows, rest)], np.stack(right))
    return {**shown, **{rest[j]: columns for j, columns in more.items()}}


def held(model: Model, base: Mapping[str, float], structures: Sequence[Structure]) -> set[str]:
    """The parameters that are time constants (or frequencies) of hidden states.

    They are found by no regression: a parameter in an entry on the diagonal of the hidden states'
    own matrix, or in one that closes a loop with entries that are plain numbers, as a stiffness
    does with the rate that is the angle's derivative.

    Args:
        model: linear.
        base: all parameters by name; one that is not given (NaN) stays so, other values do not
            matter.
        structures: of the flights.
    """
    names = tuple(n for n in naming.names(model.Params) if not np.isnan(base[n]))
    at = matrices(model, base, names, generic(len(names)))
    held_names: set[str] = set()
    for hidden in {s.hidden for s in structures}:
        block = np.ix_(hidden, hidden)
        depends = np.abs(at.slope[block]) > 0
        # An entry with a parameter on such a loop sets an eigenvalue of what nobody measured. With
        # the hidden states integrated at a wrong one, least squares would fit the rest to the wrong
        # signal.
        loop = _closing((at.value[block] != 0) & ~depends.any(axis=-1))
        held_names |= {
            names[j] for j in np.flatnonzero((depends & loop[..., None]).any(axis=(0, 1)))
        }
    return held_names | set(dict(model.delays).values())


def generic(count: int) -> Float[np.ndarray, " q"]:
    """Numbers (count,) at which nothing cancels by chance."""
    return np.random.default_rng(11).uniform(0.5, 1.5, count)


def _closing(plain: np.ndarray) -> np.ndarray:
    """Where an entry (i, j) closes a loop: on the diagonal, or where i drives j by plain ones."""
    n = plain.shape[0]
    # After n rounds every chain of plain entries is in, since one without repetition is no longer.
    drives = np.eye(n, dtype=bool)
    for _ in range(n):
        drives = drives | (plain.T.astype(int) @ drives.astype(int) > 0)
    return drives


_SEGMENTS = 20
"""of a flight at most, the longest: each has an initial state of its own for what is hidden"""
_RESOLVED = 4
"""samples to a half width of the kernel that are kept: what is smoothed moves no faster"""


class Segment(NamedTuple):
    """A stretch without gaps, smoothed: arrays (signals, n), SI."""

    states: Float[np.ndarray, "k n"]
    """those that are shown, in the order of `Structure.shown`"""
    inputs: Float[np.ndarray, "m n"]
    left: Float[np.ndarray, "e n"]
    """the left-hand sides of the equations: derivatives per second, or outputs"""
    step: float
    """time between samples [s]"""


class Record(NamedTuple):
    """A flight for regression."""

    label: str
    known: Mapping[str, float]
    structure: Structure
    segments: tuple[Segment, ...]


def whole_segments(flight: Flight, names: Sequence[str]) -> tuple[list[slice], dict]:
    """The stretches in which the named outputs are seen, and these with short gaps bridged."""
    return segments({n: flight.outputs[n] for n in names})


def shortest(half: int) -> int:
    """Samples of the shortest segment that is worth smoothing."""
    # Between the margins three widths of the kernel are left, so a few values that do not share
    # their samples.
    return 2 * margin(half) + 6 * half


def width(flights: Sequence[Flight]) -> int:
    """The half width of the kernel for all flights [samples], by the noise of their outputs."""
    widths = []
    for flight in flights:
        parts, bridged = whole_segments(flight, list(flight.outputs))
        longest = max(parts, key=lambda s: s.stop - s.start, default=None)
        if longest is None:
            continue
        sd = {n: flight.sd.get(n) or noise_guess(y) for n, y in flight.outputs.items()}
        widths.append(half_width({n: y[longest] for n, y in bridged.items()}, sd))
    # One kernel for all flights, since they are regressed together: that whose motion is fastest
    # decides, or its dynamics would be smoothed away.
    return min(widths, default=HALF_WIDTHS[0])


def record(
    model: Model, flight: Flight, structure: Structure, half: int, late: Mapping[str, float]
) -> Record:
    """A flight smoothed.

    Args:
        model: linear.
        flight: with outputs as `structure` has them.
        structure: of the flight.
        half: half width of the kernel [samples].
        late: by input, how late it acts [s].
    """
    flight = without_jumps(flight)
    outputs = structure.signals[: -len(naming.names(model.Inputs))]
    parts, bridged = whole_segments(flight, outputs)
    least = shortest(half)
    parts = sorted((p for p in parts if p.stop - p.start >= least), key=lambda p: p.start - p.stop)
    made = [
        _segment(flight, structure, {n: bridged[n][p] for n in outputs}, p, (half, late))
        for p in parts[:_SEGMENTS]
    ]
    return Record(flight.name, flight.known, structure, tuple(made))


def _segment(
    flight: Flight,
    structure: Structure,
    outputs: Mapping[str, np.ndarray],
    part: slice,
    timing: tuple[int, Mapping[str, float]],
) -> Segment:
    (half, late), dt = timing, flight.dt
    made = {n: smoothed(y, dt, half) for n, y in outputs.items()}
    n = part.stop - part.start
    # Inputs are known before the segment too, where a delayed one comes from.
    for name in structure.signals[len(outputs) :]:
        all_of_it = flight.inputs[name]
        at = np.clip(np.arange(part.start - n, part.stop), 0, all_of_it.size - 1)
        whole = smoothed_input(
            all_of_it[at], dt, half, held=flight.hold[name] == "zero-order", late=late.get(name, 0)
        )
        made[name] = whole[:, n:]
    z = np.stack([made[name] for name in structure.signals])  # (z, orders, n)
    # A state may be made of several signals and of their derivatives: all were smoothed by the same
    # kernel, so the sum is that state smoothed, without an error of its own.
    states = {i: np.einsum("rz,zrn->n", c, z) for i, c in structure.shown.items()}
    # What is a derivative of highest order already has none left; `_by_derivatives` goes once.
    rates = {
        i: np.einsum("rz,zrn->n", structure.shown[i][:-1], z[:, 1:])
        for i in structure.rows
        if i in structure.shown
    }
    left = [
        rates[i] if i in rates else made[name][0]
        for i, name in zip(structure.rows, structure.equations, strict=True)
    ]
    # Neighbours within a kernel are made of the same samples: leaving most of them out loses next
    # to nothing, and hidden states are integrated in fewer steps.
    empty, every = np.zeros((0, z.shape[-1])), max(1, half // _RESOLVED)
    return Segment(
        (np.stack(list(states.values())) if states else empty)[:, ::every],
        z[len(outputs) :, 0, ::every],
        np.stack(left)[:, ::every] if left else empty,
        dt * every,
    )
