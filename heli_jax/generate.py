"""Runs that a configuration describes and the project makes itself."""

import warnings
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from heli_jax import naming, units
from heli_jax.analysis.pilot import Pilot, attitude_hold
from heli_jax.analysis.trim import STICKS, Condition, Trim, is_full_nonlinear, trim
from heli_jax.config import (
    Experiment,
    SimulateConfig,
    StickConfig,
    disturbed,
    in_wind,
    read_flights,
    signals,
)
from heli_jax.dynamics.model import Model, needed_but_missing, zeros
from heli_jax.dynamics.start import cannot_start
from heli_jax.errors import InputError, nearest
from heli_jax.flights.flight import Flight
from heli_jax.flights.holds import decide
from heli_jax.simulation import events
from heli_jax.simulation import inputs as sticks
from heli_jax.simulation.simulate import simulate, substeps_for
from heli_jax.simulation.trajectory import Trajectory
from heli_jax.sweeps.spec import Trimmed

_MIDDLE = 1e-14


class Simulated(NamedTuple):
    """Columns of simulated runs under the names and in the units of a log."""

    columns: dict[str, np.ndarray]
    model: Model
    """what was simulated, with wind where there is some, and without the disturbance"""
    runs: dict[str, Trajectory]
    """the runs by name, without noise, in SI, as NumPy arrays"""
    notes: tuple[str, ...]
    """what is to be said of them, a sentence each"""

    @property
    def whole(self) -> bool:
        """Whether it was a whole helicopter that flew."""
        return is_full_nonlinear(self.model)


def generate(experiment: Experiment) -> Simulated:
    """The run of the configuration's `simulate`, with noise and disturbance.

    Its columns have the names and units of the first flight's `signals`, so that the same
    configuration reads it back; without flights, the model's names in SI. A whole helicopter
    begins in a trimmed flight, and its sticks are those of the trim and what is added to them.

    Raises:
        InputError: an input or output that the model lacks, a unit of the wrong kind, a vehicle
            that lacks something, or no trim of that flight.
    """
    wanted = experiment.config.simulate
    assert wanted is not None
    where = f"{experiment.path}: simulate"
    rng = np.random.default_rng(wanted.seed)
    n = round(wanted.duration * wanted.rate)
    drawn = experiment.config.disturbance
    if drawn is not None and (drawn.sigma_w is None or drawn.tau_w is None):
        raise InputError(f"{experiment.path}: disturbance: simulate needs its sigma_w and tau_w")
    _check_outputs(experiment, wanted, where)
    driven = _inputs(experiment, wanted, n, rng, where)
    _check_whole(experiment, wanted, where)
    plain = in_wind(experiment) if wanted.wind is not None else experiment
    run = _run(plain, wanted, n, driven, where)
    if not bool(run.finite):
        raise InputError(f"{where}: {_diverged(experiment, run)}")
    notes = _notes(experiment, run)
    if np.isfinite(run.ended):
        run = run.first(int(np.searchsorted(run.times, run.ended, side="right")))
    outputs = {k: np.asarray(v) for k, v in naming.asdict(run.outputs).items()}
    for name, noise in wanted.noise.items():
        si = naming.unit(experiment.model.Outputs, name) or "1"
        scale = _factor(noise.unit or si, si, f"{where}.noise.{name}.unit")
        draws = noise.sd * scale * rng.standard_normal(n)
        outputs[name] = outputs[name] + draws[: outputs[name].size]
    acted = {k: np.asarray(getattr(run.inputs, k)) for k in driven}
    columns = _as_logged(experiment, np.asarray(run.times), acted, outputs)
    notes = (*notes, *_held_notes(experiment, acted))
    return Simulated(columns, plain.model, {experiment.path.stem: run}, notes)


class Made(NamedTuple):
    """What drives a sweep whose inputs `simulate` makes."""

    experiment: Experiment
    """with wind in its model where there is some"""
    flight: Flight
    trimmed: Trimmed | None
    """each whole helicopter begins in a trim of its own, with its sticks"""
    pilot: Pilot | None
    """who holds the attitude, as for the vehicle of the file"""


