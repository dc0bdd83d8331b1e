r"""Fit of a linear model to measured frequency responses, with intervals that are true.

With Z, U the transforms of instruments (or of the inputs) and of the inputs in Hann windows, and e
the measured outputs less the simulated ones, what the model misses of the responses is

$$\Delta H = \overline{E Z^*}\; \overline{U Z^*}^{-1}.$$

The model goes through the same windows as the record: what windows do to a response they do to
both, and nothing is biased. Where it is unstable, or remembers longer than a window, its bounded
solution is taken in place of a simulation, and what the ends of the record add to it is projected
out. Errors are complex and linear, whitened between outputs and inputs by the noise's spectral
matrix: what no response explains of the errors. Lines of a window count for as much as they are
independent.

Sources: Pintelon and Schoukens (2012), chapters 2 and 9; Bendat and Piersol (2010), chapter 9;
Tischler and Remple (2012), chapters 7 to 12, for the approach, whose logarithmic errors and weights
by coherence are not used: they lose a factor of 2 to 10 in precision.
"""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from heli_jax import naming
from heli_jax.analysis.response_agreement import (
    APART,
    ResponseAgreement,
    expected_interval,
    pair_agreements,
)
from heli_jax.analysis.response_errors import noise_density, response_of
from heli_jax.flights.flight import Flight
from heli_jax.identification.estimation.estimator import Estimator, Evaluation, Residuals
from heli_jax.identification.estimation.frequency_instrument import absent_instrument
from heli_jax.identification.estimation.in_time import in_time
from heli_jax.identification.estimation.output_error import ESTIMATOR as OUTPUT_ERROR
from heli_jax.identification.estimation.response_weights import (
    ResponseWeights,
    back,
    first_weights,
    gusts_through,
    on_device,
    outputs_that_forget,
    weighed,
)
from heli_jax.identification.estimation.simulated_flights import (
    driven,
    least_noise,
    signals,
    simulated_at,
    with_biases,
)
from heli_jax.identification.estimation.window_errors import (
    errors_in_windows,
    rows_of_responses,
)
from heli_jax.identification.problem import Problem
from heli_jax.identification.unknowns.layout import (
    Data,
    Layout,
    Noise,
    Solution,
    Unknowns,
    unpack,
)


