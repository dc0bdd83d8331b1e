"""C kernels of these benchmarks: compiled when needed, and called with NumPy arrays."""

import ctypes
import platform
import subprocess
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

FLAGS = ("-O3", "-march=native", "-ffast-math", "-shared", "-fPIC")
WIDE = ("-mprefer-vector-width=512",) if platform.machine() == "x86_64" else ()
"""The vector width of our kernel; gcc uses 256 bits by default."""


def compiled(source: str, more: tuple[str, ...] = ()) -> Any:
    """Return the library of a C file in this folder, compiled with `FLAGS` and more."""
    out = Path(tempfile.mkdtemp()) / "kernel.so"
    file = Path(__file__).parent / source
    subprocess.run(["gcc", *FLAGS, *more, str(file), "-o", str(out), "-lm"], check=True)
    return ctypes.CDLL(str(out))


def pointer(a: np.ndarray) -> Any:
    return a.ctypes.data_as(ctypes.c_void_p)


if __name__ == "__main__":
    print(__doc__, "\nA part of the scripts beside it: by itself it does nothing.")
