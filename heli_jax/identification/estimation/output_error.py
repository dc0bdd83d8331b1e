"""Output error: the simulation against the measurement, (measured - bias - simulated) / sd.

Maximum likelihood if the measurement noise is white and nothing disturbs the vehicle (Maine and
Iliff, 1985; Jategaonkar, 2006, chapter 4). With windows (multiple shooting; Bock, 1983) the defects
between them are added.
"""

from collections.abc import Sequence
from dataclasses import replace

import jax.numpy as jnp
from jaxtyping import Array, Float

from heli_jax.identification.estimation.levenberg_marquardt import fit_nuisances
from heli_jax.identification.estimation.objective import Objective
from heli_jax.identification.estimation.residual import Residuals
from heli_jax.identification.estimation.simulated_flights import (
    Run,
    measured_signals,
    predict,
    signal_numbers,
)
from heli_jax.identification.unknowns.layout import Data, Layout, Noise, Solution, Unknowns


class OutputError(Objective):
    """The simulation, driven by the logged inputs alone, against the measured outputs."""

    def residuals(self, layout: Layout, data: Data, noise: Noise, u: Unknowns) -> Residuals:
        """Return the rows signal by signal; with windows, the defects between them follow."""
        # No measurement enters the simulation. So output noise causes no bias, unlike in equation
        # error, but gusts are taken for noise.
        runs = predict(layout, data, u)
        y, sd = measured_signals(layout, data, noise)
        simulated = jnp.concatenate([run.outputs.reshape(-1) for run in runs])
        biases = jnp.stack([b for by_output in u.biases for b in by_output.values()])
        error = y - biases[signal_numbers(layout, data)] - simulated
        # The row of a missing sample is zero. Dropping it would change the shapes, and so the
        # compiled program, from record to record.
        rows = jnp.where(jnp.isfinite(y), error, 0.0) / sd
        return Residuals(jnp.concatenate([rows, *_defects(layout, data, u, runs)]), runs)

    def records(self, reached: Solution, u: Unknowns, runs: int, seed: int) -> Sequence[dict]:
        """Return the simulated flights; without a disturbance all runs are the same."""
        layout = reached.layout
        simulated = predict(layout, reached.data, u)
        return [
            dict(zip(names, run.outputs, strict=True))
            for names, run in zip(layout.outputs, simulated, strict=True)
        ]


def _defects(layout: Layout, data: Data, u: Unknowns, runs: tuple[Run, ...]) -> list[Array]:
    """Return, by flight, the defects of multiple shooting: jumps of the states between windows over
    their sd."""
    rows = []
    for flight, run, starts in zip(data.flights, runs, u.states, strict=True):
        # Without continuity, the initial states of neighbouring windows are independent.
        if layout.continuity is None or run.ends is None:
            continue
        # The scale is ten times the motion of the state; continuity is a fraction of the motion.
        jumps = [
            (getattr(run.ends, n)[:-1] - getattr(starts, n)[1:])
            / (0.1 * layout.continuity * flight.state_scale[n])
            for n in layout.states
        ]
        rows.append(jnp.stack(jumps, axis=1).reshape(-1))
    return rows


OBJECTIVE = OutputError()


def in_time(layout: Layout, data: Data, noise: Noise, z: Float[Array, " q"]) -> Float[Array, " q"]:
    """Return z with the biases, offsets and initial states that fit best in time.

    A method in frequency has them in no row.
    """
    return fit_nuisances(replace(layout, objective=OBJECTIVE), data, noise, z)