def drive(experiment: Experiment) -> Made:
    """The inputs of the configuration's `simulate` for a sweep.

    Raises:
        InputError: as `generate`, or a ground, which a sweep has not.
    """
    wanted = experiment.config.simulate
    assert wanted is not None
    where = f"{experiment.path}: simulate"
    _check_whole(experiment, wanted, where)
    if wanted.ground is not None:
        raise InputError(f"{where}.ground: a sweep has none, expected a configuration without it")
    n, rng = round(wanted.duration * wanted.rate), np.random.default_rng(wanted.seed)
    plain = in_wind(experiment) if wanted.wind is not None else experiment
    inputs = _inputs(plain, wanted, n, rng, where)
    flight = Flight(dt=1.0 / wanted.rate, inputs=inputs, outputs={}, name="simulate")
    if not is_full_nonlinear(plain.model):
        return Made(plain, flight, None, None)
    begin = Condition(**wanted.start.model_dump()) if wanted.start else Condition()
    trimmed = Trimmed(begin, wanted.wind or (0.0, 0.0, 0.0), of=plain.model)
    pilot = None
    if wanted.hold_attitude:
        pilot = _pilot(plain, _begin(plain, wanted, where), where)
    return Made(plain, flight, trimmed, pilot)


def _check_outputs(experiment: Experiment, wanted: SimulateConfig, where: str) -> None:
    known = naming.names(experiment.model.Outputs)
    for name in wanted.noise:
        if name not in known:
            raise InputError(
                f"{where}.noise: model {experiment.model.name} has no output {name!r}"
                f"{nearest(name, known)}"
            )


def _run(
    experiment: Experiment,
    wanted: SimulateConfig,
    n: int,
    driven: dict[str, np.ndarray],
    where: str,
) -> Trajectory:
    """The run as NumPy arrays, without measurement noise."""
    missing = needed_but_missing(experiment.model, experiment.vehicle.params)
    if missing:
        raise InputError(
            f"{experiment.path}: vehicle: {', '.join(missing)} missing, model "
            f"{experiment.model.name} needs {'it' if len(missing) == 1 else 'them'}"
        )
    model, params = disturbed(experiment)
    start, pilot, ends = None, None, {}
    if is_full_nonlinear(experiment.model):
        begin = _begin(experiment, wanted, where)
        given = {n: jnp.asarray(v) for n, v in experiment.config.initial_state.items()}
        start = _extended(model, naming.replace(begin.state, **given))
        trimmed = {k: float(v) for k, v in naming.asdict(begin.inputs).items()}
        # What trim leaves of a stick in the middle, 1e-79, is for no reader of a log.
        trimmed = {k: v if abs(v) > _MIDDLE else 0.0 for k, v in trimmed.items()}
        driven = {k: v + driven.get(k, np.zeros(n)) for k, v in trimmed.items()}
        if wanted.hold_attitude:
            pilot = _pilot(experiment, begin, where)
        if wanted.ground is not None:
            ends = {"ground": events.ground(wanted.ground)}

    def one(p: Any, u: Any, x: Any, pilot: Pilot | None) -> Trajectory:
        return simulate(
            model,
            p,
            u,
            dt=1.0 / wanted.rate,
            initial_state=x,
            substeps=substeps_for(1.0 / wanted.rate),
            key=jax.random.key(wanted.seed) if experiment.config.disturbance else None,
            feedback=pilot,
            events=ends or None,
        )

    inputs = model.Inputs(**{k: jnp.asarray(v) for k, v in driven.items()})
    run = jax.device_get(jax.jit(one)(params, inputs, start, pilot))
    return run._replace(times=np.arange(n) / wanted.rate)


