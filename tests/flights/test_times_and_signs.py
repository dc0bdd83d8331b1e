"""Times and numbers as spreadsheets, loggers and people of several countries write them."""

import datetime
import zoneinfo

import numpy as np
import pytest

from heli_jax.errors import InputError
from heli_jax.flights import describe_log
from heli_jax.flights.csv_dates import Dates, seconds_of_dates
from heli_jax.flights.csv_table import open_csv
from heli_jax.flights.flight import Signal
from heli_jax.flights.read import read_flight
from heli_jax.flights.time_units import likely_unit, split_unit, time_unit

N, DT = 300, 0.01
T = DT * np.arange(N)
U, P = np.sin(7.0 * T), np.cos(5.0 * T)
BEGIN = datetime.datetime(2024, 3, 4, 23, 59, 58)


def stamps(form: str, digits: int = 3) -> list[str]:
    """Of the log's samples, `%F` being the fraction of a second."""
    times = [BEGIN + datetime.timedelta(microseconds=round(1e6 * t)) for t in T]
    return [t.strftime(form.replace("%F", f"{t.microsecond:06d}"[:digits])) for t in times]


def written(tmp_path, lines, encoding="utf-8"):
    path = tmp_path / "log.csv"
    path.write_text("\n".join(lines) + "\n", encoding=encoding)
    return path


def read(path, time="Time"):
    one = {"u": Signal("u", "1", "1")}, {"p": Signal("p", "1", "1")}
    return read_flight(path, time=time, inputs=one[0], outputs=one[1])


def comma(x: float) -> str:
    return f"{x:.4f}".replace(".", ",")


@pytest.mark.parametrize(
    ("form", "digits", "noted"),
    [
        ("%d.%m.%Y %H:%M:%S,%F", 3, False),
        ("%d.%m.%y %H:%M:%S.%F", 3, False),
        ("%Y/%m/%d %H:%M:%S.%F", 3, False),
        ("%Y-%m-%d, %H:%M:%S.%F", 6, False),
        ("%d-%b-%Y %H:%M:%S.%F", 3, False),
        ("%m/%d/%Y %I:%M:%S.%F %p", 2, True),
        ("%d/%m/%Y %H:%M:%S.%F", 2, True),
        ("%M:%S.%F", 2, True),
        ("%I:%M:%S.%F %p", 2, False),
        ("%H:%M:%S:%F", 3, False),
    ],
)
def test_times_as_they_are_written_go_on_over_midnight(tmp_path, form, digits, noted):
    rows = [
        f"{s};{comma(u)};{comma(p)}" for s, u, p in zip(stamps(form, digits), U, P, strict=True)
    ]
    flight = read(written(tmp_path, ["Time;u;p", *rows]))
    assert (flight.n_samples, flight.dt) == (N, DT)
    np.testing.assert_allclose(flight.outputs["p"], P, atol=1e-4)
    assert flight.source is not None
    assert ("clock.dates" in {n.code for n in flight.source.notes}) == noted


def test_the_day_of_an_ambiguous_date_matters_only_where_the_log_leaves_it():
    def seconds(*cells):
        found = seconds_of_dates(cells)
        assert isinstance(found, Dates)
        return found.seconds.tolist(), found.note

    assert seconds("3/4/2024 0:00:01", "3/4/2024 0:00:02") == ([1.0, 2.0], "")
    assert seconds("13/4/2024 23:59:59", "14/4/2024 0:00:00") == ([86399.0, 86400.0], "")
    assert seconds("12/31/2024 11:59:59 PM", "1/1/2025 12:00:00 AM")[0] == [86399.0, 86400.0]
    # Month and day, which makes a day of it and not a month.
    times, note = seconds("3/4/2024 23:59:59", "3/5/2024 0:00:00")
    assert times == [86399.0, 86400.0]
    assert "month and day" in note
    assert seconds_of_dates(["31/12/2024 1:00:00", "12/31/2024 1:00:00"]) == 1
    assert seconds_of_dates(["1:00:00 PM", "13:00:00 PM"]) == 1
    assert seconds_of_dates(["2024-02-29 1:00:00", "2024-02-30 1:00:00"]) == 1


def test_a_column_of_dates_beside_times_of_day_counts_them_on(tmp_path):
    # The second flight of a card: a day later, and earlier in the day.
    later = [d.replace("2024-03", "2024-04") for d in stamps("%Y-%m-%d")]
    rows = [f"{d},{s},1,2" for d, s in zip(stamps("%Y-%m-%d"), stamps("%H:%M:%S.%F"), strict=True)]
    rows += [f"{d},12:00:{t:05.2f},1,2" for d, t in zip(later, T, strict=True)]
    table = open_csv(written(tmp_path, ["Date,Time,u,p", *rows]))
    times = table.numbers(["Time"])["Time"]
    np.testing.assert_allclose(times[:N] - times[0], T, atol=1e-6)
    assert times[N] - times[0] == pytest.approx(31 * 86400 - 43200 + 2 - 0)
    assert "clock.dates" in {n.code for n in table.notes}


