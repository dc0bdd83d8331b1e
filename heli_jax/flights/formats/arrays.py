"""Named arrays as a table: packed numbers, stacked runs, separate clocks.

The readers of MATLAB, NetCDF, HDF5 and NumPy files collect `DataSets`. An array's name is its
path: `log.roll.data` in MATLAB's structures, `log/roll` in HDF5.

Sources of the packing: the CF conventions 1.11, sections 2.5.1 and 8.1, and the attribute
conventions of the NetCDF User's Guide.
"""

import hashlib
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from heli_jax.finding import LEFT_OUT, Finding, note
from heli_jax.flights.clock import SECONDS, is_called_time, likely_unit, split_unit, time_unit
from heli_jax.flights.log import (
    Budget,
    ChannelLog,
    Survey,
    Table,
    Topic,
    column,
    listed,
    require_columns,
    require_few_columns,
    sample_count,
    shown,
    wrong,
)

LARGEST = 10**9
"""Largest file [bytes]."""
MOST_ELEMENTS = 100
"""Most columns of a matrix, or elements of a list; more do not belong to a log."""
PACKING = ("scale_factor", "add_offset", "_FillValue", "missing_value", "_Unsigned")
"""Attributes that describe the packing of numbers."""
UNIT_ATTRIBUTES = ("units", "unit", "Units", "Unit")
SEGMENT = "segment"
"""Name of the column that numbers stacked runs, from 1."""
_DEEPEST = 3
"""Most dimensions of an array: those of a stack of runs."""
_FEWEST = 10
"""Fewest samples of a run; below it, small matrices are no stack."""
_LEVEL = re.compile(r"[./]")


class ArrayTable:
    """`Table` of arrays, each (N,); arrays requested together must have one length."""

    def __init__(
        self,
        path: str,
        kind: str,
        data: bytes,
        arrays: Mapping[str, np.ndarray],
        units: Mapping[str, str],
        notes: tuple[Finding, ...] = (),
    ) -> None:
        self.path, self.format, self.size, self.notes = path, kind, len(data), notes
        self.sha256 = hashlib.sha256(data).hexdigest()
        self.names = tuple(arrays)
        self._arrays, self.units = arrays, units
        if not arrays:
            raise wrong(path, "holds no rows of numbers, expected a log")
        require_few_columns(path, len(arrays))

    def numbers(self, names: Sequence[str]) -> dict[str, np.ndarray]:
        """Return the arrays as float64 (N,)."""
        require_columns(self.path, self.names, names)
        arrays = {name: np.asarray(self._arrays[name], np.float64) for name in names}
        # A summary of two numbers beside a log matters only if it is requested.
        first = next(iter(names))
        other = next((n for n in names if arrays[n].size != arrays[first].size), None)
        if other is not None:
            problem = f"has {arrays[other].size} samples, expected {arrays[first].size}"
            raise wrong(self.path, f"{problem} as {shown(first)} has", column(other))
        return arrays

    def survey(self) -> list[Survey]:
        """Survey every array, in the file's order."""
        return [
            Survey(name, np.asarray(values, np.float64), values.size)
            for name, values in self._arrays.items()
        ]

    def place(self, row: int) -> str:
        """Return the place of a row; `row 1` is the first."""
        return f"row {row + 1}"

    def cell_text(self, name: str, row: int) -> str:
        """Return the text of a cell."""
        return repr(self._arrays[name][row].item())[:40]

    def time_unit(self, name: str) -> str | None:
        """Return the unit that the file states, if it is one of time."""
        return time_unit(self.units.get(name, ""))


