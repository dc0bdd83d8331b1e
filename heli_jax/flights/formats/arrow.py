"""Logs in Apache's column formats: Parquet, and Arrow files and streams (.feather, .arrow)."""

import functools
import hashlib
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

import numpy as np

from heli_jax.finding import Finding
from heli_jax.flights.log import Budget, Survey, column, require_columns, require_few_columns, wrong
from heli_jax.regular_file import open_regular, read_regular, size_words

# Imported inside the functions that need it, as in `csv_text`.
if TYPE_CHECKING:
    import pyarrow as pa

ARROW_MARK = b"ARROW1"
"""First bytes of Arrow and Feather files."""
_STREAM = b"\xff\xff\xff\xff"
_LARGEST, _LARGEST_ARROW = 16 * 10**9, 10**9
_LONGEST_FOOTER = 64 * 10**6
"""Largest files [bytes]: Parquet loads only requested columns, Arrow the whole file."""
_AT_ONCE = 2 * 10**6
"""Cells decoded before their rows are counted: 16 MB of numbers."""


def open_parquet(path: Path) -> "ColumnTable":
    """Open a Parquet file and read its schema; only requested columns are read later."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    where = str(path)
    with open_regular(path, "a log in Parquet", _LARGEST) as opened:
        size = os.fstat(opened.fileno()).st_size
        # Before anything reads the whole file: a file with another end is not Parquet.
        _check_end(where, opened, size)
        try:
            file = pq.ParquetFile(path)
            schema, metadata = file.schema_arrow, file.metadata
        # pyarrow raises UnicodeDecodeError if the name of a column is no text.
        except (pa.ArrowException, OSError, UnicodeDecodeError) as e:
            raise wrong(where, "is no whole Parquet file") from e
        require_few_columns(where, metadata.num_columns)
        # Text stays in dictionary form: a few words that every row repeats can be large.
        texts = [f.name for f in schema if pa.types.is_string(f.type) or pa.types.is_binary(f.type)]
        if texts:
            file = pq.ParquetFile(path, read_dictionary=texts)

    def read(names: Sequence[str]) -> "pa.Table":
        # Counted, because a damaged column can claim and decode to any number of rows.
        pieces, rows = [], 0
        try:
            for piece in file.iter_batches(
                max(_AT_ONCE // max(len(names), 1), 1), columns=list(names)
            ):
                rows += piece.num_rows
                if rows > metadata.num_rows:
                    break
                piece.validate(full=True)  # a damaged page can decode to inconsistent lengths
                pieces.append(piece)
        except (pa.ArrowException, OSError, MemoryError, UnicodeDecodeError) as e:
            raise wrong(where, "is no whole Parquet file") from e
        if rows != metadata.num_rows:
            raise wrong(where, "is no whole Parquet file")
        return pa.Table.from_batches(pieces)

    # From groups of rows, not single columns: with some damage to a column, pyarrow ends the whole
    # process.
    groups = (metadata.row_group(i) for i in range(metadata.num_row_groups))
    unpacked = sum(group.total_byte_size for group in groups)

    def digest() -> str:
        with path.open("rb") as opened:
            return hashlib.file_digest(opened, "sha256").hexdigest()

    count = metadata.num_rows
    return ColumnTable(where, "parquet", size, digest, schema, count, read, unpacked)


def _check_end(path: str, file: BinaryIO, size: int) -> None:
    """Refuse a file whose end is not that of a Parquet file, or states an oversized footer."""
    # A Parquet file ends with its metadata, their length (4 bytes, little-endian) and its mark:
    # PAR1, or PARE if the metadata are encrypted. 12 bytes are both marks and the length.
    file.seek(max(size - 8, 0))
    end = file.read(8)
    length = int.from_bytes(end[:4], "little")
    if end[4:] not in (b"PAR1", b"PARE") or length + 12 > size:
        raise wrong(path, "is no whole Parquet file")
    if length > _LONGEST_FOOTER:
        words = f"{size_words(_LONGEST_FOOTER)}, got {size_words(length)}"
        raise wrong(path, f"expected a footer of at most {words}")


def open_arrow(path: Path) -> "ColumnTable":
    """Read a file or a stream of Arrow."""
    import pyarrow as pa

    where = str(path)
    data = read_regular(path, "a log in Arrow's format", _LARGEST_ARROW)
    if not data.startswith((ARROW_MARK, _STREAM)):
        raise wrong(where, "is no file of Arrow, expected one that begins with its mark")
    source, budget, pieces = pa.BufferReader(pa.py_buffer(data)), Budget(where, len(data)), []
    try:
        if data.startswith(_STREAM):
            file = batches = pa.ipc.open_stream(source)
        else:
            file = pa.ipc.open_file(source)
            batches = (file.get_batch(i) for i in range(file.num_record_batches))
        for batch in batches:
            budget.take(max(batch.nbytes, 8 * batch.num_rows * batch.num_columns))
            batch.validate(full=True)
            pieces.append(batch)
        table = pa.Table.from_batches(pieces, file.schema)
        table.validate(full=True)
    except (pa.ArrowException, OSError, UnicodeDecodeError, MemoryError) as e:
        raise wrong(where, f"is no whole file of Arrow ({type(e).__name__})") from e
    require_few_columns(where, len(table.schema))

    def read(names: Sequence[str]) -> "pa.Table":
        # By place: `select` fails if two columns have the same name.
        flat = (not pa.types.is_nested(f.type) for f in table.schema)
        return table.select([i for i, f in enumerate(flat) if f and table.column_names[i] in names])

    def digest() -> str:
        return hashlib.sha256(data).hexdigest()

    return ColumnTable(where, "arrow", len(data), digest, table.schema, table.num_rows, read, 0)


class ColumnTable:
    """`Table` of Arrow columns."""

    notes: tuple[Finding, ...] = ()

    def __init__(
        self,
        path: str,
        kind: str,
        size: int,
        digest: Callable[[], str],
        schema: "pa.Schema",
        n_rows: int,
        read: "Callable[[Sequence[str]], pa.Table]",
        unpacked: int,
    ) -> None:
        """Make a table of columns.

        Args:
            digest: function that returns the SHA-256 of the file.
            read: function that returns columns by name.
            unpacked: bytes of all columns after unpacking, if the file states them, else 0.
        """
        if not len(schema) or not n_rows:
            raise wrong(path, "holds no rows, expected a log")
        self.path, self.format, self.size = path, kind, size
        self._digest, self._schema, self._n_rows = functools.cache(digest), schema, n_rows
        self._columns, self._unpacked, self._budget = read, unpacked, Budget(path, size)
        self.names: tuple[str, ...] = tuple(schema.names)
        stated = {f.name: (f.metadata or {}).get(b"unit", b"") for f in schema}
        self.units: Mapping[str, str] = {
            name: unit.decode("utf-8", "replace") for name, unit in stated.items()
        }

    @property
    def sha256(self) -> str:
        """SHA-256 of the whole file; slower than reading a log's columns."""
        try:
            return self._digest()
        except OSError as e:
            raise wrong(self.path, f"cannot be read ({e.strerror or type(e).__name__})") from e

    def numbers(self, names: Sequence[str]) -> dict[str, np.ndarray]:
        """Return the columns as float64 (N,), NaN where a value is null."""
        require_columns(self.path, self.names, names)
        for name in names:
            kind = self._schema.field(name).type
            if not is_number(kind):
                raise wrong(self.path, f"holds {kind}, expected numbers", column(name))
        self._budget.require(8 * self._n_rows * len(set(names)))
        columns = self._columns(sorted(set(names)))
        return {name: column_floats(columns.column(name)) for name in names}

    def survey(self) -> list[Survey]:
        """Survey every column; non-numeric ones count as text.

        Lists and records are not read, so all of their cells count as filled.
        """
        import pyarrow as pa

        flat = [not pa.types.is_nested(f.type) for f in self._schema]
        named = zip(self.names, flat, strict=True)
        data = self._read(list(dict.fromkeys(name for name, is_flat in named if is_flat)))
        # By name: two columns may have the same, and come in an order of their own.
        columns: dict[str, list[pa.ChunkedArray]] = {}
        for name, x in zip(data.column_names, data.columns, strict=True):
            columns.setdefault(name, []).append(x)
        surveys = []
        for name, is_flat in zip(self.names, flat, strict=True):
            if not is_flat:
                surveys.append(Survey(name, None, self._n_rows))
                continue
            x = columns[name].pop(0)
            values = column_floats(x) if is_number(x.type) else None
            surveys.append(Survey(name, values, len(x) - x.null_count))
        return surveys

    def place(self, row: int) -> str:
        """Return the place of a row; `row 1` is the first."""
        return f"row {row + 1}"

    def cell_text(self, name: str, row: int) -> str:
        """Return the text of a cell."""
        value = self._read([name]).column(name)[row].as_py()
        return "nothing" if value is None else repr(value)[:40]

    def time_unit(self, name: str) -> str | None:
        """Return `s`, `ms`, `us` or `ns` for a column of time stamps or durations."""
        # By place: `field` refuses a name that two columns share.
        kind = self._schema.field(self.names.index(name)).type
        return str(kind.unit) if is_clock(kind) else None

    def _read(self, names: Sequence[str]) -> "pa.Table":
        """Return the columns, none of them of lists or records."""
        self._budget.require(max(8 * self._n_rows * len(names), self._unpacked))
        return self._columns(names)


