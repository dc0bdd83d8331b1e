"""How large a disturbance can be: of the size that moves the outputs as far as was measured."""

from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np

from heli_jax import naming
from heli_jax.dynamics.jacobians import jacobians
from heli_jax.dynamics.model import Disturbance, Model

_DEEPEST = 4
"""integrations from a derivative to an output that are looked through: position, flapping, bar"""


def push_scales(
    model: Model,
    params: Any,  # the model's Params, whose class may be a user's own
    inputs: Mapping[str, float],
    outputs: Mapping[str, float],
    disturbances: tuple[Disturbance, ...],
) -> dict[str, float]:
    """By the name of each sigma a standard deviation to begin with, SI.

    A push that lasts for a second reaches an output through C A^k, k integrations away. The scale
    is what would move the most sensitive output as far as it was measured to move.

    Args:
        model: the disturbed one, n states.
        params: its parameters at the first guess, SI.
        inputs: at the first sample, SI.
        outputs: standard deviation of what was measured, by name, SI.
        disturbances: those to scale.
    """
    at = model.Inputs(**{n: jnp.asarray(v) for n, v in inputs.items()})
    A, _, C, _ = (np.asarray(M) for M in jacobians(model, params, model.initial_state(params), at))
    rows = [naming.names(model.Outputs).index(n) for n in outputs]
    sds, states = np.array(list(outputs.values())), naming.names(model.State)
    # One that no output shows is taken as large as the largest motion, whatever its unit.
    unseen = float(sds.max(initial=0.0)) or 1.0
    return {
        d.sigma: _scale(A, C[rows], sds, states.index(d.state)) if d.state else unseen
        for d in disturbances
    }


def _scale(A: np.ndarray, C: np.ndarray, sds: np.ndarray, state: int) -> float:
    """sd of an output over what a unit push does to it, the least of all outputs; 1 unless seen.

    Args:
        A: (n, n).
        C: (p, n), of the measured outputs.
        sds: (p,), of what was measured.
        state: the number of the state that is pushed.
    """
    reach, least = C, np.inf
    for _ in range(_DEEPEST):
        effect = np.abs(reach[:, state])
        seen = np.isfinite(effect) & (effect > 0) & (sds > 0)
        # The most sensitive output bounds the push: a larger one would have moved it further than
        # was measured.
        least = min(least, float((sds[seen] / effect[seen]).min(initial=np.inf)))
        # The nearest outputs say it best: further on the same motion comes filtered.
        if np.isfinite(least):
            return least
        reach = reach @ A
    return 1.0
