"""What to do about an output that the model does not explain."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from heli_jax import naming
from heli_jax.analysis.operating_point import modes_of_flight
from heli_jax.dynamics.disturbance import disturbable
from heli_jax.flights.flight import Flight
from heli_jax.identification.problem import MAX_TIME_SHIFT, Problem
from heli_jax.identification.validation.metrics import cross_correlation
from heli_jax.messages import sentence
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
    records: Sequence[Record],
    unstable: bool,
    apart: bool,
) -> str:
    """What to do about an output that is not explained: the most telling that this problem can do.

    Args:
        problem: what was fitted: what it has switched on already is no advice.
        unstable: whether the model is, over the length of the record.
        apart: whether other outputs are followed well: then this one's sensor is at fault, not the
            inputs, which all outputs share.
    """
    name, filtered = output.output, problem.noise_model == "disturbance"
    correlation, at_start, lag = _agreement(problem, name, records)
    if min(correlation, at_start) < AGAINST:
        inputs = naming.names(problem.model.Inputs)
        code = "advice.sign" if correlation < AGAINST else "advice.sign-at-start"
        return sentence(code, output=name, inputs=inputs)
    # The lag of signals that hardly agree anywhere is one of chance.
    if lag and correlation > -AGAINST and not problem.nuisance.time_shift:
        # A shift is shared by all outputs, and windows leave no room for one.
        code = "advice.lag" if apart or problem.window is not None else "advice.lag-of-all"
        later = "later" if lag > 0 else "earlier"
        return sentence(code, output=name, seconds=abs(lag), later=later)
    diverged = _diverges(name, records)
    if problem.window is not None and diverged:
        return sentence("advice.shorter-windows")
    # Filter error corrects its states at every sample, and needs no windows.
    if problem.window is None and (diverged or unstable) and not filtered:
        return sentence(
            "advice.windows",
            state="" if problem.nuisance.initial_state else "fit.nuisance.initial_state",
            shift="fit.nuisance.time_shift" if problem.nuisance.time_shift else "",
        )
    if output.lag1 > FAR_FROM_WHITE and not filtered:
        axes = disturbable(problem.model)
        code = "advice.disturbance" if axes else "advice.other-model"
        return sentence(code, output=name, lag1=output.lag1, axis=axes[0] if axes else "")
    return sentence("advice.columns") if output.vaf >= 0 else ""


def _agreement(
    problem: Problem, name: str, records: Sequence[Record]
) -> tuple[float, float, float]:
    """Correlation of an output with the simulated one, the same at the start values, and the lag of
    the first [s]."""
    # The longest record tells most.
    i = max(
        (i for i, r in enumerate(records) if name in r.measured),
        key=lambda i: records[i].measured[name].size,
    )
    measured, dt = records[i].measured[name], records[i].dt
    correlation, lag = _alignment(measured, records[i].simulated[name], dt)
    # A parameter that keeps its sign shrinks until nothing moves: the start still tells.
    at_start = _alignment(measured, _at_start(problem, problem.training[i], name), dt)[0]
    return correlation, at_start, lag


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


def _diverges(name: str, records: Sequence[Record]) -> bool:
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
