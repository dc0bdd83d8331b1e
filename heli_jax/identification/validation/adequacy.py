"""Adequacy of a model: the response to the inputs explains the record, up to noise and disturbance.

A wrong model can converge, and its parameters can be identifiable. So the simulated response of
every fitted output is tested. The acceptance card requires a variance accounted for (VAF) of 0.9;
Tischler and Remple (2012) and Jategaonkar (2006) use similar limits. A model is inadequate if it
leaves more than a fifth of the signal without its white noise unexplained, twice the card's limit.
Between the two limits it is doubtful. White residuals make it adequate at any VAF, since only
measurement noise remains. With filter error the simulation does not contain the disturbance, so
its error is compared with the error that the estimated disturbance predicts.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
import scipy.special

from heli_jax import naming
from heli_jax.analysis.operating_point import modes_of_flight
from heli_jax.identification.estimation.evaluation import Evaluation, evaluate
from heli_jax.identification.identifiability.verdict import Verdict
from heli_jax.identification.problem import Problem
from heli_jax.identification.unknowns.layout import FlightData, Solution
from heli_jax.identification.validation.metrics import (
    Metrics,
    Whiteness,
    metrics,
)
from heli_jax.messages import sentence
from heli_jax.numerics.white_noise import white_part

# params is Any: a record of a model's Params, whose class may be a user's own.

GATE = 0.9
"""VAF of the acceptance card; below it a model is doubtful unless its residuals are white."""
FAR_FROM_WHITE = 0.5
"""Autocorrelation of innovations at one sample beyond which the filter predicts badly.

A disturbance with one pole too few leaves 0.1 to 0.3."""
_GROWTH = 3.0
"""Least growth of an unstable mode over the record [e-foldings]."""


class OutputAdequacy(NamedTuple):
    """Adequacy of one output."""

    # The names of the fields are keys of fit.json.
    output: str
    adequate: bool
    vaf: float
    """VAF of the simulation (with `Adequacy.ahead`, of predictions) over all fitted flights."""
    explained: float
    """Explained share of the signal without its white noise."""
    white: bool
    """True if the residuals (innovations) of all flights are white."""
    lag1: float
    """Largest autocorrelation of the residuals (innovations) at one sample."""
    against_disturbance: float | None = None
    """Filter error: power of the simulation's error over that of disturbance and noise."""

    @property
    def doubtful(self) -> bool:
        """True if adequate, but below the card's gate and with residuals that are not white."""
        simulated = self.against_disturbance is None
        return self.adequate and simulated and not self.white and self.vaf < GATE

    @property
    def disturbed_below_mean(self) -> bool:
        """True if adequate with the estimated disturbance, but simulated worse than the mean."""
        return self.adequate and self.against_disturbance is not None and self.vaf < 0


class Record(NamedTuple):
    """Compared signals of a flight [SI], NaN where nothing is measured."""

    label: str
    measured: Mapping[str, np.ndarray]
    simulated: Mapping[str, np.ndarray]


def is_unstable(problem: Problem, params: Any, growth: float = _GROWTH) -> bool:
    """True if a mode of the linearised model grows by exp(growth) over the longest window.

    `params` is a record of the model's Params [SI].
    """
    # An eigenvalue just right of the axis is a slow drift, which the record does not show.
    longest = max(f.duration for f in problem.training)
    longest = longest if problem.window is None else min(longest, problem.window)
    for flight in problem.training:
        linearised = modes_of_flight(problem.model, params, flight, problem.substeps)
        if linearised is not None and np.max(np.real(linearised[0])) * longest > growth:
            return True
    return False


EXPLAINED = 0.8
"""Least explained share of the signal without its white noise."""
NEARLY_WHITE = 0.1
"""Largest coloured share of the variance of a residual that counts as noise."""
WORSE = -0.1
"""VAF below which a white residual is not noise alone; chance reaches a few hundredths below 0."""
EXPECTED = 9.0
"""Largest power of the simulation's error over that expected from the disturbance.

It is three standard deviations for a disturbance so slow that the record has one period of it."""


