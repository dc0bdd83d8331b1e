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
    first_signals,
    in_wind,
    read_flights,
    signals,
)
from heli_jax.dynamics.check_model import cannot_start
from heli_jax.dynamics.model import Model, require_constants, require_linear, zeros
from heli_jax.errors import InputError, located, require_known
from heli_jax.finding import Finding, note
from heli_jax.flights.flight import Flight
from heli_jax.flights.holds import decide
from heli_jax.naming import Record
from heli_jax.simulation import events
from heli_jax.simulation import inputs as sticks
from heli_jax.simulation.simulate import simulate, substeps_for
from heli_jax.simulation.trajectory import Trajectory
from heli_jax.sweeps.spec import Trimmed

_MIDDLE = 1e-14
"""of a stick's travel: a trimmed stick nearer to its middle (trim leaves 1e-79) is written as 0"""


class Simulated(NamedTuple):
    """Columns of simulated runs under the names and in the units of a log."""

    columns: dict[str, np.ndarray]
    """inputs as they were commanded: they act later where the model has delays"""
    model: Model
    """what was simulated, with wind where there is some, and without the disturbance"""
    runs: dict[str, Trajectory]
    """the runs by name, without noise, in SI, as NumPy arrays"""
    notes: tuple[Finding, ...]
    """what is to be said of them"""

    @property
    def whole(self) -> bool:
        """True if the full nonlinear helicopter was simulated."""
        return is_full_nonlinear(self.model)


def _stick_inputs(
    experiment: Experiment, settings: SimulateConfig, n: int, rng: np.random.Generator, where: str
) -> dict[str, np.ndarray]:
    """Every input of the model in SI; one that is not named stays at neutral.

    Args:
        settings: the configuration's `simulate`.
    """
    record = experiment.model.Inputs
    words = f"model {experiment.model.name} has no input"
    require_known(settings.inputs, naming.names(record), f"{where}.inputs", words)
    out = {}
    # In the model's order, not the configuration's: the draws must not depend on how it is written.
    for name in naming.names(record):
        stick = settings.inputs.get(name)
        if stick is None:
            out[name] = np.zeros(n)
            continue
        si = naming.unit(record, name) or "1"
        scale = _factor_to_si(stick.unit or si, si, f"{where}.inputs.{name}.unit")
        out[name] = stick.amplitude * scale * _stick(stick, n, 1.0 / settings.rate, rng)
    return out


def _stick(config: StickConfig, n: int, dt: float, rng: np.random.Generator) -> np.ndarray:
    if config.kind == "random-steps":
        return sticks.random_steps(n, dt, rng, config.hold)
    if config.kind == "3-2-1-1":
        return sticks.multistep_3211(n, dt, rng, config.step, config.pause)
    if config.kind == "sweep":
        # Now the word for a parameter sweep alconfig.
        warnings.warn("kind: sweep is deprecated, expected chirp", DeprecationWarning, stacklevel=2)
    if config.kind in ("chirp", "sweep"):
        return sticks.chirp(n, dt, *config.band)
    return np.zeros(n)


def _factor_to_si(unit: str, si: str, where: str) -> float:
    """Return `units.factor`; an error names the place.

    Args:
        si: the SI unit of what it is for.
    """
    with located(where):
        return units.factor(unit, si)


