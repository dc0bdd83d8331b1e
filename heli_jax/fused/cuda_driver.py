"""The few calls of NVIDIA's driver that load a program and run it beside JAX, in C."""

import ctypes
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

_MAJOR, _MINOR, _PROCESSORS = 75, 76, 16  # of CUdevice_attribute
_ERROR_LOG, _ERROR_LOG_BYTES = 5, 6  # of CUjit_option


class CudaError(RuntimeError):
    """What the driver says."""


def _library() -> ctypes.CDLL:
    name = "nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1"
    try:
        return ctypes.CDLL(name)
    except OSError as e:
        raise CudaError(f"NVIDIA's driver ({name}) is not to be found: {e}") from e


class Gpu:
    """A GPU as JAX has it: its primary context, which JAX's arrays live in too."""

    def __init__(self, ordinal: int) -> None:
        """Find it.

        Args:
            ordinal: its number among those that this process sees, `local_hardware_id` of JAX.

        Raises:
            CudaError: the driver has none of this number.
        """
        self._driver = _library()
        self._context = ctypes.c_void_p()
        device = ctypes.c_int()
        self._ask("cuInit", 0)
        self._ask("cuDeviceGet", ctypes.byref(device), ordinal)
        self._ask("cuDevicePrimaryCtxRetain", ctypes.byref(self._context), device)
        major, minor, self.processors = (
            self._attribute(device, k) for k in (_MAJOR, _MINOR, _PROCESSORS)
        )
        self.capability = 10 * major + minor
        """such as 90 for 9.0"""

    def load(self, ptx: str) -> "Function":
        """The function `run` of a program in PTX.

        Raises:
            CudaError: the driver does not take it.
        """
        module, function = ctypes.c_void_p(), ctypes.c_void_p()
        log = ctypes.create_string_buffer(4096)
        keys = (ctypes.c_int * 2)(_ERROR_LOG, _ERROR_LOG_BYTES)
        values = (ctypes.c_void_p * 2)(ctypes.addressof(log), len(log))
        with self.current():
            try:
                self._ask("cuModuleLoadDataEx", ctypes.byref(module), ptx.encode(), 2, keys, values)
            except CudaError as e:
                raise CudaError(f"{e}: {log.value.decode(errors='replace').strip()}") from e
            self._ask("cuModuleGetFunction", ctypes.byref(function), module, b"run")
        return Function(self, function)

    @contextmanager
    def current(self) -> Iterator[None]:
        """With its context this thread's."""
        self._ask("cuCtxPushCurrent_v2", self._context)
        try:
            yield
        finally:
            self._ask("cuCtxPopCurrent_v2", ctypes.byref(ctypes.c_void_p()))

    def launch(
        self, function: ctypes.c_void_p, blocks: int, threads: int, arguments: Sequence[int]
    ) -> None:
        """Run a function of 64-bit numbers in so many blocks of threads, to its end.

        Raises:
            CudaError: it did not run, or not to its end.
        """
        held = [ctypes.c_uint64(v) for v in arguments]
        table = (ctypes.c_void_p * len(held))(*(ctypes.addressof(v) for v in held))
        with self.current():
            self._ask(
                *("cuLaunchKernel", function, blocks, 1, 1, threads, 1, 1),
                *(0, None, table, None),
            )
            self._ask("cuCtxSynchronize")

    def _attribute(self, device: ctypes.c_int, which: int) -> int:
        value = ctypes.c_int()
        self._ask("cuDeviceGetAttribute", ctypes.byref(value), which, device)
        return value.value

    def _ask(self, name: str, *arguments: object) -> None:
        code = getattr(self._driver, name)(*arguments)
        if code != 0:
            said = ctypes.c_char_p()
            self._driver.cuGetErrorString(code, ctypes.byref(said))
            words = (said.value or b"unknown error").decode(errors="replace")
            raise CudaError(f"{name}: {words} (error {code})")


class Function:
    """A program that a GPU has taken."""

    def __init__(self, gpu: Gpu, handle: ctypes.c_void_p) -> None:
        self._gpu, self._handle = gpu, handle

    def __call__(self, blocks: int, threads: int, arguments: Sequence[int]) -> None:
        """As `Gpu.launch`."""
        self._gpu.launch(self._handle, blocks, threads, arguments)
