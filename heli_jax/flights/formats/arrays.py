"""Named arrays as a table: names and units that stand beside them, packed numbers, stacked runs.

The readers of MATLAB, NetCDF, HDF5, NumPy and JSON files collect `DataSets`; an array's name is its
path, `log.roll.data` in MATLAB's structures, `log/roll` in HDF5.

Sources of the packing: the CF conventions 1.11, sections 2.5.1 and 8.1, and the attribute
conventions of the NetCDF User's Guide.
"""

import hashlib
import itertools
import re
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from heli_jax import units
from heli_jax.errors import InputError
from heli_jax.finding import LEFT_OUT, Finding, note
from heli_jax.flights.channel_names import words_in
from heli_jax.flights.clock import contradicted_rate
from heli_jax.flights.log import ChannelLog, Topic, sharing_clocks
from heli_jax.flights.table import (
    Budget,
    Survey,
    Table,
    column,
    listed,
    require_columns,
    require_few_columns,
    sample_count,
    shown,
    wrong,
)
from heli_jax.flights.time_units import SECONDS, TIME_NAMES, likely_unit, split_unit, time_unit

LARGEST = 10**9
"""bytes of a file"""
MOST_ELEMENTS = 100
"""columns of a matrix, or elements of a list: more are data of another shape than a log's"""
PACKING = (
    *("scale_factor", "add_offset", "_FillValue", "missing_value", "_Unsigned"),
    *("valid_range", "valid_min", "valid_max"),
)
"""attributes that say how numbers are packed"""
UNIT_ATTRIBUTES = ("units", "unit", "Units", "Unit")
SEGMENT = "segment"
"""name of the column that numbers stacked runs, from 1"""
_DEEPEST = 3
"""dimensions of an array that may be a stack of runs"""
_FEWEST = 10
"""samples of a run, below which matrices of a few numbers are no stack"""
_FEWEST_SHARED = 3
"""letters by which a matrix and a list of names belong together: OutputData, OutputName"""
_LABELS, _UNITS = ("label", "name", "signalname"), ("unit", "units")
_NAMES = {
    *("name", "names", "label", "labels", "columns", "column", "channel", "channels", "items"),
    *("header", "headers", "fields", "signals", "variables", "varnames", "legend", "colheaders"),
    *("ch", "component", "components", "axis", "state", "states", "output", "outputs", "input"),
    *("inputs", "sensor", "sensors", "var", "vars", "param", "params", "parameters"),
}
"""words in the name of a list of texts that names columns"""
_INDEXED = re.compile(r"(.*)\[\d+\]")
_LEVEL = re.compile(r"[./]")


class ArrayTable:
    """A `Table` on arrays, each (N,); those asked for together have to be of one length."""

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
        """The arrays as float64 (N,)."""
        require_columns(self.path, self.names, names)
        arrays = {name: np.asarray(self._arrays[name], np.float64) for name in names}
        # A summary of two numbers beside a log does no harm unless it is asked for.
        first = next(iter(names))
        other = next((n for n in names if arrays[n].size != arrays[first].size), None)
        if other is not None:
            problem = f"has {arrays[other].size} samples, expected {arrays[first].size}"
            raise wrong(self.path, f"{problem} as {shown(first)} has", column(other))
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
        """Text of a cell."""
        return repr(self._arrays[name][row].item())[:40]

    def time_unit(self, name: str) -> str | None:
        """The unit that the file states, where it is one of time."""
        return time_unit(self.units.get(name, ""))


