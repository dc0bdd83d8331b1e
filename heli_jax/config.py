"""Experiment configurations: YAML, validated here, and the problems that they describe."""

import importlib.util
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple

import jax.numpy as jnp
import pydantic
from pydantic import BaseModel, ConfigDict, Field, StrictBool, model_validator

from heli_jax import models, naming, units
from heli_jax.dynamics.disturbance import disturbable, with_disturbance
from heli_jax.dynamics.model import Model
from heli_jax.errors import InputError, nearest
from heli_jax.flights import Flight, Signal, read_flight
from heli_jax.identification.problem import Free, Method, Nuisance, Prior, Problem
from heli_jax.vehicle import Vehicle, read_vehicle, vehicle_from_mapping
from heli_jax.yaml_file import parse_value, read_mapping

if TYPE_CHECKING:
    from heli_jax.identification.choice import Alternatives

Finite = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class TimeConfig(_Strict):
    signal: str
    unit: str = "s"


class InputConfig(_Strict):
    signal: str
    unit: str | None = None


class OutputConfig(_Strict):
    signal: str
    unit: str | None = None
    sd: Positive | None = None


class SignalsConfig(_Strict):
    time: TimeConfig
    inputs: dict[str, InputConfig]
    outputs: dict[str, OutputConfig]


class FlightConfig(_Strict):
    log: str
    signals: SignalsConfig
    name: str | None = None
    rate: Positive | None = None
    window: tuple[Finite, Finite] | None = None
    hold_out: bool = False
    known: dict[str, Finite] = {}


class PriorConfig(_Strict):
    mean: Finite
    sd: Positive


class FreeConfig(_Strict):
    start: Finite
    lower: Finite | None = None
    upper: Finite | None = None
    prior: PriorConfig | None = None


class NuisanceConfig(_Strict):
    initial_state: bool = True
    bias: bool = True
    time_shift: bool = False
    input_gain: bool = False


class IntervalsConfig(_Strict):
    """Intervals beside the Gaussian one."""

    profile: list[str] = []
    """free parameters whose profile likelihood is wanted"""
    bootstrap: Annotated[int, Field(ge=0, le=100_000)] = 0
    """made records to refit; 0 for none"""
    nuts: Annotated[int, Field(ge=0, le=1_000_000)] = 0
    """draws of each of four chains (extra `bayes`); 0 for none"""


class ShootingConfig(_Strict):
    """Multiple shooting: windows with initial states of their own."""

    window: Positive
    """length [s]"""
    continuity: Positive | None = None
    """sd of the jump of each state between windows, as a part of what it does; null: free"""


class FitConfig(_Strict):
    method: Method = "output-error"
    free: dict[str, FreeConfig]
    nuisance: NuisanceConfig = NuisanceConfig()
    shooting: ShootingConfig | None = None
    starts: Annotated[int, Field(ge=1, le=10_000)] = 1
    seed: Annotated[int, Field(ge=0)] = 0
    max_steps: Annotated[int, Field(ge=1)] = 200
    compare: bool = False
    """whether to fit the alternatives too: no disturbance, one pole, two poles; without stand"""
    intervals: IntervalsConfig = IntervalsConfig()


class RLSConfig(_Strict):
    order: Annotated[int, Field(ge=1, le=20)] = 4
    forgetting: Annotated[float, Field(gt=0, le=1)] = 1.0


class DisturbanceConfig(_Strict):
    """A random acceleration on one axis: simulation draws it, filter error estimates it."""

    axis: Literal["roll", "pitch", "yaw"]
    poles: Literal[1, 2] = 1
    sigma_w: Positive | None = None
    """standard deviation [rad/s^2]: needed to simulate, a start for filter error"""
    tau_w: Positive | None = None
    """correlation time [s]: needed to simulate, a start for filter error"""
    fixed: list[Literal["sigma_w", "tau_w", "sigma_y"]] = []
    """what filter error takes as it stands here; sigma_y: the noise that the outputs state (sd)"""

    @model_validator(mode="after")
    def _fixed_given(self) -> "DisturbanceConfig":
        for name in ("sigma_w", "tau_w"):
            if name in self.fixed and getattr(self, name) is None:
                raise ValueError(f"{name} is fixed but not given, wanted is its value")
        return self


