"""The one residual: fit, identifiability and uncertainty all differentiate this function.

For flight f and output j the residual is (measured - bias - simulated) / sd; prior rows
(value - mean) / sd follow. Unknowns form one vector z: coordinates of the free parameters, then
input gains, the time shift, then for each flight the initial state and the biases.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from heli_jax import naming
from heli_jax.dynamics.model import Model
from heli_jax.flights.flight import Flight
from heli_jax.identification import coordinates
from heli_jax.identification.problem import MAX_TIME_SHIFT, Free, Problem
from heli_jax.simulation.simulate import Trajectory, simulate

_BLOCK = 32


class FlightData(NamedTuple):
    """One flight as arrays: what a trace may see of it."""

    dt: Any
    inputs: Any
    """the model's Inputs, arrays (N,)"""
    outputs: dict[str, Any]
    """measured, arrays (N,)"""
    known: dict[str, Any]
    state_scale: dict[str, Any]
    """sd of the weak prior on the initial state"""
    bias_scale: dict[str, Any]
    """sd of the weak prior on the bias"""


class Data(NamedTuple):
    """All numbers of a problem."""

    base: Any
    """the vehicle's parameters by name"""
    sign: Any
    low: Any
    high: Any
    prior_mean: Any
    prior_sd: Any
    """inf where a parameter has no prior"""
    flights: tuple[FlightData, ...]


class Layout(eqx.Module):
    """The static side of a problem: what the unknowns are, in which order."""

    model: Model
    free: tuple[str, ...] = eqx.field(static=True)
    kinds: tuple[str, ...] = eqx.field(static=True)
    gains: tuple[str, ...] = eqx.field(static=True)
    shift: bool = eqx.field(static=True)
    initial_state: bool = eqx.field(static=True)
    bias: bool = eqx.field(static=True)
    outputs: tuple[tuple[str, ...], ...] = eqx.field(static=True)
    solver: str | None = eqx.field(static=True)
    substeps: int = eqx.field(static=True)
    block: int = eqx.field(static=True)
    """samples per step of the exact recurrence"""

    @property
    def named(self) -> tuple[str, ...]:
        """The unknowns that the verdict speaks of: parameters, gains, the shift."""
        gains = tuple(f"gain {name}" for name in self.gains)
        return (*self.free, *gains, *(("time_shift",) if self.shift else ()))

    @property
    def size(self) -> int:
        """The number of unknowns."""
        states = len(naming.names(self.model.State)) if self.initial_state else 0
        each = [states + (len(o) if self.bias else 0) for o in self.outputs]
        return len(self.named) + sum(each)


class Unknowns(NamedTuple):
    """The vector z taken apart, in the units of the model."""

    params: dict[str, Any]
    gains: dict[str, Any]
    shift: Any
    states: tuple[Any, ...]
    """one State or None a flight"""
    biases: tuple[dict[str, Any], ...]


def layout_of(problem: Problem, flights: tuple[Flight, ...], *, bounded: bool = False) -> Layout:
    """The static side of a problem over the given flights.

    `bounded` keeps the free parameters within their bounds by logit coordinates.
    """
    how = coordinates.kind if bounded else coordinates.plain_kind
    nuisance = problem.nuisance
    exact = problem.solver == "exact" or (problem.solver is None and problem.model.linear)
    return Layout(
        model=problem.model,
        free=tuple(problem.free),
        kinds=tuple(how(f) for f in problem.free.values()),
        gains=naming.names(problem.model.Inputs) if nuisance.input_gain else (),
        shift=nuisance.time_shift,
        initial_state=nuisance.initial_state,
        bias=nuisance.bias,
        outputs=tuple(tuple(f.outputs) for f in flights),
        solver=problem.solver,
        substeps=problem.substeps,
        block=_BLOCK if exact else 1,
    )


def data_of(problem: Problem, flights: tuple[Flight, ...]) -> Data:
    """The numbers of a problem over the given flights."""
    dtype = np.dtype(jnp.result_type(float))
    nuisance, frees = problem.nuisance, list(problem.free.values())
    bounds = [coordinates.limits(f) for f in frees]

    def column(values: list[float]) -> np.ndarray:
        return np.array(values, dtype)

    numbers = Data(
        base={n: jnp.asarray(v) for n, v in naming.asdict(problem.vehicle).items()},
        sign=column([float(np.sign(f.start)) or 1.0 for f in frees]),
        low=column([b[0] for b in bounds]),
        high=column([b[1] for b in bounds]),
        prior_mean=column([f.prior.mean if f.prior else 0.0 for f in frees]),
        prior_sd=column([f.prior.sd if f.prior else np.inf for f in frees]),
        flights=tuple(_flight_data(problem, f, dtype) for f in flights),
    )
    numbers = jax.device_put(numbers)
    return _with_state_scales(problem, flights, numbers) if nuisance.initial_state else numbers


