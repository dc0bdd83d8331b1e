"""Arrays of a problem's numbers, and the unknowns at the start values."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from heli_jax import naming
from heli_jax.analysis.trim import is_full_nonlinear, trim
from heli_jax.dynamics.jacobians import jacobians
from heli_jax.dynamics.model import Model
from heli_jax.flights.flight import Flight
from heli_jax.identification.estimation.residual import residual_and_jacobian
from heli_jax.identification.estimation.simulated_flights import (
    Run,
    by_output,
    simulated_at,
)
from heli_jax.identification.methods import objective_of
from heli_jax.identification.problem import Problem
from heli_jax.identification.unknowns import transforms
from heli_jax.identification.unknowns.layout import (
    Data,
    FlightData,
    Layout,
    Noise,
    flight_places,
    layout_of,
)


def data_of(problem: Problem, flights: tuple[Flight, ...], layout: Layout | None = None) -> Data:
    """Return the numbers of a problem for the given flights.

    Args:
        layout: the problem's layout, if it is already computed.
    """
    dtype = np.dtype(jnp.result_type(float))
    nuisance, frees = problem.nuisance, list(problem.free.values())
    bounds = [transforms.limits(f) for f in frees]

    def column(values: list[float]) -> np.ndarray:
        return np.array(values, dtype)

    by = objective_of(problem.method).instrumented(problem, flights)
    follows = [None] * len(flights) if by is None else by
    numbers = Data(
        base={n: np.asarray(v, dtype) for n, v in naming.asdict(problem.vehicle).items()},
        sign=column([transforms.sign_or_scale(f) for f in frees]),
        low=column([b[0] for b in bounds]),
        high=column([b[1] for b in bounds]),
        prior_mean=column([f.prior.mean if f.prior else 0.0 for f in frees]),
        # Without a prior the sd is infinite, so that problems with any priors share compiled
        # programs.
        prior_sd=column([f.prior.sd if f.prior else np.inf for f in frees]),
        flights=tuple(
            _flight_data(problem, f, dtype, u) for f, u in zip(flights, follows, strict=True)
        ),
    )
    numbers = _placed(numbers)
    if not nuisance.initial_state:
        return numbers
    return _with_state_scales(problem, layout or layout_of(problem, flights), numbers)


def _placed(numbers: Data) -> Data:
    """Put signals on the device once instead of at every call; scalars are faster by call."""
    leaves, structure = jax.tree.flatten(numbers)
    signals = iter(jax.device_put([v for v in leaves if v.ndim]))
    return jax.tree.unflatten(structure, [next(signals) if v.ndim else v for v in leaves])


def _flight_data(
    problem: Problem, flight: Flight, dtype: np.dtype, follows: dict[str, np.ndarray] | None
) -> FlightData:
    """Return the numbers of a flight.

    Args:
        follows: by input, the part that follows the instruments.
    """
    model = problem.model

    def arrays(by_name: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        return {n: np.asarray(by_name[n], dtype) for n in naming.names(model.Inputs)}

    inputs = arrays(flight.inputs)
    # JAX orders dictionaries by name too.
    outputs = {n: np.asarray(y, dtype) for n, y in sorted(flight.outputs.items())}
    return FlightData(
        dt=np.asarray(flight.dt, dtype),
        inputs=model.Inputs(**inputs),
        outputs=outputs,
        known={n: np.asarray(v, dtype) for n, v in flight.known.items()},
        # These are placeholders for `_with_state_scales`.
        state_scale={n: np.ones((), dtype) for n in naming.names(model.State)},
        # A prior of ten times the signal is weak: it only stops unknowns without effect from
        # drifting.
        bias_scale={
            n: np.asarray(10.0 * _size(y[np.isfinite(y)]), dtype) for n, y in outputs.items()
        },
        # The scale is the motion of an input, or its size if it is constant.
        offset_scale={
            n: np.asarray(10.0 * _size(u - np.mean(u) if np.ptp(u) > 0 else u), dtype)
            for n, u in inputs.items()
        },
        by_instrument=None if follows is None else model.Inputs(**arrays(follows)),
    )


def _rms(values: jax.Array | np.ndarray) -> float:
    with np.errstate(over="ignore", invalid="ignore"):
        return float(np.sqrt(np.mean(np.square(np.asarray(values)))))


def _size(values: jax.Array | np.ndarray) -> float:
    """Return the rms of a signal; 1 if it is zero or not finite."""
    rms = _rms(values)
    return rms if np.isfinite(rms) and rms > 0 else 1.0


def _with_state_scales(problem: Problem, layout: Layout, data: Data) -> Data:
    """Return the data with the sds of the weak priors of initial states.

    They are ten times each state's motion in a simulation from the start values. The simulation is
    first scaled to the measured outputs, since a gain may be unknown.
    """
    # Its initial states are zero, so their current scales do not matter.
    runs = jax.device_get(_simulated(layout, data, start_vector(layout, data, problem)))
    scaled, names = [], naming.names(layout.model.State)
    for i, (flight, outputs) in enumerate(zip(data.flights, by_output(layout, runs), strict=True)):
        y = {n: np.asarray(v) for n, v in flight.outputs.items()}
        # Windows are too short for growth.
        near = _samples_near(outputs, y) if layout.windows[i][0] == 1 else None
        # The average over outputs is used because one wrong gain scales them all.
        sizes = [_size(v[np.isfinite(v)]) / _size(outputs[n][:near]) for n, v in y.items()]
        ratio, dtype = 10.0 * float(np.mean(sizes)), flight.dt.dtype
        states = zip(names, runs[i].states, strict=True)
        scale = {n: np.asarray(ratio * _size(x[:near]), dtype) for n, x in states}
        scaled.append(flight._replace(state_scale=scale))
    return data._replace(flights=tuple(scaled))


def _simulated(layout: Layout, data: Data, z: jax.Array) -> tuple[Run, ...]:
    """Return the simulation at z."""
    # The program of the residuals is used if it simulates. It must be compiled anyway, and
    # compiling a separate simulation takes longer than computing the derivatives.
    if layout.noise_model == "white":
        ones = tuple({n: np.ones((), z.dtype) for n in names} for names in layout.outputs)
        at = residual_and_jacobian(layout, data, Noise(ones, np.zeros((), z.dtype)), z)
        if at.simulated is not None:
            return at.simulated
    return simulated_at(layout, data, z)


_GROWN = 100.0
"""Growth of a simulation, relative to the largest measurement, beyond which its unstable mode hides
all other states."""


def _samples_near(simulated: dict[str, np.ndarray], measured: dict[str, np.ndarray]) -> int:
    """Return the number of samples before a growing simulation leaves the record.

    Args:
        simulated: outputs (N,) of an unstable model.
        measured: the measured outputs.
    """
    near = [len(next(iter(simulated.values())))]
    for n, y in measured.items():
        if runs_away(simulated[n], y):
            far = ~(np.abs(simulated[n]) < _GROWN * _size(y[np.isfinite(y)]))
            near.append(int(np.argmax(far)))
    return max(min(near), 2)


def runs_away(simulated: np.ndarray, measured: np.ndarray) -> bool:
    """True if a simulation grows far beyond the measurement, more than a wrong gain explains.

    Args:
        simulated: an output (N,).
        measured: the measured output (M,), NaN for missing samples.
    """
    half = len(simulated) // 2
    grows = not _rms(simulated[half:]) <= 10.0 * _rms(simulated[:half])
    return grows and not _rms(simulated) < _GROWN * _size(measured[np.isfinite(measured)])


# Start of z.


def start_vector(layout: Layout, data: Data, problem: Problem) -> Float[Array, " q"]:
    """Return z at the start values: gains 1, no shift, the model's own initial state, no bias."""
    dtype = data.low.dtype
    # All entries are fetched at once, because each would be a separate program.
    limits = zip(*jax.device_get((data.sign, data.low, data.high)), strict=True)
    z = [
        transforms.to_coordinate(kind, np.asarray(f.start, dtype), *of_one)
        for f, kind, of_one in zip(problem.free.values(), layout.kinds, limits, strict=True)
    ]
    one, zero = np.ones((), dtype), np.zeros((), dtype)
    z += [one] * len(layout.gains) + [zero] * layout.shift
    z += [np.asarray(np.log(problem.noise[n].start), dtype) for n in layout.disturbance]
    z += [np.asarray(np.log(problem.filtered_noise[n].start), dtype) for n in layout.filtered]
    # Zero is the mean of the weak priors, and a noise factor of one.
    whole = np.zeros(layout.size, dtype)
    whole[: len(z)] = jax.device_get(z)
    # A linear model without start values begins at zero, as z does.
    if layout.initial_state and not (layout.model.linear and layout.model.start is None):
        _initial_states(layout, data, problem, whole)
    return jnp.asarray(whole)


