"""Adequacy of a model: the response to the inputs explains the record, up to noise and disturbance.

A wrong model can converge, and its parameters can be identifiable. So the simulated response of
every fitted output is tested. The acceptance card requires a variance accounted for (VAF) of 0.9;
Tischler and Remple (2012) and Jategaonkar (2006) use similar limits. A model is inadequate if it
leaves more than a fifth of the signal without its white noise unexplained, twice the card's limit.
White residuals make it adequate at any VAF, since only measurement noise remains. With filter error
the simulation does not contain the disturbance, so its error is compared with the error that the
estimated disturbance predicts.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from heli_jax.analysis.operating_point import modes_of_flight
from heli_jax.identification.problem import Problem
from heli_jax.identification.validation.metrics import (
    Metrics,
    Whiteness,
)
from heli_jax.numerics.white_noise import white_part

# params is Any: a record of a model's Params, whose class may be a user's own.

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


def unstable_poles(problem: Problem, params: Any, growth: float = _GROWTH) -> list[float]:
    """Return by fitted flight |p| [rad/s] of the fastest unstable mode of the linearised model; 0
    if no mode grows by exp(growth) over the flight, or over a window.

    `params` is a record of the model's Params [SI].
    """
    poles = []
    for flight in problem.training:
        linearised = modes_of_flight(problem.model, params, flight, problem.substeps)
        modes = np.zeros(1) if linearised is None else linearised[0]
        # An eigenvalue just right of the axis is a slow drift, which the record does not show.
        length = min(flight.duration, problem.window or np.inf)
        poles.append(float(np.max(np.abs(modes[np.real(modes) * length > growth]), initial=0.0)))
    return poles


def is_unstable(problem: Problem, params: Any, growth: float = _GROWTH) -> bool:
    """True if a mode grows in a flight; arguments as in `unstable_poles`."""
    return any(unstable_poles(problem, params, growth))


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
    """True if no output follows the inputs, so that any optimum is one of chance."""
    ahead: float | None = None
    """Longest prediction [s] if predictions were tested in place of a simulation."""

    @property
    def denied(self) -> bool:
        """True if an output is not explained."""
        return self.by_chance or any(not output.adequate for output in self.judged)

    @property
    def explains_nothing(self) -> bool:
        """True if every output is simulated worse than its mean: no parameter is identifiable."""
        # With a disturbance a good model's simulation may be as poor.
        simulated = any(o.against_disturbance is None for o in self.judged)
        return self.denied and simulated and all(o.vaf < 0 for o in self.judged)


def assess(
    pairs: Sequence[tuple[Mapping[str, np.ndarray], Mapping[str, np.ndarray]]],
    agreement: Mapping[str, Metrics],
    whiteness: Mapping[str, Whiteness],
    error_ratio: Mapping[str, float] | None = None,
    ahead: float | None = None,
) -> Adequacy:
    """Assess the adequacy of the model to the fitted flights.

    Args:
        pairs: measured and simulated outputs [SI] of each flight, NaN where nothing is measured.
        agreement: metrics of the simulation by output, over all flights.
        whiteness: whiteness of the residuals (filter error: innovations) by 'flight/output'.
        error_ratio: power of the simulation's error over that of disturbance and noise, by output;
            None without a disturbance, where the simulation alone must explain the record.
        ahead: longest prediction from a filter's states [s]; None for a simulation.
    """
    judged = []
    for name, m in agreement.items():
        both = [(y[name], simulated[name]) for y, simulated in pairs if name in y]
        tests = [w for key, w in whiteness.items() if key.rsplit("/", 1)[1] == name]
        ratio = None if error_ratio is None else error_ratio[name]
        # An output that never moves has an error, but no VAF.
        if np.isfinite(m.vaf) or not np.isfinite(m.rmse):
            judged.append(_of_output(name, m, both, tests, ratio))
    return Adequacy(tuple(judged), False, ahead)


def _of_output(
    name: str,
    m: Metrics,
    both: Sequence[tuple[np.ndarray, np.ndarray]],
    tests: Sequence[Whiteness],
    ratio: float | None,
) -> OutputAdequacy:
    white = all(test.white for test in tests)
    lag1 = max((test.lag1 for test in tests), key=abs)
    if not np.isfinite(m.vaf):
        return OutputAdequacy(name, False, m.vaf, float("nan"), white, lag1, ratio)
    explained, other = _explained(both)
    # White noise does not count: with a noisy sensor even the best model has a low VAF.
    adequate = explained >= EXPLAINED
    if ratio is None:
        adequate |= (white or other <= NEARLY_WHITE) and m.vaf >= WORSE
    else:
        adequate |= ratio <= EXPECTED and (white or abs(lag1) < FAR_FROM_WHITE)
    return OutputAdequacy(name, bool(adequate), m.vaf, explained, white, lag1, ratio)


def _explained(both: Sequence[tuple[np.ndarray, np.ndarray]]) -> tuple[float, float]:
    """Return the explained share of the signal without white noise, and the error's coloured share.

    Args:
        both: measured and simulated (N,) by flight.
    """
    error = [measured - simulated for measured, simulated in both]
    with np.errstate(all="ignore"):  # a simulation that diverges overflows in its square
        residual = float(np.nanvar(np.concatenate(error)))
        total = float(np.nanvar(np.concatenate([measured for measured, _ in both])))
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