def _flight_data(problem: Problem, flight: Flight, dtype: np.dtype) -> FlightData:
    model = problem.model
    inputs = {n: np.asarray(flight.inputs[n], dtype) for n in naming.names(model.Inputs)}
    outputs = {n: np.asarray(y, dtype) for n, y in flight.outputs.items()}
    return FlightData(
        dt=np.asarray(flight.dt, dtype),
        inputs=model.Inputs(**inputs),
        outputs=outputs,
        known={n: np.asarray(v, dtype) for n, v in flight.known.items()},
        state_scale={n: np.ones((), dtype) for n in naming.names(model.State)},
        bias_scale={n: np.asarray(10.0 * _size(y), dtype) for n, y in outputs.items()},
    )


def _size(values: Any) -> float:
    """rms of a signal, 1 where that says nothing."""
    with np.errstate(over="ignore", invalid="ignore"):
        rms = float(np.sqrt(np.mean(np.square(np.asarray(values)))))
    return rms if np.isfinite(rms) and rms > 0 else 1.0


def _with_state_scales(problem: Problem, flights: tuple[Flight, ...], data: Data) -> Data:
    """Ten times what each state does in a run from the start values: a weak prior's sd.

    The run is brought to the size of the measured outputs first, since a gain may be unknown.
    """
    layout = layout_of(problem, flights)
    z = start_vector(layout, data, problem.free)
    one = np.ones((), z.dtype)
    sd = tuple(dict.fromkeys(flight.outputs, one) for flight in data.flights)
    e = jax.device_get(evaluate(layout, data, sd, z))
    scaled = []
    for flight, raw, rms in zip(data.flights, e.raw, e.state_rms, strict=True):
        y = {n: np.asarray(v) for n, v in flight.outputs.items()}
        ratio = 10.0 * float(np.mean([_size(v) / _size(v - raw[n]) for n, v in y.items()]))
        scale = {n: np.asarray(ratio * _size(v), z.dtype) for n, v in rms.items()}
        scaled.append(flight._replace(state_scale=jax.device_put(scale)))
    return data._replace(flights=tuple(scaled))


def unpack(layout: Layout, data: Data, z: Float[Array, " q"]) -> Unknowns:
    """Names for the entries of z."""
    q = len(layout.free)
    params = {
        name: coordinates.to_value(how, z[i], data.sign[i], data.low[i], data.high[i])
        for i, (name, how) in enumerate(zip(layout.free, layout.kinds, strict=True))
    }
    gains = {name: z[q + i] for i, name in enumerate(layout.gains)}
    at = q + len(layout.gains)
    shift = None
    if layout.shift:
        shift = MAX_TIME_SHIFT * jnp.tanh(z[at])
        at += 1
    states, biases = [], []
    state_names = naming.names(layout.model.State)
    for flight, outputs in zip(data.flights, layout.outputs, strict=True):
        state = None
        if layout.initial_state:
            values = {n: z[at + i] * flight.state_scale[n] for i, n in enumerate(state_names)}
            state, at = layout.model.State(**values), at + len(state_names)
        bias = {n: jnp.zeros_like(z[0]) for n in outputs}
        if layout.bias:
            bias = {n: z[at + i] * flight.bias_scale[n] for i, n in enumerate(outputs)}
            at += len(outputs)
        states.append(state)
        biases.append(bias)
    return Unknowns(params, gains, shift, tuple(states), tuple(biases))


def start_vector(layout: Layout, data: Data, free: Mapping[str, Free]) -> Float[Array, " q"]:
    """z at the start values: gains 1, no shift, the model's own initial state, no bias."""
    z = [
        coordinates.to_coordinate(
            how, jnp.asarray(free[n].start, data.low.dtype), data.sign[i], data.low[i], data.high[i]
        )
        for i, (n, how) in enumerate(zip(layout.free, layout.kinds, strict=True))
    ]
    one, zero = jnp.ones((), data.low.dtype), jnp.zeros((), data.low.dtype)
    rest = layout.size - len(z) - len(layout.gains)
    z = jnp.stack([*z, *[one] * len(layout.gains), *[zero] * rest])
    if layout.initial_state:
        z = _initial_states(layout, data, free, z)
    return z


