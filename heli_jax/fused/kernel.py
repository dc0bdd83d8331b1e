"""A program for whole runs on the processor at hand, compiled and called."""

import ctypes
import functools
import re
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

from heli_jax.fused.code import UnsupportedError
from heli_jax.fused.program import Argument, Run, whole, write


def lanes_for(dtype: np.dtype, linear: bool = False) -> int:
    """How many vehicles are in flight at once in one thread.

    Args:
        linear: whether a step is a product of matrices, whose sums wait for each other little.
    """
    # Two of the widest vectors there are: each operation waits for the one before it, and a second
    # vector fills the wait; with more, the states no longer stay in registers. Narrower ones wait
    # longer than they miss registers (RK4 of the roll model, AVX2: 16 vehicles take 0.77 of the
    # time of 8), but for products of matrices (1.2 of it).
    wide = not linear or "avx512f" in _features() or "avx" not in _features()
    return (128 if wide else 64) // np.dtype(dtype).itemsize


class Kernel:
    """A run as machine code."""

    def __init__(self, run: Run, lanes: int) -> None:
        """Translate and compile.

        Args:
            lanes: vehicles in flight at once; their number has to be a multiple of it.

        Raises:
            UnsupportedError: an operation that has no translation.
        """
        self._run, self.lanes = run, lanes
        self.assembly, self._results = write(run, lanes)
        self._engine = _compiled(self.assembly)
        pointer, size = ctypes.c_void_p, ctypes.c_int64
        kind = ctypes.CFUNCTYPE(None, *([pointer] * 4), size, size, size)
        self._call = kind(self._engine.get_function_address("run"))

    def __call__(
        self,
        stays: Sequence[np.ndarray],
        stored: Sequence[np.ndarray],
        carry: Sequence[np.ndarray],
        threads: int,
    ) -> list[np.ndarray]:
        """All vehicles' runs.

        Args:
            stays: as the run has them; those that are not shared with the vehicles as their last
                dimension.
            stored: arrays (N, ...), or (N, vehicles) where each vehicle has its own.
            carry: before the first sample, with the vehicles as the last dimension.

        Returns:
            The results, with the vehicles as the last dimension.
        """
        count = carry[0].shape[-1]
        assert count % self.lanes == 0
        assert self._run.steps >= 1
        # Kept until the call is over: the program has pointers to them.
        arguments = [[np.ascontiguousarray(v) for v in part] for part in (stays, stored, carry)]
        results = [np.empty((*r.shape, count), r.dtype) for r in self._results]
        kinds = (self._run.stays, whole(self._run.stored), self._run.carry)
        tables = [_pointers(v, count, kind) for v, kind in zip(arguments, kinds, strict=True)]
        ends = _pointers(results, count, self._results)
        blocks = count // self.lanes
        shares = np.linspace(0, blocks, min(threads, blocks) + 1).astype(int) * self.lanes

        def part(k: int) -> None:
            self._call(*tables, ends, int(shares[k]), int(shares[k + 1]), count)

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


@functools.cache
def _features() -> frozenset[str]:
    """What the processor at hand has."""
    import llvmlite.binding as llvm

    return frozenset(name for name, has in llvm.get_host_cpu_features().items() if has)


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
    for name in re.findall(r"^declare .*@(?!llvm\.)(\w+)\(", assembly, re.MULTILINE):
        # LLVM would end the process where it does not find one.
        llvm.add_symbol(name, _address(name))
    module = llvm.parse_assembly(assembly)
    module.verify()
    builder = llvm.create_pass_builder(target, llvm.create_pipeline_tuning_options(speed_level=3))
    builder.getModulePassManager().run(module, builder)
    # One of its own: the engine takes it over.
    engine = llvm.create_mcjit_compiler(module, _machine())
    engine.finalize_object()
    return engine


def _address(name: str) -> int:
    """Where a function of the C library is.

    Raises:
        UnsupportedError: it has none of this name.
    """
    # Elsewhere it is part of what every process of Python has loaded.
    library = ctypes.CDLL("ucrtbase" if sys.platform == "win32" else None)
    try:
        address = ctypes.cast(getattr(library, name), ctypes.c_void_p).value
    except AttributeError as e:
        raise UnsupportedError(f"{name}, which this machine's C library does not have") from e
    assert address is not None
    return address