class StickConfig(_Strict):
    """How one input moves in a simulation."""

    kind: Literal["random-steps", "3-2-1-1", "sweep", "neutral"] = "random-steps"
    amplitude: Positive
    unit: str | None = None
    hold: tuple[Positive, Positive] = (0.3, 2.0)
    """shortest and longest step of random-steps [s]"""
    step: Positive = 0.3
    """unit length of 3-2-1-1 [s]"""
    pause: Positive = 2.0
    """neutral between two 3-2-1-1 [s]"""
    band: tuple[Positive, Positive] = (0.05, 5.0)
    """first and last frequency of a sweep [Hz]"""


class NoiseConfig(_Strict):
    sd: Positive
    unit: str | None = None


class StartConfig(_Strict):
    """The steady flight in which a run of the whole helicopter begins."""

    ahead: Finite = 0.0
    """speed over the ground along the heading [m/s]"""
    aside: Finite = 0.0
    """to the right of it [m/s]"""
    climb: Finite = 0.0
    """[m/s]"""
    heading: Finite = 0.0
    """psi [rad]"""


class SimulateConfig(_Strict):
    """A run that the project makes itself.

    The whole helicopter begins in a trimmed flight, and `inputs` are added to the trim's sticks;
    start, wind, hold_attitude and ground are for it alone.
    """

    duration: Positive
    rate: Positive
    inputs: dict[str, StickConfig] = {}
    noise: dict[str, NoiseConfig] = {}
    seed: Annotated[int, Field(ge=0)] = 0
    start: StartConfig | None = None
    """hover unless given"""
    wind: tuple[Finite, Finite, Finite] | None = None
    """velocity of the air along x, y and z (up) [m/s]"""
    hold_attitude: bool = False
    """whether a pilot's gentle feedback is added to the sticks, so that a long manoeuvre does not
    diverge (`heli_jax.analysis.pilot`)"""
    ground: Annotated[float, Field(lt=0, allow_inf_nan=False)] | None = None
    """height at which the run ends [m]; it begins at a height of zero"""

    @model_validator(mode="after")
    def _bounded(self) -> "SimulateConfig":
        if not 8 <= self.duration * self.rate <= 1e8:
            raise ValueError(
                f"duration times rate is {self.duration * self.rate:g} samples, wanted are 8 to 1e8"
            )
        return self


class Config(_Strict):
    """One experiment."""

    model: str
    vehicle: str | dict[str, Any]
    corrections: dict[str, StrictBool] | None = None
    """what of the paper is corrected, by name (`heli_jax.dynamics.helicopter.Corrections`): on or
    off in place of what the model has; for the whole helicopter only"""
    flights: list[FlightConfig] = []
    fit: FitConfig | None = None
    rls: RLSConfig | None = RLSConfig()
    disturbance: DisturbanceConfig | None = None
    simulate: SimulateConfig | None = None


class Experiment(NamedTuple):
    """A validated configuration with what it names at hand."""

    config: Config
    path: Path
    """the file it came from; its folder is where relative paths begin"""
    model: Model
    vehicle: Vehicle


def load(path: str | Path, overrides: Sequence[str] = ()) -> Experiment:
    """Read and validate a configuration, its model and its vehicle; no log is opened yet.

    `overrides` are `key.path=value` texts.

    Raises:
        InputError: anything in the file or an override is wrong.
    """
    path = Path(path)
    content = read_mapping(path)
    for text in overrides:
        _override(content, text)
    config = _validated(content, str(path))
    model = _model(config, path)
    vehicle = _vehicle(config, path, model)
    return Experiment(config, path, model, vehicle)


def _model(config: Config, path: Path) -> Model:
    folder = path.absolute().parent
    model = models.by_name(config.model, f"{path}: model", folder)
    if config.corrections is None:
        return model
    where = f"{path}: corrections"
    return models.by_name(config.model, where, folder, corrections=config.corrections)


