"""What to do about an output that the model does not explain."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from heli_jax import naming
from heli_jax.analysis.linear import modes
from heli_jax.dynamics.disturbance import disturbable
from heli_jax.flights.flight import Flight
from heli_jax.identification.methods import estimator_of
from heli_jax.identification.problem import MAX_TIME_SHIFT, Problem
from heli_jax.identification.validation.metrics import cross_correlation
from heli_jax.identification.validation.operating_point import operating_point
from heli_jax.simulation.simulate import simulate

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


class Judged(NamedTuple):
    """One output: what was judged, and the numbers."""

    output: str
    adequate: bool
    vaf: float
    """of the simulation, over all fitted flights"""
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


class Record(NamedTuple):
    """What is compared, by flight: SI, NaN where nothing is measured."""

    label: str
    dt: float
    measured: Mapping[str, np.ndarray]
    simulated: Mapping[str, np.ndarray]


def advice_for(
    problem: Problem, one: Judged, records: tuple[Record, ...], unstable: bool, apart: bool
) -> list[str]:
    """What fits the case, most telling first; only what this problem can do.

    `apart` says that other outputs are followed well: then this one's sensor is at fault, not the
    inputs, which all outputs share.
    """
    name, ways = one.output, []
    plain = not estimator_of(problem.method).process_noise
    i = max(
        (i for i, r in enumerate(records) if name in r.measured),
        key=lambda i: records[i].measured[name].size,
    )
    measured, dt = records[i].measured[name], records[i].dt
    correlation, lag = _alignment(measured, records[i].simulated[name], dt)
    # A parameter that keeps its sign shrinks until nothing moves: the start still tells.
    begun = _alignment(measured, _at_start(problem, problem.training[i], name), dt)[0]
    wrong = min(correlation, begun) < AGAINST
    if wrong:
        inputs = " and ".join(naming.names(problem.model.Inputs))
        where = "" if correlation < AGAINST else "At the start values the"
        ways.append(
            f"{where or 'The'} simulated {name} moves against the measured one: check the signs "
            f"and columns of {name} and {inputs}, and the signs of the start values."
        )
    elif abs(lag) > 0 and correlation > -AGAINST and not problem.nuisance.time_shift:
        late = "later" if lag > 0 else "earlier"
        ways.append(
            f"The simulated {name} agrees better {abs(lag):.3g} s {late}: check the time stamps"
            + (
                "."
                if apart or problem.window is not None
                else ", or set nuisance.time_shift: true."
            )
        )
    diverged = _diverges(name, records)
    if (diverged or unstable) and plain and problem.window is None:
        why = "diverges" if diverged else "is of an unstable model, in which any error grows"
        needs = "" if problem.nuisance.initial_state else ", nuisance.initial_state on"
        needs += ", nuisance.time_shift off" if problem.nuisance.time_shift else ""
        ways.append(
            f"The simulation {why}: simulate in windows with initial states of their own "
            f"(multiple shooting; fit.shooting: {{window: 2.0}}{needs})."
        )
    elif diverged and problem.window is not None:
        ways.append("The simulation diverges within its windows: make them shorter.")
    if one.lag1 > FAR_FROM_WHITE and plain and not wrong:
        axes = disturbable(problem.model)
        said = f"What is left of {name} is slow (autocorrelation {one.lag1:+.2f} at one sample): "
        if axes:
            said += (
                "a disturbance, or dynamics that the model lacks. For the first, method: "
                f"filter-error with disturbance: {{axis: {axes[0]}, poles: 1}}."
            )
        else:
            said += (
                "dynamics, inputs or a disturbance that the model lacks; it has no axis to "
                "disturb, so the remedy is a model that has them."
            )
        ways.append(said)
    if not ways and one.vaf >= 0:
        ways.append(
            "Are the columns, signs and units the right ones, and the start values near? Several "
            "starts (fit.starts) tell a poor optimum from a poor model."
        )
    return ways


def _at_start(problem: Problem, flight: Flight, name: str) -> np.ndarray:
    """The output (N,) simulated at the start values from the model's own initial state."""
    known = {n: jnp.asarray(v) for n, v in flight.known.items()}
    params = naming.replace(problem.start_params(), **known)
    run = simulate(problem.model, params, flight, substeps=problem.substeps)
    return np.asarray(getattr(run.outputs, name))


def _alignment(measured: np.ndarray, simulated: np.ndarray, dt: float) -> tuple[float, float]:
    """Correlation of measured and simulated at the lag [s] where it is largest in size.

    The lag is 0 unless the correlation there is clearly better; (0, 0) where nothing moves.
    """
    if not np.isfinite(simulated).all() or np.std(simulated) == 0:
        return 0.0, 0.0
    lags = max(1, min(round(MAX_TIME_SHIFT / dt), measured.size // 4))
    with np.errstate(all="ignore"):
        c = cross_correlation(simulated, measured, lags)
    if not np.isfinite(c).all():
        return 0.0, 0.0
    middle, best = float(c[lags]), int(np.argmax(np.abs(c)))
    if abs(c[best]) < abs(middle) + 0.1:
        return middle, 0.0
    return float(c[best]), (best - lags) * dt


def _diverges(name: str, records: tuple[Record, ...]) -> bool:
    for r in records:
        if name not in r.measured:
            continue
        simulated = r.simulated[name]
        if not np.isfinite(simulated).all():
            return True
        if np.max(np.abs(simulated)) > _DIVERGED * np.nanmax(np.abs(r.measured[name])):
            return True
    return False


def is_unstable(problem: Problem, params: Any) -> bool:
    """Whether a mode of the linearised model grows noticeably over the longest window."""
    longest = max(f.duration for f in problem.training)
    longest = longest if problem.window is None else min(longest, problem.window)
    for flight in problem.training:
        here = naming.replace(params, **{n: jnp.asarray(v) for n, v in flight.known.items()})
        at = operating_point(
            problem.model, here, flight.inputs, flight.outputs, flight.dt, substeps=problem.substeps
        )
        try:
            found = modes(problem.model, here, at.state, at.inputs)
        except np.linalg.LinAlgError:  # no finite matrices there: nothing is known of the modes
            continue
        if np.max(np.real(found)) * longest > _GROWTH:
            return True
    return False