def test_times_with_their_unit_behind_them_are_seconds(tmp_path):
    rows = [f"{1e3 * t:g} ms,{u:.6f},{p:.6f}" for t, u, p in zip(T, U, P, strict=True)]
    flight = read(written(tmp_path, ["Time,u,p", *rows]))
    assert flight.dt == DT
    info = describe_log(written(tmp_path, ["Time,u,p", *rows])).time
    assert info is not None
    assert (info.unit, info.guessed) == ("s", False)


@pytest.mark.parametrize(
    ("space", "delimiter", "decimal"),
    [(".", ";", ","), ("\u00a0", ";", ","), (" ", "\t", ","), ("'", ";", "."), (",", ",", ".")],
)
def test_marks_between_thousands_are_no_decimal_signs(tmp_path, space, delimiter, decimal):
    def number(x, digits):
        marks = str.maketrans(",.", f"#{decimal}")
        text = f"{x:,.{digits}f}".translate(marks).replace("#", space)
        return f'"{text}"' if delimiter == "," else text

    rpm = 1577.0 + np.arange(N) % 7
    cells = zip(T, U, rpm, 1577.25 + P, strict=True)
    rows = [
        delimiter.join((number(t, 2), number(u, 4), number(w, 0), number(h, 2)))
        for t, u, w, h in cells
    ]
    path = written(tmp_path, [delimiter.join(("Time", "u", "rpm", "h")), *rows])
    columns = {c.name: c for c in describe_log(path).columns}
    # By itself too, where 1.577 could be one and a half.
    assert (columns["rpm"].min, columns["rpm"].max) == (1577.0, 1583.0)
    table = open_csv(path)
    np.testing.assert_allclose(table.numbers(["rpm"])["rpm"], rpm)
    np.testing.assert_allclose(table.numbers(["h", "u"])["h"], np.round(1577.25 + P, 2))
    marked = [n.subjects for n in table.notes if n.code == "text.thousands"]
    assert marked == [("rpm",), ("h",)]


def test_points_among_decimal_commas_that_end_no_thousands_are_refused(tmp_path):
    rows = [f"{comma(t)};{u:.4f};{comma(p)}" for t, u, p in zip(T, U, P, strict=True)]
    path = written(tmp_path, ["Time;u;p", *rows])
    with pytest.raises(InputError, match=r"column 'u': got '0.0000', expected one decimal sign"):
        read(path)
    columns = {c.name: c.kind for c in describe_log(path).columns}
    assert columns == {"Time": "number", "u": "text", "p": "number"}


def test_commas_that_are_decimal_signs_and_delimiters_both_are_refused(tmp_path):
    lines = [",".join(map(comma, row)) for row in zip(T + 1, U + 1, P + 2, strict=True)]
    path = written(tmp_path, ["Time,u,p", *lines])
    with pytest.raises(InputError, match="line 2: 6 whole numbers below 3 names: its commas are"):
        open_csv(path)


@pytest.mark.parametrize(
    ("step", "rows", "unit"),
    [
        *((0.01, 6000, "s"), (1.0, 6000, "s"), (0.1, 100_000, "s")),
        *((10, 6000, "ms"), (200, 3000, "ms"), (1, 60_000, "ms"), (2, 9000, "ms")),
        *((2500, 9000, "us"), (500, 40_000, "us"), (125, 200_000, "us")),
        (10_000_000, 900, "ns"),
    ],
)
def test_ticks_without_a_unit_are_of_the_one_that_makes_a_flight(step, rows, unit):
    assert likely_unit(step * np.arange(rows) + 12345.0) == unit


@pytest.mark.parametrize("first", [45352.5, 60371.5, 739312.5, 2460372.5])
def test_days_as_spreadsheets_and_matlab_count_them_are_guessed_by_their_size(tmp_path, first):
    assert likely_unit(first + 0.01 * np.arange(6000) / 86400) == "day"
    # Seconds of a day, and of an hour, in the same range.
    assert likely_unit(first + 0.001 * np.arange(6000)) == "s"
    assert likely_unit(1e3 + 0.01 * np.arange(6000) / 86400) == "s"
    # Twice a second: the digits of Julian days end at 40 us.
    times = 0.5 * np.arange(60)
    rows = [f"{first + t / 86400:.12f},{np.sin(t)},{np.cos(t)}" for t in times]
    path = written(tmp_path, ["datenum,u,p", *rows])
    info = describe_log(path)
    assert info.time is not None
    assert (info.time.unit, info.time.guessed) == ("day", True)
    assert (info.time.rate, info.time.duration) == (
        pytest.approx(2.0),
        pytest.approx(29.5, abs=1e-4),
    )
    flight = read(path, Signal("datenum", "day", "s"))
    np.testing.assert_allclose(flight.dt, 0.5, rtol=1e-3)


