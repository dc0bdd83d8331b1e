"""Choice of the reader for a log."""

import sys
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from heli_jax.flights import progress
from heli_jax.flights.formats import (
    arrow,
    blackbox,
    blackbox_frames,
    csv_text,
    dataflash,
    library_arrays,
    numpy_arrays,
    ulog,
)
from heli_jax.flights.log import ChannelLog, Table, require_short_names, shown, wrong
from heli_jax.regular_file import open_regular, require_regular

_SNIFFED = 8192
"""Bytes read to recognise a format; a DataFlash text log may begin with the firmware's lines."""
_TEXTS = (".csv", ".txt", ".tsv", ".asc", ".dat", ".log", ".lvm", ".prn", ".tab")
_ARRAYS = (".mat", ".nc", ".h5", ".hdf5")
"""Endings that decide the format, because MATLAB 7.3, NetCDF 4 and HDF5 files begin alike."""
EXPECTED = (
    "expected a table (.csv, .txt, .tsv, .asc, .dat, .lvm, .parquet, .feather, .jsonl), arrays "
    "(.mat, .nc, .h5, .hdf5, .npz, .npy) or an autopilot's log (.ulg, .bin, .log, .bbl, .bfl)"
)


def open_table(path: str | Path) -> Table:
    """Open a table of rows: text, Parquet or arrays; one of its columns is the time."""
    log = open_log(path)
    if isinstance(log, ChannelLog):
        raise wrong(log.path, f"is a log of {log.format}, expected a table in CSV or Parquet")
    return log


def open_log(path: str | Path, flight: int | None = None) -> Table | ChannelLog:
    """Open a log of any format; columns of tables are read on request.

    Returns:
        A table, whose time is one of its columns, or the channels of an autopilot's log.

    Raises:
        InputError: the file is missing, not regular, too large for its format, not readable or of
            an unknown format; or it holds several flights and none, or an absent one, is requested.
    """
    logs = chosen_flights(path, open_flights(path), flight)
    if not isinstance(logs, tuple):
        return logs
    log, *others = logs
    if others:
        numbers = [str(one.flight[0]) for one in logs]
        known = ", ".join(numbers[:20]) + (", ..." if len(numbers) > 20 else "")
        problem = f"holds {len(logs)} flights, expected the number of one: {known}"
        raise wrong(str(path), problem)
    return log


def chosen_flights(
    path: str | Path, logs: Table | tuple[ChannelLog, ...], flight: int | None
) -> Table | tuple[ChannelLog, ...]:
    """Return the flight with this number, or all without a number."""
    if flight is None:
        return logs
    if not isinstance(logs, tuple):
        if flight != 1:
            raise wrong(str(path), f"holds one flight, expected number 1, got {flight}")
        return logs
    chosen = tuple(log for log in logs if log.flight[0] == flight)
    if not chosen:
        known = ", ".join(str(log.flight[0]) for log in logs[:20])
        raise wrong(str(path), f"holds no flight {flight} with samples, expected one of {known}")
    return chosen


def open_flights(path: str | Path) -> Table | tuple[ChannelLog, ...]:
    """Open all flights of a log, as `open_log`."""
    path = Path(path)
    try:
        # Any size: each reader has its own limit.
        size = require_regular(path, "a log", sys.maxsize)
        if not size:
            raise wrong(str(path), "is empty, expected a log")
        reader = _reader(path)
        with progress.reading(path, size):
            opened = reader(path)
    except OSError as e:
        raise wrong(str(path), f"cannot be read ({e.strerror or type(e).__name__})") from e
    for log in opened if isinstance(opened, tuple) else (opened,):
        require_short_names(log.path, log.names)
    return opened


_Reader = Callable[[Path], Table | tuple[ChannelLog, ...]]


class Format(NamedTuple):
    """A format that can be read: recognised by its first bytes or its ending."""

    read: _Reader
    endings: tuple[str, ...]
    marks: tuple[bytes, ...] = ()
    of_autopilot: bool = False


def _one(reader: Callable[[Path], ChannelLog]) -> _Reader:
    return lambda path: (reader(path),)


FORMATS = (
    Format(_one(ulog.open_ulog), (".ulg",), (ulog.MAGIC,), of_autopilot=True),
    Format(_one(dataflash.open_dataflash), (".bin",), (dataflash.MAGIC,), of_autopilot=True),
    Format(blackbox.open_blackbox, (".bbl", ".bfl"), (blackbox_frames.MARK,), of_autopilot=True),
    Format(csv_text.open_csv, _TEXTS),
    Format(arrow.open_parquet, (".parquet",), (b"PAR1",)),
    Format(arrow.open_arrow, (".feather", ".arrow", ".arrows", ".ipc"), (arrow.ARROW_MARK,)),
    Format(library_arrays.open_json_lines, (".jsonl", ".ndjson")),
    Format(numpy_arrays.open_numpy, (".npy", ".npz"), (numpy_arrays.MAGIC,)),
    Format(library_arrays.open_mat, (".mat",), (library_arrays.MATLAB_MAGIC,)),
    Format(library_arrays.open_netcdf, (".nc",), library_arrays.NETCDF_MAGICS),
    Format(library_arrays.open_hdf5, (".h5", ".hdf5"), (library_arrays.HDF5_MAGIC,)),
)


def _reader(path: Path) -> _Reader:
    ending = path.suffix.lower()
    with open_regular(path, "a log", sys.maxsize) as file:
        head = file.read(_SNIFFED)
    if csv_text.is_gzipped(path):
        if csv_text.inner_ending(path) not in _TEXTS:
            problem = (
                f"is packed by gzip, which is read for text files only ({', '.join(_TEXTS[:3])})"
            )
            raise wrong(str(path), f"{problem}; expected it unpacked")
        return csv_text.open_csv
    # The ending decides where it is reliable, so that a damaged Parquet file is not read as text.
    named = next((f.read for f in FORMATS if ending in f.endings), None)
    marked = None
    if ending not in (*_ARRAYS, ".parquet"):
        marked = _by_content(head, is_table=ending in (".csv", ".tsv"))
    reader = marked or named
    if reader is None:
        raise wrong(str(path), f"logs ending in {shown(path.suffix)} cannot be read, {EXPECTED}")
    return reader


def _by_content(head: bytes, is_table: bool) -> _Reader | None:
    """Return the reader of a file that its first bytes identify, whatever its name.

    A table begins with the user's own text, which may look like the mark of another format. An
    autopilot's log may have the ending of a table.
    """
    for known in FORMATS:
        if known.marks and head.startswith(known.marks) and (known.of_autopilot or not is_table):
            return known.read
    if dataflash.is_dataflash_text(head) and (not is_table or head.lstrip().startswith(b"FMT,")):
        return _one(dataflash.open_dataflash_text)
    # Anywhere in the first bytes: its reader searches for the beginning of each flight and skips
    # what precedes the first.
    return blackbox.open_blackbox if blackbox_frames.MARK in head and not is_table else None
