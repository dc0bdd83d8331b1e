"""Large files: a parallel hash, a progress bar, and no memory for false claims."""

import gzip
import hashlib
import io
import struct
import zlib

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.feather
import pyarrow.parquet
import pytest
import scipy.io

from heli_jax import stages
from heli_jax.errors import InputError
from heli_jax.flights.formats import arrow
from heli_jax.flights.open_log import open_log, open_table
from tests.flights import log_writers as writers


def test_a_tables_fingerprint_is_the_files(tmp_path):
    table = pa.table(
        {"t": np.arange(300_000.0), "x": np.random.default_rng(0).normal(size=300_000)}
    )

    pyarrow.csv.write_csv(table, tmp_path / "log.csv")
    pyarrow.parquet.write_table(table, tmp_path / "log.parquet")
    for name in ("log.csv", "log.parquet"):
        opened = open_table(tmp_path / name)
        assert opened.sha256 == hashlib.sha256((tmp_path / name).read_bytes()).hexdigest()
        np.testing.assert_array_equal(opened.numbers(["x"])["x"], table.column("x").to_numpy())


@pytest.mark.parametrize("kind", ["float64", "int32", "timestamp[ns]", "decimal128(25, 3)", "bool"])
def test_columns_of_parquet_in_pieces_are_whole(tmp_path, monkeypatch, kind):
    numbers, gaps = np.arange(1003) % 97, np.arange(1003) % 10 == 3
    column = pa.array(numbers, mask=gaps)
    column = column.cast(pa.decimal128(25, 3) if "decimal" in kind else kind, safe=False)
    clock = pa.array(1e-3 * np.arange(1003))
    pyarrow.parquet.write_table(pa.table({"t": clock, "x": column}), tmp_path / "log.parquet")
    whole = open_table(tmp_path / "log.parquet").numbers(["x", "t"])
    monkeypatch.setattr(arrow, "_AT_ONCE", 20)
    pieces = open_table(tmp_path / "log.parquet").numbers(["x", "t"])
    expected = np.where(gaps, np.nan, numbers != 0 if kind == "bool" else numbers)
    assert list(pieces) == ["x", "t"]
    for read in (whole, pieces):
        np.testing.assert_array_equal(read["x"], expected)
        np.testing.assert_array_equal(read["t"], clock.to_numpy())


def compressed(size, content):
    """Return a MATLAB file with one compressed element that claims `size` bytes."""
    whole = io.BytesIO()
    scipy.io.savemat(whole, {"t": np.arange(3.0)}, do_compression=True)
    piece = zlib.compress(struct.pack("<2I", 14, size) + content)
    return whole.getvalue()[:128] + struct.pack("<2I", 15, len(piece)) + piece


@pytest.mark.parametrize("size", [3_000_000_000, 400_000_000, 1_000_000])
def test_arrays_are_refused_before_they_are_unpacked(tmp_path, size):
    path = tmp_path / "log.mat"
    path.write_bytes(compressed(size, bytes(1000)))
    with pytest.raises(InputError):
        open_log(path)


ZEROS = np.zeros(40_000_000, np.int8)
"""Elements: 320 MB of float64, 40 kB in the file."""


def many_keys(path):
    rows = [f'{{"k{i}":1}}' for i in range(1000)]
    path.write_text("[" + ",".join(rows) + ",{}" * 100_000 + "]")


def large_chunk(path):
    with h5py.File(path, "w") as file:
        options = {"maxshape": (None,), "chunks": (300_000_000,), "compression": "gzip"}
        file.create_dataset("x", (100,), "i1", **options)


def long_texts(path):
    texts = pa.array([f"{i}" + "a" * 10**7 for i in range(26)])
    pa.parquet.write_table(pa.table({"t": np.arange(26.0), "x": texts}), path, compression="zstd")


@pytest.mark.parametrize(
    ("name", "write"),
    [
        ("zeros.mat", lambda p: scipy.io.savemat(p, {"x": ZEROS}, do_compression=True)),
        ("zeros.npz", lambda p: np.savez_compressed(p, x=ZEROS)),
        ("zeros.h5", lambda p: h5py.File(p, "w").create_dataset("x", data=ZEROS, compression=1)),
        ("chunk.h5", large_chunk),
        ("zeros.csv.gz", lambda p: p.write_bytes(gzip.compress(b"t,x\n" + b"0,0\n" * 14_000_000))),
        ("keys.json", many_keys),
        ("lists.json", lambda p: p.write_text("[" + "[]," * 30_000_000 + "[]]")),
        ("zeros.parquet", lambda p: pa.parquet.write_table(pa.table({"x": ZEROS}), p)),
        ("texts.parquet", long_texts),
        ("zeros.feather", lambda p: pa.feather.write_feather(pa.table({"x": ZEROS}), p)),
    ],
)
def test_a_few_bytes_claim_no_memory(tmp_path, name, write):
    write(tmp_path / name)
    with pytest.raises(InputError):
        open_table(tmp_path / name).survey()


class Heard:
    def __init__(self):
        self.stages = []

    def begin(self, stage):
        self.stages.append(stage)

    def end(self, stage):
        pass


def test_an_observer_hears_of_a_file(tmp_path):
    messages = {"ATT": (129, "Qc", "TimeUS,Roll")}
    data = writers.dataflash(messages, [("ATT", (1000 * i, i)) for i in range(50)])
    path = tmp_path / "a\x1b[2Jlog.bin"
    path.write_bytes(data)
    heard = Heard()
    with stages.observed_by(heard):
        open_log(path)
        with pytest.raises(InputError):
            open_log(tmp_path / "none.bin")
    open_log(path)
    [stage] = heard.stages
    assert (stage.total, stage.first is not None) == (len(data), True)
    assert stage.words.isprintable()
