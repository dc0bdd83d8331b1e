"""A program for whole runs of many vehicles: from the first sample to the last."""

import ctypes
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import numpy as np

from heli_jax.fused.code import Code, UnsupportedError, Value, type_of
from heli_jax.fused.loops import loop
from heli_jax.fused.operands import INDEX, Elements, Operand, Stored, elements
from heli_jax.fused.translate import translate


class Argument(NamedTuple):
    """An array that the program is given: one for all vehicles, or a row of each vehicle's own."""

    shape: tuple[int, ...]
    """without the vehicles"""
    dtype: np.dtype
    shared: bool


class Run(NamedTuple):
    """What is compiled; jaxprs as `jax.make_jaxpr` gives them."""

    step: Any
    """of (what stays, what is stored, carry, the sample, int32): the carry a sample later"""
    last: Any
    """of (what stays, what is stored, carry): the results"""
    stays: tuple[Argument, ...]
    """what does not change over the samples"""
    stored: tuple[Argument, ...]
    """arrays (N, ...) that all vehicles share, read by the sample"""
    carry: tuple[Argument, ...]


def lanes_for(dtype: np.dtype) -> int:
    """How many vehicles are in flight at once in one thread."""
    # Two of the widest vectors there are: each operation waits for the one before it, and a second
    # vector fills the wait; with more, the states no longer stay in registers.
    return 128 // np.dtype(dtype).itemsize


class Kernel:
    """A run as machine code."""

    def __init__(self, run: Run, lanes: int) -> None:
        """Translate and compile.

        Args:
            run: what is computed.
            lanes: vehicles in flight at once; their number has to be a multiple of it.

        Raises:
            UnsupportedError: an operation that has no translation.
        """
        self._run, self.lanes = run, lanes
        self.assembly, self._results = _assembly(run, lanes)
        self._engine = _compiled(self.assembly)
        pointer, size = ctypes.c_void_p, ctypes.c_int64
        kind = ctypes.CFUNCTYPE(None, *([pointer] * 4), size, size, ctypes.c_int32)
        self._call = kind(self._engine.get_function_address("run"))

    def __call__(
        self,
        stays: Sequence[np.ndarray],
        stored: Sequence[np.ndarray],
        carry: Sequence[np.ndarray],
        samples: int,
        threads: int,
    ) -> list[np.ndarray]:
        """All vehicles' runs.

        Args:
            stays: as the run has them; those that are not shared with the vehicles as their last
                dimension.
            stored: arrays (N, ...).
            carry: before the first sample, with the vehicles as the last dimension.
            samples: N, two at least.
            threads: how many share the vehicles.

        Returns:
            The results, with the vehicles as the last dimension.
        """
        count = carry[0].shape[-1]
        assert count % self.lanes == 0
        assert samples >= 2
        # Kept until the call is over: the program has pointers to them.
        given = [[np.ascontiguousarray(v) for v in part] for part in (stays, stored, carry)]
        results = [np.empty((*r.shape, count), r.dtype) for r in self._results]
        kinds = (self._run.stays, self._run.stored, self._run.carry)
        tables = [_pointers(v, count, kind) for v, kind in zip(given, kinds, strict=True)]
        ends = _pointers(results, count, self._results)
        blocks = count // self.lanes
        shares = np.linspace(0, blocks, min(threads, blocks) + 1).astype(int) * self.lanes

        def part(k: int) -> None:
            self._call(*tables, ends, int(shares[k]), int(shares[k + 1]), samples - 1)

        # Threads of Python: the call gives its lock away.
        if len(shares) == 2:
            part(0)
        else:
            with ThreadPoolExecutor(len(shares) - 1) as pool:
                list(pool.map(part, range(len(shares) - 1)))
        return results


def _pointers(arrays: Sequence[np.ndarray], count: int, arguments: Sequence[Argument]) -> Any:
    """A table of pointers: one for each array that is shared, one for each row of the others."""
    table = []
    for array, argument in zip(arrays, arguments, strict=True):
        row = 0 if argument.shared else count * array.itemsize
        rows = 1 if argument.shared else int(np.prod(argument.shape))
        table += [array.ctypes.data + k * row for k in range(rows)]
    return (ctypes.c_void_p * max(1, len(table)))(*table)


