"""A program for whole runs on this processor, compiled and called."""

import ctypes
import functools
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import numpy as np

from heli_jax.fused.code import (
    INDEX,
    Code,
    Operand,
    Stored,
    UnsupportedError,
    Value,
    constant,
    flat,
    scalar,
    type_of,
)
from heli_jax.fused.translate import loop, translate


class Argument(NamedTuple):
    """An array passed to the program: one for all vehicles, or a row for each."""

    shape: tuple[int, ...]
    """Shape without the vehicles; () unless it is shared."""
    dtype: np.dtype
    shared: bool


class Run(NamedTuple):
    """Program to compile, with jaxprs from `jax.make_jaxpr`."""

    step: Any
    """step(constants, records, carry, k: int32) returns the carry after the k-th step."""
    last: Any
    """last(constants, records, carry) returns the results."""
    stays: tuple[Argument, ...]
    """Constants over the steps."""
    stored: tuple[Argument, ...]
    """Records (N,) of all vehicles, read by sample."""
    carry: tuple[Argument, ...]
    steps: int
    """Number of steps, at least one."""


def write(run: Run, lanes: int) -> tuple[str, list[np.dtype]]:
    """Return a run as LLVM assembly with one function, `run`, and the types of its results.

    Its arguments are four tables of pointers, and the first and last vehicle. The tables are
    constants, records, carry and results. They have one pointer for each array. An array that is
    not shared has a number per vehicle.

    Raises:
        UnsupportedError: an operation without a translation.
    """
    code = Code(lanes)
    stored = [_shared(code, code.pointer("%stored", i), kind) for i, kind in enumerate(run.stored)]
    read_stays, read_carry = (
        _read(code, name, arguments)
        for name, arguments in (("%stays", run.stays), ("%carry", run.carry))
    )
    code.write("br label %vehicles")
    entry = code.block
    code.label("vehicles")
    code.write(f"%b = phi i64 [ %begin, %{entry} ], [ %following, %done ]")
    stays, carry = read_stays(), read_carry()

    def step(index: Value, carried: list[Value]) -> list[Operand]:
        operands = [*stays, *stored, *carried, index]
        return translate(code, run.step.jaxpr, run.step.consts, operands)

    carried = loop(code, run.steps, carry, step)
    operands = [*stays, *stored, *carried]
    results = [scalar(v) for v in translate(code, run.last.jaxpr, run.last.consts, operands)]
    for i, value in enumerate(results):
        _store(code, value, code.pointer("%results", i))
    code.write("br label %done")
    code.label("done")
    code.write(f"%following = add i64 %b, {lanes}")
    code.write("%more = icmp slt i64 %following, %end")
    code.write("br i1 %more, label %vehicles, label %out")
    code.label("out")
    code.write("ret void")
    head = list(code.declared.values())
    tables = ", ".join(f"ptr %{n}" for n in ("stays", "stored", "carry", "results"))
    arguments = f"{tables}, i64 %begin, i64 %end"
    body = "\n".join(code.lines)
    # Without the attributes LLVM would use half the width of AVX-512, and spilled registers would
    # cross cache lines. This costs a quarter of an exact step's time.
    attributes = 'alignstack(64) "prefer-vector-width"="512" "min-legal-vector-width"="512"'
    function = f"define void @run({arguments}) nounwind {attributes} {{\nentry:\n{body}\n}}"
    return "\n".join([*head, function, ""]), [v.dtype for v in results]


def _shared(code: Code, pointer: str, argument: Argument) -> Operand:
    """Return an array or a number that all vehicles share."""

    def element(at: tuple[Value, ...]) -> Value:
        place = flat(code, argument.shape, at) if at else constant(0, INDEX)
        return code.load(pointer, place, argument.dtype)

    array = Stored(argument.shape, argument.dtype, element)
    return array if argument.shape else scalar(array)


def _read(code: Code, name: str, arguments: Sequence[Argument]) -> Callable[[], list[Operand]]:
    """Return a reader of the arguments in a table of pointers.

    Shared ones are read now, and the vehicles' own when it is called.
    """
    made: list[Callable[[], Operand]] = []
    for i, argument in enumerate(arguments):
        pointer = code.pointer(name, i)
        if argument.shared:
            shared = _shared(code, pointer, argument)
            made.append(lambda shared=shared: shared)
        elif argument.shape:
            raise UnsupportedError(f"an array of {argument.shape} of each vehicle")
        else:
            made.append(functools.partial(_vector, code, pointer, argument.dtype))
    return lambda: [read() for read in made]


def _vector(code: Code, pointer: str, dtype: np.dtype) -> Value:
    """Return a number of each vehicle, from the block's first one on."""
    kind = type_of(dtype)
    kept, size = ("i8", 1) if kind == "i1" else (kind, dtype.itemsize)
    place = code.register()
    code.write(f"{place} = getelementptr {kept}, ptr {pointer}, i64 %b")
    right = f"load {code.vector(kept)}, ptr {place}, align {size}"
    value = code.made(right, dtype, False)
    if kind != "i1":
        return value
    wide = f"trunc {code.vector(kept)} {value.operand} to {code.vector('i1')}"
    return code.made(wide, dtype, False)


