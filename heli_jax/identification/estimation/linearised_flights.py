"""Models that are not linear, for a method that needs one that is: linearised where they fly.

Of a whole helicopter that is the trim at the flight's mean speed; of other models the equilibrium
at the mean of its inputs, or where there is none the model's initial state. The point moves with
the parameters: its derivative is that of an implicit function.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from heli_jax import naming
from heli_jax.analysis.operating_point import flown, mean_condition, mean_heading
from heli_jax.analysis.trim import Condition, equilibrium, is_full_nonlinear, trim
from heli_jax.dynamics.jacobians import about, jacobians, linearised, point
from heli_jax.dynamics.model import Model
from heli_jax.finding import Finding, note
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
    """Why a flight's model has no point to be linearised about; None where each has one."""
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


# Whether a flight stays where its linearised model holds: what that leaves out, and what it moves.
#
# The model itself and the linear one are driven side by side by the flight's inputs. Their
# difference is an error of the linear model that no noise explains, and moves the estimates as any
# error of the outputs does.


# Params, State and Inputs are a model's own classes: they are annotated Any.

_TOLD = 0.3
"""standard deviations from which on an estimate is named"""
_TIMES = 3.0
"""time constants of the fastest divergence for which a simulation stays near the trim"""
_FEWEST = 10
"""samples of such a simulation"""


class _Trial(NamedTuple):
    """What is needed to compare a model with its linearisation over a flight."""

    params: Any
    """of the linearised model, with the point"""
    inputs: Any
    """the model's Inputs, arrays (N,)"""
    first: Any
    """the model's State at the first sample"""
    shift: Any
    A: Float[Array, "n n"]
    rest: Array


class _LeftOut(NamedTuple):
    """What the linear model leaves out of a flight."""

    signal: np.ndarray
    """(p, N), zero where nothing was simulated"""
    share: np.ndarray
    """(p,) of each output's motion"""
    samples: int
    """of each run"""
    rest: bool


def linearisation_notes(at: Solution, e: Evaluation, names: Sequence[str]) -> list[Finding]:
    """By flight where its model was linearised, how far the flight goes from there, and how much
    of the motion that leaves out; then what that does to the estimates.
    """
    layout, data, noise, _ = at
    if layout.model.linear:
        return []
    z = jnp.asarray(e.z)
    left = [_flight(layout, data, z, i) for i in range(len(data.flights))]
    notes = [
        note("frequency.linearised", f"{names[i]}: {_note(layout, data, i, flight)}", names[i])
        for i, flight in enumerate(left)
    ]
    moved = _moved(layout, data, noise, e, left)
    if moved is None:
        return notes
    sizes = deviations(e.J)[: len(layout.of_interest)] * np.abs(e.slopes)
    sds = dict(zip(layout.of_interest, sizes, strict=True))
    notable = {n: v for n, v in moved.items() if abs(v) >= _TOLD}
    words = ", ".join(f"{n} by {v:+.2g}" for n, v in notable.items()) or "no estimate by 0.1"
    share = max(float(np.max(flight.share)) for flight in left)
    return [
        *notes,
        Finding(
            "dynamics.linearised",
            "note",
            f"What the linear model leaves out moves {words} standard deviations. Use smaller "
            "inputs, or method: output-error with start: frequency-error.",
            share,
            "part of an output's motion that the linear model leaves out",
            shifts={n: float(v * sds[n]) for n, v in moved.items()},
            brief="the linearised model leaves out a part of the motion",
        ),
    ]


@eqx.filter_jit
def _trial(layout: Layout, data: Data, z: Array, i: int) -> _Trial:
    u = unpack(layout, data, z)
    own = driven(layout, data, u, i)
    model, drive, rest = linear_drive(layout, own, layout.flight_facts[i].condition)
    first = point(layout.model, drive.params)[0] if own.state is None else own.state
    A = jacobians(model, drive.params).A
    return _Trial(drive.params, drive.inputs, first, u.shift, A, rest)


@eqx.filter_jit
def _runs(layout: Layout, i: int, trial: _Trial, dt: Array, m: int) -> tuple[Array, Array]:
    """Motion of every output (windows, p, m) by the model itself and by the linear one, in runs of
    m samples: one from where the flight begins, several from the point."""
    model, small = layout.model, linearised(layout.model)
    state, inputs = point(model, trial.params)
    own = model.Params(**{n: getattr(trial.params, n) for n in naming.names(model.Params)})
    options = {"dt": dt, "delay": trial.shift, "hold": layout.hold(i)}
    count = jax.tree.leaves(trial.inputs)[0].shape[0] // m

    def run(window: Any, first: Any) -> tuple[Array, Array]:
        method = {"solver": layout.solver, "substeps": layout.substeps}
        whole = simulate(model, own, window, initial_state=first, **method, **options)
        moved, away = (
            jax.tree.map(jnp.subtract, a, b) for a, b in ((window, inputs), (first, state))
        )
        part = simulate(small, trial.params, moved, initial_state=away, **options)
        return jnp.stack(jax.tree.leaves(whole.outputs)), jnp.stack(jax.tree.leaves(part.outputs))

    # The last run is the one without any stick: where the point is none of rest all of them drift.
    windows = jax.tree.map(
        lambda u, v: jnp.concatenate([u[: count * m].reshape(count, m), jnp.full((1, m), v)]),
        trial.inputs,
        inputs,
    )
    begin = trial.first if count == 1 else state
    firsts = jax.tree.map(lambda x, v: jnp.stack([x] * count + [v]), begin, state)
    whole, part = jax.vmap(run)(windows, firsts)
    return whole[:-1] - whole[-1:], part[:-1]