class DataSets:
    """Arrays, texts and attributes as a file has them, by path."""

    def __init__(self, budget: Budget) -> None:
        self.budget = budget
        self.notes: list[Finding] = []
        self.labels: dict[str, str] = {}
        """single texts; those of `names[0]`, `names[1]` are a list too"""
        self._stored: dict[str, np.ndarray] = {}
        self._units: dict[str, str] = {}
        self._texts: dict[str, list[str]] = {}
        self._missing: dict[str, int] = {}
        self._left_out: dict[str, str] = {}

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the data sets."""
        return tuple(self._stored)

    @property
    def longest(self) -> int:
        """Numbers of the largest data set."""
        return max((x.size for x in self._stored.values()), default=0)

    def add(self, name: str, stored: np.ndarray, attributes: Mapping[str, Any]) -> None:
        """Add one data set, unpacked; `attributes` are all that it has, or those that count."""
        self.budget.take_numbers(stored.size, stored.nbytes)
        if stored.dtype.kind == "c":
            self._left_out[name] = "which is complex"
            return
        if stored.ndim > _DEEPEST:
            self.leave_out(name, stored.dtype, stored.shape)
            return
        try:
            values, missing = unpack(stored, {n: attributes[n] for n in PACKING if n in attributes})
        except Packing as e:
            self._left_out[name] = str(e)
            return
        if missing:
            self._missing[name] = missing
        stated = next((attributes[n] for n in UNIT_ATTRIBUTES if n in attributes), "")
        self._stored[name], self._units[name] = values, text_of(stated)

    def leave_out(self, name: str, kind: np.dtype, shape: tuple[int, ...] | None) -> None:
        """Note numbers that are not read, where they are of too many dimensions to be a log's."""
        if shape and kind.kind in "biuf":
            self._left_out[name] = f"which has {len(shape)} dimensions"

    def add_texts(self, name: str, texts: Sequence[Any]) -> None:
        """Add a list of texts, by which columns may be called."""
        self._texts[name] = [text_of(text).strip("\0 ") for text in texts]

    def table(self, path: str, kind: str, data: bytes) -> ArrayTable:
        """All of them."""
        return ArrayTable(path, kind, data, *self.vectors())

    def vectors(self) -> tuple[dict[str, np.ndarray], dict[str, str], tuple[Finding, ...]]:
        """Arrays (N,) and units by name, and notes."""
        notes = list(self.notes)
        if self._missing:
            each = listed(f"{shown(name)} ({n})" for name, n in self._missing.items())
            words = f"the file's marks for no value are taken as missing samples: {each}"
            total = sum(self._missing.values())
            notes.append(note("samples.marks", words, *self._missing, value=total))
        if self._left_out:
            words = listed(f"{shown(n)}, {why}" for n, why in self._left_out.items())
            notes.append(note(LEFT_OUT, f"left out: {words}", *self._left_out))
        texts = dict(self._texts)
        for path, text in self.labels.items():
            match = _INDEXED.fullmatch(path)
            texts.setdefault(match[1] if match else path, []).append(text)
        whole, units_beside = _labelled(self._stored, self.labels)
        stated = self._units | units_beside
        flat, of_stacks = _unstacked(whole)
        arrays, units_of = {}, {}
        for name, values in flat.items():
            names, beside = _named_columns(name, values, texts)
            for i, (part, vector) in enumerate(_vectors(name, values)):
                called = f"{name}.{names[i]}" if names else part
                arrays[called] = vector
                units_of[called] = (beside[i] if beside else "") or stated.get(name, "")
        return arrays, units_of, (*notes, *of_stacks)


def _vectors(name: str, value: np.ndarray) -> Iterator[tuple[str, np.ndarray]]:
    if value.dtype.kind not in "biuf" or value.ndim > 2 or not value.size:
        return
    # MATLAB knows no vector: what it calls one is a matrix of a single row or column.
    if value.ndim < 2 or 1 in value.shape:
        yield name, value.ravel()
        return
    # Samples run along the longer side.
    table = value if value.shape[0] >= value.shape[1] else value.T
    for i in range(min(table.shape[1], MOST_ELEMENTS)):
        yield f"{name}[{i}]", table[:, i]


def holds_numbers(kind: np.dtype, dimensions: int) -> bool:
    """True for an array of numbers, or a table of named fields."""
    return dimensions <= (1 if kind.names else _DEEPEST) and (
        bool(kind.names) or kind.kind in "biuf"
    )


