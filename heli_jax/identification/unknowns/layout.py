"""The unknowns of a problem: their places in the vector z, and the numbers of the problem.

z holds coordinates of the free parameters, then input gains, the time shift, the disturbance, the
noise of sensors before filters and of outputs. For each flight the initial state, the biases and
the offsets of the inputs follow.
"""

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from heli_jax import naming
from heli_jax.dynamics.disturbance import disturbances_of, sensor_noise, with_sensor_noise
from heli_jax.dynamics.model import Model
from heli_jax.flights.flight import Flight
from heli_jax.identification.methods import objective_of
from heli_jax.identification.problem import MAX_TIME_SHIFT, Problem
from heli_jax.identification.unknowns import transforms
from heli_jax.identification.unknowns.transforms import Real

# Any: a record class of the model (Params, State, Inputs), or NumPy values that become JAX arrays.

_BLOCK = 32
_SCALES = 40.0
"""Largest difference between the log noise of one output and its guess."""
_FAINTEST, _STRONGEST = 60.0, 10.0
"""Limits of log sigma_w: below the measured motion, and above the disturbance that moves the model
as far within one sample."""
_SHORTEST, _LONGEST = 0.01, 1e3
"""Bounds of tau_w, in samples and in record lengths."""


class FlightData(NamedTuple):
    """One flight as arrays."""

    dt: Any
    """Sample time [s]."""
    inputs: Any
    """The model's Inputs, arrays (N,), SI."""
    outputs: dict[str, Any]
    """Measured outputs, arrays (N,), SI; NaN for missing samples."""
    known: dict[str, Any]
    """Parameters specific to this flight, SI."""
    state_scale: dict[str, Any]
    """sd of the weak prior on the initial state."""
    bias_scale: dict[str, Any]
    """sd of the weak prior on the bias."""
    offset_scale: dict[str, Any]
    """sd of the weak prior on the offset of each input."""
    by_instrument: Any = None
    """The part of the model's Inputs that follows the instruments, arrays (N,); None without
    instruments."""


class Data(NamedTuple):
    """All numbers of a problem."""

    base: Any
    """The vehicle's parameters by name."""
    sign: Any
    """Sign of the start; the scale of a linear coordinate."""
    low: Any
    high: Any
    prior_mean: Any
    prior_sd: Any
    """sd of the prior; inf without a prior."""
    flights: tuple[FlightData, ...]


class Layout(eqx.Module):
    """Static part of a problem: the unknowns and their order."""

    model: Model
    free: tuple[str, ...] = eqx.field(static=True)
    kinds: tuple[str, ...] = eqx.field(static=True)
    gains: tuple[str, ...] = eqx.field(static=True)
    shift: bool = eqx.field(static=True)
    initial_state: bool = eqx.field(static=True)
    bias: bool = eqx.field(static=True)
    offsets: tuple[str, ...] = eqx.field(static=True)
    """Inputs with an offset of their own in each flight."""
    outputs: tuple[tuple[str, ...], ...] = eqx.field(static=True)
    """Outputs by flight, sorted by name: the order of the residuals."""
    disturbance: tuple[str, ...] = eqx.field(static=True)
    """Disturbance parameters that filter error estimates."""
    filtered: tuple[str, ...] = eqx.field(static=True)
    """Filter error: outputs with sensor noise of unknown sd before on-board low-passes."""
    scaled: tuple[str, ...] = eqx.field(static=True)
    """Filter error: outputs with their own unknown noise factor."""
    objective: Any = eqx.field(static=True)
    """The method's `Objective`, whose module imports this one."""
    solver: str | None = eqx.field(static=True)
    substeps: int = eqx.field(static=True)
    block: int = eqx.field(static=True)
    """Samples per step of the exact recurrence."""
    windows: tuple[tuple[int, int], ...] = eqx.field(static=True)
    """Number of windows and samples of each, by flight."""
    continuity: float | None = eqx.field(static=True)
    """See `Problem.continuity`."""
    holds: tuple[tuple[str, ...], ...] = eqx.field(static=True)
    """Hold of each of the model's inputs by flight (`Flight.hold`)."""
    one_covariance: tuple[tuple[int, ...], ...] = eqx.field(static=True)
    """Filter error: groups of flights that share covariances."""
    flight_facts: tuple[Any, ...] = eqx.field(static=True, default=())
    """`Objective.flight_facts` by flight."""
    reverse: bool = eqx.field(static=True, default=False)
    """True if the rows are differentiated in reverse mode too."""

    @property
    def noise_model(self) -> str:
        """Noise model of the method (`Objective.noise_model`)."""
        return self.objective.noise_model

    @property
    def of_interest(self) -> tuple[str, ...]:
        """Parameters of interest, first in z: free parameters, gains and the shift."""
        gains = tuple(f"gain {name}" for name in self.gains)
        return (*self.free, *gains, *(("time_shift",) if self.shift else ()))

    @property
    def states(self) -> tuple[str, ...]:
        """States whose initial values are unknowns: all that are not random."""
        if not self.initial_state:
            return ()
        # The state of a disturbance has a distribution at the first sample.
        random = self.model.random_states
        return tuple(n for n in naming.names(self.model.State) if n not in random)

    @property
    def first_nuisance(self) -> int:
        """Index in z of the first nuisance parameter of a flight: initial states, biases and input
        offsets, which have weak priors."""
        return len(self.of_interest) + len(self.noises) + len(self.scaled)

    @property
    def noises(self) -> tuple[str, ...]:
        """Parameters of process noise: disturbance parameters, then sds of noise before filters."""
        return (*self.disturbance, *map(sensor_noise, self.filtered))

    @property
    def sigmas(self) -> tuple[str, ...]:
        """Standard deviations of disturbances among the unknowns."""
        return tuple(d.sigma for d in disturbances_of(self.model) if d.sigma in self.disturbance)

    def disturbance_at(self, name: str) -> int:
        """Return the index in z of a parameter of process noise."""
        return len(self.of_interest) + self.noises.index(name)

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return self.first_nuisance + sum(places.every.size for places in flight_places(self))

    def hold(self, i: int) -> dict[str, str]:
        """Return the hold of each input of the i-th flight, by name."""
        return dict(zip(naming.names(self.model.Inputs), self.holds[i], strict=True))

    @property
    def determined(self) -> int:
        """Number of unknowns, with states linked by continuity counted once."""
        if self.continuity is None:
            return self.size
        # With continuity the states at the start of a window nearly equal those at the end of the
        # last.
        return self.size - len(self.states) * sum(count - 1 for count, _ in self.windows)


