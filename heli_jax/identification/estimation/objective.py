"""The objective that an estimation method minimises, and what depends on it.

A method is one class: its rows and their tags, the noise and its relaxation, the likelihood, and
the records of a bootstrap. The optimiser minimises the sum of squared rows. Their Jacobian gives
identifiability and intervals. The defaults suit a simulation compared with samples in white noise.
Methods are listed in `heli_jax.identification.methods`.
"""

import abc
from collections.abc import Sequence
from typing import Any, ClassVar, Literal, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from heli_jax.analysis.response_agreement import ResponseAgreement
from heli_jax.finding import Finding
from heli_jax.flights.flight import Flight
from heli_jax.identification.estimation.evaluation import Evaluation, evaluate
from heli_jax.identification.estimation.residual import Residuals
from heli_jax.identification.estimation.simulated_flights import (
    least_noise,
    measured_count,
    signal_numbers,
    signals,
)
from heli_jax.identification.problem import Problem
from heli_jax.identification.unknowns.layout import Data, Layout, Noise, Solution, Unknowns

NoiseModel = Literal["white", "disturbance", "spectrum"]


class RowTags(NamedTuple):
    """Meaning of each row of the measurements, (n,) each; -1 if it belongs to no single one."""

    flight: np.ndarray
    signal: np.ndarray
    """Index of (flight, output) in `signals`."""
    sample: np.ndarray
    """Sample within its flight."""
    residual: np.ndarray
    """True for a residual, False for the rows after them: variances, defects."""


def untagged(count: int) -> RowTags:
    """Return tags of rows that belong to no single flight."""
    none = np.full(count, -1)
    return RowTags(none, none, none, np.ones(count, bool))


