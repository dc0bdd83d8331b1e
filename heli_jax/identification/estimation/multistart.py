"""Runs of the optimiser from one or several starts."""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Float

from heli_jax.identification.estimation.evaluation import Evaluation
from heli_jax.identification.estimation.levenberg_marquardt import (
    Optimum,
    measured_count,
    optimise,
)
from heli_jax.identification.problem import Problem
from heli_jax.identification.unknowns import transforms
from heli_jax.identification.unknowns.layout import Data, Layout, Noise

Progress = Callable[[str], None]


class StartRow(NamedTuple):
    """Start and end of one run of the optimiser."""

    start: dict[str, float]
    end: dict[str, float]
    cost: float
    steps: int
    converged: bool
    optimum: int
    """1 for the best optimum of that reason, 2 for the next, ...; 0 if not converged."""
    reason: str = "start"
    """'start', 'starts' of several, or the name of a restart."""
    chosen: bool = False
    """True for the run that the fit uses."""


class Run(NamedTuple):
    """One run of the optimiser."""

    reason: str
    """As in `StartRow`."""
    start: Float[Array, " q"]
    optimum: Optimum


_GOOD = 10.0
"""Cost below which a run counts as a fit, whatever the size of the outputs."""


class Search(NamedTuple):
    """The optimiser for a problem."""

    problem: Problem
    layout: Layout
    data: Data
    max_steps: int

    def run(
        self,
        noise: Noise,
        points: Float[Array | np.ndarray, "s q"],
        progress: Progress | None = None,
    ) -> list[Optimum]:
        """Return an optimum for each start.

        Args:
            progress: called with a sentence after each of several starts.
        """
        # Starts run in sequence: on two cores a vmap, which waits for the slowest, took four times
        # as long and needed its own compilation.
        runs = []
        for i, z in enumerate(np.asarray(points)):
            run = optimise(self.layout, self.data, noise, z, self.max_steps, held=self._held)
            # An optimiser may converge where the model explains nothing, because its gradient is
            # zero there. Both costs are means over the measured values.
            if not run.cost <= _GOOD:
                nothing = self.misfit_without_response(noise) / measured_count(self.data)
                run = run._replace(converged=run.converged and run.cost <= 1.5 * nothing + _GOOD)
            runs.append(run)
            if progress is not None and len(points) > 1:
                progress(f"{i + 1} of {len(points)} starts done")
        return runs

    @property
    def _held(self) -> np.ndarray | None:
        """Return (q,) True for the unknowns fixed at their start; None if all are free."""
        layout = self.layout
        # Rows of a spectrum do not depend on initial states. Their weak priors would move them to
        # zero, a stopped rotor, from which no search in time recovers.
        if layout.model.linear or layout.noise_model != "spectrum":
            return None
        return np.arange(layout.size) >= layout.first_nuisance

    def misfit_without_response(self, noise: Noise) -> float:
        """Return the sum of squares of a model without any response."""
        return sum_of_squares([f.outputs for f in self.data.flights], noise)


def sum_of_squares(signals: Sequence[Mapping[str, Array | np.ndarray]], noise: Noise) -> float:
    """Return the sum of squares of signals (N,) by flight and output, over the sd of their noise;
    NaN is missing."""
    return sum(
        float(np.nansum(np.square(np.abs(y) / np.asarray(sd[n]))))
        for by_output, sd in zip(signals, noise.sd, strict=True)
        for n, y in by_output.items()
    )


def named_values(
    layout: Layout, data: Data, z: Float[Array | np.ndarray, " q"]
) -> dict[str, float]:
    """Return the values of the free parameters at z, by name, SI."""
    at, sign, low, high = (np.asarray(v) for v in (z, data.sign, data.low, data.high))
    return {
        n: float(transforms.to_value(kind, at[i], sign[i], low[i], high[i]))
        for i, (n, kind) in enumerate(zip(layout.free, layout.kinds, strict=True))
    }


def table(layout: Layout, data: Data, runs: list[Run], chosen: Run) -> tuple[StartRow, ...]:
    """Return a row for each run: the chosen one first, then by reason, best first.

    Equal optima of one reason share a number.
    """
    reasons = list(dict.fromkeys(run.reason for run in runs))
    rows, optimum, last = [], 0, None
    for run in sorted(runs, key=lambda run: (reasons.index(run.reason), rank(run.optimum))):
        cost, converged = _cost(run.optimum), run.optimum.converged
        if rows and rows[-1].reason != run.reason:
            optimum, last = 0, None
        # Costs are compared, because equal optima may lie apart in directions that the data leave
        # open.
        if converged and (last is None or cost > last + 1e-6 * abs(last)):
            optimum, last = optimum + 1, cost
        rows.append(
            StartRow(
                named_values(layout, data, run.start),
                named_values(layout, data, run.optimum.z),
                cost,
                run.optimum.steps,
                converged,
                optimum if converged else 0,
                run.reason,
                run is chosen,
            )
        )
    return tuple(sorted(rows, key=lambda row: not row.chosen))


def rank(run: Optimum) -> tuple[bool, float]:
    """Return the sort key of a run: converged runs first, then the lowest cost."""
    # False sorts before True.
    return not run.converged, _cost(run)


def _cost(run: Optimum) -> float:
    # NaN compares as neither better nor worse and would sort at random.
    cost = run.cost
    return cost if np.isfinite(cost) else float("inf")


class FirstGuess(NamedTuple):
    """A problem at its start values, with a first guess of the noise."""

    layout: Layout
    data: Data
    noise: Noise
    z: Float[Array, " q"]
    e: Evaluation
    search_data: Data
    """Data of the first search."""
