"""Outputs of a model that follow an input within a sample, such as an acceleration."""

from collections.abc import Mapping

import jax.numpy as jnp
import numpy as np
import scipy.linalg

from heli_jax import naming
from heli_jax.config.experiment import Experiment
from heli_jax.dynamics.jacobians import jacobians
from heli_jax.flights.flight import Signal

_AT_ONCE = 0.1
"""Smallest immediate step response of an output that jumps, relative to its largest within a
second."""
_WITHIN = 0.5
"""Smallest step response after one sample of an output that follows, likewise."""
_HORIZON = 1.0
"""Length of the step response [s]."""
_MOST_STEPS = 200


def follows(
    experiment: Experiment, rate: float | None, inputs: Mapping[str, Signal]
) -> Mapping[tuple[str, str], bool]:
    """Return the pairs of input and output that follow within a sample.

    The value is True if the output jumps at the same sample. The model is linearised with the free
    parameters at their starts.

    Args:
        rate: rate to which a log is resampled [Hz]; None without resampling, which needs no pairs.
        inputs: inputs of the log.
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
    # Columns: the step response of the state to each input, from rest.
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
    """Return the vehicle with the free parameters at their starts, or at one if unknown."""
    params, fit = experiment.vehicle.params, experiment.config.fit
    known = naming.asdict(params)
    starts = {}
    for name, free in ({} if fit is None else fit.free).items():
        if name in known:
            here = [float(v) for v in (free.start, np.asarray(known[name]))]
            # A coefficient with start zero counts as one.
            value = next((v for v in here if np.isfinite(v) and v != 0.0), 1.0)
            starts[name] = jnp.asarray(value, jnp.result_type(float))
    return naming.replace(params, **starts)