class Adequacy(NamedTuple):
    """Adequacy of the fitted outputs in time."""

    # The names of the first three fields are keys of fit.json.
    judged: tuple[OutputAdequacy, ...] = ()
    by_chance: bool = False
    """True if no response exceeds the noise, so that any optimum is one of chance."""
    ahead: float | None = None
    """Longest prediction [s] if predictions were tested in place of a simulation."""
    still: tuple[str, ...] = ()
    """Outputs that never move."""

    @property
    def denied(self) -> bool:
        """True if an output is not explained."""
        return self.by_chance or any(not output.adequate for output in self.judged)

    @property
    def explains_nothing(self) -> bool:
        """True if every output is simulated worse than its mean: no parameter is identifiable."""
        # With a disturbance, or predictions ahead, a good model's simulation may be as poor.
        if not self.denied or self.ahead is not None:
            return False
        simulated = any(o.against_disturbance is None for o in self.judged)
        return simulated and all(o.vaf < 0 for o in self.judged)


class Evidence(NamedTuple):
    """Fitted flights and their residuals, for the assessment of adequacy."""

    records: tuple[Record, ...]
    agreement: Mapping[str, Metrics]
    """Metrics of the simulation by output, over all fitted flights."""
    whiteness: Mapping[str, Whiteness]
    """Whiteness of the residuals (filter error: innovations) by 'flight/output'."""
    error_ratio: Mapping[str, float] | None = None
    """Power of the simulation's error over that of disturbance and noise, by output.

    None without a disturbance: the simulation alone must explain the record."""
    unknowns: int = 0
    """Number of estimated unknowns."""
    ahead: float | None = None
    """Longest prediction from a filter's states [s]; None for a simulation."""


def misses(expected: Mapping[str, float]) -> bool:
    """True if a simulation misses an output by more than the disturbance can explain.

    Args:
        expected: power of the simulation's error over the expected power, by output.
    """
    return max(expected.values()) > EXPECTED


def joined_metrics(name: str, records: Sequence[Record]) -> Metrics:
    """Return the metrics of one output over all records that have it."""
    both = [(r.measured[name], r.simulated[name]) for r in records if name in r.measured]
    measured, predicted = (np.concatenate(v) for v in zip(*both, strict=True))
    return metrics(measured, predicted)


def assess(problem: Problem, params: Any, evidence: Evidence) -> Adequacy:
    """Assess the adequacy of the model to the fitted flights.

    Args:
        params: the vehicle with the estimates in place, a record of the model's Params [SI].
        evidence: measured and simulated outputs, and their residuals.
    """
    disturbed = evidence.error_ratio is not None
    # Linearise only if needed, since this compiles a program.
    unstable = disturbed and evidence.ahead is None and is_unstable(problem, params)
    # An output that never moves has an error, but no VAF.
    still = tuple(
        n for n, m in evidence.agreement.items() if np.isnan(m.vaf) and np.isfinite(m.rmse)
    )
    outputs = tuple(
        _of_output(name, m, evidence, unstable)
        for name, m in evidence.agreement.items()
        if name not in still
    )
    bad = any(not output.adequate for output in outputs)
    noise = () if disturbed else tuple(o for o in outputs if _of_noise(o, evidence))
    # One output with a response is enough: these inputs may not move the others.
    if outputs and not bad and noise == outputs:
        outputs = tuple(output._replace(adequate=False) for output in outputs)
        return Adequacy(outputs, by_chance=True, still=still)
    return Adequacy(outputs, False, evidence.ahead, still)


_BY_CHANCE = 1e-3
"""Significance level of the response: probability that noise alone is explained equally well."""


def _of_noise(output: OutputAdequacy, evidence: Evidence) -> bool:
    """True if the model explains an output no better than it would explain noise.

    A likelihood ratio compares the model with a constant (Wilks, 1938).
    """
    unknowns = evidence.unknowns
    if unknowns < 1 or not np.isfinite(output.vaf):
        return False
    n = int(np.isfinite(_of_all_flights(output.output, evidence.records)).sum())
    # Twice the gain in log-likelihood for white noise of unknown variance is n log(1/(1 - VAF)).
    # For noise alone it is chi-squared with one degree of freedom per unknown.
    gain = -n * np.log(max(1.0 - output.vaf, 1e-300))
    return bool(scipy.special.chdtrc(unknowns, max(gain, 0.0)) >= _BY_CHANCE)


def _of_all_flights(name: str, records: tuple[Record, ...]) -> np.ndarray:
    """Return the measured output (any,), flight after flight."""
    return np.concatenate([r.measured[name] for r in records if name in r.measured])


