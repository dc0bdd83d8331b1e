"""Faults of a log or a request end in one sentence with the place."""

import math
import os
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from heli_jax.errors import InputError
from heli_jax.flights import (
    Flight,
    Signal,
    read_flight,
    require_moving_outputs,
)
from heli_jax.flights.describe import describe_log
from heli_jax.flights.read import require_some_time

STICK = Signal("stick", "mm", "m")
PHI = Signal("phi", "deg", "rad")


def test_a_record_too_short_for_any_machine_names_the_unit_of_its_time():
    flight = Flight(1e-7, {"u": np.arange(7000.0)}, {"p": np.arange(7000.0)}, name="flight 1")
    with pytest.raises(InputError):
        require_some_time(flight)


def rows(n: int = 20, dt: float = 0.02) -> list[list[str]]:
    return [[f"{i * dt:.3f}", str(i % 3), f"{0.1 * i:.1f}"] for i in range(n)]


def csv_text(cells: list[list[str]], header: str = "t,stick,phi") -> str:
    return "\n".join([header, *(",".join(row) for row in cells)]) + "\n"


def refused(path: Path, *places: str, **request) -> str:
    """Read, and check that the sentence has the file and the places."""
    asked = {"time": "t", "inputs": {"x_roll": STICK}, "outputs": {"roll": PHI}} | request
    with pytest.raises(InputError) as caught:
        read_flight(path, **asked)
    text = str(caught.value)
    assert text.startswith(str(path))
    assert "\n" not in text
    assert "Traceback" not in text
    for place in places:
        assert place in text
    return text


WHOLE = csv_text(rows())


def stamps(values: list[float]) -> str:
    return csv_text([[repr(t), str(i % 3), "0"] for i, t in enumerate(values)])


REGULAR = [0.02 * i for i in range(20)]

UNEVEN = {
    "few samples": (csv_text(rows(7)), ["7 samples"]),
    "lost sample": (stamps([0.02 * i for i in (*range(9), *range(10, 20))]), ["line 11", "50"]),
    "long gap": (stamps([*REGULAR[:9], *(t + 3 for t in REGULAR)]), ["line 11"]),
    "jitter": (stamps([t + 0.006 * (i == 4) for i, t in enumerate(REGULAR)]), ["line 6", "50"]),
}


@pytest.mark.parametrize("case", UNEVEN)
def test_uneven_times(tmp_path, case):
    text, places = UNEVEN[case]
    path = tmp_path / "bench.csv"
    path.write_text(text)
    refused(path, *places)


def test_slow_clock_drift_is_refused(tmp_path):
    t = np.cumsum(np.where(np.arange(400) < 200, 0.02, 0.0206))
    path = tmp_path / "bench.csv"
    path.write_text(stamps([float(x) for x in t]))
    refused(path, "line ")


def test_file_that_is_not_there(tmp_path):
    refused(tmp_path / "none.csv", "no such file")


def test_folder(tmp_path):
    refused(tmp_path, "folder")


def test_name_with_a_null_character():
    with pytest.raises(InputError):
        read_flight("a\x00b.csv", time="t", inputs={"x_roll": STICK}, outputs={})


def test_file_that_may_not_be_read(tmp_path, monkeypatch):
    path = tmp_path / "bench.csv"
    path.write_text(WHOLE)

    def deny(*_):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(os, "open", deny)
    refused(path, "Permission denied")


BAD_REQUEST = {
    "input and output": {"inputs": {"x_roll": PHI}},
    "time and signal": {"inputs": {"x_roll": Signal("t", "s", "s")}},
    "one output twice": {"outputs": {"roll": PHI, "pitch": PHI}},
    "nothing": {"inputs": {}, "outputs": {}},
    "unknown unit": {"outputs": {"roll": Signal("phi", "dog", "rad")}},
    "wrong kind": {"outputs": {"roll": Signal("phi", "mm", "rad")}},
    "time in metres": {"time": Signal("t", "m", "s")},
    "input with sd": {"inputs": {"x_roll": Signal("stick", "mm", "m", 1.0)}},
    "input with repeats": {"inputs": {"x_roll": Signal("stick", "mm", "m", repeats="keep")}},
    "output with hold": {"outputs": {"roll": Signal("phi", "deg", "rad", hold="linear")}},
    "no such hold": {"inputs": {"x_roll": Signal("stick", "mm", "m", hold="foh")}},
    "rate zero": {"rate": 0.0},
    "rate nan": {"rate": math.nan},
    "rate infinite": {"rate": math.inf},
    "rate far too high": {"rate": 1e9},
    "rate next to infinite": {"rate": 1e308},
    "rate next to zero": {"rate": 1e-320},
    "rate far too low": {"rate": 2.0},
    "window reversed": {"window": (0.3, 0.1)},
    "window empty": {"window": (0.1, 0.1)},
    "window infinite": {"window": (0.1, math.inf)},
    "window of three": {"window": (0.1, 0.2, 0.3)},
    "window after": {"window": (1.0, 2.0)},
    "window before": {"window": (-2.0, -1.0)},
    "window short": {"window": (0.0, 0.1)},
    "known nan": {"known": {"Ixx": math.nan}},
} | {
    f"sd {sd}": {"outputs": {"roll": Signal("phi", "deg", "rad", sd)}}
    for sd in (0.0, -1.0, math.nan, math.inf)
}


