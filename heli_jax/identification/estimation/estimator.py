"""What a method of estimation is: the residuals that it makes small, and what follows from them.

Everything around it asks only this: the optimiser squares and sums the rows, identifiability and
intervals come from their Jacobian, the noise is relaxed from them. A method is one class with
`residuals` and `records`, entered in `heli_jax.identification.methods`. All else here is right for
rows that are samples of every signal over its noise; a method of other rows says what follows.
"""

import abc
from collections.abc import Sequence
from typing import Any, ClassVar, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from heli_jax.analysis.response_agreement import ResponseAgreement
from heli_jax.finding import Finding
from heli_jax.flights.flight import Flight
from heli_jax.identification.estimation.kalman import Innovations
from heli_jax.identification.estimation.simulated_flights import (
    Run,
    least_noise,
    measured_count,
    signal_numbers,
    signals,
)
from heli_jax.identification.problem import Problem
from heli_jax.identification.unknowns.layout import Data, Layout, Noise, Solution, Unknowns


class Evaluation(NamedTuple):
    """Everything that one point tells, as NumPy arrays."""

    simulated: tuple[dict[str, np.ndarray], ...]
    """with the bias, SI, by flight and output (N,)"""
    raw: tuple[dict[str, np.ndarray], ...]
    """measured - simulated, SI, by flight and output (N,); NaN where nothing is measured"""
    state_rms: np.ndarray
    """(flights, states) root mean square of each simulated state"""
    innovations: tuple[Innovations, ...]
    r: np.ndarray
    """(n,) whitened residuals with the rows of the priors"""
    J: np.ndarray
    """(n, q) derivative of r by z"""
    named: np.ndarray
    """values of the named unknowns, in their units"""
    slopes: np.ndarray
    """their derivatives by their own coordinates"""
    z: np.ndarray
    """(q,) where it is"""


class Residuals(NamedTuple):
    """What a method makes small."""

    rows: Float[Array, " n"]
    """whitened; zero where nothing is measured. Those of the priors are added to them"""
    runs: tuple[Run, ...] | None
    """by flight the simulated `Run`s on whose way the rows came; None where none was simulated"""
    innovations: tuple[Innovations, ...] = ()
    """by flight, where predictions one step ahead are what is compared"""


class Nearing(NamedTuple):
    """How a search ends after which the noise is estimated anew, and another one begins."""

    unchecked: float
    """gain in joint standard deviations squared below which a whole step is the last, taken without
    an evaluation of where it leads: the next search begins with that"""
    damping: float = 1.0
    """of the first step, in the optimiser's units: little near an optimum"""


