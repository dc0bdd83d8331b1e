"""Where a fit starts: the unknowns at the values that the problem and its records suggest."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from heli_jax import naming
from heli_jax.dynamics.jacobians import jacobians
from heli_jax.identification.problem import Problem
from heli_jax.identification.unknowns import transforms as coordinates
from heli_jax.identification.unknowns.layout import Data, FlightData, Layout


def start_vector(layout: Layout, data: Data, problem: Problem) -> Float[Array, " q"]:
    """z at the start values: gains 1, no shift, the model's own initial state, no bias."""
    z = [
        coordinates.to_coordinate(
            how, jnp.asarray(f.start, data.low.dtype), data.sign[i], data.low[i], data.high[i]
        )
        for i, (f, how) in enumerate(zip(problem.free.values(), layout.kinds, strict=True))
    ]
    one, zero = jnp.ones((), data.low.dtype), jnp.zeros((), data.low.dtype)
    z += [one] * len(layout.gains) + [zero] * layout.shift
    z += [jnp.asarray(np.log(problem.noise[n].start), data.low.dtype) for n in layout.disturbance]
    z = jnp.stack([*z, *[zero] * (layout.size - len(z))])
    if layout.initial_state:
        z = _initial_states(layout, data, problem, z)
    return z


def _initial_states(layout: Layout, data: Data, problem: Problem, z: Array) -> Array:
    """The model's own initial state, or for one that is not linear the nearest that shows the
    measured outputs at the first sample of the window."""
    at = layout.first_nuisance
    values = {n: jnp.asarray(f.start, z.dtype) for n, f in problem.free.items()}
    for flight, outputs, (count, m) in zip(
        data.flights, layout.outputs, layout.windows, strict=True
    ):
        params = layout.model.Params(**{**data.base, **values, **flight.known})
        own = naming.asdict(layout.model.initial_state(params))
        first = np.array([float(own[n]) for n in naming.names(layout.model.State)])
        for k in range(count):
            found = first
            if not layout.model.linear:
                found = _shown(layout, params, flight, k * m, first)
            for i, name in enumerate(layout.states):
                value = found[naming.names(layout.model.State).index(name)]
                scale = float(flight.state_scale[name])
                z = z.at[at + i].set(jnp.asarray(value / scale, z.dtype))
            at += len(layout.states)
        at += layout.constants(outputs)
    return z


_LINE = 5
"""samples to which a straight line is fitted for the value at the first"""


def _shown(
    layout: Layout, params: Any, flight: FlightData, k: int, first: np.ndarray
) -> np.ndarray:
    """The state (n,) nearest to `first` whose outputs are the measured ones at sample k."""
    measured = {n: _at_start(np.asarray(y)[k : k + _LINE]) for n, y in flight.outputs.items()}
    measured = {n: v for n, v in measured.items() if np.isfinite(v)}
    inputs = jax.tree.map(lambda u: u[k], flight.inputs)
    names, x = naming.names(layout.model.State), first
    rows = [naming.names(layout.model.Outputs).index(n) for n in measured]
    for _ in range(3):
        state = layout.model.State(**dict(zip(names, jnp.asarray(x), strict=True)))
        _, _, C, _ = jacobians(layout.model, params, state, inputs)
        outputs = naming.asdict(layout.model.output(params, state, inputs))
        missed = np.array([v - float(outputs[n]) for n, v in measured.items()])
        x = x + np.linalg.pinv(np.asarray(C)[rows], rcond=1e-8) @ missed
    return x


def _at_start(y: np.ndarray) -> float:
    seen = np.flatnonzero(np.isfinite(y))
    if seen.size < 3:
        return float(y[seen[0]]) if seen.size else float("nan")
    return float(np.polyval(np.polyfit(seen, y[seen], 1), 0.0))