@pytest.mark.parametrize("case", BAD_REQUEST)
def test_bad_request(tmp_path, case):
    path = tmp_path / "bench.csv"
    path.write_text(WHOLE)
    refused(path, **BAD_REQUEST[case])


def test_gap_that_resampling_may_not_bridge(tmp_path):
    path = tmp_path / "bench.csv"
    path.write_text(stamps([*REGULAR[:9], *(t + 3 for t in REGULAR)]))
    refused(path, "line 11", "gap of 2.84 s", "0.25 s", rate=50.0)


def write_parquet(path: Path, **changed) -> Path:
    columns = {"t": 0.02 * np.arange(20), "stick": np.arange(20) % 3, "phi": np.arange(20.0)}
    pq.write_table(pa.table(columns | changed), path)
    return path


BAD_PARQUET = {
    "text": ({"phi": ["a"] * 20}, ["'phi'", "string"]),
    "null": ({"stick": [*range(9), None, *range(10)]}, ["row 10", "'stick'", "nothing"]),
    "nan": ({"stick": [*range(9), math.nan, *range(10)]}, ["row 10", "'stick'", "nan"]),
    "inf": ({"stick": [*range(9), math.inf, *range(10)]}, ["row 10", "'stick'", "inf"]),
    "list": ({"phi": [[1.0]] * 20}, ["'phi'", "list"]),
    "time stands": ({"t": [*range(9), 8, *range(10, 20)]}, ["row 10", "'t'", "stands still"]),
}


@pytest.mark.parametrize("case", BAD_PARQUET)
def test_bad_parquet(tmp_path, case):
    changed, places = BAD_PARQUET[case]
    refused(write_parquet(tmp_path / "bench.parquet", **changed), *places)


def test_parquet_without_rows(tmp_path):
    path = tmp_path / "bench.parquet"
    pq.write_table(pa.table({"t": pa.array([], pa.float64())}), path)
    refused(path, "no rows")


def test_parquet_with_a_column_twice(tmp_path):
    path = tmp_path / "bench.parquet"
    x = pa.array(np.arange(20.0))
    pq.write_table(pa.table([x, x, x], names=["t", "phi", "phi"]), path)
    refused(path, "'phi'", "2 columns", inputs={})


@pytest.mark.parametrize("keep", [1, 10, 200, -1, -9])
def test_broken_parquet(tmp_path, keep):
    path = write_parquet(tmp_path / "bench.parquet")
    path.write_bytes(path.read_bytes()[:keep])
    refused(path, "no whole Parquet file")


def test_an_input_may_stay_where_it_is(tmp_path):
    path = tmp_path / "bench.csv"
    path.write_text(csv_text([[r[0], "2", r[2]] for r in rows()]))
    asked = {"time": "t", "inputs": {"x_roll": STICK}, "outputs": {"roll": PHI}}
    flight = read_flight(path, **asked)
    assert np.array_equal(flight.inputs["x_roll"], np.full(20, 0.002))


def test_moving_outputs_of_a_flight_made_by_hand():
    moving, still = np.arange(9.0), np.ones(9)
    require_moving_outputs(Flight(0.1, {"x_roll": still}, {"roll": moving, "p": still}))
    with pytest.raises(InputError):
        require_moving_outputs(Flight(0.1, {"x_roll": moving}, {"roll": still}))


def test_a_parquet_file_of_lists_is_described(tmp_path):
    path = tmp_path / "lists.parquet"
    t = np.arange(4.0)
    lists = pa.array([[1.0], [], [2.0, 3.0], [4.0]])
    names = ["a", "b", "a", "each"]
    pq.write_table(pa.table([t, t + 1, t + 2, lists], names=names), path)
    columns = describe_log(path).columns
    assert [(c.name, c.kind, c.count) for c in columns] == [
        ("a", "number", 4),
        ("b", "number", 4),
        ("a", "number", 4),
        ("each", "text", 4),
    ]
    np.testing.assert_allclose([c.mean for c in columns[:3]], [1.5, 2.5, 3.5])