@pytest.mark.parametrize(
    ("text", "unit"),
    [
        ("days since 2024-03-01", "day"),
        ("Hours since 2024-03-01 00:00:00", "h"),
        ("minutes since takeoff", "min"),
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


def test_an_offset_from_utc_that_changes_in_flight(tmp_path):
    # Summer time begins at 01:00 UTC: 01:59:59.8 +01:00 is followed by 03:00:00 +02:00.
    begin = datetime.datetime(2024, 3, 31, 0, 59, 59, tzinfo=datetime.UTC)
    rows, berlin = [], zoneinfo.ZoneInfo("Europe/Berlin")
    for k in range(60):
        at = (begin + datetime.timedelta(seconds=0.1 * k)).astimezone(berlin)
        rows.append(f"{at.isoformat(timespec='milliseconds')},{np.sin(k)},{np.cos(k)}")
    assert "+01:00" in rows[0]
    assert "+02:00" in rows[-1]
    flight = read(written(tmp_path, ["Time,u,p", *rows]))
    assert flight.dt == pytest.approx(0.1)
    assert [n.code for n in flight.source.notes].count("clock.dates") == 1
    # Z is an offset of 0; a row without any is of no known time.
    cells = ["2024-03-31T01:59:59+01:00", "2024-03-31T01:00:00Z", "2024-03-31T01:00:01 UTC"]
    found = seconds_of_dates(cells)
    assert not isinstance(found, int)
    np.testing.assert_allclose(np.diff(found.seconds), [1.0, 1.0])
    assert seconds_of_dates([*cells, "2024-03-31T03:00:01"]) == 3


def test_a_receivers_fix_is_no_time(tmp_path):
    rows = [
        f"{t:.2f},{u},{p},3D,{k // 9}h" for k, (t, u, p) in enumerate(zip(T, U, P, strict=True))
    ]
    info = describe_log(written(tmp_path, ["Time,u,p,fix,2D", *rows]))
    assert info.time is not None
    assert info.time.column == "Time"
    assert [c.kind for c in info.columns] == ["number"] * 3 + ["text"] * 2


@pytest.mark.parametrize(
    ("names", "stated", "count"),
    [
        # A quarter off; as stated; every eighth sample logged.
        (("t", "u", "p"), {"fs": 100.0}, 1),
        (("t", "u", "p"), {"dt": 0.0125}, 0),
        (("t", "u", "p"), {"fs": 640.0}, 0),
        # Of two clocks the one that is stated.
        (("imu.t", "rc.u", "imu.p", "rc.t"), {"imu.fs": 100.0, "rc.fs": 200.0}, 1),
        (("t_imu", "rc_u", "imu_p", "t_rc"), {"imu_dt": 0.0125, "rc_dt": 0.004}, 1),
        (("t_imu", "rc_u", "imu_p", "t_rc"), {"imu_dt": 0.0125, "rc_dt": 0.005}, 0),
    ],
)
def test_a_rate_beside_times_of_another_is_a_caution(tmp_path, names, stated, count):
    slow, fast = 0.0125 * np.arange(2000), 0.005 * np.arange(4500)
    clock, u, p, *other = names
    arrays = {clock: slow, u: np.sin(fast if other else slow), p: np.cos(slow)}
    np.savez(tmp_path / "a.npz", **arrays, **stated, **dict.fromkeys(other, fast))
    flight = read_flight(
        tmp_path / "a.npz",
        time=None if other else clock,
        inputs={"u": Signal(u, "1", "1")},
        outputs={"p": Signal(p, "rad/s", "rad/s")},
        rate=80.0,
    )
    assert [c.code for c in flight.source.cautions] == count * ["clock.rate-contradicted"]


@pytest.mark.parametrize(("step", "rows"), [(10.0, 2000), (5.0, 300), (1.0, 20000)])
def test_times_in_ms_are_not_taken_in_seconds(tmp_path, step, rows):
    t = step * np.arange(rows)
    np.savez(tmp_path / "a.npz", t=t, u=np.sin(t), p=np.cos(t))
    signals = {"u": Signal("u", "1", "1")}, {"p": Signal("p", "rad/s", "rad/s")}
    with pytest.raises(InputError):
        read_flight(tmp_path / "a.npz", time="t", inputs=signals[0], outputs=signals[1])
    for unit, scale, count in (("ms", 1e-3, 0), ("s", 1.0, 1)):
        clock = Signal("t", unit, "s")
        f = read_flight(tmp_path / "a.npz", time=clock, inputs=signals[0], outputs=signals[1])
        assert f.dt == pytest.approx(scale * step)
        assert [c.code for c in f.source.cautions] == count * ["units.unlikely"]