class Objective(abc.ABC):
    """An estimation method, without state: there is one object of each."""

    noise_model: ClassVar[NoiseModel] = "white"
    """Noise of the likelihood. 'white': a simulation against samples, with white noise of each
    signal. 'disturbance': one-step predictions, with an estimated disturbance and one white noise
    of each output. 'spectrum': values at frequencies over an estimated spectrum, without initial
    states and biases."""
    fits_responses: ClassVar[bool] = False
    """True if frequency responses are fitted, with the settings in `Problem.frequency`."""

    def refusal(self, problem: Problem) -> str | None:
        """Return why the method cannot solve a problem and which one can, or None."""
        return None

    def flight_facts(self, problem: Problem, flights: Sequence[Flight]) -> tuple[Any, ...]:
        """Return, by flight, hashable facts that the method needs before tracing."""
        return ()

    def instrumented(
        self, problem: Problem, flights: Sequence[Flight]
    ) -> tuple[dict[str, np.ndarray], ...] | None:
        """Return, by flight and input, the part (N,) that follows the instruments, SI.

        The result is None without instruments.
        """
        return None

    def scaled_outputs(self, problem: Problem) -> tuple[str, ...]:
        """Return the outputs whose noise factor is an unknown in z."""
        return ()

    @abc.abstractmethod
    def residuals(self, layout: Layout, data: Data, noise: Noise, u: Unknowns) -> Residuals:
        """Return the rows of the measurements, divided by the noise; traced, and differentiated in
        forward mode."""

    def tags(self, layout: Layout, data: Data, count: int) -> RowTags:
        """Return the tags of the `count` rows that `residuals` returns."""
        numbers = signal_numbers(layout, data)
        flights = np.array([i for i, _ in signals(layout)])
        begins = np.searchsorted(numbers, np.arange(flights.size))
        tags = np.full((3, count), -1)
        samples = np.arange(numbers.size) - begins[numbers]
        tags[:, : numbers.size] = flights[numbers], numbers, samples
        if layout.continuity is not None:
            defects = [(windows - 1) * len(layout.states) for windows, _ in layout.windows]
            tags[0, numbers.size :] = np.repeat(np.arange(len(defects)), defects)
        return RowTags(tags[0], tags[1], tags[2], np.arange(count) < numbers.size)

    def first_noise(self, problem: Problem, noise: Noise, flights: Sequence[Flight]) -> Noise:
        """Return the first guess of the noise in the method's form.

        Args:
            noise: sds by flight and output.
        """
        return noise

    def noise_at_start(self, layout: Layout, data: Data, e: Evaluation, noise: Noise) -> Noise:
        """Return the noise after an evaluation at a start; the same object if unchanged."""
        return noise

    def data_at_start(self, data: Data) -> Data:
        """Return the data of the first search, if they differ from the measured data."""
        return data

    def noise_of_check(self, layout: Layout, data: Data, noise: Noise) -> Noise:
        """Return the noise of a check at the start values.

        It is the same object unless the fit ends with another.
        """
        return noise

    def relax(
        self, layout: Layout, data: Data, noise: Noise, z: Float[Array, " q"]
    ) -> tuple[Float[Array, " q"], Noise]:
        """Return z, and the noise of the residuals there."""
        n = measured_count(data)
        # The unknowns absorb part of the noise of every signal.
        freedom = n / max(n - layout.determined, 1)
        e = evaluate(layout, data, noise, z)
        sd = [dict(by_output) for by_output in noise.sd]
        for (i, name), errors in zip(signals(layout), errors_of(layout, e), strict=True):
            y = np.asarray(data.flights[i].outputs[name])
            size = max(self.scale(errors) * np.sqrt(freedom), least_noise(y))
            sd[i][name] = np.asarray(size, y.dtype)
        return z, Noise(tuple(sd), noise.log_variance_ratio)

    def scale(self, errors: Float[np.ndarray, " n"]) -> float:
        """Return the most likely scale of the noise of one signal."""
        return float(np.sqrt(np.mean(np.square(errors))))

    def noise_matters(self, problem: Problem, layout: Layout, before: Noise, after: Noise) -> bool:
        """True if a change of the noise moves the optimum."""
        return True

    def finish(
        self, layout: Layout, data: Data, noise: Noise, z: Float[Array, " q"]
    ) -> Float[Array, " q"]:
        """Return z at the end of a search, with the unknowns that affect no row."""
        return z

    def log_likelihood(self, layout: Layout, data: Data, noise: Noise, e: Evaluation) -> float:
        """Return the log-likelihood in SI units of the outputs.

        An estimated noise has its most likely value.
        """
        total = 0.0
        for v in errors_of(layout, e):
            sd = self.scale(v)
            total -= v.size * float(np.log(2.0 * np.pi * sd**2)) + float(np.sum((v / sd) ** 2))
        return 0.5 * total

    def log_density(self, layout: Layout, data: Data, rows: Float[Array, " n"]) -> Array:
        """Return the log density of the rows up to a constant; traced.

        The scales of white noise are integrated out under Jeffreys' prior.
        """
        if self.noise_model != "white":
            return -0.5 * jnp.sum(rows**2)
        # The integral over sd of sd^-(n+1) exp(-S / (2 sd^2)) is proportional to S^(-n/2). Rows of
        # missing samples are zero, and n excludes them.
        counts = [jnp.sum(jnp.isfinite(y)) for f in data.flights for y in f.outputs.values()]
        n = jnp.stack(counts).astype(rows.dtype)
        numbers = signal_numbers(layout, data)
        S = jnp.zeros(n.size, rows.dtype).at[numbers].add(rows[: numbers.size] ** 2)
        return -0.5 * jnp.sum(n * jnp.log(S))

    def numbers(self, layout: Layout, data: Data, noise: Noise) -> int:
        """Return the number of independent values that the noise is estimated from."""
        return measured_count(data)

    @abc.abstractmethod
    def records(self, reached: Solution, u: Unknowns, runs: int, seed: int) -> Sequence[dict]:
        """Return, by flight and output, the signals without bias and noise at `reached` with the
        unknowns u.

        They are (N,), or (runs, N) if a disturbance is drawn.
        """

    def ill_conditioned(self, problem: Problem, e: Evaluation, sd: dict[str, float]) -> bool:
        """True if the evaluation is dominated by rounding.

        Args:
            sd: sd of the measurement noise, SI, by 'flight/output'.
        """
        return False

    def response_agreement(
        self, layout: Layout, data: Data, noise: Noise, z: Array
    ) -> ResponseAgreement | None:
        """Return the agreement of modelled and measured frequency responses, if fitted."""
        return None

    def findings(
        self, at: Solution, e: Evaluation, names: Sequence[str], ill: bool
    ) -> list[Finding]:
        """Return findings on the assumptions of the method; `ill` if the evaluation is rounding."""
        return []


def errors_of(layout: Layout, e: Evaluation) -> list[Float[np.ndarray, " n"]]:
    """Return the errors of each signal, measured less simulated, SI, without missing samples."""
    return [e.raw[i][name][np.isfinite(e.raw[i][name])] for i, name in signals(layout)]


def noise_unknowns(layout: Layout) -> int:
    """Return the number of measurement-noise sds that are estimated in addition to z."""
    # They count in AIC and BIC. A smooth spectrum does not, because each candidate model has its
    # own.
    return len(signals(layout)) if layout.noise_model == "white" else 0