def generate(experiment: Experiment) -> Simulated:
    """The run of the configuration's `simulate`, with noise and disturbance.

    Its columns have the names and units of the first flight's `signals`, so that the same
    configuration reads it back; without flights, the model's names in SI. Its inputs are those that
    were commanded: where the model has delays, they act later than the log shows them, as in a log
    of a vehicle. A whole helicopter begins in a trimmed flight, and its sticks are those of the
    trim and what is added to them, by the configuration and by the pilot who holds the attitude.

    Raises:
        InputError: an input or output that the model lacks, a unit of the wrong kind, a vehicle
            that lacks something, or no trim of that flight.
    """
    settings = experiment.config.simulate
    assert settings is not None
    where = f"{experiment.path}: simulate"
    # One generator for all: inputs are drawn before the noise, so that another noise leaves the
    # manoeuvre as it is.
    rng = np.random.default_rng(settings.seed)
    n = round(settings.duration * settings.rate)
    drawn = experiment.config.disturbance
    disturbed(experiment)  # names before numbers: of a state that is none no sigma_w is needed
    if drawn is not None and None in drawn.parameters.values():
        needed = " and ".join(drawn.parameters)
        raise InputError(f"{experiment.path}: disturbance: simulate needs its {needed}")
    # What can be refused is refused before the run, which takes longest.
    known, words = (
        naming.names(experiment.model.Outputs),
        f"model {experiment.model.name} has no output",
    )
    require_known(settings.noise, known, f"{where}.noise", words)
    driven = _stick_inputs(experiment, settings, n, rng, where)
    _check_full_nonlinear(experiment, settings, where)
    flown = in_wind(experiment) if settings.wind is not None else experiment
    run, commanded = _run(flown, settings, n, driven, where)
    if not bool(run.finite):
        raise InputError(f"{where}: {_diverged(experiment, run)}")
    # A log ends where the vehicle is on the ground; the frozen state after it is no flight.
    notes = _notes(experiment, run)
    if np.isfinite(run.ended):
        run = run.first(int(np.searchsorted(run.times, run.ended, side="right")))
    outputs = {k: np.asarray(v) for k, v in naming.asdict(run.outputs).items()}
    for name, noise in settings.noise.items():
        si = naming.unit(experiment.model.Outputs, name) or "1"
        scale = _factor_to_si(noise.unit or si, si, f"{where}.noise.{name}.unit")
        # Drawn for the whole record, so that a ground does not change the noise of what is left.
        draws = noise.sd * scale * rng.standard_normal(n)
        outputs[name] = outputs[name] + draws[: outputs[name].size]
    # As commanded, not as they acted: a delay in the log as well as in the model would be fitted as
    # none. Wind is an input of `flown`, and in no log.
    logged = {k: np.asarray(commanded[k])[: run.times.size] for k in driven}
    columns = _as_logged(experiment, np.asarray(run.times), logged, outputs)
    notes = (*notes, *_held_notes(experiment, logged))
    return Simulated(columns, flown.model, {experiment.path.stem: run}, notes)


class Made(NamedTuple):
    """Drive of a sweep whose inputs `simulate` makes."""

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
    settings = experiment.config.simulate
    assert settings is not None
    where = f"{experiment.path}: simulate"
    _check_full_nonlinear(experiment, settings, where)
    # A sweep reduces while it flies, and its results are of runs of one length.
    if settings.ground is not None:
        raise InputError(f"{where}.ground: a sweep has none, expected a configuration without it")
    n, rng = round(settings.duration * settings.rate), np.random.default_rng(settings.seed)
    flown = in_wind(experiment) if settings.wind is not None else experiment
    # The same draws as `generate` makes: element by element the sweep flies that manoeuvre.
    inputs = _stick_inputs(flown, settings, n, rng, where)
    flight = Flight(dt=1.0 / settings.rate, inputs=inputs, outputs={}, name="simulate")
    if not is_full_nonlinear(flown.model):
        return Made(flown, flight, None, None)
    # Each element trims itself, so only the condition goes along; the pilot's gains are those for
    # the vehicle of the file, as a pilot's would be.
    begin = Condition(**settings.start.model_dump()) if settings.start else Condition()
    trimmed = Trimmed(begin, settings.wind or (0.0, 0.0, 0.0), of=flown.model)
    pilot = None
    if settings.hold_attitude:
        pilot = _pilot(flown, _begin(flown, settings, where), where)
    return Made(flown, flight, trimmed, pilot)


def _run(
    experiment: Experiment,
    settings: SimulateConfig,
    n: int,
    driven: dict[str, np.ndarray],
    where: str,
) -> tuple[Trajectory, dict[str, Any]]:
    """The run as NumPy arrays, without measurement noise; and its inputs as they were commanded, in
    arrays of as many samples."""
    # Said by name: what is missing is NaN, and the run would only be called not finite.
    with experiment.located(""):
        require_constants(experiment.model, experiment.vehicle.params)
        require_linear(experiment.model, experiment.vehicle.params)
    model, params = disturbed(experiment)
    start, pilot, ends = None, None, {}
    if is_full_nonlinear(experiment.model):
        begin = _begin(experiment, settings, where)
        changed = {n: jnp.asarray(v) for n, v in experiment.config.initial_state.items()}
        start = _extended(model, naming.replace(begin.state, **changed))
        trimmed = {k: float(v) for k, v in naming.asdict(begin.inputs).items()}
        # The configuration's inputs are what a pilot adds: sticks at zero would let it fall.
        trimmed = {k: v if abs(v) > _MIDDLE else 0.0 for k, v in trimmed.items()}
        driven = {k: v + driven.get(k, np.zeros(n)) for k, v in trimmed.items()}
        if settings.hold_attitude:
            pilot = _pilot(experiment, begin, where)
        if settings.ground is not None:
            ends = {"ground": events.ground(settings.ground)}

    def fly(p: Record, u: Record, x: Record | None, pilot: Pilot | None) -> Trajectory:
        return simulate(
            model,
            p,
            u,
            dt=1.0 / settings.rate,
            initial_state=x,
            substeps=substeps_for(1.0 / settings.rate, model.fastest),
            key=jax.random.key(settings.seed) if model.noise_intensity else None,
            feedback=pilot,
            events=ends or None,
        )

    inputs = model.Inputs(**{k: jnp.asarray(v) for k, v in driven.items()})
    # jit around the whole: without it simulate would run its outputs and limits operation by
    # operation. The key and the rate are constants of that one program.
    run = jax.device_get(jax.jit(fly)(params, inputs, start, pilot))
    # In float64 whatever the run was in: k/rate to the last digit, as a log has it.
    run = run._replace(times=np.arange(n) / settings.rate)
    # What a pilot adds depends on the states, so it is known from the run alone; `simulate` takes
    # no feedback where an input is late.
    return run, driven if pilot is None else naming.asdict(run.inputs)


