"""Tables as strangers write them: marks for nothing, rows of units, dates, encodings, counters."""

import numpy as np
import pytest
import scipy.io

from heli_jax.errors import InputError
from heli_jax.flights import describe_log
from heli_jax.flights.convert import Selection, convert_log
from heli_jax.flights.csv_table import open_csv
from heli_jax.flights.flight import Signal
from heli_jax.flights.read import read_flight

N, DT = 300, 0.01
T = DT * np.arange(N)
U, P = np.sin(7.0 * T), np.cos(5.0 * T)
ROWS = [f"{t:.2f},{u:.6f},{p:.6f}" for t, u, p in zip(T, U, P, strict=True)]


def written(tmp_path, lines, name="log.csv", encoding="utf-8"):
    path = tmp_path / name
    path.write_bytes(("\n".join(lines) + "\n").encode(encoding))
    return path


def read(path, time: str | Signal = "t", u="u", p="p"):
    return read_flight(
        path, time=time, inputs={"u": Signal(u, "1", "1")}, outputs={"p": Signal(p, "1", "1")}
    )


def notes(flight):
    """By code the number that was found."""
    return {n.code: n.value for n in flight.source.notes}


@pytest.mark.parametrize(
    "mark",
    ["", "NaN", "nan", "NA", "N/A", "null", "None", "-", "#N/A", " - ", "1.#QNAN", "-1.#IND", "?"],
)
def test_marks_for_nothing_are_missing_samples(tmp_path, mark):
    rows = ROWS.copy()
    rows[100] = f"1.00,{U[100]:.6f},{mark}"
    path = written(tmp_path, ["t,u,p", *rows])
    y = read(path).outputs["p"]
    assert np.flatnonzero(np.isnan(y)).tolist() == [100]
    np.testing.assert_allclose(np.delete(y, 100), np.delete(P, 100), atol=1e-6)
    assert "p" in convert_log(path, Selection()).columns
    rows[100] = f"1.00,{mark},0"
    with pytest.raises(InputError, match="line 102, column 'u'"):
        read(written(tmp_path, ["t,u,p", *rows]))


@pytest.mark.parametrize(
    ("above", "units"),
    [
        # Half of the units are of quantities that no model has.
        (["t,u,p,T,T2,baro,mag", "s,-,rad/s,degC,K,hPa,uT"], ("s", "-", "rad/s", "degC")),
        (["t,u,p,T,T2,baro,mag", "SEC,PCT,DEG/SEC,NONE,NONE,PSI,ND"], ("SEC", "pct", "deg/sec")),
    ],
)
def test_a_row_of_units_is_none_of_names_whatever_it_holds(tmp_path, above, units):
    path = written(tmp_path, [*above, *(f"{row},20,293,1013,44" for row in ROWS)])
    table = open_csv(path)
    assert table.names == tuple(above[0].split(","))
    assert tuple(table.units.values())[: len(units)] == units
    np.testing.assert_allclose(read(path).outputs["p"], P, atol=1e-6)


def test_infinite_samples_of_an_output_are_missing_and_a_true_minus_is_one(tmp_path):
    rows = [
        f"{t:.2f},{u:.6f},{p:.6f}".replace("-", "\u2212") for t, u, p in zip(T, U, P, strict=True)
    ]
    rows[50] = f"0.50,{U[50]:.6f},inf".replace("-", "\u2212")
    flight = read(written(tmp_path, ["t,u,p", *rows]))
    assert np.flatnonzero(np.isnan(flight.outputs["p"])).tolist() == [50]
    np.testing.assert_allclose(np.delete(flight.outputs["p"], 50), np.delete(P, 50), atol=1e-6)
    assert notes(flight)["samples.marks"] == 1
    np.testing.assert_allclose(flight.inputs["u"], U, atol=1e-6)
    every = [f"{t:.2f},{u:.6f},inf" for t, u in zip(T, U, strict=True)]
    with pytest.raises(InputError, match="line 2, column 'p': got 'inf'"):
        read(written(tmp_path, ["t,u,p", *every]))


def test_columns_that_are_left_out_are_named_with_their_text(tmp_path):
    rows = [f"{r},{'auto' if i < 250 else 'manual'}" for i, r in enumerate(ROWS)]
    rows[40] = rows[40].replace(f"{P[40]:.6f}", "ERR")
    got = convert_log(written(tmp_path, ["t,u,p,mode", *rows]), Selection())
    assert list(got.columns) == ["time", "u"]
    assert [n.subjects for n in got.notes if n.code == "channels.left-out"] == [("p",), ("mode",)]


