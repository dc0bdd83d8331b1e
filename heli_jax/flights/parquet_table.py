"""Logs in Apache Parquet."""

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from heli_jax.flights.table import Survey, column, require_columns, wrong


def open_parquet(path: Path) -> "ParquetTable":
    """Open a Parquet file and read its schema.

    Raises:
        InputError: it is no Parquet file, or it is broken.
        OSError: it cannot be read.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    with path.open("rb") as file:
        sha256 = hashlib.file_digest(file, "sha256").hexdigest()
    try:
        file = pq.ParquetFile(path)
        schema, n_rows = file.schema_arrow, file.metadata.num_rows
    except (pa.ArrowException, OSError) as e:
        raise wrong(str(path), "is no whole Parquet file") from e
    if not len(schema) or not n_rows:
        raise wrong(str(path), "holds no rows, wanted is a log")
    return ParquetTable(str(path), path.stat().st_size, sha256, file)


class ParquetTable:
    """A `Table` on a Parquet file; only the columns asked for are read."""

    format = "parquet"

    def __init__(self, path: str, size: int, sha256: str, file: Any) -> None:
        self.path, self.size, self.sha256 = path, size, sha256
        self._file = file
        self._schema = file.schema_arrow
        self.names: tuple[str, ...] = tuple(self._schema.names)

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
                raise wrong(self.path, f"holds {kind}, wanted are numbers", column(name))
        data = self._read(sorted(set(names)))
        return {name: _floats(data.column(name)) for name in names}

    def survey(self) -> list[Survey]:
        """Every column; what is not a number counts as text."""
        data = self._read(None)
        columns = (data.column(i) for i in range(data.num_columns))
        return [
            Survey(name, _floats(x) if _is_number(x.type) else None, len(x) - x.null_count)
            for name, x in zip(data.column_names, columns, strict=True)
        ]

    def place(self, row: int) -> str:
        """`row 1` is the first."""
        return f"row {row + 1}"

    def found(self, name: str, row: int) -> str:
        """What stands in a cell, in words."""
        value = self._read([name]).column(name)[row].as_py()
        return "nothing" if value is None else repr(value)[:40]

    def time_unit(self, name: str) -> str | None:
        """`s`, `ms`, `us` or `ns` for a column of time stamps or durations."""
        import pyarrow as pa

        kind = self._schema.field(name).type
        if pa.types.is_timestamp(kind) or pa.types.is_duration(kind) or pa.types.is_time(kind):
            return str(kind.unit)
        return None

    def _read(self, names: Sequence[str] | None) -> Any:
        import pyarrow as pa

        try:
            data = self._file.read(columns=None if names is None else list(names))
            data.validate(full=True)  # a damaged page can decode to lengths that do not fit
            return data
        except (pa.ArrowException, OSError, MemoryError) as e:
            raise wrong(self.path, "is no whole Parquet file") from e


def _is_number(kind: Any) -> bool:
    import pyarrow as pa

    types = pa.types
    return (
        types.is_integer(kind)
        or types.is_floating(kind)
        or types.is_decimal(kind)
        or types.is_boolean(kind)
        or types.is_timestamp(kind)
        or types.is_duration(kind)
        or types.is_time(kind)
    )


def _floats(values: Any) -> np.ndarray:
    """Numbers, or ticks of a clock, as float64 (N,), NaN where null."""
    import pyarrow as pa
    import pyarrow.compute as pc

    kind = values.type
    if pa.types.is_timestamp(kind) or pa.types.is_duration(kind) or pa.types.is_time64(kind):
        values = values.cast(pa.int64())
    elif pa.types.is_time32(kind):
        values = values.cast(pa.int32())
    values = pc.cast(values, pa.float64(), safe=False)
    return np.asarray(values.to_numpy(), dtype=np.float64)
