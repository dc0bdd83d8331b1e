"""ArduPilot DataFlash logs as text (.log): a line a message, as planners save them.

The oldest have no TimeUS: their rows have only an order, which `info` shows and no fit can use.
"""

import io
from pathlib import Path
from typing import NamedTuple

import numpy as np

from heli_jax.flights.dataflash import FIELDS, Format, Part, make_log
from heli_jax.flights.log import ChannelLog
from heli_jax.flights.table import wrong
from heli_jax.regular_file import read_regular

_LARGEST = 10**9
_FMT_PARTS = 5
"""cells of a format before the names of the columns, the word FMT among them"""
# The kinds of fields that hold text, of 4, 16 and 64 characters.
_TEXT = "nNZ"


def is_dataflash_text(head: bytes) -> bool:
    """Whether the first bytes of a file hold the format of a message, as such logs begin."""
    return any(line.startswith(b"FMT,") for line in head.splitlines())


def open_dataflash_text(path: Path) -> ChannelLog:
    """The flight of a DataFlash log in text.

    Raises:
        InputError: it is no DataFlash log, or holds no samples.
        OSError: it cannot be read.
    """
    data = read_regular(path, "a DataFlash log in text", _LARGEST)
    formats: dict[str, _Described] = {}
    described: list[_Described] = []
    damaged = 0
    # Bytes that are no UTF-8 cost the line that they are in and not the log: a message may hold
    # damage.
    for at, line in enumerate(io.TextIOWrapper(io.BytesIO(data), "utf-8", "replace")):
        name, _, rest = line.rstrip("\n").partition(",")
        name = name.strip()
        if name == "FMT":
            taken = _format(rest)
            damaged += taken is None
            # A new firmware may describe its messages otherwise from its boot on.
            if taken is not None and (
                taken[1].name not in formats or formats[taken[1].name].form != taken[1]
            ):
                described.append(_Described(taken[1], taken[0], at, [], []))
                formats[taken[1].name] = described[-1]
        elif name in formats:
            form, _, _, places, rows = formats[name]
            # The last cell may be a message with commas of its own.
            row = [cell.strip() for cell in rest.split(",", len(form.columns) - 1)]
            if len(row) == len(form.columns):
                places.append(at)
                rows.append(row)
            else:
                damaged += 1
        # Before the first format stand lines of the firmware and the board.
        elif line.strip() and formats:
            damaged += 1
    if not formats:
        raise wrong(str(path), "is no DataFlash log, expected lines of FMT that name its columns")
    parts = []
    for form, number, since, places, rows in described:
        table, good = _columns(form, rows)
        damaged += len(rows) - table.size
        if table.size:
            parts.append(Part(form, number, since, np.array(places)[good], table))
    return make_log(str(path), data, parts, damaged, scaled=True)


class _Described(NamedTuple):
    """A description, its message's number, the line that it stands in, and the lines and cells of
    the messages that are read by it."""

    form: Format
    number: int
    since: int
    places: list[int]
    rows: list[list[str]]


def _format(rest: str) -> tuple[int, Format] | None:
    """The number and the format that a line FMT describes; None of damage."""
    cells = [cell.strip() for cell in rest.split(",")]
    if len(cells) < _FMT_PARTS or not cells[0].isdigit():
        return None
    # A line is FMT, type, length, name, kinds, columns. The length is that of the binary message,
    # which says nothing of a text.
    form = Format(cells[2], cells[3], tuple(cells[_FMT_PARTS - 1 :]))
    # Of arrays nobody has seen a text.
    if not form.is_valid or "a" in form.kinds:
        return None
    # Cut, since a damaged cell may hold thousands of digits, which Python refuses to convert.
    return int(cells[0][:9]), form


def _columns(form: Format, lines: list[list[str]]) -> tuple[np.ndarray, list[int]]:
    """Lines of one message as a structured array, and which of them hold numbers."""
    good, parsed = [], []
    for i, row in enumerate(lines):
        try:
            parsed.append(
                tuple(
                    cell.encode() if kind in _TEXT else float(cell)
                    for kind, cell in zip(form.kinds, row, strict=True)
                )
            )
            good.append(i)
        # A row whose cells are no numbers is left out as a whole: what else it holds is as
        # doubtful.
        except ValueError:
            continue
    # Whatever its letter says, a number in text may have decimals: what the binary log stores as
    # hundredths is written as what it means.
    kinds = [FIELDS[kind][0] if kind in _TEXT else "<f8" for kind in form.kinds]
    # A mode is written as its name: a column that never holds a number is text.
    dtype = np.dtype(list(zip(form.columns, kinds, strict=True)))
    return np.array(parsed, dtype), good