def _store(code: Code, value: Value, row: str) -> None:
    kind = type_of(value.dtype)
    vector, operand = code.vector(kind), code.of(value, False)
    if kind == "i1":
        wide = code.vector("i8")
        operand = code.made(f"zext {vector} {operand} to {wide}", value.dtype, False).operand
        kind, vector = "i8", wide
    place = code.register()
    code.write(f"{place} = getelementptr {kind}, ptr {row}, i64 %b")
    size = 1 if kind == "i8" else value.dtype.itemsize
    code.write(f"store {vector} {operand}, ptr {place}, align {size}")


def lanes_for(dtype: np.dtype, linear: bool = False) -> int:
    """Return the number of vehicles that one thread computes at once.

    Args:
        linear: True if a step is a product of matrices, whose sums depend little on each other.
    """
    # Twice the widest vector: each operation waits for the previous one, and a second vector fills
    # the wait. With more, states no longer fit in registers. On narrower vectors waiting costs more
    # than spilling (RK4 of the roll model with AVX2: 16 vehicles take 0.77 of the time of 8),
    # except for products of matrices (1.2 of it).
    wide = not linear or "avx512f" in _features() or "avx" not in _features()
    return (128 if wide else 64) // np.dtype(dtype).itemsize


class Kernel:
    """A run as machine code."""

    def __init__(self, run: Run, lanes: int) -> None:
        """Translate and compile.

        Args:
            lanes: vehicles per vector; their number must be a multiple of it.

        Raises:
            UnsupportedError: an operation without a translation.
        """
        self._run, self.lanes = run, lanes
        self.assembly, self._results = write(run, lanes)
        self._engine = _compiled(self.assembly)
        pointer, size = ctypes.c_void_p, ctypes.c_int64
        kind = ctypes.CFUNCTYPE(None, *([pointer] * 4), size, size)
        self._call = kind(self._engine.get_function_address("run"))

    def __call__(
        self,
        stays: Sequence[np.ndarray],
        stored: Sequence[np.ndarray],
        carry: Sequence[np.ndarray],
        threads: int,
    ) -> list[np.ndarray]:
        """Compute the runs of all vehicles.

        Args:
            stays: constants of the run, arrays (vehicles,) unless they are shared.
            stored: records (N,).
            carry: carry before the first sample, arrays (vehicles,).

        Returns:
            The results, arrays (vehicles,).
        """
        count = carry[0].shape[-1]
        assert count % self.lanes == 0
        assert self._run.steps >= 1
        # Keep references during the call, since the program has pointers to the arrays.
        arguments = [[np.ascontiguousarray(v) for v in part] for part in (stays, stored, carry)]
        results = [np.empty(count, dtype) for dtype in self._results]
        tables = [_pointers(arrays) for arrays in (*arguments, results)]
        blocks = count // self.lanes
        shares = np.linspace(0, blocks, min(threads, blocks) + 1).astype(int) * self.lanes

        def part(k: int) -> None:
            self._call(*tables, int(shares[k]), int(shares[k + 1]))

        # Python threads suffice, since the call releases the interpreter lock.
        if len(shares) == 2:
            part(0)
        else:
            with ThreadPoolExecutor(len(shares) - 1) as pool:
                list(pool.map(part, range(len(shares) - 1)))
        return results


def _pointers(arrays: Sequence[np.ndarray]) -> Any:
    """Return a table of pointers to arrays."""
    return (ctypes.c_void_p * max(1, len(arrays)))(*(v.ctypes.data for v in arrays))


# Any: llvmlite is an extra without types.
def _llvm() -> Any:
    """Return llvmlite's binding of LLVM.

    Raises:
        UnsupportedError: it is not installed.
    """
    try:
        import llvmlite.binding as llvm
    except ImportError as e:
        remedy = "pip install 'heli_jax[fused]'"
        raise UnsupportedError(f"any model: llvmlite is not installed ({remedy})") from e
    return llvm


@functools.cache
def _features() -> frozenset[str]:
    """Return the features of this processor."""
    return frozenset(name for name, has in _llvm().get_host_cpu_features().items() if has)


def _machine() -> Any:
    """Return this processor as an LLVM target."""
    llvm = _llvm()
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    return llvm.Target.from_default_triple().create_target_machine(
        cpu=llvm.get_host_cpu_name(), features=llvm.get_host_cpu_features().flatten(), opt=3
    )


def _compiled(assembly: str) -> Any:
    """Return the engine, which owns the machine code."""
    llvm, target = _llvm(), _machine()
    module = llvm.parse_assembly(assembly)
    module.verify()
    builder = llvm.create_pass_builder(target, llvm.create_pipeline_tuning_options(speed_level=3))
    builder.getModulePassManager().run(module, builder)
    # A second target, since the engine takes ownership of it.
    engine = llvm.create_mcjit_compiler(module, _machine())
    engine.finalize_object()
    return engine
