"""Logs in Apache Arrow's own format: Feather (.feather) and its files and streams (.arrow)."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from heli_jax.flights.digest import Digest
from heli_jax.flights.parquet_table import ColumnTable, is_nested
from heli_jax.flights.table import Budget, require_few_columns, wrong
from heli_jax.regular_file import read_regular

# Imported again within the functions that need it, as in `csv_table`.
if TYPE_CHECKING:
    import pyarrow as pa

MARK = b"ARROW1"
"""what files begin with, and those of Feather"""
_STREAM = b"\xff\xff\xff\xff"
_LARGEST = 10**9


def open_arrow(path: Path) -> "ArrowTable":
    """Read a file or a stream of Arrow.

    Raises:
        InputError: it is none, it is broken, or larger than a log may be.
        OSError: it cannot be read.
    """
    import pyarrow as pa

    where = str(path)
    data = read_regular(path, "a log in Arrow's format", _LARGEST)
    if not data.startswith((MARK, _STREAM)):
        raise wrong(where, "is no file of Arrow, expected one that begins with its mark")
    source, budget = pa.BufferReader(pa.py_buffer(data)), Budget(where, len(data))
    try:
        if data.startswith(_STREAM):
            table = _joined(pa.ipc.open_stream(source), budget)
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


def _joined(stream: "pa.RecordBatchReader", budget: Budget) -> "pa.Table":
    import pyarrow as pa

    return pa.Table.from_batches(list(_checked(stream, budget)), stream.schema)


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
        # By place: of two columns of one name `select` takes neither.
        fields = enumerate(self._schema)
        kept = [
            i for i, f in fields if names is None or (f.name in names and not is_nested(f.type))
        ]
        yield from self._table.select(kept).to_batches()
