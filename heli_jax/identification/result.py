"""Result of a fit, as plain data."""

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np

from heli_jax.analysis.response_agreement import ResponseAgreement
from heli_jax.finding import Distrust, Finding, distrusted, exit_code, sentences
from heli_jax.identification.estimation.multistart import StartRow
from heli_jax.identification.identifiability.verdict import Verdict
from heli_jax.identification.methods import METHODS, objective_of
from heli_jax.identification.unknowns.layout import Solution
from heli_jax.identification.validation.adequacy import Adequacy
from heli_jax.identification.validation.follows_response import Feedback
from heli_jax.identification.validation.held_out import HeldOutFrequency
from heli_jax.identification.validation.metrics import Metrics, Signals, Whiteness

if TYPE_CHECKING:
    import pandas as pd

_DOUBTFUL_TOPICS = ("adequacy", "dynamics", "units", "timing", "quality")
"""Topics of findings that raise doubts about an adequate model."""
Status = Literal["converged", "not-converged", "not-identifiable"]


class Estimate(NamedTuple):
    """One estimate; sd and interval are None if it is not identifiable."""

    value: float
    sd: float | None
    lower95: float | None
    upper95: float | None
    unit: str
    start: float
    """Initial guess."""
    prior_share: float
    """Share of the prior in the posterior precision, 0 to 1."""
    at_bound: bool
    sd_white: float | None = None
    """Cramér-Rao sd for white residuals."""
    sd_alone: float | None = None
    """Cramér-Rao sd if all other unknowns were known: Tischler's insensitivity."""

    def without_interval(self) -> "Estimate":
        """Return the estimate without sd and interval."""
        return self._replace(sd=None, lower95=None, upper95=None, sd_white=None, sd_alone=None)


@dataclass(frozen=True, eq=False)
class Check:
    """Result of `check`, before any fit."""

    verdict: Verdict
    noise: dict[str, float]
    """Assumed sd by flight and output."""
    guessed: tuple[str, ...] = ()
    """Flights and outputs without stated noise."""
    findings: tuple[Finding, ...] = ()
    """Findings, the most severe first."""
    at_zero: dict[str, tuple[float, str]] = field(default_factory=dict)
    """For each parameter that starts at zero: the size [SI] that scales its expected sd, and its
    unit."""
    log_notes: tuple[Finding, ...] = ()
    """Notes from reading the logs."""

    def __repr__(self) -> str:
        doubts = sentences(f for f in self.findings if f.bad)
        return "\n".join([self.verdict.text, *(f"! {doubt}" for doubt in doubts)])


# Compared by identity (eq=False), because == of array fields has no single truth value.


