"""A chunk whose runs are one program of machine code, with XLA before and behind it."""

import functools
import importlib.util
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend import core

from heli_jax.fused.code import UnsupportedError
from heli_jax.fused.cuda_driver import CudaError, Gpu
from heli_jax.fused.gpu_kernel import GpuKernel
from heli_jax.fused.kernel import Kernel, lanes_for
from heli_jax.fused.program import Argument, Run
from heli_jax.numerics.hoist import hoisted
from heli_jax.sweeps.design_point import ElementResults, of_samples, samples_of
from heli_jax.sweeps.flight_numbers import (
    FlightNumbers,
    InitialTrim,
    Scalars,
    flight_numbers,
    steady,
)
from heli_jax.sweeps.program import arguments, filled_up, spread, trims_of
from heli_jax.sweeps.spec import Job, Plan

_NVIDIA = ("gpu", "cuda")
_COMPARED = 32
"""elements that a GPU and the processor both compute, before the GPU is believed"""

# `Any` below: trees of arrays, jaxprs, the functions that JAX compiles and its devices.


class _Parts(NamedTuple):
    """A plan's program for flights of one shape."""

    kernel: Kernel | GpuKernel
    begin: Any
    """of (numbers, (values, trim)): what is carried before the first sample, and what stays"""
    shared: Any
    """of (numbers, values, trim) of any element: what stays and is the same for all"""
    conclude: Any
    """of (numbers, (values, trim, reduced)): the results"""
    split: Any
    trims: Any
    varies: tuple[bool, ...]
    """of what stays"""
    reduced: Any
    """the structure of what the kernel gives"""


def refusal(job: Job, devices: Sequence[Any], lanes: int) -> str | None:
    """Why the job's runs cannot be one program each; None where they can.

    Args:
        job: the sweep.
        devices: of JAX, that would compute it.
        lanes: as a program takes it.
    """
    on_gpu = devices[0].platform != "cpu"
    if on_gpu and (devices[0].platform not in _NVIDIA or len(devices) > 1):
        return "it is for CPUs, or for one GPU of NVIDIA's"
    if not job.streamed or not job.simulated:
        return "its runs are kept whole, or none is made"
    if on_gpu and not _has_processor():
        return "JAX_PLATFORMS leaves no processor to compare a GPU's numbers with"
    if importlib.util.find_spec("llvmlite") is None:
        return "llvmlite is not installed"
    try:
        # What it compiles is remembered, for the sweep that follows.
        for index in range(len(job.flights)):
            program = FusedProgram(job, index, devices, lanes)
            if on_gpu and not _agrees(job, index, program):
                return "the GPU gives other numbers than the processor"
    except UnsupportedError as e:
        return f"there is no translation of {e}"
    except CudaError as e:
        return str(e)
    return None


def _has_processor() -> bool:
    try:
        return len(jax.devices("cpu")) > 0
    except RuntimeError:
        return False


def run_of(job: Job, index: int) -> Run:
    """What the program of one of the job's flights is translated from.

    Raises:
        UnsupportedError: a part of it has no translation.
    """
    return _traced(*_example(job, index)).run


def _agrees(job: Job, index: int, program: "FusedProgram") -> bool:
    """Whether a GPU gives what the processor gives, for a few elements.

    The driver compiles the program, and JAX knows nothing of it: a wrong number would be seen by
    nobody.
    """
    count = min(_COMPARED, job.design.size)
    values = arguments(job, job.design.values(0, count))
    here = FusedProgram(job, index, jax.devices("cpu")[:1], count)
    own, expected = (
        [np.asarray(v)[:count] for v in jax.tree.leaves(p(values, count))] for p in (program, here)
    )
    tolerance = np.sqrt(np.finfo(job.precision).eps)
    close = [
        np.isclose(a, b, tolerance, tolerance * np.nanmax(np.abs(b), initial=0.0), equal_nan=True)
        for a, b in zip(own, expected, strict=True)
    ]
    # Of most: a run that leaves its steady flight by itself magnifies any rounding.
    return all(np.mean(c) >= 0.5 for c in close)


