"""Problem: model, flights and free parameters, and checks of their consistency."""

import functools
import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

import numpy as np

from heli_jax import naming
from heli_jax.analysis.spectra import ResponseOptions
from heli_jax.dynamics.check_model import cannot_start, check_model, check_params
from heli_jax.dynamics.disturbance import disturbances_of, sensor_noise
from heli_jax.dynamics.model import (
    Model,
    require_constants,
    require_linear,
    require_sample_time,
)
from heli_jax.errors import VehicleError, nearest
from heli_jax.flights.flight import Flight
from heli_jax.identification.defaults import filtered_noise, offset_inputs
from heli_jax.identification.methods import objective_of
from heli_jax.numerics.white_noise import noise_guess
from heli_jax.vehicle import Helicopter, impossible, of_helicopter


class Prior(NamedTuple):
    """Prior knowledge of a parameter: a normal distribution, in the parameter's unit."""

    mean: float
    sd: float


Sign = Literal["keep", "any"]


class Free(NamedTuple):
    """Parameter to estimate: start, bounds and prior.

    `sign` is `keep` (the estimate has the sign of the start; searched in its logarithm) or `any`
    (searched in units of its start, which may be zero). By default parameters of a Helicopter and
    those in `Model.positive` keep their sign; parameters of user models may have any. Bounds on one
    side of zero keep the sign in either case.
    """

    start: float = math.nan
    """Initial guess; NaN: `equation_error_start` finds it before the Problem is made."""
    lower: float | None = None
    upper: float | None = None
    prior: Prior | None = None
    sign: Sign | None = None


class Nuisance(NamedTuple):
    """Unknowns of the experiment, estimated together with the parameters.

    `initial_state`, `bias` and `input_offset` belong to each flight. `input_gain` (one factor for
    each input) and `time_shift` [s] are shared by all flights. A positive time shift means that the
    stick acted later than logged.

    `input_offset` is a constant added to the logged input, because sticks are not centred exactly.
    True: all inputs; or their names. None: the sticks of a vehicle in free flight, where an offset
    is integrated (`heli_jax.identification.defaults`).
    """

    initial_state: bool = True
    bias: bool = True
    time_shift: bool = False
    input_gain: bool = False
    input_offset: bool | tuple[str, ...] | None = None


# Below, `Any` is Params, which may be a user's class.

_FEWEST = 4
"""Least samples of a window, because each window adds an initial state."""
FEWEST_SEEN = 8
"""Least measured samples of an output."""
_PER_PARAMETER = 3
"""Least samples of a flight for each free parameter."""

MAX_TIME_SHIFT = 0.5
"""Bound on an estimated time shift, to either side [s]."""


