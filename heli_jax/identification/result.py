"""What a fit gives: plain data."""

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np

from heli_jax.analysis.response_agreement import ResponseAgreement
from heli_jax.dynamics.disturbance import disturbable
from heli_jax.identification.estimation.multistart import StartRow
from heli_jax.identification.identifiability.verdict import Verdict
from heli_jax.identification.methods import METHODS, estimator_of
from heli_jax.identification.unknowns.layout import Solution
from heli_jax.identification.validation.adequacy import UNJUDGED, WORSE, Adequacy
from heli_jax.identification.validation.closed_loop_trust import Loop, Moved, untrusted
from heli_jax.identification.validation.excitation import ALIASED
from heli_jax.identification.validation.finding import Finding
from heli_jax.identification.validation.follows_response import Feedback
from heli_jax.identification.validation.held_out_agreement import HeldOutFrequency
from heli_jax.identification.validation.late_stick import LateStick
from heli_jax.identification.validation.metrics import Metrics, Whiteness

if TYPE_CHECKING:
    import pandas as pd

# Of a fit that converged too: numbers that the data do not determine are no estimates.
Status = Literal["converged", "not-converged", "not-identifiable"]


class Estimate(NamedTuple):
    """One estimated number; sd and interval are None where it is not identifiable."""

    value: float
    sd: float | None
    lower95: float | None
    upper95: float | None
    unit: str
    start: float
    """the initial guess"""
    prior_share: float
    """share of the posterior variance that the priors explain, 0 to 1"""
    at_bound: bool
    sd_white: float | None = None
    """the Cramer-Rao sd, as if the residuals were white; the same as `sd` where they are"""
    sd_alone: float | None = None
    """the Cramer-Rao sd if all other unknowns were known: Tischler's insensitivity"""


class SecondMethod(NamedTuple):
    """Where a method that weighs by the noise's spectrum has other values than output error. The
    names of the fields are keys of fit.json."""

    label: str
    """the method, as reports call it"""
    estimates: Mapping[str, tuple[float, float, float] | None]
    """by parameter that it does not bear out its estimate there and the ends of its 95 % interval;
    None where the data do not determine it by that method"""


class Signals(NamedTuple):
    """One flight as measured and as simulated; arrays (N,), SI."""

    flight: str
    hold_out: bool
    times: np.ndarray
    """[s]"""
    inputs: dict[str, np.ndarray]
    measured: dict[str, np.ndarray]
    simulated: dict[str, np.ndarray]
    """with the estimated bias"""
    innovations: dict[str, np.ndarray] | None = None
    """filter error: measured - predicted from all samples before, SI"""
    log_start: float | None = None
    """time in the log of the first sample [s], from the log's beginning; None without a log"""

    @property
    def log_times(self) -> np.ndarray:
        """Time in the log (N,) [s], as windows and notes count it; from zero without a log."""
        return self.times + (self.log_start or 0.0)

    def predicted(self, output: str) -> np.ndarray:
        """One sample ahead, from all samples before (filter error)."""
        assert self.innovations is not None
        return self.measured[output] - self.innovations[output]

    def residual(self, output: str) -> np.ndarray:
        """measured - simulated"""
        return self.measured[output] - self.simulated[output]

    def error(self, output: str) -> np.ndarray:
        """What the fit makes white: the innovations with filter error, else the residual."""
        return self.residual(output) if self.innovations is None else self.innovations[output]


@dataclass(frozen=True, eq=False)
class Check:
    """What is known before any fit."""

    verdict: Verdict
    noise: dict[str, float]
    """sd assumed for each flight and output"""
    notes: tuple[str, ...]
    guessed: tuple[str, ...] = ()
    """flights and outputs whose noise nobody stated"""
    findings: tuple[Finding, ...] = ()
    """whether the log is enough: bands, rates, outputs, feedback, what to fly next; worst first"""
    at_zero: dict[str, tuple[float, str]] = field(default_factory=dict)
    """by parameter that starts at zero, of which nothing is a part: the size [SI] that its expected
    sd is relative to, and the unit"""

    @property
    def further_notes(self) -> tuple[str, ...]:
        """The notes without those that a finding says too."""
        said = {f.sentence for f in self.findings}
        slow = any(f.topic == "logging rate" and f.bad for f in self.findings)
        return tuple(n for n in self.notes if n not in said and not (slow and ALIASED in n))


# Compared by identity (eq=False): a field-wise == of records of arrays has no single truth value.


