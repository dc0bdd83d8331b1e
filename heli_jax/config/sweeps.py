"""Sweep of a configuration."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from heli_jax import naming, units
from heli_jax.analysis.trim import Condition
from heli_jax.config.experiment import Experiment
from heli_jax.config.logs import read_flights
from heli_jax.config.problems import disturbed
from heli_jax.config.run_sections import AxisConfig, DesignConfig, ReduceConfig, SweepConfig
from heli_jax.control.pilot import Pilot
from heli_jax.dynamics.model import Model
from heli_jax.errors import InputError
from heli_jax.flights.flight import Flight
from heli_jax.flights.open_log import open_table
from heli_jax.import_path import by_path, is_path
from heli_jax.sweeps import design as designs
from heli_jax.sweeps.design import Design, Range, whole_seeds
from heli_jax.sweeps.reducers import LINEAR, REDUCERS, Reduce, Streaming
from heli_jax.sweeps.spec import Job, RunOptions, Trajectories, Trimmed, axis_unit, job


def simulates(experiment: Experiment) -> bool:
    """True if `simulate` makes the sweep's inputs.

    Raises:
        InputError: there is no sweep, or no source of inputs.
    """
    config, path = experiment.config, experiment.path
    if config.sweep is None:
        raise InputError(f"{path}: sweep: missing, expected a design with axes and results")
    # Logs have priority: a configuration with both was written for a fit of a simulated log.
    source = config.sweep.inputs or ("flights" if config.flights else "simulate")
    if source == "flights" and not config.flights:
        raise InputError(f"{path}: sweep.inputs: no flights, expected at least one log")
    if source == "simulate" and config.simulate is None:
        raise InputError(
            f"{path}: sweep: no inputs, expected flights, or simulate, which generates inputs"
        )
    return source == "simulate"


def sweep_job(
    experiment: Experiment,
    made: Flight | None = None,
    trimmed: Trimmed | None = None,
    pilot: Pilot | None = None,
) -> Job:
    """Return the sweep of a configuration, checked, with its logs and tables read.

    Args:
        made: flight made by `simulate`; by default the logs are read.
        trimmed: steady flight in which each run of `made` begins.
        pilot: attitude feedback of the simulated pilot, if any.

    Raises:
        InputError: a part is invalid; the sentence states which and where.
    """
    sweep, path = experiment.config.sweep, experiment.path
    # `simulates` has refused a configuration without a sweep; it must be called first to find the
    # source of inputs.
    assert sweep is not None
    where = f"{path}: sweep"
    model, params = _model(experiment, sweep)
    reduce = {n: _reduce(r, f"{where}.reduce.{n}", path) for n, r in sweep.reduce.items()}
    kept = sweep.trajectories
    # Constant inputs do not identify parameters, but are valid in a sweep.
    flights = (made,) if made is not None else read_flights(experiment)
    if sweep.start is not None:
        # Two starts would contradict each other.
        if made is not None:
            raise InputError(f"{where}.start: expected simulate.start, which generates the inputs")
        # A logged stick already includes the trim, which must not be added twice.
        trimmed = Trimmed(Condition(**sweep.start.model_dump()), sticks=False, of=experiment.model)
    # The trim would silently overwrite an initial state.
    if trimmed is not None and experiment.config.initial_state:
        raise InputError(
            f"{path}: initial_state: each element of this sweep begins in its own trim, expected "
            "a configuration without it"
        )
    with experiment.located("sweep"):
        return job(
            model,
            params,
            flights,
            _design(sweep, model, path, sweep.seed or 0),
            reduce,
            RunOptions(
                sweep.solver,
                sweep.substeps,
                sweep.precision,
                None if kept is None else Trajectories(tuple(kept.signals), kept.every),
                trimmed,
                pilot,
            ),
        )


def _model(experiment: Experiment, sweep: SweepConfig) -> tuple[Model, Any]:
    """Return the model, with the disturbance if an axis belongs to it."""
    plain, disturbance = naming.names(experiment.model.Params), experiment.config.disturbance
    values = {} if disturbance is None else disturbance.parameters
    # A user's model may have a parameter named sigma_w, which is not the disturbance's.
    drawn = [n for n in _axes(sweep) if n in ("seed", *values) and n not in plain]
    # Without such an axis nothing is drawn, and a disturbance's states would only cost time.
    if not drawn or disturbance is None:
        return experiment.model, experiment.vehicle.params
    for name, value in values.items():
        # Filter error guesses missing values from a record; a sweep has no record.
        if value is None and name not in drawn:
            raise InputError(
                f"{experiment.path}: disturbance.{name}: missing, expected a number, since the "
                "sweep draws the disturbance"
            )
    if "seed" not in drawn:
        raise InputError(
            f"{experiment.path}: sweep.axes.{drawn[0]}: expected also an axis seed, as seed: "
            "{values: [0]}; without it no disturbance is drawn"
        )
    return disturbed(experiment)


def _axes(section: DesignConfig) -> list[str]:
    return [*section.axes, *(n for part in section.of for n in _axes(part))]


def _design(section: DesignConfig, model: Model, path: Path, seed: int) -> Design:
    """Return the design of experiments of a section.

    Raises:
        ValueError: the section is invalid.
    """
    kind = section.design
    seed = seed if section.seed is None else section.seed
    if kind in ("product", "zip"):
        return _of_designs(section, model, path, seed)
    _refuse(section, ("of",), f"only product and zip have it, not {kind}")
    if kind == "table":
        _refuse(section, ("n",), "a table has its rows")
        return _table(section, model, path)
    _refuse(section, ("file",), f"only a table has it, not {kind}")
    if kind in ("lhs", "sobol"):
        if section.n is None:
            raise ValueError(f"n: missing, expected the number of design points of {kind}")
        ranges = {n: _range(n, a, model, path) for n, a in section.axes.items()}
        return {"lhs": designs.lhs, "sobol": designs.sobol}[kind](ranges, section.n, seed)
    _refuse(section, ("n",), f"a {kind} has its axes' points: expected n in an axis")
    axes = {n: _points(n, a, model, path) for n, a in section.axes.items()}
    return {"grid": designs.grid, "list": designs.paired}[kind](axes)


def _of_designs(section: DesignConfig, model: Model, path: Path, seed: int) -> Design:
    """Return a product or a zip of the designs below `of`."""
    _refuse(section, ("axes", "n", "file"), f"a {section.design} has designs in 'of'")
    parts = []
    for i, part in enumerate(section.of):
        try:
            # Parts draw different values at any depth. Not seed + i: the second part of one seed
            # would equal the first of the next.
            own = np.random.SeedSequence(seed, spawn_key=(i,)).generate_state(1)[0]
            parts.append(_design(part, model, path, int(own)))
        except InputError:
            raise
        except ValueError as e:  # the place grows outward: of[0].of[1].axes.a
            raise ValueError(f"of[{i}].{e}") from e
    combine: Callable[..., Design] = {"product": designs.product, "zip": designs.zipped}[
        section.design
    ]
    return combine(*parts)


# Refused, not ignored: a user expects every stated key to act.
def _refuse(section: DesignConfig, keys: tuple[str, ...], why: str) -> None:
    for key in keys:
        if getattr(section, key):
            raise ValueError(f"{key}: {why}")


def _range(name: str, axis: AxisConfig, model: Model, path: Path) -> Range:
    for key in ("values", "column", "n"):
        if getattr(axis, key) is not None:
            raise ValueError(f"axes.{name}.{key}: expected lower and upper here")
    # No default: a range may be wide for one parameter and narrow for another.
    if axis.lower is None or axis.upper is None:
        raise ValueError(f"axes.{name}: expected lower and upper")
    # A logarithmic axis stays one in SI, because units of parameters have no offset.
    scale = _scale(name, axis, model, path)
    return Range(axis.lower * scale, axis.upper * scale, axis.scale)


def _points(name: str, axis: AxisConfig, model: Model, path: Path) -> Any:
    if axis.column is not None:
        raise ValueError(f"axes.{name}.column: only a table has columns")
    if axis.values is None:
        # Only a grid has n: a design that draws its points refuses a range with it.
        points = axis.model_copy(update={"n": None})
        return _range(name, points, model, path)._replace(n=axis.n)
    for key in ("lower", "upper", "n"):
        if getattr(axis, key) is not None:
            raise ValueError(f"axes.{name}: expected values, or lower and upper, not both")
    values = np.asarray(axis.values) * _scale(name, axis, model, path)
    return whole_seeds(values) if name == "seed" else values


def _table(section: DesignConfig, model: Model, path: Path) -> Design:
    if section.file is None:
        raise ValueError("file: missing, expected a table in CSV or Parquet")
    if not section.axes:
        raise ValueError("axes: expected at least one, as Ixx: {} for a column Ixx, got none")
    # Read like a log, with the same formats and messages.
    source = open_table(path.parent / section.file)
    for name, axis in section.axes.items():
        for key in ("lower", "upper", "values", "n"):
            if getattr(axis, key) is not None:
                raise ValueError(f"axes.{name}.{key}: the table has the values")
    columns = {name: axis.column or name for name, axis in section.axes.items()}
    # Each column once, because two axes may share one.
    numbers = source.numbers(list(dict.fromkeys(columns.values())))
    scaled: dict[str, np.ndarray] = {
        name: numbers[columns[name]] * _scale(name, axis, model, path)
        for name, axis in section.axes.items()
    }
    if "seed" in scaled:
        scaled["seed"] = whole_seeds(scaled["seed"])
    return designs.table(scaled)


def _scale(name: str, axis: AxisConfig, model: Model, path: Path) -> float:
    """Return the factor from the axis's numbers to SI."""
    if axis.unit is None:
        return 1.0
    try:
        # A seed and a user's parameter may have no unit; they take only plain numbers.
        return units.factor(axis.unit, axis_unit(model, name) or "1")
    except ValueError as e:
        raise ValueError(f"axes.{name}.unit: {e}") from e


def _reduce(section: ReduceConfig, where: str, path: Path) -> Reduce:
    reducer: Any = section.how  # Any: a name, or any object at a path
    # Our own names first, so that no user module changes the meaning of rms.
    if reducer not in REDUCERS and reducer not in LINEAR and is_path(reducer):
        reducer = by_path(reducer, f"{where}.how", path.absolute().parent)
        if not callable(reducer) and not isinstance(reducer, Streaming):
            kind = "nothing" if reducer is None else f"a {type(reducer).__name__}"
            raise InputError(
                f"{where}.how: expected a function of a Trajectory at {section.how!r}, got {kind}"
            )
    return Reduce(reducer, section.signal, section.input, section.gain)