def is_clock(kind: "pa.DataType") -> bool:
    import pyarrow as pa

    types = pa.types
    return any(test(kind) for test in (types.is_timestamp, types.is_duration, types.is_time))


def is_number(kind: "pa.DataType") -> bool:
    import pyarrow as pa

    types = pa.types
    # A clock's ticks count as numbers, so that a column of time stamps can be the time.
    tests = (types.is_integer, types.is_floating, types.is_decimal, types.is_boolean, is_clock)
    return any(test(kind) for test in tests)


def column_floats(values: "pa.ChunkedArray") -> np.ndarray:
    """Return numbers, or ticks of a clock, as float64 (N,), NaN where null."""
    import pyarrow as pa
    import pyarrow.compute as pc

    # Ticks become integers first, because no cast goes from stamps to floats.
    if is_clock(values.type):
        values = values.cast(pa.int32() if pa.types.is_time32(values.type) else pa.int64())
    # Unsafe, because a safe cast refuses integers above 2^53, as all stamps in ns are. Calendar
    # stamps round to 256 ns.
    return floats(pc.cast(values, pa.float64(), safe=False))


def floats(numbers: "pa.ChunkedArray") -> np.ndarray:
    """Return numbers of type float64 (N,), NaN where null."""
    import pyarrow as pa

    values, at = np.empty(len(numbers), np.float64), 0
    # As buffers, because to_numpy imports pandas, which takes a second.
    for chunk in (c for c in numbers.chunks if len(c)):
        piece = values[at : at + len(chunk)]
        piece[:] = np.frombuffer(chunk.buffers()[1], np.float64, len(chunk), 8 * chunk.offset)
        if chunk.null_count:
            known = chunk.is_valid().cast(pa.uint8())
            at_known = np.frombuffer(known.buffers()[1], np.uint8, len(known), known.offset)
            piece[at_known == 0] = np.nan
        at += len(chunk)
    return values
