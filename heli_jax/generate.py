"""Runs that a configuration describes and the project makes itself."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from heli_jax import naming, units
from heli_jax.config import (
    Experiment,
    SimulateConfig,
    StickConfig,
    disturbed,
    read_flights,
    signals,
)
from heli_jax.errors import InputError, nearest
from heli_jax.simulation import inputs as sticks
from heli_jax.simulation.simulate import simulate


class Table(NamedTuple):
    """Columns of one simulated run under the names and in the units of a log."""

    columns: dict[str, np.ndarray]


def generate(experiment: Experiment) -> Table:
    """The run of the configuration's `simulate`, with noise and disturbance.

    Its columns have the names and units of the first flight's `signals`, so that the same
    configuration reads it back; without flights, the model's names in SI.

    Raises:
        InputError: an input or output that the model lacks, or a unit of the wrong kind.
    """
    wanted = experiment.config.simulate
    assert wanted is not None
    where = f"{experiment.path}: simulate"
    rng = np.random.default_rng(wanted.seed)
    n = round(wanted.duration * wanted.rate)
    drawn = experiment.config.disturbance
    if drawn is not None and (drawn.sigma_w is None or drawn.tau_w is None):
        raise InputError(f"{experiment.path}: disturbance: simulate needs its sigma_w and tau_w")
    model, params = disturbed(experiment)
    driven = _inputs(experiment, wanted, n, rng, where)
    key = jax.random.key(wanted.seed) if experiment.config.disturbance else None
    run = jax.jit(lambda p, u: simulate(model, p, u, dt=1.0 / wanted.rate, key=key))(
        params, model.Inputs(**{k: jnp.asarray(v) for k, v in driven.items()})
    )
    if not bool(run.finite):
        raise InputError(f"{where}: the run is not finite: the model is unstable with this vehicle")
    outputs = {k: np.asarray(v) for k, v in naming.asdict(run.outputs).items()}
    for name, noise in wanted.noise.items():
        if name not in outputs:
            raise InputError(
                f"{where}.noise: model {experiment.model.name} has no output {name!r}"
                f"{nearest(name, outputs)}"
            )
        si = naming.unit(model.Outputs, name) or "1"
        scale = _factor(noise.unit or si, si, f"{where}.noise.{name}.unit")
        outputs[name] = outputs[name] + noise.sd * scale * rng.standard_normal(n)
    return _as_logged(experiment, np.arange(n) / wanted.rate, driven, outputs)


def follow(experiment: Experiment) -> Table:
    """The model driven by the inputs of the configuration's flights, in SI.

    Raises:
        InputError: no flights, or one that cannot be read.
    """
    model = experiment.model
    parts: list[dict[str, Any]] = []
    gain = experiment.config.fit is not None and experiment.config.fit.nuisance.input_gain
    for flight in read_flights(experiment, gain=gain, moving_inputs=False):
        known = {n: jnp.asarray(v) for n, v in flight.known.items()}
        run = simulate(model, naming.replace(experiment.vehicle.params, **known), flight)
        outputs = {n: np.asarray(v) for n, v in naming.asdict(run.outputs).items()}
        label = np.array([flight.name] * flight.n_samples)
        parts.append({"flight": label, "time": flight.times, **flight.inputs, **outputs})
    return Table({name: np.concatenate([p[name] for p in parts]) for name in parts[0]})


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
        return sticks.sweep(n, dt, *one.band)
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
) -> Table:
    if not experiment.config.flights:
        return Table({"time": times, **driven, **outputs})
    given, where = experiment.config.flights[0].signals, f"{experiment.path}: flights[0].signals"
    model = experiment.model
    columns = {given.time.signal: times / _factor(given.time.unit, "s", f"{where}.time.unit")}
    for signal, values in (
        (signals(model, "inputs", given.inputs, where), driven),
        (signals(model, "outputs", given.outputs, where), outputs),
    ):
        for name, one in signal.items():
            columns[one.name] = values[name] / units.factor(one.unit, one.si)
    return Table(columns)