class FlightUnknown(NamedTuple):
    """An unknown of one flight; its weak prior has an sd of ten times the signal."""

    label: str
    """Name in the fit: 'flight 1/bias p', 'flight 1/initial p of window 2'."""
    kind: str
    """Its switch in `Nuisance`."""
    of: str
    """Its state, output or input."""
    flight: int

    @property
    def words(self) -> str:
        """Name in a sentence, for any flight: 'the bias of p'."""
        kinds = {"initial_state": "initial", "bias": "bias of", "input_offset": "offset of"}
        return f"the {kinds[self.kind]} {self.of}"

    def scale(self, data: "Data") -> Any:
        """Return the sd of its prior, by which z is multiplied [SI]."""
        flight = data.flights[self.flight]
        scales = {
            "initial_state": flight.state_scale,
            "bias": flight.bias_scale,
            "input_offset": flight.offset_scale,
        }
        return scales[self.kind][self.of]


class FlightPlaces(NamedTuple):
    """Indices of one flight's unknowns in z."""

    states: Int[np.ndarray, "windows k"]
    biases: Int[np.ndarray, " p"]
    offsets: Int[np.ndarray, " i"]

    @property
    def constants(self) -> Int[np.ndarray, " c"]:
        """Biases and offsets."""
        return np.concatenate([self.biases, self.offsets])

    @property
    def every(self) -> Int[np.ndarray, " q"]:
        """All of them, in the order of z."""
        return np.concatenate([self.states.ravel(), self.constants])


def flight_places(layout: Layout) -> list[FlightPlaces]:
    """Return the indices of each flight's unknowns in z."""
    places, at, k = [], layout.first_nuisance, len(layout.states)
    for (windows, _), outputs in zip(layout.windows, layout.outputs, strict=True):
        sizes = windows * k, len(outputs) if layout.bias else 0, len(layout.offsets)
        states, biases, offsets = np.split(at + np.arange(sum(sizes)), np.cumsum(sizes)[:2])
        places.append(FlightPlaces(states.reshape(windows, k), biases, offsets))
        at += sum(sizes)
    return places


def flight_unknowns(layout: Layout, called: Sequence[str]) -> tuple[FlightUnknown, ...]:
    """Return the unknowns from `layout.first_nuisance` on, in the order of z."""
    unknowns = []
    for i, ((count, _), outputs) in enumerate(zip(layout.windows, layout.outputs, strict=True)):
        ends = [f" of window {k + 1}" if count > 1 else "" for k in range(count)]
        names = [(f"initial {n}{end}", "initial_state", n) for end in ends for n in layout.states]
        names += [(f"bias {n}", "bias", n) for n in outputs if layout.bias]
        names += [(f"offset {n}", "input_offset", n) for n in layout.offsets]
        unknowns += [FlightUnknown(f"{called[i]}/{name}", kind, n, i) for name, kind, n in names]
    return tuple(unknowns)


