"""Simulation of the flights with given unknowns; windows of equal length run together."""

from typing import Any, NamedTuple

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from heli_jax import naming
from heli_jax.dynamics.disturbance import sensor_noise
from heli_jax.identification.unknowns.layout import Data, Layout, Noise, Unknowns, unpack
from heli_jax.numerics.jitted import jitted
from heli_jax.simulation.hold import Delays, at, delays_of
from heli_jax.simulation.options import Scan
from heli_jax.simulation.simulate import Trajectory, simulate

# Params, State and Inputs are Any, because they are a model's own classes.


class Drive(NamedTuple):
    """Parameters, inputs and initial state of the model in one flight."""

    params: Any
    """The model's Params, SI."""
    inputs: Any
    """The model's Inputs, arrays (N,)."""
    dt: Any
    """Sample time [s]."""
    state: Any
    """The model's State at the first sample; None for the model's own."""


def driven(layout: Layout, data: Data, u: Unknowns, i: int) -> Drive:
    """Return the drive of the i-th flight; its inputs are (logged + offset) * gain."""
    flight, offsets = data.flights[i], u.offsets[i]
    # The last value counts, so known values of this flight take precedence.
    params = layout.model.Params(**{**data.base, **u.params, **u.noise, **flight.known})
    inputs = naming.asdict(flight.inputs)
    # Offsets are in units of the log, so that they do not change with the gain.
    inputs = {n: v + offsets[n] if n in offsets else v for n, v in inputs.items()}
    inputs = {n: v * u.gains[n] if n in u.gains else v for n, v in inputs.items()}
    return Drive(params, layout.model.Inputs(**inputs), flight.dt, u.states[i])


class Run(NamedTuple):
    """A simulated flight."""

    states: Float[Array, "s N"]
    """States, in the order of the model's State."""
    outputs: Float[Array, "p N"]
    """Measured outputs [SI], in the order of `Layout.outputs`."""
    ends: Any
    """State at the end of each window (the first sample of the next), (windows,), with windows
    only."""


def predict(layout: Layout, data: Data, u: Unknowns) -> tuple[Run, ...]:
    """Return the simulated flights (without bias).

    Windows of equal length, of all flights, are simulated together.
    """
    by_flight, groups = {}, {}
    for i, flight in enumerate(data.flights):
        # Flights share a program only if all of these are equal.
        key = (layout.windows[i][1], tuple(flight.known), layout.holds[i])
        groups.setdefault(key, []).append(i)
    for (m, *_), members in groups.items():
        if len(members) == 1 and layout.windows[members[0]][0] == 1:
            i = members[0]
            run = simulated_flight(layout, i, driven(layout, data, u, i), u.shift)
            measured = [getattr(run.outputs, n) for n in layout.outputs[i]]
            by_flight[i] = Run(jnp.stack(jax.tree.leaves(run.states)), jnp.stack(measured), None)
        else:
            by_flight |= _side_by_side(layout, data, u, members, m)
    return tuple(by_flight[i] for i in range(len(data.flights)))


# Any: options of `simulate`.
def simulated_flight(
    layout: Layout, i: int, drive: Drive, shift: Any, **options: Any
) -> Trajectory:
    """Simulate with the holds of the i-th flight.

    Args:
        options: of `simulate`, in place of those for least squares.
    """
    # ForwardMode compiles faster than an adjoint for both modes, and least squares uses it alone.
    usual = {"block": layout.block, "adjoint": Scan() if layout.reverse else dfx.ForwardMode()}
    return simulate(
        layout.model,
        drive.params,
        drive.inputs,
        dt=drive.dt,
        initial_state=drive.state,
        solver=layout.solver,
        substeps=layout.substeps,
        delay=shift,
        hold=layout.hold(i),
        **{**usual, **options},
    )


def _side_by_side(
    layout: Layout, data: Data, u: Unknowns, members: list[int], m: int
) -> dict[int, Run]:
    """Return the runs of several windows of m samples, by vmap."""
    chained = any(layout.windows[i][0] > 1 for i in members)
    # With several windows one sample is added, the first of the next window.
    each = [_cut(layout, data, u, i, m + chained) for i in members]
    stacked = jax.tree.map(lambda *v: jnp.concatenate(v), *each)

    def window(inputs: Any, known: dict[str, Any], dt: Any, state: Any) -> tuple[Any, Any]:
        """Return states and outputs of one window."""
        params = layout.model.Params(**{**data.base, **u.params, **u.noise, **known})
        # All members have the same holds.
        late = delays_of(layout.model, params, u.shift, dt)
        if late is not None:
            # `_with_lead` has shifted by whole samples, except for the leading sample.
            late = Delays(late.groups, tuple(-1 for _ in late.whole), late.rest)
        run = simulated_flight(layout, members[0], Drive(params, inputs, dt, state), late)
        return jax.tree.map(lambda v: v[: m + chained], (run.states, run.outputs))

    states, outputs = jax.vmap(window)(*stacked)
    names = naming.names(layout.model.Outputs)
    # Signals are joined in one array, because XLA makes a kernel of every slice.
    x, y = (jnp.stack(jax.tree.leaves(v)) for v in (states, outputs))
    runs, first = {}, 0
    for i in members:
        # The batch contains the windows flight after flight.
        count = layout.windows[i][0]
        n = jax.tree.leaves(data.flights[i].inputs)[0].shape[0]
        windows = slice(first, first + count)

        def joined(v: Array, windows: slice = windows, n: int = n) -> Array:
            """Join the windows of one flight, of signals (signals, windows, samples)."""
            # Sample m is the first of the next window; samples after n are repetitions.
            return v[:, windows, :m].reshape(v.shape[0], -1)[:, :n]

        ends = None
        if count > 1:
            ends = jax.tree.map(lambda v, windows=windows: v[windows, -1], states)
        rows = np.array([names.index(name) for name in layout.outputs[i]])
        runs[i] = Run(joined(x), joined(y[rows]), ends)
        first += count
    return runs


