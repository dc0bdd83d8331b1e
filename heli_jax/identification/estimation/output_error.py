"""Output error: the simulation against what was measured, (measured - bias - simulated) / sd.

Maximum likelihood where the measurement noise is white and nothing disturbs the vehicle (Maine and
Iliff, 1985; Jategaonkar, 2006, chapter 4). With windows (multiple shooting; Bock, 1983) also the
defects between them.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from heli_jax.identification.estimation.objective import Objective
from heli_jax.identification.estimation.residual import Residuals
from heli_jax.identification.estimation.simulated_flights import (
    Run,
    measured_signals,
    predict,
    signal_numbers,
)
from heli_jax.identification.unknowns.layout import Data, Layout, Noise, Solution, Unknowns, unpack
from heli_jax.numerics.jitted import jitted


class OutputError(Objective):
    """The simulation, driven by the logged inputs alone, against the measured outputs."""

    def residuals(self, layout: Layout, data: Data, noise: Noise, u: Unknowns) -> Residuals:
        """Signal after signal; with windows the defects between them follow."""
        # No measurement enters the simulation: that keeps the estimates free of a bias by output
        # noise, which equation error has, and is why gusts are taken for noise.
        runs = predict(layout, data, u)
        y, sd = measured_signals(layout, data, noise)
        simulated = jnp.concatenate([run.outputs.reshape(-1) for run in runs])
        biases = jnp.stack([b for by_output in u.biases for b in by_output.values()])
        error = y - biases[signal_numbers(layout, data)] - simulated
        # A missing sample says nothing: its row is zero, and so is its derivative. Left out it
        # would change the shapes, and with them the program, from record to record.
        rows = jnp.where(jnp.isfinite(y), error, 0.0) / sd
        return Residuals(jnp.concatenate([rows, *_defects(layout, data, u, runs)]), runs)

    def records(self, reached: Solution, u: Unknowns, runs: int, seed: int) -> Sequence[dict]:
        """The simulated flights: with no disturbance all runs are the same."""
        layout = reached.layout
        simulated = predict(layout, reached.data, u)
        return [
            dict(zip(names, run.outputs, strict=True))
            for names, run in zip(layout.outputs, simulated, strict=True)
        ]


def _defects(layout: Layout, data: Data, u: Unknowns, runs: tuple[Run, ...]) -> list[Array]:
    """By flight the defects of multiple shooting: the jumps of the states between windows over
    their sd, window by window."""
    rows = []
    for flight, run, begun in zip(data.flights, runs, u.states, strict=True):
        # Without continuity each window has an initial state that nothing ties to its neighbours.
        if layout.continuity is None or run.ends is None:
            continue
        # The scale is ten times what the state does, and continuity a part of what it does.
        jumps = [
            (getattr(run.ends, n)[:-1] - getattr(begun, n)[1:])
            / (0.1 * layout.continuity * flight.state_scale[n])
            for n in layout.states
        ]
        rows.append(jnp.stack(jumps, axis=1).reshape(-1))
    return rows


OBJECTIVE = OutputError()


# The unknowns that a method in frequency does not see, from the simulation in time.


_STEPS = 20
"""at most, for models that are not linear"""
_DAMPED = (0.0, 0.01, 1.0, 100.0)
"""damping (Marquardt's) of the steps that are tried beside one another"""
_ENOUGH = 1e-4
"""part of the cost that a step has to gain for another one to be made"""


def in_time(layout: Layout, data: Data, noise: Noise, z: Float[Array, " q"]) -> Float[Array, " q"]:
    """z with the biases, offsets and initial states by which the simulation is nearest in time."""
    if layout.first_nuisance == z.shape[0]:
        return z
    # Of a linear model one step is enough.
    for _ in range(1 if layout.model.linear else _STEPS):
        z, gained = _step(layout, data, noise, z)
        if not float(gained) > _ENOUGH:
            break
    return z


@jitted
def _step(layout: Layout, data: Data, noise: Noise, z: Array) -> tuple[Array, Array]:
    """The best of a few damped steps of Gauss and Newton, and the part of the cost it gains."""
    first = layout.first_nuisance

    def rows(part: Array) -> Array:
        u = unpack(layout, data, z.at[first:].set(part))
        return jnp.concatenate([OBJECTIVE.residuals(layout, data, noise, u).rows, part])

    part = z[first:]
    r, J = rows(part), jax.jacfwd(rows)(part)
    sizes = jnp.diag(jnp.linalg.norm(J, axis=0))
    below = jnp.zeros_like(part)

    def tried(damping: Array) -> tuple[Array, Array]:
        stacked = jnp.concatenate([J, jnp.sqrt(damping) * sizes])
        step = jnp.linalg.lstsq(stacked, -jnp.concatenate([r, below]))[0]
        cost = jnp.sum(rows(part + step) ** 2)
        # The simulation of an unstable vehicle over a whole record may be no number.
        return step, jnp.where(jnp.isfinite(cost), cost, jnp.inf)

    dampings = _DAMPED[:1] if layout.model.linear else _DAMPED
    steps, costs = jax.lax.map(tried, jnp.asarray(dampings, z.dtype))
    best, before = jnp.argmin(costs), jnp.sum(r**2)
    better = costs[best] < before
    gained = jnp.where(better, 1.0 - costs[best] / before, 0.0)
    return z.at[first:].add(jnp.where(better, steps[best], 0.0)), gained
