"""Logs of named arrays: MATLAB (.mat), NetCDF (.nc), HDF5 (.h5, .hdf5) and NumPy (.npy, .npz).

An array's name is its path: `log.roll.data` in MATLAB's structures, `log/roll` in HDF5.
"""

import hashlib
import importlib.util
import io
import json
import signal
import subprocess
import sys
import threading
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from heli_jax import import_path
from heli_jax.errors import InputError
from heli_jax.finding import LEFT_OUT, Finding, note
from heli_jax.flights import mat_file, packed, stacked
from heli_jax.flights.array_names import as_lists, labelled, named_columns
from heli_jax.flights.stacked import unstacked
from heli_jax.flights.table import (
    Budget,
    Survey,
    column,
    listed,
    require_columns,
    require_few_columns,
    shown,
    wrong,
)
from heli_jax.flights.time_units import time_unit
from heli_jax.regular_file import read_regular

_LARGEST = 10**9
_SECONDS, _RATE = 20, 10**7
"""processor time [s] that an HDF5 file may take, and bytes for which it has a second more"""
_PATIENCE = 10
"""times as long by the clock"""
_MOST_ARRAYS = 1000
_MOST_ELEMENTS = 100
"""columns of a matrix: more are data of another shape than a log's"""
NUMPY_MAGIC = b"\x93NUMPY"
HDF5_MAGIC = b"\x89HDF\r\n\x1a\n"


class ArrayTable:
    """A `Table` on arrays, each (N,); those asked for together have to be of one length."""

    def __init__(
        self,
        path: str,
        kind: str,
        data: bytes,
        arrays: Mapping[str, np.ndarray],
        units: Mapping[str, str] | None = None,
        notes: tuple[Finding, ...] = (),
    ) -> None:
        self.path, self.format, self.size, self.notes = path, kind, len(data), notes
        self.sha256 = hashlib.sha256(data).hexdigest()
        self.names = tuple(arrays)
        self._arrays = arrays
        self.units: Mapping[str, str] = dict(units or {})
        if not arrays:
            raise wrong(path, "holds no rows of numbers, expected a log")
        require_few_columns(path, len(arrays))

    def numbers(self, names: Sequence[str]) -> dict[str, np.ndarray]:
        """The arrays as float64 (N,).

        Raises:
            InputError: one is missing or they differ in length.
        """
        require_columns(self.path, self.names, names)
        arrays = {name: np.asarray(self._arrays[name], np.float64) for name in names}
        sizes = {name: values.size for name, values in arrays.items()}
        # A file may hold records of several lengths. Only those that are asked for together have to
        # fit, so that a summary of two numbers beside a log does no harm.
        first = next(iter(names))
        other = next((n for n in names if sizes[n] != sizes[first]), None)
        if other is not None:
            problem = f"has {sizes[other]} samples, expected {sizes[first]} as {shown(first)} has"
            raise wrong(self.path, problem, column(other))
        return arrays

    def survey(self) -> list[Survey]:
        """Every array, in the file's order."""
        return [
            Survey(name, np.asarray(values, np.float64), values.size)
            for name, values in self._arrays.items()
        ]

    def place(self, row: int) -> str:
        """`row 1` is the first."""
        return f"row {row + 1}"

    def cell_text(self, name: str, row: int) -> str:
        """What stands in a cell, in words."""
        return repr(self._arrays[name][row].item())[:40]

    def time_unit(self, name: str) -> str | None:
        """The unit that the file states, where it is one of time."""
        return time_unit(self.units.get(name, ""))