def _initial_states(layout: Layout, data: Data, problem: Problem, z: np.ndarray) -> None:
    """Enter the model's own initial state (hover for a full helicopter).

    For a nonlinear model, enter the nearest state that matches the measured outputs at the window's
    first sample.
    """
    names, places = naming.names(layout.model.State), flight_places(layout)
    values = {n: np.asarray(f.start, z.dtype) for n, f in problem.free.items()}
    for flight, own, (_, m) in zip(data.flights, places, layout.windows, strict=True):
        # Known values of this flight take precedence.
        params = layout.model.Params(**{**data.base, **values, **flight.known})
        by_model = own_start(layout.model, params)
        first = np.array([by_model[n] for n in names])
        # States are in units of their weak priors' sds.
        scales = np.array([float(flight.state_scale[n]) for n in layout.states])
        for k, at in enumerate(own.states):
            x0 = first
            # One step finds the initial states of a linear model from anywhere. In nonlinear models
            # a far start may lead to another solution.
            if not layout.model.linear:
                x0 = _matching_state(layout, params, flight, k * m, first)
            z[at] = x0[[names.index(n) for n in layout.states]] / scales


# Params is Any because its class may be a user's.
def own_start(model: Model, params: Any) -> dict[str, float]:
    """Return the model's initial state; for a full helicopter hover replaces zeros."""
    start = {n: float(v) for n, v in naming.asdict(model.initial_state(params)).items()}
    if not is_full_nonlinear(model):
        return start
    # Because of its tail's side force a helicopter hovers at a bank with a tilted rotor. Starting
    # level it would drift sideways.
    try:
        hover = trim(model, params).state
    except ValueError:  # the start values cannot fly, but the optimum may
        return start
    return {n: v if v != 0.0 else float(getattr(hover, n)) for n, v in start.items()}


def _matching_state(
    layout: Layout, params: Any, flight: FlightData, k: int, first: np.ndarray
) -> np.ndarray:
    """Return the state (n,) nearest to `first` that fits the first measurements from sample k.

    Three Gauss-Newton steps suffice, because outputs are mostly states or functions of angles.
    """
    after = {n: np.asarray(y)[k:] for n, y in flight.outputs.items()}
    measured = {n: y[np.isfinite(y)][0] for n, y in after.items() if np.isfinite(y).any()}
    inputs = jax.tree.map(lambda u: u[k], flight.inputs)
    names, x = naming.names(layout.model.State), first
    rows = [naming.names(layout.model.Outputs).index(n) for n in measured]
    for _ in range(3):
        state = layout.model.State(**dict(zip(names, jnp.asarray(x), strict=True)))
        _, _, C, _ = jacobians(layout.model, params, state, inputs)
        outputs = naming.asdict(layout.model.output(params, state, inputs))
        error = np.array([v - float(outputs[n]) for n, v in measured.items()])
        # The shortest step leaves states without effect on the outputs unchanged.
        x = x + np.linalg.pinv(np.asarray(C)[rows], rcond=1e-8) @ error
    return x