def test_a_row_of_units_is_no_sample(tmp_path):
    path = written(tmp_path, ["t,u,p", "[ms],[-],[deg/s]", *(r for r in ROWS)])
    f = read(path, Signal("t", "s", "s"))
    assert f.n_samples == N
    assert f.dt == pytest.approx(DT * 1e-3)
    assert notes(f)["text.units-line"] == 2
    assert [n.subjects for n in f.source.notes if n.code == "units.contradicted"] == [(), ("p",)]
    assert [c.unit for c in describe_log(path).columns] == ["ms", "-", "deg/s"]
    # As it is written, whole or short; micro is two letters that look the same.
    for unit, step in {"Milliseconds": 1e-3, "Ms": 1e-3, "\u00b5s": 1e-6, "\u03bcs": 1e-6}.items():
        path = written(tmp_path, ["t,u,p", f"{unit},-,rad/s", *ROWS])
        assert read(path, Signal("t", "s", "s")).dt == pytest.approx(DT * step)
    # A name is no statement, and a hint.
    path = written(tmp_path, ["time_ms,u,p", *ROWS])
    assert "units.contradicted" in notes(read(path, "time_ms"))
    inputs, outputs = {"u": Signal("u", "1", "1")}, {"p": Signal("p", "1", "1")}
    with pytest.raises(InputError, match=r"lies outside the log.*state unit: ms"):
        read_flight(path, time="time_ms", inputs=inputs, outputs=outputs, window=(10.0, 20.0))
    # Steps of 10 s are no flight's: those that the name says are meant.
    path = written(tmp_path, ["time_ms,u,p", *(f"{1e3 * k * DT:.1f},0,0" for k in range(N))])
    with pytest.raises(InputError, match=r"expected .*unit: ms"):
        read(path, "time_ms")
    # A line further down, and between blanks.
    rows = [r.replace(",", "  ") for r in ROWS]
    f = read(written(tmp_path, ["t  u  p", "s  -  rad/s", *rows], "log.asc"))
    np.testing.assert_allclose(f.outputs["p"], P, atol=1e-6)


@pytest.mark.parametrize("zone", ["", "Z", "+01:00"])
def test_dates_and_times_of_day_are_clocks(tmp_path, zone):
    stamps = np.datetime64("2024-02-29T23:59:58", "ms") + np.round(1e3 * T).astype("m8[ms]")
    cells = [row.partition(",")[2] for row in ROWS]
    rows = [f"{s}{zone},{c}" for s, c in zip(stamps.astype(str), cells, strict=True)]
    path = written(tmp_path, ["t,u,p", *rows])
    f = read(path)
    assert (f.n_samples, f.dt) == (N, DT)
    assert f.t0 == pytest.approx(86398.0)
    info = describe_log(path)
    assert info.time is not None
    assert (info.time.unit, info.time.guessed) == ("s", False)
    # Over midnight.
    days = [f"{str(s)[11:]},{c}" for s, c in zip(stamps.astype(str), cells, strict=True)]
    f = read(written(tmp_path, ["t,u,p", *days]))
    assert f.dt == DT
    days[7] = days[7].replace("23:59", "yesterday")
    with pytest.raises(InputError, match="line 9, column 't': got 'yesterday"):
        read(written(tmp_path, ["t,u,p", *days]))


@pytest.mark.parametrize("encoding", ["latin-1", "utf-16", "utf-16-be"])
def test_other_encodings_are_read_and_named(tmp_path, encoding):
    lines = ["t,Knüppel,Rate [°/s]", *ROWS]
    lines[0] = "\ufeff" * (encoding == "utf-16-be") + lines[0]
    path = written(tmp_path, lines, encoding=encoding)
    f = read(path, u="Knüppel", p="Rate [°/s]")
    np.testing.assert_allclose(f.outputs["p"], P, atol=1e-6)


def test_a_counter_of_32_bits_goes_on_and_other_clocks_get_a_remedy(tmp_path):
    ticks = (np.round(1e6 * T).astype(np.int64) + 2**32 - 1_000_000) % 2**32
    cells = [row.partition(",")[2] for row in ROWS]

    def log(stamps):
        rows = [f"{s},{c}" for s, c in zip(stamps, cells, strict=True)]
        return written(tmp_path, ["t,u,p", *rows])

    f = read(log(ticks), Signal("t", "us", "s"))
    assert f.dt == pytest.approx(DT)
    got = convert_log(log(ticks), Selection(time_unit="us"))
    np.testing.assert_allclose(got.columns["time"], T, atol=1e-9)
    twice, spike = T.copy(), T.copy()
    twice[100], spike[100] = twice[99], 1e6
    for stamps, remedy in (
        (np.round(twice, 3), "leave line 102 out"),
        (np.round(spike, 3), "line 102 is out of order"),
        (np.round(T[::-1], 3), "sort the rows"),
        (np.round(T - (T >= 1.5), 3), "the second from line 152 on"),
        (np.round(T % 1.5, 3), "gaps: split beside log: makes a flight of each"),
        (np.round(T, 1), "too few digits"),
    ):
        with pytest.raises(InputError, match=remedy):
            read(log(stamps))


