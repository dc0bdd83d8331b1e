"""Where the optimiser starts and how it is run: a first guess, several starts, bounds."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from heli_jax.dynamics.disturbance import disturbances_of
from heli_jax.dynamics.model import Disturbance
from heli_jax.identification.estimation.estimator import Evaluation
from heli_jax.identification.estimation.levenberg_marquardt import (
    Optimum,
    measured_count,
    optimise,
    residual_and_jacobian,
)
from heli_jax.identification.estimation.optimiser_step import Nearing
from heli_jax.identification.estimation.residual import rows_of
from heli_jax.identification.estimation.simulated_flights import predict
from heli_jax.identification.problem import MAX_TIME_SHIFT, Problem
from heli_jax.identification.unknowns import transforms as coordinates
from heli_jax.identification.unknowns.layout import Data, Layout, Noise, unpack, within_bounds
from heli_jax.numerics.jitted import jitted

# A first guess of the disturbances: the greatest likelihood on a coarse grid.


_DECADES = np.log(10.0) * np.arange(-3.0, 2.5)
"""by which the coarse search moves sigma_w"""
_FINER, _ROUNDS = 0.2, 3
"""decades between the points of a finer search, and how often it is done: a round reaches 0.4
decades up and 0.6 down"""
_TAUS = 3
"""correlation times between a few samples and a part of the record, from which a search that ran
to an end is begun again; with the decades as many points as the coarse search has"""


def noise_guess_at(
    layout: Layout, data: Data, noise: Noise, z0: Float[Array, " q"]
) -> Float[Array, " q"]:
    """z0 with sigma_w and tau_w of the greatest likelihood on a coarse grid about it; of several
    disturbances first all together, then each by itself.

    Args:
        layout: what the unknowns are.
        data: the numbers of the problem.
        noise: of the measurements.
        z0: where the grid has its middle.
    """
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
        layout: what the unknowns are.
        data: the numbers of the problem.
        noise: of the measurements.
        z0: where the grid has its middle.
        names: of the parameters; those that are no unknowns stay.
        width: of the grid, in decades between its points.
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
    """z with each disturbance of the greatest likelihood about it, to a tenth of a decade or so.

    Args:
        layout: what the unknowns are.
        data: the numbers of the problem.
        noise: of the measurements.
        z: of the coarse search.
    """
    # As many points as the coarse search has: what was compiled for it serves here too.
    for _ in range(_ROUNDS):
        for d in disturbances_of(layout.model):
            if {d.sigma, d.tau} & set(layout.disturbance):
                z = one_noise_guess(layout, data, noise, z, (d.sigma, d.tau), _FINER)
    return z


def noise_guesses_by_tau(
    layout: Layout, data: Data, noise: Noise, z0: Float[Array, " q"], d: Disturbance
) -> list[Float[Array, " q"]]:
    """z0 with one disturbance at correlation times from five samples to a fifth of the longest
    record, sigma_w of the greatest likelihood on a coarse grid for each; the most likely first.

    Args:
        layout: what the unknowns are, d.tau among them.
        data: the numbers of the problem.
        noise: of the measurements.
        z0: where the grid of sigma_w has its middle.
        d: the disturbance.
    """
    dt = min(float(f.dt) for f in data.flights)
    longest = max(float(f.dt) * next(iter(f.outputs.values())).shape[0] for f in data.flights)
    first, last = sorted((5.0 * dt, 0.2 * longest))
    decades = _DECADES if d.sigma in layout.disturbance else np.zeros(1)
    points = np.tile(np.asarray(z0), (_TAUS, decades.size, 1))
    points[..., layout.disturbance_at(d.tau)] = np.log(np.geomspace(first, last, _TAUS))[:, None]
    if d.sigma in layout.disturbance:
        points[..., layout.disturbance_at(d.sigma)] += decades
    flat = jnp.asarray(points.reshape(-1, points.shape[-1]), z0.dtype)
    costs = np.asarray(costs_at(layout, data, noise, flat)).reshape(points.shape[:2])
    costs = np.where(np.isfinite(costs), costs, np.inf)
    best = points[np.arange(_TAUS), np.argmin(costs, axis=1)]
    return [jnp.asarray(best[i], z0.dtype) for i in np.argsort(costs.min(axis=1))]


@jitted
def costs_at(
    layout: Layout, data: Data, noise: Noise, points: Float[Array, "s q"]
) -> Float[Array, " s"]:
    """The mean of the squared rows at each of some points.

    Args:
        layout: what the unknowns are.
        data: the numbers of the problem.
        noise: of the measurements.
        points: in the layout's coordinates.
    """
    # One point after another: side by side they would need the memory of as many filters, for a
    # search of a few points.
    return jax.lax.map(lambda z: jnp.mean(jnp.square(rows_of(layout, data, noise, z))), points)


Progress = Callable[[str], None]


class StartRow(NamedTuple):
    """Where one start led."""

    start: dict[str, float]
    end: dict[str, float]
    cost: float
    steps: int
    converged: bool
    optimum: int
    """1 for the best optimum, 2 for the next, ...; 0 where it did not converge"""


_SHIFTS = 41
"""time shifts tried first, 20 ms apart"""
_NEAR = 0.1
"""standard deviations from the optimum at which it counts as reached"""
_AGAIN = 3
"""times that an optimiser which stopped short of the optimum is sent on"""
_GOOD = 10.0
"""cost up to which a run explains something whatever there is to explain"""
_FAINT = 0.3
"""one over the sd of the logarithm of a disturbance's parameter below which it is none"""


