"""Models that are not linear, for a method that needs one that is: linearised where they fly.

Of a whole helicopter that is the trim at the flight's mean speed; of other models the equilibrium
at the mean of its inputs, or where there is none the model's initial state. The point moves with
the parameters: its derivative is that of an implicit function.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array

from heli_jax import naming
from heli_jax.analysis.operating_point import flown, mean_condition, mean_heading
from heli_jax.analysis.trim import Condition, equilibrium, is_full_nonlinear, trim
from heli_jax.dynamics.jacobians import about, jacobians, linearised, point
from heli_jax.dynamics.model import Model
from heli_jax.finding import Finding, found
from heli_jax.flights.flight import Flight
from heli_jax.identification.estimation.evaluation import Evaluation, deviations
from heli_jax.identification.estimation.residual import rows_of
from heli_jax.identification.estimation.simulated_flights import Drive, driven
from heli_jax.identification.problem import Problem
from heli_jax.identification.unknowns.layout import Data, Layout, Noise, Solution, unpack
from heli_jax.simulation.simulate import simulate

# Params, State and Inputs are a model's own classes: they are annotated Any.

_STEADY = 1e-6
"""of the rates at the initial state, and [SI], below which those of an equilibrium are zero"""


def condition_of(model: Model, flight: Flight) -> Condition | None:
    """Steady flight about which a flight of a whole helicopter is linearised; None for others."""
    if model.linear or not is_full_nonlinear(model):
        return None
    condition = mean_condition(flight.outputs, flight.dt)
    # Positions and velocities along the ground's axes mix with the heading in hover too.
    return condition._replace(heading=mean_heading(flight.outputs))


def cannot_linearise(problem: Problem) -> str | None:
    """The reason why a flight's model has no point to be linearised about; None where each has
    one."""
    for flight in problem.training:
        condition = condition_of(problem.model, flight)
        if condition is None:
            continue
        try:
            trim(problem.model, problem.start_params(flight.known), condition)
        except ValueError as e:
            return f"the model cannot be linearised for {flight.name or 'a flight'}: {e}"
    return None


def linear_drive(
    layout: Layout, drive: Drive, condition: Condition | None
) -> tuple[Model, Drive, Array]:
    """A linear model of a flight, what drives it, and whether its point is one of rest.

    Args:
        condition: of `condition_of`.
    """
    model = layout.model
    if model.linear:
        return model, drive, jnp.asarray(True)
    if condition is None:
        inputs = jax.tree.map(jnp.mean, drive.inputs)
        state, rest = _rest(model, drive.params, inputs)
    else:
        steady = equilibrium(model, drive.params, condition)
        state, inputs, rest = steady.state, steady.inputs, steady.residual < _STEADY
    params = about(model, drive.params, state, inputs)
    return linearised(model), drive._replace(params=params), rest


def _rest(model: Model, params: Any, inputs: Any) -> tuple[Any, Array]:
    """The State at which constant inputs leave the model, and whether there is one; else the
    initial state."""
    start = naming.ravel(model.initial_state(params), jnp.result_type(float))

    def rates(x: Array, arguments: Any) -> Array:
        p, u = arguments
        return naming.ravel(model.vector_field(p, naming.unravel(model.State, x), u), x.dtype)

    still = jax.lax.stop_gradient((params, inputs))
    # Damped: what has no place of its own, as a heading, stays where the model begins.
    solution = optx.root_find(
        rates,
        optx.LevenbergMarquardt(1e-12, 1e-12),
        jax.lax.stop_gradient(start),
        args=still,
        max_steps=100,
        throw=False,
    )
    x = jax.lax.stop_gradient(solution.value)
    size = 1.0 + jnp.max(jnp.abs(rates(start, still)))
    rest = jnp.max(jnp.abs(rates(x, still))) <= _STEADY * size
    inverse = jax.lax.stop_gradient(jnp.linalg.pinv(jax.jacfwd(rates)(x, still)))
    # One more step of Newton's, which has the derivative of the root by the parameters.
    x = x - inverse @ rates(x, (params, inputs))
    return naming.unravel(model.State, jnp.where(rest, x, start)), rest


# Motion that the linearised model leaves out, and by how much it moves the estimates.
#
# The model itself and the linear one are driven side by side by the flight's inputs. Their
# difference is an error of the linear model that no noise explains, and moves the estimates as any
# error of the outputs does.


_TOLD = 0.3
"""standard deviations from which on an estimate is named"""
_TIMES = 3.0
"""time constants of the fastest divergence for which a simulation stays near the trim"""
_FEWEST = 10
"""samples of such a simulation"""


class _LeftOut(NamedTuple):
    """The part of a flight that the linear model leaves out."""

    signal: np.ndarray
    """(p, N), zero where nothing was simulated"""
    share: float
    """of the motion of the output that lacks most"""
    where: str
    """the point, in words"""


def linearisation_notes(at: Solution, e: Evaluation) -> list[Finding]:
    """The part of the motion that the linearised model leaves out, and its effect on estimates."""
    layout, data, noise, _ = at
    if layout.model.linear:
        return []
    left = [_left_out(layout, data, jnp.asarray(e.z), i) for i in range(len(data.flights))]
    moved = _moved(layout, data, noise, e, left)
    sizes = deviations(e.J)[: len(layout.of_interest)] * np.abs(e.slopes)
    sds = dict(zip(layout.of_interest, sizes, strict=True))
    notable = [f"{n} by {v:+.2g}" for n, v in moved.items() if abs(v) >= _TOLD]
    return [
        found(
            "dynamics.linearised",
            "note",
            value=max(flight.share for flight in left),
            shifts={n: float(v * sds[n]) for n, v in moved.items()},
            where=list(dict.fromkeys(flight.where for flight in left)),
            moved=notable or [f"no estimate by {_TOLD:g}"],
        )
    ]


@eqx.filter_jit
def _linear_model(layout: Layout, data: Data, z: Array, i: int) -> tuple[Drive, Array, Array]:
    """The inputs of a flight's linear model, its matrix, and True if its point is one of rest."""
    u = unpack(layout, data, z)
    condition = layout.flight_facts[i].condition
    model, drive, rest = linear_drive(layout, driven(layout, data, u, i), condition)
    return drive, jacobians(model, drive.params).A, rest


