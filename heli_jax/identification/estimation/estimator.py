"""What a method of estimation is: the residuals that it makes small, and what follows from them.

Everything around it asks only this: the optimiser squares and sums the rows, identifiability and
intervals come from their Jacobian, the noise is relaxed from them. A method is one class with
`residuals` and `records`, entered in `heli_jax.identification.methods`. What stands here besides is
right for rows that are samples of every signal over its noise, one row a sample; a method whose
rows are something else says what follows from them.
"""

import abc
from collections.abc import Sequence
from typing import Any, ClassVar, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from heli_jax.identification.estimation.kalman import Innovations
from heli_jax.identification.problem import Problem
from heli_jax.identification.unknowns.layout import Data, Layout, Noise, Solution, Unknowns


class Evaluation(NamedTuple):
    """Everything that one point tells, as NumPy arrays."""

    simulated: tuple[dict[str, Any], ...]
    """with the bias, SI, by flight and output"""
    raw: tuple[dict[str, Any], ...]
    """measured - simulated, SI, by flight and output; NaN where nothing is measured"""
    state_rms: Any
    """(flights, states) root mean square of each simulated state"""
    innovations: tuple[Innovations, ...]
    r: Any
    J: Any
    named: Any
    """values of the named unknowns"""
    slopes: Any
    """their derivatives by their own coordinates"""


class Residuals(NamedTuple):
    """What a method makes small."""

    rows: Float[Array, " n"]
    """whitened; zero where nothing is measured. Those of the priors are added to them"""
    runs: Any
    """by flight the simulated `Run`s on whose way the rows came; None where none was simulated"""
    innovations: tuple[Innovations, ...] = ()
    """by flight, where predictions one step ahead are what is compared"""