def first_guess(
    layout: Layout, data: Data, noise: Noise, z0: Float[Array, " q"]
) -> Float[Array, " q"]:
    """z0 with the disturbance and the time shift from a coarse search each, and a single gain by
    linear least squares; what is not among the unknowns stays.

    Args:
        layout: what the unknowns are.
        data: the numbers of the problem.
        noise: of the measurements.
        z0: the start values.
    """
    z0 = noise_guess_at(layout, data, noise, z0) if layout.disturbance else z0
    if not (layout.shift or len(layout.gains) == 1):
        return z0
    grid = np.linspace(-0.8, 0.8, _SHIFTS) * MAX_TIME_SHIFT if layout.shift else np.zeros(1)
    # A misfit has a valley for every period of the motion by which the shift is wrong: the grid
    # finds the deepest. It ends short of the bounds, at which the coordinate is infinite.
    coordinate = np.arctanh(grid / MAX_TIME_SHIFT)
    if data.flights[0].by_instrument is not None and not layout.gains:
        # By the rows: of a machine that somebody holds a simulation by its inputs drifts off.
        points = np.tile(np.asarray(z0), (_SHIFTS, 1))
        points[:, len(layout.free)] = coordinate
        costs, gains = costs_at(layout, data, noise, jnp.asarray(points, z0.dtype)), coordinate
    else:
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