class FrequencyResponse(Estimator):
    """The model's frequency responses against those of the flights together."""

    rows_are_samples = False
    least_squares = False
    nuisances_in_rows = False
    noise_spectrum = True
    fits_responses = True
    by_instrument = True
    errors = "residuals"

    def residuals(self, layout: Layout, data: Data, noise: Noise, u: Unknowns) -> Residuals:
        """The whitened errors of all responses, real and imaginary parts.

        Args:
            layout: what the unknowns are.
            data: the numbers of the problem.
            noise: with the weights.
            u: the unknowns, in the units of the model.
        """
        # A flight held out that is shorter than a window has no responses.
        if noise.whitening == ():
            return Residuals(jnp.zeros(0), None)
        return Residuals(rows_of_responses(layout, data, noise.whitening, u), None)

    def refusal(self, problem: Problem) -> str | None:
        """Other than linear models, and flights with too little in windows.

        Args:
            problem: what is to be fitted.
        """
        if not problem.model.linear:
            return (
                f"model {problem.model.name} is not linear; expected frequency-error, which "
                "takes it linear about where it flies, output-error or filter-error"
            )
        refused = absent_instrument(problem)
        if refused is not None:
            return refused
        try:
            first_weights(problem, problem.training)
        except ValueError as e:
            return str(e)
        return None

    def one_program(self, layout: Layout) -> bool:
        """Windows are transformed: a step is cheap to call for beside that."""
        return False

    def prepared_for(self, problem: Problem, noise: Noise, flights: Sequence[Flight]) -> Noise:
        """The weights to begin with, of what is measured.

        Args:
            problem: says which responses.
            noise: standard deviations by flight and output.
            flights: those fitted, or held out: of these too short ones have no responses.
        """
        try:
            weights = first_weights(problem, flights)
        except ValueError:
            if not all(f.hold_out for f in flights):
                raise
            return noise
        return noise._replace(whitening=on_device(weights))

    def relax(
        self, layout: Layout, data: Data, e: Any, noise: Noise, z: Float[Array, " q"]
    ) -> tuple[Float[Array, " q"], Noise]:
        """The spectrum of what no response explains of the errors.

        Args:
            layout: what the unknowns are.
            data: the numbers of the problem.
            e: not asked for.
            noise: so far.
            z: the unknowns.
        """
        z = in_time(layout, data, noise, z)
        u, weights = unpack(layout, data, z), back(noise.whitening)
        weights = weights._replace(simulated=_forgetful(layout, data, u, weights))
        weights = weights._replace(begun=(u.states, u.offsets))
        errors = np.asarray(errors_in_windows(layout, data, on_device(weights), z))
        shape = gusts_through(layout, data, z, weights.windows)
        density = noise_density(weights.windows, weights.averages, errors, shape)
        weights = weighed(weights, weights.simulated, density)
        level = -2.0 * weights.log_determinant / max(weights.numbers, 1.0)
        sd = _sd(layout, data, weights, z)
        return z, Noise(sd, np.asarray(level), on_device(weights))

    def log_likelihood(self, layout: Layout, data: Data, noise: Noise, e: Evaluation) -> float:
        """Of complex normal errors of the responses, in SI units of output over input.

        Args:
            layout: what the unknowns are.
            data: the numbers of the problem.
            noise: that `e` was evaluated with.
            e: the evaluation.
        """
        weights: ResponseWeights = noise.whitening
        squares = float(np.sum(np.square(np.asarray(e.r)[: 2 * weights.used.size])))
        constant = weights.numbers * float(np.log(np.pi))
        return 2.0 * weights.log_determinant - 0.5 * squares - constant

    def log_density(self, layout: Layout, data: Data, rows: Float[Array, " n"]) -> Array:
        """Of the whitened rows, the spectrum taken as it was estimated.

        Args:
            layout: what the unknowns are.
            data: the numbers of the problem.
            rows: those of the measurements, traced.
        """
        return -0.5 * jnp.sum(rows**2)

    def noise_unknowns(self, layout: Layout) -> int:
        """None that is counted: a smooth spectrum, and that of each candidate model its own."""
        return 0

    def numbers(self, layout: Layout, data: Data, noise: Noise) -> int:
        """Those that the noise's spectrum is taken from at the lines used.

        Args:
            layout: what the unknowns are.
            data: the numbers of the problem.
            noise: with the weights.
        """
        # The nuisances are not taken from them.
        return int(noise.whitening.numbers_of_noise) + layout.determined

    def records(self, reached: Solution, u: Unknowns, runs: int, seed: int) -> Sequence[dict]:
        """The simulated flights: what disturbs them is in the noise.

        Args:
            reached: where the fit ended.
            u: the unknowns there.
            runs: how many records; one simulation serves them all.
            seed: of nothing here, since nothing is drawn.
        """
        return OUTPUT_ERROR.records(reached, u, runs, seed)

    def errors_in_windows(
        self, layout: Layout, data: Data, noise: Noise, z: Array
    ) -> Complex[Array, "W k p"]:
        """Transforms of measured less modelled outputs; zero where an output is not seen.

        Args:
            layout: what the unknowns are.
            data: the numbers of the problem.
            noise: with the weights.
            z: the unknowns.
        """
        return errors_in_windows(layout, data, noise.whitening, z)

    def response_agreement(
        self, layout: Layout, data: Data, noise: Noise, z: Array, *, fitted: bool = True
    ) -> ResponseAgreement | None:
        """Chi-squared and Tischler's J of every response.

        Args:
            layout: what the unknowns are.
            data: the numbers of the problem.
            noise: at the optimum.
            z: the unknowns.
            fitted: whether the unknowns were fitted to these flights.
        """
        weights = back(noise.whitening)
        w, used = weights.windows, weights.used
        E = response_of(
            w, weights.averages, np.asarray(errors_in_windows(layout, data, noise.whitening, z))
        )
        H = response_of(w, weights.averages, w.Y)
        white = np.einsum("kab,kb->ka", weights.whitening, E.reshape(len(E), -1))
        # What the ends of the records add takes its part.
        ends = 0 if all(weights.simulated) else len(data.flights) * len(layout.states)
        taken = len(layout.of_interest) if fitted else 0
        freedom = max(2.0 * weights.numbers - taken - ends, 1.0)
        low, high = expected_interval(freedom, weights.numbers_of_noise)
        pairs = pair_agreements(
            w, used, H, E, weights.variance(), weights.coherence, weights.simulated
        )
        left_out = [f"{n}: its responses take no part, {why}." for n, why in w.left_out.items()]
        return ResponseAgreement(
            pairs,
            2.0 * float(np.sum(np.abs(white) ** 2)) / freedom,
            low,
            high,
            freedom,
            w.seconds,
            tuple(zip(w.outputs, w.averages.tolist(), strict=True)),
            w.instruments,
            (*left_out, *(() if w.together else (APART,))),
        )


def _forgetful(
    layout: Layout, data: Data, u: Unknowns, weights: ResponseWeights
) -> tuple[bool, ...]:
    """By output whether the model at the unknowns may be simulated over every flight."""
    drives = [driven(layout, data, u, i) for i in range(len(data.flights))]
    return outputs_that_forget(
        layout.model,
        [naming.asdict(d.params) for d in drives],
        [{n: np.asarray(v) for n, v in naming.asdict(d.inputs).items()} for d in drives],
        weights.windows,
    )


def _sd(layout: Layout, data: Data, weights: ResponseWeights, z: Array) -> tuple[dict, ...]:
    """By flight and output the residual's in time, or where no simulation stands that of the noise
    in the band."""
    runs = with_biases(layout, jax.device_get(simulated_at(layout, data, z)))
    w, sd = weights.windows, [dict[str, Any]() for _ in data.flights]
    in_band = np.mean(np.real(np.einsum("kpp->kp", weights.density)), axis=0)
    in_band = np.sqrt(in_band * max(float(np.ptp(w.hz)), 1.0 / w.seconds))
    for i, name in signals(layout):
        y = np.asarray(data.flights[i].outputs[name])
        left = (y - runs[i][name])[np.isfinite(y)]
        stands = name not in w.outputs or weights.simulated[w.outputs.index(name)]
        # A simulation that diverges overflows in its square.
        with np.errstate(all="ignore"):
            size = float(np.sqrt(np.mean(left**2))) if stands else np.nan
        if not np.isfinite(size):
            j = w.outputs.index(name) if name in w.outputs else 0
            size = float(in_band[j])
        sd[i][name] = np.asarray(max(size, least_noise(y)), y.dtype)
    return tuple(sd)


ESTIMATOR = FrequencyResponse()
