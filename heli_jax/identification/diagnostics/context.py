"""Context of the diagnostics: one point of a problem, with everything computed there."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import jax
import numpy as np

from heli_jax.analysis.response_agreement import ResponseAgreement
from heli_jax.flights.flight import Flight, labels
from heli_jax.identification.estimation.evaluation import Evaluation
from heli_jax.identification.estimation.filter_error import (
    SECONDS,
    expected_error,
    predictions_ahead,
)
from heli_jax.identification.estimation.frequency_instrument import instruments_of
from heli_jax.identification.estimation.frequency_lines import errors_of_lines
from heli_jax.identification.estimation.noise_covariance import RelaxedOptimum
from heli_jax.identification.identifiability.equivalents import second_solutions
from heli_jax.identification.identifiability.verdict import Verdict
from heli_jax.identification.problem import Problem
from heli_jax.identification.result import Estimate, Signals, Status
from heli_jax.identification.uncertainty.estimates import (
    StandardErrors,
    estimates_of,
    flight_nuisances,
    noise_by_name,
    standard_errors,
    without_disturbance,
)
from heli_jax.identification.unknowns.layout import Solution, scales_of
from heli_jax.identification.validation.adequacy import (
    EXPECTED,
    Adequacy,
    assess,
    is_unstable,
    unstable_poles,
)
from heli_jax.identification.validation.closed_loop_trust import moved_by_feedback
from heli_jax.identification.validation.excitation import (
    LEVEL,
    Followed,
    errors_against_excitation,
    excitation_of,
)
from heli_jax.identification.validation.follows_response import Feedback, feedback_of
from heli_jax.identification.validation.held_out import (
    HeldOutFrequency,
    validate,
    validate_in_frequency,
)
from heli_jax.identification.validation.logging_rate import (
    aliased_parameters,
    measurement_noise,
)
from heli_jax.identification.validation.metrics import (
    Metrics,
    Whiteness,
    metrics,
    outputs_correlated,
    pooled_metrics,
    signals_of,
    whiteness_of,
)
from heli_jax.identification.validation.unmodelled import Unmodelled, unmodelled
from heli_jax.messages import sentence


class HeldOut(NamedTuple):
    """Predictions of the held-out flights."""

    signals: tuple[Signals, ...] = ()
    free_run: tuple[Signals, ...] = ()
    """Simulation in one piece, if the fit uses windows."""
    in_frequency: HeldOutFrequency | None = None


@dataclass(frozen=True, eq=False)
class Context:
    """A point of a problem, with results that are computed on demand.

    The point is the start values before a fit, else the end of the search.
    """

    problem: Problem
    at: Solution
    e: Evaluation
    """Evaluation at the point."""
    before: Verdict
    """Identifiability at the start values."""
    optimum: RelaxedOptimum | None = None
    """End of the search; None before a fit."""

    @property
    def fitted(self) -> bool:
        """True if the point is the end of a search."""
        return self.optimum is not None

    @property
    def at_optimum(self) -> bool:
        """True if the point is an optimum."""
        return self.optimum is not None and bool(self.optimum.best.converged)

    @cached_property
    def flights(self) -> list[tuple[str, Flight]]:
        """The fitted flights with their labels."""
        training = self.problem.training
        return list(zip(labels(training), training, strict=True))

    @property
    def free(self) -> tuple[str, ...]:
        """The free parameters."""
        return self.at.layout.free

    @property
    def named(self) -> dict[str, float]:
        """Value of each unknown of interest [SI]."""
        names = self.at.layout.of_interest
        return {n: float(v) for n, v in zip(names, self.e.named, strict=True)}

    @cached_property
    def params(self) -> Any:  # a record of the model's Params, a class of the user's
        """The vehicle with the values of the free parameters in place."""
        return self.problem.params_with({n: v for n, v in self.named.items() if n in self.free})

    # Residuals of the record.

    @cached_property
    def signals(self) -> tuple[Signals, ...]:
        """Measured and simulated signals of the fitted flights."""
        return signals_of(self.problem.training, self.e.simulated, self.e.innovations)

    @cached_property
    def metrics(self) -> dict[str, Metrics]:
        """Metrics of the simulation, by output."""
        return pooled_metrics(self.signals)

    @cached_property
    def whiteness(self) -> dict[str, Whiteness]:
        """Whiteness of the innovations, or else of the residuals, by 'flight/output'."""
        return whiteness_of(self.signals, self.e, self.problem.training, self.at.layout)

    @property
    def white(self) -> bool:
        """True if the residuals, or innovations, of each output are white."""
        return all(w.white for w in self.whiteness.values())

    @cached_property
    def independent(self) -> bool:
        """True if the residuals, or innovations, are white and not correlated between outputs."""
        return self.white and not outputs_correlated(self.signals)

    # Feedback to the inputs.

    @cached_property
    def feedback(self) -> tuple[Feedback, ...]:
        """Test results for feedback, by flight and input."""
        # A late log looks like feedback: shift each input to the time at which it acted.
        delays = {n: (e.value, e.sd) for n, e in self.estimates.items()} if self.at_optimum else {}
        return feedback_of(self.problem, delays)

    @property
    def follows(self) -> bool:
        """True if an input follows the response."""
        return any(one.present for one in self.feedback)

    @cached_property
    def _poles(self) -> list[float]:
        """Poles in a fit of lines that only a loop can keep from growing, see `unstable_poles`."""
        objective, none = self.at.layout.objective, [0.0] * len(self.flights)
        lines = objective.noise_model == "spectrum" and not objective.fits_responses
        return unstable_poles(self.problem, self.params) if lines else none

    @property
    def held(self) -> bool:
        """True for a fit in frequency of an unstable model, which only a loop can hold."""
        return bool(self.moved) and any(self._poles)

    @cached_property
    def moved(self) -> dict[str, float]:
        """Share of information that may be feedback, by unknown of interest, in frequency."""
        if not self.at_optimum or self.unrelated:
            return {}
        poles = [0.0] * len(self._poles) if self.instruments else self._poles
        return moved_by_feedback(self.at, poles)

    @cached_property
    def instruments(self) -> tuple[str, ...]:
        """Inputs that are taken by instrument."""
        if self.responses is not None:
            return self.responses.instruments
        by_instrument = self.at.data.flights[0].by_instrument is not None
        return instruments_of(self.problem) if by_instrument else ()

    # Adequacy of the model.

    @cached_property
    def responses(self) -> ResponseAgreement | None:
        """Agreement of the model's responses with the measured ones, if responses are fitted."""
        if not self.fitted:
            return None
        layout, data, noise, z = self.at
        return layout.objective.response_agreement(layout, data, noise, z)

    @cached_property
    def followed(self) -> dict[str, Followed]:
        """Part of the residual that follows the excitation, by output, in frequency."""
        objective = self.at.layout.objective
        if objective.noise_model != "spectrum" or objective.fits_responses:
            return {}
        errors = jax.device_get(errors_of_lines(*self.at).errors)
        return errors_against_excitation(self.problem.training, self.at, errors, self.instruments)

    @cached_property
    def expected_error(self) -> dict[str, float] | None:
        """Power of the simulation's error over that expected from the disturbance, by output.

        None if the simulation alone must explain the record.
        """
        layout = self.at.layout
        # Without any significant disturbance the fit is that of output error.
        if layout.disturbance and set(layout.disturbance) <= set(self.absent):
            return None
        return expected_error(self.at, self.e) if layout.noise_model == "disturbance" else None

    @cached_property
    def ahead(self) -> bool:
        """True if predictions some seconds ahead are tested in place of a simulation.

        The model is unstable, or gusts moved it beyond the range in which it is nearly linear.
        """
        expected = self.expected_error
        return expected is not None and (
            is_unstable(self.problem, self.params)
            or (not self.problem.model.linear and self.white and max(expected.values()) > EXPECTED)
        )

    @cached_property
    def unmodelled(self) -> tuple[list[Unmodelled], tuple[float, dict[str, float]]]:
        """Drives that the residuals follow beyond chance, and values that the inputs prefer.

        Empty unless the fit converged, explains the record, and no input follows the response.
        """
        tested = self.at_optimum and self.explains and not (self.instruments or self.ahead)
        if not tested or self.follows:
            return [], (1.0, {})
        coloured = self.errors.coloured and self.at.layout.noise_model != "spectrum"
        names = [label for label, _ in self.flights]
        return unmodelled(self.at, self.e, names, coloured=coloured)

    @cached_property
    def adequacy(self) -> Adequacy:
        """Adequacy of the fitted outputs in time.

        Empty for a fit in frequency, or if no output follows the excitation.
        """
        if self.responses is not None or self.followed or self.unrelated:
            return Adequacy(by_chance=bool(self.unrelated))
        if self.ahead:
            return self._adequacy_ahead()
        pairs = [(s.measured, s.simulated) for s in self.signals]
        return assess(pairs, self.metrics, self.whiteness, self.expected_error)

    @cached_property
    def unrelated(self) -> dict[str, float]:
        """Probability that each output follows the excitation by chance.

        Empty if any output follows it significantly, or if no input moves.
        """
        p_values = excitation_of(self.problem)
        return {} if any(p < LEVEL / len(p_values) for p in p_values.values()) else p_values

    def _adequacy_ahead(self) -> Adequacy:
        """Return the adequacy of predictions from the filter's states, in place of a simulation."""
        predictions = predictions_ahead(self.at)
        pairs = [
            (flight.outputs, {n: flight.outputs[n] - np.asarray(v) for n, v in p.error.items()})
            for (_, flight), p in zip(self.flights, predictions, strict=True)
        ]
        error, expected, agreement = {}, {}, {}
        for n in self.metrics:
            have = [
                (y[n], predicted[n], np.asarray(p.variance[n]))
                for (y, predicted), p in zip(pairs, predictions, strict=True)
                if n in y
            ]
            measured, predicted, variance = (np.concatenate(v) for v in zip(*have, strict=True))
            agreement[n] = metrics(measured, predicted)
            error[n] = float(np.nansum(np.square(measured - predicted)))
            expected[n] = float(np.nansum(variance))
        ratio = {n: error[n] / expected[n] if expected[n] > 0 else np.inf for n in error}
        return assess(pairs, agreement, self.whiteness, ratio, ahead=SECONDS)

    # Estimates and their uncertainty.

    @property
    def absent(self) -> tuple[str, ...]:
        """Parameters of disturbances that are not significant."""
        return () if self.optimum is None else self.optimum.absent

    @cached_property
    def errors(self) -> StandardErrors:
        """Standard errors of the estimates; none if the model explains nothing."""
        noise = measurement_noise(self.problem, self.at.noise.sd)
        errors = standard_errors(
            self.problem,
            self.at,
            self.e,
            self.before,
            white=self.white if self.e.innovations else self.independent,
            aliased=aliased_parameters(self.problem, self.named, noise),
            second=second_solutions(self.problem, self.at, self.e) if self.at_optimum else (),
            optimum=self.at_optimum,
        )
        if not self.at_optimum or self.explains:
            return errors
        verdict = errors.verdict
        outputs = [o.output for o in self.adequacy.judged]
        words = sentence("verdict.model-explains-nothing", names=verdict.names, outputs=outputs)
        return errors._replace(verdict=verdict.nothing(words), limits={})

    @property
    def explains(self) -> bool:
        """True if the model explains any part of the record."""
        return not self.adequacy.explains_nothing

    @property
    def verdict(self) -> Verdict:
        """Verdict on identifiability at the point."""
        return self.errors.verdict if self.fitted else self.before

    @property
    def status(self) -> Status:
        """Status of the fit: convergence, then identifiability."""
        if not (self.at_optimum and np.isfinite(self.e.J).all()):
            return "not-converged"
        return "converged" if self.verdict.identifiable else "not-identifiable"

    @cached_property
    def estimates(self) -> dict[str, Estimate]:
        """Estimates of free parameters, input gains and the time shift; none before a fit."""
        if not self.fitted:
            return {}
        return self._bounded(estimates_of(self.problem, self.at, self.e, self.errors))

    @cached_property
    def nuisance(self) -> dict[str, Estimate]:
        """Estimates of all other unknowns: disturbance, initial states, biases, offsets."""
        layout = self.at.layout
        found = {k: v for k, v in self.estimates.items() if k not in layout.free}
        # A fit in frequency does not determine initial states and biases, so has no intervals.
        if layout.noise_model != "spectrum":
            found |= self._bounded(flight_nuisances(self.problem, self.at, self.e, self.errors))
        gone = {n: without_disturbance(found[n], size=n in layout.sigmas) for n in self.absent}
        return found | gone

    def _bounded(self, estimates: dict[str, Estimate]) -> dict[str, Estimate]:
        """Return the estimates, without intervals if the fit did not converge."""
        if self.status != "not-converged":
            return estimates
        return {n: e.without_interval() for n, e in estimates.items()}

    @cached_property
    def noise(self) -> dict[str, float]:
        """Standard deviation of the measurement noise by 'flight/output' [SI]."""
        return noise_by_name(self.problem, self.at.noise, scales_of(self.at.layout, self.at.z))

    @cached_property
    def held_out(self) -> HeldOut:
        """Predictions of the held-out flights, with their own initial states and biases."""
        problem, at = self.problem, self.at
        flights = tuple(f for f in problem.flights if f.hold_out)
        if not flights or not self.fitted:
            return HeldOut()
        (signals, free_run), in_frequency = validate(problem, at, flights), None
        if self.at_optimum:
            feedback = (self.held or self.follows) and not self.instruments
            in_frequency = validate_in_frequency(problem, at, self.e, flights, feedback=feedback)
        return HeldOut(signals, free_run, in_frequency)

    @cached_property
    def rounding(self) -> bool:
        """True if the numbers are rounding, as in a filter with too little noise."""
        return self.at.layout.objective.ill_conditioned(self.problem, self.e, self.noise)
