"""A log as named columns of numbers, whatever the file's format."""

import re
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from heli_jax.errors import InputError, nearest
from heli_jax.regular_file import require_regular


@dataclass(frozen=True)
class Survey:
    """One column as it is found: `values` (N,), NaN where empty, or None where it is text."""

    name: str
    values: np.ndarray | None
    n_filled: int


class Table(Protocol):
    """What a reader of one format offers. Rows count from 0, places are for people."""

    path: str
    format: str
    size: int
    sha256: str
    names: tuple[str, ...]

    def numbers(self, names: Sequence[str]) -> dict[str, np.ndarray]:
        """The columns as float64 (N,), NaN where a cell is empty."""
        ...

    def survey(self) -> list[Survey]:
        """Every column, in the file's order."""
        ...

    def place(self, row: int) -> str:
        """Where a row stands: `line 12` of a text file, `row 3` (from 1) of another."""
        ...

    def found(self, name: str, row: int) -> str:
        """What stands in a cell, in words."""
        ...

    def time_unit(self, name: str) -> str | None:
        """The unit of a column that holds stamps of a clock by its type, otherwise None."""
        ...


def wrong(path: str, problem: str, *place: str) -> InputError:
    """The error for a file: `file, place, place: problem`, in one line whatever the names hold."""
    text = f"{', '.join((path, *place))}: {problem}"
    return InputError(re.sub(r"[\x00-\x1f\x7f\x85\u2028\u2029]+", " ", text))


def shown(text: str) -> str:
    """Text from a file, quoted, cut to 40 characters."""
    return repr(text) if len(text) <= 40 else repr(text[:40]) + "..."


def column(name: str) -> str:
    """`column 'phi'`, as a place."""
    return f"column {shown(name)}"


MOST_COLUMNS = 10_000
"""of a log: more are none that anybody named"""


def require_few_columns(path: str, count: int, *place: str) -> None:
    """Refuse more columns than any log has.

    Raises:
        InputError: naming the number.
    """
    if count > MOST_COLUMNS:
        raise wrong(path, f"expected at most {MOST_COLUMNS} columns, got {count}", *place)


def require_columns(path: str, have: Sequence[str], wanted: Sequence[str]) -> None:
    """Refuse a column that is missing or stands in the file twice.

    Raises:
        InputError: with the nearest name there is.
    """
    for name in wanted:
        times = have.count(name)
        if times > 1:
            raise wrong(path, f"{times} columns have this name, wanted is one", column(name))
        if times == 0:
            known = {n[:40] for n in have if n}
            raise wrong(path, f"no column {shown(name)}{nearest(name[:40], known)}")


def open_table(path: str | Path) -> Table:
    """Open a log; its columns are read when they are asked for.

    Raises:
        InputError: there is no such file, it is no regular one, it is larger than a log of its
            format may be, it cannot be read, or it is of no readable format.
    """
    from heli_jax.flights.csv_table import open_csv
    from heli_jax.flights.parquet_table import open_parquet

    path = Path(path)
    readers = {".parquet": open_parquet} | dict.fromkeys((".csv", ".txt", ".tsv"), open_csv)
    try:
        if not require_regular(path, "a log in CSV or Parquet", sys.maxsize):
            raise wrong(str(path), "is empty, wanted is a log in CSV or Parquet")
        reader = readers.get(path.suffix.lower())
        if reader is None:
            raise wrong(
                str(path),
                f"logs ending in {shown(path.suffix)} cannot be read, wanted is .csv, .txt, .tsv"
                " or .parquet; convert other logs to CSV or Parquet first",
            )
        return reader(path)
    except OSError as e:
        raise wrong(str(path), f"cannot be read ({e.strerror or type(e).__name__})") from e
