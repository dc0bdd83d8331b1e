"""Simulated runs of a configuration."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from heli_jax import naming, units
from heli_jax.analysis.trim import STICKS, Condition, Trim, is_full_nonlinear, trim
from heli_jax.config import (
    Experiment,
    SimulateConfig,
    disturbed,
    first_signals,
    in_wind,
    read_flights,
    signals,
)
from heli_jax.control.pilot import Pilot, attitude_hold
from heli_jax.dynamics.check_model import cannot_start
from heli_jax.dynamics.model import (
    Model,
    require_constants,
    require_linear,
    require_sample_time,
    zeros,
)
from heli_jax.errors import InputError, located, require_known
from heli_jax.finding import Finding, note
from heli_jax.flights.flight import Flight
from heli_jax.naming import Record
from heli_jax.simulation import events
from heli_jax.simulation.inputs import excitation
from heli_jax.simulation.simulate import simulate, substeps_for
from heli_jax.simulation.trajectory import Trajectory
from heli_jax.sweeps.spec import Trimmed

_MIDDLE = 1e-14
"""Stick position that counts as zero [fraction of travel]. Trim leaves values near 1e-79."""


class Simulated(NamedTuple):
    """Columns of simulated runs under the names and in the units of a log."""

    columns: dict[str, np.ndarray]
    """Commanded inputs. With delays in the model they act later."""
    runs: dict[str, Trajectory]
    """Noise-free runs by name, in SI, as NumPy arrays."""
    notes: tuple[Finding, ...]
    """Notes on the runs."""


def _stick_inputs(
    experiment: Experiment, settings: SimulateConfig, n: int, rng: np.random.Generator, where: str
) -> dict[str, np.ndarray]:
    """Return every input of the model in SI; inputs without a name stay at neutral.

    Args:
        settings: the configuration's `simulate`.
    """
    record = experiment.model.Inputs
    words = f"model {experiment.model.name} has no input"
    require_known(settings.inputs, naming.names(record), f"{where}.inputs", words)
    out, dt = {}, 1.0 / settings.rate
    together = [n for n, stick in settings.inputs.items() if stick.kind == "multisine"]
    # Draws follow the model's order, so that they do not depend on the order in the configuration.
    for name in naming.names(record):
        stick = settings.inputs.get(name)
        if stick is None:
            out[name] = np.zeros(n)
            continue
        si = naming.unit(record, name) or "1"
        scale = _factor_to_si(stick.unit or si, si, f"{where}.inputs.{name}.unit")
        place = (together.index(name), len(together)) if name in together else (0, 1)
        limits = {"amplitude": scale * stick.amplitude, "rate": scale * (stick.rate or np.inf)}
        with located(f"{where}.inputs.{name}"):
            out[name] = excitation(
                stick.kind, n, dt, rng, {**dict(stick), "place": place}, **limits
            )
    return out


def _factor_to_si(unit: str, si: str, where: str) -> float:
    """Return `units.factor`; errors name the place.

    Args:
        si: the SI unit of the quantity.
    """
    with located(where):
        return units.factor(unit, si)


def generate(experiment: Experiment) -> Simulated:
    """Simulate the run of the configuration's `simulate`, with noise and disturbance.

    Columns have the names and units of the first flight's `signals`, so that the same configuration
    reads them back. Without flights they have the model's names in SI. Inputs are logged as
    commanded: with delays in the model they act later, as in a real log. A whole helicopter starts
    in trim. Its sticks are the trim plus the inputs of the configuration and of the pilot who holds
    the attitude.

    Raises:
        InputError: an input or output that the model lacks, a unit of the wrong kind, a vehicle
            that lacks something, or a flight without a trim.
    """
    settings = experiment.config.simulate
    assert settings is not None
    where = f"{experiment.path}: simulate"
    # One generator draws inputs first, then noise. Other noise settings leave the manoeuvre
    # unchanged.
    rng = np.random.default_rng(settings.seed)
    n = round(settings.duration * settings.rate)
    _check_disturbance(experiment)
    # All checks come before the run, which takes longest.
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
    # A log ends when the vehicle touches the ground. The frozen state after that is no flight.
    notes = _notes(experiment, run)
    if np.isfinite(run.ended):
        run = run.first(int(np.searchsorted(run.times, run.ended, side="right")))
    outputs = {k: np.asarray(v) for k, v in naming.asdict(run.outputs).items()}
    for name, noise in settings.noise.items():
        si = naming.unit(experiment.model.Outputs, name) or "1"
        scale = _factor_to_si(noise.unit or si, si, f"{where}.noise.{name}.unit")
        # Noise is drawn for the whole record, so that an early end does not change it.
        draws = noise.sd * scale * rng.standard_normal(n)
        outputs[name] = outputs[name] + draws[: outputs[name].size]
    # Log inputs as commanded. If log and model both had the delay, a fit would find none. Wind is
    # an input of `flown`, but logs do not contain it.
    logged = {k: np.asarray(commanded[k])[: run.times.size] for k in driven}
    columns = _as_logged(experiment, np.asarray(run.times), logged, outputs)
    return Simulated(columns, {experiment.path.stem: run}, notes)


class Made(NamedTuple):
    """Inputs and pilot of a sweep that `simulate` generates."""

    experiment: Experiment
    """Experiment, with wind in its model if there is any."""
    flight: Flight
    trimmed: Trimmed | None
    """Trim condition. Each whole helicopter computes its own trim and sticks."""
    pilot: Pilot | None
    """Pilot who holds the attitude, with gains for the vehicle of the file."""


def drive(experiment: Experiment) -> Made:
    """Return the inputs of the configuration's `simulate` for a sweep.

    Raises:
        InputError: as for `generate`, or a ground is given.
    """
    settings = experiment.config.simulate
    assert settings is not None
    where = f"{experiment.path}: simulate"
    _check_full_nonlinear(experiment, settings, where)
    # A sweep reduces results during the run, so all runs have the same length.
    if settings.ground is not None:
        raise InputError(f"{where}.ground: not for sweeps, expected a configuration without it")
    n, rng = round(settings.duration * settings.rate), np.random.default_rng(settings.seed)
    flown = in_wind(experiment) if settings.wind is not None else experiment
    # The draws equal those of `generate`, so each element flies the same manoeuvre.
    inputs = _stick_inputs(flown, settings, n, rng, where)
    flight = Flight(dt=1.0 / settings.rate, inputs=inputs, outputs={}, name="simulate")
    if not is_full_nonlinear(flown.model):
        return Made(flown, flight, None, None)
    # Each element computes its own trim, so only the condition is passed on. The pilot's gains are
    # those for the vehicle of the file.
    begin = Condition(**settings.start.model_dump()) if settings.start else Condition()
    trimmed = Trimmed(begin, settings.wind or (0.0, 0.0, 0.0), of=flown.model)
    pilot = None
    if settings.hold_attitude:
        pilot = _pilot(flown, _begin(flown, settings, where), where)
    return Made(flown, flight, trimmed, pilot)


class Planned(NamedTuple):
    """A run of `simulate` before it is flown."""

    sticks: dict[str, np.ndarray]
    """Excitations (N,) of the inputs, SI."""
    rest: dict[str, float]
    """Inputs in trim, SI."""
    sd: dict[str, float]
    """Measurement noise of each measured output, SI, as `noise` or the first flight states it."""
    start: Record | None
    """State in trim; None for the model's own."""
    pilot: Pilot | None


