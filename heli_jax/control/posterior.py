"""Vehicles drawn from the posterior of a fit, each with its steady flight."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heli_jax import naming
from heli_jax.analysis.trim import (
    HOVER,
    Condition,
    equilibrium,
    is_full_nonlinear,
    is_trimmed,
    trim,
)
from heli_jax.dynamics.model import Model, zeros

_SYMMETRIC = 0.02
"""Largest relative difference of the halves of an interval that is symmetric in the logarithm."""
_STILL = 1e-9
"""Largest rate of a state at rest [SI]."""
_TWO_SIDED = 1.959963984540054


class SteadyFlights(NamedTuple):
    """Steady flights, with arrays (k,)."""

    state: Any
    inputs: Any


def draws(fit: Any, count: int, seed: int = 0) -> dict[str, np.ndarray]:
    """Return values (count,) of the estimated parameters from the posterior; the first is its mode.

    Args:
        fit: a `Fit`, or a `SavedFit` of a run directory.

    Raises:
        ValueError: a parameter is not identifiable, so that its posterior has no width.
    """
    estimates = fit.estimates
    for name, e in estimates.items():
        if e.sd is None or not np.isfinite(e.sd):
            raise ValueError(
                f"{name} is not identifiable: expected a prior for it, or a fixed value"
            )
        if e.lower95 is None or e.upper95 is None:
            raise ValueError(f"{name} has no interval in this fit, expected one that is adequate")
    content: Mapping[str, Any] | None = getattr(fit, "content", None)
    if content is None:
        order, correlation = fit.verdict.names, fit.verdict.correlation
    else:
        order, correlation = content["verdict"]["names"], content["verdict"]["correlation"]
    rows = [list(order).index(n) for n in estimates]
    R = np.asarray(correlation, float)[np.ix_(rows, rows)]
    size, vectors = np.linalg.eigh(0.5 * (R + R.T))
    root = vectors * np.sqrt(np.maximum(size, 0.0))
    z = np.random.default_rng(seed).standard_normal((count, len(rows))) @ root.T
    z[0] = 0.0
    return {n: _drawn(e, z[:, i]) for i, (n, e) in enumerate(estimates.items())}


def _drawn(e: Any, z: np.ndarray) -> np.ndarray:
    """Return a parameter's values from standard normal numbers, in the form of its interval."""
    low, value, high = e.lower95, e.value, e.upper95
    if value != 0.0 and low / value > 0.0 and high / value > 0.0:
        below, above = np.log(value / low), np.log(high / value)
        if abs(above - below) <= _SYMMETRIC * abs(above + below):
            return value * np.exp(z * (above + below) / (2.0 * _TWO_SIDED))
    return value + e.sd * z


def vehicles_of(
    model: Model, params: Any, values: Mapping[str, np.ndarray], condition: Condition = HOVER
) -> tuple[Any, SteadyFlights, int]:
    """Return vehicles with drawn parameters, arrays (k,), their steady flights, and failures.

    Linear models are steady at zero, others are trimmed. Vehicles without the steady flight are
    left out and counted.

    Args:
        values: parameters (k,) by name, the mode first; none: the vehicle itself.

    Raises:
        ValueError: the first vehicle has no steady flight in this condition.
    """
    count = len(next(iter(values.values()))) if values else 1

    def all_alike(record: Any) -> Any:
        return jax.tree.map(lambda v: jnp.full(count, jnp.asarray(v, float)), record)

    vehicles = naming.replace(all_alike(params), **{n: jnp.asarray(v) for n, v in values.items()})
    if not is_full_nonlinear(model):
        return vehicles, all_alike(_at_rest(model, params)), 0
    found = eqx.filter_jit(jax.vmap(lambda p: equilibrium(model, p, condition)))(vehicles)
    kept = np.flatnonzero(is_trimmed(found))
    if 0 not in kept:
        trim(model, jax.tree.map(lambda v: v[0], vehicles), condition)
        raise ValueError("the first vehicle has no steady flight")
    vehicles, state, inputs = jax.tree.map(lambda v: v[kept], (vehicles, found.state, found.inputs))
    return vehicles, SteadyFlights(state, inputs), count - len(kept)


def _at_rest(model: Model, params: Any) -> SteadyFlights:
    """Return the state of zeros.

    Raises:
        ValueError: the model moves there.
    """
    at = SteadyFlights(zeros(model.State), zeros(model.Inputs))
    rates = naming.asdict(model.vector_field(params, *at))
    moving = [n for n, v in rates.items() if not abs(float(v)) < _STILL]
    if moving:
        raise ValueError(f"model {model.name} is not at rest at zero: {moving[0]} changes")
    return at
