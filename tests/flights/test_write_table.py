"""Columns are written as pyarrow alone would have them."""

import numpy as np
import pyarrow as pa
import pytest

from heli_jax.flights.write import write_table

COLUMNS = {
    "numbers": np.array([1.0, np.nan, -np.inf, 0.1 + 0.2]),
    "every other": np.arange(8.0)[::2],
    "whole": np.arange(4),
    "single": np.array([0.1, 0.2, 0.3, 0.4], np.float32),
    "true": np.array([True, False, True, True]),
    "words": ["a", None, "", 'b"'],
    "texts": ["é", "", 'b"', "a,b"],
}


@pytest.mark.parametrize("name", ["log.csv", "log.parquet"])
def test_columns_are_written_as_pyarrow_has_them(tmp_path, name):
    import pyarrow.csv
    import pyarrow.parquet

    write_table(tmp_path / name, COLUMNS)
    table = pa.table({n: pa.array(v) for n, v in COLUMNS.items()})
    if name.endswith(".csv"):
        pyarrow.csv.write_csv(table, tmp_path / "wanted.csv")
        assert (tmp_path / name).read_bytes() == (tmp_path / "wanted.csv").read_bytes()
    else:
        read = pyarrow.parquet.read_table(tmp_path / name)
        assert read.schema.equals(table.schema)
        assert repr(read.to_pydict()) == repr(table.to_pydict())