class Noise(NamedTuple):
    """The noise by which residuals are divided."""

    sd: tuple[dict[str, Any], ...]
    """sd of the measurement noise by flight and output; those in `Layout.scaled` are multiplied by
    their factors."""
    log_determinant: Any
    """Methods in frequency: mean over all lines of log det(spectrum); else zero."""
    whitening: Any = ()
    """Frequency error: whitening matrices of each record's lines (K, p, p); otherwise ()."""
    corrections: Any = ()
    """Filter error: slope of a likelihood correction by parameter, and where the correction is zero
    (2,), see `noise_scales`; () if the model integrates no sensor."""


class Solution(NamedTuple):
    """A point with all that is needed to evaluate it, such as the end of a fit."""

    layout: Layout
    data: Data
    noise: Noise
    z: Any


class Unknowns(NamedTuple):
    """The vector z split into names, in the units of the model."""

    params: dict[str, Any]
    noise: dict[str, Any]
    scales: dict[str, Any]
    """Factors of the measurement noise by output."""
    gains: dict[str, Any]
    shift: Any
    states: tuple[Any, ...]
    """State at the first sample by flight, with arrays (windows,) if there are several; None for
    the model's own."""
    biases: tuple[dict[str, Any], ...]
    offsets: tuple[dict[str, Any], ...]
    """Offsets of the inputs by flight."""


def layout_of(problem: Problem, flights: tuple[Flight, ...]) -> Layout:
    """Return the static part of a problem for the given flights."""
    # All of it is hashable and static, so problems with equal layouts share compiled programs.
    objective = objective_of(problem.method)
    nuisance = problem.nuisance
    exact = problem.solver == "exact" or (problem.solver is None and problem.model.linear)
    return Layout(
        model=with_sensor_noise(problem.model, tuple(problem.filtered_noise)),
        free=tuple(problem.free),
        kinds=tuple(transforms.kind(f) for f in problem.free.values()),
        gains=naming.names(problem.model.Inputs) if nuisance.input_gain else (),
        shift=nuisance.time_shift,
        initial_state=nuisance.initial_state,
        bias=nuisance.bias,
        offsets=problem.offset_inputs,
        # JAX orders dictionaries by name in compiled programs.
        outputs=tuple(tuple(sorted(f.outputs)) for f in flights),
        disturbance=tuple(problem.noise),
        filtered=tuple(problem.filtered_noise),
        scaled=objective.scaled_outputs(problem),
        objective=objective,
        solver=problem.solver,
        substeps=problem.substeps,
        # Only an exact recurrence allows several samples in a step.
        block=_BLOCK if exact else 1,
        windows=tuple(_windows(problem, flight) for flight in flights),
        continuity=problem.continuity,
        holds=tuple(_holds(problem.model, flight) for flight in flights),
        one_covariance=_one_covariance(problem, flights),
        flight_facts=objective.flight_facts(problem, flights),
    )


def _holds(model: Model, flight: Flight) -> tuple[str, ...]:
    return tuple(flight.hold[n] for n in naming.names(model.Inputs))


def _one_covariance(problem: Problem, flights: tuple[Flight, ...]) -> tuple[tuple[int, ...], ...]:
    """Return groups of flights that share one covariance.

    They are flights of a linear model without missing samples.
    """
    if not (problem.model.linear and problem.noise_model == "disturbance"):
        return ()
    groups: dict[Any, list[int]] = {}
    for i, flight in enumerate(flights):
        # A missing sample changes the covariance of its record.
        if all(np.isfinite(y).all() for y in flight.outputs.values()):
            numbers = (sorted(flight.sd.items()), sorted(flight.known.items()))
            key = (flight.dt, sorted(flight.outputs), _holds(problem.model, flight), numbers)
            groups.setdefault(repr(key), []).append(i)
    return tuple(tuple(group) for group in groups.values())


