"""A program for whole runs on a GPU of NVIDIA's, loaded and called on JAX's own arrays."""

import functools
from collections.abc import Callable, Sequence
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from heli_jax.fused.program import Argument, Run, whole
from heli_jax.fused.ptx import ptx

# `Any` below: devices of JAX, whose class type checkers do not take for one.

_THREADS, _FEW = 128, 32
"""a block's; and where there are too few vehicles to give every processor a block of those"""


class Loader(Protocol):
    """What a GPU does for us: `cuda_driver.Gpu`."""

    capability: int
    """such as 90 for 9.0"""
    processors: int

    def load(self, ptx: str, /) -> Callable[[int, int, Sequence[int]], None]: ...


class GpuKernel:
    """A run as a program that a GPU has taken, one vehicle a thread."""

    lanes = 1

    def __init__(self, run: Run, gpu: Loader, device: Any) -> None:
        """Translate, compile and load.

        Args:
            run: what is computed.
            gpu: the device, by the driver.
            device: the same, of JAX.

        Raises:
            UnsupportedError: an operation that has no translation.
            CudaError: the driver does not take the program.
        """
        self._run, self._gpu, self._device = run, gpu, device
        self.ptx, text = ptx(run, gpu.capability)
        self._results = text.results
        self._call = gpu.load(self.ptx)

    def __call__(
        self, stays: Sequence[jax.Array], stored: Sequence[jax.Array], carry: Sequence[jax.Array]
    ) -> list[jax.Array]:
        """All vehicles' runs.

        Args:
            stays: as the run has them; those that are not shared with the vehicles as their last
                dimension.
            stored: arrays (N, ...), or (N, vehicles) where each vehicle has its own.
            carry: before the first sample, with the vehicles as the last dimension.

        Returns:
            The results, with the vehicles as the last dimension.

        Raises:
            CudaError: the program did not run to its end.
        """
        count = carry[0].shape[-1]
        results = _memory(self._device, count, tuple((r.shape, r.dtype) for r in self._results))
        run = self._run
        kinds = (run.stays, whole(run.stored), run.carry, self._results)
        on_device = [jax.device_put(list(part), self._device) for part in (stays, stored, carry)]
        tables = [
            self._table(_pointers(arrays, count, kind))
            for arrays, kind in zip([*on_device, results], kinds, strict=True)
        ]
        # The driver knows nothing of what JAX is still computing.
        jax.block_until_ready((on_device, results, tables))
        few = count < self._gpu.processors * _THREADS
        threads = _FEW if few else _THREADS
        arguments = [*(t.unsafe_buffer_pointer() for t in tables), 0, count, count]
        self._call(-(-count // threads), threads, arguments)
        return results

    def _table(self, pointers: list[int]) -> jax.Array:
        # As pairs of 32 bits: JAX has no numbers of 64 unless it is told to.
        words = np.asarray(pointers or [0], np.uint64).view(np.uint32)
        return jax.device_put(words, self._device)


def _memory(
    device: Any, count: int, kinds: tuple[tuple[tuple[int, ...], np.dtype], ...]
) -> list[jax.Array]:
    """Arrays that nobody else has, for a program to write into."""
    with jax.default_device(device):
        arrays = _zeros(count, kinds)()
    assert len({a.unsafe_buffer_pointer() for a in arrays}) == len(arrays)
    return arrays


@functools.lru_cache(maxsize=32)
def _zeros(
    count: int, kinds: tuple[tuple[tuple[int, ...], np.dtype], ...]
) -> Callable[[], list[jax.Array]]:
    return jax.jit(lambda: [jnp.zeros((*shape, count), dtype) for shape, dtype in kinds])


def _pointers(arrays: Sequence[jax.Array], count: int, arguments: Sequence[Argument]) -> list[int]:
    """One for each array that is shared, one for each row of the others."""
    table = []
    for array, argument in zip(arrays, arguments, strict=True):
        start = array.unsafe_buffer_pointer()
        row = 0 if argument.shared else count * array.dtype.itemsize
        rows = 1 if argument.shared else int(np.prod(argument.shape))
        table += [start + k * row for k in range(rows)]
    return table