def _check_full_nonlinear(experiment: Experiment, settings: SimulateConfig, where: str) -> None:
    if is_full_nonlinear(experiment.model):
        late = [n for n, _ in experiment.model.delays]
        if settings.hold_attitude and late:
            raise InputError(
                f"{where}.hold_attitude: expected a model without delays of inputs, got one of "
                f"{', '.join(late)}"
            )
        return
    keys = {
        "start": settings.start is not None,
        "wind": settings.wind is not None,
        "hold_attitude": settings.hold_attitude,
        "ground": settings.ground is not None,
    }
    for name in (n for n, given in keys.items() if given):
        raise InputError(
            f"{where}.{name}: model {experiment.model.name} is not the full nonlinear model, "
            "expected model: helicopter, helicopter-consistent or helicopter-paper"
        )


def _begin(experiment: Experiment, settings: SimulateConfig, where: str) -> Trim:
    """The trimmed flight that a run begins in."""
    condition = Condition(**settings.start.model_dump()) if settings.start else Condition()
    wind = settings.wind or (0.0, 0.0, 0.0)
    with located(f"{where}.start"):
        return trim(experiment.model, experiment.vehicle.params, condition, wind=wind)


def _pilot(experiment: Experiment, begin: Trim, where: str) -> Pilot:
    with located(f"{where}.hold_attitude"):
        return attitude_hold(experiment.model, experiment.vehicle.params, begin)


def _extended(model: Model, state: Record) -> Record:
    """A state of the model without disturbance as one of the model with it, at zero there."""
    undisturbed = {k: jnp.asarray(v) for k, v in naming.asdict(state).items()}
    return naming.replace(zeros(model.State), **undisturbed)


def _diverged(experiment: Experiment, run: Trajectory) -> str:
    # Two causes look alike: a model that cannot begin where it begins, and one that runs away.
    if not is_full_nonlinear(experiment.model):
        first = {k: float(np.asarray(v)[0]) for k, v in naming.asdict(run.inputs).items()}
        reason = cannot_start(experiment.model, experiment.vehicle.params, first)
        return reason or "the run is not finite: the model is unstable with this vehicle"
    return (
        f"the run is not finite from {_diverged_at(run):g} s on, expected a shorter duration, "
        "gentler inputs or hold_attitude: true"
    )


def _diverged_at(run: Trajectory) -> float:
    """Return the time at which a run ceases to be finite [s]."""
    # argmin of booleans: the first sample at which any state is not finite.
    good = np.all([np.isfinite(v) for v in jax.tree.leaves(run.states)], axis=0)
    return float(run.times[np.argmin(good)])


def _notes(experiment: Experiment, run: Trajectory) -> tuple[Finding, ...]:
    """Return the notes on a run: how it ended, and where it left the range of model and sticks."""
    notes = []
    if np.isfinite(run.ended):
        settings = experiment.config.simulate
        assert settings is not None
        ended = float(run.ended)
        words = (
            f"the vehicle descends to {settings.ground:g} m at {ended:.4g} s: nothing "
            "is written after that"
        )
        notes.append(note("simulation.ends-on-ground", words, value=ended))
    # After an event the state stands still; what it does there says nothing of the flight.
    flown = np.asarray(run.times <= float(run.ended))
    for name, out in run.outside.items():
        left = np.asarray(out) & flown
        if left.any():
            share = left.sum() / flown.sum()
            words = (
                f"the run leaves the model's range at {run.times[np.argmax(left)]:g} s: {name} "
                f"({100 * share:.2g} % of the samples)"
            )
            notes.append(note("simulation.outside-model", words, name, value=float(share)))
    return (*notes, *_stick_notes(experiment, run, flown))


