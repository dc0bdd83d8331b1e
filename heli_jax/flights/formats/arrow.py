"""Logs in columns of Apache: Parquet, and Arrow's own files (.feather, .arrow)."""

import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

import numpy as np

from heli_jax.finding import Finding
from heli_jax.flights.digest import Digest
from heli_jax.flights.table import (
    Budget,
    Survey,
    column,
    require_columns,
    require_few_columns,
    wrong,
)
from heli_jax.regular_file import open_regular, read_regular, size_words

# Imported again within the functions that need it, as in `csv_text`.
if TYPE_CHECKING:
    import pyarrow as pa
    import pyarrow.parquet as pq

_LARGEST = 16 * 10**9
"""bytes: the whole file goes through sha256, the columns asked for into memory"""
_LONGEST_FOOTER = 64 * 10**6
_AT_ONCE = 2 * 10**6
"""cells that are decoded before their rows are counted: 16 MB of numbers"""


def open_parquet(path: Path) -> "ParquetTable":
    """Open a Parquet file and read its schema.

    Raises:
        InputError: it is no Parquet file, it is broken, or larger than a log may be.
        OSError: it cannot be read.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    with open_regular(path, "a log in Parquet", _LARGEST) as opened:
        size = os.fstat(opened.fileno()).st_size
        # Before anything goes through the whole file: what ends otherwise is none of Parquet.
        _check_end(str(path), opened, size)
        try:
            file = pq.ParquetFile(path)
            schema, metadata = file.schema_arrow, file.metadata
            n_rows = metadata.num_rows
        # pyarrow raises UnicodeDecodeError where the name of a column is no text.
        except (pa.ArrowException, OSError, UnicodeDecodeError) as e:
            raise wrong(str(path), "is no whole Parquet file") from e
        if not len(schema) or not n_rows:
            raise wrong(str(path), "holds no rows, expected a log")
        require_few_columns(str(path), metadata.num_columns)
        # Text stays as its dictionary: a few words that every row repeats can be large.
        texts = [f.name for f in schema if pa.types.is_string(f.type) or pa.types.is_binary(f.type)]
        if texts:
            file = pq.ParquetFile(path, read_dictionary=texts)
    return ParquetTable(str(path), size, Digest(path), file)


def _check_end(path: str, file: BinaryIO, size: int) -> None:
    """Refuse a file whose end is not that of a Parquet file, or says that it is mostly header."""
    # A Parquet file ends with its metadata, their length (4 bytes, little-endian) and its mark:
    # PAR1, or PARE where the metadata are encrypted. 12 bytes are both marks and the length.
    file.seek(max(size - 8, 0))
    end = file.read(8)
    file.seek(0)
    length = int.from_bytes(end[:4], "little")
    if end[4:] not in (b"PAR1", b"PARE") or length + 12 > size:
        raise wrong(path, "is no whole Parquet file")
    if length > _LONGEST_FOOTER:
        words = f"{size_words(_LONGEST_FOOTER)}, got {size_words(length)}"
        raise wrong(path, f"expected a footer of at most {words}")


class ColumnTable:
    """A `Table` on columns of Arrow, which come in pieces."""

    format = "arrow"
    notes: tuple[Finding, ...] = ()
    _unpacked = 0
    """bytes of all columns once they are unpacked, where the file states them"""

    def __init__(
        self, path: str, size: int, digest: Digest, schema: "pa.Schema", n_rows: int
    ) -> None:
        self.path, self.size = path, size
        self._budget = Budget(path, size)
        self._digest, self._schema, self._n_rows = digest, schema, n_rows
        self.names: tuple[str, ...] = tuple(self._schema.names)
        stated = {f.name: (f.metadata or {}).get(b"unit", b"") for f in self._schema}
        self.units: Mapping[str, str] = {
            name: unit.decode("utf-8", "replace") for name, unit in stated.items()
        }

    @property
    def sha256(self) -> str:
        """Of the file: a log's columns are read in less time."""
        try:
            return self._digest.hex()
        except OSError as e:
            raise wrong(self.path, f"cannot be read ({e.strerror or type(e).__name__})") from e

    def numbers(self, names: Sequence[str]) -> dict[str, np.ndarray]:
        """The columns as float64 (N,), NaN where a value is null.

        Raises:
            InputError: a column is missing, there twice, or of a type that is no number; the
                file is broken.
        """
        require_columns(self.path, self.names, names)
        for name in names:
            kind = self._schema.field(name).type
            if not _is_number(kind):
                raise wrong(self.path, f"holds {kind}, expected numbers", column(name))
        needed = sorted(set(names))
        self._budget.require(8 * self._n_rows * len(needed))
        # Each piece goes to its place as it is decoded: all of them together, and an array made of
        # them, would be three times the numbers.
        numbers = {name: np.empty(self._n_rows) for name in needed}
        first = 0
        for piece in self._pieces(needed):
            for name in needed:
                numbers[name][first : first + piece.num_rows] = _floats(piece.column(name))
            first += piece.num_rows
        self._digest.begin()
        return {name: numbers[name] for name in names}

    def survey(self) -> list[Survey]:
        """Every column; what is not a number counts as text. Lists and records within cells are
        not read, so that all of their cells count as filled."""
        import pyarrow as pa

        nested = [pa.types.is_nested(f.type) for f in self._schema]
        flat = [f.name for f, n in zip(self._schema, nested, strict=True) if not n]
        data = self._read(flat if any(nested) else None)
        # By name: two columns may have the same, and come in an order of their own.
        columns: dict[str, list[pa.ChunkedArray]] = {}
        for name, x in zip(data.column_names, data.columns, strict=True):
            columns.setdefault(name, []).append(x)
        surveys = []
        for name, of_lists in zip(self.names, nested, strict=True):
            if of_lists:
                surveys.append(Survey(name, None, self._n_rows))
                continue
            x = columns[name].pop(0)
            values = _floats(x) if _is_number(x.type) else None
            surveys.append(Survey(name, values, len(x) - x.null_count))
        return surveys

    def place(self, row: int) -> str:
        """`row 1` is the first."""
        return f"row {row + 1}"

    def cell_text(self, name: str, row: int) -> str:
        """What stands in a cell, in words."""
        value = self._read([name]).column(name)[row].as_py()
        return "nothing" if value is None else repr(value)[:40]

    def time_unit(self, name: str) -> str | None:
        """`s`, `ms`, `us` or `ns` for a column of time stamps or durations."""
        import pyarrow as pa

        # By place: of two columns of one name the first, where `field` would refuse the name.
        kind = self._schema.field(self.names.index(name)).type
        if pa.types.is_timestamp(kind) or pa.types.is_duration(kind) or pa.types.is_time(kind):
            return str(kind.unit)
        return None

    def _read(self, names: Sequence[str] | None) -> "pa.Table":
        """The columns, none of them of lists or records; all of the file without names."""
        import pyarrow as pa

        self._budget.require(max(8 * self._n_rows * len(names or self.names), self._unpacked))
        return pa.Table.from_batches(list(self._pieces(names)))

    def _pieces(self, names: Sequence[str] | None) -> "Iterator[pa.RecordBatch]":
        """The columns in pieces, in their order; all without names."""
        raise NotImplementedError