@eqx.filter_jit
def _runs(layout: Layout, data: Data, z: Array, i: int, m: int) -> tuple[Array, Array]:
    """Motion of every output (runs, p, m) by the model itself and by the linear one, in runs of m
    samples from the point."""
    model, small = layout.model, linearised(layout.model)
    drive, _, _ = _linear_model(layout, data, z, i)
    state, inputs = point(model, drive.params)
    own = model.Params(**{n: getattr(drive.params, n) for n in naming.names(model.Params)})
    shift = unpack(layout, data, z).shift
    options = {"dt": data.flights[i].dt, "delay": shift, "hold": layout.hold(i)}
    still, method = jax.tree.map(jnp.zeros_like, state), {"substeps": layout.substeps}

    def run(window: Any) -> tuple[Array, Array]:
        whole = simulate(
            model, own, window, initial_state=state, solver=layout.solver, **method, **options
        )
        moved = jax.tree.map(jnp.subtract, window, inputs)
        part = simulate(small, drive.params, moved, initial_state=still, **options)
        return jnp.stack(jax.tree.leaves(whole.outputs)), jnp.stack(jax.tree.leaves(part.outputs))

    # The last run is the one without any stick: where the point is none of rest all of them drift.
    windows = jax.tree.map(
        lambda u, v: jnp.concatenate([u[: len(u) // m * m].reshape(-1, m), jnp.full((1, m), v)]),
        drive.inputs,
        inputs,
    )
    whole, part = jax.vmap(run)(windows)
    return whole[:-1] - whole[-1:], part[:-1]


def _left_out(layout: Layout, data: Data, z: Array, i: int) -> _LeftOut:
    drive, A, rest = jax.device_get(_linear_model(layout, data, z, i))
    n, dt = jax.tree.leaves(drive.inputs)[0].shape[0], float(data.flights[i].dt)
    finite = np.isfinite(A).all()
    growth = max(float(np.max(np.real(np.linalg.eigvals(A)))), 0.0) if finite else 0.0
    # An unstable model would leave the trim whatever the sticks do.
    m = n if growth * n * dt <= _TIMES else min(max(int(_TIMES / growth / dt), _FEWEST), n)
    every = naming.names(layout.model.Outputs)
    rows = np.array([every.index(name) for name in layout.outputs[i]])
    whole, part = (np.asarray(v)[:, rows] for v in _runs(layout, data, z, i, m))
    total, left = (np.mean(np.var(v, axis=2), axis=0) for v in (whole, whole - part))
    share = np.sqrt(np.divide(left, total, out=np.zeros_like(left), where=total != 0))
    signal = np.zeros((rows.size, n))
    joined = np.moveaxis(whole - part, 0, 1).reshape(rows.size, -1)
    signal[:, : joined.shape[1]] = joined
    condition = layout.flight_facts[i].condition
    where = "the equilibrium at the mean of its inputs" if rest else "its initial state"
    where = where if condition is None else f"the trim {flown(condition)}"
    # A simulation that diverges shares nothing with the model.
    return _LeftOut(signal, float(np.max(np.where(np.isfinite(share), share, 1.0))), where)


def _moved(
    layout: Layout, data: Data, noise: Noise, e: Evaluation, left: list[_LeftOut]
) -> dict[str, float]:
    """By parameter how far what is left out moves its estimate [sd]; empty where that is no
    number."""
    flights = []
    for names, flight, out in zip(layout.outputs, data.flights, left, strict=True):
        outputs = {n: y + out.signal[names.index(n)] for n, y in flight.outputs.items()}
        flights.append(flight._replace(outputs=outputs))
    # The rows are linear in what was measured: their change is that of an error of the model.
    changed = data._replace(flights=tuple(flights))
    rows = np.asarray(eqx.filter_jit(rows_of)(layout, changed, noise, jnp.asarray(e.z)))
    change, J = rows - np.asarray(e.r), np.asarray(e.J)
    if not (np.isfinite(change).all() and np.isfinite(J).all()):
        return {}
    shift = -np.linalg.lstsq(J, change, rcond=1e-10)[0] / deviations(J)
    return {n: float(v) for n, v in zip(layout.of_interest, shift, strict=False)}