def open_mat(path: Path) -> ArrayTable:
    """A MATLAB file, of version 7.3 too where h5py is installed.

    Raises:
        InputError: it is none, it is damaged, or it holds no arrays of numbers.
        OSError: it cannot be read.
    """
    data = read_regular(path, "a MATLAB file", _LARGEST)
    # MATLAB puts 512 bytes of its own in front of the mark of HDF5, which is 8 bytes long.
    if data[:520].find(HDF5_MAGIC) >= 0 or data.startswith(b"MATLAB 7.3"):
        return _from_hdf5(path, "mat 7.3", data)
    sets = DataSets(Budget(str(path), len(data)))
    try:
        read = mat_file.read_mat(data, sets.budget)
    except mat_file.DamagedMatFile as e:
        raise wrong(str(path), f"is no whole MATLAB file: {e}") from e
    if read.objects:
        if not any(x.size > 1 for x in read.arrays.values()):
            name, kind = next(iter(read.objects.items()))
            problem = (
                f"holds {shown(name)}, a {kind} of MATLAB, which is no array; save its numbers"
            )
            way = f"writetable or writetimetable({name}, 'flight.csv') writes what is read"
            raise wrong(str(path), f"{problem} as arrays, or of a table {way}")
        each = listed(f"{shown(n)} ({kind})" for n, kind in read.objects.items())
        sets.note(note(LEFT_OUT, f"objects of MATLAB are left out: {each}", *read.objects))
    for name, array in read.arrays.items():
        sets.add(name, array, {})
    sets.labels |= read.texts
    for name, texts in as_lists(read.texts).items():
        sets.add_texts(name, texts)
    return sets.table(str(path), "mat", data)


def _vectors(name: str, value: np.ndarray) -> Iterator[tuple[str, np.ndarray]]:
    # Text and complex numbers are no samples.
    if value.dtype.kind not in "biuf" or value.ndim > 2 or not value.size:
        return
    # MATLAB knows no vector: what it calls one is a matrix of a single row or column.
    if value.ndim < 2 or 1 in value.shape:
        yield name, value.ravel()
        return
    # Samples run along the longer side.
    table = value if value.shape[0] >= value.shape[1] else value.T
    # Quaternions and motors are matrices of a few columns. An image would fill the list of
    # channels.
    for i in range(min(table.shape[1], _MOST_ELEMENTS)):
        yield f"{name}[{i}]", table[:, i]


def open_netcdf(path: Path) -> ArrayTable:
    """A NetCDF file; of version 4 where a reader of HDF5 is installed.

    Raises:
        InputError: it is none, it is damaged, or it holds no arrays of numbers.
        OSError: it cannot be read.
    """
    data = read_regular(path, "a NetCDF file", _LARGEST)
    if data.startswith(HDF5_MAGIC):
        return _from_hdf5(path, "netcdf", data)
    if not data.startswith((b"CDF\x01", b"CDF\x02")):
        raise wrong(str(path), "is no NetCDF file, expected one that begins with its mark")
    import xarray

    def read() -> DataSets:
        # Nothing is decoded: times stay numbers, of which `time_unit` knows what they are, and
        # numbers are unpacked here as those of HDF5 are.
        # The engine is named, so that what else is installed does not decide which library reads
        # the file.
        with xarray.open_dataset(io.BytesIO(data), engine="scipy", decode_cf=False) as file:
            read = DataSets(Budget(str(path), len(data)))
            for name, variable in file.variables.items():
                read.add(str(name), np.asarray(variable.values), variable.attrs)
            return read

    return guarded(path, "NetCDF file", read).table(str(path), "netcdf", data)


def open_numpy(path: Path) -> ArrayTable:
    """A file of NumPy: one array (.npy), or several by name (.npz).

    Without pickle, which would run what a file says: arrays of Python's objects are passed over.

    Raises:
        InputError: it is none, it is damaged, or it holds no arrays of numbers.
        OSError: it cannot be read.
    """
    where = str(path)
    data = read_regular(path, "a file of NumPy", _LARGEST)
    sets, objects = DataSets(Budget(where, len(data))), []

    def read() -> None:
        for name, content in _arrays(data, sets.budget):
            file = io.BytesIO(content)
            version = np.lib.format.read_magic(file)
            header = np.lib.format.read_array_header_1_0 if version == (1, 0) else None
            shape, _, dtype = (header or np.lib.format.read_array_header_2_0)(file)
            if dtype.hasobject:
                objects.append(name)
            # What is claimed beyond the bytes that there are would be allocated.
            elif np.prod(shape, dtype=object) * dtype.itemsize > len(content) or not dtype.itemsize:
                raise ValueError("cut off")
            else:
                _add(sets, name, np.load(io.BytesIO(content), allow_pickle=False))

    guarded(path, "file of NumPy", read)
    if objects:
        words = f"objects of Python, which are not read: {listed(map(shown, objects))}"
        if not sets.names:
            problem = f"holds {words}; expected arrays of numbers, numpy.savez(FILE, t=t, p=p)"
            raise wrong(where, problem)
        sets.note(note(LEFT_OUT, words, *objects))
    return sets.table(where, "numpy", data)


