"""ArduPilot DataFlash logs as text (.log): a line a message, as planners save them.

The oldest have no TimeUS: their rows have only an order, which `info` shows and no fit can use.
"""

from pathlib import Path

import numpy as np

from heli_jax.flights.csv_text import lines_of
from heli_jax.flights.dataflash import FIELDS, Format, make_log
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
    formats: dict[str, Format] = {}
    numbers: dict[int, str] = {}
    cells: dict[str, list[list[str]]] = {}
    damaged = 0
    # Bytes that are no UTF-8 cost the line that they are in and not the log: a message may hold
    # damage.
    for line in lines_of(data.decode("utf-8", "replace").replace("\r", "")):
        name, _, rest = line.partition(",")
        name = name.strip()
        if name == "FMT":
            damaged += not _take_format(rest, formats, numbers)
        elif name in formats:
            # The last cell may be a message with commas of its own.
            row = [cell.strip() for cell in rest.split(",", len(formats[name].columns) - 1)]
            if len(row) == len(formats[name].columns):
                cells.setdefault(name, []).append(row)
            else:
                damaged += 1
        # Before the first format stand lines of the firmware and the board.
        elif line.strip() and formats:
            damaged += 1
    if not formats:
        raise wrong(str(path), "is no DataFlash log, expected lines of FMT that name its columns")
    rows = {}
    for name, lines in cells.items():
        rows[name], bad = _columns(formats[name], lines)
        damaged += bad
    rows = {name: table for name, table in rows.items() if table.size}
    return make_log(str(path), data, rows, formats, numbers, damaged, scaled=True)


def _take_format(rest: str, formats: dict[str, Format], numbers: dict[int, str]) -> bool:
    cells = [cell.strip() for cell in rest.split(",")]
    if len(cells) < _FMT_PARTS or not cells[0].isdigit():
        return False
    # A line is FMT, type, length, name, kinds, columns. The length is that of the binary message,
    # which says nothing of a text.
    form = Format(cells[2], cells[3], tuple(cells[_FMT_PARTS - 1 :]))
    # Of arrays nobody has seen a text.
    if not form.is_valid or "a" in form.kinds or form.name in formats:
        return formats.get(form.name) == form
    formats[form.name] = form
    # Cut, since a damaged cell may hold thousands of digits, which Python refuses to convert.
    numbers[int(cells[0][:9])] = form.name
    return True


def _columns(form: Format, lines: list[list[str]]) -> tuple[np.ndarray, int]:
    """Lines of one message as a structured array, and how many hold no numbers."""
    good, parsed = 0, []
    for row in lines:
        try:
            parsed.append(
                tuple(
                    cell.encode() if kind in _TEXT else float(cell)
                    for kind, cell in zip(form.kinds, row, strict=True)
                )
            )
            good += 1
        # A row whose cells are no numbers is left out as a whole: what else it holds is as
        # doubtful.
        except ValueError:
            continue
    # Whatever its letter says, a number in text may have decimals: what the binary log stores as
    # hundredths is written as what it means.
    kinds = [FIELDS[kind][0] if kind in _TEXT else "<f8" for kind in form.kinds]
    # A mode is written as its name: a column that never holds a number is text.
    dtype = np.dtype(list(zip(form.columns, kinds, strict=True)))
    return np.array(parsed, dtype), len(lines) - good
