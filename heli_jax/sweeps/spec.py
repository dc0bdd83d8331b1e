"""Specification of a sweep: checked options and the parts that workers need."""

from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple

import jax
import numpy as np

from heli_jax import naming
from heli_jax.analysis.trim import Condition, is_full_nonlinear
from heli_jax.control.pilot import Pilot
from heli_jax.dynamics.check_model import check_model
from heli_jax.dynamics.model import (
    Model,
    plain,
    reads,
    require_constants,
    require_continuous,
    require_linear,
    require_sample_time,
)
from heli_jax.errors import nearest, require_kind
from heli_jax.flights.flight import Flight
from heli_jax.simulation.options import SimulationOptions
from heli_jax.simulation.simulate import substeps_for
from heli_jax.simulation.solvers import solver_named
from heli_jax.sweeps import reducers
from heli_jax.sweeps.design import Design, whole_seeds
from heli_jax.sweeps.reducers import Reduce

Precision = Literal["float64", "float32"]


# `Any` below: Params are the user's own class, a NamedTuple that the model names.


class Trajectories(NamedTuple):
    """Runs to keep, thinned."""

    signals: tuple[str, ...]
    """Outputs of the model."""
    every: int = 1
    """Samples between two kept ones."""


class Trimmed(NamedTuple):
    """Each element of a full helicopter begins in its own steady flight."""

    condition: Condition = Condition()
    wind: tuple[float, float, float] = (0.0, 0.0, 0.0)
    sticks: bool = True
    """True to add its sticks to the flight's; a logged flight already includes them."""
    of: Model | None = None
    """Model to trim, if the sweep's model has a disturbance."""


class RunOptions(NamedTuple):
    """Options of each run of a sweep; each field is also a keyword of `sweep`."""

    solver: str | None = None
    """Solver with fixed steps: "exact" (default of linear models), "rk4" (of others), or a diffrax
    solver's name."""
    substeps: int | None = None
    """Steps per sample; by default enough for steps of 5 ms."""
    precision: Precision = "float64"
    """Precision. float32 is faster on some devices."""
    trajectories: Trajectories | None = None
    """Outputs to keep, thinned."""
    trimmed: Trimmed | None = None
    """Steady flight in which a full nonlinear model begins."""
    pilot: Pilot | None = None
    """Pilot that holds the attitude."""


class Plan(NamedTuple):
    """Compiled part of a sweep; sweeps with the same plan share the program."""

    # The cache key of `program`: every field is hashable, and none is a number of a vehicle or a
    # flight.

    model: Model
    reduce: tuple[tuple[str, Reduce], ...]
    options: RunOptions
    """Without the pilot, whose gains are numbers."""
    streamed: bool
    simulated: bool
    moving: tuple[tuple[str, str], ...] = ()
    """Inputs that are linear or mixed between samples, with their holds; the others are held."""

    def simulation(self, **numbers: Any) -> SimulationOptions:  # fields of several types
        """Return the simulation options of a run; `numbers` are the fields that vary by element."""
        solver, substeps = self.options.solver, self.options.substeps
        # `job` states both.
        assert solver is not None
        assert substeps is not None
        return SimulationOptions(
            solver=solver_named(solver),
            substeps=substeps,
            hold={
                **dict.fromkeys(naming.names(self.model.Inputs), "zero-order"),
                **dict(self.moving),
            },
            **numbers,
        )


DEFAULT = RunOptions()
_MOST = 10**10  # elements: more take months, and indicate a slip in one of the axes
_LOOKED_AT = 1 << 16  # elements whose seeds are checked: all of 10^10 would take minutes