@dataclass(frozen=True, eq=False)
class Problem:
    """Model, vehicle, flights and free parameters.

    Flights with `hold_out` are predicted, never fitted. A flight's `known` parameters replace the
    vehicle's for that flight.

    Raises:
        ValueError: inconsistent parts, with their place.
        TypeError: `model` is no Model.
    """

    model: Model
    vehicle: Any
    flights: Sequence[Flight]
    free: Mapping[str, Free]
    nuisance: Nuisance = field(default_factory=Nuisance)
    solver: str | None = None
    substeps: int = 4
    gain_units: Mapping[str, str] = field(default_factory=dict)
    """Unit of an input's gain, if the log holds plain numbers."""
    method: str = "output-error"
    """`output-error` compares with a simulation. `filter-error` compares with one-step predictions
    of a Kalman filter, for models with a disturbance (`with_disturbance`)."""
    fixed_noise: tuple[str, ...] = ()
    """Noise that filter error does not estimate. `sigma_w` and `tau_w` (with several disturbances
    `sigma_w_p`, ...) come from `vehicle`, `sigma_y` (measurement noise) from the flights' `sd`."""
    window: float | None = None
    """Multiple shooting: length of the windows [s], each with its own initial state. In unstable
    flight the error of an initial state grows, so windows must be short."""
    continuity: float | None = None
    """Standard deviation of the jump of each state between windows, as a fraction of its motion;
    None: unrestricted jumps."""
    instrument: tuple[str, ...] | None = None
    """In frequency: inputs that use their instrument (`Flight.instruments`); None: all inputs for
    which every flight has one; (): none."""
    # Any: an EquationErrorStart, whose module imports this one.
    first_guess: Any = None
    """Origin of the starts, for the report; None if they are stated."""
    frequency: ResponseOptions = field(default_factory=ResponseOptions)
    """For frequency-response: band, windows and fitted responses."""

    def __post_init__(self) -> None:
        # The model comes first because the other checks need its names and units.
        check_model(self.model)
        _check_arguments(self.model.Params, self.vehicle, self.flights, self.free)
        if not isinstance(self.nuisance, Nuisance):
            got = type(self.nuisance).__name__
            raise TypeError(f"nuisance: expected Nuisance(time_shift=True, ...), got {got}")
        _warn_of_degrees(self.model.Outputs, self.flights)
        object.__setattr__(self, "flights", tuple(self.flights))
        if self.instrument is not None:
            names = (self.instrument,) if isinstance(self.instrument, str) else self.instrument
            object.__setattr__(self, "instrument", tuple(names))
        # All constants of a helicopter keep their sign, unlike the derivatives of an aircraft.
        positive = set(self.model.positive)
        if of_helicopter(self.model.Params):
            positive |= set(naming.names(Helicopter))
        free = {
            n: f if f.sign is not None else f._replace(sign="keep" if n in positive else "any")
            for n, f in self.free.items()
        }
        object.__setattr__(self, "free", free)
        _check_method(self)
        if not self.free:
            raise ValueError("no parameter is free: name at least one to estimate")
        for name, free in self.free.items():
            _check_free(name, free, self.model)
        _check_possible(self)
        _check_windows(self)
        _check_offsets(self)
        if not self.training:
            reason = "every one is held out" if self.flights else "the list of flights is empty"
            raise ValueError(f"no flight to fit: {reason}")
        for flight in self.flights:
            _check_flight(flight, self)
        _check_model(self)
        refusal = objective_of(self.method).refusal(self)
        if refusal is not None:
            raise ValueError(f"method {self.method}: {refusal}")

    @property
    def noise_model(self) -> str:
        """Noise model of the method (`Objective.noise_model`)."""
        return objective_of(self.method).noise_model

    @property
    def noise(self) -> dict[str, Free]:
        """Disturbance parameters that filter error estimates, with their starts."""
        if self.noise_model != "disturbance":
            return {}
        # The size of the motion and one second start a coarse search.
        sizes = {d.sigma: self.motion for d in disturbances_of(self.model)}
        free = {n: Free(sizes.get(n, 1.0)) for n in self.noise_names}
        for name in free:
            # A stated value counts. Zero is the default of a sigma and means 'not stated'.
            value = float(getattr(self.vehicle, name))
            if math.isfinite(value) and value > 0:
                free[name] = Free(value)
        return free

    @property
    def noise_names(self) -> tuple[str, ...]:
        """Names of the disturbance parameters that filter error estimates."""
        if self.noise_model != "disturbance":
            return ()
        names = [n for d in disturbances_of(self.model) for n in (d.sigma, d.tau)]
        return tuple(n for n in names if n not in self.fixed_noise)

    @functools.cached_property
    def filtered_noise(self) -> dict[str, Free]:
        """Sensor noise before on-board low-passes, which filter error estimates: start of its sd by
        output, if the samples show the low-pass."""
        if self.noise_model != "disturbance" or self.noise_is_fixed:
            return {}
        # A model may define its own noise of that sensor.
        own = naming.names(self.model.Params)
        coloured = [p.output for p in filtered_noise(self.model.low_passes, self.training)]
        return {
            n: Free(max(f.sd.get(n) or noise_guess(f.outputs[n]) for f in flights))
            for n in coloured
            if sensor_noise(n) not in own
            and (flights := [f for f in self.training if n in f.outputs])
        }

    @property
    def noise_is_fixed(self) -> bool:
        """True if the measurement noise is fixed at its stated value."""
        return self.noise_model == "disturbance" and "sigma_y" in self.fixed_noise

    @functools.cached_property
    def offset_inputs(self) -> tuple[str, ...]:
        """Inputs with an estimated offset, in the order of the model: those of
        `nuisance.input_offset`, or the sticks of a vehicle in free flight."""
        inputs, requested = naming.names(self.model.Inputs), self.nuisance.input_offset
        if requested is None:
            # One flight is enough, because all are of one vehicle.
            first = self.training[0]
            return offset_inputs(self.model, self.start_params(), first, tuple(self.free))
        if isinstance(requested, bool):
            return inputs if requested else ()
        return tuple(n for n in inputs if n in requested)

    @property
    def motion(self) -> float:
        """Largest standard deviation of a measured output; 1 if nothing moves."""
        return max(float(np.nanstd(y)) for f in self.training for y in f.outputs.values()) or 1.0

    @property
    def training(self) -> tuple[Flight, ...]:
        """Fitted flights."""
        return tuple(f for f in self.flights if not f.hold_out)

    def start_params(self, known: Mapping[str, Any] | None = None) -> Any:
        """Return the vehicle with the free parameters at their starts.

        Args:
            known: other values by name, SI, such as a flight's known parameters.
        """
        return self.params_with({n: f.start for n, f in self.free.items()} | dict(known or {}))

    def params_with(self, values: Mapping[str, Any]) -> Any:
        """Return the vehicle with other values of free parameters, or of a flight's known ones.

        Args:
            values: by name, SI.
        """
        return self._varied.having(values)

    @functools.cached_property
    def _varied(self) -> naming.Varied:
        # `_check_flight` rejects other names.
        own = set(naming.names(type(self.vehicle)))
        known = (n for f in self.flights for n in f.known if n in own)
        return naming.Varied(self.vehicle, dict.fromkeys((*self.free, *known)))

    def __repr__(self) -> str:
        from heli_jax.summaries import of_problem

        return of_problem(self)


