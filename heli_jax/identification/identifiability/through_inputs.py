"""What the inputs and the initial states tell, apart from what the colour of a disturbance tells.

The gain of a filter depends on the machine's parameters, so that innovations inform on these in two
ways: by the response, and by the correlation of what the response does not explain. The second
part is information only as far as disturbance and measurement noise are what the model says. Where
the innovations are not white they are not, and it then fixes combinations that no input shows, at
values of the noise's making and with narrow intervals.

On the record that the model itself simulates the innovations are zero, and so is the second part:
the Jacobian of the innovations there is that of the response, weighed as the filter weighs it.
"""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from heli_jax.identification.estimation.estimator import Evaluation
from heli_jax.identification.estimation.evaluation import deviations, evaluate
from heli_jax.identification.identifiability.sentences import listed
from heli_jax.identification.identifiability.verdict import Verdict
from heli_jax.identification.unknowns.layout import FlightData, Layout, Solution

_LEFT = 10.0
"""of a signal's variance, from which on the error of its simulation says that it left the record"""
_NOISE_ONLY = 1e-6
"""part of a parameter's effect on the innovations below which its effect on the response is none"""


def through_inputs(at: Solution, e: Evaluation) -> Evaluation | None:
    """The optimum with the Jacobian of what inputs and initial states alone tell.

    With a row for each free parameter that only noise has, such as a process noise of the model's
    own: that is no question to the inputs.

    None without innovations, and where a simulation leaves its record (an unstable machine), so
    that what of it the inputs make is not known.

    Args:
        at: the optimum of a method with process noise.
        e: what it tells.
    """
    if not e.innovations or not (np.isfinite(e.J).all() and np.isfinite(e.r).all()):
        return None
    pairs = list(zip(at.data.flights, e.simulated, strict=True))
    if any(
        _left(np.asarray(y), np.asarray(simulated[n]))
        for flight, simulated in pairs
        for n, y in flight.outputs.items()
        if np.nanstd(np.asarray(y)) > 0
    ):
        return None
    simulated = at.data._replace(flights=tuple(_simulated(*pair) for pair in pairs))
    J = np.array(evaluate(at.layout, simulated, at.noise, at.z).J)
    # Between the samples' rows and the priors' stand those of the innovations' variances, which
    # are noise too.
    priors = len(at.layout.free) + at.layout.size - at.layout.first_nuisance
    J[at.layout.estimator.row_signals(at.layout, at.data).size : len(J) - priors] = 0.0
    if not np.isfinite(J).all():
        return None
    return e._replace(J=np.vstack([*_of_noise_alone(at.layout, J, e.J), J]))


def _simulated(flight: FlightData, simulated: dict[str, np.ndarray]) -> FlightData:
    """The flight with its simulated outputs, missing where the measured ones are."""
    return flight._replace(
        outputs={
            n: jnp.where(jnp.isfinite(y), jnp.asarray(simulated[n], jnp.asarray(y).dtype), jnp.nan)
            for n, y in flight.outputs.items()
        }
    )


def _of_noise_alone(
    layout: Layout, by_inputs: Float[np.ndarray, "n q"], J: Float[np.ndarray, "n q"]
) -> list[Float[np.ndarray, " q"]]:
    """Rows with what the innovations tell of free parameters that no response has."""
    sds = deviations(J)
    return [
        np.eye(layout.size)[i] / sds[i]
        for i in range(len(layout.free))
        if np.linalg.norm(by_inputs[:, i]) < _NOISE_ONLY * np.linalg.norm(J[:, i])
        and np.isfinite(sds[i])
    ]


def not_by_inputs(verdict: Verdict, by_inputs: Verdict) -> tuple[str, ...]:
    """The parameters that are determined, and are not by the inputs alone.

    Args:
        verdict: of all that the innovations tell.
        by_inputs: of what the responses tell.
    """
    lacking = {*verdict.undetermined, *verdict.without_effect}
    alone = {*by_inputs.undetermined, *by_inputs.without_effect}
    return tuple(n for n in verdict.names if n in alone and n not in lacking)


def resting_on_disturbance(names: Sequence[str]) -> str:
    """That parameters rest on the model of the disturbance, whose innovations are white."""
    return (
        f"By the inputs alone the data do not determine {listed(tuple(names), 'or')}: "
        f"{'it rests' if len(names) == 1 else 'they rest'} on the model of the disturbance."
    )


def not_counted(names: Sequence[str]) -> str:
    """That what a disturbance tells of parameters does not count."""
    return (
        f"What the colour of the innovations tells of {listed(tuple(names))} does not count, since "
        "they are not white: disturbance or noise are not what the model says."
    )


@np.errstate(over="ignore", invalid="ignore")
def _left(measured: np.ndarray, simulated: np.ndarray) -> bool:
    """Whether a simulation (N,) left what was measured (N,), NaN where nothing was."""
    seen = ~np.isnan(measured)
    error = (measured - simulated)[seen]
    return not float(np.var(error)) <= _LEFT * float(np.var(measured[seen]))