def guarded[T](path: Path, what: str, read: Callable[[], T]) -> T:
    """Read with a library; any exception over a damaged file becomes an error of that file."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return read()
    # Each library raises what its parser stumbles over: KeyError, TypeError, zlib.error, ...
    except (Exception, MemoryError) as e:
        if isinstance(e, InputError):
            raise
        raise wrong(str(path), f"is no whole {what} ({type(e).__name__})") from e


# Names and units that a file has as texts beside its arrays. Simulink's structures with time have
# `values` and `label`, dSPACE's `Data`, `Name` and `Unit`; identification toolboxes keep
# `OutputData` beside `OutputName`, ground stations `ATT` beside `ATT_label`, pandas `block0_values`
# beside `block0_items`.


def _labelled(
    arrays: Mapping[str, np.ndarray], texts: Mapping[str, str]
) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """Arrays of structures' elements called by their labels, `out.signals.phi`, where all labels
    differ, and the units that stand beside them."""
    beside: dict[str, dict[str, str]] = {}
    for path, text in texts.items():
        element, _, field = path.rpartition(".")
        beside.setdefault(element, {})[field.casefold()] = text
    samples: dict[str, list[str]] = {}
    for path, values in arrays.items():
        if values.size > 1:
            samples.setdefault(path.rpartition(".")[0], []).append(path)
    names, stated = {}, {}
    for element, (path, *others) in samples.items():
        said = beside.get(element, {})
        # Of an element with several arrays of samples label and unit may be those of any.
        if others or not said:
            continue
        if unit := next((said[u] for u in _UNITS if u in said), ""):
            stated[path] = unit
        label = next((said[n] for n in _LABELS if n in said), "")
        if label and (match := _INDEXED.fullmatch(element)):
            names[path] = f"{match[1]}.{label}"
    taken = [names.get(path, path) for path in arrays]
    names = {path: name for path, name in names.items() if taken.count(name) == 1}
    return (
        {names.get(path, path): values for path, values in arrays.items()},
        {names.get(path, path): unit for path, unit in stated.items()},
    )


def _named_columns(
    path: str, array: np.ndarray, texts: Mapping[str, Sequence[str]]
) -> tuple[Sequence[str], Sequence[str]]:
    """The names and the units of a matrix's columns, each empty where nothing states them."""
    if array.dtype.kind not in "biuf" or array.ndim > 2 or array.size < 2:
        return (), ()
    count, own = 1 if array.ndim < 2 else min(array.shape), _LEVEL.split(path)
    names, units_of = {}, {}
    for other, each in texts.items():
        *group, leaf = _LEVEL.split(other)
        if group != own[:-1] or len(each) != count:
            continue
        words = set(words_in(leaf))
        if words & set(_UNITS):
            if any(time_unit(t) or units.is_unit(t) for t in each):
                units_of[leaf.casefold()] = each
        elif words & _NAMES and all(each) and len(set(each)) == count:
            names[leaf.casefold()] = each
    leaf = own[-1].casefold()
    return _belonging(leaf, count, names), _belonging(leaf, count, units_of)


def _belonging(own: str, count: int, lists: Mapping[str, Sequence[str]]) -> Sequence[str]:
    """The list that belongs to an array: the one called most alike; empty where several might."""
    shared = {}
    for leaf in lists:
        pairs = zip(own, leaf, strict=False)
        shared[leaf] = sum(1 for _ in itertools.takewhile(lambda pair: pair[0] == pair[1], pairs))
    # The whole name of an array may be a letter: y and y_names.
    shared = {p: max(n, _FEWEST_SHARED) if n == len(own) else n for p, n in shared.items()}
    most = max(shared.values(), default=0)
    near = [texts for p, texts in lists.items() if shared[p] == most >= _FEWEST_SHARED]
    # A vector's own name says as much as a single text that happens to stand beside it.
    different = {tuple(texts) for texts in near or (() if count == 1 else lists.values())}
    return different.pop() if len(different) == 1 else ()


class Packing(ValueError):
    """An attribute that says how numbers are packed cannot be understood; in words which."""


def unpack(stored: np.ndarray, attributes: Mapping[str, object]) -> tuple[np.ndarray, int]:
    """Unpack stored numbers; return them with NaN for fills and invalid values, and the number
    missing.

    Raises:
        Packing: a scale or an offset is no number.
    """
    if stored.dtype.kind not in "iuf" or not attributes:
        return stored, 0
    kind = {"true": "u", "false": "i"}.get(text_of(attributes.get("_Unsigned")).lower())
    if kind and stored.dtype.kind in "iu":
        # NetCDF 3 has no unsigned numbers, and notes it.
        stored = stored.view(stored.dtype.str.replace(stored.dtype.kind, kind))
    missing = np.zeros(stored.shape, bool)
    for name in ("_FillValue", "missing_value"):
        for mark in _numbers(attributes.get(name, ())):
            # In the stored type: as float64, -9999.9 is none of a float32's numbers, and of an
            # unsigned byte the mark is often written with a sign.
            with np.errstate(all="ignore"):
                same = np.asarray(mark).astype(stored.dtype)
                whole = bool(mark == np.rint(mark)) and abs(mark) < 2.0 ** (8 * same.itemsize)
            if stored.dtype.kind == "f" or whole:
                missing |= stored == same
    scale, offset = _one(attributes, "scale_factor", 1.0), _one(attributes, "add_offset", 0.0)
    values = stored
    if (scale, offset) != (1.0, 0.0):
        values = stored.astype(np.float64) * scale + offset
    both = _numbers(attributes.get("valid_range", ()))
    for i, (name, beyond) in enumerate((("valid_min", np.less), ("valid_max", np.greater))):
        limits = _numbers(attributes.get(name, both[[i]] if both.size == 2 else ()))
        if limits.size == 1:
            # The range has the type of the packed numbers, or of the unpacked ones.
            of = stored if limits.dtype.kind in "iu" or values is stored else values
            limit = limits[0]
            if of.dtype.kind == "u" and limit < 0:
                limit = int(limit) + 2 ** (8 * of.dtype.itemsize)
            with np.errstate(invalid="ignore"):
                missing |= beyond(of, limit)
    count = int(np.count_nonzero(missing))
    return (np.where(missing, np.nan, values.astype(np.float64)) if count else values), count