def in_wind(experiment: Experiment) -> Experiment:
    """The experiment with a model that has the wind as inputs.

    Raises:
        InputError: the model takes no wind.
    """
    config, path = experiment.config, experiment.path
    model = models.by_name(
        config.model,
        f"{path}: simulate.wind",
        path.absolute().parent,
        corrections=config.corrections,
        wind=True,
    )
    return experiment._replace(model=model)


def _override(content: dict[str, Any], text: str) -> None:
    key, equals, value = text.partition("=")
    where = f"--set {text!r:.80}"
    if not equals or not key.strip():
        raise InputError(f"{where}: wanted is key.path=value")
    *above, last = key.strip().split(".")
    at: Any = content
    for name in above:
        at = _child(at, name, where)
    if isinstance(at, list):
        at[_index(at, last, where)] = parse_value(value, where)
    elif isinstance(at, dict):
        at[last] = parse_value(value, where)
    else:
        raise InputError(f"{where}: {'.'.join(above)} holds no keys to set")


def _child(at: Any, name: str, where: str) -> Any:
    if isinstance(at, list):
        return at[_index(at, name, where)]
    if isinstance(at, dict):
        return at.setdefault(name, {})
    raise InputError(f"{where}: there is nothing below the key before {name!r}")


def _index(at: list[Any], name: str, where: str) -> int:
    if not name.isdigit() or int(name) >= len(at):
        raise InputError(f"{where}: found {name!r}, wanted is a number from 0 to {len(at) - 1}")
    return int(name)


def _validated(content: dict[str, Any], where: str) -> Config:
    try:
        return Config.model_validate(content)
    except pydantic.ValidationError as e:
        # An unknown key is the likeliest cause of the others, so it is told first.
        errors = sorted(e.errors(), key=lambda one: one["type"] != "extra_forbidden")
        raise InputError(f"{where}: {_sentence(errors[0])}") from None


def _sentence(error: Any) -> str:
    place = _place(error["loc"])
    found = error.get("input")
    if error["type"] == "extra_forbidden":
        known = _known_keys(error["loc"])
        return f"{place}: unknown key{nearest(str(error['loc'][-1]), known)}"
    if error["type"] == "missing":
        return f"{place}: missing"
    message = str(error["msg"]).removeprefix("Value error, ")
    message = message[0].lower() + message[1:]
    if isinstance(found, dict | list) or error["type"] == "value_error":
        return f"{place}: {message}"
    return f"{place}: found {found!r:.60}, {message.replace('input should be', 'wanted is')}"


def _place(loc: tuple[Any, ...]) -> str:
    text = ""
    for part in loc:
        if isinstance(part, int):
            text += f"[{part}]"
        elif part not in ("str", "dict[str,any]"):
            text += f".{part}" if text else str(part)
    return text or "the configuration"


def _known_keys(loc: tuple[Any, ...]) -> list[str]:
    """The keys of the section that an unknown key stands in."""
    section: Any = Config
    for part in loc[:-1]:
        if isinstance(part, int):
            continue
        fields = getattr(section, "model_fields", None)
        if fields is None or part not in fields:
            continue
        section = _section(fields[part].annotation) or section
    return list(section.model_fields)


