"""Which reader opens a log."""

import sys
from pathlib import Path

from heli_jax.flights.csv_table import open_csv
from heli_jax.flights.parquet_table import open_parquet
from heli_jax.flights.table import Table, shown, wrong
from heli_jax.regular_file import require_regular


def open_table(path: str | Path) -> Table:
    """Open a log; its columns are read when they are asked for.

    Raises:
        InputError: there is no such file, it is no regular one, it is larger than a log of its
            format may be, it cannot be read, or it is of no readable format.
    """
    path = Path(path)
    # By the ending, not by the content, so that a damaged Parquet file is called so and not read as
    # text. A new format adds one entry.
    readers = {".parquet": open_parquet} | dict.fromkeys((".csv", ".txt", ".tsv"), open_csv)
    try:
        # Any size here: each reader has a limit of its own.
        if not require_regular(path, "a log in CSV or Parquet", sys.maxsize):
            raise wrong(str(path), "is empty, expected a log in CSV or Parquet")
        reader = readers.get(path.suffix.lower())
        if reader is None:
            raise wrong(
                str(path),
                f"logs ending in {shown(path.suffix)} cannot be read, expected .csv, .txt, .tsv"
                " or .parquet; convert other logs to CSV or Parquet first",
            )
        return reader(path)
    except OSError as e:
        raise wrong(str(path), f"cannot be read ({e.strerror or type(e).__name__})") from e
