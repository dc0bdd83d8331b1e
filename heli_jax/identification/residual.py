"""The one residual: fit, identifiability and uncertainty all differentiate this function.

For flight f and output j the residual is (measured - bias - simulated) / sd; prior rows
(value - mean) / sd follow. Unknowns form one vector z: coordinates of the free parameters, then
input gains, the time shift, then for each flight the initial state and the biases.
"""

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
from heli_jax.identification.kalman import Innovations, innovations
from heli_jax.identification.problem import MAX_TIME_SHIFT, Problem
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
    noise: tuple[str, ...] = eqx.field(static=True)
    """parameters of the disturbance, estimated beside the others by filter error"""
    filtered: bool = eqx.field(static=True)
    """whether the residuals are a Kalman filter's innovations"""
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
    def states(self) -> tuple[str, ...]:
        """The states whose initial values are unknowns: all that are not random there."""
        if not self.initial_state:
            return ()
        random = self.model.spread_names
        return tuple(n for n in naming.names(self.model.State) if n not in random)

    @property
    def weak(self) -> int:
        """Where in z the initial states and biases begin."""
        return len(self.named) + len(self.noise)

    def noise_at(self, name: str) -> int:
        """Where in z a parameter of the disturbance stands."""
        return len(self.named) + self.noise.index(name)

    @property
    def size(self) -> int:
        """The number of unknowns."""
        each = [len(self.states) + (len(o) if self.bias else 0) for o in self.outputs]
        return self.weak + sum(each)


class Noise(NamedTuple):
    """What the residuals are measured by."""

    sd: tuple[dict[str, Any], ...]
    """of the measurement noise, by flight and output"""
    level: Any
    """filter error: the mean over all measurements of log(innovation variance / sd^2) about which
    the concentrated likelihood is scaled, so that its rows have variance 1"""


class Unknowns(NamedTuple):
    """The vector z taken apart, in the units of the model."""

    params: dict[str, Any]
    noise: dict[str, Any]
    gains: dict[str, Any]
    shift: Any
    states: tuple[Any, ...]
    """one State or None a flight"""
    biases: tuple[dict[str, Any], ...]


def layout_of(
    problem: Problem,
    flights: tuple[Flight, ...],
    *,
    bounded: bool = False,
    simulated: bool = False,
) -> Layout:
    """The static side of a problem over the given flights.

    `bounded` keeps the free parameters within their bounds by logit coordinates; `simulated`
    compares with a simulation whatever the problem's method.
    """
    filtering = problem.method == "filter-error" and not simulated
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
        noise=tuple(problem.noise) if filtering else (),
        filtered=filtering,
        solver=problem.solver,
        substeps=problem.substeps,
        block=_BLOCK if exact else 1,
    )


def data_of(problem: Problem, flights: tuple[Flight, ...], *, simulated: bool = False) -> Data:
    """The numbers of a problem over the given flights; `simulated` as in `layout_of`."""
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
    if not nuisance.initial_state:
        return numbers
    layout = layout_of(problem, flights, simulated=simulated)
    return _with_state_scales(problem, layout, numbers)


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


def _with_state_scales(problem: Problem, layout: Layout, data: Data) -> Data:
    """Ten times what each state does in a run from the start values: a weak prior's sd.

    The run is brought to the size of the measured outputs first, since a gain may be unknown.
    """
    z = start_vector(layout, data, problem)
    one = np.ones((), z.dtype)
    sd = tuple(dict.fromkeys(flight.outputs, one) for flight in data.flights)
    e = jax.device_get(evaluate(layout, data, Noise(sd, np.zeros((), z.dtype)), z))
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
    noise = {name: jnp.exp(z[at + i]) for i, name in enumerate(layout.noise)}
    at = layout.weak
    states, biases = [], []
    for flight, outputs in zip(data.flights, layout.outputs, strict=True):
        state = None
        if layout.initial_state:
            zero = jnp.zeros_like(z[0])
            values = dict.fromkeys(naming.names(layout.model.State), zero)
            values |= {n: z[at + i] * flight.state_scale[n] for i, n in enumerate(layout.states)}
            state, at = layout.model.State(**values), at + len(layout.states)
        bias = {n: jnp.zeros_like(z[0]) for n in outputs}
        if layout.bias:
            bias = {n: z[at + i] * flight.bias_scale[n] for i, n in enumerate(outputs)}
            at += len(outputs)
        states.append(state)
        biases.append(bias)
    return Unknowns(params, noise, gains, shift, tuple(states), tuple(biases))


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
    z += [jnp.asarray(np.log(problem.noise[n].start), data.low.dtype) for n in layout.noise]
    z = jnp.stack([*z, *[zero] * (layout.size - len(z))])
    if layout.initial_state:
        z = _initial_states(layout, data, problem, z)
    return z