def _check_whole(experiment: Experiment, wanted: SimulateConfig, where: str) -> None:
    if is_full_nonlinear(experiment.model):
        return
    given = {
        "start": wanted.start is not None,
        "wind": wanted.wind is not None,
        "hold_attitude": wanted.hold_attitude,
        "ground": wanted.ground is not None,
    }
    for name in (n for n, there in given.items() if there):
        raise InputError(
            f"{where}.{name}: model {experiment.model.name} is not the full nonlinear model, "
            "expected model: helicopter or helicopter-paper"
        )


def _begin(experiment: Experiment, wanted: SimulateConfig, where: str) -> Trim:
    """The trimmed flight that a run begins in."""
    condition = Condition(**wanted.start.model_dump()) if wanted.start else Condition()
    wind = wanted.wind or (0.0, 0.0, 0.0)
    try:
        return trim(experiment.model, experiment.vehicle.params, condition, wind=wind)
    except ValueError as e:
        raise InputError(f"{where}.start: {e}") from e


def _pilot(experiment: Experiment, begin: Trim, where: str) -> Pilot:
    try:
        return attitude_hold(experiment.model, experiment.vehicle.params, begin)
    except ValueError as e:
        raise InputError(f"{where}.hold_attitude: {e}") from e


def _extended(model: Model, state: Any) -> Any:
    """A state of the model without disturbance as one of the model with it, at zero there."""
    given = {k: jnp.asarray(v) for k, v in naming.asdict(state).items()}
    return naming.replace(zeros(model.State), **given)


def _diverged(experiment: Experiment, run: Trajectory) -> str:
    if not is_full_nonlinear(experiment.model):
        first = {k: float(np.asarray(v)[0]) for k, v in naming.asdict(run.inputs).items()}
        wrong = cannot_start(experiment.model, experiment.vehicle.params, first)
        return wrong or "the run is not finite: the model is unstable with this vehicle"
    return (
        f"the run is not finite from {_lost(run):g} s on, expected a shorter duration, gentler "
        "inputs or hold_attitude: true"
    )


def _lost(run: Trajectory) -> float:
    """When a run ceases to be finite [s]."""
    good = np.all([np.isfinite(v) for v in jax.tree.leaves(run.states)], axis=0)
    return float(run.times[np.argmin(good)])


def _notes(experiment: Experiment, run: Trajectory) -> tuple[str, ...]:
    """What is to be said of a run: its end, and where it left the range of model and sticks."""
    found = []
    if np.isfinite(run.ended):
        wanted = experiment.config.simulate
        assert wanted is not None
        found.append(
            f"the machine comes down to {wanted.ground:g} m at {float(run.ended):.4g} s: nothing "
            "is written after that"
        )
    flown = run.times <= float(run.ended)
    for name, out in run.outside.items():
        left = np.asarray(out) & flown
        if left.any():
            share = left.sum() / flown.sum()
            found.append(
                f"the run leaves the model's range at {run.times[np.argmax(left)]:g} s: {name} "
                f"({100 * share:.2g} % of the samples)"
            )
    for name, (low, high) in STICKS.items():
        if not is_full_nonlinear(experiment.model):
            break
        stick = np.asarray(getattr(run.inputs, name))[flown]
        beyond = (stick < low) | (stick > high)
        if beyond.any():
            first = run.times[np.argmax(beyond)]
            found.append(f"{name} is beyond its ends of {low:g} and {high:g}, first at {first:g} s")
    return tuple(found)


def _held_notes(experiment: Experiment, acted: dict[str, np.ndarray]) -> list[str]:
    """Sticks are held here whatever they do; what to say where a reader of the log would not know.

    A chirp and a pilot's feedback move at every sample, as sampled sticks do.
    """
    if not experiment.config.flights:
        return []
    signals = experiment.config.flights[0].signals.inputs
    auto = [n for n, one in signals.items() if one.hold == "auto" and n in acted]
    moving = [n for n in auto if decide(acted[n]).hold == "linear"]
    if not moving:
        return []
    return [
        f"{', '.join(moving)}: held between samples here, but moving at nearly every one; to fit "
        "this log say hold: zero-order in flights[].signals.inputs (docs/inputs.md)"
    ]