def _check_method(problem: Problem) -> None:
    model = problem.model
    if problem.instrument and problem.noise_model != "spectrum":
        raise ValueError(
            f"instrument: method {problem.method} takes no input by an instrument, expected "
            "frequency-error, frequency-response, or none"
        )
    if problem.noise_model != "disturbance":
        return
    if model.noise_intensity is None:
        raise ValueError(
            f"method {problem.method}: model {model.name} has no disturbance, expected a model "
            "from with_disturbance (in a configuration: a `disturbance`) or one with its own "
            "noise_intensity"
        )
    estimated = [n for d in disturbances_of(model) for n in (d.sigma, d.tau)]
    if not all(n in (*estimated, "sigma_y") for n in problem.fixed_noise):
        raise ValueError(
            f"fixed_noise: expected some of {', '.join((*estimated, 'sigma_y'))}, got "
            f"{', '.join(problem.fixed_noise)}"
        )
    for name in estimated:
        if name in problem.free:
            raise ValueError(
                f"free.{name}: {problem.method} always estimates it, remove it from free"
            )
        value = float(getattr(problem.vehicle, name))
        if name in problem.fixed_noise and not (math.isfinite(value) and value > 0):
            raise ValueError(f"disturbance: fixed {name} must be above zero, got {value:g}")


def _check_offsets(problem: Problem) -> None:
    offsets, known = problem.nuisance.input_offset, naming.names(problem.model.Inputs)
    for name in offsets if isinstance(offsets, tuple) else ():
        if name not in known:
            raise ValueError(
                f"nuisance.input_offset: model {problem.model.name} has no input {name!r}"
                f"{nearest(name, known)}"
            )


def _check_windows(problem: Problem) -> None:
    window, continuity = problem.window, problem.continuity
    if window is None and continuity is not None:
        raise ValueError("continuity is for windows only: expected a window as well, got none")
    for key, value in (("window", window), ("continuity", continuity)):
        if value is not None and not (math.isfinite(value) and value > 0):
            raise ValueError(f"{key} must be above zero, got {value:g}")
    if window is None:
        return
    # A filter corrects its state at every sample, so it needs no windows.
    if problem.noise_model != "white":
        raise ValueError(f"window is for method output-error: {problem.method} needs none")
    if not problem.nuisance.initial_state:
        raise ValueError("windows need nuisance.initial_state, which is off")
    for flight in problem.flights:
        if (samples := round(window / flight.dt)) < _FEWEST:
            raise ValueError(
                f"{_of(flight)}: a window must hold {_FEWEST} samples at least, got {samples} in "
                f"{window:g} s"
            )


def _of(flight: Flight) -> str:
    return f"flight {flight.name!r}" if flight.name else "a flight"


def _check_possible(problem: Problem) -> None:
    if not of_helicopter(problem.model.Params):
        return
    for key in ("start", "lower", "upper"):
        values = {n: getattr(f, key) for n, f in problem.free.items()}
        # A bound of zero on a mass only states its sign.
        stated = {
            n: v for n, v in values.items() if v is not None and not (key != "start" and v == 0)
        }
        wrong = impossible(stated)
        if wrong:
            raise ValueError(f"free: the {key} of {wrong}")
    # Constants that are valid alone may contradict each other, such as R1 and R2.
    concrete = {n: float(np.asarray(v)) for n, v in naming.asdict(problem.start_params()).items()}
    wrong = impossible({n: v for n, v in concrete.items() if not math.isnan(v)})
    if wrong:
        raise VehicleError(f"with the free parameters at their starts, {wrong}")


