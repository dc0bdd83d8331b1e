"""Where z begins, and what flights are called."""

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
from heli_jax.identification.problem import Problem
from heli_jax.identification.unknowns import transforms
from heli_jax.identification.unknowns.layout import (
    Data,
    FlightData,
    Layout,
    flight_places,
)


def labels(flights: tuple[Flight, ...]) -> list[str]:
    """What to call each flight; of several with one name the second and further have a number."""
    names = [f.name or f"flight {i + 1}" for i, f in enumerate(flights)]
    # Two logs may bear one file name; results are kept by label, so one would hide the other.
    before = [names[:i].count(name) for i, name in enumerate(names)]
    return [f"{name} ({k + 1})" if k else name for name, k in zip(names, before, strict=True)]


# params is Any: a record of a model's Params, whose class may be a user's own.


def start_vector(layout: Layout, data: Data, problem: Problem) -> Float[Array, " q"]:
    """z at the start values: gains 1, no shift, the model's own initial state, no bias.

    Args:
        layout: what stands where in z.
        data: scales, signs and bounds of the coordinates, and the measured outputs.
        problem: the start values, in the units of the parameters.
    """
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


def own_start(model: Model, params: Any) -> dict[str, float]:
    """Where the model begins, by state; what a whole helicopter begins at zero is as in hover.

    Args:
        params: its Params, concrete numbers, SI.
    """
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
        # machine was near that, rather than at zero.
        seen = seen if seen.size else np.flatnonzero(np.isfinite(y))
        return float(y[seen[0]]) if seen.size else float("nan")
    return float(np.polyval(np.polyfit(seen, y[seen], 1), 0.0))
