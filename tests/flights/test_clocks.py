"""Clocks of logs: units, choice of the column, contradicting rates, faults."""

import numpy as np
import pytest

from heli_jax.errors import InputError
from heli_jax.flights import Signal, describe_log, read_flight
from heli_jax.flights.clock import likely_unit, split_unit, time_unit
from heli_jax.flights.convert import Selection, convert_log

N, DT = 300, 0.01
T = DT * np.arange(N)
U, P = np.sin(7.0 * T), np.cos(5.0 * T)
ROWS = [f"{t:.2f},{u:.6f},{p:.6f}" for t, u, p in zip(T, U, P, strict=True)]
CELLS = [row.partition(",")[2] for row in ROWS]


def written(tmp_path, rows, names="t,u,p"):
    path = tmp_path / "log.csv"
    path.write_text("\n".join([names, *rows]) + "\n")
    return path


def stamped(tmp_path, stamps, names="t,u,p"):
    rows = [f"{s},{c}" for s, c in zip(stamps, CELLS, strict=False)]
    return written(tmp_path, rows, names)


def read(path, time: str | Signal | None = "t", u="u", p="p", **options):
    inputs, outputs = {"u": Signal(u, "1", "1")}, {"p": Signal(p, "1", "1")}
    return read_flight(path, time=time, inputs=inputs, outputs=outputs, **options)


def clock(path):
    info = describe_log(path)
    assert info.time is not None
    return info.time


# Units.


@pytest.mark.parametrize(
    ("step", "rows", "unit"),
    [
        *((0.01, 6000, "s"), (1.0, 6000, "s"), (0.1, 100_000, "s")),
        *((10, 6000, "ms"), (200, 3000, "ms"), (1, 60_000, "ms"), (2, 9000, "ms")),
        *((2500, 9000, "us"), (500, 40_000, "us"), (125, 200_000, "us")),
        *((1e6, 5000, "ns"), (2e3, 5000, "us"), (10_000_000, 900, "ns")),
    ],
)
def test_ticks_without_a_unit_are_of_the_one_that_makes_a_flight(step, rows, unit):
    assert likely_unit(step * np.arange(rows) + 12345.0) == unit


@pytest.mark.parametrize(
    ("text", "unit"),
    [
        ("days since 2024-03-01", "day"),
        ("Hours since 2024-03-01 00:00:00", "h"),
        ("milliseconds  Since 1970-01-01T00:00:00Z", "ms"),
        ("d", "day"),
        ("since 1970", None),
        ("dayssince 1970", None),
    ],
)
def test_the_unit_of_a_clock_with_its_epoch(text, unit):
    assert time_unit(text) == unit


@pytest.mark.parametrize(
    ("name", "parts"),
    [
        ("Time [h]", ("Time", "h")),
        ("t (d)", ("t", "day")),
        ("elapsed_hours", ("elapsed", "h")),
        ("time days", ("time", "day")),
        # A position down, and the span of a tail.
        ("pos_d", ("pos_d", "")),
        ("t_h", ("t_h", "")),
    ],
)
def test_the_unit_of_a_clock_behind_its_name(name, parts):
    assert split_unit(name) == parts


def test_a_unit_in_the_file_counts_and_one_in_a_name_is_a_hint(tmp_path):
    path = written(tmp_path, ["[ms],[-],[deg/s]", *ROWS])
    flight = read(path)
    assert flight.dt == pytest.approx(DT * 1e-3)
    contradicted = [n.subjects for n in flight.source.notes if n.code == "units.contradicted"]
    assert contradicted == [(), ("p",)]
    path = written(tmp_path, ROWS, "time_ms,u,p")
    assert "units.contradicted" in {n.code for n in read(path, "time_ms").source.notes}
    # Flights do not have steps of 10 s: the unit in the name applies.
    path = stamped(tmp_path, [f"{1e3 * t:.1f}" for t in T], "time_ms,u,p")
    with pytest.raises(InputError):
        read(path, "time_ms")


@pytest.mark.parametrize(("step", "rows"), [(10.0, 2000), (5.0, 300), (1.0, 20000)])
def test_times_in_ms_are_not_taken_in_seconds(tmp_path, step, rows):
    t = step * np.arange(rows)
    np.savez(tmp_path / "a.npz", t=t, u=np.sin(t), p=np.cos(t))
    with pytest.raises(InputError):
        read(tmp_path / "a.npz")
    for unit, scale in (("ms", 1e-3), ("s", 1.0)):
        f = read(tmp_path / "a.npz", Signal("t", unit, "s"))
        assert f.dt == pytest.approx(scale * step)


# Choice of the clock's column.


@pytest.mark.parametrize(
    ("names", "column"),
    [
        ("Packet number,Gyroscope X (deg/s)", None),
        ("Millis,Gyroscope X (deg/s)", "Millis"),
        ("Freq (Hz),Gain", None),
    ],
)
def test_what_increases_along_a_table_and_is_no_time(tmp_path, names, column):
    # A common count of several sensors' packets does not increase by one in each of them.
    numbers = np.cumsum(np.tile([2, 1, 2, 1, 1], 40))
    path = written(tmp_path, [f"{n},{np.sin(n / 9):.5f}" for n in numbers], names)
    time = describe_log(path).time
    assert (None if time is None else time.column) == column


# Faults.


def test_a_counter_of_32_bits_goes_on_and_other_faults_are_refused_with_their_line(tmp_path):
    ticks = (np.round(1e6 * T).astype(np.int64) + 2**32 - 1_000_000) % 2**32
    path = stamped(tmp_path, ticks)
    assert read(path, Signal("t", "us", "s")).dt == pytest.approx(DT)
    made = convert_log(path, Selection(time_unit="us")).columns["time"]
    np.testing.assert_allclose(made, T, atol=1e-9)
    twice, spike = T.copy(), T.copy()
    twice[100], spike[100] = twice[99], 1e6
    for stamps, line in (
        (twice, 102),
        (spike, 103),
        (T[::-1], 3),
        (T - (T >= 1.5), 152),
        (T % 1.5, 152),
        (np.round(T, 1), 3),
    ):
        with pytest.raises(InputError, match=f"line {line}, column 't'"):
            read(stamped(tmp_path, [f"{s:.3f}" for s in stamps]))