def _section(annotation: Any) -> Any:
    """The configuration class within an annotation such as list[FlightConfig] | None."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    for inner in getattr(annotation, "__args__", ()):
        found = _section(inner)
        if found is not None:
            return found
    return None


def _vehicle(config: Config, path: Path, model: Model) -> Vehicle:
    if isinstance(config.vehicle, str):
        return read_vehicle(path.parent / config.vehicle, model.Params)
    return vehicle_from_mapping(config.vehicle, f"{path}: vehicle", model.Params)


def problem(experiment: Experiment) -> Problem:
    """The problem that a configuration's `fit` describes, its logs read.

    Raises:
        InputError: no fit or no flight, a log that cannot be read, or parts that do not fit.
    """
    config, path = experiment.config, experiment.path
    if config.fit is None:
        raise InputError(f"{path}: fit: missing, wanted is fit.free with a parameter to estimate")
    if not config.fit.free:
        raise InputError(f"{path}: fit.free: nothing is free, wanted is a parameter to estimate")
    _check_intervals(config.fit, path)
    nuisance = Nuisance(**config.fit.nuisance.model_dump())
    flights = read_flights(experiment, gain=nuisance.input_gain)
    free = {
        name: Free(f.start, f.lower, f.upper, Prior(f.prior.mean, f.prior.sd) if f.prior else None)
        for name, f in config.fit.free.items()
    }
    model, params, fixed = experiment.model, experiment.vehicle.params, ()
    if config.fit.method == "filter-error":
        if config.disturbance is None:
            raise InputError(
                f"{path}: fit.method: filter-error needs a disturbance, wanted is "
                "disturbance: {axis: roll, poles: 1}"
            )
        model, params = disturbed(experiment)
        fixed = tuple(config.disturbance.fixed)
    try:
        return Problem(
            model,
            params,
            flights,
            free,
            nuisance,
            gain_units=_gain_units(experiment) if nuisance.input_gain else {},
            method=config.fit.method,
            fixed_noise=fixed,
            window=None if config.fit.shooting is None else config.fit.shooting.window,
            continuity=None if config.fit.shooting is None else config.fit.shooting.continuity,
        )
    except ValueError as e:
        raise InputError(
            f"{path}: fit: {e}" if "vehicle" not in str(e)[:8] else f"{path}: {e}"
        ) from e


def _check_intervals(wanted: FitConfig, path: Path) -> None:
    """Refuse before the fit what could not be done after it."""
    for name in wanted.intervals.profile:
        if name not in wanted.free:
            raise InputError(
                f"{path}: fit.intervals.profile: {name!r} is not free{nearest(name, wanted.free)}"
            )
    if wanted.intervals.nuts and importlib.util.find_spec("blackjax") is None:
        raise InputError(
            f"{path}: fit.intervals.nuts: blackjax is not installed, wanted is the extra bayes: "
            "pip install 'heli_jax[bayes]'"
        )
    if wanted.intervals.bootstrap and wanted.nuisance.time_shift:
        raise InputError(
            f"{path}: fit.intervals.bootstrap: not available with nuisance.time_shift, wanted is "
            "one of the two"
        )


def rivals(experiment: Experiment, fitted: Problem) -> "Alternatives":
    """The models that a configuration's `compare` puts beside the fitted one.

    Raises:
        InputError: no axis of the model can be disturbed.
    """
    from heli_jax.identification.choice import alternatives  # not before it is needed: slow

    model, wanted = experiment.model, experiment.config.disturbance
    axes = disturbable(model)
    if not axes:
        raise InputError(
            f"{experiment.path}: fit.compare: model {model.name} has no axis to disturb, wanted is "
            "one with roll, pitch or yaw"
        )
    axis = wanted.axis if wanted is not None else axes[0]
    bare = {"roll-on-stand": "roll", "pitch-on-stand": "pitch"}.get(model.name)
    stand = models.by_name(bare) if bare and "kappa" in fitted.free else None
    return alternatives(fitted, model, axis, without_stand=stand)


def disturbed(experiment: Experiment) -> tuple[Model, Any]:
    """The model with the configuration's disturbance, and its parameters.

    Raises:
        InputError: the model has no such axis.
    """
    model, params, wanted = (
        experiment.model,
        experiment.vehicle.params,
        experiment.config.disturbance,
    )
    if wanted is None:
        return model, params
    try:
        model = with_disturbance(model, wanted.axis, wanted.poles)
    except ValueError as e:
        raise InputError(f"{experiment.path}: disturbance: {e}") from e
    given = {"sigma_w": wanted.sigma_w, "tau_w": wanted.tau_w}
    extra = {n: jnp.asarray(v) for n, v in given.items() if v is not None}
    return model, model.Params(**{**naming.asdict(params), **extra})


def read_flights(
    experiment: Experiment, *, gain: bool = False, moving_inputs: bool = True
) -> tuple[Flight, ...]:
    """The flights that a configuration names, in SI.

    `gain` allows a plain number for an input with a unit: an estimated gain then carries the unit.

    Raises:
        InputError: no flights, or one that cannot be read.
    """
    config, path = experiment.config, experiment.path
    if not config.flights:
        raise InputError(f"{path}: flights: none given, wanted is at least one log")
    return tuple(
        _read_flight(experiment, i, f, gain, moving_inputs) for i, f in enumerate(config.flights)
    )


def _read_flight(
    experiment: Experiment, i: int, f: FlightConfig, gain: bool, moving: bool
) -> Flight:
    model = experiment.model
    where = f"{experiment.path}: flights[{i}]"
    for name in f.known:
        if name not in naming.names(model.Params):
            raise InputError(
                f"{where}.known: model {model.name} has no parameter {name!r}"
                f"{nearest(name, naming.names(model.Params))}"
            )
    try:
        flight = read_flight(
            experiment.path.parent / f.log,
            time=Signal(f.signals.time.signal, f.signals.time.unit, "s"),
            inputs=signals(model, "inputs", f.signals.inputs, f"{where}.signals", gain),
            outputs=signals(model, "outputs", f.signals.outputs, f"{where}.signals"),
            rate=f.rate,
            window=f.window,
            known=f.known,
            hold_out=f.hold_out,
            name=f.name or f"flight {i + 1}",
            moving_inputs=moving,
        )
    except InputError:
        raise
    except ValueError as e:
        raise InputError(f"{where}: {e}") from e
    return flight


def signals(
    model: Model,
    role: Literal["inputs", "outputs"],
    given: Mapping[str, Any],
    where: str,
    gain: bool = False,
) -> dict[str, Signal]:
    """Which column is which of the model's inputs or outputs, with units checked.

    Raises:
        InputError: a name that the model lacks, an input that is missing, no output at all, a
            unit that is unknown or of the wrong kind.
    """
    record = model.Inputs if role == "inputs" else model.Outputs
    known = naming.names(record)
    for name in given:
        if name not in known:
            raise InputError(
                f"{where}.{role}: model {model.name} has no {role[:-1]} {name!r}"
                f"{nearest(name, known)}"
            )
    missing = [n for n in known if n not in given]
    if role == "inputs" and missing:
        raise InputError(f"{where}.inputs: {missing[0]} missing, model {model.name} needs it")
    if not given:
        raise InputError(f"{where}.{role}: none given, wanted is one of {', '.join(known)}")
    out = {}
    for name, one in given.items():
        place = f"{where}.{role}.{name}.unit"
        si = naming.unit(record, name)
        unit = one.unit if one.unit is not None else (si or "1")
        out[name] = Signal(one.signal, unit, _si(unit, si, place, gain), getattr(one, "sd", None))
    return out


def _si(unit: str, si: str | None, place: str, gain: bool) -> str:
    try:
        if si is None:
            return units.si_of(unit)
        if gain and units.is_plain(unit):
            return "1"
        units.factor(unit, si)
    except ValueError as e:
        hint = ""
        if si is not None and unit.strip() in ("", "1", "-", "%", "stick", "dimensionless"):
            hint = "; or set fit.nuisance.input_gain: true, and the estimated gain carries the unit"
        raise InputError(f"{place}: {e}{hint}") from e
    return si


def _gain_units(experiment: Experiment) -> dict[str, str]:
    """The unit that each input's gain carries: 1 where the log's unit is of the right kind."""
    out = {}
    for name, one in experiment.config.flights[0].signals.inputs.items():
        si = naming.unit(experiment.model.Inputs, name)
        plain = one.unit is not None and units.is_plain(one.unit)
        out[name] = si if si and plain and not units.is_plain(si) else "1"
    return out


def resolved(experiment: Experiment) -> dict[str, Any]:
    """The configuration written out so that it runs again from anywhere.

    Paths of logs become absolute; the vehicle stands in it with units and sources.
    """
    config, path = experiment.config, experiment.path
    content = config.model_dump(mode="json", exclude_none=True)
    for flight in content.get("flights", []):
        flight["log"] = str((path.parent / flight["log"]).resolve())
    content["vehicle"] = {
        name: {"value": c.value, "unit": c.unit, "source": c.source}
        for name, c in experiment.vehicle.constants.items()
    }
    return content
