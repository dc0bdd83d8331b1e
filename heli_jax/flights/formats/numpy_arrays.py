"""NumPy files (.npy, .npz), without Python objects."""

import io
import zipfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from heli_jax.flights.formats.apart import guarded
from heli_jax.flights.formats.arrays import (
    LARGEST,
    ArrayTable,
    DataSets,
)
from heli_jax.flights.log import Budget, wrong
from heli_jax.regular_file import read_regular

MAGIC = b"\x93NUMPY"
_MOST_ARRAYS = 1000


def open_numpy(path: Path) -> ArrayTable:
    """Read a NumPy file: one array (.npy), or several by name (.npz).

    Pickle is off, because it would run code in a file. Arrays of Python objects are left out.
    """
    where = str(path)
    data = read_regular(path, "a file of NumPy", LARGEST)
    sets = DataSets(Budget(where, len(data)))

    def read() -> None:
        for name, content in _arrays(data, sets.budget):
            file = io.BytesIO(content)
            version = np.lib.format.read_magic(file)
            header = np.lib.format.read_array_header_1_0 if version == (1, 0) else None
            shape, _, dtype = (header or np.lib.format.read_array_header_2_0)(file)
            if dtype.hasobject:
                sets.leave_out(name, "objects of Python, which may run code")
            # Sizes beyond the actual bytes are refused before they are allocated.
            elif np.prod(shape, dtype=object) * dtype.itemsize > len(content) or not dtype.itemsize:
                raise ValueError("cut off")
            else:
                _add(sets, name, np.load(io.BytesIO(content), allow_pickle=False))

    guarded(path, "file of NumPy", read)
    if not sets.names:
        raise wrong(where, "holds no arrays of numbers, expected numpy.savez(FILE, t=t, p=p)")
    return sets.table(where, "numpy", data)


def _arrays(data: bytes, budget: Budget) -> Iterator[tuple[str, bytes]]:
    """Yield the arrays of a file by name, each as the content of a .npy file."""
    if data.startswith(MAGIC):
        yield "data", data
        return
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = archive.infolist()[:_MOST_ARRAYS]
        budget.take(sum(m.file_size for m in members))
        for member in members:
            if member.filename.endswith(".npy"):
                yield member.filename.removesuffix(".npy"), archive.read(member)


def _add(sets: DataSets, name: str, array: np.ndarray) -> None:
    kind = array.dtype.kind
    if array.dtype.names is not None:
        for field in array.dtype.names:
            _add(sets, f"{name}.{field}" if name != "data" else field, array[field])
    elif kind in "mM":
        unit, count = np.datetime_data(array.dtype)
        if unit in ("s", "ms", "us", "ns") and count == 1:
            ticks = array.astype(np.int64).astype(np.float64)
            sets.add(name, np.where(np.isnat(array), np.nan, ticks), {"units": unit})
    elif kind in "biufc":
        # In the computer's own byte order.
        sets.add(name, array.astype(array.dtype.newbyteorder("=")), {})