class ParquetTable(ColumnTable):
    """A `Table` on a Parquet file; only the columns asked for are read."""

    format = "parquet"

    def __init__(self, path: str, size: int, digest: Digest, file: "pq.ParquetFile") -> None:
        super().__init__(path, size, digest, file.schema_arrow, file.metadata.num_rows)
        self._file = file
        # Of groups of rows: what is said of a single column is not asked, since of some damage to
        # it pyarrow ends the whole process.
        groups = (file.metadata.row_group(i) for i in range(file.metadata.num_row_groups))
        self._unpacked = sum(group.total_byte_size for group in groups)

    def _pieces(self, names: Sequence[str] | None) -> "Iterator[pa.RecordBatch]":
        """The columns in pieces, of as many rows together as the file says that it has.

        Raises:
            InputError: that is not so, the file is broken, or they are too many numbers.
        """
        import pyarrow as pa

        n_rows, count = self._n_rows, len(names or self.names)
        columns = None if names is None else list(names)
        # In pieces that are counted: a damaged column can claim, and decode to, any number of
        # rows.
        rows = 0
        try:
            for piece in self._file.iter_batches(
                max(_AT_ONCE // max(count, 1), 1), columns=columns
            ):
                rows += piece.num_rows
                if rows > n_rows:
                    break
                piece.validate(full=True)  # a damaged page can decode to lengths that do not fit
                yield piece
        # UnicodeDecodeError: of a damaged name, which pyarrow reads as UTF-8.
        except (pa.ArrowException, OSError, MemoryError, UnicodeDecodeError) as e:
            raise wrong(self.path, "is no whole Parquet file") from e
        if rows != n_rows:
            raise wrong(self.path, "is no whole Parquet file")


def _is_number(kind: "pa.DataType") -> bool:
    import pyarrow as pa

    types = pa.types
    # A clock's ticks count as numbers, so that a column of time stamps can be the time.
    tests = (
        *(types.is_integer, types.is_floating, types.is_decimal, types.is_boolean),
        *(types.is_timestamp, types.is_duration, types.is_time),
    )
    return any(test(kind) for test in tests)


def _floats(values: "pa.Array | pa.ChunkedArray") -> np.ndarray:
    """Numbers, or ticks of a clock, as float64 (N,), NaN where null."""
    import pyarrow as pa
    import pyarrow.compute as pc

    kind = values.type
    # Ticks as whole numbers first: no cast goes from stamps to floating point.
    if pa.types.is_timestamp(kind) or pa.types.is_duration(kind) or pa.types.is_time64(kind):
        values = values.cast(pa.int64())
    elif pa.types.is_time32(kind):
        values = values.cast(pa.int32())
    # Unsafe, since a safe cast refuses integers above 2^53, which stamps in ns all are. A
    # calendar's stamps round to 256 ns.
    values = pc.cast(values, pa.float64(), safe=False)
    # A piece of a column has to be asked to copy where it has nulls; a column copies anyway.
    copied = {"zero_copy_only": False} if isinstance(values, pa.Array) else {}
    return np.asarray(values.to_numpy(**copied), dtype=np.float64)


# Apache Arrow's own format: Feather (.feather) and its files and streams (.arrow).

ARROW_MARK = b"ARROW1"
"""what files begin with, and those of Feather"""
_STREAM = b"\xff\xff\xff\xff"
_LARGEST_ARROW = 10**9


def open_arrow(path: Path) -> "ArrowTable":
    """Read a file or a stream of Arrow.

    Raises:
        InputError: it is none, it is broken, or larger than a log may be.
        OSError: it cannot be read.
    """
    import pyarrow as pa

    where = str(path)
    data = read_regular(path, "a log in Arrow's format", _LARGEST_ARROW)
    if not data.startswith((ARROW_MARK, _STREAM)):
        raise wrong(where, "is no file of Arrow, expected one that begins with its mark")
    source, budget = pa.BufferReader(pa.py_buffer(data)), Budget(where, len(data))
    try:
        if data.startswith(_STREAM):
            file = batches = pa.ipc.open_stream(source)
        else:
            file = pa.ipc.open_file(source)
            batches = (file.get_batch(i) for i in range(file.num_record_batches))
        table = pa.Table.from_batches(list(_checked(batches, budget)), file.schema)
        table.validate(full=True)
    # pyarrow raises UnicodeDecodeError where the name of a column is no text.
    except (pa.ArrowException, OSError, UnicodeDecodeError, MemoryError) as e:
        raise wrong(where, f"is no whole file of Arrow ({type(e).__name__})") from e
    if not len(table.schema) or not table.num_rows:
        raise wrong(where, "holds no rows, expected a log")
    require_few_columns(where, len(table.schema))
    return ArrowTable(where, len(data), Digest(data), table)


def _checked(
    batches: "Iterator[pa.RecordBatch] | pa.RecordBatchReader", budget: Budget
) -> "Iterator[pa.RecordBatch]":
    for batch in batches:
        budget.take(max(batch.nbytes, 8 * batch.num_rows * batch.num_columns))
        batch.validate(full=True)
        yield batch


class ArrowTable(ColumnTable):
    """A `Table` on columns of Arrow, in memory."""

    format = "arrow"

    def __init__(self, path: str, size: int, digest: Digest, table: "pa.Table") -> None:
        super().__init__(path, size, digest, table.schema, table.num_rows)
        self._table = table

    def _pieces(self, names: Sequence[str] | None) -> "Iterator[pa.RecordBatch]":
        import pyarrow as pa

        # By place: of two columns of one name `select` takes neither.
        fields = enumerate(self._schema)
        kept = [
            i
            for i, f in fields
            if names is None or (f.name in names and not pa.types.is_nested(f.type))
        ]
        yield from self._table.select(kept).to_batches()
