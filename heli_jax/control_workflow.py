"""Control of an identified vehicle from a configuration, as a function and as files."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from heli_jax import config as configuration
from heli_jax import naming, run_directory, units
from heli_jax.analysis.margins import Margins
from heli_jax.analysis.trim import Condition
from heli_jax.config import Experiment
from heli_jax.config.control_section import AcceptableConfig, ControlConfig
from heli_jax.control.controller import Controller, commanded, in_loop
from heli_jax.control.loops import all_stable
from heli_jax.control.posterior import SteadyFlights, draws, vehicles_of
from heli_jax.control.regulators import lqg, lqr, pid
from heli_jax.control.tune import Flown, Scenario, Tuned, Tuning, gusts, tune
from heli_jax.dynamics.model import Model, require_constants
from heli_jax.errors import InputError, located, require_known
from heli_jax.report.saved_fit import SavedFit, load_fit
from heli_jax.simulation.trajectory import STATUS
from heli_jax.yaml_file import as_yaml


class ControlRun(NamedTuple):
    """A controller, and how it flies the vehicles of a posterior."""

    config: Experiment
    model: Model
    fit: SavedFit | None
    controller: Controller
    tuned: Tuned | None
    """None without tuning."""
    commands: tuple[str, ...]
    margins: tuple[Margins, ...]
    """Margins (samples,) of the loop at each command."""
    tuning: Tuning
    """The samples, with responses of their loops."""
    flown: Flown
    """Flights of the samples."""
    stable: float
    """Share of stable samples, vehicles without steady flight included."""
    lost: int
    """Samples without steady flight."""
    directory: Path | None

    @property
    def sound(self) -> bool:
        """True if all vehicles are stable, none diverges in flight, and the tuning converged."""
        flown = np.all(self.flown.status < STATUS.index("not finite"))
        return bool(flown) and self.stable == 1.0 and (self.tuned is None or self.tuned.converged)


def run_control(
    config: Experiment | str | Path,
    out: str | Path | None = None,
    *,
    fit: str | Path | None = None,
    progress: Callable[[str], None] = lambda _: None,
) -> ControlRun:
    """Compute the controller of a configuration's `control`, and fly it over a posterior.

    Args:
        config: result of `load_config`, or the path of a configuration.
        out: directory for control.json, gains.csv, report.html and figures; default: none.
        fit: run directory of a fit, in place of `control.fit`; without either the only vehicle is
            that of the configuration.
        progress: called with progress messages.

    Raises:
        InputError: the configuration or the fit is wrong, or `out` exists or cannot be written.
    """
    config = config if isinstance(config, Experiment) else configuration.load(config)
    settings, where = config.config.control, f"{config.path}: control"
    if settings is None:
        raise InputError(f"{where}: missing, expected control.inputs with their largest deviations")
    if out is not None:
        run_directory.require_free(Path(out))
    saved = _fit(config, settings, fit, where)
    if any(n.startswith("wind_") for n in settings.gusts):
        config = configuration.in_wind(config, "control.gusts")
    model = in_loop(config.model, settings.inputs)
    with config.located(""):
        require_constants(model, config.vehicle.params)
    most, integral, limits, steps = _numbers(model, settings, where)
    sd = _sensors(model, settings, where)
    progress("steady flights of the vehicles")
    with located(where):
        values = {} if saved is None else draws(saved, settings.samples, settings.seed)
        condition = Condition(**settings.start.model_dump())
        vehicles, flights, lost = vehicles_of(model, config.vehicle.params, values, condition)
        first = SteadyFlights(*jax.tree.map(lambda v: v[0], (flights.state, flights.inputs)))
        mode = jax.tree.map(lambda v: v[0], vehicles)
        controller = _law(
            model, mode, first, settings, most, integral, limits, sd, tuple(steps), where
        )
        scenario = _scenario(model, settings, steps, sd, where)
        bandwidth = {n: s.bandwidth for n, s in settings.signals.items() if s.bandwidth}
        tuned = None
        if settings.max_steps:
            some, steady = jax.tree.map(lambda v: v[: settings.vehicles], (vehicles, flights))
            tuned = tune(
                model, some, steady, controller, scenario, most=most, distance=settings.distance,
                bandwidth=bandwidth, max_steps=settings.max_steps, progress=progress,
            )  # fmt: skip
            controller = tuned.controller
        progress("flights of the samples")
        tuning = Tuning(model, vehicles, flights, controller, scenario, most, bandwidth)
    margins = tuning.margins(controller)
    kept = all_stable(margins)
    run = ControlRun(
        config, model, saved, controller, tuned, commanded(model, controller), margins, tuning,
        tuning.flown(controller), float(np.sum(kept) / (len(kept) + lost)), lost,
        None if out is None else Path(out),
    )  # fmt: skip
    if run.directory is not None:
        _write(run, run.directory)
    return run


def _fit(
    config: Experiment, settings: ControlConfig, fit: str | Path | None, where: str
) -> SavedFit | None:
    """Return the fit whose posterior is flown."""
    if fit is None and settings.fit is not None:
        fit = config.path.parent / settings.fit
    if fit is None:
        return None
    saved = load_fit(fit)
    unknown = [n for n in saved.estimates if n not in naming.names(config.model.Params)]
    if unknown:
        raise InputError(
            f"{where}.fit: {fit} has estimates of model {saved.model}, expected those of "
            f"{config.model.name}, which has no {unknown[0]}"
        )
    return saved


def _numbers(
    model: Model, settings: ControlConfig, where: str
) -> tuple[dict[str, float], dict[str, float], dict[str, float], dict[str, float]]:
    """Return largest deviations, largest integrals, limits and steps, by name, SI."""
    known = dict.fromkeys(naming.names(model.Inputs), model.Inputs)
    signals = _signals(model)
    words = f"model {model.name} has no"
    require_known(settings.inputs, tuple(known), f"{where}.inputs", f"{words} input")
    require_known(settings.signals, tuple(signals), f"{where}.signals", f"{words} signal")
    require_known(settings.gusts, tuple(known), f"{where}.gusts", f"{words} input")
    require_known(settings.integral, tuple(signals), f"{where}.integral", f"{words} signal")
    drawn = (*known, *naming.names(model.State))
    require_known(settings.noise, drawn, f"{where}.noise", f"{words} input or state")
    for name, by in settings.loops.items():
        require_known(by, tuple(signals), f"{where}.loops.{name}", f"{words} signal")
    most, integral, limits, steps = {}, {}, {}, {}
    stated: list[tuple[str, AcceptableConfig, type, str]] = [
        *((n, one, signals[n], f"{where}.signals.{n}") for n, one in settings.signals.items()),
        *((n, one, known[n], f"{where}.inputs.{n}") for n, one in settings.inputs.items()),
    ]
    for name, one, record, place in stated:
        si = naming.unit(record, name) or "1"
        with located(f"{place}.unit"):
            factor = units.factor(one.unit or si, si)
        most[name] = factor * one.most
        if one.limit is not None:
            limits[name] = factor * one.limit
        if one.integral is not None:
            integral[name] = factor * one.most * one.integral
        if one.step is not None:
            steps[name] = factor * one.step
        if name in settings.inputs and (one.integral is not None or one.step is not None):
            raise InputError(f"{place}: expected integral and step of signals alone")
    if integral and settings.law != "lqr":
        raise InputError(f"{where}.signals: integral is for law: lqr, got law: {settings.law}")
    return most, integral, limits, steps


def _law(
    model: Model,
    params: Any,
    trimmed: SteadyFlights,
    settings: ControlConfig,
    most: dict[str, float],
    integral: dict[str, float],
    limits: dict[str, float],
    sd: dict[str, float],
    references: tuple[str, ...],
    where: str,
) -> Controller:
    dt = 1.0 / settings.rate
    commands = {n: v for n, v in limits.items() if n in settings.inputs}
    if settings.law == "pid":
        outer = [next(iter(by)) for by in settings.loops.values()]
        for name in references:
            if name not in outer:
                raise InputError(
                    f"{where}.signals.{name}.step: expected a signal of an outermost loop "
                    f"({', '.join(outer)})"
                )
        return pid(
            model, params, trimmed, loops=settings.loops, dt=dt, integral=settings.integral,
            limits=limits,
        )  # fmt: skip
    shared: dict[str, Any] = {"most": most, "dt": dt, "references": references, "limits": commands}
    if settings.law == "lqr":
        return lqr(model, params, trimmed, integral=integral, **shared)
    return lqg(model, params, trimmed, sd=sd, noise=settings.noise, **shared)


def _signals(model: Model) -> dict[str, type]:
    """Return the record of each signal by name."""
    signals = dict.fromkeys(naming.names(model.State), model.State)
    return signals | dict.fromkeys(naming.names(model.Outputs), model.Outputs)


def _sensors(model: Model, settings: ControlConfig, where: str) -> dict[str, float]:
    """Return the sd of the noise of the measured signals, SI."""
    signals, sd = _signals(model), {}
    words = f"model {model.name} has no"
    if settings.law == "lqg":
        require_known(
            settings.sensors, naming.names(model.Outputs), f"{where}.sensors", f"{words} output"
        )
    require_known(settings.sensors, tuple(signals), f"{where}.sensors", f"{words} signal")
    for name, sensor in settings.sensors.items():
        si = naming.unit(signals[name], name) or "1"
        with located(f"{where}.sensors.{name}.unit"):
            sd[name] = sensor.sd * units.factor(sensor.unit or si, si)
    return sd


def _scenario(
    model: Model,
    settings: ControlConfig,
    steps: dict[str, float],
    sd: dict[str, float],
    where: str,
) -> Scenario:
    """Return gusts, steps of the set points one after another, and the noise of sensors."""
    dt, rng = 1.0 / settings.rate, np.random.default_rng(settings.seed)
    n = round(settings.duration * settings.rate)
    if n < 2:
        raise InputError(f"{where}.duration: expected at least two samples, got {n}")
    inputs = {}
    for name in naming.names(model.Inputs):
        if name in settings.gusts:
            gust = settings.gusts[name]
            inputs[name] = gusts(gust.sd, gust.tau, n, dt, rng)
    set_points = {}
    for i, (name, step) in enumerate(steps.items()):
        # Each step lasts an equal share of the flight, and begins after the first tenth.
        begin = round((0.1 + 0.9 * i / len(steps)) * n)
        set_points[name] = np.where(np.arange(n) >= begin, step, 0.0)
    noise = {name: size * rng.standard_normal(n) for name, size in sd.items()}
    return Scenario(inputs, set_points, n, noise)


def _write(run: ControlRun, out: Path) -> None:
    """Write the directory of a controller, whole or not at all."""
    from heli_jax.report.control import write_control

    with run_directory.whole(out) as folder:
        config = as_yaml(configuration.resolved(run.config))
        (folder / "config.yaml").write_text(config, encoding="utf-8")
        write_control(folder, run, config)