class Job(NamedTuple):
    """All data that a chunk of a sweep needs."""

    # Sent to workers on other computers: its content must be picklable, functions by name.

    model: Model
    params: dict[str, float]
    flights: tuple[Flight, ...]
    design: Design
    reduce: dict[str, Reduce]
    options: RunOptions
    """With the solver and its steps."""

    def plan(self, index: int) -> Plan:
        """Return the compiled part for one of its flights."""
        return Plan(
            self.model,
            tuple(self.reduce.items()),
            self.options._replace(pilot=None),
            self.streamed,
            self.simulated,
            moving_inputs_of(self.model, self.flights[index]),
        )

    @property
    def streamed(self) -> bool:
        """True if every run is reduced during the simulation and none is stored."""
        how = [r.how for r in self.reduce.values()]
        whole = any(callable(h) and not isinstance(h, reducers.Streaming) for h in how)
        # `accumulate` lacks delay, noise and feedback, which `simulate` has. Such runs are stored
        # whole and reduced afterwards.
        drawn_or_late = {"delay", "seed"} & set(special_axes(self.model, self.design))
        kept = self.options.trajectories is not None
        return not whole and not drawn_or_late and not kept and self.options.pilot is None

    @property
    def simulated(self) -> bool:
        """True if anything is simulated."""
        kept = [r for r in self.reduce.values() if r.how not in reducers.LINEAR]
        return bool(kept) or self.options.trajectories is not None


def moving_inputs_of(model: Model, flight: Flight) -> tuple[tuple[str, str], ...]:
    """Return the inputs that are not held between this flight's samples, with their holds."""
    holds = ((n, flight.hold.get(n, "zero-order")) for n in naming.names(model.Inputs))
    return tuple((n, hold) for n, hold in holds if hold != "zero-order")


def special_axes(model: Model, design: Design) -> list[str]:
    """Return the axes that are no parameters of the model."""
    return [n for n in design.names if n not in naming.names(model.Params)]


def _check_kinds(design: Any, reduce: Any) -> None:
    require_kind("design", design, Design, "a design, as heli_jax.sweeps.grid({'Ixx': [1, 2]})")
    results = "results by name, as {'rms': Reduce('rms', 'roll')}"
    require_kind("reduce", reduce, Mapping, results)
    for name, each in reduce.items():
        require_kind(f"reduce: {name}", each, Reduce, "a Reduce, as Reduce('rms', 'roll')")


def job(
    model: Model,
    params: Any,
    flights: Flight | Sequence[Flight],
    design: Design,
    reduce: Mapping[str, Reduce],
    options: RunOptions = DEFAULT,
) -> Job:
    """Check a sweep and prepare it.

    Args:
        params: the model's Params, SI; the axes of the design override them.
        flights: flights with the inputs.
        reduce: results by name.

    Raises:
        ValueError: an axis or a result that the model or the flights cannot have; an incomplete
            vehicle; an unknown solver or precision; float64 while JAX has it switched off.
        TypeError: a design or a result of another kind.
    """
    # The model first: the other checks use its names, and a wrong model would fail there far from
    # its cause.
    check_model(model)
    flights = (flights,) if isinstance(flights, Flight) else tuple(flights)
    if not flights:
        raise ValueError("flights: expected at least one, got none")
    _check_kinds(design, reduce)
    if not 1 <= design.size <= _MOST:
        raise ValueError(
            f"axes: expected a design of 1 to {_MOST:.0e} elements, got {design.size:.3g}"
        )
    _check_axes(model, design, flights)
    _check_inputs(model, flights)
    _check_results(model, design, reduce, flights, options.trajectories)
    _check_precision(model, options.precision)
    for flight in flights:
        require_sample_time(model, flight.dt)
    # The exact step of a linear model leaves no solver error in the results.
    solver = options.solver or ("exact" if model.linear else "rk4")
    if solver == "exact" and not model.linear:
        raise ValueError(f"solver: model {model.name!r} is not linear, expected rk4")
    # Checked here, so that an unknown name is refused before anything is compiled.
    solver_named(solver)
    # All flights must state it; a flight without it would be computed with NaN.
    known = set.intersection(*(set(f.known) for f in flights))
    require_constants(model, params, known.union(design.names))
    require_linear(model, params)
    trimmed = options.trimmed
    if trimmed is not None and not is_full_nonlinear(trimmed.of or model):
        raise ValueError(
            f"model {model.name!r} cannot be trimmed: it is not the full nonlinear model"
        )
    substeps = options.substeps
    if substeps is None:
        # One program serves all flights, so the slowest rate decides the number of steps.
        substeps = substeps_for(max(f.dt for f in flights), model.fastest)
    if substeps < 1:
        raise ValueError(f"substeps must be at least 1, got {substeps}")
    # Plain numbers, not arrays: they are compared with the store's JSON.
    numbers = {n: float(v) for n, v in naming.asdict(params).items()}
    checked = options._replace(solver=solver, substeps=substeps)
    return Job(model, numbers, flights, design, dict(reduce), checked)


