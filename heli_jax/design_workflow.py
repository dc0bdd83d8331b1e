"""Design of a flight from a configuration, as a function and as files."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from heli_jax import config as configuration
from heli_jax import generate, naming, run_directory, units
from heli_jax.config import Experiment
from heli_jax.config.design_section import DesignedInputConfig, FlightDesignConfig
from heli_jax.control.pilot import Pilot
from heli_jax.dynamics.model import require_constants, zeros
from heli_jax.errors import InputError, located, require_known
from heli_jax.flights.flight import Flight
from heli_jax.identification.design.autopilots import ARDUPILOT
from heli_jax.identification.design.information import Feedback
from heli_jax.identification.flight_design import Design, InputLimit, Limits, design
from heli_jax.identification.identifiability.verdict import exponents
from heli_jax.identification.problem import Problem
from heli_jax.identification.unknowns.layout import layout_of
from heli_jax.simulation.simulate import simulate, substeps_for
from heli_jax.yaml_file import as_yaml


class DesignRun(NamedTuple):
    """A design with its configuration."""

    config: Experiment
    settings: FlightDesignConfig
    """Section `design` of the configuration."""
    problem: Problem
    limits: Limits
    design: Design
    wanted: Mapping[str, float]
    """Relative sd by parameter that is enough."""
    directory: Path | None


class Loop(NamedTuple):
    """Feedback of a pilot, or of gains, with excitations at inputs or at set points."""

    pilot: Pilot
    through: dict[str, float]
    """Gain by which an excitation of a set point reaches its input."""

    def __call__(self, state: Any, inputs: Any) -> Any:
        """Return the acting inputs."""
        given = {n: k * getattr(inputs, n) for n, k in self.through.items()}
        return self.pilot(state, naming.replace(inputs, **given))


def run_design(
    config: Experiment | str | Path,
    out: str | Path | None = None,
    *,
    wanted: Mapping[str, float] | None = None,
    progress: Callable[[str], None] = lambda _: None,
) -> DesignRun:
    """Design the inputs of a configuration's `design`.

    Args:
        config: result of `load_config`, or the path of a configuration. `simulate` states the
            duration, the rate, the noise and the inputs that are compared.
        out: directory for design.json, input.csv, report.html and figures; default: none.
        wanted: relative sd by parameter that is enough, in place of `design.wanted`.
        progress: called with progress messages.

    Raises:
        InputError: the configuration is wrong, or `out` exists or cannot be written.
    """
    config = config if isinstance(config, Experiment) else configuration.load(config)
    settings, where = config.config.design, f"{config.path}: design"
    if settings is None:
        raise InputError(f"{where}: missing, expected design.inputs with their limits")
    if out is not None:
        run_directory.require_free(Path(out))
    plan = generate.plan(config)
    limits = _limits(config, settings, where)
    feedback = _feedback(config, settings, plan.pilot, where)
    flights, differences = _flights(config, settings, plan, feedback, where)
    problem = configuration.problem(config, flights)
    # An excitation of a set point has another unit than the input.
    shifted = any(limit.set_point is not None for limit in settings.inputs.values())
    moves = any(np.ptp(u) > 0 for u in plan.sticks.values())
    asked = dict(settings.wanted if wanted is None else wanted)
    with located(where):
        # Before the search, which may take minutes.
        for name in asked:
            exponents(name, layout_of(problem, problem.training).of_interest)
        found = design(
            problem,
            limits,
            criterion=settings.criterion,
            own=[plan.sticks] * len(flights) if moves and not shifted else None,
            rest=plan.rest,
            differences=differences,
            feedback=feedback,
            chirps=_chirps(settings) or ("chirp",),
            vehicles=settings.vehicles,
            seed=settings.seed,
            max_steps=settings.max_steps,
            progress=progress,
        )
    place = None if out is None else Path(out)
    run = DesignRun(config, settings, problem, limits, found, asked, place)
    if run.directory is not None:
        _write(run, run.directory)
    return run


def _chirps(settings: FlightDesignConfig) -> tuple[str, ...]:
    """Return the kinds of chirps that the files of the design play."""
    limits = settings.inputs.values()
    played = {
        "ardupilot-chirp": any(limit.ardupilot for limit in limits),
        "betaflight-chirp": any(limit.betaflight for limit in limits),
    }
    return tuple(kind for kind, wanted in played.items() if wanted)


def _flights(
    config: Experiment,
    settings: FlightDesignConfig,
    plan: generate.Planned,
    feedback: Feedback | None,
    where: str,
) -> tuple[list[Flight], list[dict[str, tuple[float, float]]]]:
    """Return the runs with the inputs of `simulate`, and the differences that the design chooses.

    Their motion sets the sizes of weak priors.
    """
    model, params = config.model, config.vehicle.params
    with config.located(""):
        require_constants(model, params)
    assert config.config.simulate is not None
    dt, flights, differences = 1.0 / config.config.simulate.rate, [], []
    given = model.Inputs(**{n: jnp.asarray(plan.rest[n] + u) for n, u in plan.sticks.items()})
    for i, run in enumerate(settings.runs):
        place = f"{where}.runs[{i}]"
        words = f"model {model.name} has no parameter"
        require_known(run.known, naming.names(model.Params), place, words)
        ranges = {n: v for n, v in run.known.items() if isinstance(v, tuple)}
        known = {n: 0.5 * sum(v) if isinstance(v, tuple) else v for n, v in run.known.items()}
        here = naming.replace(params, **{n: jnp.asarray(v) for n, v in known.items()})
        flown = simulate(
            model, here, given, dt=dt, initial_state=plan.start, feedback=feedback,
            substeps=substeps_for(dt, model.fastest),
        )  # fmt: skip
        if not bool(flown.finite):
            raise InputError(
                f"{place}: the vehicle diverges with the inputs of simulate, expected a feedback, "
                "gentler inputs or a shorter duration"
            )
        inputs = {n: np.asarray(v) for n, v in naming.asdict(flown.inputs).items()}
        outputs = {n: np.asarray(getattr(flown.outputs, n)) for n in plan.sd}
        name = f"run {i + 1}" if len(settings.runs) > 1 else "run"
        flights.append(Flight(dt, inputs, outputs, sd=plan.sd, known=known, name=name))
        differences.append(ranges)
    return flights, differences


def _limits(config: Experiment, settings: FlightDesignConfig, where: str) -> Limits:
    """Return the limits in SI."""
    model = config.model
    require_known(
        settings.inputs,
        naming.names(model.Inputs),
        f"{where}.inputs",
        f"model {model.name} has no input",
    )
    inputs = {}
    for name, limit in settings.inputs.items():
        place = f"{where}.inputs.{name}"
        of = (model.Inputs, name) if limit.set_point is None else (model.State, limit.set_point)
        si = naming.unit(*of) or "1"
        _check_autopilot(limit, si, place)
        factor = _factor(limit.unit, si, place)
        rate = np.inf if limit.rate is None else factor * limit.rate
        inputs[name] = InputLimit(factor * limit.amplitude, rate)
    records = (model.Inputs, model.State, model.Outputs)
    known = {n: record for record in records for n in naming.names(record)}
    words = f"model {model.name} has no output, state or input"
    require_known(settings.motion, tuple(known), f"{where}.motion", words)
    motion = {
        n: m.most * _factor(m.unit, naming.unit(known[n], n), f"{where}.motion.{n}")
        for n, m in settings.motion.items()
    }
    return Limits(inputs, motion)


def _check_autopilot(limit: DesignedInputConfig, si: str, where: str) -> None:
    """Refuse a place of an autopilot that has another unit than the excitation."""
    for key, needed in (
        ("ardupilot", limit.ardupilot and ARDUPILOT[limit.ardupilot][1]),
        ("betaflight", limit.betaflight and "rad/s"),
    ):
        if needed and needed != si:
            raise InputError(
                f"{where}.{key}: the excitation is in {si}, expected {needed}, as of a set_point"
            )


def _factor(unit: str | None, si: str | None, where: str) -> float:
    with located(f"{where}.unit"):
        return units.factor(unit or si or "1", si or "1")


def _feedback(
    config: Experiment, settings: FlightDesignConfig, pilot: Pilot | None, where: str
) -> Loop | None:
    """Return the loop that flies, in SI."""
    model = config.model
    if not settings.feedback:
        return None if pilot is None else Loop(pilot, {})
    if pilot is not None:
        raise InputError(f"{where}.feedback: expected either gains or simulate.hold_attitude")
    if not model.linear:
        raise InputError(f"{where}.feedback: expected a linear model, got {model.name}")
    words = f"model {model.name} has no"
    require_known(
        settings.feedback, naming.names(model.Inputs), f"{where}.feedback", f"{words} input"
    )
    for name, gains in settings.feedback.items():
        names = naming.names(model.State)
        require_known(gains, names, f"{where}.feedback.{name}", f"{words} state")
    gains = {
        n: {k: jnp.asarray(v) for k, v in by_state.items()}
        for n, by_state in settings.feedback.items()
    }
    through = {
        n: settings.feedback[n][limit.set_point]
        for n, limit in settings.inputs.items()
        if limit.set_point is not None
    }
    return Loop(Pilot(gains, zeros(model.State)), through)


def _write(run: DesignRun, out: Path) -> None:
    """Write the directory of a design, whole or not at all."""
    from heli_jax.report.design import write_design

    with run_directory.whole(out) as folder:
        config = as_yaml(configuration.resolved(run.config))
        (folder / "config.yaml").write_text(config, encoding="utf-8")
        write_design(folder, run, config)