def test_a_header_between_rows_and_exponents_of_fortran(tmp_path):
    rows = [*ROWS[:50], "t,u,p", *ROWS[50:]]
    with pytest.raises(InputError, match=r"line 52: .*began anew"):
        read(written(tmp_path, ["t,u,p", *rows]))
    rows = [f"{t:.6E},{u:.6E},{p:.6E}".replace("E", "D") for t, u, p in zip(T, U, P, strict=True)]
    f = read(written(tmp_path, ["t,u,p", *rows]))
    np.testing.assert_allclose(f.outputs["p"], P, atol=1e-6)


def test_complex_numbers_are_named(tmp_path):
    path = tmp_path / "log.mat"
    scipy.io.savemat(path, {"t": T, "u": U, "p": P + 2j * U})
    f = read(path)
    np.testing.assert_array_equal(f.outputs["p"], P)
    assert [n.subjects for n in f.source.notes if n.code == "channels.complex"] == [("p",)]


def test_convert_spreads_neither_marks_nor_turns(tmp_path):
    psi = (170 + 40 * np.arange(3000) * DT + 180) % 360 - 180
    p = np.cos(5.0 * np.arange(3000) * DT)
    p[500:505] = -9999.0
    rows = [f"{DT * i:.2f},{a:.6f},{b:.6f}" for i, (a, b) in enumerate(zip(psi, p, strict=True))]
    got = convert_log(written(tmp_path, ["t,psi,p", *rows]), Selection(rate=50.0))
    # A straight line, but for the filter's ends.
    middle = slice(50, -50)
    line = 170 + 40 * got.columns["time"]
    np.testing.assert_allclose(got.columns["psi"][middle], line[middle], atol=1e-3)
    assert np.nanmax(np.abs(got.columns["p"])) < 1.1
    said = {n.code: n.value for n in got.notes}
    assert "angles.unwrapped" in said
    assert said["samples.marks"] == 5


@pytest.mark.parametrize("large", [False, True])
def test_a_last_line_that_is_cut_off_is_left_out_and_told(tmp_path, monkeypatch, large):
    if large:
        monkeypatch.setattr("heli_jax.flights.csv_on_disk._LARGE", 1)
    rows = "".join(f"{0.01 * k:.2f},{k % 7},0.5\n" for k in range(100))
    path = tmp_path / "cut.csv"
    path.write_text(f"t,a,b\n{rows}1.00,3")
    table = open_csv(path)
    assert [(n.code, n.value) for n in table.notes] == [("text.line-cut-off", 2)]
    assert len(table.numbers(["t", "a", "b"])["b"]) == 100
    path.write_text(f"t,a,b\n{rows}1.00,3,0.5")
    whole = open_csv(path)
    assert whole.notes == ()
    assert len(whole.numbers(["t"])["t"]) == 101


@pytest.mark.parametrize("large", [False, True])
def test_empty_rows_that_a_spreadsheet_writes_at_the_end_are_left_out(tmp_path, monkeypatch, large):
    if large:
        monkeypatch.setattr("heli_jax.flights.csv_on_disk._LARGE", 1)
        monkeypatch.setattr("heli_jax.flights.csv_text._LAST", 8)
    # Cells behind the last column are empty too, and so are some of the last sample.
    rows = [f"{0.01 * k:.2f};{k % 7};{0.5 if k < 99 else ''};;" for k in range(100)]
    path = written(tmp_path, ["t;a;b;;", *rows, *30 * [";;;;"]])
    table = open_csv(path)
    columns = table.numbers(["t", "b"])
    np.testing.assert_allclose(columns["t"], 0.01 * np.arange(100))
    assert np.isnan(columns["b"]).sum() == 1


def test_the_stamp_of_a_sample_goes_before_that_of_its_arrival(tmp_path):
    stamps = 1_700_000_000_000_000_000 + 10_000_000 * np.arange(40)
    late = stamps + np.random.default_rng(0).integers(1_000_000, 9_000_000, 40).cumsum()
    rows = [f"{a},{s},0,{k % 7}" for k, (a, s) in enumerate(zip(late, stamps, strict=True))]
    path = written(tmp_path, ["%time,field.header.stamp,field.header.seq,field.p", *rows])
    info = describe_log(path)
    assert info.time is not None
    assert (info.time.column, info.time.unit) == ("field.header.stamp", "ns")
    assert (info.time.uniform, info.time.rate) == (True, pytest.approx(100.0))
    assert "clock.of-several" in {n.code for n in info.notes}
    # One that was never set is none.
    path = written(tmp_path, ["%time,header.stamp,p", *(f"{a},0,{a % 7}" for a in late)])
    info = describe_log(path)
    assert info.time is not None
    assert info.time.column == "%time"
    assert "clock.of-several" not in {n.code for n in info.notes}