class FusedProgram:
    """The compiled part for one flight; a chunk is cut among threads, as many as devices."""

    def __init__(self, job: Job, index: int, devices: Sequence[Any], lanes: int) -> None:
        plan, numbers, values, trim = _example(job, index)
        self._numbers, self._threads = numbers, len(devices)
        self._on_gpu = devices[0].platform != "cpu"
        leaves, structure = jax.tree.flatten((numbers, values, trim))
        kinds = tuple((np.shape(v), np.asarray(v).dtype) for v in leaves)
        self._parts = _compiled(plan, structure, kinds, tuple(devices), lanes)
        # Whole blocks of the kernel too: both are powers of two, unless lanes were asked for.
        self._step = int(np.lcm(lanes * len(devices), self._parts.kernel.lanes))

    def __call__(self, values: dict[str, np.ndarray], size: int) -> ElementResults:
        """A chunk of values (k,), filled up to `size` elements; arrays (size,)."""
        parts, numbers = self._parts, self._numbers
        filled = filled_up(values, size, self._step)
        trims = None if parts.trims is None else parts.trims(numbers, filled)
        mapped = jax.device_put((filled, trims), parts.split)
        carry, own = parts.begin(numbers, mapped)
        first = jax.tree.map(lambda v: v[0], (filled, trims))
        shared = iter(parts.shared(numbers, *first))
        carry, own = _rows((carry, own)) if self._on_gpu else _rows_here((carry, own))
        own = iter(own)
        stays = [next(own) if v else next(shared) for v in parts.varies]
        results = self._run(stays, jax.tree.leaves(_records(numbers)), carry)
        reduced = jax.tree.unflatten(parts.reduced, results)
        return parts.conclude(numbers, (*mapped, jax.device_put(reduced, parts.split)))

    def _run(self, stays: Any, stored: Any, carry: Any) -> Any:
        kernel = self._parts.kernel
        if isinstance(kernel, GpuKernel):
            return kernel(stays, stored, carry)
        stays, stored, carry = ([np.asarray(v) for v in p] for p in (stays, stored, carry))
        return kernel(stays, stored, carry, self._threads)


@jax.jit
def _rows(tree: Any) -> Any:
    """With the elements as the last dimension."""
    return jax.tree.map(lambda v: jnp.moveaxis(v, 0, -1), tree)


def _rows_here(tree: Any) -> Any:
    """The same, where it takes no copy."""
    return jax.tree.map(lambda v: np.moveaxis(np.asarray(v), 0, -1), tree)


def _records(numbers: FlightNumbers) -> Any:
    """What of a flight is read sample by sample, arrays (N,)."""
    return numbers.inputs, {n: (m.values, m.seen) for n, m in numbers.measured.items()}


def _with(numbers: FlightNumbers, records: Any) -> FlightNumbers:
    inputs, seen = records
    measured = {
        n: m._replace(values=seen[n][0], seen=seen[n][1]) for n, m in numbers.measured.items()
    }
    return numbers._replace(inputs=inputs, measured=measured)


def _without(numbers: FlightNumbers) -> FlightNumbers:
    """The numbers of a flight that are no records."""
    return _with(numbers, (None, dict.fromkeys(numbers.measured, (None, None))))


def _example(job: Job, index: int) -> tuple[Plan, FlightNumbers, Scalars, Any]:
    """What one element is made of."""
    plan, numbers = job.plan(index), flight_numbers(job, index)
    values = {n: v[0] for n, v in arguments(job, job.design.values(0, 1)).items()}
    trim = None
    if plan.trimmed is not None:
        shape = jax.eval_shape(functools.partial(steady, plan), numbers, values)
        trim = jax.tree.map(lambda v: np.zeros(v.shape, v.dtype), shape)
    return plan, numbers, values, trim


class _Traced(NamedTuple):
    begin: Any
    """the jaxpr of (numbers, values, trim): what is carried before the first sample, then what
    stays"""
    run: Run
    reduced: Any