def _check_precision(model: Model, precision: str) -> None:
    if precision not in ("float64", "float32"):
        raise ValueError(f"precision: expected float64 or float32, got {precision!r}")
    # Otherwise JAX would silently compute in float32.
    if precision == "float64" and not jax.config.jax_enable_x64:  # pyright: ignore
        raise ValueError(
            "precision: float64 is switched off in JAX, expected "
            "jax.config.update('jax_enable_x64', True), or precision='float32'"
        )
    if precision == "float32":
        _check_single(model)


def _check_single(model: Model) -> None:
    """Refuse a model that converts float32 to float64, for example by a NumPy table.

    The type of the carried state would change from one sample to the next.
    """

    def computed(p: Any, s: Any, u: Any) -> tuple[dict[str, Any], dict[str, Any]]:
        arguments = model.Params(**p), model.State(**s), model.Inputs(**u)
        results = model.vector_field(*arguments), model.output(*arguments)
        return naming.asdict(results[0]), naming.asdict(results[1])

    single = jax.ShapeDtypeStruct((), np.float32)
    classes = (model.Params, model.State, model.Inputs)
    results = jax.eval_shape(computed, *(dict.fromkeys(naming.names(c), single) for c in classes))
    for function, values in zip(("vector_field", "output"), results, strict=True):
        for name, value in values.items():
            if value.dtype == np.float64:
                raise ValueError(
                    f"precision: the {function} of model {model.name!r} returns {name} in float64 "
                    "although all its arguments are float32; expected float64, or its arrays "
                    "made as jnp.asarray(table, x.dtype), x a state"
                )


def _check_axes(model: Model, design: Design, flights: tuple[Flight, ...]) -> None:
    params = naming.names(model.Params)
    states, inputs = naming.names(model.State), naming.names(model.Inputs)
    special = {f"initial.{n}" for n in states}
    special |= {f"{kind}.{n}" for kind in ("gain", "offset") for n in inputs}
    special |= {"delay", "seed"}
    for name in design.names:
        if name in params:
            for flight in flights:
                if name in flight.known:
                    # The axis would silently override the flight's known value.
                    raise ValueError(
                        f"axes.{name}: the flight {flight.name!r} states it as known, expected "
                        "either"
                    )
        elif name not in special:
            # 'gain.x_rol' is a slip in the input's name, so no parameter is suggested.
            kind = name.partition(".")[0]
            among = [n for n in special if n.startswith(f"{kind}.")] or [*params, *special]
            raise ValueError(
                f"axes.{name}: model {model.name} has no parameter or input of that "
                f"name{nearest(name, among)}"
            )
    # A model's own parameter of this name is an axis like any other.
    if "seed" in design.names and "seed" not in params:
        if model.noise_intensity is None:
            raise ValueError(
                f"axes.seed: model {model.name} has no random part, expected a disturbance"
            )
        if "delay" in design.names and "delay" not in params:
            raise ValueError(
                "axes.seed: noise cannot be drawn with an axis delay, expected one of the two"
            )
        whole_seeds(design.values(0, min(design.size, _LOOKED_AT))["seed"])


