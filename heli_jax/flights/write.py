"""Tables as log files: the formats that `read_flight` reads."""

from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any


def write_table(
    target: Path | IO[bytes], columns: Mapping[str, Any], units: Mapping[str, str] | None = None
) -> None:
    """Write columns of equal length as CSV, or as Parquet if the name ends so.

    A column is an array (N,) or a list of text; None in a list and masked numbers are empty cells.
    Parquet also keeps the columns' `units`.
    """
    import pyarrow as pa  # here, so that a fit without files does not wait for it

    arrays = {name: pa.array(x) for name, x in columns.items()}
    metadata = {name: {"unit": unit} for name, unit in (units or {}).items() if unit}
    fields = [pa.field(n, x.type, metadata=metadata.get(n)) for n, x in arrays.items()]
    table = pa.Table.from_arrays(list(arrays.values()), schema=pa.schema(fields))
    if isinstance(target, Path) and target.suffix.lower() == ".parquet":
        import pyarrow.parquet

        pyarrow.parquet.write_table(table, target)
        return
    import pyarrow.csv

    # pyarrow writes enough digits to restore the same float64.
    pyarrow.csv.write_csv(
        table, target if isinstance(target, Path) else pa.PythonFile(target, mode="w")
    )