def follow(experiment: Experiment) -> Simulated:
    """The model driven by the inputs of the configuration's flights, in SI.

    Raises:
        InputError: no flights, or one that cannot be read.
    """
    model = experiment.model
    parts: list[dict[str, Any]] = []
    runs: dict[str, Trajectory] = {}
    notes: list[str] = []
    gain = experiment.config.fit is not None and experiment.config.fit.nuisance.input_gain
    for flight in read_flights(experiment, gain=gain, moving_inputs=False):
        known = {n: jnp.asarray(v) for n, v in flight.known.items()}
        run = simulate(model, naming.replace(experiment.vehicle.params, **known), flight)
        outputs = {n: np.asarray(v) for n, v in naming.asdict(run.outputs).items()}
        label = np.array([flight.name] * flight.n_samples)
        parts.append({"flight": label, "time": flight.times, **flight.inputs, **outputs})
        run = jax.device_get(run)._replace(times=flight.times)
        runs[f"{len(runs) + 1}: {flight.name}"] = run
        notes += [f"{flight.name}: {note}" for note in _notes(experiment, run)]
        if not run.finite:
            first = {n: float(u[0]) for n, u in flight.inputs.items()}
            params = naming.replace(experiment.vehicle.params, **known)
            wrong = "" if is_full_nonlinear(model) else cannot_start(model, params, first)
            notes.append(
                f"{flight.name}: {wrong or f'the run is not finite from {_lost(run):g} s on'}"
            )
    columns = {name: np.concatenate([p[name] for p in parts]) for name in parts[0]}
    return Simulated(columns, model, runs, tuple(notes))


def _inputs(
    experiment: Experiment, wanted: SimulateConfig, n: int, rng: np.random.Generator, where: str
) -> dict[str, np.ndarray]:
    """Every input of the model in SI; one that is not named stays at neutral."""
    record = experiment.model.Inputs
    for name in wanted.inputs:
        if name not in naming.names(record):
            raise InputError(
                f"{where}.inputs: model {experiment.model.name} has no input {name!r}"
                f"{nearest(name, naming.names(record))}"
            )
    out = {}
    for name in naming.names(record):
        one = wanted.inputs.get(name)
        if one is None:
            out[name] = np.zeros(n)
            continue
        si = naming.unit(record, name) or "1"
        scale = _factor(one.unit or si, si, f"{where}.inputs.{name}.unit")
        out[name] = one.amplitude * scale * _stick(one, n, 1.0 / wanted.rate, rng)
    return out


def _stick(one: StickConfig, n: int, dt: float, rng: np.random.Generator) -> np.ndarray:
    if one.kind == "random-steps":
        return sticks.random_steps(n, dt, rng, one.hold)
    if one.kind == "3-2-1-1":
        return sticks.multistep_3211(n, dt, rng, one.step, one.pause)
    if one.kind == "sweep":
        # Now the word for a parameter sweep alone.
        warnings.warn("kind: sweep is deprecated, expected chirp", DeprecationWarning, stacklevel=2)
    if one.kind in ("chirp", "sweep"):
        return sticks.chirp(n, dt, *one.band)
    return np.zeros(n)


def _factor(unit: str, si: str, where: str) -> float:
    try:
        return units.factor(unit, si)
    except ValueError as e:
        raise InputError(f"{where}: {e}") from e


def _as_logged(
    experiment: Experiment,
    times: np.ndarray,
    driven: dict[str, np.ndarray],
    outputs: dict[str, np.ndarray],
) -> dict[str, np.ndarray]:
    if not experiment.config.flights:
        return {"time": times, **driven, **outputs}
    given, where = experiment.config.flights[0].signals, f"{experiment.path}: flights[0].signals"
    model = experiment.model
    columns = {given.time.signal: times / _factor(given.time.unit, "s", f"{where}.time.unit")}
    for signal, values in (
        (signals(model, "inputs", given.inputs, where), driven),
        (signals(model, "outputs", given.outputs, where), outputs),
    ):
        for name, one in signal.items():
            columns[one.name] = values[name] / units.factor(one.unit, one.si)
    return columns