class Estimator(abc.ABC):
    """A method of estimation. Without a state of its own: there is one object of each."""

    # What others have to know of a method stands here as a fact about its rows: code that asked
    # which method it is would have to be changed for a third one.
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
    rows_by_flight: ClassVar[bool] = True
    """whether each row of the measurements is of one flight"""
    noise_spectrum: ClassVar[bool] = False
    """whether the noise's spectrum is estimated, so that intervals hold where residuals in time are
    not white; rows are then numbers at frequencies, of no sample and maybe of no flight"""
    fits_responses: ClassVar[bool] = False
    """whether frequency responses are what is fitted, as `Problem.frequency` says"""
    nuisances_in_rows: ClassVar[bool] = True
    """whether initial states and biases have a part in the rows: else the simulation in time has
    them found by themselves"""
    rows_are_white: ClassVar[bool] = True
    """whether rows are independent where the measurement noise is white"""
    relaxes_rows: ClassVar[bool] = True
    """whether the noise is relaxed from the rows: else nobody evaluates them for that"""
    least_squares: ClassVar[bool] = True
    """whether the sum of squared rows is the misfit itself, weighed by the noise of each output"""
    nearing: ClassVar[Nearing | None] = None
    """how a search ends after which the noise is relaxed; None: as near as it gets"""
    by_instrument: ClassVar[bool] = False
    """whether it can take inputs by their instrument (`Problem.instrument`)"""

    @abc.abstractmethod
    def residuals(self, layout: Layout, data: Data, noise: Noise, u: Unknowns) -> Residuals:
        """The rows of the measurements at the unknowns; traced, and differentiated forwards.

        Args:
            u: the unknowns, in the units of the model.
        """

    def row_signals(self, layout: Layout, data: Data) -> np.ndarray:
        """Of the first rows (n,) the signal that each belongs to, as `signals` numbers them."""
        return signal_numbers(layout, data)

    def one_program(self, layout: Layout) -> bool:
        """Whether a whole run of the optimiser is compiled as one program: worth it where the
        rows take no longer to evaluate than a step takes to be called for."""
        # The rows of a linear model are one short recurrence; a simulation in steps takes longer.
        return layout.model.linear

    def scaled_outputs(self, problem: Problem) -> tuple[tuple[str, ...], bool]:
        """Outputs whose noise is an unknown factor in z, and whether a common factor of all noise
        is taken out of the likelihood instead."""
        return (), False

    def refusal(self, problem: Problem) -> str | None:
        """Why the method cannot solve a problem and what can, in words; None where it can."""
        return None

    def of_flights(self, problem: Problem, flights: Sequence[Flight]) -> tuple[Any, ...]:
        """By flight what the method has to know of it before anything is traced; hashable."""
        return ()

    def instrumented(
        self, problem: Problem, flights: Sequence[Flight]
    ) -> tuple[dict[str, np.ndarray], ...] | None:
        """By flight and input what of it follows the instruments (N,), SI; None without any."""
        return None

    def prepared(self, noise: Noise, flights: Sequence[Flight]) -> Noise:
        """The first guess of the noise as the method needs it."""
        return noise

    def begins_with(self, data: Data) -> Data:
        """What the first search goes by, other signals where those measured would mislead it."""
        return data

    def to_begin_with(
        self,
        layout: Layout,
        data: Data,
        noise: Noise,
        z: Float[Array, " q"],
        known: tuple[Array, Array],
    ) -> tuple[Noise, tuple[Array, Array]]:
        """A noise by which a search takes less time and finds nearly the same, with residuals and
        Jacobian at z; the one given where there is none.

        Args:
            known: residuals and Jacobian there with `noise`.
        """
        return noise, known

    def whole(self, noise: Noise) -> Noise:
        """The noise by which a search ends that began with less; the same object otherwise."""
        return noise

    def as_it_ends(self, layout: Layout, data: Data, noise: Noise) -> Noise:
        """The noise to ask at the start values what a fit may determine, where a search begins by
        other equations or with another noise than it ends with.
        """
        return noise

    def prepared_for(self, problem: Problem, noise: Noise, flights: Sequence[Flight]) -> Noise:
        """`prepared` where the method asks more of the problem than its flights.

        Args:
            flights: those fitted, or those held out.
        """
        return self.prepared(noise, flights)

    def with_level(self, data: Data, e: Evaluation, noise: Noise) -> Noise:
        """The noise with the level about which the likelihood is laid out in rows.

        Args:
            e: at any point, with `noise`.
        """
        return noise

    def relax(
        self, layout: Layout, data: Data, e: Any, noise: Noise, z: Float[Array, " q"]
    ) -> tuple[Float[Array, " q"], Noise]:
        """The noise that the rows show, degrees of freedom taken off in proportion, and z.

        Args:
            e: the `Evaluation` at z with `noise`; None unless `relaxes_rows`.
        """
        n = measured_count(data)
        # What the unknowns could fit of the noise is missing in the rows of every signal.
        freedom = n / max(n - layout.determined, 1)
        sd = [dict(by_output) for by_output in noise.sd]
        for (i, name), r in zip(
            signals(layout), self.errors_of(layout, data, noise, e), strict=True
        ):
            y = np.asarray(data.flights[i].outputs[name])
            size = max(np.sqrt(np.mean(np.square(r)) * freedom), least_noise(y))
            sd[i][name] = np.asarray(size, np.asarray(y).dtype)
        return z, Noise(tuple(sd), noise.log_variance_ratio)

    def with_nuisances(
        self, layout: Layout, data: Data, noise: Noise, z: Float[Array, " q"]
    ) -> Float[Array, " q"]:
        """z at the end of a search, with the nuisances that neither rows nor noise hang on."""
        return z

    def noise_matters(self, problem: Problem, layout: Layout, before: Noise, after: Noise) -> bool:
        """Whether the optimum moves with the noise, so that it has to be searched again."""
        return True

    def errors_of(
        self, layout: Layout, data: Data, noise: Noise, e: Evaluation
    ) -> list[np.ndarray]:
        """By signal what the rows are made of, SI, where something is measured."""
        errors = self.rows_by_signal(layout, data, noise, e)
        # The row of a missing sample is zero, which is no error of that size.
        return [
            error[np.isfinite(np.asarray(data.flights[i].outputs[name]))]
            for (i, name), error in zip(signals(layout), errors, strict=True)
        ]

    def rows_by_signal(
        self, layout: Layout, data: Data, noise: Noise, e: Evaluation
    ) -> list[np.ndarray]:
        """By signal all of its rows times its sd, SI."""
        numbers, rows = self.row_signals(layout, data), np.asarray(e.r)
        # The first rows alone: defects and priors follow.
        return [
            rows[: numbers.size][numbers == k] * np.asarray(noise.sd[i][name])
            for k, (i, name) in enumerate(signals(layout))
        ]

    def log_likelihood(self, layout: Layout, data: Data, noise: Noise, e: Evaluation) -> float:
        """Gaussian, in SI units of the outputs, at the noise of the greatest likelihood where that
        is not given.

        Args:
            noise: that `e` was evaluated with.
        """
        errors = self.errors_of(layout, data, noise, e)
        # With the noise at its optimum the squares over the variance are as many as there are rows:
        # hence the 1.
        return sum(-0.5 * r.size * float(np.log(2.0 * np.pi * np.mean(r**2)) + 1.0) for r in errors)

    def noise_unknowns(self, layout: Layout) -> int:
        """How many standard deviations of measurement noise are estimated beside z."""
        # They count in AIC and BIC: two models that need different noises differ in unknowns.
        return len(signals(layout))

    def deviance(
        self, layout: Layout, cost: np.ndarray | float, first: float, n: int
    ) -> np.ndarray | float:
        """Twice the log-likelihood that is lost between two costs.

        Args:
            cost: sum of squares of all rows over n, any shape.
        """
        # The cost is a mean over n: times n it is the sum of squares of whitened rows, minus twice
        # the log-likelihood but for a constant.
        return n * (cost - first)

    def log_density(self, layout: Layout, data: Data, rows: Float[Array, " n"]) -> Array:
        """Of the rows of the measurements, but for a constant; the scale of the noise is integrated
        out under Jeffreys' prior, of each signal by itself.

        Args:
            rows: those of the measurements, traced.
        """
        # Rows where nothing was measured are zero: they add nothing to the sum, and n leaves them
        # out.
        total, at = jnp.zeros((), rows.dtype), 0
        for i, name in signals(layout):
            y = data.flights[i].outputs[name]
            n = jnp.sum(jnp.isfinite(y).astype(rows.dtype))
            # The integral over sd of sd^-(n+1) exp(-S / (2 sd^2)) is proportional to S^(-n/2).
            total -= 0.5 * n * jnp.log(jnp.sum(rows[at : at + y.shape[0]] ** 2))
            at += y.shape[0]
        return total

    def numbers(self, layout: Layout, data: Data, noise: Noise) -> int:
        """How many independent numbers the noise is estimated from."""
        return measured_count(data)

    @abc.abstractmethod
    def records(self, reached: Solution, u: Unknowns, runs: int, seed: int) -> Sequence[dict]:
        """By flight and output what is measured but for bias and noise, (N,), or (runs, N) where
        chance moves the machine too.

        Args:
            reached: where the fit ended.
        """

    def against_expected(
        self, layout: Layout, data: Data, noise: Noise, e: Evaluation, z: Array
    ) -> dict[str, float] | None:
        """By output, the power of the simulation's error over that which disturbance and noise
        let expect; None where the simulation has to explain the record by itself.

        Args:
            noise: that `e` was evaluated with.
        """
        return None

    def ill_conditioned(self, problem: Problem, e: Evaluation, sd: dict[str, float]) -> bool:
        """Whether the numbers at the optimum are rounding.

        Args:
            sd: of the measurement noise, SI, by 'flight/output'.
        """
        return False

    def response_agreement(
        self, layout: Layout, data: Data, noise: Noise, z: Array, *, fitted: bool = True
    ) -> ResponseAgreement | None:
        """How model and measured frequency responses agree, where these are what is fitted."""
        return None

    def notes(self, at: Solution, e: Evaluation, names: Sequence[str], ill: bool) -> list[Finding]:
        """What a reader should know of the method's own assumptions."""
        return []
