"""Points to start a search from: coarse searches of disturbances and delays, and draws."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from heli_jax.dynamics.disturbance import disturbances_of
from heli_jax.identification.estimation.levenberg_marquardt import optimise
from heli_jax.identification.estimation.residual import rows_of
from heli_jax.identification.estimation.simulated_flights import signal_numbers
from heli_jax.identification.problem import MAX_TIME_SHIFT, Free, Problem
from heli_jax.identification.unknowns import transforms
from heli_jax.identification.unknowns.layout import Data, Layout, Noise
from heli_jax.numerics.jitted import jitted

# A first guess of the disturbances: the greatest likelihood on a coarse grid.


_DECADES = {"sigma": np.arange(-3.0, 2.5), "tau": np.arange(-1.0, 2.0)}
"""by which the coarse search moves the parameters: from a disturbance far too faint the likelihood
has no slope that leads back"""
_FINER, _ROUNDS = 0.2, 3
"""decades between the points of a finer search, and how often it is done: a round reaches 0.4
decades up and 0.6 down"""


def noise_guess_at(
    layout: Layout, data: Data, noise: Noise, z: Float[Array, " q"], *, finer: bool = False
) -> Float[Array, " q"]:
    """Return z with sigma_w and tau_w of the greatest likelihood on a coarse grid about it.

    Several disturbances are moved first all together, then each by itself.

    Args:
        finer: search on, each by itself, to about a tenth of a decade.
    """
    each = [(d.sigma, d.tau) for d in disturbances_of(layout.model)]
    each = [names for names in each if set(names) & set(layout.disturbance)]
    # A grid over all at once would have 18 to the power of their number.
    coarse = [layout.disturbance, *(each if len(each) > 1 else [])]
    for names in coarse:
        z = _best_on_grid(layout, data, noise, z, names, 1.0)
    for names in each * _ROUNDS if finer else []:
        z = _best_on_grid(layout, data, noise, z, names, _FINER)
    return z


def _best_on_grid(
    layout: Layout, data: Data, noise: Noise, z0: Array, names: tuple[str, ...], width: float
) -> Array:
    """Return z0 with the named parameters moved by the same factors of every sigma and of every
    tau; `width` scales the decades."""
    kinds = {n: "sigma" if n in layout.sigmas else "tau" for n in layout.disturbance if n in names}
    used = [k for k in _DECADES if k in kinds.values()]
    grid = np.stack(np.meshgrid(*(_DECADES[k] for k in used), indexing="ij"), axis=-1)
    grid = width * np.log(10.0) * grid.reshape(-1, len(used))
    points = np.tile(np.asarray(z0), (grid.shape[0], 1))
    for name, kind in kinds.items():
        points[:, layout.disturbance_at(name)] += grid[:, used.index(kind)]
    costs = np.asarray(_costs_at(layout, data, noise, jnp.asarray(points, z0.dtype)))
    # A filter may overflow at the ends of the grid: such a point is no candidate, and no failure.
    best = int(np.argmin(np.where(np.isfinite(costs), costs, np.inf)))
    return jnp.asarray(points[best], z0.dtype)


@jitted
def _costs_at(
    layout: Layout, data: Data, noise: Noise, points: Float[Array, "s q"]
) -> Float[Array, " s"]:
    """Return the mean of the squared rows at each point."""
    # One point after another: side by side they would need the memory of as many filters.
    return jax.lax.map(lambda z: jnp.mean(jnp.square(rows_of(layout, data, noise, z))), points)


# Starts about the given one, drawn within the bounds.


def draw(
    layout: Layout, problem: Problem, z0: Float[Array, " q"], starts: int, seed: int
) -> Float[Array, "s q"]:
    """Draw starts (s, q): the first is z0, the others differ in the free parameters.

    Between two bounds of one sign the draw is uniform in log, between two of different sign
    uniform; else log-normal about the start, a factor of three wide or as wide as the prior, and of
    either sign where any is allowed.
    """
    rng = np.random.default_rng(seed)
    rows = np.tile(np.asarray(z0, dtype=np.float64), (max(starts, 1), 1))
    for i, (free, kind) in enumerate(zip(problem.free.values(), layout.kinds, strict=True)):
        values = _draw_values(free, rows.shape[0] - 1, rng)
        rows[1:, i] = transforms.coordinates(free, kind, values)
    return jnp.asarray(rows, z0.dtype)


def _draw_values(free: Free, size: int, rng: np.random.Generator) -> np.ndarray:
    # Not at the bounds.
    share = rng.uniform(0.02, 0.98, size)
    low, high = free.lower, free.upper
    if low is not None and high is not None:
        if low * high > 0:
            return low * (high / low) ** share
        return low + (high - low) * share
    width = 1.1  # e^1.1 is a factor of three
    if free.prior is not None and free.prior.mean:
        # Twice as wide as the prior: it would pull back a start beyond.
        width = min(width, 2.0 * free.prior.sd / abs(free.prior.mean))
    # Log-normal: a parameter of physics is more likely wrong by a factor than by an amount, and
    # keeps its sign.
    values = free.start * np.exp(width * rng.standard_normal(size))
    if transforms.changes_sign(free):
        # As large as the start, or about the mean of the prior.
        drawn = rng.standard_normal((2, size))
        values = transforms.scale(free) * np.exp(width * drawn[0]) * np.sign(drawn[1])
        if free.prior is not None:
            values = free.prior.mean + 2.0 * free.prior.sd * drawn[0]
    # A value beyond a single bound is replaced by the start.
    return np.where([transforms.inside(free, float(v)) for v in values], values, free.start)


# The start where a delay is free: a misfit has a valley for each period of the motion by which a
# delay is wrong, and in a loop a narrow one about the truth alone. The misfit is scanned over each
# delay, and the other unknowns take a step at each of its values (variable projection: Golub and
# Pereyra, 1973).


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
_EVALUATIONS = 4
"""of the optimiser at each value: a step, and two shorter ones where it is refused"""


def delay_start(
    problem: Problem,
    layout: Layout,
    data: Data,
    noise: Noise,
    z0: Float[Array, " q"],
    J: Float[np.ndarray, "n q"],
) -> Float[Array, " q"]:
    """Return z0, or where a delay or the time shift is free the deepest valley of the misfit over
    it; J is the Jacobian at z0."""
    least, best = np.inf, z0
    for i, values in _grids(problem, layout, data, J).items():
        start, held = best, np.arange(layout.size) == i
        for value in values:
            run = optimise(layout, data, noise, start.at[i].set(value), _EVALUATIONS, held=held)
            if run.cost < least:
                least, best = run.cost, run.z
    return best


def _grids(problem: Problem, layout: Layout, data: Data, J: np.ndarray) -> dict[int, np.ndarray]:
    """Return the coordinates to try, in increasing order, by number of the unknown."""
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
    """Return the step between values of a delay [s], by how fast its effect on the rows changes."""
    dt = min(float(f.dt) for f in data.flights)
    if layout.noise_model != "white":
        return dt
    signal = signal_numbers(layout, data)
    effect = np.asarray(J[: signal.size, i], np.float64)
    moves = np.diff(effect)[np.diff(signal) == 0]
    with np.errstate(all="ignore"):
        step = _STEP * dt * np.linalg.norm(effect) / np.linalg.norm(moves)
    return max(dt, float(step)) if np.isfinite(step) else dt
