"""The compiled part of a sweep: values of the axes in, results and status of each element out."""

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import PartitionSpec

from heli_jax import naming
from heli_jax.analysis.trim import STICKS, equilibrium, plausible
from heli_jax.dynamics.jacobians import jacobians
from heli_jax.simulation.accumulate import accumulated
from heli_jax.simulation.simulate import simulate
from heli_jax.simulation.trajectory import Trajectory
from heli_jax.sweeps import reducers
from heli_jax.sweeps.reducers import Measured, Reduce
from heli_jax.sweeps.spec import Job, Plan

OK, DIVERGED, OUT_OF_RANGE, NOT_RUN = 0, 1, 2, 255
MEANINGS = {OK: "ok", DIVERGED: "diverged", OUT_OF_RANGE: "out_of_range", NOT_RUN: "not_run"}
"""The status of an element. Diverged: a state or an axis is not finite, or a state is beyond
`RUNAWAY`. Out of range: a parameter no helicopter can have, the model's range was left, or there is
no steady flight to begin with."""

RUNAWAY = 1e12
"""Where a state [SI] no longer is that of a helicopter."""

_BLOCK = 4
_TRIMMED = 1e-6
_CPU_OPTIONS = {"xla_cpu_prefer_vector_width": 512}
"""XLA stays at 256 bits unless told, where elements side by side gain most from the widest vectors
there are: roll model, 64 lanes, two cores: 1.5 times as fast. Without AVX-512 nothing changes."""


class Given(NamedTuple):
    """The numbers of a flight and of the vehicle, in the sweep's precision."""

    base: dict[str, Any]
    dt: Any
    inputs: Any
    known: dict[str, Any]
    measured: dict[str, Measured]
    """by result, of those that compare with the flight"""
    pilot: Any


class Found(NamedTuple):
    """What the compiled part gives for an element."""

    results: dict[str, Any]
    trajectories: dict[str, Any]
    matrices: Any
    """the linearisation where the run begins, if a result needs it"""
    status: Any


def given(job: Job, index: int) -> Given:
    """The numbers of one of the job's flights."""
    dtype, flight, model = np.dtype(job.precision), job.flights[index], job.model
    inputs = {n: flight.inputs[n].astype(dtype) for n in naming.names(model.Inputs)}
    against = {
        name: reducers.measured(flight.outputs[str(r.signal)], dtype)
        for name, r in job.reduce.items()
        if (s := reducers.streaming(r)) is not None and s.against_flight
    }
    return Given(
        {n: np.asarray(v, dtype) for n, v in job.params.items()},
        np.asarray(flight.dt, dtype),
        model.Inputs(**inputs),
        {n: np.asarray(v, dtype) for n, v in flight.known.items()},
        against,
        jax.tree.map(lambda v: np.asarray(v, dtype), job.pilot),
    )


class Start(NamedTuple):
    """The steady flight that an element begins in."""

    state: Any
    sticks: Any
    """the model's Inputs, added to the flight's"""
    sound: Any
    """whether there is such a flight"""


