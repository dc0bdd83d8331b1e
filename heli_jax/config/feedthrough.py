"""Outputs of a model that follow an input within a sample, as an acceleration does the stick."""

from collections.abc import Mapping

import jax.numpy as jnp
import numpy as np
import scipy.linalg

from heli_jax import naming
from heli_jax.config.experiment import Experiment
from heli_jax.dynamics.jacobians import jacobians
from heli_jax.flights.flight import Signal

_AT_ONCE = 0.1
"""of the largest answer to a step within a second: an output that jumps by less does not jump"""
_WITHIN = 0.5
"""likewise, of what it does within a sample"""
_HORIZON = 1.0
"""s"""
_MOST_STEPS = 200


def follows(
    experiment: Experiment, rate: float | None, inputs: Mapping[str, Signal]
) -> Mapping[tuple[str, str], bool]:
    """The inputs that an output follows within a sample, and whether at the very sample.

    By the linearisation with the free parameters at their starts.

    Args:
        rate: to which a log is resampled [Hz]; None where it is not, and nobody has to know.
    """
    model = experiment.model
    if rate is None or all(s.hold == "linear" for s in inputs.values()):
        return {}
    matrices = jacobians(model, _params(experiment))
    A, B, C, D = (np.asarray(M, np.float64) for M in matrices)
    n, m = B.shape
    both = np.zeros((n + m, n + m))
    both[:n, :n], both[:n, n:] = A / rate, B / rate
    if not np.isfinite(both).all():
        return {}
    step = scipy.linalg.expm(both)
    # Columns: the state from rest, a while after each input has made a unit step.
    x, after = np.zeros((n, m)), [np.abs(D)]
    for _ in range(min(int(np.ceil(_HORIZON * rate)), _MOST_STEPS)):
        x = step[:n, :n] @ x + step[:n, n:]
        after.append(np.abs(C @ x + D))
    largest = np.max(after, axis=0)
    with np.errstate(invalid="ignore"):
        jumps = (after[0] >= _AT_ONCE * largest) & (largest > 0)
        quick = (after[1] >= _WITHIN * largest) & (largest > 0)
    return {
        (u, y): bool(jumps[i, j])
        for i, y in enumerate(naming.names(model.Outputs))
        for j, u in enumerate(naming.names(model.Inputs))
        if jumps[i, j] or quick[i, j]
    }


def _params(experiment: Experiment) -> naming.Record:
    """The vehicle with the free parameters at their starts, and at one where none is known."""
    params, fit = experiment.vehicle.params, experiment.config.fit
    known = naming.asdict(params)
    starts = {}
    for name, free in ({} if fit is None else fit.free).items():
        if name in known:
            here = [float(v) for v in (free.start, np.asarray(known[name]))]
            # A coefficient that a fit begins at zero is one all the same.
            value = next((v for v in here if np.isfinite(v) and v != 0.0), 1.0)
            starts[name] = jnp.asarray(value, jnp.result_type(float))
    return naming.replace(params, **starts)
