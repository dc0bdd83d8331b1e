"""Tables as log files: the formats that `read_flight` reads."""

from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any

import numpy as np


def write_table(target: Path | IO[bytes], columns: Mapping[str, Any]) -> None:
    """Write columns of equal length as CSV, or as Parquet if the name ends so.

    A column is an array (N,) or a list of text; None in a list is an empty cell.
    """
    import pyarrow as pa  # here, so that a fit without files does not wait for it

    table = pa.table(dict(columns))
    if isinstance(target, Path) and target.suffix.lower() == ".parquet":
        import pyarrow.parquet

        pyarrow.parquet.write_table(table, target)
        return
    import pyarrow.csv

    # pyarrow writes enough digits to restore the same float64.
    pyarrow.csv.write_csv(
        table, target if isinstance(target, Path) else pa.PythonFile(target, mode="w")
    )


def stacked(parts: list[dict[str, Any]], names: list[str]) -> dict[str, Any]:
    """Stack tables vertically; a column that a part lacks is empty there.

    `names` are the columns of the result, in order.
    """
    out: dict[str, Any] = {}
    for name in names:
        if all(isinstance(part.get(name), list) for part in parts):
            out[name] = [cell for part in parts for cell in part[name]]
            continue
        if all(name in part for part in parts):
            out[name] = np.concatenate([np.asarray(part[name]) for part in parts])
            continue
        # A list, because no array of numbers holds an empty cell: NaN would be written as a value.
        cells: list[Any] = []
        for part in parts:
            n = len(next(iter(part.values())))
            cells += list(part[name]) if name in part else [None] * n
        out[name] = cells
    return out