def design_point(plan: Plan, numbers: Given, values: dict[str, Any], start: Start | None) -> Found:
    """One element: the axes' values are scalars."""
    model, dtype = plan.model, numbers.dt.dtype
    params, moved = _params(plan, numbers, values)
    status = jnp.asarray(OK)
    inputs = numbers.inputs
    if start is None:
        state = jax.tree.map(lambda v: jnp.asarray(v, dtype), model.initial_state(params))
    else:
        # Without a steady flight there is no run: what would come of it is no result.
        state = jax.tree.map(lambda v: jnp.where(start.sound, v, jnp.nan), start.state)
        inputs = jax.tree.map(lambda u, stick: u + stick, inputs, start.sticks)
    state = naming.replace(
        state,
        **{n.removeprefix("initial."): v for n, v in moved.items() if n.startswith("initial.")},
    )
    inputs = _moved(inputs, moved)
    if start is not None and numbers.pilot is not None:
        # The gains are those for the vehicle as it is given, the flight is this one's own.
        numbers = numbers._replace(pilot=numbers.pilot._replace(trimmed=start.state))
    results: dict[str, Any] = {}
    kept: dict[str, Any] = {}
    if plan.simulated:
        if plan.streamed:
            run = _streamed(plan, numbers, params, state, inputs)
        else:
            run = _whole(plan, numbers, params, state, inputs, moved)
        results, kept, last, outside = run
        for left in outside:
            status = jnp.where(left, OUT_OF_RANGE, status)
        sound = jnp.stack([jnp.abs(v) < RUNAWAY for v in jax.tree.leaves(last)])
        status = jnp.where(jnp.all(sound), status, DIVERGED)
    if start is not None:
        status = jnp.where(start.sound, status, OUT_OF_RANGE)
    matrices = None
    if any(r.how in reducers.LINEAR for _, r in plan.reduce):
        at_start = jax.tree.map(lambda u: u[0], inputs)
        matrices = jacobians(model, params, state, at_start)
    results = {n: jnp.asarray(v, dtype) for n, v in results.items()}
    return Found(results, kept, matrices, status.astype(np.uint8))


def _params(plan: Plan, numbers: Given, values: dict[str, Any]) -> tuple[Any, dict[str, Any]]:
    """The element's parameters, and the axes that are not among them."""
    own = naming.names(plan.model.Params)
    swept = {n: v for n, v in values.items() if n in own}
    params = plan.model.Params(**{**numbers.base, **numbers.known, **swept})
    return params, {n: v for n, v in values.items() if n not in own}


def steady(plan: Plan, numbers: Given, values: dict[str, Any]) -> Start:
    """The steady flight of one element: in the default precision, whatever the sweep's."""
    assert plan.trimmed is not None
    whole, dtype = plan.trimmed.of or plan.model, numbers.dt.dtype
    params, _ = _params(plan, numbers, values)
    plain = whole.Params(**{n: getattr(params, n) for n in naming.names(whole.Params)})
    plain, condition, wind = jax.tree.map(
        lambda v: jnp.asarray(v, jnp.result_type(float)),
        (plain, plan.trimmed.condition, tuple(plan.trimmed.wind)),
    )
    found = equilibrium(whole, plain, condition, wind)
    sound = plausible(found) & (found.residual < _TRIMMED)
    for name, (low, high) in STICKS.items():
        stick = getattr(found.inputs, name)
        sound = sound & (stick >= low) & (stick <= high)
    state = naming.replace(plan.model.initial_state(params), **naming.asdict(found.state))
    share = 1.0 if plan.trimmed.sticks else 0.0
    sticks = jax.tree.map(lambda v: jnp.asarray(share * v, dtype), found.inputs)
    return Start(jax.tree.map(lambda v: jnp.asarray(v, dtype), state), sticks, sound)


def _moved(inputs: Any, values: dict[str, Any]) -> Any:
    """The inputs of this element: the flight's times a gain, and an offset."""
    changed = {}
    for name, u in naming.asdict(inputs).items():
        gain, offset = values.get(f"gain.{name}"), values.get(f"offset.{name}")
        u = u if gain is None else gain * u
        changed[name] = u if offset is None else u + offset
    return type(inputs)(**changed)


def _updating(plan: Plan, numbers: Given) -> tuple[Any, dict[str, Any], dict[str, Any]]:
    """What all streaming reducers do at a sample, their start, and what they need of it."""
    dtype = numbers.dt.dtype
    reduce = dict(plan.reduce)
    streams = {n: s for n, r in plan.reduce if (s := reducers.streaming(r)) is not None}
    start = {n: jax.tree.map(lambda v: jnp.asarray(v, dtype), s.start) for n, s in streams.items()}
    data = {n: (m.values, m.seen) for n, m in numbers.measured.items()}

    def update(value: dict[str, Any], outputs: Any, now: dict[str, Any]) -> dict[str, Any]:
        found = {}
        for name, stream in streams.items():
            measured = None
            if name in now:
                measured = numbers.measured[name]._replace(values=now[name][0], seen=now[name][1])
            found[name] = stream.update(value[name], _signal(reduce[name], outputs), measured)
        return found

    return update, start, data