@dataclass(frozen=True, eq=False)
class Fit:
    """The result of a fit: plain data."""

    model: str
    method: str
    status: Status
    n_samples: int
    estimates: dict[str, Estimate]
    nuisance: dict[str, Estimate]
    params: Any  # of the model's Params, a class of the user's
    """the vehicle with the estimates in place"""
    verdict_before: Verdict
    verdict: Verdict
    noise: dict[str, float]
    """residual sd for each flight and output: 'flight/output'"""
    log_likelihood: float
    """Gaussian, of the measured outputs in SI"""
    unknowns: int
    """all that was estimated: parameters, disturbance, noise, initial states, biases"""
    signals: tuple[Signals, ...]
    metrics: dict[str, Metrics]
    """of the simulation, over the fitted flights, by output"""
    validation: dict[str, Metrics]
    """of the simulation, over the flights held out, by output"""
    one_step: dict[str, Metrics]
    """filter error: of the prediction one sample ahead, over the fitted flights, by output"""
    one_step_validation: dict[str, Metrics]
    """the same over the flights held out"""
    whiteness: dict[str, Whiteness]
    starts: tuple[StartRow, ...]
    steps: int
    trace: tuple[tuple[int, float], ...]
    """(steps, cost) of every round of the optimiser"""
    notes: tuple[str, ...]
    reached: Solution
    """the optimum in the optimiser's coordinates, for profile, bootstrap and NUTS"""
    validation_free_run: dict[str, Metrics] = field(default_factory=dict)
    """with windows: the same simulated in one piece, from the initial state of the first window"""
    held_out_frequency: HeldOutFrequency | None = None
    """of a fit in frequency: what the flights held out say in frequency"""
    adequacy: Adequacy = UNJUDGED
    """whether the model explains what was measured, judged against what"""
    coloured: bool = False
    """whether `sd` and the intervals allow for autocorrelated (coloured) residuals"""
    responses: ResponseAgreement | None = None
    """frequency-response: how the model's responses agree with the measured ones"""
    feedback: tuple[Feedback, ...] = ()
    """by flight and input, whether it follows the response"""
    moved_by_feedback: Mapping[str, Moved] = field(default_factory=dict)
    """frequency error without an instrument: by parameter what feedback may have done to it"""
    weak_instrument: tuple[str, ...] = ()
    """the parameters of which an instrument tells too little"""
    held_upright: bool = False
    """in frequency: whether the model is unstable and the record does not grow, so that somebody
    closes a loop even where no input was found to follow the response"""
    instruments: tuple[str, ...] = ()
    """the inputs that were taken by their instrument"""
    disturbed_loop: bool = False
    """in time without process noise: whether inputs follow the response and the residuals are not
    white, so that a disturbance comes back through the inputs"""
    second_method: SecondMethod | None = None
    """where a method that weighs by the noise's spectrum differs from output error with coloured
    residuals, or from filter error whose values the inputs do not ask for; None where that was not
    asked"""
    late_stick: LateStick | None = None
    """by how much inputs look later than they acted, where that is clear and matters"""
    seed: int = 0
    timing: dict[str, float] = field(default_factory=dict)

    @property
    def method_label(self) -> str:
        """The method as reports call it."""
        label = METHODS[self.method].label
        by = ", ".join(self.instruments)
        return f"{label} by instrument ({by})" if by else label

    @property
    def untrusted(self) -> tuple[str, ...]:
        """The parameters that feedback may have biased, of which the instruments say too little, or
        that another method does not bear out."""
        if self.disturbed_loop:
            # Nothing tells which of them: a disturbance in the inputs moves all.
            return tuple(self.estimates)
        if self.not_borne_out:
            # One estimate of a wrong optimum is as wrong as another.
            return tuple(n for n, e in self.estimates.items() if e.sd is not None)
        loop = Loop(self.feedback, self.instruments, self.held_upright)
        doubted = (*untrusted(self.moved_by_feedback, loop), *self.weak_instrument)
        return tuple(n for n in self.estimates if n in doubted)

    @property
    def not_borne_out(self) -> tuple[str, ...]:
        """The parameters whose estimates a method that weighs by the noise's spectrum excludes, or,
        of output error with coloured residuals, does not determine."""
        return tuple(self.second_method.estimates) if self.second_method is not None else ()

    @property
    def distrust(self) -> str:
        """A sentence that belongs beside what the data determine; empty where all is trusted."""
        if not self.untrusted or self.status == "not-converged":
            return ""
        why = "weak instrument" if self.weak_instrument else "closed loop without an instrument"
        if self.disturbed_loop:
            why = "the inputs follow the response, and the residuals are not white"
        elif self.second_method is not None and self.second_method.estimates:
            names = ", ".join(self.not_borne_out)
            knows = "any gusts" if self.method == "filter-error" else "gusts"
            why = f"{self.second_method.label}, which allows for {knows}, does not bear {names} out"
        return f"Not to be trusted: {', '.join(self.untrusted)} ({why})."

    @property
    def not_identifiable(self) -> tuple[str, ...]:
        """The free parameters that the data do not determine."""
        return tuple(n for n, e in self.estimates.items() if e.sd is None)

    @property
    def lost(self) -> tuple[str, ...]:
        """Deprecated: the name that `not_identifiable` had."""
        _warn_renamed("lost", "not_identifiable")
        return self.not_identifiable

    @property
    def adequate(self) -> bool:
        """Whether the model explains what was measured (`adequacy` says why not)."""
        return self.adequacy.adequate

    @property
    def held_out_worse(self) -> tuple[str, ...]:
        """The outputs that flights held out show worse than their mean, by more than chance makes
        of one that does not respond; of a fit in frequency, of what follows the inputs there."""
        if self.held_out_frequency is not None:
            return self.held_out_frequency.worse
        # With gusts in the model, or no simulation in the fit, a simulation says little.
        estimator = estimator_of(self.method)
        if estimator.process_noise or estimator.noise_spectrum:
            return ()
        return tuple(n for n, m in self.validation.items() if not m.vaf >= WORSE)

    @property
    def disturbable(self) -> bool:
        """Whether filter error could be tried: its model has an axis to disturb and none yet."""
        # A disturbance on one axis already: its model has all that filter error asks for.
        model = self.reached.layout.model
        return model.noise_intensity is None and bool(disturbable(model))

    # `unknowns` counts noise, disturbance and initial states too: models that differ in these are
    # compared by differences of the criteria, in which the constants of the likelihood cancel.

    @property
    def aic(self) -> float:
        """Akaike's information criterion."""
        return 2.0 * self.unknowns - 2.0 * self.log_likelihood

    @property
    def bic(self) -> float:
        """Schwarz' information criterion."""
        return self.unknowns * float(np.log(self.n_samples)) - 2.0 * self.log_likelihood

    @property
    def overconfident(self) -> bool:
        """Whether the intervals are too narrow: coloured residuals that nothing allows for."""
        spectrum = estimator_of(self.method).noise_spectrum
        return not self.white and not self.coloured and not spectrum

    @property
    def narrow(self) -> bool:
        """Deprecated: the name that `overconfident` had."""
        _warn_renamed("narrow", "overconfident")
        return self.overconfident

    @property
    def interval(self) -> str:
        """What to call the intervals."""
        if self.status != "not-converged" and self.late_stick is not None:
            return "95 % (stick late)"
        if self.status != "not-converged" and self.coloured:
            return "95 % (autocorrelated residuals)"
        # Where no optimum was reached there are none.
        narrow = self.overconfident and self.status != "not-converged"
        return "95 % (too narrow)" if narrow else "95 % interval"

    @property
    def white(self) -> bool:
        """Whether all residuals look white, so that the intervals may be taken at their word."""
        return all(w.white for w in self.whiteness.values())

    # What prints and exports stands above this module in the order of imports, hence inside.

    def __repr__(self) -> str:
        from heli_jax.summaries import as_text, of_fit

        return as_text(of_fit(self))

    def _repr_html_(self) -> str:
        from heli_jax.summaries import as_html, of_fit

        return as_html(of_fit(self))

    def to_dataframe(self, *, nuisance: bool = False) -> "pd.DataFrame":
        """The estimates as a pandas data frame: a row each, with value, sd, lower95, upper95, unit
        and prior_share; NaN where the data do not determine a parameter.

        Args:
            nuisance: whether initial states, biases, gains and offsets follow the parameters.
        """
        from heli_jax.exports import estimates_frame

        return estimates_frame({**self.estimates, **(self.nuisance if nuisance else {})})


def _warn_renamed(old: str, new: str) -> None:
    warnings.warn(f"Fit: {old} is deprecated, expected {new}", DeprecationWarning, stacklevel=3)