class DataSets:
    """Arrays, texts and attributes of a file, by path."""

    def __init__(self, budget: Budget) -> None:
        self.budget = budget
        self._stored: dict[str, np.ndarray] = {}
        self._units: dict[str, str] = {}
        self._missing: dict[str, int] = {}
        self._left_out: dict[str, str] = {}

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the data sets."""
        return tuple(self._stored)

    @property
    def longest(self) -> int:
        """Size of the largest data set."""
        return max((x.size for x in self._stored.values()), default=0)

    def add(self, name: str, stored: np.ndarray, attributes: Mapping[str, Any]) -> None:
        """Add one data set, unpacked; `attributes` are all or the relevant ones."""
        self.budget.take_numbers(stored.size, stored.nbytes)
        if stored.dtype.kind == "c" or stored.ndim > _DEEPEST:
            self.leave_out(name, f"{stored.dtype} of {stored.ndim} dimensions")
            return
        try:
            values, missing = unpack(stored, {n: attributes[n] for n in PACKING if n in attributes})
        except Packing as e:
            self.leave_out(name, str(e))
            return
        if missing:
            self._missing[name] = missing
        stated = next((attributes[n] for n in UNIT_ATTRIBUTES if n in attributes), "")
        self._stored[name], self._units[name] = values, text_of(stated)

    def leave_out(self, name: str, why: str) -> None:
        """Note content that is no signal."""
        self._left_out[name] = why

    def table(self, path: str, kind: str, data: bytes) -> ArrayTable:
        """Return all data sets as a table."""
        return ArrayTable(path, kind, data, *self.vectors())

    def vectors(self) -> tuple[dict[str, np.ndarray], dict[str, str], tuple[Finding, ...]]:
        """Return arrays (N,) and units by name, and notes."""
        notes = []
        if self._missing:
            each = listed(f"{shown(name)} ({n})" for name, n in self._missing.items())
            words = f"fill values of the file are missing samples: {each}"
            total = sum(self._missing.values())
            notes.append(note("samples.marks", words, *self._missing, value=total))
        if self._left_out:
            words = listed(f"{shown(n)} ({why})" for n, why in self._left_out.items())
            notes.append(note(LEFT_OUT, f"left out: {words}", *self._left_out))
        flat, of_stacks = _unstacked(self._stored)
        arrays, units_of = {}, {}
        for name, values in flat.items():
            for part, vector in _vectors(name, values):
                arrays[part], units_of[part] = vector, self._units.get(name, "")
        return arrays, units_of, (*notes, *of_stacks)


def _vectors(name: str, value: np.ndarray) -> Iterator[tuple[str, np.ndarray]]:
    if value.dtype.kind not in "biuf" or value.ndim > 2 or not value.size:
        return
    # MATLAB has no vectors, only matrices of a single row or column.
    if value.ndim < 2 or 1 in value.shape:
        yield name, value.ravel()
        return
    # Samples are along the longer side.
    table = value if value.shape[0] >= value.shape[1] else value.T
    for i in range(min(table.shape[1], MOST_ELEMENTS)):
        yield f"{name}[{i}]", table[:, i]


def holds_numbers(kind: np.dtype, dimensions: int) -> bool:
    """True for an array of numbers, or a table of named fields."""
    return dimensions <= 1 if kind.names else kind.kind in "biuf" and dimensions <= _DEEPEST


class Packing(ValueError):
    """Reason why a packing attribute cannot be understood."""


def unpack(stored: np.ndarray, attributes: Mapping[str, object]) -> tuple[np.ndarray, int]:
    """Unpack stored numbers; return them, NaN if missing or invalid, and the count missing.

    Raises:
        Packing: a scale or an offset is no number.
    """
    if stored.dtype.kind not in "iuf" or not attributes:
        return stored, 0
    kind = {"true": "u", "false": "i"}.get(text_of(attributes.get("_Unsigned")).lower())
    if kind and stored.dtype.kind in "iu":
        # NetCDF 3 has no unsigned numbers and marks them by an attribute.
        stored = stored.view(stored.dtype.str.replace(stored.dtype.kind, kind))
    missing = np.zeros(stored.shape, bool)
    for name in ("_FillValue", "missing_value"):
        for mark in _numbers(attributes.get(name, ())):
            # Compared in the stored type: no float32 equals the float64 -9999.9, and the mark of an
            # unsigned byte often has a sign.
            with np.errstate(all="ignore"):
                same = np.asarray(mark).astype(stored.dtype)
                whole = bool(mark == np.rint(mark)) and abs(mark) < 2.0 ** (8 * same.itemsize)
            if stored.dtype.kind == "f" or whole:
                missing |= stored == same
    scale, offset = _one(attributes, "scale_factor", 1.0), _one(attributes, "add_offset", 0.0)
    values = stored
    if (scale, offset) != (1.0, 0.0):
        values = stored.astype(np.float64) * scale + offset
    count = int(np.count_nonzero(missing))
    return (np.where(missing, np.nan, values.astype(np.float64)) if count else values), count


def text_of(attribute: object) -> str:
    """Return the text of an attribute, also from bytes or an array of one; empty for any other."""
    if isinstance(attribute, np.ndarray) and attribute.size == 1:
        attribute = attribute.ravel()[0]
    if isinstance(attribute, bytes):
        attribute = attribute.decode("utf-8", "replace")
    return attribute.strip("\0 ") if isinstance(attribute, str) else ""


def _one(attributes: Mapping[str, object], name: str, otherwise: float) -> float:
    if name not in attributes:
        return otherwise
    numbers = _numbers(attributes[name])
    number = float(numbers[0]) if numbers.size == 1 else float("nan")
    if not np.isfinite(number) or (name == "scale_factor" and number == 0):
        raise Packing(f"because its {name} is no valid number")
    return number


def _numbers(attribute: object) -> np.ndarray:
    """Return the numbers of an attribute (n,), which may be a text; empty if it has none."""
    if text := text_of(attribute):
        try:
            return np.array([float(text)])
        except ValueError:
            return np.empty(0)
    numbers = np.atleast_1d(np.asarray(attribute)).ravel()
    return numbers if numbers.dtype.kind in "biuf" else np.empty(0)


# Runs stored as a stack, (segment, sample, channel), as in data sets for learning.


def _unstacked(
    arrays: Mapping[str, np.ndarray],
) -> tuple[Mapping[str, np.ndarray], tuple[Finding, ...]]:
    """Return arrays of at most two dimensions, and notes.

    Stacks become matrices (segment times sample, channel), and a column numbers the segments.
    """
    cubes = {n: x for n, x in arrays.items() if x.ndim == _DEEPEST and x.size}
    if not cubes:
        return arrays, ()
    shape = next(iter(cubes.values())).shape[:2]
    clocks = {n: x for n, x in arrays.items() if is_called_time(n) and x.ndim < _DEEPEST}
    # Images and rotation matrices, (sample, row, column), have times of other lengths.
    if (
        shape[1] < _FEWEST
        or any(x.shape[:2] != shape for x in cubes.values())
        or any(x.shape != shape and x.size != shape[1] for x in clocks.values() if x.size > 1)
    ):
        why = "runs are read only from arrays (run, sample, channel) with a time for each sample"
        shapes = listed(f"{shown(n)} {x.shape}" for n, x in cubes.items())
        notices = note(LEFT_OUT, f"left out, since {why}: {shapes}", *cubes)
        return {n: x for n, x in arrays.items() if n not in cubes}, (notices,)
    made = dict(arrays)
    for name, values in arrays.items():
        if values.shape[:2] == shape:
            made[name] = values.reshape(shape[0] * shape[1], -1)
        elif name in clocks and values.size == shape[1]:
            made[name] = np.tile(values.ravel(), shape[0])
    if shape[0] > 1:
        made.setdefault(SEGMENT, np.repeat(np.arange(1.0, shape[0] + 1.0), shape[1]))
    words = (
        f"stacked arrays: {shape[0]} segments of {shape[1]} samples, joined; "
        f"{SEGMENT!r} numbers them"
    )
    return made, (note("channels.stacked", words, *cubes, value=shape[0]),)


# Arrays with separate clocks, by their place in a file: `log.imu.t` is the time of `log.imu.gx` and
# `log.rc.t` that of `log.rc.aileron`.


def by_clocks(table: ArrayTable) -> ChannelLog | None:
    """Return arrays as topics, or None if all have one clock.

    A topic has the times of its group, or of the nearest group above with times of its length.
    """
    arrays = {s.name: s.values for s in table.survey() if s.values is not None}
    clocks: dict[str, np.ndarray] = {}
    for name, stamps in arrays.items():
        if is_called_time(name) and stamps.size > 1 and np.all(stamps[1:] > stamps[:-1]):
            leaf = _LEVEL.split(name)[-1]
            unit = table.time_unit(name) or split_unit(leaf)[1] or likely_unit(stamps)
            with np.errstate(over="ignore"):  # for a damaged file
                clocks[name] = stamps * SECONDS[unit]
    of_clock: dict[str, list[str]] = {}
    without = []
    for name, x in arrays.items():
        if name not in clocks and x.size > 1:
            clock = _clock_of(name, x.size, clocks)
            of_clock.setdefault(clock, []).append(name) if clock else without.append(name)
    if len(of_clock) < 2:
        return None
    notes, topics = table.notes, []
    for clock, names in of_clock.items():
        units_of = {n: table.units.get(n, "") for n in names}
        topics.append(Topic(clock, clocks[clock], {n: arrays[n] for n in names}, units_of, clock))
    if without:
        each = listed(f"{shown(n)} ({sample_count(arrays[n].size)})" for n in without)
        words = "their groups have no time of their length, or several"
        notes = (*notes, note(LEFT_OUT, f"left out, since {words}: {each}", *without))
    return ChannelLog.of_table(table, tuple(topics), notes=notes)


def _clock_of(name: str, size: int, clocks: Mapping[str, np.ndarray]) -> str | None:
    """Return the clock of an array; None without one in the groups above it, or with several."""
    group = _LEVEL.split(name)[:-1]
    for depth in range(len(group), -1, -1):
        near = [
            c for c, t in clocks.items() if _LEVEL.split(c)[:-1] == group[:depth] and t.size == size
        ]
        if near:
            return near[0] if len(near) == 1 else None
    return None


def clock_notes(table: Table) -> tuple[Finding, ...]:
    """Return a note if arrays have separate clocks."""
    log = by_clocks(table) if isinstance(table, ArrayTable) else None
    if log is None:
        return ()
    topics = listed(f"{shown(t.name)} of {len(t.columns)}" for t in log.topics)
    words = f"arrays have their own clocks, used if no time is stated: {topics}"
    return (note("clock.of-arrays", words, value=len(log.topics)),)