def _signal(one: Reduce, outputs: Any) -> Any:
    return outputs if one.signal is None else getattr(outputs, one.signal)


def _finished(plan: Plan, numbers: Given, value: dict[str, Any], n: int) -> dict[str, Any]:
    found: dict[str, Any] = {}
    count = jnp.asarray(n, numbers.dt.dtype)
    for name, one in plan.reduce:
        stream = reducers.streaming(one)
        if stream is not None:
            result = stream.finish(value[name], count, numbers.measured.get(name))
            found |= _named(name, result)
    return found


def _own(name: str, how: Callable[[Trajectory], Any], run: Trajectory) -> dict[str, Any]:
    """What one's own function of a run gives, by name.

    Raises:
        ValueError: it fails, or gives no real number.
    """
    called = getattr(how, "__qualname__", str(how))
    try:
        given = how(run)
        found = {n: jnp.asarray(v) for n, v in _named(name, given).items()}
    except Exception as e:
        # JAX's own sentences go on for pages.
        first = str(e).partition("\n")[0]
        raise ValueError(
            f"reduce.{name}: {called} cannot be computed ({type(e).__name__}: {first:.200}), "
            "expected a function of a Trajectory, of jax.numpy and without branches on its "
            "values, that gives a number or numbers by name"
        ) from e
    for n, v in found.items():
        if not (jnp.issubdtype(v.dtype, jnp.number) or v.dtype == jnp.bool_) or (
            jnp.issubdtype(v.dtype, jnp.complexfloating)
        ):
            raise ValueError(
                f"reduce.{name}: {called} gives {n} as {v.dtype}, expected a real number"
            )
    return found


def _named(name: str, result: Any) -> dict[str, Any]:
    """A result by name; several of one function by name and key."""
    if isinstance(result, dict):
        return {f"{name}_{key}": v for key, v in result.items()}
    return {name: result}


def _streamed(
    plan: Plan, numbers: Given, params: Any, state: Any, inputs: Any
) -> tuple[dict[str, Any], dict[str, Any], Any, list[Any]]:
    """The run reduced while it goes on."""
    update, start, data = _updating(plan, numbers)
    options = plan.simulation(
        dt=numbers.dt, initial_state=state, block=_BLOCK if plan.solver == "exact" else 1
    )
    found = accumulated(
        plan.model,
        params,
        inputs,
        update,
        start,
        data=data,
        limits=True,
        options=options,
    )
    n = jax.tree.leaves(inputs)[0].shape[0]
    return _finished(plan, numbers, found.value, n), {}, found.state, list(found.outside.values())


def _whole(
    plan: Plan, numbers: Given, params: Any, state: Any, inputs: Any, moved: dict[str, Any]
) -> tuple[dict[str, Any], dict[str, Any], Any, list[Any]]:
    """The whole run, for functions of it and for trajectories to keep."""
    options = plan.simulation(
        dt=numbers.dt,
        initial_state=state,
        delay=moved.get("delay"),
        key=jax.random.key(moved["seed"]) if "seed" in moved else None,
        feedback=numbers.pilot,
    )
    run: Trajectory = simulate(plan.model, params, inputs, options)
    update, start, data = _updating(plan, numbers)
    value, _ = jax.lax.scan(lambda v, now: (update(v, *now), None), start, (run.outputs, data))
    n = run.times.shape[0]
    results = _finished(plan, numbers, value, n)
    for name, one in plan.reduce:
        if callable(one.how) and reducers.streaming(one) is None:
            results |= _own(name, one.how, run)
    kept = {}
    if plan.trajectories is not None:
        every = plan.trajectories.every
        kept = {n: getattr(run.outputs, n)[::every] for n in plan.trajectories.signals}
    last = jax.tree.map(lambda v: v[-1], run.states)
    return results, kept, last, [jnp.any(out) for out in run.outside.values()]