def _traced(plan: Plan, numbers: FlightNumbers, values: Scalars, trim: Any) -> _Traced:
    """The run of an element, taken apart: what is computed once, and what at every sample.

    Raises:
        UnsupportedError: a part of it has no translation.
    """
    records = _records(numbers)
    sample = np.zeros((), np.int32)

    def step(own: Any, records: Any, carry: Any, k: Any) -> Any:
        bare, values, trim = own
        return samples_of(plan, _with(bare, records), values, trim).step(carry, k)

    def last(own: Any, records: Any, carry: Any) -> Any:
        bare, values, trim = own
        left = samples_of(plan, _with(bare, records), values, trim).last(carry)
        return left.value, left.state, left.outside

    found: dict[str, Any] = {}

    def begin(numbers: FlightNumbers, values: Scalars, trim: InitialTrim | None) -> Any:
        """What is carried before the first sample, and what stays."""
        carry = samples_of(plan, numbers, values, trim).carry
        own = (_without(numbers), values, trim)
        of_step, a_step = hoisted(step, own, _records(numbers), carry, sample)
        of_last, the_last = hoisted(last, own, _records(numbers), carry)
        both, n = [*of_step, *of_last], len(of_step)
        # Traced here, where the values that they stay with are at hand.
        found["step"] = jax.make_jaxpr(lambda v, *rest: a_step(v[:n], *rest))(
            both, records, carry, sample
        )
        found["last"], shape = jax.make_jaxpr(
            lambda v, *rest: the_last(v[n:], *rest), return_shape=True
        )(both, records, carry)
        found["reduced"] = jax.tree.structure(shape)
        return carry, both

    closed, shape = jax.make_jaxpr(begin, return_shape=True)(numbers, values, trim)
    carried, stay = (jax.tree.leaves(part) for part in shape)
    varies = _vary(closed.jaxpr, len(jax.tree.leaves(numbers)))[len(carried) :]
    run = Run(
        found["step"],
        found["last"],
        tuple(
            Argument(v.shape, np.dtype(v.dtype), not own)
            for v, own in zip(stay, varies, strict=True)
        ),
        tuple(Argument(v.shape, v.dtype, True) for v in jax.tree.leaves(records)),
        tuple(Argument(v.shape, np.dtype(v.dtype), False) for v in carried),
        jax.tree.leaves(records)[0].shape[0],
    )
    return _Traced(closed, run, found["reduced"])


def _vary(jaxpr: Any, n_shared: int) -> list[bool]:
    """Of each result whether it depends on more than the first arguments."""
    own = set(jaxpr.invars[n_shared:])
    for equation in jaxpr.eqns:
        # A literal has no hash, and depends on nothing.
        if any(not hasattr(v, "val") and v in own for v in equation.invars):
            own |= set(equation.outvars)
    return [not hasattr(v, "val") and v in own for v in jaxpr.outvars]


@functools.lru_cache(maxsize=32)
def _compiled(
    plan: Plan,
    structure: Any,
    kinds: tuple[tuple[tuple[int, ...], np.dtype], ...],
    devices: tuple[Any, ...],
    lanes: int,
) -> _Parts:
    """The program, remembered as `program` does it."""
    example = jax.tree.unflatten(structure, [np.zeros(*kind) for kind in kinds])
    begin, run, reduced = _traced(plan, *example)
    evaluate = core.jaxpr_as_fun(begin)
    varies = tuple(not argument.shared for argument in run.stays)

    n_carry = len(run.carry)

    def own(numbers: FlightNumbers, *element: Any) -> Any:
        outputs = evaluate(*jax.tree.leaves((numbers, *element)))
        stay = zip(outputs[n_carry:], varies, strict=True)
        return outputs[:n_carry], [v for v, varying in stay if varying]

    def shared(numbers: FlightNumbers, *element: Any) -> Any:
        outputs = evaluate(*jax.tree.leaves((numbers, *element)))
        return [v for v, varying in zip(outputs[n_carry:], varies, strict=True) if not varying]

    before, split = spread(own, devices, lanes)
    conclude, _ = spread(functools.partial(of_samples, plan), devices, lanes)
    if devices[0].platform == "cpu":
        kernel = Kernel(run, lanes_for(np.dtype(plan.precision)))
    else:
        kernel = GpuKernel(run, Gpu(devices[0].local_hardware_id), devices[0])
    return _Parts(
        kernel, before, jax.jit(shared), conclude, split, trims_of(plan, lanes), varies, reduced
    )
