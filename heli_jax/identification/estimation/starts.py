"""Points to start a search from: coarse searches of disturbances and delays, and draws."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from heli_jax.dynamics.disturbance import disturbances_of
from heli_jax.identification.estimation.levenberg_marquardt import without_size
from heli_jax.identification.estimation.residual import residual_and_jacobian, rows_of
from heli_jax.identification.estimation.simulated_flights import predict, signal_numbers
from heli_jax.identification.problem import MAX_TIME_SHIFT, Free, Problem
from heli_jax.identification.unknowns import transforms
from heli_jax.identification.unknowns.layout import Data, Layout, Noise, unpack
from heli_jax.numerics.jitted import jitted

# A first guess of the disturbances: the greatest likelihood on a coarse grid.


_DECADES = np.log(10.0) * np.arange(-3.0, 2.5)
"""by which the coarse search moves sigma_w"""
_FINER, _ROUNDS = 0.2, 3
"""decades between the points of a finer search, and how often it is done: a round reaches 0.4
decades up and 0.6 down"""


def noise_guess_at(
    layout: Layout, data: Data, noise: Noise, z0: Float[Array, " q"]
) -> Float[Array, " q"]:
    """z0 with sigma_w and tau_w of the greatest likelihood on a coarse grid about it; of several
    disturbances first all together, then each by itself."""
    z = one_noise_guess(layout, data, noise, z0, layout.disturbance)
    # A grid over all at once would have 18 to the power of their number.
    several = [d for d in disturbances_of(layout.model) if d.sigma in layout.disturbance]
    for d in several if len(several) > 1 else []:
        z = one_noise_guess(layout, data, noise, z, (d.sigma, d.tau))
    return z


def one_noise_guess(
    layout: Layout,
    data: Data,
    noise: Noise,
    z0: Float[Array, " q"],
    names: tuple[str, ...],
    width: float = 1.0,
) -> Float[Array, " q"]:
    """z0 with the named parameters of disturbances moved together, by the same factors of every
    sigma and of every tau, to the greatest likelihood on a coarse grid about it.

    Args:
        names: of the parameters; those that are no unknowns stay.
    """
    # Decades: from a disturbance far too faint the likelihood has no slope that leads back.
    steps = {
        "sigma": _DECADES,
        "tau": np.log(10.0) * np.arange(-1, 2),
    }
    # One factor for all sigmas and one for all taus: the grid stays two-dimensional however many
    # disturbances there are.
    kinds = {n: "sigma" if n in layout.sigmas else "tau" for n in layout.disturbance if n in names}
    used = [k for k in steps if k in kinds.values()]
    grid = np.stack(np.meshgrid(*(steps[k] for k in used), indexing="ij"), axis=-1)
    grid = grid.reshape(-1, len(used))
    points = np.tile(np.asarray(z0), (grid.shape[0], 1))
    for name, kind in kinds.items():
        points[:, layout.disturbance_at(name)] += width * grid[:, used.index(kind)]
    costs = np.asarray(costs_at(layout, data, noise, jnp.asarray(points, z0.dtype)))
    # A filter may overflow at the ends of the grid: such a point is no candidate, and no failure.
    best = int(np.argmin(np.where(np.isfinite(costs), costs, np.inf)))
    return jnp.asarray(points[best], z0.dtype)


def finer_noise_guess(
    layout: Layout, data: Data, noise: Noise, z: Float[Array, " q"]
) -> Float[Array, " q"]:
    """z with each disturbance of the greatest likelihood about it, to a tenth of a decade or so."""
    # As many points as the coarse search has: what was compiled for it serves here too.
    for _ in range(_ROUNDS):
        for d in disturbances_of(layout.model):
            if {d.sigma, d.tau} & set(layout.disturbance):
                z = one_noise_guess(layout, data, noise, z, (d.sigma, d.tau), _FINER)
    return z


@jitted
def costs_at(
    layout: Layout, data: Data, noise: Noise, points: Float[Array, "s q"]
) -> Float[Array, " s"]:
    """The mean of the squared rows at each of some points."""
    # One point after another: side by side they would need the memory of as many filters, for a
    # search of a few points.
    return jax.lax.map(lambda z: jnp.mean(jnp.square(rows_of(layout, data, noise, z))), points)


# A first guess of the time shift, with a single gain.


_SHIFTS = 41
"""time shifts tried first, 20 ms apart"""


def coarse_guess(
    layout: Layout, data: Data, noise: Noise, z0: Float[Array, " q"]
) -> Float[Array, " q"]:
    """z0 with the disturbance and the time shift from a coarse search each, and a single gain by
    linear least squares; what is not among the unknowns stays."""
    z0 = noise_guess_at(layout, data, noise, z0) if layout.disturbance else z0
    # A vehicle that is held through its instruments leaves a simulation by its inputs.
    by_inputs = data.flights[0].by_instrument is None
    if not (by_inputs and (layout.shift or len(layout.gains) == 1)):
        return z0
    grid = (
        np.linspace(-_SHIFT_RANGE, _SHIFT_RANGE, _SHIFTS) * MAX_TIME_SHIFT
        if layout.shift
        else np.zeros(1)
    )
    # A misfit has a valley for every period of the motion by which the shift is wrong: the grid
    # finds the deepest. It ends short of the bounds, at which the coordinate is infinite.
    coordinate = np.arctanh(grid / MAX_TIME_SHIFT)
    costs, gains = _scan(layout, data, noise, z0, jnp.asarray(coordinate, z0.dtype))
    costs = np.where(np.isfinite(costs), costs, np.inf)
    best = int(np.argmin(costs))
    if not np.isfinite(costs[best]):
        return z0
    q = len(layout.free)
    if len(layout.gains) == 1:
        z0 = z0.at[q].set(gains[best])
    if layout.shift:
        z0 = z0.at[q + len(layout.gains)].set(coordinate[best])
    return z0


@eqx.filter_jit
def _scan(
    layout: Layout, data: Data, noise: Noise, z0: Array, shifts: Array
) -> tuple[Array, Array]:
    """Cost and best single gain for each time shift.

    Means are taken off both signals: biases are not known yet.
    """
    q = len(layout.free)

    def at(shift: Array) -> tuple[Array, Array]:
        z = z0.at[q + len(layout.gains)].set(shift) if layout.shift else z0
        runs = predict(layout, data, unpack(layout, data, z))
        ys, ms = [], []
        for flight, names, run, s in zip(data.flights, layout.outputs, runs, noise.sd, strict=True):
            for n, y in flight.outputs.items():
                m = run.outputs[names.index(n)]
                seen = jnp.isfinite(y)
                # Over the noise, as in the fit itself: otherwise the output with the largest
                # numbers would choose the time shift.
                ys.append(_centred(y, seen) / s[n])
                ms.append(_centred(m, seen) / s[n])
        y, m = jnp.concatenate(ys), jnp.concatenate(ms)
        # The simulation is linear in a single gain, so that its best value is a quotient.
        gain = jnp.ones_like(y[0])
        if len(layout.gains) == 1:
            power = jnp.sum(m * m)
            gain = jnp.where(power > 0, jnp.sum(y * m) / jnp.where(power > 0, power, 1.0), gain)
        return jnp.mean(jnp.square(y - gain * m)), gain

    return jax.lax.map(at, shifts)


def _centred(signal: Array, seen: Array) -> Array:
    """Less its mean over the samples seen; zero elsewhere."""
    mean = jnp.sum(jnp.where(seen, signal, 0.0)) / jnp.sum(seen.astype(signal.dtype))
    return jnp.where(seen, signal - mean, 0.0)


# Starts about the given one, drawn within the bounds.


def draw(
    layout: Layout, problem: Problem, z0: Float[Array, " q"], starts: int, seed: int
) -> Float[Array, "s q"]:
    """Starts (s, q): the first is z0, the others differ in the free parameters.

    Between two bounds of one sign the draw is uniform in log, between two of different sign
    uniform; elsewhere log-normal about the start, a factor of three wide or as wide as the prior,
    and of either sign where that may be any.
    """
    rng = np.random.default_rng(seed)
    rows = np.tile(np.asarray(z0, dtype=np.float64), (max(starts, 1), 1))
    for i, (free, kind) in enumerate(zip(problem.free.values(), layout.kinds, strict=True)):
        values = _draw_values(free, rows.shape[0] - 1, rng)
        rows[1:, i] = transforms.coordinates(free, kind, values)
    return jnp.asarray(rows, z0.dtype)


def _draw_values(free: Free, size: int, rng: np.random.Generator) -> np.ndarray:
    # Off the bounds, where a bounded coordinate has no slope left.
    share = rng.uniform(0.02, 0.98, size)
    low, high = free.lower, free.upper
    if low is not None and high is not None:
        if low * high > 0:
            return low * (high / low) ** share
        return low + (high - low) * share
    width = 1.1  # e^1.1 is a factor of three
    if free.prior is not None and free.prior.mean:
        # Twice the prior: a start beyond would only be pulled back.
        width = min(width, 2.0 * free.prior.sd / abs(free.prior.mean))
    # Log-normal: a parameter of physics is more likely wrong by a factor than by an amount, and
    # keeps its sign.
    values = free.start * np.exp(width * rng.standard_normal(size))
    if transforms.changes_sign(free):
        # As large as the start; about the prior's mean where there is one, which knows more.
        drawn = rng.standard_normal((2, size))
        values = transforms.scale(free) * np.exp(width * drawn[0]) * np.sign(drawn[1])
        if free.prior is not None:
            values = free.prior.mean + 2.0 * free.prior.sd * drawn[0]
    # A single bound does not shape the draw: what lies beyond it begins at the start value instead.
    return np.where([transforms.inside(free, float(v)) for v in values], values, free.start)


# The start where a delay is free: a misfit has a valley for each period of the motion by which a
# delay is wrong, and in a loop a narrow one about the truth alone.
#
# The misfit is scanned over each delay with the other unknowns solved for at each of its values by
# a Gauss-Newton step (variable projection: Golub and Pereyra, 1973).


_EARLIEST, _LATEST = -0.1, 0.2
"""s: range of a delay without bounds; to twice its start at least"""
_SHIFT_RANGE = 0.8
"""of the largest time shift: at the bounds themselves the coordinate is infinite"""
_OFF_BOUNDS = 0.02
"""of the range between two bounds, for the same reason"""
_FIRST = 0.2
"""of a step: the least value of a delay that is positive"""
_STEP = 1.4
"""rad: of the motion that a delay shifts, between two values of it; a valley is a half turn wide"""
_FEWEST, _MOST = 5, 64
"""values of a delay"""
_DAMPING = 1e-3
"""of the Gauss-Newton step, in columns of norm 1"""
_FACTOR = 2.0
"""of a logarithm: the farthest that one step takes it"""
_PARTS = (1.0, 0.25, 0.06)
"""of the step, of which the first that leads down is taken"""


type _Tried = tuple[float, np.ndarray]
"""sum of squares at a point, and the point"""


def delay_start(
    problem: Problem,
    layout: Layout,
    data: Data,
    noise: Noise,
    z0: Float[Array, " q"],
    J: Float[np.ndarray, "n q"],
) -> Float[Array, " q"]:
    """z0, or where a delay or the time shift is free the deepest valley of the misfit over it; J is
    the Jacobian at z0."""

    def evaluate(z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        at = residual_and_jacobian(layout, data, noise, jnp.asarray(z, z0.dtype))
        return np.asarray(at.r, np.float64), np.asarray(at.J, np.float64)

    best = (np.inf, np.asarray(z0, np.float64))
    for i, values in _grids(problem, layout, data, J).items():
        tried = [_solved(layout, evaluate, best[1], i, value) for value in values]
        best = min([best, *tried], key=lambda t: t[0])
    return jnp.asarray(best[1], z0.dtype)


def _grids(problem: Problem, layout: Layout, data: Data, J: np.ndarray) -> dict[int, np.ndarray]:
    """The coordinates to try by number of the unknown, in increasing order."""
    grids = {}
    for name in problem.model.delay_parameters:
        if name not in problem.free:
            continue
        free, i = problem.free[name], layout.free.index(name)
        low, high = transforms.limits(free)
        step = _step(layout, data, J, i)
        if np.isfinite(low) and np.isfinite(high):
            low, high = low + _OFF_BOUNDS * (high - low), high - _OFF_BOUNDS * (high - low)
        else:
            early = _EARLIEST if transforms.changes_sign(free) else _FIRST * step
            low, high = max(low, min(early, free.start)), min(high, max(_LATEST, 2.0 * free.start))
        values = np.unique([free.start, *_between(low, high, step)])
        values = values[[transforms.inside(free, float(v)) for v in values]]
        grids[i] = transforms.coordinates(free, layout.kinds[i], values)
    if layout.shift:
        i = len(layout.free) + len(layout.gains)
        ends = -_SHIFT_RANGE * MAX_TIME_SHIFT, _SHIFT_RANGE * MAX_TIME_SHIFT
        values = _between(*ends, _step(layout, data, J, i))
        grids[i] = np.arctanh(values / MAX_TIME_SHIFT)
    return grids


def _between(low: float, high: float, step: float) -> np.ndarray:
    return np.linspace(low, high, int(np.clip(np.ceil((high - low) / step) + 1, _FEWEST, _MOST)))


def _step(layout: Layout, data: Data, J: np.ndarray, i: int) -> float:
    """The step between values of a delay [s], by how fast its effect on the rows changes."""
    dt = min(float(f.dt) for f in data.flights)
    if layout.noise_model != "white":
        return dt
    signal = signal_numbers(layout, data)
    effect = np.asarray(J[: signal.size, i], np.float64)
    moves = np.diff(effect)[np.diff(signal) == 0]
    with np.errstate(all="ignore"):
        step = _STEP * dt * np.linalg.norm(effect) / np.linalg.norm(moves)
    return max(dt, float(step)) if np.isfinite(step) else dt


def _solved(
    layout: Layout,
    evaluate: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]],
    z0: np.ndarray,
    i: int,
    value: float,
) -> _Tried:
    """The point with the i-th unknown at a value and the others one Gauss-Newton step on."""
    z = z0.copy()
    z[i] = value
    r, J = evaluate(z)
    if not (np.isfinite(r).all() and np.isfinite(J).all()):
        return np.inf, z
    cost = float(r @ r)
    J = J * (np.arange(z.size) != i)
    norms = np.linalg.norm(J, axis=0)
    norms = np.where(norms > 0, norms, 1.0)
    A = J / norms
    step = -np.linalg.solve(A.T @ A + _DAMPING * np.eye(z.size), A.T @ r) / norms
    logarithm = (np.arange(z.size) < layout.first_nuisance) & ~without_size(layout)
    step = np.where(logarithm, np.clip(step, -_FACTOR, _FACTOR), step)
    for part in _PARTS:
        r, _ = evaluate(z + part * step)
        if np.isfinite(r).all() and r @ r < cost:
            return float(r @ r), z + part * step
    return cost, z
