"""The flights as the model with given unknowns flies them, with windows side by side."""

from typing import Any, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from heli_jax import naming
from heli_jax.identification.unknowns.layout import Data, Layout, Unknowns, unpack
from heli_jax.simulation.simulate import Trajectory, simulate


def driven(layout: Layout, data: Data, u: Unknowns, i: int) -> tuple[Any, Any]:
    """Parameters and inputs of the i-th flight at the unknowns: (logged + offset) * gain."""
    flight, offsets = data.flights[i], u.offsets[i]
    params = layout.model.Params(**{**data.base, **u.params, **u.noise, **flight.known})
    inputs = naming.asdict(flight.inputs)
    inputs = {n: v + offsets[n] if n in offsets else v for n, v in inputs.items()}
    inputs = {n: v * u.gains[n] if n in u.gains else v for n, v in inputs.items()}
    return params, layout.model.Inputs(**inputs)


class SimulatedOutputs(NamedTuple):
    """What is simulated."""

    outputs: tuple[Float[Array, "p N"], ...]
    """by flight, SI, as `Layout.outputs` orders them, without the bias"""
    biases: Float[Array, " s"]
    """flight after flight and output after output"""
    state_rms: Float[Array, "f n"]
    """root mean square of each simulated state, by flight"""


class Run(NamedTuple):
    """A simulated flight."""

    states: Float[Array, "s N"]
    """as the model's State orders them"""
    outputs: Float[Array, "p N"]
    """what the flight measures, as `Layout.outputs` orders it, without bias"""
    ends: Any
    """with windows the State that each leads to at the next one's first sample, (windows,)"""


def predict(layout: Layout, data: Data, u: Unknowns) -> tuple[Run, ...]:
    """The simulated flights (without bias).

    Windows of one length are simulated together, whichever flight they belong to.
    """
    alone, groups = {}, {}
    for i, flight in enumerate(data.flights):
        key = (layout.windows[i][1], tuple(flight.known), layout.holds[i])
        groups.setdefault(key, []).append(i)
    for (m, *_), members in groups.items():
        if len(members) == 1 and layout.windows[members[0]][0] == 1:
            i = members[0]
            params, inputs = driven(layout, data, u, i)
            dt, state = data.flights[i].dt, u.states[i]
            run = _simulated_one(layout, i, params, inputs, dt, state, u.shift)
            measured = [getattr(run.outputs, n) for n in layout.outputs[i]]
            alone[i] = Run(jnp.stack(jax.tree.leaves(run.states)), jnp.stack(measured), None)
        else:
            alone |= _together(layout, data, u, members, m)
    return tuple(alone[i] for i in range(len(data.flights)))


def _simulated_one(
    layout: Layout, i: int, params: Any, inputs: Any, dt: Any, state: Any, shift: Any
) -> Trajectory:
    """A run with inputs that move between samples as those of the i-th flight."""
    return simulate(
        layout.model,
        params,
        inputs,
        dt=dt,
        initial_state=state,
        solver=layout.solver,
        substeps=layout.substeps,
        delay=shift,
        block=layout.block,
        adjoint=dfx.ForwardMode(),
        hold=layout.hold(i),
    )


def _together(
    layout: Layout, data: Data, u: Unknowns, members: list[int], m: int
) -> dict[int, Run]:
    """The runs of several windows of m samples, by vmap."""
    chained = any(layout.windows[i][0] > 1 for i in members)
    each = []
    for i in members:
        flight, count = data.flights[i], layout.windows[i][0]
        _, inputs = driven(layout, data, u, i)
        n = jax.tree.leaves(inputs)[0].shape[0]
        # With several windows one sample more, at which the next begins.
        at = np.minimum(m * np.arange(count)[:, None] + np.arange(m + chained)[None, :], n - 1)
        state = u.states[i]
        if state is not None:
            state = jax.tree.map(lambda v, c=count: jnp.broadcast_to(v, (c,)), state)
        known = {k: jnp.broadcast_to(v, (count,)) for k, v in flight.known.items()}
        cut = jax.tree.map(lambda v, at=at: v[at], inputs)
        each.append((cut, known, jnp.broadcast_to(flight.dt, (count,)), state))
    stacked = jax.tree.map(lambda *v: jnp.concatenate(v), *each)

    def one(inputs: Any, known: Any, dt: Any, state: Any) -> Any:
        params = layout.model.Params(**{**data.base, **u.params, **u.noise, **known})
        run = _simulated_one(layout, members[0], params, inputs, dt, state, u.shift)
        return run.states, run.outputs

    states, outputs = jax.vmap(one)(*stacked)
    names = naming.names(layout.model.Outputs)
    # All of them in one array, since XLA makes a kernel of every part that is cut out of another.
    x, y = (jnp.stack(jax.tree.leaves(v)) for v in (states, outputs))
    found, first = {}, 0
    for i in members:
        count = layout.windows[i][0]
        n = jax.tree.leaves(data.flights[i].inputs)[0].shape[0]
        mine = slice(first, first + count)

        def joined(v: Array, mine: slice = mine, n: int = n) -> Array:
            return v[:, mine, :m].reshape(v.shape[0], -1)[:, :n]

        ends = jax.tree.map(lambda v, mine=mine: v[mine, -1], states) if count > 1 else None
        rows = np.array([names.index(name) for name in layout.outputs[i]])
        found[i] = Run(joined(x), joined(y[rows]), ends)
        first += count
    return found


def joined_biases(u: Unknowns) -> Array:
    """The biases, flight after flight and output after output."""
    return jnp.stack([b for bias in u.biases for b in bias.values()])


def shown_of(u: Unknowns, runs: tuple[Run, ...]) -> SimulatedOutputs:
    """Of the simulated flights what is shown."""
    rms = [jnp.sqrt(jnp.mean(jnp.square(run.states), axis=1)) for run in runs]
    return SimulatedOutputs(tuple(run.outputs for run in runs), joined_biases(u), jnp.stack(rms))


@eqx.filter_jit
def simulated_at(layout: Layout, data: Data, z: Array) -> SimulatedOutputs:
    """What is simulated at z, without any derivative."""
    u = unpack(layout, data, z)
    return shown_of(u, predict(layout, data, u))


def with_biases(layout: Layout, simulated: SimulatedOutputs) -> tuple[dict[str, np.ndarray], ...]:
    """By flight and output what is simulated, (N,), with the bias, SI.

    Args:
        simulated: as NumPy arrays.
    """
    bias = iter(simulated.biases)
    return tuple(
        {n: np.asarray(y + next(bias)) for n, y in zip(names, run, strict=True)}
        for run, names in zip(simulated.outputs, layout.outputs, strict=True)
    )