def _check_inputs(model: Model, flights: tuple[Flight, ...]) -> None:
    for flight in flights:
        for name in naming.names(model.Inputs):
            if name not in flight.inputs:
                raise ValueError(
                    f"flight {flight.name!r} has no input {name!r}, which {model.name} needs"
                )
        # One sample has no step, so there is nothing to simulate.
        if flight.n_samples < 2:
            raise ValueError(f"flight {flight.name!r}: expected at least two samples, got one")


def _check_results(
    model: Model,
    design: Design,
    reduce: Mapping[str, Reduce],
    flights: tuple[Flight, ...],
    trajectories: Trajectories | None,
) -> None:
    outputs, inputs = naming.names(model.Outputs), naming.names(model.Inputs)
    if not reduce and trajectories is None:
        raise ValueError("reduce: no result is kept, expected a result or trajectories")
    for name, reducer in reduce.items():
        reducers.check(name, reducer, outputs, inputs)
        if reducer.how in reducers.LINEAR:
            require_continuous(model, f"reduce.{name}")
        # Reserved names of the store; names that its format cannot have are refused where it is
        # created.
        if name in design.names or name in ("status", "element"):
            raise ValueError(f"reduce.{name}: the name exists already, expected another")
        stream = reducers.streaming(reducer)
        signal = str(reducer.signal)
        for flight in flights if stream is not None and stream.against_flight else ():
            if signal not in flight.outputs:
                raise ValueError(
                    f"reduce.{name}: flight {flight.name!r} did not measure "
                    f"{signal!r}{nearest(signal, flight.outputs)}"
                )
    if trajectories is not None:
        _check_trajectories(trajectories, outputs, flights)


def _check_trajectories(
    trajectories: Trajectories, outputs: tuple[str, ...], flights: tuple[Flight, ...]
) -> None:
    if not trajectories.signals:
        raise ValueError("trajectories.signals: none given, expected at least one")
    for signal in trajectories.signals:
        if signal not in outputs:
            raise ValueError(
                f"trajectories.signals: the model has no output {signal!r}"
                f"{nearest(signal, outputs)}"
            )
    if trajectories.every < 1:
        raise ValueError(f"trajectories.every must be at least 1, got {trajectories.every}")
    # They share the store's dimension `time`, which has one step and one length.
    if len({(f.dt, f.n_samples) for f in flights}) > 1:
        raise ValueError(
            "trajectories: the flights differ in rate or length, expected flights of one grid"
        )


def axis_unit(model: Model, name: str) -> str | None:
    """Return the SI unit of an axis; None for a seed or an unknown axis."""
    kind, _, of = name.partition(".")
    if name in naming.names(model.Params):
        return naming.unit(model.Params, name)
    if kind == "initial" and of in naming.names(model.State):
        return naming.unit(model.State, of)
    if kind == "offset" and of in naming.names(model.Inputs):
        return naming.unit(model.Inputs, of)
    return {"delay": "s", "gain": "1"}.get(kind)


def unread(job: Job) -> list[str]:
    """Return the axes that are parameters the model does not read.

    They are found at one point of the states and inputs. A model that reads a parameter only
    elsewhere is reported by mistake.
    """
    model = job.model
    params = model.Params(**job.params)
    axes = [n for n in job.design.names if n in naming.names(model.Params)]
    # Only the noise reads the size of a disturbance, and only if noise is drawn.
    drawn = model.noise_intensity if "seed" in job.design.names else None

    def read_elsewhere(name: str) -> bool:
        # NaN propagates to everything that reads the parameter.
        missing = plain(params, **{name: np.nan})
        with np.errstate(all="ignore"):
            parts = (model.initial_state(missing), None if drawn is None else drawn(missing))
        return any(bool(np.isnan(float(v))) for v in jax.tree.leaves(parts))

    return [n for n in axes if not reads(model, params, n) and not read_elsewhere(n)]