@dataclass(frozen=True, eq=False)
class Fit:
    """Result of a fit, as plain data."""

    model: str
    method: str
    status: Status
    n_samples: int
    estimates: dict[str, Estimate]
    nuisance: dict[str, Estimate]
    params: Any  # Params, possibly a user's class
    """Vehicle with the estimates."""
    verdict_before: Verdict
    verdict: Verdict
    noise: dict[str, float]
    """Residual sd by 'flight/output'."""
    log_likelihood: float
    """Gaussian log-likelihood of the measured outputs in SI."""
    unknowns: int
    """Number of all estimated unknowns: parameters, disturbance, noise, initial states, biases."""
    signals: tuple[Signals, ...]
    metrics: dict[str, Metrics]
    """Metrics of the simulation by output, over the fitted flights."""
    validation: dict[str, Metrics]
    """Metrics of the simulation by output, over the held-out flights."""
    one_step: dict[str, Metrics]
    """Filter error: metrics of one-step predictions by output, over the fitted flights."""
    one_step_validation: dict[str, Metrics]
    """Filter error: metrics of one-step predictions by output, over the held-out flights."""
    whiteness: dict[str, Whiteness]
    starts: tuple[StartRow, ...]
    steps: int
    trace: tuple[tuple[int, float], ...]
    """Steps and cost of each round of the optimiser."""
    findings: tuple[Finding, ...]
    reached: Solution
    """Optimum in the optimiser's coordinates, for profile, bootstrap and NUTS."""
    validation_free_run: dict[str, Metrics] = field(default_factory=dict)
    """Windows: metrics of an uninterrupted simulation from the first window's initial state."""
    held_out_frequency: HeldOutFrequency | None = None
    """Fit in frequency: agreement with the held-out flights in frequency."""
    adequacy: Adequacy = field(default_factory=Adequacy)
    """Adequacy of the model for the fitted outputs."""
    coloured: bool = False
    """True if `sd` and intervals allow for autocorrelated (coloured) residuals."""
    responses: ResponseAgreement | None = None
    """Agreement of the model's frequency responses with the measured ones."""
    feedback: tuple[Feedback, ...] = ()
    """For each flight and input, whether the input follows the response (feedback)."""
    instruments: tuple[str, ...] = ()
    """Inputs replaced by their instruments."""
    seed: int = 0
    timing: dict[str, float] = field(default_factory=dict)

    @property
    def method_label(self) -> str:
        """Name of the method in reports."""
        label = METHODS[self.method].label
        by = ", ".join(self.instruments)
        return f"{label} by instrument ({by})" if by else label

    @property
    def distrusts(self) -> dict[str, Distrust]:
        """Reason to distrust an interval, by parameter or nuisance; empty without an optimum."""
        if self.status == "not-converged":
            return {}
        return distrusted(self.findings, {**self.nuisance, **self.estimates})

    @property
    def untrusted(self) -> tuple[str, ...]:
        """Parameters with untrustworthy intervals."""
        return tuple(self.distrusts)

    @property
    def distrust(self) -> str:
        """One sentence for each reason to distrust intervals; empty if all are trusted."""
        by_reason: dict[str, list[str]] = {}
        for name, d in self.distrusts.items():
            by_reason.setdefault(d.brief, []).append(name)
        return " ".join(
            f"Do not use {' or '.join(names)}: {reason}." for reason, names in by_reason.items()
        )

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences of the findings, except those that only confirm that all is well."""
        return tuple(sentences(f for f in self.findings if f.severity != "ok"))

    @property
    def exit_code(self) -> int:
        """Exit code of the command line: 0, 3 or 4."""
        return exit_code(self.status, self.adequate, self.distrusts)

    @property
    def not_identifiable(self) -> tuple[str, ...]:
        """Free parameters that are not identifiable."""
        return tuple(n for n, e in self.estimates.items() if e.sd is None)

    @property
    def adequate(self) -> bool:
        """True if no finding shows that the model fails to explain the record."""
        return not any(f.denies for f in self.findings)

    @property
    def doubts(self) -> tuple[str, ...]:
        """Doubts about the model that do not deny its adequacy, each in a few words."""
        return tuple(
            f.brief
            for f in self.findings
            if f.bad and f.brief and f.code.partition(".")[0] in _DOUBTFUL_TOPICS
        )

    @property
    def adequate_in_words(self) -> str:
        """`yes`, `doubtful (...)`, `not judged` (no optimum), or `no (VAF of p is 20.0 %)`."""
        if self.status == "not-converged":
            return "not judged"
        if self.reasons_against:
            return f"no ({'; '.join(self.reasons_against)})"
        return f"doubtful ({self.doubts[0]})" if self.doubts else "yes"

    @property
    def reasons_against(self) -> tuple[str, ...]:
        """Reasons why the model is not adequate, each in a few words."""
        return tuple(dict.fromkeys(f.brief for f in self.findings if f.denies))

    # `unknowns` also counts noise, disturbance and initial states. Models are compared by
    # differences of the criteria, in which the constants of the likelihood cancel.

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
        """True if intervals are too narrow, because residuals are autocorrelated."""
        spectrum = objective_of(self.method).noise_model == "spectrum"
        return not self.white and not self.coloured and not spectrum

    @property
    def interval(self) -> str:
        """Name of the intervals."""
        if self.status != "not-converged" and self.coloured:
            return "95 % (autocorrelated residuals)"
        # Without an optimum there are no intervals.
        narrow = self.overconfident and self.status != "not-converged"
        return "95 % (too narrow)" if narrow else "95 % interval"

    @property
    def white(self) -> bool:
        """True if all residuals look white."""
        return all(w.white for w in self.whiteness.values())

    # The modules that print and export import this one, so they are imported inside.

    def __repr__(self) -> str:
        from heli_jax.summaries import of_fit

        return of_fit(self)

    def to_dataframe(self, *, nuisance: bool = False) -> "pd.DataFrame":
        """Return the estimates as a pandas data frame, one row each.

        The columns are value, sd, lower95, upper95, unit and prior_share. Values are NaN if a
        parameter is not identifiable.

        Args:
            nuisance: append initial states, biases, gains and offsets.
        """
        from heli_jax.exports import estimates_frame

        return estimates_frame({**self.estimates, **(self.nuisance if nuisance else {})})