def plan(experiment: Experiment) -> Planned:
    """Return the run of `simulate` with the outputs that will be measured.

    Raises:
        InputError: as for `generate`; there is no `simulate`; an output has no stated noise; or
            wind or a ground is given.
    """
    settings, where = experiment.config.simulate, f"{experiment.path}: simulate"
    if settings is None:
        raise InputError(f"{where}: missing, expected duration and rate of the designed run")
    if settings.wind is not None or settings.ground is not None:
        raise InputError(f"{where}: a design takes neither wind nor ground, expected none")
    _check_disturbance(experiment)
    n, rng = round(settings.duration * settings.rate), np.random.default_rng(settings.seed)
    sticks = _stick_inputs(experiment, settings, n, rng, where)
    _check_full_nonlinear(experiment, settings, where)
    sd = _stated_noise(experiment, settings, where)
    if not is_full_nonlinear(experiment.model):
        return Planned(sticks, dict.fromkeys(sticks, 0.0), sd, None, None)
    begin = _begin(experiment, settings, where)
    rest = {k: float(v) for k, v in naming.asdict(begin.inputs).items()}
    pilot = _pilot(experiment, begin, where) if settings.hold_attitude else None
    return Planned(sticks, rest, sd, begin.state, pilot)


def _check_disturbance(experiment: Experiment) -> None:
    drawn = experiment.config.disturbance
    disturbed(experiment)  # checks names before numbers: an unknown state needs no sigma_w
    if drawn is not None and None in drawn.parameters.values():
        needed = " and ".join(drawn.parameters)
        raise InputError(f"{experiment.path}: disturbance: simulate needs its {needed}")


