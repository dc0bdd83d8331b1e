"""Do the inputs explain anything? A filter follows any record, if need be by its disturbance alone.

What is then estimated is the colour of the noise, and not how the machine answers: from other
starts, or with another disturbance, it is something else, with an interval as narrow.
"""

import jax.numpy as jnp
import numpy as np
import scipy.special

from heli_jax import naming
from heli_jax.identification.estimation.estimator import Evaluation
from heli_jax.identification.estimation.evaluation import evaluate
from heli_jax.identification.identifiability.sentences import listed
from heli_jax.identification.identifiability.verdict import Verdict
from heli_jax.identification.unknowns.layout import Data, FlightData, Solution

_BY_CHANCE = 1e-3
"""probability that inputs which do nothing gain as much of the likelihood"""


def unless_inputs_explain_nothing(at: Solution, e: Evaluation, verdict: Verdict) -> Verdict:
    """The verdict; where the inputs explain nothing that determines no parameter.

    Args:
        at: the optimum.
        e: what it tells.
        verdict: what the data determine as the model has it.
    """
    # Without a disturbance that is asked of the response: it has to stand out of the noise.
    if not verdict.identifiable or not e.innovations:
        return verdict
    gain = gain_of_inputs(at, e)
    free = len(at.layout.free)
    # Written so that a gain that is no number changes nothing.
    if not scipy.special.chdtrc(free, max(gain, 0.0)) >= _BY_CHANCE:
        return verdict
    names = sorted({n for flight in at.data.flights for n in _moving(flight)})
    sentence = (
        f"The data do not determine {listed(verdict.names, 'or')}: {listed(names)} "
        f"{'explain' if len(names) > 1 else 'explains'} nothing of what was measured (twice the "
        f"log-likelihood gained by the inputs is {max(gain, 0.0):.2g}, chance alone makes up to "
        f"{scipy.special.chdtri(free, _BY_CHANCE):.2g}), so that the estimates are those of the "
        "disturbance and the noise. Larger inputs are needed, or other columns: are these the "
        "signals that move the machine?"
    )
    return verdict.nothing(sentence)


def gain_of_inputs(at: Solution, e: Evaluation) -> float:
    """Twice the log-likelihood that the inputs gain at the optimum over inputs that rest at their
    means; NaN where no input moves.

    All unknowns stay as they are: estimated anew without the inputs the likelihood could only be
    larger, and the gain smaller, so that a gain of no account is certain.

    Args:
        at: the optimum.
        e: what it tells.
    """
    if not any(_moving(flight) for flight in at.data.flights):
        return float("nan")
    still = at.data._replace(flights=tuple(_at_rest(flight) for flight in at.data.flights))
    without = evaluate(at.layout, still, at.noise, at.z)
    if not np.isfinite(without.r).all():
        return float("nan")
    return 2.0 * (_likelihood(at, at.data, e) - _likelihood(at, still, without))


def _likelihood(at: Solution, data: Data, e: Evaluation) -> float:
    return at.layout.estimator.log_likelihood(at.layout, data, at.noise, e)


def _moving(flight: FlightData) -> list[str]:
    return [n for n, u in naming.asdict(flight.inputs).items() if np.ptp(np.asarray(u)) > 0]


def _at_rest(flight: FlightData) -> FlightData:
    """The flight with each input at its mean, of the same shapes and types."""
    still = {n: jnp.full_like(u, jnp.mean(u)) for n, u in naming.asdict(flight.inputs).items()}
    return flight._replace(inputs=naming.replace(flight.inputs, **still))