def _initial_states(layout: Layout, data: Data, problem: Problem, z: Array) -> Array:
    at = layout.weak
    values = {n: jnp.asarray(f.start, z.dtype) for n, f in problem.free.items()}
    for flight, outputs in zip(data.flights, layout.outputs, strict=True):
        params = layout.model.Params(**{**data.base, **values, **flight.known})
        state = naming.asdict(layout.model.initial_state(params))
        for i, name in enumerate(layout.states):
            z = z.at[at + i].set(state[name] / flight.state_scale[name])
        at += len(layout.states) + (len(outputs) if layout.bias else 0)
    return z


def _run(layout: Layout, data: Data, u: Unknowns, flight: FlightData) -> tuple[Any, Any]:
    """Parameters and inputs of one flight at the unknowns."""
    params = layout.model.Params(**{**data.base, **u.params, **u.noise, **flight.known})
    inputs = naming.asdict(flight.inputs)
    inputs = {n: v * u.gains[n] if n in u.gains else v for n, v in inputs.items()}
    return params, layout.model.Inputs(**inputs)


def predict(layout: Layout, data: Data, u: Unknowns) -> tuple[Trajectory, ...]:
    """The simulated flights (without bias)."""
    out = []
    for flight, state in zip(data.flights, u.states, strict=True):
        params, inputs = _run(layout, data, u, flight)
        out.append(
            simulate(
                layout.model,
                params,
                inputs,
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


def filtered(layout: Layout, data: Data, noise: Noise, u: Unknowns) -> tuple[Innovations, ...]:
    """The innovations of every flight."""
    out = []
    for flight, state, bias, sd in zip(data.flights, u.states, u.biases, noise.sd, strict=True):
        params, inputs = _run(layout, data, u, flight)
        measured = {n: y - bias[n] for n, y in flight.outputs.items()}
        out.append(
            innovations(
                layout.model,
                params,
                inputs,
                measured,
                sd,
                dt=flight.dt,
                initial_state=state,
                delay=u.shift,
            )
        )
    return tuple(out)


def _likelihood_rows(data: Data, noise: Noise, found: tuple[Innovations, ...]) -> Array:
    r"""$e_k/\sqrt{s_k}\,\exp(\tfrac12(\overline{\log s} - level))$: rows whose sum of squares
    is the likelihood with the scale of all noise concentrated out; zero where nothing is measured.
    """
    whitened, logs, count = [], 0.0, 0.0
    for flight, one, sd in zip(data.flights, found, noise.sd, strict=True):
        for n, y in flight.outputs.items():
            seen = jnp.isfinite(y)
            s = jnp.where(seen, one.variance[n], 1.0)
            whitened.append(jnp.where(seen, one.error[n], 0.0) / jnp.sqrt(s))
            logs += jnp.sum(jnp.where(seen, jnp.log(s / sd[n] ** 2), 0.0))
            count += jnp.sum(seen.astype(y.dtype))
    return jnp.concatenate(whitened) * jnp.exp(0.5 * (logs / count - noise.level))


def prior_rows(layout: Layout, data: Data, z: Float[Array, " q"]) -> Float[Array, " r"]:
    """(value - mean) / sd of the parameters' priors; zero where there is none."""
    u = unpack(layout, data, z)
    values = jnp.stack(list(u.params.values()))
    return (values - data.prior_mean) / data.prior_sd


def weak_rows(layout: Layout, z: Float[Array, " q"]) -> Float[Array, " r"]:
    """Weak priors of the initial states and biases: their coordinates are in units of its sd."""
    return z[layout.weak :]


def _simulation_rows(data: Data, noise: Noise, raw: Any) -> Array:
    return jnp.concatenate(
        [
            jnp.where(jnp.isfinite(y), by_name[n], 0.0) / sd[n]
            for flight, by_name, sd in zip(data.flights, raw, noise.sd, strict=True)
            for n, y in flight.outputs.items()
        ]
    )


def _rows(layout: Layout, data: Data, noise: Noise, z: Array, errors: Any) -> Array:
    """All rows from the innovations, or from measured - bias - simulated."""
    how = _likelihood_rows if layout.filtered else _simulation_rows
    rows = how(data, noise, errors)
    return jnp.concatenate([rows, prior_rows(layout, data, z), weak_rows(layout, z)])


def rows_of(layout: Layout, data: Data, noise: Noise, z: Float[Array, " q"]) -> Array:
    """The rows whose squares are summed, without their derivative."""
    u = unpack(layout, data, z)
    if layout.filtered:
        return _rows(layout, data, noise, z, filtered(layout, data, noise, u))
    return _rows(layout, data, noise, z, _raw(data, u, predict(layout, data, u)))


def _raw(data: Data, u: Unknowns, runs: tuple[Trajectory, ...]) -> tuple[dict[str, Any], ...]:
    return tuple(
        {n: y - bias[n] - getattr(run.outputs, n) for n, y in flight.outputs.items()}
        for flight, run, bias in zip(data.flights, runs, u.biases, strict=True)
    )


class Evaluation(NamedTuple):
    """Everything that one differentiated run tells."""

    raw: tuple[dict[str, Any], ...]
    """measured - bias - simulated, SI, by flight and output"""
    state_rms: tuple[dict[str, Any], ...]
    """root mean square of each simulated state, by flight"""
    innovations: tuple[Innovations, ...]
    """by flight; none with output error"""
    r: Any
    """(n,) whitened residuals with prior rows"""
    J: Any
    """(n, q) derivative of r by z"""
    named: Any
    """values of the named unknowns"""
    slopes: Any
    """their derivatives by their own coordinates"""


@eqx.filter_jit
def evaluate(layout: Layout, data: Data, noise: Noise, z: Float[Array, " q"]) -> Evaluation:
    """Residuals, their Jacobian in forward mode, and the named unknowns, in one pass.

    The residual: measured - bias - simulated over sd for all flights and outputs (output error),
    or the whitened innovations (filter error), then the priors' rows (value - mean) / sd, then
    the weak priors' rows.
    """

    def simulated(u: Unknowns) -> tuple[Any, Any]:
        runs = predict(layout, data, u)
        return _raw(data, u, runs), tuple(_rms(run.states) for run in runs)

    def rows(z: Array) -> tuple[Array, Any]:
        u = unpack(layout, data, z)
        aux = filtered(layout, data, noise, u) if layout.filtered else simulated(u)
        r = _rows(layout, data, noise, z, aux if layout.filtered else aux[0])
        return r, (r, aux)

    def named(z: Array) -> Array:
        u = unpack(layout, data, z)
        shift = () if u.shift is None else (u.shift,)
        return jnp.stack([*u.params.values(), *u.gains.values(), *shift])

    J, (r, aux) = jax.jacfwd(rows, has_aux=True)(z)
    slopes = jnp.diagonal(jax.jacfwd(named)(z))
    raw, rms = simulated(unpack(layout, data, z)) if layout.filtered else aux
    return Evaluation(raw, rms, aux if layout.filtered else (), r, J, named(z), slopes)


def _rms(states: Any) -> dict[str, Any]:
    return {n: jnp.sqrt(jnp.mean(jnp.square(v))) for n, v in naming.asdict(states).items()}
