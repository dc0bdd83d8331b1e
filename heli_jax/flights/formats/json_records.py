"""Logs in JSON: records in a list or one per line (.jsonl, .ndjson), or columns by name.

Nested records and lists are named by path, `imu.p`, `gyro[0]`, like MATLAB's arrays.
"""

import json
import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from heli_jax.flights.clock import is_date, seconds_of_dates
from heli_jax.flights.formats.arrays import ArrayTable, DataSets
from heli_jax.flights.log import Budget, shown, wrong
from heli_jax.regular_file import read_regular

_LARGEST = 500 * 10**6
_OBJECTS = {b",": 32, b"[": 64, b"{": 200, b'"': 30}
"""Memory that Python uses for each object that begins or ends with this character [bytes]."""
_MOST_COLUMNS = 10_000
_DEEPEST = 8
_LONGEST_LIST = 16
"""Most numbers of a list within a sample."""


def open_json(path: Path) -> ArrayTable:
    """Read a JSON file, or one with a record per line."""
    where = str(path)
    data = read_regular(path, "a log in JSON", _LARGEST)
    sets = DataSets(Budget(where, len(data)))
    sets.budget.take(sum(size * data.count(mark) for mark, size in _OBJECTS.items()))
    content = _parsed(where, data)
    if isinstance(content, list):
        columns = _of_rows(where, content, sets.budget)
    else:
        columns = dict(_within(where, content, sets.budget)) if isinstance(content, dict) else {}
    if not 0 < len(columns) <= _MOST_COLUMNS:
        raise wrong(where, f"holds {len(columns)} columns, expected 1 to {_MOST_COLUMNS}")
    for name, values in columns.items():
        _add(sets, name, values)
    return sets.table(where, "json", data)


def _parsed(where: str, data: bytes) -> Any:
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as e:
        raise wrong(where, "is not UTF-8 text, as JSON must be") from e
    try:
        return json.loads(text)
    except RecursionError as e:
        raise wrong(where, "is nested too deeply, expected a log") from e
    except ValueError as e:
        whole = e
    # One record per line; the last may be cut off if the logger lost its power.
    lines = [(i, line) for i, line in enumerate(text.split("\n"), 1) if line.strip()]
    records = []
    for place, (number, line) in enumerate(lines):
        try:
            records.append(json.loads(line))
        except (ValueError, RecursionError) as e:
            if len(records) > 1 and place == len(lines) - 1:
                break
            problem = "is no whole JSON" if not records else "holds no record in JSON"
            at = str(whole) if not records else str(e)
            raise wrong(where, f"{problem} ({at})", f"line {number}") from e
    return records


def _within(where: str, content: Any, budget: Budget) -> Iterator[tuple[str, Any]]:
    """Yield the lists in nested records by path."""
    for name, value in _cells(content, "", 0):
        if isinstance(value, dict):
            yield name, list(value.values())
        elif isinstance(value, list) and value and isinstance(value[0], dict):
            yield from ((f"{name}.{n}", x) for n, x in _of_rows(where, value, budget).items())
        elif isinstance(value, list):
            yield name, value


def _of_rows(where: str, rows: list[Any], budget: Budget) -> dict[str, Any]:
    """Return columns of records or rows, with missing values where one lacks a column."""
    if not rows or not isinstance(rows[0], dict):
        return {"data": rows}
    columns: dict[str, list[Any]] = {}
    for i, row in enumerate(rows):
        for path, value in _cells(row, "", 0) if isinstance(row, dict) else ():
            if not isinstance(value, list):
                cells = [(path, value)]
            elif len(value) > _LONGEST_LIST:
                problem = f"record {i + 1} has a list of {len(value)}, {shown(path)}"
                raise wrong(where, f"{problem}: expected a sample a record, or columns by name")
            else:
                cells = [(f"{path}[{k}]", x) for k, x in enumerate(value)]
            for name, cell in cells:
                if name not in columns:
                    budget.take(8 * len(rows))
                column = columns.setdefault(name, [])
                # Earlier rows did not have this column.
                column.extend([None] * (i - len(column)))
                column.append(cell)
        if len(columns) > _MOST_COLUMNS:
            raise wrong(where, f"expected at most {_MOST_COLUMNS} columns")
    return {n: x + [None] * (len(rows) - len(x)) for n, x in columns.items()}


def _cells(record: Mapping[str, Any], path: str, depth: int) -> Iterator[tuple[str, Any]]:
    """Yield the cells of nested records by path."""
    for key, value in record.items():
        name = f"{path}.{key}" if path else str(key)
        # Columns of pandas are no records: {"0": 0.1, "1": 0.2}.
        numbered = isinstance(value, dict) and len(value) > 1 and all(map(str.isdigit, value))
        if isinstance(value, dict) and not numbered and depth < _DEEPEST:
            yield from _cells(value, name, depth + 1)
        else:
            yield name, value


def _add(sets: DataSets, name: str, values: list[Any]) -> None:
    filled = [x for x in values if x is not None]
    if filled and all(isinstance(x, str) for x in filled):
        if is_date(filled[0]):
            seconds = seconds_of_dates(values)
            if not isinstance(seconds, int):
                sets.add(name, seconds, {"units": "s"})
                return
        sets.leave_out(name, "text")
        return
    sets.budget.take(8 * len(values))
    try:
        if filled and isinstance(filled[0], list):
            array = np.array([[_number(x) for x in row] for row in values], np.float64)
        else:
            array = np.array([_number(x) for x in values], np.float64)
    # Rows of different lengths, or cells that are no numbers.
    except (TypeError, ValueError, OverflowError):
        sets.leave_out(name, "text")
        return
    if array.size:
        sets.add(name, array, {})


def _number(value: Any) -> float:
    if value is None:
        return math.nan
    if not isinstance(value, int | float):
        raise TypeError
    return float(value)