def _arrays(data: bytes, budget: Budget) -> Iterator[tuple[str, bytes]]:
    """The arrays of a file by name, each as a .npy file has it."""
    if data.startswith(NUMPY_MAGIC):
        yield "data", data
        return
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = archive.infolist()[:_MOST_ARRAYS]
        budget.take(sum(m.file_size for m in members))
        for member in members:
            if member.filename.endswith(".npy"):
                yield member.filename.removesuffix(".npy"), archive.read(member)


def _add(sets: "DataSets", name: str, array: np.ndarray) -> None:
    kind = array.dtype.kind
    if array.dtype.names is not None:
        for field in array.dtype.names:
            _add(sets, f"{name}.{field}" if name != "data" else field, array[field])
    elif kind in "US" and 0 < array.size <= _MOST_ELEMENTS:
        sets.add_texts(name, [str(x)[:1000] for x in array.astype(str).ravel()])
    elif kind in "mM":
        unit, count = np.datetime_data(array.dtype)
        if unit in ("s", "ms", "us", "ns") and count == 1:
            ticks = array.astype(np.int64).astype(np.float64)
            sets.add(name, np.where(np.isnat(array), np.nan, ticks), {"units": unit})
    elif holds_numbers(array.dtype, array.ndim):
        # In the machine's own order of bytes.
        sets.add(name, array.astype(array.dtype.newbyteorder("=")), {})
    else:
        sets.leave_out(name, array.dtype, array.shape)


class DataSets:
    """What is read of a file whose data sets have attributes."""

    def __init__(self, budget: Budget) -> None:
        self.budget = budget
        self.labels: dict[str, str] = {}
        """texts by path"""
        self._stored: dict[str, np.ndarray] = {}
        self._units: dict[str, str] = {}
        self._texts: dict[str, list[str]] = {}
        self._missing: dict[str, int] = {}
        self._left_out: dict[str, str] = {}
        self._notes: list[Finding] = []

    @property
    def names(self) -> tuple[str, ...]:
        """Of the data sets."""
        return tuple(self._stored)

    def note(self, finding: Finding) -> None:
        """What else is to be said of the file."""
        self._notes.append(finding)

    def add(self, name: str, stored: np.ndarray, attributes: Mapping[str, Any]) -> None:
        """One data set, unpacked; `attributes` are all that it has, or those that count."""
        self.budget.take_numbers(stored.size, stored.nbytes)
        if stored.dtype.kind == "c":
            self._left_out[name] = "which is complex"
            return
        packing = {n: attributes[n] for n in packed.ATTRIBUTES if n in attributes}
        try:
            values, missing = packed.unpack(stored, packing)
        except packed.Packing as e:
            self._left_out[name] = str(e)
            return
        if missing:
            self._missing[name] = missing
        stated = next((attributes[n] for n in packed.UNIT_ATTRIBUTES if n in attributes), "")
        self._stored[name] = values
        self._units[name] = packed.text_of(stated)

    def leave_out(self, name: str, kind: np.dtype, shape: tuple[int, ...] | None) -> None:
        """Say that numbers are not read, where they are of too many dimensions to be a log's."""
        if shape and kind.kind in "biuf":
            self._left_out[name] = f"which has {len(shape)} dimensions"

    def add_texts(self, name: str, texts: Sequence[Any]) -> None:
        """A list of texts, by which columns may be called."""
        self._texts[name] = [packed.text_of(text).strip("\0 ") for text in texts]

    def table(self, path: str, kind: str, data: bytes) -> ArrayTable:
        """All of them."""
        return ArrayTable(path, kind, data, *self.vectors())

    def vectors(self) -> tuple[dict[str, np.ndarray], dict[str, str], tuple[Finding, ...]]:
        """Arrays (N,) and units by name, and notes."""
        notes = list(self._notes)
        if self._missing:
            each = listed(f"{shown(name)} ({n})" for name, n in self._missing.items())
            words = f"the file's marks for no value are taken as missing samples: {each}"
            total = sum(self._missing.values())
            notes.append(note("samples.marks", words, *self._missing, value=total))
        if self._left_out:
            words = listed(f"{shown(n)}, {why}" for n, why in self._left_out.items())
            notes.append(note(LEFT_OUT, f"left out: {words}", *self._left_out))
        whole, units_beside = labelled(self._stored, self.labels)
        stated = self._units | units_beside
        flat, of_stacks = unstacked(whole)
        arrays, units = {}, {}
        for name, values in flat.items():
            names, beside = named_columns(name, values, self._texts)
            for i, (part, vector) in enumerate(_vectors(name, values)):
                called = f"{name}.{names[i]}" if names else part
                arrays[called] = vector
                units[called] = (beside[i] if beside else "") or stated.get(name, "")
        return arrays, units, (*notes, *of_stacks)


