"""How well the sizes of noises are known, where all are told relative to a small one.

With the common scale of all noise concentrated out of the likelihood, the sizes among the unknowns
are relative to the measurement noise of one output. Behind an on-board filter that may be next to
nothing, and all that is relative to it is as uncertain as it is. In its own unit a size is its
coordinate plus the logarithm of the common scale, which moves by -1/2 of the mean of log s (the
variances of the innovations): large sizes beside a small reference stay where they are.
"""

import jax.numpy as jnp
import numpy as np

from heli_jax.identification.estimation.estimator import Evaluation
from heli_jax.identification.estimation.evaluation import combined_deviations, evaluate
from heli_jax.identification.estimation.filter_error import innovation_sums
from heli_jax.identification.estimation.measured_signals import measured_count
from heli_jax.identification.unknowns.layout import Solution

_STEP = 1e-3
"""of a coordinate, for a difference"""
_NO_EFFECT = 1e-5
"""of the largest singular value, below which a direction is that of the common scale"""
_TAKES_PART = 0.02
"""part of a direction without effect from which on a size is lost with it"""


def size_deviations(at: Solution, e: Evaluation) -> dict[str, float]:
    """By size of a noise the standard deviation of its logarithm, in its own unit; {} where the
    sizes are not relative to one that may vanish.

    Args:
        at: the optimum.
        e: what it tells.
    """
    layout = at.layout
    if not (layout.filtered and layout.concentrated and np.isfinite(e.J).all()):
        return {}
    n, shared = measured_count(at.data), layout.first_nuisance
    _, here = innovation_sums(e, at.noise)
    mean = np.zeros(layout.size)
    for j in range(shared):
        moved = evaluate(layout, at.data, at.noise, jnp.asarray(at.z).at[j].add(_STEP))
        mean[j] = (innovation_sums(moved, at.noise)[1] - here) / (n * _STEP)
    rows = np.tile(-0.5 * mean, (len(layout.sizes), 1))
    rows[range(len(layout.sizes)), [layout.disturbance_at(name) for name in layout.sizes]] += 1.0
    # The scale itself is known to 1/(2 n) from the innovations' squares.
    sds = combined_deviations(e.J, rows, _NO_EFFECT, _TAKES_PART)
    sds = np.sqrt(sds**2 + 0.5 / n)
    return dict(zip(layout.sizes, map(float, sds), strict=True))