def _windows(problem: Problem, flight: Flight) -> tuple[int, int]:
    """Return the number of windows and the samples of each; a short rest belongs to the last."""
    n = flight.n_samples
    if problem.window is None:
        return 1, n
    samples = round(problem.window / flight.dt)
    # `Problem.window` is met only roughly, because windows of equal length share one vmap.
    count = max(1, round(n / samples))
    return count, -(-n // count)


def value_of(layout: Layout, data: Data, i: int, z: Real) -> Any:
    """Return the value of a free parameter."""
    return transforms.to_value(layout.kinds[i], z, data.sign[i], data.low[i], data.high[i])


def disturbance_limits(layout: Layout, data: Data) -> dict[str, tuple[Any, Any]]:
    """Return the lowest and highest logarithm of each disturbance parameter.

    A correlation time below a hundredth of a sample is white noise, and one above a thousand
    records is a random walk. sigma_w is limited by the size of the measured motion. Without limits
    a likelihood without a maximum would drive them to overflow.
    """
    dt = functools.reduce(jnp.minimum, [flight.dt for flight in data.flights])
    longest = functools.reduce(
        jnp.maximum,
        [f.dt * next(iter(f.outputs.values())).shape[0] for f in data.flights],
    )
    # The scale of a bias is ten times the output.
    motion = functools.reduce(
        jnp.maximum, [0.1 * s for f in data.flights for s in f.bias_scale.values()]
    )
    # sigma_w is an acceleration. Over one sample it moves an angle by sigma_w dt^2, hence -2
    # log(dt) in the upper limit.
    limits = dict.fromkeys(
        layout.disturbance, (jnp.log(_SHORTEST * dt), jnp.log(_LONGEST * longest))
    )
    for name in layout.sigmas:
        size = jnp.log(motion)
        limits[name] = (size - _FAINTEST, size - 2.0 * jnp.log(dt) + _STRONGEST)
    for output in layout.filtered:
        # The scale of a bias is ten times the output, more than any noise.
        scales = [f.bias_scale[output] for f in data.flights if output in f.bias_scale]
        size = jnp.log(functools.reduce(jnp.maximum, scales))
        limits[sensor_noise(output)] = (size - _FAINTEST, size)
    return limits


def unpack(layout: Layout, data: Data, z: Float[Array, " q"]) -> Unknowns:
    """Return the unknowns by name, in the units of the model."""
    q = len(layout.free)
    params = {name: value_of(layout, data, i, z[i]) for i, name in enumerate(layout.free)}
    gains = {name: z[q + i] for i, name in enumerate(layout.gains)}
    at = q + len(layout.gains)
    shift = None
    if layout.shift:
        # The bound is smooth, because a clipped shift would have no derivative at the bound.
        shift = MAX_TIME_SHIFT * jnp.tanh(z[at])
        at += 1
    limits = disturbance_limits(layout, data)
    # Clipping keeps the likelihood's shape in the logarithm inside the limits. Outside, the zero
    # derivative shows that the parameter has no effect.
    noise = {
        name: jnp.exp(jnp.clip(z[at + i], *limits[name])) for i, name in enumerate(layout.noises)
    }
    flights = [_of_flight(layout, i, flight, z) for i, flight in enumerate(data.flights)]
    states, biases, offsets = zip(*flights, strict=True)
    scales = scales_of(layout, z)
    return Unknowns(params, noise, scales, gains, shift, states, biases, offsets)


def scales_of(layout: Layout, z: Float[Array, " q"]) -> dict[str, Any]:
    """Return the estimated factors on the guessed noise, by output."""
    first = layout.first_nuisance - len(layout.scaled)
    return {
        name: jnp.exp(jnp.clip(z[first + i], -_SCALES, _SCALES))
        for i, name in enumerate(layout.scaled)
    }


def _of_flight(
    layout: Layout, i: int, flight: FlightData, z: Array
) -> tuple[Any, dict[str, Any], dict[str, Any]]:
    """Return the i-th flight's initial state, biases and input offsets."""
    places, outputs, state = flight_places(layout)[i], layout.outputs[i], None
    if layout.initial_state:
        every = places.states.ravel().tolist()
        initial = z[every[0] : every[-1] + 1] if every else z[:0]
        initial = initial.reshape(places.states.shape)
        initial = initial[0] if len(initial) == 1 else initial
        # Random states begin at their mean, zero.
        values = dict.fromkeys(
            naming.names(layout.model.State), jnp.zeros(initial.shape[:-1], z.dtype)
        )
        values |= {n: initial[..., j] * flight.state_scale[n] for j, n in enumerate(layout.states)}
        state = layout.model.State(**values)
    bias = dict.fromkeys(outputs, jnp.zeros_like(z[0]))
    if layout.bias:
        each = zip(outputs, places.biases.tolist(), strict=True)
        bias = {n: z[k] * flight.bias_scale[n] for n, k in each}
    each = zip(layout.offsets, places.offsets.tolist(), strict=True)
    return state, bias, {n: z[k] * flight.offset_scale[n] for n, k in each}
