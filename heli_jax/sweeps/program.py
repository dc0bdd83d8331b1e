"""Compiled part of a sweep: `design_point` over the elements of a chunk, on all devices."""

# `Any` below: a tree of arrays that JAX maps over, the functions that it compiles, and its devices,
# whose class type checkers reject.

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from jax.sharding import PartitionSpec

from heli_jax import naming
from heli_jax.sweeps.design_point import (
    ElementResults,
    FlightNumbers,
    InitialTrim,
    Scalars,
    design_point,
    flight_numbers,
    steady,
)
from heli_jax.sweeps.spec import Job, Plan

# XLA uses 256 bits by default, but parallel elements gain from the widest vectors: 1.5 times as
# fast for the roll model, 64 lanes, two cores. Without AVX-512 nothing changes.
_CPU_OPTIONS = {"xla_cpu_prefer_vector_width": 512}


def arguments(job: Job, columns: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the axes' values in the form for the compiled part."""
    dtype = np.dtype(job.options.precision)
    # A seed in float32 would lose its last digits beyond 2^24. A NaN seed gets some number, and its
    # element is flagged afterwards.
    whole = {"seed"} - set(naming.names(job.model.Params))
    return {
        n: np.nan_to_num(v).astype(np.uint32) if n in whole else v.astype(dtype)
        for n, v in columns.items()
    }


def shapes(job: Job, index: int) -> ElementResults:
    """Return the shapes of the results of `design_point` for one of the job's flights."""
    columns = arguments(job, job.design.values(0, 1))
    example = (flight_numbers(job, index), {n: v[0] for n, v in columns.items()})
    leaves, structure = jax.tree.flatten(example)
    # Arrays cannot be a cache key; their shapes can.
    return _shapes(job.plan(index), structure, tuple((v.shape, v.dtype) for v in leaves))


@functools.lru_cache(maxsize=32)
def _shapes(
    plan: Plan, structure: Any, leaves: tuple[tuple[tuple[int, ...], np.dtype], ...]
) -> ElementResults:
    numbers, values = jax.tree.unflatten(structure, [jax.ShapeDtypeStruct(*v) for v in leaves])
    trim = None
    if plan.options.trimmed is not None:
        trim = jax.eval_shape(functools.partial(steady, plan), numbers, values)
    return jax.eval_shape(functools.partial(design_point, plan), numbers, values, trim)


@functools.lru_cache(maxsize=32)
def _compiled(plan: Plan, devices: tuple[Any, ...], lanes: int) -> tuple[Any, Any, Any]:
    """Return the functions for steady flights and elements, and the sharding of mapped arrays."""
    # Cached, because every flight of a sweep and every sweep of the same plan uses it.
    run, split = spread(functools.partial(design_point, plan), devices, lanes)
    return trims_of(plan, lanes), run, split


def trims_of(plan: Plan, lanes: int) -> Any:
    """Return the function that computes the elements' initial steady flights; None without them.

    Its arguments are the numbers and the values of the axes.
    """

    def starts(numbers: FlightNumbers, values: Scalars) -> InitialTrim:
        return _batched(functools.partial(steady, plan, numbers), values, lanes)

    # Separate, because lineax does not work within shard_map.
    return None if plan.options.trimmed is None else jax.jit(starts)


def spread(
    function: Callable[..., Any], devices: tuple[Any, ...], lanes: int
) -> tuple[Any, jax.sharding.NamedSharding]:
    """Compile a function of elements for many of them.

    Args:
        function: function of the numbers of a flight and of an element's own data.
        devices: devices of JAX.
        lanes: batch size.

    Returns:
        The function of the numbers and of a tuple of arrays with one row per element, and the
        sharding of those rows.
    """
    mesh = jax.sharding.Mesh(np.asarray(devices), ("device",))
    split = PartitionSpec("device")

    def part(numbers: FlightNumbers, mapped: Any) -> Any:
        return _batched(lambda m: function(numbers, *m), mapped, lanes)

    options = _CPU_OPTIONS if devices[0].platform == "cpu" else None
    # Each device runs the program of its own part alone, so the number of devices changes no digit.
    # With a jit over sharded arrays, XLA would decide the division.
    run = jax.jit(
        jax.shard_map(
            part, mesh=mesh, in_specs=(PartitionSpec(), split), out_specs=split, check_vma=False
        ),
        compiler_options=options,
    )
    return run, jax.sharding.NamedSharding(mesh, split)


class Program:
    """Compiled part for one flight on some devices; a chunk is divided among them."""

    def __init__(self, job: Job, index: int, devices: Sequence[Any], lanes: int) -> None:
        self._step = lanes * len(devices)
        self._numbers = flight_numbers(job, index)
        self._trims, self._run, self._split = _compiled(job.plan(index), tuple(devices), lanes)

    def __call__(self, values: dict[str, np.ndarray], size: int) -> ElementResults:
        """Start to compute a chunk of values (k,), padded to `size` elements.

        It returns arrays (size,) that JAX may still be computing.
        """
        filled = filled_up(values, size, self._step)
        trims = None if self._trims is None else self._trims(self._numbers, filled)
        return self._run(self._numbers, jax.device_put((filled, trims), self._split))


def filled_up(values: dict[str, np.ndarray], size: int, step: int) -> dict[str, np.ndarray]:
    """Pad the values of a chunk to whole steps."""
    # The last chunk is padded with its last element. A program of its own size would be compiled
    # for it alone, and might give other digits.
    size = -(-size // step) * step
    return {n: np.pad(v, (0, size - v.size), mode="edge") for n, v in values.items()}


def _batched(function: Callable[[Any], Any], mapped: Any, lanes: int) -> Any:
    """Apply a function to each row of the mapped arrays, `lanes` rows in parallel."""
    if jax.tree.leaves(mapped)[0].shape[0] <= lanes:
        return jax.vmap(function)(mapped)
    return jax.lax.map(function, mapped, batch_size=lanes)