def _stick_notes(experiment: Experiment, run: Trajectory, flown: np.ndarray) -> list[Finding]:
    """Return the notes on sticks beyond their ends, in the samples that were flown."""
    # Other models' inputs are lengths or anyone's own, without known ends.
    if not is_full_nonlinear(experiment.model):
        return []
    notes = []
    for name, (low, high) in STICKS.items():
        if not hasattr(run.inputs, name):
            continue
        stick = np.asarray(getattr(run.inputs, name))[flown]
        beyond = (stick < low - _MIDDLE) | (stick > high + _MIDDLE)
        if beyond.any():
            first = run.times[np.argmax(beyond)]
            words = f"{name} is beyond its ends of {low:g} and {high:g}, first at {first:g} s"
            notes.append(note("simulation.stick-beyond-ends", words, name, value=float(first)))
    return notes


def _held_notes(experiment: Experiment, logged: dict[str, np.ndarray]) -> list[Finding]:
    """Sticks are held here whatever they do; what to say where a reader of the log would not know.

    A chirp and a pilot's feedback move at every sample, as sampled sticks do.
    """
    if not experiment.config.flights:
        return []
    signals = first_signals(experiment).inputs
    auto = [n for n, signal in signals.items() if signal.hold == "auto" and n in logged]
    moving = [n for n in auto if decide(logged[n]).hold != "zero-order"]
    if not moving:
        return []
    words = (
        f"{', '.join(moving)}: held between samples here, but moving at nearly every one; to fit "
        "this log say hold: zero-order in flights[].signals.inputs (docs/inputs.md)"
    )
    return [note("hold.moving-held", words, *moving)]


def follow(experiment: Experiment) -> Simulated:
    """The model driven by the inputs of the configuration's flights, in SI.

    Raises:
        InputError: no flights, or one that cannot be read.
    """
    model = experiment.model
    parts: list[dict[str, Any]] = []
    runs: dict[str, Trajectory] = {}
    notes: list[Finding] = []
    gain = experiment.config.fit is not None and experiment.config.fit.nuisance.input_gain
    for flight in read_flights(experiment, gain=gain):
        known = {n: jnp.asarray(v) for n, v in flight.known.items()}
        run = simulate(model, naming.replace(experiment.vehicle.params, **known), flight)
        outputs = {n: np.asarray(v) for n, v in naming.asdict(run.outputs).items()}
        label = np.array([flight.name] * flight.n_samples)
        parts.append({"flight": label, "time": flight.times, **flight.inputs, **outputs})
        run = jax.device_get(run)._replace(times=flight.times)
        # Numbered, since two flights may have the same name.
        runs[f"{len(runs) + 1}: {flight.name}"] = run
        notes += [n.of(flight.name) for n in _notes(experiment, run)]
        if not run.finite:
            first = {n: float(u[0]) for n, u in flight.inputs.items()}
            params = naming.replace(experiment.vehicle.params, **known)
            reason = "" if is_full_nonlinear(model) else cannot_start(model, params, first)
            reason = reason or f"the run is not finite from {_diverged_at(run):g} s on"
            notes.append(Finding("simulation.diverged", "doubt", f"{flight.name}: {reason}"))
    columns = {name: np.concatenate([p[name] for p in parts]) for name in parts[0]}
    return Simulated(columns, model, runs, tuple(notes))


def _as_logged(
    experiment: Experiment,
    times: np.ndarray,
    driven: dict[str, np.ndarray],
    outputs: dict[str, np.ndarray],
) -> dict[str, np.ndarray]:
    if not experiment.config.flights:
        # Without flights nobody has named a column or a unit.
        return {"time": times, **driven, **outputs}
    logged, where = experiment.config.flights[0].signals, f"{experiment.path}: flights[0].signals"
    model, named = experiment.model, first_signals(experiment)
    # An autopilot's log needs no name for the time; the table that is written here has one.
    time = logged.time
    name, unit = ("time", "s") if time is None else (time.signal or "time", time.unit)
    seconds = _factor_to_si(unit, "s", f"{where}.time.unit")
    # A column that counts samples; where rows are the clock, times do no harm beside them.
    if time is not None and time.rate is not None and time.signal is not None:
        seconds = 1.0 / time.rate
    columns = {name: times / seconds}
    for by_name, values in (
        (signals(model, "inputs", named.inputs, where), driven),
        (signals(model, "outputs", named.outputs, where), outputs),
    ):
        for name, signal in by_name.items():
            if signal.constant is None:  # a constant is in no log
                columns[signal.name] = signal.from_si(values[name])
    return columns