class Search:
    """The optimiser over a problem: log coordinates first, bounded ones where that leaves them.

    An optimum inside the bounds is the same in any coordinates; the bounded ones are needed, and
    compiled, only where the free optimum lies outside.
    """

    def __init__(self, problem: Problem, layout: Layout, data: Data, max_steps: int) -> None:
        self.problem, self.layout, self.data = problem, layout, data
        self.max_steps = max_steps
        self.bounded = within_bounds(layout, problem)

    def run(
        self,
        noise: Noise,
        points: Float[Array | np.ndarray, "s q"],
        progress: Progress | None = None,
        *,
        nearing: Nearing | None = None,
        known: tuple[Array, Array] | None = None,
    ) -> list[Optimum]:
        """An optimum for each start, all in the coordinates of `layout`.

        Args:
            noise: of the measurements, by which the rows are divided.
            points: the starts.
            progress: called with a sentence after each of several starts.
            nearing: how to end where another search follows; as near as it gets unless given.
            known: residuals and Jacobian at the first start, where they are at hand.
        """
        # One of them is taken out of NumPy's arrays in no time.
        ends, points = (nearing, known), np.asarray(points)
        runs = self._run(self.layout, noise, points, progress, ends)
        # An optimiser can arrive where nothing is explained: a gradient of zero says nothing of how
        # good a place is.
        runs = [self._better_than_nothing(run, noise) for run in runs]
        # Where one stayed its end may be the start itself, of NumPy.
        runs = [run._replace(z=jnp.asarray(run.z)) for run in runs]
        if self.bounded.kinds == self.layout.kinds:
            return runs
        # What left its bounds begins anew from its start, in coordinates that cannot leave them.
        left = [i for i, run in enumerate(runs) if not self._inside(run.z)]
        if left:
            starts = np.stack([self._convert(points[i], self.layout, self.bounded) for i in left])
            again = self._run(self.bounded, noise, starts, progress, (nearing, None))
            for i, run in zip(left, again, strict=True):
                runs[i] = run._replace(z=self._convert(run.z, self.bounded, self.layout))
        return runs

    def _run(
        self,
        layout: Layout,
        noise: Noise,
        points: np.ndarray,
        progress: Progress | None,
        ends: tuple[Nearing | None, tuple[Array, Array] | None],
    ) -> list[Optimum]:
        # One after another: on two cores a vmap over the starts, which goes on until the slowest
        # has converged, took four times as long as this, and had to be compiled besides.
        runs = []
        for i in range(points.shape[0]):
            optimum = optimise(
                layout,
                self.data,
                noise,
                points[i],
                self.max_steps,
                held=self._held,
                nearing=ends[0],
                known=ends[1] if i == 0 else None,
            )
            # z stays on the device, from where the next program takes it.
            run = jax.device_get(optimum)._replace(z=optimum.z)
            if not bool(run.converged) and layout.estimator.least_squares:
                near = np.isfinite(run.cost) and self._is_near(layout, noise, run.z)
                run = run._replace(converged=np.asarray(near))
            run = self._arrived(layout, noise, run)
            runs.append(run)
            if progress is not None and points.shape[0] > 1:
                progress(f"{i + 1} of {points.shape[0]} starts done")
        return runs

    @property
    def _held(self) -> np.ndarray | None:
        """What the optimiser leaves where it is."""
        layout = self.layout
        # Their weak priors alone would lead the initial states to zero: for a machine that is not
        # linear, with a rotor that stands still, a place from which no search in time comes back.
        if layout.model.linear or layout.estimator.nuisances_in_rows:
            return None
        return np.arange(layout.size) >= layout.first_nuisance

    def _arrived(self, layout: Layout, noise: Noise, run: Optimum) -> Optimum:
        """A run with several noises, gone on with until no step would gain anything.

        The optimiser stops where its last step moved no parameter; next to variances that vanish
        that step may have been short for another reason.
        """
        if len(layout.sizes) < 2:
            return run
        for _ in range(_AGAIN):
            at = residual_and_jacobian(layout, self.data, noise, run.z)
            J, faint = np.asarray(at.J), np.zeros(run.z.shape[0], bool)
            noises = slice(len(layout.of_interest), len(layout.of_interest) + len(layout.noises))
            # Of a variance that vanishes the slope says less than its bounds do.
            faint[noises] = ~(np.linalg.norm(J[:, noises], axis=0) > _FAINT)
            gain = gauss_newton_gain(at.r, J[:, ~faint])
            if not (bool(run.converged) and gain > _NEAR**2):
                break
            again = optimise(layout, self.data, noise, run.z, self.max_steps)
            steps = run.steps + again.steps
            run = jax.device_get(again)._replace(z=again.z, steps=np.asarray(steps))
        return run

    def _is_near(self, layout: Layout, noise: Noise, z: Array) -> bool:
        """Whether the optimum is within a tenth of a standard deviation of every unknown.

        Along a valley that weak priors alone close the optimiser goes on in steps that change no
        likelihood. What a Gauss-Newton step would gain there is the squared distance to the
        optimum in standard deviations of whichever unknown lies furthest.
        """
        at = residual_and_jacobian(layout, self.data, noise, z)
        gain = gauss_newton_gain(at.r, at.J)
        return bool(np.isfinite(gain) and gain < _NEAR**2)

    def _better_than_nothing(self, run: Optimum, noise: Noise) -> Optimum:
        """A run that ends worse than no model at all (an unstable one, say) did not converge."""
        if run.cost <= _GOOD:
            return run
        # The cost is a mean over the measured numbers, so this is one too.
        nothing = self.misfit_of_nothing(noise) / measured_count(self.data)
        return run._replace(converged=run.converged & (run.cost <= 1.5 * nothing + _GOOD))

    def misfit_of_nothing(self, noise: Noise) -> float:
        """Sum of squares that a model without any response leaves."""
        power = [
            float(np.nansum(np.square(np.asarray(y) / np.asarray(s[n]))))
            for flight, s in zip(self.data.flights, noise.sd, strict=True)
            for n, y in flight.outputs.items()
        ]
        return sum(power)

    def variation(self, noise: Noise) -> float:
        """Sum of squares that the outputs' means leave."""
        return sum(
            float(np.nansum(np.square((y - np.nanmean(y)) / np.asarray(s[n]))))
            for flight, s in zip(self.data.flights, noise.sd, strict=True)
            for n, y in ((n, np.asarray(y)) for n, y in flight.outputs.items())
        )

    def _inside(self, z: Array) -> bool:
        values = named_values(self.layout, self.data, z)
        return all(
            not np.isfinite(v) or coordinates.inside(f, float(v))
            for f, v in zip(self.problem.free.values(), values.values(), strict=True)
        )

    def _convert(self, z: Array | np.ndarray, old: Layout, new: Layout) -> Array:
        """The same point in another layout's coordinates; a value at a bound is moved inside."""
        z = jnp.asarray(z)
        for i, (free, value) in enumerate(
            zip(self.problem.free.values(), named_values(old, self.data, z).values(), strict=True)
        ):
            low, high = (float(b) for b in coordinates.limits(free))
            if np.isfinite(low) and np.isfinite(high):
                # At a bound itself the bounded coordinate is infinite.
                edge = 1e-9 * (high - low)
                value = min(max(value, low + edge), high - edge)
            limits = (self.data.sign[i], self.data.low[i], self.data.high[i])
            x = jnp.asarray(value, z.dtype)
            z = z.at[i].set(coordinates.to_coordinate(new.kinds[i], x, *limits))
        return z


