"""Adequacy of a model: it explains the record, beside noise and disturbance.

A wrong model can converge, and the data can determine its parameters. So the simulated response of
every fitted output is tested. The acceptance card asks for a variance accounted for (VAF) of 0.9
(Tischler and Remple, 2012, and Jategaonkar, 2006, use limits in that region). A model is inadequate
if it leaves more than a fifth of what is not white noise unexplained, twice what the card allows;
between the two it is doubtful. If the residuals are white, the model is adequate at any VAF: only
measurement noise is left. With filter error the simulation does not know the disturbance, so its
error is compared with what the estimated disturbance lets expect.
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
"""VAF that the acceptance card asks for: below it, with residuals not white, there is doubt"""
FAR_FROM_WHITE = 0.5
"""autocorrelation of innovations at one sample beyond which the filter predicts badly; a
disturbance with one pole too few leaves 0.1 to 0.3"""
_GROWTH = 3.0
"""an unstable mode that grows by e to this over the record"""


class OutputAdequacy(NamedTuple):
    """Adequacy of one output, and the numbers behind it."""

    # The names of the fields are keys of fit.json.
    output: str
    adequate: bool
    vaf: float
    """of the simulation (`Adequacy.ahead`: of predictions), over all fitted flights"""
    explained: float
    """share explained of what is not white noise"""
    white: bool
    """True if residuals (innovations) of all flights are white"""
    lag1: float
    """their largest autocorrelation at one sample"""
    against_disturbance: float | None = None
    """filter error: power of the simulation's error over that which disturbance and noise make"""

    @property
    def doubtful(self) -> bool:
        """Adequate, but with residuals that are not white below the card's gate."""
        simulated = self.against_disturbance is None
        return self.adequate and simulated and not self.white and self.vaf < GATE

    @property
    def disturbed_below_mean(self) -> bool:
        """Adequate beside the estimated disturbance, though the simulation by the inputs alone
        follows worse than the mean does."""
        return self.adequate and self.against_disturbance is not None and self.vaf < 0


class Record(NamedTuple):
    """Compared signals of a flight: SI, NaN where nothing is measured."""

    label: str
    measured: Mapping[str, np.ndarray]
    simulated: Mapping[str, np.ndarray]


def is_unstable(problem: Problem, params: Any, growth: float = _GROWTH) -> bool:
    """True if a mode of the linearised model grows by e to `growth` over the longest window;
    `params` is a record of the model's Params, SI."""
    # An eigenvalue just right of the axis is a slow drift, of which the record shows nothing.
    longest = max(f.duration for f in problem.training)
    longest = longest if problem.window is None else min(longest, problem.window)
    for flight in problem.training:
        linearised = modes_of_flight(problem.model, params, flight, problem.substeps)
        if linearised is not None and np.max(np.real(linearised[0])) * longest > growth:
            return True
    return False


# params is Any: a record of a model's Params, whose class may be a user's own.

EXPLAINED = 0.8
"""share of what is not white noise that has to be explained"""
NEARLY_WHITE = 0.1
"""largest share of the residual's variance that is not white noise, of a residual that counts as
noise"""
WORSE = -0.1
"""VAF below which a white residual is not noise alone; chance makes it a few hundredths negative"""
EXPECTED = 9.0
"""power of the simulation's error over that which the disturbance lets expect: its square root is
three standard deviations where the disturbance is so slow that the record holds one swing of it"""


class Adequacy(NamedTuple):
    """Adequacy of the fitted outputs in time."""

    # The names of the first three fields are keys of fit.json.
    judged: tuple[OutputAdequacy, ...] = ()
    by_chance: bool = False
    """True if no response stands out of the noise, so that any optimum is one of chance"""
    ahead: float | None = None
    """[s] longest prediction, where predictions were tested in place of a simulation"""
    still: tuple[str, ...] = ()
    """outputs that never move"""

    @property
    def denied(self) -> bool:
        """True if an output is not explained."""
        return self.by_chance or any(not output.adequate for output in self.judged)

    @property
    def explains_nothing(self) -> bool:
        """True if the model follows every output worse than its mean, so that the record determines
        none of its parameters."""
        # A disturbance, or predictions ahead, let a good model's simulation be as poor.
        if not self.denied or self.ahead is not None:
            return False
        simulated = any(o.against_disturbance is None for o in self.judged)
        return simulated and all(o.vaf < 0 for o in self.judged)


class Evidence(NamedTuple):
    """The fitted flights and their residuals, by which adequacy is assessed."""

    records: tuple[Record, ...]
    agreement: Mapping[str, Metrics]
    """of the simulation, by output over all fitted flights"""
    whiteness: Mapping[str, Whiteness]
    """by 'flight/output', of the residuals, with filter error of the innovations"""
    error_ratio: Mapping[str, float] | None = None
    """with a disturbance, by output the power of the simulation's error over that which disturbance
    and noise make; without, the simulation has to explain by itself"""
    unknowns: int = 0
    """number of estimated unknowns"""
    ahead: float | None = None
    """[s] longest prediction from a filter's states, of an unstable model; None of a simulation"""


