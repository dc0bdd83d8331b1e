"""The numbers of a problem over its flights as arrays, and the unknowns at the start values."""

from dataclasses import replace
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
    SimulatedOutputs,
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
    """The numbers of a problem over the given flights, whose layout may be at hand already."""
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
        # An infinite sd in place of a missing prior: its row is zero, and problems that differ in
        # their priors share one compiled program.
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
    """Signals on the device, once instead of with every call of a compiled program; numbers that
    stand alone, of which there are many more, take longer to put there than to hand over."""
    leaves, structure = jax.tree.flatten(numbers)
    signals = iter(jax.device_put([v for v in leaves if v.ndim]))
    return jax.tree.unflatten(structure, [next(signals) if v.ndim else v for v in leaves])


def _flight_data(
    problem: Problem, flight: Flight, dtype: np.dtype, follows: dict[str, np.ndarray] | None
) -> FlightData:
    """`follows`: by input what of it follows the instruments."""
    model = problem.model

    def arrays(by_name: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        return {n: np.asarray(by_name[n], dtype) for n in naming.names(model.Inputs)}

    inputs = arrays(flight.inputs)
    # By name, as JAX orders them in everything that is compiled.
    outputs = {n: np.asarray(y, dtype) for n, y in sorted(flight.outputs.items())}
    return FlightData(
        dt=np.asarray(flight.dt, dtype),
        inputs=model.Inputs(**inputs),
        outputs=outputs,
        known={n: np.asarray(v, dtype) for n, v in flight.known.items()},
        # Ones until a run from the start values has shown what the states do: see below.
        state_scale={n: np.ones((), dtype) for n in naming.names(model.State)},
        # Ten times the signal: so weak a prior says no more than the order of magnitude, but keeps
        # an unknown that has no effect from drifting off.
        bias_scale={
            n: np.asarray(10.0 * _size(y[np.isfinite(y)]), dtype) for n, y in outputs.items()
        },
        # How far an input moves, or its size where it never does.
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
    """rms of a signal, 1 where that says nothing."""
    rms = _rms(values)
    return rms if np.isfinite(rms) and rms > 0 else 1.0


def _with_state_scales(problem: Problem, layout: Layout, data: Data) -> Data:
    """Ten times what each state does in a run from the start values: a weak prior's sd.

    The run is brought to the size of the measured outputs first, since a gain may be unknown.
    """
    # Initial states are zero in it whatever their scales are, which may be the ones still.
    z = start_vector(layout, data, problem)
    at_start, simulated = _before_it_grows(layout, data, z)
    scaled, names = [], naming.names(layout.model.State)
    for flight, runs, rms in zip(data.flights, simulated, at_start.state_rms, strict=True):
        y = {n: np.asarray(v) for n, v in flight.outputs.items()}
        y = {n: v[np.isfinite(v)] for n, v in y.items()}
        # On average over the outputs: one gain that is off scales them all.
        ratio = 10.0 * float(np.mean([_size(v) / _size(runs[n]) for n, v in y.items()]))
        scale = {n: np.asarray(ratio * _size(v), z.dtype) for n, v in zip(names, rms, strict=True)}
        scaled.append(flight._replace(state_scale=scale))
    return data._replace(flights=tuple(scaled))


def _simulated(layout: Layout, data: Data, z: jax.Array) -> SimulatedOutputs:
    """Simulate at z."""
    # By the program that is to be compiled anyway, where that simulates on its way: one more for
    # the simulation alone would take longer than the derivatives that nobody asks for here.
    if layout.noise_model == "white":
        ones = tuple({n: np.ones((), z.dtype) for n in names} for names in layout.outputs)
        at = residual_and_jacobian(layout, data, Noise(ones, np.zeros((), z.dtype)), z)
        if at.simulated is not None:
            return at.simulated
    return simulated_at(layout, data, z)


_GROWN = 100.0
"""times all that was measured of a flight, from which on a run that grows says nothing of sizes:
its unstable mode drowns all other states"""
_HALVINGS = 8


def _before_it_grows(
    layout: Layout, data: Data, z: Array
) -> tuple[SimulatedOutputs, tuple[dict[str, np.ndarray], ...]]:
    """Simulate at z, an unstable model over as much of the records as it stays near
    them; as NumPy arrays, and by flight and output."""
    simulate = _simulated
    for _ in range(_HALVINGS):
        runs = jax.device_get(simulate(layout, data, z))
        simulated = by_output(layout, runs)
        windows = [count for count, _ in layout.windows]
        far = any(
            runs_away(v, np.asarray(f.outputs[n]))
            for f, by_name in zip(data.flights, simulated, strict=True)
            for n, v in by_name.items()
        )
        # Windows are short already.
        if not far or max(windows) > 1 or min(m for _, m in layout.windows) < 4:
            break
        cut = tuple((1, m // 2) for _, m in layout.windows)
        flights = tuple(
            f._replace(inputs=jax.tree.map(lambda v, m=m: v[:m], f.inputs))
            for f, (_, m) in zip(data.flights, cut, strict=True)
        )
        layout, data = replace(layout, windows=cut), data._replace(flights=flights)
        # Of the cut records the simulation alone: their outputs are no longer of their length.
        simulate = simulated_at
    return runs, simulated


def runs_away(simulated: np.ndarray, measured: np.ndarray) -> bool:
    """True if a simulation grows, and far beyond what was measured, which no wrong gain makes it.

    Args:
        simulated: an output (N,).
        measured: of it (M,), NaN where a sample is missing.
    """
    half = len(simulated) // 2
    grows = not _rms(simulated[half:]) <= 10.0 * _rms(simulated[:half])
    return grows and not _rms(simulated) < _GROWN * _size(measured[np.isfinite(measured)])


# Where z begins.


def start_vector(layout: Layout, data: Data, problem: Problem) -> Float[Array, " q"]:
    """Return z at the start values: gains 1, no shift, the model's own initial state, no bias."""
    dtype = data.low.dtype
    # Fetched once: an entry by itself would be a program of its own, for each of the unknowns.
    limits = zip(*jax.device_get((data.sign, data.low, data.high)), strict=True)
    z = [
        transforms.to_coordinate(kind, np.asarray(f.start, dtype), *of_one)
        for f, kind, of_one in zip(problem.free.values(), layout.kinds, limits, strict=True)
    ]
    one, zero = np.ones((), dtype), np.zeros((), dtype)
    z += [one] * len(layout.gains) + [zero] * layout.shift
    z += [np.asarray(np.log(problem.noise[n].start), dtype) for n in layout.disturbance]
    z += [np.asarray(np.log(problem.filtered_noise[n].start), dtype) for n in layout.filtered]
    # Zero is the mean of the weak priors, and for the noise's factors the guess as it is.
    whole = np.zeros(layout.size, dtype)
    whole[: len(z)] = jax.device_get(z)
    # A linear model without a start of its own begins at zero, as z does.
    if layout.initial_state and not (layout.model.linear and layout.model.start is None):
        _initial_states(layout, data, problem, whole)
    return jnp.asarray(whole)


def _initial_states(layout: Layout, data: Data, problem: Problem, z: np.ndarray) -> None:
    """Enter the model's own initial state (of a whole helicopter its hover), or for one that is not
    linear the nearest that shows the measured outputs at the first sample of the window."""
    names, places = naming.names(layout.model.State), flight_places(layout)
    values = {n: np.asarray(f.start, z.dtype) for n, f in problem.free.items()}
    for flight, own, (_, m) in zip(data.flights, places, layout.windows, strict=True):
        # What is known of this flight alone stands over what is free in all of them.
        params = layout.model.Params(**{**data.base, **values, **flight.known})
        by_model = own_start(layout.model, params)
        first = np.array([by_model[n] for n in names])
        # Coordinates of states are in units of their weak priors' sds.
        scales = np.array([float(flight.state_scale[n]) for n in layout.states])
        for k, at in enumerate(own.states):
            x0 = first
            # The residual of a linear model is linear in its initial states: one step finds them
            # from anywhere. Of others a far start can lie in the valley of another solution.
            if not layout.model.linear:
                x0 = _state_that_shows(layout, params, flight, k * m, first)
            z[at] = x0[[names.index(n) for n in layout.states]] / scales


# Any: the model's Params, whose class may be a user's own.
def own_start(model: Model, params: Any) -> dict[str, float]:
    """Return the model's initial state; zeros of a whole helicopter's are as in hover."""
    start = {n: float(v) for n, v in naming.asdict(model.initial_state(params)).items()}
    if not is_full_nonlinear(model):
        return start
    # With its tail's side force a helicopter hovers on a bank, with its rotor tilted. From level it
    # would slide away, and what no output shows would have to be searched for from there.
    try:
        hover = trim(model, params).state
    except ValueError:  # the start values cannot fly; the optimum may
        return start
    return {n: v if v != 0.0 else float(getattr(hover, n)) for n, v in start.items()}


_LINE = 5
"""samples to which a straight line is fitted for the value at the first"""


def _state_that_shows(
    layout: Layout, params: Any, flight: FlightData, k: int, first: np.ndarray
) -> np.ndarray:
    """The state (n,) nearest to `first` whose outputs are the measured ones at sample k.

    Three Gauss-Newton steps: outputs are mostly states themselves, or angles of them.
    """
    measured = {n: _at_start(np.asarray(y)[k:]) for n, y in flight.outputs.items()}
    measured = {n: v for n, v in measured.items() if np.isfinite(v)}
    inputs = jax.tree.map(lambda u: u[k], flight.inputs)
    names, x = naming.names(layout.model.State), first
    rows = [naming.names(layout.model.Outputs).index(n) for n in measured]
    for _ in range(3):
        state = layout.model.State(**dict(zip(names, jnp.asarray(x), strict=True)))
        _, _, C, _ = jacobians(layout.model, params, state, inputs)
        outputs = naming.asdict(layout.model.output(params, state, inputs))
        error = np.array([v - float(outputs[n]) for n, v in measured.items()])
        # The least step: states that no output shows stay where the model puts them.
        x = x + np.linalg.pinv(np.asarray(C)[rows], rcond=1e-8) @ error
    return x


def _at_start(y: np.ndarray) -> float:
    """The value at the first of the samples, from a few with less noise than one has; NaN where
    nothing is measured."""
    seen = np.flatnonzero(np.isfinite(y[:_LINE]))
    if seen.size < 3:
        # Too few for a line that averages anything. A slow sensor's first sample comes later: the
        # vehicle was near that, rather than at zero.
        seen = seen if seen.size else np.flatnonzero(np.isfinite(y))
        return float(y[seen[0]]) if seen.size else float("nan")
    return float(np.polyval(np.polyfit(seen, y[seen], 1), 0.0))