def _stated_noise(experiment: Experiment, settings: SimulateConfig, where: str) -> dict[str, float]:
    """Return the sd of each measured output [SI]: those of the first flight, else of `noise`."""
    record, flights = experiment.model.Outputs, experiment.config.flights
    known, words = naming.names(record), f"model {experiment.model.name} has no output"
    require_known(settings.noise, known, f"{where}.noise", words)
    stated: dict[str, Any] = dict.fromkeys(settings.noise)
    if flights:
        stated = {
            n: None if o.sd is None else o for n, o in first_signals(experiment).outputs.items()
        }
    found = {}
    for name, signal in stated.items():
        noise = settings.noise.get(name, signal)
        if noise is None:
            raise InputError(
                f"{where}.noise.{name}: missing, expected the sd of the output's noise"
            )
        si = naming.unit(record, name) or "1"
        found[name] = noise.sd * _factor_to_si(noise.unit or si, si, f"{where}.noise.{name}.unit")
    if not found:
        raise InputError(f"{where}.noise: missing, expected the outputs that are measured")
    return found


def _run(
    experiment: Experiment,
    settings: SimulateConfig,
    n: int,
    driven: dict[str, np.ndarray],
    where: str,
) -> tuple[Trajectory, dict[str, Any]]:
    """Return the run as NumPy arrays without measurement noise, and its commanded inputs."""
    # Missing constants are NaN. Without this check the message would only be "not finite".
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
        # The configuration's inputs are added to the trim. With sticks at zero the vehicle would
        # fall.
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
    with located(f"{where}.rate"):
        require_sample_time(model, 1.0 / settings.rate)
    # jit covers the whole run. Otherwise `simulate` would execute outputs and limits operation by
    # operation. Key and rate are constants of this program.
    run = jax.device_get(jax.jit(fly)(params, inputs, start, pilot))
    # Times are float64 in any precision of the run, so that they equal k/rate, as in a log.
    run = run._replace(times=np.arange(n) / settings.rate)
    # The pilot's inputs depend on the states, so only the run has them. `simulate` does not allow
    # feedback with delayed inputs.
    return run, driven if pilot is None else naming.asdict(run.inputs)


def _check_full_nonlinear(experiment: Experiment, settings: SimulateConfig, where: str) -> None:
    if is_full_nonlinear(experiment.model):
        if settings.hold_attitude and experiment.model.sampled is not None:
            raise InputError(
                f"{where}.hold_attitude: expected a model without controller, which holds the "
                "attitude already"
            )
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
    """Return the trim in which a run starts."""
    condition = Condition(**settings.start.model_dump()) if settings.start else Condition()
    wind = settings.wind or (0.0, 0.0, 0.0)
    with located(f"{where}.start"):
        return trim(experiment.model, experiment.vehicle.params, condition, wind=wind)


def _pilot(experiment: Experiment, begin: Trim, where: str) -> Pilot:
    with located(f"{where}.hold_attitude"):
        return attitude_hold(experiment.model, experiment.vehicle.params, begin)


