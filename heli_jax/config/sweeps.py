"""The sweep that a configuration describes."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from heli_jax import naming, units
from heli_jax.analysis.trim import Condition
from heli_jax.config.experiment import Experiment
from heli_jax.config.logs import read_flights
from heli_jax.config.problems import disturbed
from heli_jax.config.schema import AxisConfig, DesignConfig, ReduceConfig, SweepConfig
from heli_jax.dynamics.model import Model
from heli_jax.errors import InputError
from heli_jax.flights.flight import Flight
from heli_jax.flights.open_log import open_table
from heli_jax.import_path import by_path, is_path
from heli_jax.sweeps import design as designs
from heli_jax.sweeps.axes import Range, whole_seeds
from heli_jax.sweeps.design import Design
from heli_jax.sweeps.reducers import LINEAR, REDUCERS, Reduce, Streaming
from heli_jax.sweeps.spec import Job, RunOptions, Trajectories, Trimmed, axis_unit, job

_DRAWN = ("seed", "sigma_w", "tau_w")
"""axes that are of the disturbance"""


def simulates(experiment: Experiment) -> bool:
    """Whether the sweep's inputs are those that `simulate` makes.

    Raises:
        InputError: there is no sweep, or nothing to take the inputs from.
    """
    config, path = experiment.config, experiment.path
    if config.sweep is None:
        raise InputError(f"{path}: sweep: missing, expected a design with axes and results")
    source = config.sweep.inputs or ("flights" if config.flights else "simulate")
    if source == "flights" and not config.flights:
        raise InputError(f"{path}: sweep.inputs: there are no flights, expected at least one log")
    if source == "simulate" and config.simulate is None:
        raise InputError(
            f"{path}: sweep: no inputs, expected flights, or simulate, which makes some"
        )
    return source == "simulate"


def sweep_job(
    experiment: Experiment,
    made: Flight | None = None,
    trimmed: Trimmed | None = None,
    pilot: Any = None,
) -> Job:
    """The sweep of a configuration, checked; its logs and tables are read.

    `made` is the flight that `simulate` makes, with the beginning and the pilot that belong to it.

    Raises:
        InputError: something of it cannot be; the sentence says what and where.
    """
    sweep, path = experiment.config.sweep, experiment.path
    assert sweep is not None
    where = f"{path}: sweep"
    model, params = _model(experiment, sweep)
    reduce = {n: _reduce(r, f"{where}.reduce.{n}", path) for n, r in sweep.reduce.items()}
    kept = sweep.trajectories
    flights = (made,) if made is not None else read_flights(experiment, moving_inputs=False)
    if sweep.start is not None:
        if made is not None:
            raise InputError(f"{where}.start: expected simulate.start, which makes the inputs")
        trimmed = Trimmed(Condition(**sweep.start.model_dump()), sticks=False, of=experiment.model)
    if trimmed is not None and experiment.config.initial_state:
        raise InputError(
            f"{path}: initial_state: each element of this sweep begins in a trim of its own, "
            "expected a configuration without it"
        )
    try:
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
    except InputError:
        raise
    except ValueError as e:
        outside = str(e).startswith("vehicle:")
        raise InputError(f"{path if outside else where}: {e}") from e


def _model(experiment: Experiment, sweep: SweepConfig) -> tuple[Model, Any]:
    """The model, with the disturbance where an axis is one of its."""
    plain = naming.names(experiment.model.Params)
    drawn = [n for n in _axes(sweep) if n in _DRAWN and n not in plain]
    if not drawn or experiment.config.disturbance is None:
        return experiment.model, experiment.vehicle.params
    where, given = f"{experiment.path}: disturbance", experiment.config.disturbance
    for name in ("sigma_w", "tau_w"):
        if getattr(given, name) is None and name not in drawn:
            raise InputError(f"{where}.{name}: missing, expected a number to draw it with")
    if "seed" not in drawn:
        raise InputError(
            f"{experiment.path}: sweep.axes.{drawn[0]}: nothing is drawn without an axis seed, "
            "expected seed: {values: [0]} too"
        )
    return disturbed(experiment)


def _axes(one: DesignConfig) -> list[str]:
    return [*one.axes, *(n for part in one.of for n in _axes(part))]


def _design(one: DesignConfig, model: Model, path: Path, seed: int) -> Design:
    """The design that a section describes; ValueError where it cannot be."""
    seed = seed if one.seed is None else one.seed
    if one.design in ("product", "zip"):
        _refuse(one, ("axes", "n", "file"), f"a {one.design} has designs in 'of'")
        parts = []
        for i, part in enumerate(one.of):
            try:
                parts.append(_design(part, model, path, _another(seed, i)))
            except InputError:
                raise
            except ValueError as e:
                raise ValueError(f"of[{i}].{e}") from e
        made: Callable[..., Design] = {"product": designs.product, "zip": designs.zipped}[
            one.design
        ]
        return made(*parts)
    _refuse(one, ("of",), f"only product and zip have it, not {one.design}")
    if one.design == "table":
        _refuse(one, ("n",), "a table has its rows")
        return _table(one, model, path)
    _refuse(one, ("file",), f"only a table has it, not {one.design}")
    if one.design in ("lhs", "sobol"):
        if one.n is None:
            raise ValueError(f"n: missing, expected how many elements {one.design} makes")
        between = {n: _between(n, a, model, path) for n, a in one.axes.items()}
        return {"lhs": designs.lhs, "sobol": designs.sobol}[one.design](between, one.n, seed)
    _refuse(one, ("n",), f"a {one.design} has its axes' points: expected n in an axis")
    axes = {n: _points(n, a, model, path) for n, a in one.axes.items()}
    return {"grid": designs.grid, "list": designs.paired}[one.design](axes)


def _another(seed: int, i: int) -> int:
    """A seed for the i-th part of a design: no two parts, however deep, draw the same."""
    return int(np.random.SeedSequence(seed, spawn_key=(i,)).generate_state(1)[0])


def _refuse(one: DesignConfig, keys: tuple[str, ...], why: str) -> None:
    for key in keys:
        if getattr(one, key):
            raise ValueError(f"{key}: {why}")


def _between(name: str, axis: AxisConfig, model: Model, path: Path) -> Range:
    for key in ("values", "column", "n"):
        if getattr(axis, key) is not None:
            raise ValueError(f"axes.{name}.{key}: expected lower and upper here")
    if axis.lower is None or axis.upper is None:
        raise ValueError(f"axes.{name}: expected lower and upper")
    scale = _scale(name, axis, model, path)
    return Range(axis.lower * scale, axis.upper * scale, axis.scale)


def _points(name: str, axis: AxisConfig, model: Model, path: Path) -> Any:
    if axis.column is not None:
        raise ValueError(f"axes.{name}.column: only a table has columns")
    if axis.values is None:
        points = axis.model_copy(update={"n": None})
        return _between(name, points, model, path)._replace(n=axis.n)
    for key in ("lower", "upper", "n"):
        if getattr(axis, key) is not None:
            raise ValueError(f"axes.{name}: expected values, or lower and upper, not both")
    return _as_column(name, np.asarray(axis.values) * _scale(name, axis, model, path))


def _as_column(name: str, values: np.ndarray) -> np.ndarray:
    """Seeds are whole numbers."""
    return whole_seeds(values) if name == "seed" else values


def _table(one: DesignConfig, model: Model, path: Path) -> Design:
    if one.file is None:
        raise ValueError("file: missing, expected a table in CSV or Parquet")
    if not one.axes:
        raise ValueError("axes: none given, expected at least one, as Ixx: {} for a column Ixx")
    source = open_table(path.parent / one.file)
    for name, axis in one.axes.items():
        for key in ("lower", "upper", "values", "n"):
            if getattr(axis, key) is not None:
                raise ValueError(f"axes.{name}.{key}: the table has the values")
    columns = {name: axis.column or name for name, axis in one.axes.items()}
    found = source.numbers(list(dict.fromkeys(columns.values())))
    scaled: Mapping[str, np.ndarray] = {
        name: _as_column(name, found[columns[name]] * _scale(name, axis, model, path))
        for name, axis in one.axes.items()
    }
    return designs.table(scaled)


def _scale(name: str, axis: AxisConfig, model: Model, path: Path) -> float:
    """What takes the axis's numbers to SI."""
    if axis.unit is None:
        return 1.0
    try:
        return units.factor(axis.unit, axis_unit(model, name) or "1")
    except ValueError as e:
        raise ValueError(f"axes.{name}.unit: {e}") from e


def _reduce(one: ReduceConfig, where: str, path: Path) -> Reduce:
    how: Any = one.how
    if how not in REDUCERS and how not in LINEAR and is_path(how):
        how = by_path(how, f"{where}.how", path.absolute().parent)
        if not callable(how) and not isinstance(how, Streaming):
            found = "nothing" if how is None else f"a {type(how).__name__}"
            raise InputError(
                f"{where}.how: {one.how!r} is {found}, expected a function of a Trajectory"
            )
    return Reduce(how, one.signal, one.input, one.gain)