def misses(expected: Mapping[str, float]) -> bool:
    """True if a simulation misses an output by more than its disturbance lets expect, from the
    power of its errors over that which is expected."""
    return max(expected.values()) > EXPECTED


def joined_metrics(name: str, records: Sequence[Record]) -> Metrics:
    """Metrics of one output over all records that have it."""
    both = [(r.measured[name], r.simulated[name]) for r in records if name in r.measured]
    measured, predicted = (np.concatenate(v) for v in zip(*both, strict=True))
    return metrics(measured, predicted)


def assess(problem: Problem, params: Any, evidence: Evidence) -> Adequacy:
    """Assess the adequacy of the model to the fitted flights.

    Args:
        params: the vehicle with the estimates in place, a record of the model's Params, SI.
        evidence: measured and simulated outputs, and what is left between them.
    """
    disturbed = evidence.error_ratio is not None
    # Linearising compiles a program: only where it counts.
    unstable = disturbed and evidence.ahead is None and is_unstable(problem, params)
    # An output that never moves has an error and no VAF.
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
    # One output that stands out is enough: the others may be ones that these inputs do not move.
    if outputs and not bad and noise == outputs:
        outputs = tuple(output._replace(adequate=False) for output in outputs)
        return Adequacy(outputs, by_chance=True, still=still)
    return Adequacy(outputs, False, evidence.ahead, still)


_BY_CHANCE = 1e-3
"""probability that noise alone is explained as well"""


def _of_noise(output: OutputAdequacy, evidence: Evidence) -> bool:
    """True if no more of an output is explained than of noise alone: a likelihood ratio of the
    model against a constant (Wilks, 1938)."""
    unknowns = evidence.unknowns
    if unknowns < 1 or not np.isfinite(output.vaf):
        return False
    n = int(np.isfinite(_of_all_flights(output.output, evidence.records)).sum())
    # Twice the gain in log-likelihood of white noise with unknown variance: n log(1/(1 - VAF)),
    # which noise alone makes chi-squared with one degree of freedom an unknown.
    gain = -n * np.log(max(1.0 - output.vaf, 1e-300))
    return bool(scipy.special.chdtrc(unknowns, max(gain, 0.0)) >= _BY_CHANCE)


def _of_all_flights(name: str, records: tuple[Record, ...]) -> np.ndarray:
    """The measured output (any,), flight after flight."""
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
    # By the share of what is not white noise: a good model of a noisy sensor has a low VAF, and no
    # better model could raise it.
    enough = explained >= EXPLAINED
    if ratio is None:
        noise_alone = (white or other <= NEARLY_WHITE) and m.vaf >= WORSE
        return OutputAdequacy(name, bool(enough or noise_alone), m.vaf, explained, white, lag1)
    # Of an unstable model the filter expects any error of a simulation: then its innovations are
    # all there is to judge by.
    expected = ratio <= EXPECTED and (white or (abs(lag1) < FAR_FROM_WHITE and not unstable))
    adequate = bool(enough or expected)
    return OutputAdequacy(name, adequate, m.vaf, explained, white, lag1, ratio)


def _explained(error: list[np.ndarray], measured: np.ndarray) -> tuple[float, float]:
    """Share explained of what is not white noise, and the part of the error that is not; `error`
    by flight."""
    with np.errstate(all="ignore"):  # a simulation that diverges overflows in its square
        residual, total = float(np.nanvar(np.concatenate(error))), float(np.nanvar(measured))
        # Flight by flight, since differences across the joint of two flights are no noise.
        sizes = [int(np.count_nonzero(~np.isnan(r))) for r in error]
        noises = [white_part(r) ** 2 for r in error]
        noise = float(np.average(noises, weights=sizes))
    if not np.isfinite(residual):
        return float("nan"), float("nan")
    # The guess of the noise may exceed a residual that is noise alone.
    other = max(residual - noise, 0.0)
    rest = max(total - min(noise, residual), 1e-300)
    return 1.0 - other / rest, other / residual if residual > 0 else 0.0


# A filter follows any record, if need be by its disturbance alone. The estimates are then those of
# the noise, and not of the response to the inputs.


def inputs_explain_nothing(at: Solution, e: Evaluation, verdict: Verdict) -> Verdict:
    """Return the verdict; nothing is identifiable if the inputs explain nothing."""
    # Without a disturbance the response has to stand out of the noise (`Adequacy.by_chance`).
    if not verdict.identifiable or not e.innovations:
        return verdict
    gain, free = gain_of_inputs(at, e), len(at.layout.free)
    # A gain that is NaN changes nothing.
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
    """Return twice the log-likelihood that the inputs gain at the optimum over inputs that rest at
    their means; NaN where no input moves.

    All unknowns stay as they are: estimated anew without the inputs the likelihood could only be
    larger, and the gain smaller, so that a gain of no account is certain.
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
