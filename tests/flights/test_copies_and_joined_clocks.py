"""Rows that were written twice, and clocks of two columns."""

import numpy as np
import pytest

from heli_jax.errors import InputError
from heli_jax.flights import describe_log
from heli_jax.flights.convert import Selection, convert_log
from heli_jax.flights.flight import Signal
from heli_jax.flights.read import read_flight

N, DT = 300, 0.01
T = DT * np.arange(N)
U, P = np.sin(7.0 * T), np.cos(5.0 * T)
ROWS = [f"{t:.2f},{u:.6f},{p:.6f}" for t, u, p in zip(T, U, P, strict=True)]


def written(tmp_path, lines):
    path = tmp_path / "log.csv"
    path.write_text("\n".join(lines) + "\n")
    return path


def read(path, time="t"):
    one = {"u": Signal("u", "1", "1")}, {"p": Signal("p", "1", "1")}
    return read_flight(path, time=time, inputs=one[0], outputs=one[1])


@pytest.mark.parametrize(
    "rows",
    [
        [row for row in ROWS for _ in range(2)],
        [*ROWS[:50], *ROWS[45:]],
        [*ROWS, ROWS[-1]],
    ],
    ids=["each", "a block again", "the last"],
)
def test_rows_written_twice_are_read_once_and_noted(tmp_path, rows):
    path = written(tmp_path, ["t,u,p", *rows])
    flight = read(path)
    assert (flight.n_samples, flight.dt) == (N, DT)
    np.testing.assert_allclose(flight.outputs["p"], P, atol=1e-6)
    assert flight.source is not None
    assert "clock.rows-twice" in {n.code for n in flight.source.notes}
    info = describe_log(path)
    assert (info.n_rows, info.time is not None and info.time.problem) == (N, "")
    got = convert_log(path, Selection())
    np.testing.assert_allclose(got.columns["u"], U, atol=1e-6)


def test_a_line_behind_rows_written_twice_is_named_by_its_place_in_the_file(tmp_path):
    rows = [row for row in ROWS for _ in range(2)]
    rows[200] = rows[201] = f"{T[100]:.2f},nan,0.5"
    with pytest.raises(InputError, match="line 202, column 'u'"):
        read(written(tmp_path, ["t,u,p", *rows]))


def test_rows_of_one_time_with_other_values_are_refused_for_what_they_are(tmp_path):
    others = [f"{t:.2f},{u:.6f},{p + 1:.6f}" for t, u, p in zip(T, U, P, strict=True)]
    rows = [row for both in zip(ROWS, others, strict=True) for row in both]
    path = written(tmp_path, ["t,u,p", *rows])
    words = "300 of 600 rows have the time of the row before and other values"
    with pytest.raises(InputError, match=words):
        read(path)
    info = describe_log(path)
    assert info.time is not None
    assert words in info.time.problem
    # At rest a coarse clock makes rows alike, which are none written twice.
    still = [f"{t:.1f},0,{p:.6f}" for t, p in zip(T, np.where(T < 1, 0.0, P), strict=True)]
    assert describe_log(written(tmp_path, ["t,u,p", *still])).n_rows == N


@pytest.mark.parametrize(
    ("names", "whole", "rest", "scale"),
    [
        ("header.stamp.secs,header.stamp.nsecs", "{:d}", "{:.0f}", 1e9),
        ("stamp.sec,stamp.nanosec", "{:d}", "{:.0f}", 1e9),
        ("Time,Millis", "12:30:{:02d}", "{:.0f}", 1e3),
    ],
)
def test_seconds_in_two_columns_are_one_clock(tmp_path, names, whole, rest, scale):
    seconds, parts = np.arange(N) // 100, np.arange(N) % 100 / 100
    cells = [row.partition(",")[2] for row in ROWS]
    rows = [
        f"{i},{whole.format(s)},{rest.format(scale * r)},{c}"
        for i, (s, r, c) in enumerate(zip(seconds, parts, cells, strict=True))
    ]
    path = written(tmp_path, [f"seq,{names},u,p", *rows])
    info = describe_log(path)
    assert info.time is not None
    assert (info.time.column, info.time.unit) == (names.replace(",", "+"), "s")
    assert info.time.rate == pytest.approx(100.0)
    flight = read(path, names.replace(",", "+"))
    assert flight.dt == pytest.approx(DT)
    np.testing.assert_allclose(flight.outputs["p"], P, atol=1e-6)
    # Two whole clocks in two units are no parts of one.
    both = [f"{t:.2f},{1e3 * t:.0f},1" for t in T]
    info = describe_log(written(tmp_path, ["time_s,time_ms,p", *both]))
    assert info.time is not None
    assert info.time.column == "time_s"
