"""Whether the answer to the inputs, by itself, bears out what a filter has estimated.

Filter error learns from what the inputs do, and from how a disturbance goes through the machine.
Where the disturbance is not as assumed (it acts elsewhere, has another spectrum) the second is
wrong, and in strong gusts it prevails; innovations stay white, since parameters take up what the
disturbance's model lacks. Then the residual of the simulation follows the sensitivities of the
parameters: the inputs ask for other values.
"""

import numpy as np

from heli_jax.identification.estimation.estimator import Evaluation
from heli_jax.identification.unknowns.layout import Solution
from heli_jax.identification.validation.residual_slopes import (
    longest,
    of_one_clock,
    sensitivities,
)
from heli_jax.identification.validation.score_test import lines_of, pulled_away

_LEVEL = 1e-3
"""of all outputs together"""


def by_the_inputs(at: Solution, e: Evaluation) -> bool:
    """Whether nothing shows that the inputs ask for other values of the parameters.

    Args:
        at: where the fit ended.
        e: what that tells.
    """
    layout = at.layout
    if any(count > 1 for count, _ in layout.windows):
        return True
    flights, k = longest(at), len(layout.of_interest)
    J, chances = sensitivities(at, e), []
    for name in sorted({n for i in flights for n in layout.outputs[i]}):
        lines = []
        for i, own in of_one_clock(at, e, name):
            left, slopes = np.asarray(e.raw[i][name])[own.rows], J[i, name][own.rows]
            lines.append(lines_of(left, slopes, np.zeros((left.size, 0)), own.holes))
        lines = [one for one in lines if one is not None]
        if lines:
            chances.append(pulled_away(lines, k))
    return not chances or min(chances) * len(chances) > _LEVEL