def _extended(model: Model, state: Record) -> Record:
    """Return an undisturbed model's state as a state of the disturbed model, with zeros added."""
    undisturbed = {k: jnp.asarray(v) for k, v in naming.asdict(state).items()}
    return naming.replace(zeros(model.State), **undisturbed)


def _diverged(experiment: Experiment, run: Trajectory) -> str:
    # Two causes give the same result: a model that cannot start in this state, and an unstable one.
    if not is_full_nonlinear(experiment.model):
        first = {k: float(np.asarray(v)[0]) for k, v in naming.asdict(run.inputs).items()}
        reason = cannot_start(experiment.model, experiment.vehicle.params, first)
        return reason or "the run is not finite: the model is unstable with this vehicle"
    return (
        f"the run is not finite from {_diverged_at(run):g} s on, expected a shorter duration, "
        "gentler inputs or hold_attitude: true"
    )


def _diverged_at(run: Trajectory) -> float:
    """Return the first time at which a run is not finite [s]."""
    # argmin of booleans gives the first sample with a state that is not finite.
    good = np.all([np.isfinite(v) for v in jax.tree.leaves(run.states)], axis=0)
    return float(run.times[np.argmin(good)])


def _notes(experiment: Experiment, run: Trajectory) -> tuple[Finding, ...]:
    """Return notes on how a run ended and where it left the range of the model or the sticks."""
    notes = []
    if np.isfinite(run.ended):
        settings = experiment.config.simulate
        assert settings is not None
        ended = float(run.ended)
        words = (
            f"the vehicle reaches {settings.ground:g} m at {ended:.4g} s: the rest is not written"
        )
        notes.append(note("simulation.ends-on-ground", words, value=ended))
    # The state is frozen after an event and does not belong to the flight.
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
    """Return notes on sticks beyond their limits, in the samples before the end of the flight."""
    # Inputs of other models have no known limits.
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
            words = f"{name} is beyond its limits of {low:g} and {high:g}, first at {first:g} s"
            notes.append(note("simulation.stick-beyond-ends", words, name, value=float(first)))
    return notes


def follow(experiment: Experiment) -> Simulated:
    """Simulate the model with the inputs of the configuration's flights, in SI.

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
        # Two flights may have the same name, so they are numbered.
        runs[f"{len(runs) + 1}: {flight.name}"] = run
        notes += [n.of(flight.name) for n in _notes(experiment, run)]
        if not run.finite:
            first = {n: float(u[0]) for n, u in flight.inputs.items()}
            params = naming.replace(experiment.vehicle.params, **known)
            reason = "" if is_full_nonlinear(model) else cannot_start(model, params, first)
            reason = reason or f"the run is not finite from {_diverged_at(run):g} s on"
            notes.append(Finding("simulation.diverged", "doubt", f"{flight.name}: {reason}"))
    columns = {name: np.concatenate([p[name] for p in parts]) for name in parts[0]}
    return Simulated(columns, runs, tuple(notes))


def _as_logged(
    experiment: Experiment,
    times: np.ndarray,
    driven: dict[str, np.ndarray],
    outputs: dict[str, np.ndarray],
) -> dict[str, np.ndarray]:
    if not experiment.config.flights:
        # Without flights no column names or units are defined.
        return {"time": times, **driven, **outputs}
    logged, where = experiment.config.flights[0].signals, f"{experiment.path}: flights[0].signals"
    model, named = experiment.model, first_signals(experiment)
    # An autopilot's log needs no name for the time, but the table written here does.
    time = logged.time
    name, unit = ("time", "s") if time is None else (time.signal or "time", time.unit)
    seconds = _factor_to_si(unit, "s", f"{where}.time.unit")
    # The column counts samples. If the rows are the clock, extra times do no harm.
    if time is not None and time.rate is not None and time.signal is not None:
        seconds = 1.0 / time.rate
    columns = {name: times / seconds}
    for by_name, values in (
        (signals(model, "inputs", named.inputs, where), driven),
        (signals(model, "outputs", named.outputs, where), outputs),
    ):
        for name, signal in by_name.items():
            if signal.constant is None:  # a log has no column for a constant
                columns[signal.name] = signal.from_si(values[name])
    return columns