def open_hdf5(path: Path) -> ArrayTable:
    """An HDF5 file, where h5py is installed.

    Raises:
        InputError: it is none, it is damaged, it holds no arrays of numbers, or h5py is missing.
        OSError: it cannot be read.
    """
    data = read_regular(path, "an HDF5 file", _LARGEST)
    if not data.startswith(HDF5_MAGIC):
        raise wrong(str(path), "is no HDF5 file, expected one that begins with its mark")
    return _from_hdf5(path, "hdf5", data)


def _from_hdf5(path: Path, kind: str, data: bytes) -> ArrayTable:
    """The file as `hdf5_file` reads it, in a process of its own.

    Raises:
        InputError: of that process, or it ended otherwise, or went on for too long.
    """
    if importlib.util.find_spec("h5py") is None:
        problem = "is an HDF5 file inside, for which h5py is needed: pip install 'heli_jax[logs]'"
        raise wrong(str(path), problem)
    seconds = _SECONDS + len(data) // _RATE
    arguments = (str(path), kind, str(len(data)), str(seconds))
    process = subprocess.Popen(
        [sys.executable, "-P", "-m", "heli_jax.flights.hdf5_file", *arguments],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        env=import_path.environment() | {"OPENBLAS_NUM_THREADS": "1"},
    )
    # Where the system sets no limit to its processor time.
    watch = threading.Timer(_PATIENCE * seconds, process.kill)
    watch.daemon = True
    watch.start()
    try:
        with process:
            answer: Any = process.stdout
            head = json.loads(answer.readline() or "{}")
            arrays = {}
            for name, dtype, size in head.get("arrays", ()):
                arrays[name] = np.empty(size, dtype)
                answer.readinto(arrays[name].view(np.uint8))
    finally:
        watch.cancel()
    if "error" in head:
        raise InputError(head["error"])
    if process.returncode:
        slow = f"took more than {seconds} s to read: it is damaged, or save it without compression"
        ended = process.returncode in (-signal.SIGKILL, -getattr(signal, "SIGXCPU", 0))
        raise wrong(str(path), slow if ended else "is no whole HDF5 file (its reader crashed)")
    notes = tuple(
        note(code, words, *names, value=value) for code, words, names, value in head["notes"]
    )
    return ArrayTable(str(path), kind, data, arrays, head["units"], notes)


def holds_numbers(kind: np.dtype, dimensions: int) -> bool:
    """Whether a data set is an array of numbers, or a table of named fields that are."""
    return dimensions <= (1 if kind.names else stacked.DEEPEST) and (
        bool(kind.names) or kind.kind in "biuf"
    )


def guarded[T](path: Path, what: str, read: Callable[[], T]) -> T:
    """What a library reads; whatever it raises of a damaged file is an error of that file."""
    import warnings

    try:
        # What a library warns of while it reads a damaged file is about its own functions. The
        # sentence below is the one that names the file.
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return read()
    # Each library raises what its parser stumbles over: KeyError, TypeError, zlib.error, ...
    except (Exception, MemoryError) as e:
        # Our own refusals, such as too many values, say more than that the file is not whole.
        if isinstance(e, InputError):
            raise
        raise wrong(str(path), f"is no whole {what} ({type(e).__name__})") from e
