"""Arrays as NumPy saves them: one in a .npy file, several by name in an .npz archive.

Without pickle, which would run what a file says: arrays of Python's objects are passed over.
"""

import io
import zipfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from heli_jax.finding import LEFT_OUT, note
from heli_jax.flights import array_table
from heli_jax.flights.array_table import ArrayTable, DataSets
from heli_jax.flights.table import Budget, listed, shown, wrong
from heli_jax.regular_file import read_regular

MAGIC = b"\x93NUMPY"
_LARGEST = 10**9
_MOST_TEXTS, _LONGEST = 100, 1000
"""of a list of names, and letters of each: others are data"""
_MOST_ARRAYS = 1000
_TICKS = {"s": "s", "ms": "ms", "us": "us", "ns": "ns"}


def open_numpy(path: Path) -> ArrayTable:
    """A file of NumPy.

    Raises:
        InputError: it is none, it is damaged, or it holds no arrays of numbers.
        OSError: it cannot be read.
    """
    where = str(path)
    data = read_regular(path, "a file of NumPy", _LARGEST)
    sets, objects = DataSets(Budget(where, len(data))), []

    def read() -> None:
        for name, content in _members(data, sets.budget):
            array = _array(content)
            if array is None:
                objects.append(name)
            else:
                _add(sets, name, array)

    array_table.guarded(path, "file of NumPy", read)
    if objects:
        words = f"objects of Python, which are not read: {listed(map(shown, objects))}"
        if not sets.names:
            problem = f"holds {words}; expected arrays of numbers, numpy.savez(FILE, t=t, p=p)"
            raise wrong(where, problem)
        sets.note(note(LEFT_OUT, words, *objects))
    return sets.table(where, "numpy", data)


def _members(data: bytes, budget: Budget) -> Iterator[tuple[str, bytes]]:
    """The arrays of a file by name, each as a .npy file has it."""
    if data.startswith(MAGIC):
        yield "data", data
        return
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = archive.infolist()[:_MOST_ARRAYS]
        budget.take(sum(m.file_size for m in members))
        for member in members:
            if member.filename.endswith(".npy"):
                yield member.filename.removesuffix(".npy"), archive.read(member)


def _array(content: bytes) -> np.ndarray | None:
    """The array of a .npy file; None where it holds objects."""
    file = io.BytesIO(content)
    version = np.lib.format.read_magic(file)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else None
    shape, by_columns, dtype = (read or np.lib.format.read_array_header_2_0)(file)
    if dtype.hasobject:
        return None
    count = int(np.prod(shape, dtype=object)) if shape else 1
    begin = file.tell()
    if count < 0 or not dtype.itemsize or count * dtype.itemsize > len(content) - begin:
        raise ValueError("cut off")
    array = np.frombuffer(content, dtype, count, begin)
    return array.reshape(shape, order="F" if by_columns else "C")


def _add(sets: DataSets, name: str, array: np.ndarray) -> None:
    if array.dtype.names is not None:
        for field in array.dtype.names:
            _add(sets, f"{name}.{field}" if name != "data" else field, array[field])
        return
    kind = array.dtype.kind
    if kind in "US" and 0 < array.size <= _MOST_TEXTS:
        sets.add_texts(name, [str(x)[:_LONGEST] for x in array.astype(str).ravel()])
    elif kind in "mM":
        unit, count = np.datetime_data(array.dtype)
        if unit in _TICKS and count == 1:
            ticks = array.astype(np.int64).astype(np.float64)
            ticks[np.isnat(array)] = np.nan
            sets.add(name, ticks, {"units": _TICKS[unit]})
    elif array_table.holds_numbers(array.dtype, array.ndim):
        # In the machine's own order of bytes.
        sets.add(name, array.astype(array.dtype.newbyteorder("=")), {})
    else:
        sets.leave_out(name, array.dtype, array.shape)
