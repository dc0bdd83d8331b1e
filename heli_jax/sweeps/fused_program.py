"""Chunks whose runs are one program of machine code, with XLA before and after it."""

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from heli_jax.fused.code import UnsupportedError, translating
from heli_jax.fused.kernel import Kernel, lanes_for
from heli_jax.fused.traced import Traced, traced
from heli_jax.simulation.accumulate import Steps
from heli_jax.sweeps.design_point import (
    ElementResults,
    FlightNumbers,
    Scalars,
    flight_numbers,
    of_steps,
    steady,
    steps_of,
)
from heli_jax.sweeps.program import arguments, filled_up, spread, trims_of
from heli_jax.sweeps.spec import Job, Plan

_SOLVERS = ("exact", "rk4", "Euler")
"""Solvers with a translation; other solvers of diffrax use operations of their own."""

# `Any` below: trees of arrays, jaxprs, the functions that JAX compiles and its devices.


class _Parts(NamedTuple):
    """A plan's program for flights of one shape."""

    kernel: Kernel
    run: Traced
    begin: Any
    """Function of (numbers, (values, trim)): initial values of an element, `Traced.own`."""
    common: Any
    """Function of (numbers, values, trim) of any element: constants common to all."""
    conclude: Any
    """Function of (numbers, (values, trim, reduced)): the results."""
    split: Any
    trims: Any


def refusal(job: Job, devices: Sequence[Any], lanes: int) -> str | None:
    """Return why the job's runs cannot be fused; None if they can."""
    if devices[0].platform != "cpu":
        return "it is for CPUs alone"
    if not job.streamed or not job.simulated:
        return "its runs are kept whole, or none is made"
    if job.options.solver not in _SOLVERS:
        return f"the solver {job.options.solver} cannot be translated"
    try:
        # The compiled program is cached for the sweep that follows.
        for index in range(len(job.flights)):
            FusedProgram(job, index, devices, lanes)
    except UnsupportedError as e:
        return f"{e} cannot be translated"
    return None


class FusedProgram:
    """Compiled part for one flight; a chunk is divided among threads, one per device."""

    def __init__(self, job: Job, index: int, devices: Sequence[Any], lanes: int) -> None:
        plan, numbers, values, trim = _example(job, index)
        self._numbers, self._threads = numbers, len(devices)
        leaves, structure = jax.tree.flatten((numbers, values, trim))
        kinds = tuple((np.shape(v), np.asarray(v).dtype) for v in leaves)
        self._parts = _compiled(plan, structure, kinds, tuple(devices), lanes)
        # Whole blocks of the kernel too; both are powers of two, unless lanes were requested.
        self._step = int(np.lcm(lanes * len(devices), self._parts.kernel.lanes))

    def __call__(self, values: dict[str, np.ndarray], size: int) -> ElementResults:
        """Compute a chunk of values (k,), padded to `size` elements; arrays (size,)."""
        parts, numbers = self._parts, self._numbers
        filled = filled_up(values, size, self._step)
        trims = None if parts.trims is None else parts.trims(numbers, filled)
        mapped = jax.device_put((filled, trims), parts.split)
        begun = parts.begin(numbers, mapped)
        first = jax.tree.map(lambda v: v[0], (filled, trims))
        common = parts.common(numbers, *first)
        reduced = parts.run.compute(parts.kernel, begun, common, _records(numbers), self._threads)
        return parts.conclude(numbers, (*mapped, jax.device_put(reduced, parts.split)))


def _records(numbers: FlightNumbers) -> Any:
    """Return the parts of a flight that are read sample by sample, arrays (N,)."""
    return numbers.inputs, {n: (m.values, m.seen) for n, m in numbers.measured.items()}


def _with(numbers: FlightNumbers, records: Any) -> FlightNumbers:
    inputs, seen = records
    measured = {
        n: m._replace(values=seen[n][0], seen=seen[n][1]) for n, m in numbers.measured.items()
    }
    return numbers._replace(inputs=inputs, measured=measured)


def _without(numbers: FlightNumbers) -> FlightNumbers:
    """Return the numbers of a flight without its records."""
    return _with(numbers, (None, dict.fromkeys(numbers.measured, (None, None))))


def _example(job: Job, index: int) -> tuple[Plan, FlightNumbers, Scalars, Any]:
    """Return the numbers of one element."""
    plan, numbers = job.plan(index), flight_numbers(job, index)
    values = {n: v[0] for n, v in arguments(job, job.design.values(0, 1)).items()}
    trim = None
    if plan.options.trimmed is not None:
        shape = jax.eval_shape(functools.partial(steady, plan), numbers, values)
        trim = jax.tree.map(lambda v: np.zeros(v.shape, v.dtype), shape)
    return plan, numbers, values, trim


def _traced(plan: Plan, numbers: FlightNumbers, values: Scalars, trim: Any) -> Traced:
    def making(bare: FlightNumbers, records: Any, element: Any) -> Steps:
        return steps_of(plan, _with(bare, records), *element)

    return traced(making, _without(numbers), _records(numbers), (values, trim))


@functools.lru_cache(maxsize=32)
@translating()
def _compiled(
    plan: Plan,
    structure: Any,
    kinds: tuple[tuple[tuple[int, ...], np.dtype], ...],
    devices: tuple[Any, ...],
    lanes: int,
) -> _Parts:
    """Compile the program; cached as in `program`."""
    example = jax.tree.unflatten(structure, [np.zeros(*kind) for kind in kinds])
    run = _traced(plan, *example)

    def own(numbers: FlightNumbers, *element: Any) -> Any:
        return run.own(_without(numbers), _records(numbers), element)

    @jax.jit
    def common(numbers: FlightNumbers, *element: Any) -> Any:
        return run.common(_without(numbers), _records(numbers), element)

    before, split = spread(own, devices, lanes)
    conclude, _ = spread(functools.partial(of_steps, plan), devices, lanes)
    kernel = Kernel(
        run.run, lanes_for(np.dtype(plan.options.precision), plan.options.solver == "exact")
    )
    return _Parts(kernel, run, before, common, conclude, split, trims_of(plan, lanes))
