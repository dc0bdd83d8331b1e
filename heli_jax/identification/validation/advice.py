"""What to do about an output that the model does not explain."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from heli_jax import naming
from heli_jax.analysis.operating_point import modes_of_flight
from heli_jax.dynamics.disturbance import disturbable
from heli_jax.flights.flight import Flight
from heli_jax.identification.methods import estimator_of
from heli_jax.identification.problem import MAX_TIME_SHIFT, Problem
from heli_jax.identification.validation.metrics import cross_correlation
from heli_jax.simulation.simulate import simulate

# params is Any: a record of a model's Params, whose class may be a user's own.

GATE = 0.9
"""VAF that the acceptance card asks for: below it, with residuals not white, there is doubt"""
FAR_FROM_WHITE = 0.5
"""autocorrelation of innovations at one sample beyond which the filter predicts badly; a
disturbance with one pole too few leaves 0.1 to 0.3"""
AGAINST = -0.3
"""correlation below which a simulated output moves against the measured one"""
_DIVERGED = 10.0
"""a simulation that leaves the measured range by this factor"""
_GROWTH = 3.0
"""an unstable mode that grows by e to this over the record"""


class OutputAdequacy(NamedTuple):
    """Whether one output is explained, and by what numbers."""

    # The names of the fields are keys of fit.json.
    output: str
    adequate: bool
    vaf: float
    """of the simulation (`Adequacy.ahead`: of predictions), over all fitted flights"""
    explained: float
    """share explained of what is not white noise"""
    white: bool
    """whether residuals (innovations) of all flights are white"""
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
    """What is compared, by flight: SI, NaN where nothing is measured."""

    label: str
    dt: float
    """[s]"""
    measured: Mapping[str, np.ndarray]
    simulated: Mapping[str, np.ndarray]


def advice_for(
    problem: Problem,
    output: OutputAdequacy,
    records: tuple[Record, ...],
    unstable: bool,
    apart: bool,
) -> list[str]:
    """What fits the case, most telling first; only what this problem can do.

    Args:
        problem: what was fitted: what it has switched on already is no advice.
        output: the output that is not explained, with its numbers.
        records: the fitted flights.
        unstable: whether the model is, over the length of the record.
        apart: whether other outputs are followed well: then this one's sensor is at fault, not the
            inputs, which all outputs share.
    """
    wrong_sign, ways = _sign_or_lag(problem, output.output, records, apart)
    ways += _windows(problem, _diverges(output.output, records), unstable)
    # With the sign turned the whole response is left over, and that is slow too.
    output_error = not estimator_of(problem.method).process_noise
    if output.lag1 > FAR_FROM_WHITE and output_error and not wrong_sign:
        ways.append(_slow_residual(problem, output))
    if not ways and output.vaf >= 0:
        ways.append(
            "Are the columns, signs and units the right ones, and the start values near? Several "
            "starts (fit.starts) tell a poor optimum from a poor model."
        )
    return ways


def _sign_or_lag(
    problem: Problem, name: str, records: tuple[Record, ...], apart: bool
) -> tuple[bool, list[str]]:
    """Whether an output moves against the measured one, and what to do about that or its lag."""
    # The longest record tells most.
    i = max(
        (i for i, r in enumerate(records) if name in r.measured),
        key=lambda i: records[i].measured[name].size,
    )
    measured, dt = records[i].measured[name], records[i].dt
    correlation, lag = _alignment(measured, records[i].simulated[name], dt)
    # A parameter that keeps its sign shrinks until nothing moves: the start still tells.
    at_start = _alignment(measured, _at_start(problem, problem.training[i], name), dt)[0]
    if min(correlation, at_start) < AGAINST:
        inputs = " and ".join(naming.names(problem.model.Inputs))
        the = "The" if correlation < AGAINST else "At the start values the"
        return True, [
            f"{the} simulated {name} moves against the measured one: check the signs "
            f"and columns of {name} and {inputs}, and the signs of the start values."
        ]
    # The lag of signals that hardly agree anywhere is one of chance.
    if abs(lag) > 0 and correlation > -AGAINST and not problem.nuisance.time_shift:
        late = "later" if lag > 0 else "earlier"
        # A shift is shared by all outputs, and windows leave no room for one.
        shift = ", or set fit.nuisance.time_shift: true"
        remedy = "" if apart or problem.window is not None else shift
        return False, [
            f"The simulated {name} agrees better {abs(lag):.3g} s {late}: check the time "
            f"stamps{remedy}."
        ]
    return False, []


def _windows(problem: Problem, diverged: bool, unstable: bool) -> list[str]:
    """Where errors grow along the record: multiple shooting, or shorter windows of it."""
    if problem.window is not None:
        if not diverged:
            return []
        return ["The simulation diverges within its windows: make them shorter."]
    # Filter error corrects its states at every sample, and needs no windows.
    if not (diverged or unstable) or estimator_of(problem.method).process_noise:
        return []
    why = "diverges" if diverged else "is of an unstable model, in which any error grows"
    needs = "" if problem.nuisance.initial_state else ", fit.nuisance.initial_state on"
    needs += ", fit.nuisance.time_shift off" if problem.nuisance.time_shift else ""
    return [
        f"The simulation {why}: simulate in windows with initial states of their own "
        f"(multiple shooting; fit.shooting: {{window: 2.0}}{needs})."
    ]


def _slow_residual(problem: Problem, output: OutputAdequacy) -> str:
    slow = (
        f"What is left of {output.output} is slow (autocorrelation {output.lag1:+.2f} at one "
        "sample): "
    )
    axes = disturbable(problem.model)
    if not axes:
        return slow + (
            "dynamics, inputs or a disturbance that the model lacks; it has no axis to "
            "disturb, so the remedy is a model that has them."
        )
    return slow + (
        "a disturbance, or dynamics that the model lacks. For the first, method: "
        f"filter-error with disturbance: {{axis: {axes[0]}, poles: 1}}."
    )


def _at_start(problem: Problem, flight: Flight, name: str) -> np.ndarray:
    """The output (N,) simulated at the start values from the model's own initial state."""
    # In one piece even where the fit has windows: the sign of a response shows from its beginning.
    params = problem.start_params(flight.known)
    run = simulate(problem.model, params, flight, substeps=problem.substeps)
    return np.asarray(getattr(run.outputs, name))