def _check_flight(flight: Flight, problem: Problem) -> None:
    where, model = _of(flight), problem.model
    missing = [n for n in naming.names(model.Inputs) if n not in flight.inputs]
    if missing:
        raise ValueError(f"{where} has no input {missing[0]!r}, which model {model.name} needs")
    # A model may have outputs that are not measured.
    unknown = [n for n in flight.outputs if n not in naming.names(model.Outputs)]
    if unknown:
        raise ValueError(
            f"{where}: model {model.name} has no output {unknown[0]!r}"
            f"{nearest(unknown[0], naming.names(model.Outputs))}"
        )
    if not flight.outputs:
        raise ValueError(f"{where} has no output to compare with the model")
    for name, y in flight.outputs.items():
        # Most samples may be missing, as with a slow sensor, but the noise needs more than a few.
        if (seen := int(np.isfinite(y).sum())) < FEWEST_SEEN:
            raise ValueError(
                f"{where}, output {name!r}: expected at least {FEWEST_SEEN} measured samples, got "
                f"{seen} of {y.size}"
            )
        if problem.noise_is_fixed and name not in flight.sd and not flight.hold_out:
            raise ValueError(
                f"{where}, output {name!r}: expected the sd of its noise, which is fixed "
                "(sigma_y), got none"
            )
    # A parameter is either known for a flight or estimated over all flights.
    for name, value in flight.known.items():
        if name not in naming.names(model.Params):
            raise ValueError(
                f"{where}, known.{name}: model {model.name} has no such parameter"
                f"{nearest(name, naming.names(model.Params))}"
            )
        if name in problem.free or name in problem.noise_names:
            raise ValueError(f"{where}, known.{name}: expected known or free, got both")
        if not math.isfinite(value):
            raise ValueError(f"{where}, known.{name}: expected a finite number, got {value}")
        wrong = impossible({name: value}) if of_helicopter(model.Params) else None
        if wrong:
            raise ValueError(f"{where}, known: {wrong}")
    count, least = len(problem.free), _PER_PARAMETER * len(problem.free)
    # The output with the most measured samples counts.
    measured = max(int(np.isfinite(y).sum()) for y in flight.outputs.values())
    if not flight.hold_out and measured < least:
        raise ValueError(
            f"{where}: expected at least {least} samples for {count} free parameters, got "
            f"{measured}"
        )


def _check_model(problem: Problem) -> None:
    params, model = problem.start_params(), problem.model
    if model.sampled is not None:
        _check_controller(problem)
    for flight in problem.flights:
        # A flight's known parameters may complete the vehicle.
        own = naming.replace(params, **flight.known)
        require_constants(model, own)
        # The first rates depend on the flight's first inputs.
        if not model.linear and not of_helicopter(model.Params):
            first = {n: float(u[0]) for n, u in flight.inputs.items()}
            if wrong := cannot_start(model, own, first):
                raise ValueError(wrong)
    require_linear(model, params)


def _check_controller(problem: Problem) -> None:
    """Raise if a fit of a closed loop has another method than output error, or another rate."""
    if problem.noise_model != "white":
        raise ValueError(
            f"method: expected output-error for a model with a controller, got {problem.method}"
        )
    for flight in problem.flights:
        require_sample_time(problem.model, flight.dt, f"flight {flight.name}")


def _check_free(name: str, free: Free, model: Model) -> None:
    """Reject a free parameter that the model lacks, or whose numbers contradict each other.

    Args:
        free: its start, bounds, prior and sign; the sign is filled in.

    Raises:
        ValueError: naming the key, the expectation and the value.
    """
    known, start = naming.names(model.Params), free.start
    if name not in known:
        raise ValueError(
            f"free.{name}: model {model.name} has no such parameter{nearest(name, known)}"
        )
    if math.isnan(start):
        raise ValueError(
            f"free.{name}.start: missing, expected a start value (or, for a linear model, start: "
            "equation-error)"
        )
    for key, value in _numbers(free).items():
        if not math.isfinite(value):
            raise ValueError(f"free.{name}.{key}: expected a finite number, got {value}")
    low = -math.inf if free.lower is None else free.lower
    high = math.inf if free.upper is None else free.upper
    bounded, positive = high - low < math.inf, name in model.positive
    keeps, since = free.sign == "keep", "since the model says that it is positive"
    wrongs = (
        (
            free.prior is not None and free.prior.sd <= 0,
            f".prior.sd must be above zero, got {free.prior and free.prior.sd}",
        ),
        (free.sign not in ("keep", "any"), f".sign: expected 'keep' or 'any', got {free.sign!r}"),
        (positive and start <= 0, f".start: expected more than zero, {since}, got {start:g}"),
        (
            positive and -math.inf < low < 0,
            f".lower: expected zero or more, {since}, got {low:g}",
        ),
        (positive and not keeps, f".sign: expected keep, {since}, got any"),
        (
            keeps and bounded and low < 0 < high,
            f".sign: keep: expected bounds of one sign, got {low:g} to {high:g}",
        ),
        (low >= high, f": lower must be below upper, got {low:g} and {high:g}"),
        # If the bounds have different signs, a start at a bound has an infinite coordinate.
        (
            not low < start < high,
            f".start: expected a value inside {low:g} to {high:g}, got {start:g}",
        ),
        # Zero has no logarithm.
        (
            start == 0 and keeps and not bounded,
            ".start: expected a start of the right sign and size, or lower and upper, or sign: "
            "any; got 0 without two bounds",
        ),
    )
    for wrong, words in wrongs:
        if wrong:
            raise ValueError(f"free.{name}{words}")