def text_of(attribute: object) -> str:
    """The text of an attribute, which may be bytes or an array of one; empty of any other."""
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
        raise Packing(f"since its {name} is no number that packs")
    return number


def _numbers(attribute: object) -> np.ndarray:
    """The numbers of an attribute (n,); empty where it holds none. Some writers put them in a
    text."""
    if text := text_of(attribute):
        try:
            return np.array([float(text)])
        except ValueError:
            return np.empty(0)
    numbers = np.atleast_1d(np.asarray(attribute)).ravel()
    return numbers if numbers.dtype.kind in "biuf" else np.empty(0)


# Runs that a file has as a stack, (segment, sample, channel), as data sets for learning do.


def _unstacked(
    arrays: Mapping[str, np.ndarray],
) -> tuple[dict[str, np.ndarray], tuple[Finding, ...]]:
    """Arrays of at most two dimensions, stacks as matrices (segment times sample, channel) with a
    column that numbers the segments; and notes."""
    numeric = {n: x for n, x in arrays.items() if x.dtype.kind in "biuf"}
    cubes = {n: x for n, x in numeric.items() if x.ndim == _DEEPEST and x.size}
    if not cubes:
        return dict(arrays), ()
    # One time for each sample of one or more runs.
    times = {
        n: x
        for n, x in numeric.items()
        if _is_called_time(n) and 1 <= x.ndim <= 2 and max(x.shape) >= _FEWEST
    }
    shapes = {x.shape[:2] for x in cubes.values()}
    shape = shapes.pop() if len(shapes) == 1 else None
    # Images and rotation matrices, (sample, row, column), stand beside times or signals of one run.
    alone = (x for n, x in arrays.items() if x.ndim == 1 and n not in times)
    if shape is not None and (
        shape[1] < _FEWEST
        or any(x.shape != shape and x.size != shape[1] for x in times.values())
        or any(x.size == shape[1] for x in alone)
    ):
        shape = None
    notes, made = [], {}
    if shape is not None:
        for name, values in numeric.items():
            if name in times and values.size == shape[1]:
                made[name] = np.tile(values.ravel(), shape[0])
            elif values.shape[:2] == shape:
                made[name] = values.reshape(shape[0] * shape[1], -1)
        stacked = [n for n in made if n != SEGMENT]
        made = _without_padding(made, times, shape)
        padding = shape[0] * shape[1] - next(iter(made.values())).shape[0]
        words = f"{shape[0]} segments of {shape[1]} samples, put one after another"
        words += f" without {padding} that pad them" if padding else ""
        words = f"stacked arrays, {_shapes(stacked, arrays)}: {words}; {SEGMENT!r} numbers them"
        notes.append(note("channels.stacked", words, *stacked, value=shape[0]))
    left = [n for n in cubes if n not in made]
    if left:
        why = "runs are read of arrays (run, sample, channel), with a time for each sample"
        notes.append(note(LEFT_OUT, f"left out, since {why}: {_shapes(left, arrays)}", *left))
    kept = {n: x for n, x in {**arrays, **made}.items() if n not in left}
    return kept, tuple(notes)


def _is_called_time(name: str) -> bool:
    words = words_in(split_unit(_LEVEL.split(name)[-1])[0])
    return bool(words and TIME_NAMES & {words[0], words[-1]})