def _of_output(name: str, m: Metrics, evidence: Evidence, unstable: bool) -> OutputAdequacy:
    records = [r for r in evidence.records if name in r.measured]
    tests = [evidence.whiteness[f"{r.label}/{name}"] for r in records]
    white = all(test.white for test in tests)
    lag1 = max((test.lag1 for test in tests), key=abs)
    ratio = None if evidence.error_ratio is None else evidence.error_ratio[name]
    error = [r.measured[name] - r.simulated[name] for r in records]
    explained, other = _explained(error, _of_all_flights(name, evidence.records))
    if not np.isfinite(m.vaf):
        return OutputAdequacy(name, False, m.vaf, float("nan"), white, lag1, ratio)
    # White noise does not count: with a noisy sensor even the best model has a low VAF.
    enough = explained >= EXPLAINED
    if ratio is None:
        noise_alone = (white or other <= NEARLY_WHITE) and m.vaf >= WORSE
        return OutputAdequacy(name, bool(enough or noise_alone), m.vaf, explained, white, lag1)
    # An unstable model allows any error of a simulation, so that only the innovations count.
    expected = ratio <= EXPECTED and (white or (abs(lag1) < FAR_FROM_WHITE and not unstable))
    adequate = bool(enough or expected)
    return OutputAdequacy(name, adequate, m.vaf, explained, white, lag1, ratio)


def _explained(error: list[np.ndarray], measured: np.ndarray) -> tuple[float, float]:
    """Return the explained share of the signal without white noise, and the error's coloured share.

    Args:
        error: residuals (N,) by flight.
        measured: the output over all flights.
    """
    with np.errstate(all="ignore"):  # a simulation that diverges overflows in its square
        residual, total = float(np.nanvar(np.concatenate(error))), float(np.nanvar(measured))
        # By flight, since a difference across two flights is no noise.
        sizes = [int(np.count_nonzero(~np.isnan(r))) for r in error]
        noises = [white_part(r) ** 2 for r in error]
        noise = float(np.average(noises, weights=sizes))
    if not np.isfinite(residual):
        return float("nan"), float("nan")
    # The estimated noise may exceed a residual that is noise alone.
    other = max(residual - noise, 0.0)
    rest = max(total - min(noise, residual), 1e-300)
    return 1.0 - other / rest, other / residual if residual > 0 else 0.0


# A filter can follow any record by its disturbance alone. The estimates then describe the noise
# and not the response to the inputs.


def inputs_explain_nothing(at: Solution, e: Evaluation, verdict: Verdict) -> Verdict:
    """Return the verdict; nothing is identifiable if the inputs explain nothing."""
    # Without a disturbance, `Adequacy.by_chance` tests the response against the noise.
    if not verdict.identifiable or not e.innovations:
        return verdict
    gain, free = gain_of_inputs(at, e), len(at.layout.free)
    # A gain of NaN keeps the verdict.
    if not scipy.special.chdtrc(free, max(gain, 0.0)) >= _BY_CHANCE:
        return verdict
    words = sentence(
        "verdict.inputs-explain-nothing",
        names=verdict.names,
        inputs=sorted({n for flight in at.data.flights for n in _moving(flight)}),
        gain=max(gain, 0.0),
        chance=scipy.special.chdtri(free, _BY_CHANCE),
    )
    return verdict.nothing(words)


def gain_of_inputs(at: Solution, e: Evaluation) -> float:
    """Return twice the log-likelihood gained by the inputs over inputs that rest at their means.

    NaN if no input moves. The unknowns are not estimated again. That could only reduce the gain, so
    an insignificant gain is certain.
    """
    layout, data, noise, z = at
    if not any(_moving(flight) for flight in data.flights):
        return float("nan")
    resting = []
    for flight in data.flights:
        inputs = naming.asdict(flight.inputs)
        means = {n: jnp.full_like(u, jnp.mean(u)) for n, u in inputs.items()}
        resting.append(flight._replace(inputs=naming.replace(flight.inputs, **means)))
    still = data._replace(flights=tuple(resting))
    without = evaluate(layout, still, noise, z)
    if not np.isfinite(without.r).all():
        return float("nan")
    likelihood = layout.objective.log_likelihood
    return 2.0 * (likelihood(layout, data, noise, e) - likelihood(layout, still, noise, without))


def _moving(flight: FlightData) -> list[str]:
    return [n for n, u in naming.asdict(flight.inputs).items() if np.ptp(np.asarray(u)) > 0]