def arguments(job: Job, columns: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The axes' values as the compiled part takes them."""
    dtype = np.dtype(job.precision)
    whole = {"seed"} - set(naming.names(job.model.Params))
    return {
        n: np.nan_to_num(v).astype(np.uint32) if n in whole else v.astype(dtype)
        for n, v in columns.items()
    }


def shapes(job: Job, index: int) -> Found:
    """The shapes of what `design_point` gives."""
    columns = arguments(job, job.design.values(0, 1))
    taken = (given(job, index), {n: v[0] for n, v in columns.items()})
    leaves, structure = jax.tree.flatten(taken)
    return _shapes(job.plan(index), structure, tuple((v.shape, v.dtype) for v in leaves))


@functools.lru_cache(maxsize=32)
def _shapes(plan: Plan, structure: Any, leaves: tuple[Any, ...]) -> Found:
    numbers, values = jax.tree.unflatten(structure, [jax.ShapeDtypeStruct(*v) for v in leaves])
    start = None
    if plan.trimmed is not None:
        start = jax.eval_shape(functools.partial(steady, plan), numbers, values)
    return jax.eval_shape(functools.partial(design_point, plan), numbers, values, start)


@functools.lru_cache(maxsize=32)
def _compiled(plan: Plan, devices: tuple[Any, ...], lanes: int) -> tuple[Any, Any, Any]:
    """The functions that compute steady flights and elements on some devices, and how what is
    mapped is shared among these."""
    mesh = jax.sharding.Mesh(np.asarray(devices), ("device",))
    split = PartitionSpec("device")

    def part(numbers: Given, mapped: Any) -> Found:
        return _each(lambda m: design_point(plan, numbers, *m), mapped, lanes)

    def starts(numbers: Given, values: dict[str, Any]) -> Start:
        return _each(functools.partial(steady, plan, numbers), values, lanes)

    options = _CPU_OPTIONS if devices[0].platform == "cpu" else None
    run = jax.jit(
        jax.shard_map(
            part, mesh=mesh, in_specs=(PartitionSpec(), split), out_specs=split, check_vma=False
        ),
        compiler_options=options,
    )
    # Apart, since lineax does not work within shard_map.
    before = None if plan.trimmed is None else jax.jit(starts)
    return before, run, jax.sharding.NamedSharding(mesh, split)


class Program:
    """The compiled part for one flight on some devices; a chunk is cut among them."""

    def __init__(self, job: Job, index: int, devices: Sequence[Any], lanes: int) -> None:
        self._step = lanes * len(devices)
        self._numbers = given(job, index)
        self._starts, self._run, self._split = _compiled(job.plan(index), tuple(devices), lanes)

    def __call__(self, values: dict[str, np.ndarray], size: int) -> Found:
        """Begin to compute a chunk of values (k,), filled up to `size` elements; arrays (size,)
        that JAX may still be computing."""
        size = -(-size // self._step) * self._step
        filled = {n: np.pad(v, (0, size - v.size), mode="edge") for n, v in values.items()}
        start = None if self._starts is None else self._starts(self._numbers, filled)
        return self._run(self._numbers, jax.device_put((filled, start), self._split))


def _each(one: Callable[[Any], Any], mapped: Any, lanes: int) -> Any:
    """One after another of what is mapped, `lanes` side by side."""
    if jax.tree.leaves(mapped)[0].shape[0] <= lanes:
        return jax.vmap(one)(mapped)
    return jax.lax.map(one, mapped, batch_size=lanes)