def _cut(
    layout: Layout, data: Data, u: Unknowns, i: int, samples: int
) -> tuple[Any, dict[str, Array], Array, Any]:
    """Return inputs (windows, samples), known parameters, sample time and initial states (windows,)
    of the i-th flight."""
    flight, (count, m) = data.flights[i], layout.windows[i]
    drive = driven(layout, data, u, i)
    late = delays_of(layout.model, drive.params, u.shift, flight.dt)
    # The last window may exceed the record, so it is padded with the last sample.
    of_window = m * np.arange(count)[:, None] + np.arange(samples)[None, :]
    state = u.states[i]
    if state is not None:
        state = jax.tree.map(lambda v: jnp.broadcast_to(v, (count,)), state)
    known = {k: jnp.broadcast_to(v, (count,)) for k, v in flight.known.items()}
    cut = _with_lead(drive.inputs, of_window, late)
    return cut, known, jnp.broadcast_to(flight.dt, (count,)), state


def _with_lead(inputs: Any, samples: np.ndarray, late: Delays | None) -> Any:
    """Return the inputs (windows, m) as they act, delayed.

    With a delay each window begins with the sample before its first, which acts until the first one
    does: (windows, m + 1).
    """
    if late is None:
        return at(inputs, samples)
    lead = np.concatenate([samples[:, :1] - 1, samples], axis=1)
    leaves, structure = jax.tree.flatten(at(inputs, lead, late))
    for i, v in enumerate(jax.tree.leaves(inputs)):
        # An input without a delay needs no leading sample.
        if late.group(i) is None:
            leaves[i] = at(v, np.concatenate([samples, samples[:, -1:] + 1], axis=1))
    return jax.tree.unflatten(structure, leaves)


def with_bias(u: Unknowns, runs: tuple[Run, ...]) -> tuple[Run, ...]:
    """Return the simulated flights with the biases of their outputs."""
    return tuple(
        run._replace(outputs=run.outputs + jnp.stack(list(bias.values()))[:, None])
        for run, bias in zip(runs, u.biases, strict=True)
    )


@jitted
def simulated_at(layout: Layout, data: Data, z: Float[Array, " q"]) -> tuple[Run, ...]:
    """Simulate the flights at z with bias, without derivatives."""
    u = unpack(layout, data, z)
    return with_bias(u, predict(layout, data, u))


def by_output(layout: Layout, runs: tuple[Run, ...]) -> tuple[dict[str, np.ndarray], ...]:
    """Return the simulated outputs (N,) of each flight by name.

    Args:
        runs: simulated flights fetched from the device.
    """
    return tuple(
        dict(zip(names, np.asarray(run.outputs), strict=True))
        for names, run in zip(layout.outputs, runs, strict=True)
    )


# The measured signals of all flights, one after another.


_BEHIND = 0.02
"""Least noise after the filters, as a fraction of the noise before them. Without it the first
innovation, which an initial state makes zero, has no variance, and the likelihood no maximum."""


def signals(layout: Layout) -> list[tuple[int, str]]:
    """Return the measured signals, as (flight, output), in the order of the rows."""
    return [(i, n) for i, names in enumerate(layout.outputs) for n in names]


def signal_numbers(layout: Layout, data: Data) -> np.ndarray:
    """Return the index of the signal of every measured value."""
    # Only shapes are used, so that the result is constant in a trace.
    sizes = [data.flights[i].outputs[n].shape[0] for i, n in signals(layout)]
    return np.repeat(np.arange(len(sizes)), sizes)


def measured_signals(layout: Layout, data: Data, noise: Noise) -> tuple[Array, Array]:
    """Return all measurements and their sd, each (n,)."""
    # Signals are joined, because XLA makes a kernel of every single one.
    at = signals(layout)
    sd = jnp.stack([noise.sd[i][n] for i, n in at])
    y = jnp.concatenate([data.flights[i].outputs[n] for i, n in at])
    return y, sd[signal_numbers(layout, data)]


def measurement_sd(u: Unknowns, output: str, sd: Array) -> Array:
    """Return the sd of the white noise of an output, from its guessed or stated sd."""
    sd = sd * u.scales[output] if output in u.scales else sd
    through = u.noise.get(sensor_noise(output))
    return sd if through is None else jnp.hypot(sd, _BEHIND * through)


def measured_count(data: Data) -> int:
    """Return the number of measured values."""
    outputs = [y for flight in data.flights for y in flight.outputs.values()]
    return int(sum(np.isfinite(np.asarray(y)).sum() for y in outputs))


def least_noise(y: np.ndarray) -> float:
    """Return the sd [SI] below which the residual of an output (N,) is rounding; NaN is missing."""
    # A noise of zero would make the next rows infinite. For an output of zeros 1e-12 of its unit is
    # enough.
    rms = float(np.sqrt(np.mean(np.square(y[np.isfinite(y)]))))
    return 1e-12 * (rms if rms > 1e-100 else 1.0)