def _alignment(measured: np.ndarray, simulated: np.ndarray, dt: float) -> tuple[float, float]:
    """Correlation of measured and simulated at the lag [s] where it is largest in size.

    The lag is 0 unless the correlation there is clearly better; (0, 0) where nothing moves.
    """
    # A simulation that overflowed has no correlation; that it diverged is said elsewhere.
    if not np.max(np.abs(simulated)) < 1e100 or np.std(simulated) == 0:
        return 0.0, 0.0
    lags = max(1, min(round(MAX_TIME_SHIFT / dt), measured.size // 4))
    with np.errstate(all="ignore"):
        # Missing samples add nothing to the products and all of the simulation to their scale.
        share = float(np.mean(~np.isnan(measured)))
        c = cross_correlation(simulated, measured, lags) / np.sqrt(share)
    if not np.isfinite(c).all():
        return 0.0, 0.0
    # Largest in size: a response of the wrong sign is aligned where it is most negative.
    middle, best = float(c[lags]), int(np.argmax(np.abs(c)))
    # Over so many lags chance alone finds one that is a little better than none.
    if abs(c[best]) < abs(middle) + 0.1:
        return middle, 0.0
    return float(c[best]), (best - lags) * dt


def _diverges(name: str, records: tuple[Record, ...]) -> bool:
    """Whether in some flight the simulation leaves what was measured by far."""
    for r in records:
        if name not in r.measured:
            continue
        simulated = r.simulated[name]
        if not np.isfinite(simulated).all():
            return True
        if np.max(np.abs(simulated)) > _DIVERGED * np.nanmax(np.abs(r.measured[name])):
            return True
    return False


def is_unstable(problem: Problem, params: Any, growth: float = _GROWTH) -> bool:
    """Whether a mode of the linearised model grows by e to `growth` over the longest window;
    `params` is a record of the model's Params, SI."""
    # An eigenvalue just right of the axis is a slow drift, of which the record shows nothing.
    longest = max(f.duration for f in problem.training)
    longest = longest if problem.window is None else min(longest, problem.window)
    for flight in problem.training:
        linearised = modes_of_flight(problem.model, params, flight, problem.substeps)
        if linearised is not None and np.max(np.real(linearised[0])) * longest > growth:
            return True
    return False