def gauss_newton_gain(r: Array | np.ndarray, J: Array | np.ndarray) -> float:
    """By how much a Gauss-Newton step lowers the sum of squares of residuals r (n,) with the
    Jacobian J (n, q), as the linear model of them has it; NaN where either is not finite."""
    r, J = np.asarray(r, np.float64), np.asarray(J, np.float64)
    if not (np.isfinite(r).all() and np.isfinite(J).all()):
        return float("nan")
    # The step takes away the part of r that lies in the span of J's columns.
    norms = np.linalg.norm(J, axis=0)
    Q, _ = np.linalg.qr(J / np.where(norms > 0, norms, 1.0))
    return float(np.sum((Q.T @ r) ** 2))


def named_values(
    layout: Layout, data: Data, z: Float[Array | np.ndarray, " q"]
) -> dict[str, float]:
    """The free parameters' values at z, by name, SI.

    Args:
        layout: what the unknowns are.
        data: the numbers of the problem.
        z: the unknowns.
    """
    at, sign, low, high = (np.asarray(v) for v in (z, data.sign, data.low, data.high))
    return {
        n: float(coordinates.to_value(kind, at[i], sign[i], low[i], high[i]))
        for i, (n, kind) in enumerate(zip(layout.free, layout.kinds, strict=True))
    }


def table(
    layout: Layout, data: Data, points: Float[Array, "s q"], runs: list[Optimum]
) -> tuple[StartRow, ...]:
    """Start, end and cost of every run, best first; equal optima share a number.

    Args:
        layout: what the unknowns are.
        data: the numbers of the problem.
        points: where the runs began.
        runs: their ends, in the same order.
    """
    order = sorted(range(len(runs)), key=lambda i: rank(runs[i]))
    rows, optimum, last = [], 0, None
    for i in order:
        cost, converged = _cost(runs[i]), bool(runs[i].converged)
        # By their costs: along a direction that the data leave open, equal optima differ in place.
        if converged and (last is None or cost > last * (1.0 + 1e-6) + 1e-300):
            optimum, last = optimum + 1, cost
        rows.append(
            StartRow(
                named_values(layout, data, points[i]),
                named_values(layout, data, runs[i].z),
                cost,
                int(runs[i].steps),
                converged,
                optimum if converged else 0,
            )
        )
    return tuple(rows)


def rank(run: Optimum) -> tuple[bool, float]:
    """Sorts runs: those that converged first, then by cost."""
    # False sorts before True.
    return not bool(run.converged), _cost(run)


def _cost(run: Optimum) -> float:
    # NaN would compare as neither better nor worse, and sort at random.
    cost = float(run.cost)
    return cost if np.isfinite(cost) else float("inf")


# The search from the start values, by what takes least time to search with.


class FirstGuess(NamedTuple):
    """A problem at its first guess."""

    layout: Layout
    data: Data
    noise: Noise
    z: Float[Array, " q"]
    e: Evaluation
    begun: Data
    """what the first search goes by"""


class FirstOptima(NamedTuple):
    """Where each start led, and by what."""

    search: Search
    noise: Noise
    points: Float[Array, "s q"]
    optima: list[Optimum]


def first_optima(
    search: Search,
    at: FirstGuess,
    starts: Callable[[Noise, tuple[Any, Any]], Float[Array, "s q"]],
    report: Progress | None = None,
) -> FirstOptima:
    """An optimum for each start, after which the noise is relaxed.

    Args:
        search: the optimiser over the problem.
        at: its first guess.
        starts: makes them of the noise to begin with, and of residuals and Jacobian at the guess.
        report: called with a sentence after each of several.
    """
    layout, estimator = at.layout, at.layout.estimator
    r_J: tuple[Any, Any] = (at.e.r, at.e.J)
    first = Search(search.problem, layout, at.begun, search.max_steps)
    quick, quickly = estimator.to_begin_with(layout, at.data, at.noise, at.z, r_J)
    points = starts(quick, quickly)

    def run(noise: Noise, known: tuple[Array, Array]) -> list[Optimum]:
        # Residuals at the first start are those of the first guess.
        same = at.begun is at.data and bool(np.array_equal(points[0], at.z))
        ends = known if same else None
        return first.run(noise, points, report, nearing=estimator.nearing, known=ends)

    optima = run(quick, quickly)
    # What a part of the data leads to nowhere may be found by all of them.
    if quick is not at.noise and not any(bool(o.converged) for o in optima):
        quick, optima = at.noise, run(at.noise, r_J)
    return FirstOptima(first, quick, points, optima)