def _initial_states(layout: Layout, data: Data, free: Mapping[str, Free], z: Array) -> Array:
    at = len(layout.named)
    values = {n: jnp.asarray(f.start, z.dtype) for n, f in free.items()}
    for flight, outputs in zip(data.flights, layout.outputs, strict=True):
        params = layout.model.Params(**{**data.base, **values, **flight.known})
        state = naming.asdict(layout.model.initial_state(params))
        for i, (name, value) in enumerate(state.items()):
            z = z.at[at + i].set(value / flight.state_scale[name])
        at += len(state) + (len(outputs) if layout.bias else 0)
    return z


def predict(layout: Layout, data: Data, u: Unknowns) -> tuple[Trajectory, ...]:
    """The simulated flights (without bias)."""
    out = []
    for flight, state in zip(data.flights, u.states, strict=True):
        params = layout.model.Params(**{**data.base, **u.params, **flight.known})
        inputs = naming.asdict(flight.inputs)
        inputs = {n: v * u.gains[n] if n in u.gains else v for n, v in inputs.items()}
        out.append(
            simulate(
                layout.model,
                params,
                layout.model.Inputs(**inputs),
                dt=flight.dt,
                initial_state=state,
                solver=layout.solver,
                substeps=layout.substeps,
                delay=u.shift,
                block=layout.block,
                adjoint=dfx.ForwardMode(),
            )
        )
    return tuple(out)


def prior_rows(layout: Layout, data: Data, z: Float[Array, " q"]) -> Float[Array, " r"]:
    """(value - mean) / sd of the parameters' priors; zero where there is none."""
    u = unpack(layout, data, z)
    values = jnp.stack(list(u.params.values()))
    return (values - data.prior_mean) / data.prior_sd


def weak_rows(layout: Layout, z: Float[Array, " q"]) -> Float[Array, " r"]:
    """Weak priors of the initial states and biases: their coordinates are in units of its sd."""
    return z[len(layout.named) :]


def _whitened(layout: Layout, data: Data, sd: Any, z: Array, raw: Any) -> Array:
    rows = [r / s[n] for by_name, s in zip(raw, sd, strict=True) for n, r in by_name.items()]
    return jnp.concatenate([*rows, prior_rows(layout, data, z), weak_rows(layout, z)])


class Evaluation(NamedTuple):
    """Everything that one differentiated run tells."""

    raw: tuple[dict[str, Any], ...]
    """measured - bias - simulated, SI, by flight and output"""
    state_rms: tuple[dict[str, Any], ...]
    """root mean square of each state, by flight"""
    r: Any
    """(n,) whitened residuals with prior rows"""
    J: Any
    """(n, q) derivative of r by z"""
    named: Any
    """values of the named unknowns"""
    slopes: Any
    """their derivatives by their own coordinates"""


@eqx.filter_jit
def evaluate(
    layout: Layout, data: Data, sd: tuple[dict[str, Any], ...], z: Float[Array, " q"]
) -> Evaluation:
    """Residuals, their Jacobian in forward mode, and the named unknowns, in one pass.

    The residual: measured - bias - simulated over sd for all flights and outputs, then the
    priors' rows (value - mean) / sd, then the weak priors' rows.
    """

    def rows(z: Array) -> tuple[Array, Any]:
        u = unpack(layout, data, z)
        runs = predict(layout, data, u)
        raw = tuple(
            {n: y - bias[n] - getattr(run.outputs, n) for n, y in flight.outputs.items()}
            for flight, run, bias in zip(data.flights, runs, u.biases, strict=True)
        )
        rms = tuple(
            {n: jnp.sqrt(jnp.mean(jnp.square(v))) for n, v in naming.asdict(run.states).items()}
            for run in runs
        )
        r = _whitened(layout, data, sd, z, raw)
        return r, (raw, rms, r)

    def named(z: Array) -> Array:
        u = unpack(layout, data, z)
        shift = () if u.shift is None else (u.shift,)
        return jnp.stack([*u.params.values(), *u.gains.values(), *shift])

    J, (raw, rms, r) = jax.jacfwd(rows, has_aux=True)(z)
    return Evaluation(raw, rms, r, J, named(z), jnp.diagonal(jax.jacfwd(named)(z)))