def _assembly(run: Run, lanes: int) -> tuple[str, list[Argument]]:
    """The program, and what it gives."""
    code = Code(lanes)
    stored = _stored(code, run.stored)
    rows, shared = _tables(code, "%stays", run.stays)
    starts, _ = _tables(code, "%carry", run.carry)
    entry = code.block
    code.write("br label %vehicles")
    code.label("vehicles")
    code.write(f"%b = phi i64 [ %begin, %{entry} ], [ %following, %done ]")
    stays = [_of_row(code, *v) if v[1] else shared[i] for i, v in enumerate(rows)]
    carry = [_of_row(code, *v) for v in starts]
    steps = Value("%steps", INDEX, True)

    def step(index: Value, carried: list[Operand]) -> list[Operand]:
        return translate(
            code, run.step.jaxpr, run.step.consts, [*stays, *stored, *carried, _single(index)]
        )

    carried = loop(code, steps, carry, step)
    results = translate(code, run.last.jaxpr, run.last.consts, [*stays, *stored, *carried])
    given = [elements(code, v) for v in results]
    kinds = [Argument(v.shape, v.ravel()[0].dtype, False) for v in given]
    for i, value in enumerate(v for array in given for v in array.ravel()):
        _store(code, value, code.pointer("%results", i))
    code.write("br label %done")
    code.label("done")
    code.write(f"%following = add i64 %b, {lanes}")
    code.write("%more = icmp slt i64 %following, %end")
    code.write("br i1 %more, label %vehicles, label %out")
    code.label("out")
    code.write("ret void")
    head = [f"{name} = {text}" for name, text in code.globals.items()]
    head += code.declared.values()
    arguments = (
        "ptr %stays, ptr %stored, ptr %carry, ptr %results, i64 %begin, i64 %end, i32 %steps"
    )
    body = "\n".join(code.lines)
    # Without the attributes LLVM would take half of AVX-512's width.
    attributes = '"prefer-vector-width"="512" "min-legal-vector-width"="512"'
    function = f"define void @run({arguments}) nounwind {attributes} {{\nentry:\n{body}\n}}"
    return "\n".join([*head, function, ""]), kinds


def _single(value: Value) -> Elements:
    single = np.empty((), object)
    single[()] = value
    return single


def _stored(code: Code, arguments: Sequence[Argument]) -> list[Stored]:
    made = []
    for i, argument in enumerate(arguments):
        if len(argument.shape) != 1:
            raise UnsupportedError(f"a record of shape {argument.shape}")
        pointer = code.pointer("%stored", i)
        made.append(
            Stored(
                argument.shape,
                argument.dtype,
                lambda at, p=pointer, d=argument.dtype: code.load(p, at[0], d),
            )
        )
    return made


def _tables(
    code: Code, name: str, arguments: Sequence[Argument]
) -> tuple[list[tuple[Argument, list[str]]], dict[int, Elements]]:
    """Pointers to the rows of what is not shared, and the elements of what is."""
    rows: list[tuple[Argument, list[str]]] = []
    shared: dict[int, Elements] = {}
    place = 0
    for i, argument in enumerate(arguments):
        size = int(np.prod(argument.shape))
        pointers = []
        for _ in range(1 if argument.shared else size):
            pointers.append(code.pointer(name, place))
            place += 1
        if not argument.shared:
            rows.append((argument, pointers))
            continue
        rows.append((argument, []))
        values = np.empty(argument.shape, object)
        for k, at in enumerate(np.ndindex(argument.shape)):
            index = Value(str(k), INDEX, True)
            values[at] = code.load(pointers[0], index, argument.dtype)
        shared[i] = values
    return rows, shared


def _of_row(code: Code, argument: Argument, pointers: list[str]) -> Elements:
    """The vehicles' own numbers, a vector each."""
    values = np.empty(argument.shape, object)
    kind = type_of(argument.dtype)
    kept = "i8" if kind == "i1" else kind
    for pointer, at in zip(pointers, np.ndindex(argument.shape), strict=True):
        place = code.register()
        code.write(f"{place} = getelementptr {kept}, ptr {pointer}, i64 %b")
        size = 1 if kind == "i1" else argument.dtype.itemsize
        vector = f"<{code.lanes} x {kept}>"
        value = code.made(f"load {vector}, ptr {place}, align {size}", argument.dtype, False)
        if kind == "i1":
            wide = f"trunc {vector} {value.operand} to <{code.lanes} x i1>"
            value = code.made(wide, argument.dtype, False)
        values[at] = value
    return values


def _store(code: Code, value: Value, row: str) -> None:
    kind = type_of(value.dtype)
    vector, operand = f"<{code.lanes} x {kind}>", code.of(value, False)
    if kind == "i1":
        wide = f"<{code.lanes} x i8>"
        operand = code.made(f"zext {vector} {operand} to {wide}", value.dtype, False).operand
        kind, vector = "i8", wide
    place = code.register()
    code.write(f"{place} = getelementptr {kind}, ptr {row}, i64 %b")
    size = 1 if kind == "i8" else value.dtype.itemsize
    code.write(f"store {vector} {operand}, ptr {place}, align {size}")


def _machine() -> Any:
    """The processor at hand, for LLVM."""
    import llvmlite.binding as llvm

    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    return llvm.Target.from_default_triple().create_target_machine(
        cpu=llvm.get_host_cpu_name(), features=llvm.get_host_cpu_features().flatten(), opt=3
    )


def _compiled(assembly: str) -> Any:
    """The engine that holds the machine code, which goes with it."""
    import llvmlite.binding as llvm

    target = _machine()
    module = llvm.parse_assembly(assembly)
    module.verify()
    builder = llvm.create_pass_builder(target, llvm.create_pipeline_tuning_options(speed_level=3))
    builder.getModulePassManager().run(module, builder)
    # One of its own: the engine takes it over.
    engine = llvm.create_mcjit_compiler(module, _machine())
    engine.finalize_object()
    return engine
