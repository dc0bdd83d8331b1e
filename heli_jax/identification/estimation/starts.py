"""Start points of a search: coarse searches of disturbances and delays, and random draws."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from heli_jax.dynamics.disturbance import disturbances_of
from heli_jax.identification.estimation.levenberg_marquardt import optimise
from heli_jax.identification.estimation.residual import cost_of
from heli_jax.identification.estimation.simulated_flights import signal_numbers
from heli_jax.identification.problem import MAX_TIME_SHIFT, Free, Problem
from heli_jax.identification.unknowns import transforms
from heli_jax.identification.unknowns.layout import Data, Layout, Noise
from heli_jax.numerics.jitted import jitted

# First guess of the disturbances: the greatest likelihood on a coarse grid.


_DECADES = {"sigma": np.arange(-3.0, 2.5), "tau": np.arange(-1.0, 2.0)}
"""Decades by which the coarse search moves the parameters. For a far too small disturbance the
likelihood has no slope towards the optimum."""
_FINER, _ROUNDS = 0.2, 3
"""Step [decades] and rounds of the finer search; a round reaches 0.4 decades up and 0.6 down."""


def noise_guess_at(
    layout: Layout, data: Data, noise: Noise, z: Float[Array, " q"], *, finer: bool = False
) -> Float[Array, " q"]:
    """Return z with the sigma_w and tau_w of greatest likelihood on a coarse grid around it.

    Several disturbances are first moved together, then each alone.

    Args:
        finer: refine each disturbance to about a tenth of a decade.
    """
    each = [(d.sigma, d.tau) for d in disturbances_of(layout.model)]
    each = [names for names in each if set(names) & set(layout.disturbance)]
    # A grid over all n disturbances at once would have 18^n points.
    coarse = [layout.disturbance, *(each if len(each) > 1 else [])]
    for names in coarse:
        z = _best_on_grid(layout, data, noise, z, names, 1.0)
    for names in each * _ROUNDS if finer else []:
        z = _best_on_grid(layout, data, noise, z, names, _FINER)
    return z


def _best_on_grid(
    layout: Layout, data: Data, noise: Noise, z0: Array, names: tuple[str, ...], width: float
) -> Array:
    """Return z0 with the named parameters moved to the best point of a grid.

    All sigmas move by a common factor, and so do all taus.

    Args:
        width: scale of the decades.
    """
    kinds = {n: "sigma" if n in layout.sigmas else "tau" for n in layout.disturbance if n in names}
    used = [k for k in _DECADES if k in kinds.values()]
    grid = np.stack(np.meshgrid(*(_DECADES[k] for k in used), indexing="ij"), axis=-1)
    grid = width * np.log(10.0) * grid.reshape(-1, len(used))
    points = np.tile(np.asarray(z0), (grid.shape[0], 1))
    for name, kind in kinds.items():
        points[:, layout.disturbance_at(name)] += grid[:, used.index(kind)]
    costs = np.asarray(_costs_at(layout, data, noise, jnp.asarray(points, z0.dtype)))
    # A filter may overflow at the ends of the grid; such points are no candidates.
    best = int(np.argmin(np.where(np.isfinite(costs), costs, np.inf)))
    return jnp.asarray(points[best], z0.dtype)


@jitted
def _costs_at(
    layout: Layout, data: Data, noise: Noise, points: Float[Array, "s q"]
) -> Float[Array, " s"]:
    """Return the cost at each point."""
    # Points are evaluated in sequence, because a batch would need one filter's memory for each.
    return jax.lax.map(lambda z: cost_of(layout, data, noise, z), points)


# Starts drawn around the stated one, within the bounds.


def draw(
    layout: Layout, problem: Problem, z0: Float[Array, " q"], starts: int, seed: int
) -> Float[Array, "s q"]:
    """Draw starts (s, q): the first is z0, the others differ in the free parameters.

    Between two bounds of one sign the draw is uniform in the logarithm, between bounds of different
    sign uniform. Otherwise it is log-normal around the start, with a width of a factor of three or
    of the prior. The sign is random if any is allowed.
    """
    rng = np.random.default_rng(seed)
    rows = np.tile(np.asarray(z0, dtype=np.float64), (max(starts, 1), 1))
    for i, (free, kind) in enumerate(zip(problem.free.values(), layout.kinds, strict=True)):
        values = _draw_values(free, rows.shape[0] - 1, rng)
        rows[1:, i] = transforms.coordinates(free, kind, values)
    return jnp.asarray(rows, z0.dtype)


def _draw_values(free: Free, size: int, rng: np.random.Generator) -> np.ndarray:
    # The draw avoids the bounds.
    share = rng.uniform(0.02, 0.98, size)
    low, high = free.lower, free.upper
    if low is not None and high is not None:
        if low * high > 0:
            return low * (high / low) ** share
        return low + (high - low) * share
    width = 1.1  # e^1.1 is a factor of three
    if free.prior is not None and free.prior.mean:
        # Beyond twice its width the prior would pull a start back.
        width = min(width, 2.0 * free.prior.sd / abs(free.prior.mean))
    # Physical parameters are more likely wrong by a factor than by an amount, and keep their sign.
    values = free.start * np.exp(width * rng.standard_normal(size))
    if transforms.changes_sign(free):
        # The draw has the size of the start, or is around the mean of the prior.
        drawn = rng.standard_normal((2, size))
        values = transforms.scale(free) * np.exp(width * drawn[0]) * np.sign(drawn[1])
        if free.prior is not None:
            values = free.prior.mean + 2.0 * free.prior.sd * drawn[0]
    # The start replaces a value beyond a single bound.
    return np.where([transforms.inside(free, float(v)) for v in values], values, free.start)


# Start of a free delay. The misfit has a minimum at each period of the motion, and in a closed loop
# a narrow one near the truth only. So the misfit is scanned over each delay, and the other unknowns
# take a step at each value (variable projection: Golub and Pereyra, 1973).


_EARLIEST, _LATEST = -0.1, 0.2
"""Range of a delay without bounds [s], extended to at least twice its start."""
_SHIFT_RANGE = 0.8
"""Fraction of the largest time shift, because the coordinate is infinite at the bounds."""
_OFF_BOUNDS = 0.02
"""Distance from bounds as a fraction of their range, for the same reason."""
_FIRST = 0.2
"""Least value of a positive delay, as a fraction of a step."""
_STEP = 1.4
"""Phase of the delayed motion between two values of the delay [rad]; a minimum is a half turn
wide."""
_FEWEST, _MOST = 5, 64
"""Fewest and most values of a delay."""
_EVALUATIONS = 4
"""Evaluations of the optimiser at each value: a step, and two shorter ones if it is rejected."""


def delay_start(
    problem: Problem,
    layout: Layout,
    data: Data,
    noise: Noise,
    z0: Float[Array, " q"],
    J: Float[np.ndarray, "n q"],
) -> Float[Array, " q"]:
    """Return z0, or the deepest minimum of the misfit over a free delay or time shift.

    Args:
        J: the Jacobian at z0.
    """
    least, best = np.inf, z0
    for i, values in _grids(problem, layout, data, J).items():
        start, held = best, np.arange(layout.size) == i
        for value in values:
            run = optimise(layout, data, noise, start.at[i].set(value), _EVALUATIONS, held=held)
            if run.cost < least:
                least, best = run.cost, run.z
    return best


def _grids(problem: Problem, layout: Layout, data: Data, J: np.ndarray) -> dict[int, np.ndarray]:
    """Return the coordinates to try, in increasing order, by index of the unknown."""
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
    """Return the step between values of a delay [s], from how fast the rows change with it."""
    dt = min(float(f.dt) for f in data.flights)
    if layout.noise_model != "white":
        return dt
    signal = signal_numbers(layout, data)
    effect = np.asarray(J[: signal.size, i], np.float64)
    moves = np.diff(effect)[np.diff(signal) == 0]
    with np.errstate(all="ignore"):
        step = _STEP * dt * np.linalg.norm(effect) / np.linalg.norm(moves)
    return max(dt, float(step)) if np.isfinite(step) else dt
