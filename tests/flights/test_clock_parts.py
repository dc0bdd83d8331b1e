"""Clocks that a file has in several columns, or in one number of hours, minutes and seconds."""

import datetime

import numpy as np
import pytest

from heli_jax.flights import describe_log
from heli_jax.flights.flight import Signal
from heli_jax.flights.read import read_flight

N, DT = 1500, 0.01
P = np.cos(5.0 * DT * np.arange(N))
BEGIN = datetime.datetime(2024, 2, 29, 23, 59, 50)
TIMES = [BEGIN + datetime.timedelta(milliseconds=10 * i) for i in range(N)]


def written(tmp_path, names, cells):
    rows = (f"{cell},{np.sin(0.1 * i):.5f},{p:.6f}" for i, (cell, p) in enumerate(cells))
    path = tmp_path / "log.csv"
    path.write_text("\n".join([f"{names},u,p", *rows]) + "\n")
    return path


def seconds(t: datetime.datetime) -> float:
    return t.second + 1e-6 * t.microsecond


@pytest.mark.parametrize(
    ("names", "form", "clock"),
    [
        (
            "Year,Month,Day,Hour,Minute,Second",
            lambda t: f"{t.year},{t.month},{t.day},{t.hour},{t.minute},{seconds(t):.2f}",
            "Hour+Minute+Second",
        ),
        # Without a date it goes on behind midnight, without hours behind the hour.
        ("HH,MM,SS.sss", lambda t: f"{t.hour},{t.minute},{seconds(t):.3f}", "HH+MM+SS.sss"),
        ("GPS_min,GPS_sec", lambda t: f"{t.minute},{seconds(t):.2f}", "GPS_min+GPS_sec"),
        (
            "DOY,Hour,Min,Sec,Millisec",
            lambda t: f"{t:%j},{t.hour},{t.minute},{t.second},{t.microsecond // 1000}",
            "Hour+Min+Sec+Millisec",
        ),
        ("utc", lambda t: f"{t:%H%M%S}.{t.microsecond // 10000:02d}", "utc (HHMMSS)"),
    ],
)
def test_parts_of_a_clock_are_one_over_minutes_and_midnight(tmp_path, names, form, clock):
    path = written(tmp_path, names, zip(map(form, TIMES), P, strict=True))
    info = describe_log(path)
    assert info.time is not None
    assert (info.time.column, info.time.unit, info.time.guessed) == (clock, "s", False)
    assert info.time.duration == pytest.approx(DT * (N - 1))
    one = {"u": Signal("u", "1", "1")}, {"p": Signal("p", "1", "1")}
    flight = read_flight(path, time=clock, inputs=one[0], outputs=one[1])
    assert flight.dt == pytest.approx(DT)
    np.testing.assert_allclose(flight.outputs["p"], P, atol=1e-6)


def test_clocks_in_several_units_and_other_numbers_are_no_parts(tmp_path):
    t = DT * np.arange(N) + 50.0
    for names, cells in [
        ("t_min,t_sec", [f"{x / 60:.6f},{x:.2f}" for x in t]),
        ("hour,minute,second", [f"{x / 3600:.7f},{x / 60:.6f},{x:.2f}" for x in t]),
        ("time_utc", [f"{x:.2f}" for x in t]),
    ]:
        info = describe_log(written(tmp_path, names, zip(cells, P, strict=True)))
        assert info.time is not None
        assert info.time.column in names.split(",")
        assert info.time.duration == pytest.approx(DT * (N - 1), rel=1e-3)