class Estimator(abc.ABC):
    """A method of estimation. Without a state of its own: there is one object of each."""

    errors: ClassVar[str] = "residuals"
    """what the method asks to be white"""
    process_noise: ClassVar[bool] = False
    """whether it estimates a disturbance, which a simulation does not know"""
    shared_noise: ClassVar[bool] = False
    """whether an output has one measurement noise in all flights"""
    windows: ClassVar[bool] = False
    """whether flights may be cut into windows (multiple shooting)"""
    rows_are_samples: ClassVar[bool] = True
    """whether the first rows are the samples in time of every signal, flight after flight and
    output after output: then their autocorrelation can be allowed for"""
    rows_are_white: ClassVar[bool] = True
    """whether rows are independent where the measurement noise is white"""
    least_squares: ClassVar[bool] = True
    """whether the sum of squared rows is the misfit itself, weighed by the noise of each output"""

    @abc.abstractmethod
    def residuals(self, layout: Layout, data: Data, noise: Noise, u: Unknowns) -> Residuals:
        """The rows of the measurements at the unknowns; traced, and differentiated forwards."""

    def row_signals(self, layout: Layout, data: Data) -> np.ndarray:
        """Of the first rows (n,) the signal that each belongs to, as `signals` numbers them."""
        return signal_numbers(layout, data)

    def one_program(self, layout: Layout) -> bool:
        """Whether a whole run of the optimiser is compiled as one program: worth it where the
        rows take no longer to evaluate than a step takes to be called for."""
        return layout.model.linear

    def scaled_outputs(self, problem: Problem) -> tuple[tuple[str, ...], bool]:
        """Outputs whose noise is an unknown factor in z, and whether a common factor of all noise
        is taken out of the likelihood instead."""
        return (), False

    def with_level(self, data: Data, e: Evaluation, noise: Noise) -> Noise:
        """The noise with the level about which the likelihood is laid out in rows."""
        return noise

    def relax(
        self, layout: Layout, data: Data, e: Evaluation, noise: Noise, z: Float[Array, " q"]
    ) -> tuple[Float[Array, " q"], Noise]:
        """The noise that the rows show, degrees of freedom taken off in proportion, and z.

        Args:
            e: at z with `noise`.
        """
        n = measured_count(data)
        freedom = n / max(n - layout.determined, 1)
        sd = [dict(one) for one in noise.sd]
        for (i, name), r in zip(
            signals(layout), self.errors_of(layout, data, noise, e), strict=True
        ):
            y = np.asarray(data.flights[i].outputs[name])
            # A residual that is all rounding would make the next rows infinite.
            floor = 1e-12 * np.sqrt(np.mean(np.square(y[np.isfinite(y)]))) + 1e-300
            size = max(np.sqrt(np.mean(np.square(r)) * freedom), floor)
            sd[i][name] = np.asarray(size, np.asarray(y).dtype)
        return z, Noise(tuple(sd), noise.log_variance_ratio)

    def noise_matters(self, problem: Problem, layout: Layout, fall: float) -> bool:
        """Whether the optimum moves with the noise; `fall` is that of its level."""
        return True

    def errors_of(
        self, layout: Layout, data: Data, noise: Noise, e: Evaluation
    ) -> list[np.ndarray]:
        """By signal what the rows are made of, SI, where something is measured."""
        numbers, rows = self.row_signals(layout, data), np.asarray(e.r)
        errors = []
        for k, (i, name) in enumerate(signals(layout)):
            seen = np.isfinite(np.asarray(data.flights[i].outputs[name]))
            mine = rows[: numbers.size][numbers == k]
            errors.append(mine[seen] * np.asarray(noise.sd[i][name]))
        return errors

    def log_likelihood(self, layout: Layout, data: Data, noise: Noise, e: Evaluation) -> float:
        """Gaussian, in SI units of the outputs, at the noise of the greatest likelihood where that
        is not given."""
        errors = self.errors_of(layout, data, noise, e)
        return sum(-0.5 * r.size * float(np.log(2.0 * np.pi * np.mean(r**2)) + 1.0) for r in errors)

    def noise_unknowns(self, layout: Layout) -> int:
        """How many standard deviations of measurement noise are estimated beside z."""
        return len(signals(layout))

    def log_likelihood_lost(
        self, layout: Layout, cost: np.ndarray | float, first: float, n: int
    ) -> Any:
        """Twice the log-likelihood between two costs (sums of squares of all rows over n)."""
        return n * (cost - first)

    def log_density(self, layout: Layout, data: Data, rows: Float[Array, " n"]) -> Array:
        """Of the rows of the measurements, but for a constant; the scale of the noise is integrated
        out under Jeffreys' prior, of each signal by itself."""
        total, at = jnp.zeros((), rows.dtype), 0
        for i, name in signals(layout):
            y = data.flights[i].outputs[name]
            n = jnp.sum(jnp.isfinite(y).astype(rows.dtype))
            total -= 0.5 * n * jnp.log(jnp.sum(rows[at : at + y.shape[0]] ** 2))
            at += y.shape[0]
        return total

    @abc.abstractmethod
    def records(self, reached: Solution, u: Unknowns, runs: int, seed: int) -> Sequence[dict]:
        """By flight and output what is measured but for bias and noise, (N,), or (runs, N) where
        chance moves the machine too."""

    def against_expected(
        self, layout: Layout, data: Data, noise: Noise, e: Evaluation, z: Array
    ) -> dict[str, float] | None:
        """By output, the power of the simulation's error over that which disturbance and noise
        let expect; None where the simulation has to explain the record by itself."""
        return None

    def ill_conditioned(self, problem: Problem, e: Evaluation, sd: dict[str, float]) -> bool:
        """Whether the numbers at the optimum are rounding; sd by 'flight/output'."""
        return False

    def notes(
        self, layout: Layout, data: Data, noise: Noise, e: Evaluation, ill: bool
    ) -> list[str]:
        """What a reader should know of the method's own assumptions; `ill` as above."""
        return []


def signals(layout: Layout) -> list[tuple[int, str]]:
    """What is measured, as (flight, output), in the order of the rows."""
    return [(i, n) for i, names in enumerate(layout.outputs) for n in names]


def signal_numbers(layout: Layout, data: Data) -> np.ndarray:
    """Of every measured number its signal."""
    sizes = [data.flights[i].outputs[n].shape[0] for i, n in signals(layout)]
    return np.repeat(np.arange(len(sizes)), sizes)


def measured_signals(layout: Layout, data: Data, noise: Noise) -> tuple[Array, Array]:
    """All that is measured, and its sd. Joined: XLA makes kernels of signals one by one."""
    at = signals(layout)
    sd = jnp.stack([noise.sd[i][n] for i, n in at])
    y = jnp.concatenate([data.flights[i].outputs[n] for i, n in at])
    return y, sd[signal_numbers(layout, data)]


def measured_count(data: Data) -> int:
    """How many measured numbers there are."""
    return sum(
        int(np.isfinite(np.asarray(y)).sum())
        for flight in data.flights
        for y in flight.outputs.values()
    )
