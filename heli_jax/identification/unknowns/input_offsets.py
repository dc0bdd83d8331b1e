"""Sticks that are not centred: which inputs get a constant offset of their own in every flight.

On a stand an offset moves the output by a constant, and the bias takes it up. In free flight it is
integrated: 1 % of the stick left out moves an inertia by a fifth, with an interval that says
nothing of it.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg

from heli_jax import naming
from heli_jax.dynamics.jacobians import jacobians
from heli_jax.dynamics.model import Model
from heli_jax.flights.flight import Flight
from heli_jax.identification.problem import Problem
from heli_jax.vehicle import of_helicopter

_EXPLAINED = 1e-6
"""part of an offset's response that initial states and biases leave over where they explain it"""
_POINTS = 200
"""samples at which the responses are compared"""


def offset_inputs(problem: Problem) -> tuple[str, ...]:
    """The inputs whose offset is estimated, in the order of the model.

    As `nuisance.input_offset` says; where it leaves that open, the sticks of a machine in free
    flight: those whose constant offset no initial state and no bias can take the place of. The
    throttle is no stick that has a centre, and where a free parameter is a constant term of the
    equations that parameter stands for the offsets already.
    """
    known = naming.names(problem.model.Inputs)
    asked = problem.nuisance.input_offset
    if asked is None:
        return _in_free_flight(problem)
    if isinstance(asked, bool):
        return known if asked else ()
    return tuple(n for n in known if n in asked)


def _in_free_flight(problem: Problem) -> tuple[str, ...]:
    model, params = problem.model, problem.start_params()
    sticks = [n for n in naming.names(model.Inputs) if n != "x_throttle"]
    if of_helicopter(model.Params) and not model.linear:
        return tuple(sticks)
    flight = problem.training[0]
    params = naming.replace(params, **{n: jnp.asarray(v) for n, v in flight.known.items()})
    if not model.linear and _has_constant_term(model, params, tuple(problem.free)):
        return ()
    left = _left_over(model, params, flight)
    at = naming.names(model.Inputs)
    return tuple(n for n in sticks if not left[at.index(n)] < _EXPLAINED)


def _left_over(model: Model, params: Any, flight: Flight) -> np.ndarray:
    """Of the response to a constant offset of each input (m,) the part that no initial state and no
    constant in the outputs explains, of the model linearised at the flight's mean inputs."""
    dtype = jnp.result_type(float)
    inputs = {n: jnp.asarray(np.mean(flight.inputs[n]), dtype) for n in flight.inputs}
    u = model.Inputs(**{n: inputs[n] for n in naming.names(model.Inputs)})
    space = jacobians(model, params, None, u)
    A, B, C = (np.asarray(M, np.float64) for M in (space.A, space.B, space.C))
    m = B.shape[1]
    if not (np.isfinite(A).all() and np.isfinite(B).all() and np.isfinite(C).all()):
        return np.ones(m)
    names = naming.names(model.Outputs)
    C = C[[names.index(n) for n in sorted(flight.outputs)]]
    n = A.shape[0]
    both = np.zeros((n + m, n + m))
    both[:n, :n], both[:n, n:] = A, B
    step = max(flight.duration, flight.dt) / _POINTS
    with np.errstate(all="ignore"):
        E, state, rows = scipy.linalg.expm(both * step), np.eye(n + m), []
        for _ in range(_POINTS + 1):
            rows.append(C @ state[:n])
            state = E @ state
        response = np.concatenate(rows)
    if not np.isfinite(response).all():
        return np.ones(m)  # unstable over the record: free flight
    constants = np.tile(np.eye(C.shape[0]), (_POINTS + 1, 1))
    others, driven = np.hstack([response[:, :n], constants]), response[:, n:]
    sizes = np.linalg.norm(others, axis=0)
    factors: Any = scipy.linalg.qr(
        others / np.where(sizes > 0, sizes, 1.0), mode="economic", pivoting=True
    )
    Q, R = factors[:2]
    kept = np.abs(np.diag(R)) > 1e-10 * np.abs(R[0, 0])
    Q = Q[:, kept]
    rest = driven - Q @ (Q.T @ driven)
    size = np.linalg.norm(driven, axis=0)
    # An input that no output shows has no offset to be found.
    return np.divide(np.linalg.norm(rest, axis=0), size, out=np.zeros(m), where=size > 0)


def _has_constant_term(model: Model, params: Any, free: tuple[str, ...]) -> bool:
    """Whether a free parameter is added to the rates whatever the state and the inputs are."""
    rng = np.random.default_rng(11)
    dtype = jnp.result_type(float)

    def draw(record: type) -> Any:
        names = naming.names(record)
        return record(**{n: jnp.asarray(rng.standard_normal(), dtype) for n in names})

    def rates(values: dict[str, Any], x: Any, u: Any) -> Any:
        return model.vector_field(naming.replace(params, **values), x, u)

    values = {n: jnp.asarray(getattr(params, n), dtype) for n in free}
    found = []
    for _ in range(3):
        slopes = jax.jacfwd(rates)(values, draw(model.State), draw(model.Inputs))
        by_state = [
            [float(d[n]) for d in (naming.asdict(slopes)[s] for s in naming.names(model.State))]
            for n in free
        ]
        found.append(np.array(by_state))
    for slopes in zip(*found, strict=True):
        first, size = slopes[0], np.max(np.abs(slopes[0]))
        if size > 0 and all(np.max(np.abs(s - first)) <= 1e-9 * size for s in slopes):
            return True
    return False