def _flight(layout: Layout, data: Data, z: Array, i: int) -> _LeftOut:
    trial = jax.device_get(_trial(layout, data, z, i))
    n, dt = jax.tree.leaves(trial.inputs)[0].shape[0], float(data.flights[i].dt)
    growth = _growth(trial.A)
    # A machine that diverges would leave the trim whatever the sticks do.
    m = n if growth * n * dt <= _TIMES else min(max(int(_TIMES / growth / dt), _FEWEST), n)
    every = naming.names(layout.model.Outputs)
    rows = np.array([every.index(name) for name in layout.outputs[i]])
    whole, part = (np.asarray(v)[:, rows] for v in _runs(layout, i, trial, data.flights[i].dt, m))
    total, left = (np.mean(np.var(v, axis=2), axis=0) for v in (whole, whole - part))
    share = np.sqrt(np.divide(left, total, out=np.zeros_like(left), where=total != 0))
    signal = np.zeros((rows.size, n))
    joined = np.moveaxis(whole - part, 0, 1).reshape(rows.size, -1)
    signal[:, : joined.shape[1]] = joined
    return _LeftOut(signal, share, m, bool(trial.rest))


def _growth(A: np.ndarray) -> float:
    """Of the fastest mode that grows [1/s]; 0 where none does."""
    return max(float(np.max(np.real(np.linalg.eigvals(A)))), 0.0) if np.isfinite(A).all() else 0.0


def _moved(
    layout: Layout, data: Data, noise: Noise, e: Evaluation, left: list[_LeftOut]
) -> dict[str, float] | None:
    """By parameter how far what is left out moves its estimate [sd]; None where that is no
    number."""
    flights = []
    for names, flight, out in zip(layout.outputs, data.flights, left, strict=True):
        outputs = {n: y + out.signal[names.index(n)] for n, y in flight.outputs.items()}
        flights.append(flight._replace(outputs=outputs))
    # The rows are linear in what was measured: their change is that of an error of the model.
    changed = data._replace(flights=tuple(flights))
    rows = np.asarray(_rows(layout, changed, noise, jnp.asarray(e.z)))
    change, J = rows - np.asarray(e.r), np.asarray(e.J)
    if not (np.isfinite(change).all() and np.isfinite(J).all()):
        return None
    shift = -np.linalg.lstsq(J, change, rcond=1e-10)[0] / deviations(J)
    return {n: float(v) for n, v in zip(layout.of_interest, shift, strict=False)}


@eqx.filter_jit
def _rows(layout: Layout, data: Data, noise: Noise, z: Array) -> Array:
    return rows_of(layout, data, noise, z)


def _note(layout: Layout, data: Data, i: int, left: _LeftOut) -> str:
    flight, condition = data.flights[i], layout.flight_facts[i].condition
    n, dt = left.signal.shape[1], float(flight.dt)
    where = "its initial state, since the mean of its inputs has no equilibrium"
    if condition is not None:
        where = f"the trim {flown(condition)}"
    elif left.rest:
        where = "the equilibrium at the mean of its inputs"
    said = f"linearised about {where}; {_reach(layout, data, i)}. "
    if not np.isfinite(left.share).all():
        return said + "A simulation from there is not finite: how far that holds is not known."
    runs = "a run" if left.samples == n else f"runs of {left.samples * dt:.2g} s from there"
    shares = zip(layout.outputs[i], left.share, strict=True)
    words = ", ".join(f"{100 * v:.2g} % of {name}" for name, v in shares)
    return said + f"In {runs} with its inputs the linear model leaves out {words}."


def _reach(layout: Layout, data: Data, i: int) -> str:
    """How far the flight's outputs go from their means, in words."""
    words = []
    for name in layout.outputs[i]:
        y = np.asarray(data.flights[i].outputs[name])
        unit = naming.unit(layout.model.Outputs, name) or ""
        words.append(f"{name} {np.nanmax(np.abs(y - np.nanmean(y))):.2g} {unit}".rstrip())
    return f"the flight goes as far as {', '.join(words)} from its mean"
