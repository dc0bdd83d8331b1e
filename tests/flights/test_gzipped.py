"""Texts packed by gzip, as Python's own module packs them."""

import gzip
import hashlib

import numpy as np
import pytest

from heli_jax.errors import InputError
from heli_jax.flights import describe_log, table
from heli_jax.flights.open_log import open_log, open_table

T = 0.02 * np.arange(50)
TEXT = "\n".join(["t,phi", *(f"{t:.2f},{np.sin(t):.6f}" for t in T)]) + "\n"


@pytest.mark.parametrize("name", ["flight.csv.gz", "FLIGHT.CSV.GZ", "flight.txt.gz"])
def test_a_text_is_read_as_it_is_unpacked(tmp_path, name):
    path = tmp_path / name
    # Two members, as where a logger appended.
    half = len(TEXT) // 2
    path.write_bytes(gzip.compress(TEXT[:half].encode()) + gzip.compress(TEXT[half:].encode()))
    table = open_table(path)
    np.testing.assert_allclose(table.numbers(["phi"])["phi"], np.sin(T), atol=1e-6)
    assert table.sha256 == hashlib.sha256(path.read_bytes()).hexdigest()
    assert table.size == path.stat().st_size
    info = describe_log(path)
    assert info.time is not None
    assert info.time.rate == pytest.approx(50.0)


def test_what_is_no_whole_file_or_no_text_is_refused(tmp_path):
    path, packed = tmp_path / "flight.csv.gz", gzip.compress(TEXT.encode())
    for data in (packed[:-9], packed[:40], TEXT.encode(), packed[:60] + b"\0" * 50 + packed[60:]):
        path.write_bytes(data)
        with pytest.raises(InputError, match=r"flight\.csv\.gz: is no whole file of gzip"):
            open_log(path)
    other = tmp_path / "flight.ulg.gz"
    other.write_bytes(packed)
    with pytest.raises(InputError, match=r"read of texts alone .* expected it unpacked"):
        open_log(other)


def test_a_few_bytes_that_claim_any_number_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(table, "_MOST_SMALL", 10**6)
    path = tmp_path / "flight.csv.gz"
    path.write_bytes(gzip.compress(b"t,phi\n" + b"0" * 10**7))
    with pytest.raises(InputError, match=r"1\.95 MB"):
        open_log(path)