def _without_padding(
    made: Mapping[str, np.ndarray], times: Mapping[str, np.ndarray], shape: tuple[int, int]
) -> dict[str, np.ndarray]:
    """The stacked arrays with a number for each row's segment, without rows that fill up short
    segments."""
    # Behind a segment's last sample there are no values, or no times but zeros.
    values = [x.reshape((*shape, -1)) for n, x in made.items() if n not in times]
    used = [np.any([np.isfinite(x).any(axis=2) for x in values], axis=0)] if values else []
    used += [np.nan_to_num(x.reshape(shape)) != 0 for n, x in made.items() if n in times]
    lengths = np.min([shape[1] - np.argmax(is_used[:, ::-1], axis=1) for is_used in used], axis=0)
    kept = np.ravel(np.arange(shape[1]) < lengths[:, None])
    numbers = np.repeat(np.arange(1.0, shape[0] + 1.0), shape[1])
    own = {SEGMENT: numbers} if shape[0] > 1 and SEGMENT not in made else {}
    return {name: x[kept] for name, x in {**made, **own}.items()}


def _shapes(names: Sequence[str], arrays: Mapping[str, np.ndarray]) -> str:
    return listed(f"{shown(n)} {arrays[n].shape}" for n in names)


# Arrays that have clocks of their own by where they stand in a file: `log.imu.t` is the time of
# `log.imu.gx` and `log.rc.t` that of `log.rc.aileron`.


def by_clocks(table: ArrayTable) -> ChannelLog | None:
    """Return arrays as topics, each with the times of its group or of the nearest above that has
    some of its length; None where all have one clock."""
    arrays = {s.name: s.values for s in table.survey() if s.values is not None}
    clocks: dict[str, np.ndarray] = {}
    for name, stamps in arrays.items():
        if _is_called_time(name) and stamps.size > 1 and np.all(stamps[1:] > stamps[:-1]):
            leaf = _LEVEL.split(name)[-1]
            unit = table.time_unit(name) or split_unit(leaf)[1] or likely_unit(stamps)
            with np.errstate(over="ignore"):  # of a damaged file
                clocks[name] = stamps * SECONDS[unit]
    of_clock: dict[str, list[str]] = {}
    without = []
    for name, x in arrays.items():
        clock = _clock_of(name, x.size, clocks)
        if clock is None and x.size > 1:
            without.append(name)
        elif clock is not None and name not in clocks:
            of_clock.setdefault(clock, []).append(name)
    if len(of_clock) < 2:
        return None
    notes, topics, cautions = table.notes, [], []
    for clock, names in of_clock.items():
        units_of = {n: table.units.get(n, "") for n in names}
        columns = {n: arrays[n] for n in names}
        topics.append(Topic(clock, clocks[clock], columns, units_of, clock))
        cautions += contradicted_rate(table, clock, 1.0 / float(np.median(np.diff(clocks[clock]))))
    if without:
        each = listed(f"{shown(n)} ({sample_count(arrays[n].size)})" for n in without)
        words = "no time of their length, or several, stand in their groups"
        notes = (*notes, note(LEFT_OUT, f"left out, since {words}: {each}", *without))
    return ChannelLog.of_table(table, tuple(topics), notes=notes, cautions=tuple(cautions))


def _clock_of(name: str, size: int, clocks: Mapping[str, np.ndarray]) -> str | None:
    """The clock of an array; None where its group has none of its length, or several of which not
    one alone shares the other groups' time."""
    group = _LEVEL.split(name)[:-1]
    groups = {c: _LEVEL.split(c)[:-1] for c in clocks}
    for depth in range(len(group), -1, -1):
        near = [c for c, g in groups.items() if g == group[:depth] and clocks[c].size == size]
        others = [clocks[c] for c, g in groups.items() if g != group[:depth]]
        if len(near) > 1 and others:
            # GPS time of week beside the board's time.
            times = max(others, key=lambda x: x.size)
            shared = (float(times[0]), float(times[-1]))
            on_it = sharing_clocks({c: clocks[c] for c in near}, shared)
            near = [c for c in near if c in on_it]
        if near:
            return near[0] if len(near) == 1 else None
    return None


def clock_notes(table: Table) -> tuple[Finding, ...]:
    """Note that arrays have clocks of their own."""
    log = by_clocks(table) if isinstance(table, ArrayTable) else None
    if log is None:
        return ()
    topics = listed(f"{shown(t.name)} of {len(t.columns)}" for t in log.topics)
    words = f"arrays have clocks of their own, read where no time is stated: {topics}"
    return (note("clock.of-arrays", words, value=len(log.topics)),)
