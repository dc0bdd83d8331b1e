"""Results of `describe_log`."""

import math
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from heli_jax.errors import InputError
from heli_jax.flights import Gap, Signal, describe_log, read_flight

TREX = Path(__file__).parents[2] / ".." / "shared" / "data" / "trex550"


def test_columns_of_a_csv(tmp_path):
    path = tmp_path / "bench.csv"
    path.write_text("mode,time,phi\nhover,0,1\nhover,1,nan\n,2,\nclimb,3,5\n")
    info = describe_log(path)
    assert (info.format, info.n_rows, info.size) == ("csv", 4, path.stat().st_size)
    mode, time, phi = info.columns
    assert (mode.kind, mode.count, math.isnan(mode.mean)) == ("text", 3, True)
    assert (time.kind, time.min, time.max, time.mean) == ("number", 0.0, 3.0, 1.5)
    assert (phi.count, phi.n_nan, phi.min, phi.max, phi.sd) == (3, 2, 1.0, 5.0, 2.0)
    assert info.time is not None
    assert (info.time.column, info.time.duration, info.time.rate) == ("time", 3.0, 1.0)
    assert info.time.uniform


def test_gaps_and_unit_of_the_clock(tmp_path):
    path = tmp_path / "bench.csv"
    stamps = [i for i in range(0, 1000, 20) if not 200 < i < 300]
    path.write_text("\n".join(["phi,t_ms", *(f"1,{t}" for t in stamps)]))
    time = describe_log(path).time
    assert time is not None
    assert (time.column, time.unit, time.uniform) == ("t_ms", "ms", False)
    assert time.rate == pytest.approx(50.0)
    assert time.gaps == (Gap(pytest.approx(0.2), pytest.approx(0.1)),)


@pytest.mark.parametrize(
    ("name", "unit"), [("time [us]", "us"), ("Timestamp (ms)", "ms"), ("time s", "s"), ("T", "s")]
)
def test_names_of_a_clock(tmp_path, name, unit):
    path = tmp_path / "bench.csv"
    path.write_text(f"n,{name}\n" + "\n".join(f"{i},{3 * i}" for i in range(9)))
    time = describe_log(path).time
    assert time is not None
    assert (time.column, time.unit) == (name, unit)


def test_a_column_that_merely_increases_is_no_clock_unless_it_is_named(tmp_path):
    path = tmp_path / "bench.parquet"
    x = np.arange(10.0)
    pq.write_table(pa.table({"phi": -x, "elapse": x, "other": 2 * x}), path)
    guessed, asked = describe_log(path).time, describe_log(path, Signal("other", "ms", "s")).time
    assert guessed is None
    assert asked is not None
    assert (asked.column, asked.rate) == ("other", pytest.approx(500.0))


@pytest.mark.parametrize(
    ("stamps", "word"),
    [
        ("0 1 1", "stands still"),
        ("0 2 1", "backwards"),
        ("0 nan 1", "1 time stamps"),
        ("0", "single"),
    ],
)
def test_clock_with_a_problem(tmp_path, stamps, word):
    path = tmp_path / "bench.csv"
    path.write_text("\n".join(["t,x", *(f"{t},{i}" for i, t in enumerate(stamps.split()))]))
    time = describe_log(path).time
    assert time is not None
    assert word in time.problem


def test_log_without_a_clock(tmp_path):
    path = tmp_path / "bench.csv"
    path.write_text("x,y\n3,a\n1,b\n")
    assert describe_log(path).time is None


@pytest.mark.parametrize(("time", "word"), [("tt", "did you mean"), ("mode", "text")])
def test_wrong_clock(tmp_path, time, word):
    path = tmp_path / "bench.csv"
    path.write_text("t,mode\n0,a\n1,b\n")
    with pytest.raises(InputError):
        describe_log(path, time)


@pytest.mark.skipif(not TREX.is_dir(), reason="the T-Rex logs are not part of the project")
@pytest.mark.parametrize(
    ("log", "t0", "n"), [("Pitchtest", 243.64, 6697), ("Hovertest", 108.05, 7968)]
)
def test_real_logs(log, t0, n):
    path = TREX / f"{log}.csv"
    info = describe_log(path)
    assert info.time is not None
    assert (info.n_rows, info.time.rate, info.time.gaps) == (n, pytest.approx(100.0), ())
    flight = read_flight(
        path,
        time="t",
        inputs={"x_roll": Signal("lat", "stick", "1")},
        outputs={"roll": Signal("phi", "rad", "rad")},
        window=(18, 32),
    )
    assert (flight.dt, flight.n_samples, flight.t0) == (0.01, 1401, pytest.approx(t0 + 18))
    assert flight.source is not None
    assert flight.source.notes == ()