def _numbers(free: Free) -> dict[str, Any]:
    """Return the stated numbers by key."""
    prior = free.prior
    numbers = {"start": free.start, "lower": free.lower, "upper": free.upper}
    if prior is not None:
        numbers |= {"prior.mean": prior.mean, "prior.sd": prior.sd}
    return {key: value for key, value in numbers.items() if value is not None}


_HEADINGS = {"psi", "yaw"}
"""Angles that may exceed a turn."""
_FURTHEST = 6 * math.pi
"""Largest plausible angle [rad]; without a pilot, linear models of one axis roll over in long
records."""
_HALF_TURN = 1.1 * math.pi
"""Largest angle without unwrapping [rad]; only unwrapped rolls or loops exceed it."""
_FASTEST, _OVER = 15.0, 0.1
"""Rate [rad/s] (860 deg/s) that no helicopter sustains, and its duration [s]."""


def _check_arguments(params: type, vehicle: Any, flights: Any, free: Any) -> None:
    """Reject arguments of a wrong type.

    Raises:
        TypeError: naming the argument, the expected type and the actual one.
    """
    check_params(params, vehicle)
    several = isinstance(flights, Sequence) and not isinstance(flights, str)
    odd = [f for f in (flights if several else [flights]) if not isinstance(f, Flight)]
    if odd or not several:
        raise TypeError(
            f"flights: expected a list of Flights, got {type((odd or [flights])[0]).__name__}; "
            "heli_jax.read_flight(path, ...) reads a log"
        )
    by_name = free if isinstance(free, Mapping) else {}
    odd = [f for f in by_name.values() if not isinstance(f, Free)]
    if odd or not isinstance(free, Mapping):
        raise TypeError(
            "free: expected Free by the parameter's name, as {'Ixx': Free(0.02)}, got "
            f"{type((odd or [free])[0]).__name__}"
        )
    for name, each in by_name.items():
        if not isinstance(each.prior, Prior | None):
            kind = type(each.prior).__name__
            raise TypeError(f"free.{name}.prior: expected Prior(mean, sd), got {kind}")
        for key, value in _numbers(each).items():
            # Numbers of Python, NumPy or JAX are accepted, booleans are not.
            kind = getattr(value, "dtype", np.dtype(type(value))).kind
            if getattr(value, "shape", ()) != () or kind not in "iuf":
                raise TypeError(f"free.{name}.{key}: expected a number, got {value!r:.60}")


def _warn_of_degrees(outputs: type, flights: Sequence[Flight]) -> None:
    """Warn of angles that turn further or faster than a helicopter can, as degrees would.

    Args:
        outputs: the model's class, which has the units.
        flights: flights made in Python; logs state their units, which are checked.
    """
    angles = {n for n in naming.names(outputs) if naming.unit(outputs, n) == "rad"} - _HEADINGS
    signals = [(f, n) for f in flights if f.source is None for n in f.outputs if n in angles]
    for flight, name in signals:
        y, steps = np.asarray(flight.outputs[name], float), max(1, round(_OVER / flight.dt))
        turned = np.abs(y[steps:] - y[:-steps])
        turned = turned[np.isfinite(turned)]
        # The quantile ignores single outliers.
        fastest = float(np.quantile(turned, 0.98)) / (steps * flight.dt) if turned.size else 0.0
        largest = float(np.nanmax(np.abs(y), initial=0.0))
        if largest > _FURTHEST or (largest > _HALF_TURN and fastest > _FASTEST):
            warnings.warn(
                f"{flight.name or 'a flight'}: {name} reaches {largest:.3g} rad and {fastest:.2g} "
                "rad/s, implausible for a helicopter; angles here are in radians: "
                "np.radians(degrees)",
                UserWarning,
                stacklevel=4,
            )
