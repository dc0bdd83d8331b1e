"""Delimited text: the numbers of each file, or the place of the fault."""

import datetime
import gzip
import hashlib
import zoneinfo

import numpy as np
import pytest

from heli_jax.errors import InputError
from heli_jax.flights import Signal, describe_log, log, read_flight
from heli_jax.flights.clock import seconds_of_dates
from heli_jax.flights.convert import Selection, convert_log
from heli_jax.flights.formats.csv_text import open_csv
from heli_jax.flights.open_log import open_log

N = 40
T = 0.02 * np.arange(N)
U, P = np.round(np.sin(9.0 * T), 6), np.round(np.cos(7.0 * T), 6)


def lines(between=",", form="{:.6f}", end="", first=None):
    """Return rows of T, U and P."""
    rows = zip(T if first is None else first, U, P, strict=True)
    return [
        between.join(x if isinstance(x, str) else form.format(x) for x in row) + end for row in rows
    ]


def text(*above, rows=None, **how):
    return "\n".join((*above, *(lines(**how) if rows is None else rows))) + "\n"


def with_cell(row, name, cell, **how):
    """Return the table with one cell replaced."""
    rows = [row.split(",") for row in lines(**how)]
    rows[row]["tup".index(name)] = cell
    return text("t,u,p", rows=[",".join(row) for row in rows])


def written(tmp_path, content, name="log.csv"):
    path = tmp_path / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def read(path, time: str | Signal = "t", **options):
    one = {"u": Signal("u", "1", "1")}, {"p": Signal("p", "1", "1")}
    return read_flight(path, time=time, inputs=one[0], outputs=one[1], **options)


BEGIN = datetime.datetime(2024, 2, 29, 23, 59, 59, 600_000)


def times(form, digits=3):
    """Return stamps of the rows across midnight; `%F` is the fraction of a second."""
    at = [BEGIN + datetime.timedelta(seconds=float(t)) for t in T]
    return [t.strftime(form.replace("%F", f"{t.microsecond:06d}"[:digits])) for t in at]


COMMA = [row.replace(".", ",") for row in lines(";")]
LABVIEW = ("LabVIEW Measurement\t", "Separator\tTab", "Time\t17:18:18.93\t17:18:18.93\t")
LABVIEW += ("X0\t0.0E+0\t0.0E+0\t", "Delta_X\t0.01\t0.01\t", "***End_of_Header***\t\t\t")
BLACKBOX = ('"Product","Blackbox flight data recorder"', '"minthrottle",1070')
BLACKBOX += ('"rollPID","45,80,30"', '"t","u","p"')
TUP = "t,u,p"
READ = {
    "plain": ("a.csv", text(TUP)),
    "windows": ("a.csv", text(TUP).replace("\n", "\r\n")),
    "old mac": ("a.csv", text(TUP).replace("\n", "\r")),
    "no end of line": ("a.csv", text(TUP).rstrip()),
    "blank lines": ("a.csv", text(TUP).replace("\n", "\n \n\n")),
    "byte order mark": ("a.csv", "\ufeff" + text(TUP)),
    "utf-16": ("a.csv", text(TUP).encode("utf-16")),
    "latin letters": ("a.csv", text("t,u,p,Knüppel", end=",0").encode("latin-1")),
    "tabs": ("a.csv", text("t\tu\tp", between="\t")),
    "semicolons": ("a.csv", text("t;u;p", between=";")),
    "decimal commas": ("a.csv", text("t;u;p", rows=COMMA)),
    "decimal commas in quotes": ("a.csv", text(TUP, rows=['"' + r.replace(";", '","') + '"'
                                                          for r in COMMA])),
    "commas in a name": ("a.csv", text("t;u;p;a, b", between=";", end=";0")),
    "bars": ("a.txt", text("t | u | p |", between=" | ", end=" | ")),
    "blanks": ("a.asc", text("t   u  p", between="   ")),
    "blanks and exponents": ("a.dat", text(" t u p", between=" ", form="{:15.6E}")),
    "quotes": ("a.csv", text('"t", "u", "p"', rows=['"' + r.replace(",", '", "') + '"'
                                                    for r in lines()])),
    "a long text": ("a.csv", text("t,u,p,n", end="," + "x" * 400_000)),
    "plus signs": ("a.csv", text(TUP, form="{:+.6f}")),
    "exponents of Fortran": ("a.csv", text(TUP, form="{:.6E}").replace("E", "D")),
    "a true minus": ("a.csv", text(TUP).replace("-", "\u2212")),
    "comments above": ("a.csv", text("// logger 7", "# a, b, c", "", TUP)),
    "names in a comment": ("a.csv", text("# t,u,p")),
    "names and units in comments": ("a.asc", text("# a title", "# t u p", "# s - deg/s",
                                                  between=" ")),
    "titles": ("a.csv", text("Title,Stand", "Rate,100", "Begin,12", TUP)),
    "titles and blanks": ("a.txt", text("Stand, roll", "Date: 3/1/2024", "", "t u p", "s % deg/s",
                                        between=" ")),
    "Blackbox Explorer": ("a.csv", text(*BLACKBOX)),
    "LabVIEW": ("a.lvm", text(*LABVIEW, "t\tu\tp\tComment", between="\t")),
    "a rule": ("a.csv", text(TUP, "-----")),
    "a separator": ("a.csv", text("sep=;", "t;u;p", between=";")),
    "units below": ("a.csv", text(TUP, "[s],[-],[deg/s]")),
    "units in capitals": ("a.csv", text(TUP, "SEC,PCT,DEG/SEC")),
    "a delimiter at the end": ("a.csv", text("t,u,p", end=",")),
    "empty rows at the end": ("a.csv", text("t;u;p;;", between=";", end=";;") + ";;;;\n" * 30),
    "a last line cut off": ("a.csv", text(TUP) + "0.8,3"),
    "marks at the beginning": ("a.csv", text(TUP).replace("t,u,p\n", "t,u,p\n-0.020000,0,NA\n")),
    "gzip": ("a.csv.gz", gzip.compress(text(TUP)[:300].encode())
             + gzip.compress(text(TUP)[300:].encode())),
    "ISO dates": ("a.csv", text(TUP, first=times("%Y-%m-%dT%H:%M:%S.%F"))),
    "ISO dates, UTC": ("a.csv", text(TUP, first=times("%Y/%m/%d %H:%M:%S.%FZ"))),
    "ISO dates, offset": ("a.csv", text(TUP, first=times("%Y-%m-%d %H:%M:%S.%F+01:00", 6))),
    "times of day": ("a.csv", text(TUP, first=times("%H:%M:%S.%F"))),
}  # fmt: skip
NOTED = {"units below": "text.units-line",
         "units in capitals": "text.units-line", "a last line cut off": "text.line-cut-off",
              "names and units in comments": "text.units-line"}  # fmt: skip


@pytest.mark.parametrize("case", READ)
def test_read(tmp_path, case):
    path = written(tmp_path, READ[case][1], READ[case][0])
    flight = read(path)
    skip = 1 if case == "marks at the beginning" else 0
    assert flight.dt == pytest.approx(0.02, rel=1e-9)
    np.testing.assert_array_equal(flight.inputs["u"][skip:], U)
    np.testing.assert_array_equal(flight.outputs["p"][skip:], P)
    assert flight.source is not None
    assert (NOTED.get(case) in {n.code for n in flight.source.notes}) == (case in NOTED)
    assert flight.source.sha256 == hashlib.sha256(path.read_bytes()).hexdigest()
    info = describe_log(path)
    assert info.n_rows == N + skip
    assert info.time is not None
    assert (info.time.column, info.time.rate) == ("t", pytest.approx(50.0))
    assert (info.columns[2].max, info.columns[1].kind) == (P.max(), "number")
    # The number of a row is that in the file.
    place = open_log(path).place(7 + skip).removeprefix("line ")
    if case not in ("old mac", "utf-16", "gzip", "latin letters"):
        raw = path.read_text(encoding="utf-8-sig").split("\n")[int(place) - 1]
        assert f"{U[7]:.6f}"[:6] in raw.replace("\u2212", "-").replace(",", ".") or "E" in raw \
            or "D" in raw or "0,4" in raw or "+" in raw  # fmt: skip


UNITS = {
    "[ms],[-],[deg/s]": ("ms", "-", "deg/s"),
    "Milliseconds,-,°/s": ("Milliseconds", "-", "°/s"),
    "\u03bcs,NONE,DEG/SEC": ("\u03bcs", "NONE", "deg/sec"),
    "s,degC,hPa": ("s", "degC", "hPa"),
}


@pytest.mark.parametrize("row", UNITS)
@pytest.mark.parametrize("encoding", ["utf-8", "utf-16"])
def test_units(tmp_path, row, encoding):
    opened = open_csv(written(tmp_path, text(TUP, row).encode(encoding)))
    assert tuple(opened.units.values()) == UNITS[row]
    assert opened.numbers(["t"])["t"].size == N


MARKS = ("", "NaN", "NA", "null", "None", "-", "#N/A", " - ", "1.#QNAN", "-1.#IND", "?")


@pytest.mark.parametrize("mark", MARKS)
def test_marks_for_nothing(tmp_path, mark):
    path = written(tmp_path, with_cell(30, "p", mark))
    y = read(path).outputs["p"]
    np.testing.assert_array_equal(y, np.where(np.arange(N) == 30, np.nan, P))
    assert "p" in convert_log(path, Selection()).columns
    with pytest.raises(InputError, match="line 32, column 'u'"):
        read(written(tmp_path, with_cell(30, "u", mark)))


REFUSED = {
    "nothing": ("# a comment\n\n", "log.csv"),
    "a header alone": ("t,u,p\n  \n\n", "line 1"),
    "no names": (text(rows=lines()), "line 1"),
    "times for names": (text(rows=lines(first=times("%H:%M:%S.%F"))), "line 1"),
    "blanks": ("t u p\n0 1 2\n", "'t'"),
    "commas twice": (text(TUP, rows=[r.replace(";", ",") for r in COMMA]), "line 2"),
    "a short row": (text("# a", TUP, rows=[*lines()[:9], "0,1", *lines()[9:]]), "line 12"),
    "a long row": (text("# a", TUP, rows=[*lines()[:9], "0,1,2,3", *lines()[9:]]), "line 12"),
    "a name too few": (text("t,u"), "'p'"),
    "a name too many": (text("t,u,p,q"), "line 2"),
    "a comment between": (text(TUP, rows=[*lines()[:9], "# a", *lines()[9:]]), "line 11"),
    "names between": (text(TUP, rows=[*lines()[:9], TUP, *lines()[9:]]), "line 11"),
    "text": (with_cell(4, "p", "fast"), "line 6, column 'p'"),
    "a hexadecimal": (with_cell(4, "p", "0x10"), "line 6, column 'p'"),
    "an underscore": (with_cell(4, "p", "1_0"), "line 6, column 'p'"),
    "an empty input": (with_cell(5, "u", ""), "line 7, column 'u'"),
    "an infinite input": (with_cell(5, "u", "-inf"), "line 7, column 'u'"),
    "a huge input": (with_cell(5, "u", "1e400"), "line 7, column 'u'"),
    "no output": (text(TUP, rows=[f"{t:.2f},0,inf" for t in T]), "line 2, column 'p'"),
    "a text behind blanks": (
        text(TUP).replace("0.0600", "\n  \n0.0600").replace("0.100000,0", "0.100000,zwei"),
        "line 9, column 'u'",
    ),
    "a text behind quotes": (
        with_cell(2, "t", '"0.04\n"').replace("0.100000,0", "0.100000,zwei"),
        "line 4",
    ),
    "an open quote": (with_cell(4, "p", '"4'), "line 6"),
    "a column twice": (text("t,u,u"), "'u'"),
    "no such column": (text("t,u,P"), "'p'"),
    "no time": (with_cell(5, "t", ""), "line 7, column 't'"),
    "a time that stands": (with_cell(5, "t", "0.08"), "line 7, column 't'"),
    "a time that goes back": (with_cell(5, "t", "0.05"), "line 7, column 't'"),
    "a text for a time": (
        text(TUP, first=times("%H:%M:%S.%F")).replace("00:00:00.100", "later"), "column 't'"),
    "thousands": (with_cell(5, "p", "1'577.25"), "line 7, column 'p'"),
    "both decimal signs": (text("t;u;p", rows=[*COMMA[:-1], "0,78;0.5;0,1"]), "line 41"),
    "two decimal signs": (text("t;u;p", between=";").replace("0.02", "0,02"), "column 't'"),
    "German dates": (text("t;u;p", between=";", first=times("%d.%m.%Y %H:%M:%S")), "line 2"),
    "month and day": (text(TUP, first=times("%m/%d/%Y %H:%M:%S.%F")), "line 2, column 't'"),
    "half a day": (text(TUP, first=times("%I:%M:%S.%F %p")), "line 2, column 't'"),
    "minutes": (text(TUP, first=times("%M:%S.%F")), "line 2, column 't'"),
    "binary": (b"t,u\n0,1\n\0\1\2\n", "line 3"),
    "half of utf-16": ("t,u\n0,1\n".encode("utf-16")[:-1], "log.csv"),
    "other bytes": (b"t,u,p\n" + b"\x81\x8d\x90,1,2\n" * 20, "line 2"),
    "a long line": ("t,u,p\n" + "1" * 11_000_000, "line 2"),
    "many columns": ("t,u,p" + "," * 20_000 + "\n1,2", "line 1"),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_refused(tmp_path, case):
    content, place = REFUSED[case]
    path = written(tmp_path, content)
    with pytest.raises(InputError) as caught:
        read(path, rate=50.0)
    assert str(caught.value).startswith(str(path))
    assert place in str(caught.value)
    assert len(str(caught.value)) < 500 + len(str(path))
    assert "\n" not in str(caught.value)


def test_packed_texts(tmp_path, monkeypatch):
    packed = gzip.compress(text(TUP).encode())
    for data in (packed[:-9], packed[:40], b"t,u", packed[:60] + b"\0" * 50 + packed[60:]):
        with pytest.raises(InputError):
            open_log(written(tmp_path, data, "a.csv.gz"))
    with pytest.raises(InputError):
        open_log(written(tmp_path, packed, "a.ulg.gz"))
    monkeypatch.setattr(log, "_MOST_SMALL", 10**6)
    with pytest.raises(InputError):
        open_log(written(tmp_path, gzip.compress(b"t,u\n" + b"0" * 10**7), "a.csv.gz"))


def test_columns_of_text(tmp_path):
    rows = [f"{r},{i}D,{'auto' if i < 25 else ''}" for i, r in enumerate(lines())]
    rows[12] = rows[12].replace(f"{P[12]:.6f}", "ERR")
    path = written(tmp_path, text("t,u,p,fix,mode", rows=rows))
    t, u, p, fix, mode = describe_log(path).columns
    assert [c.kind for c in (t, u, p, fix, mode)] == ["number"] * 2 + ["text"] * 3
    # A single bad cell is reported with its place.
    assert "line 14" in p.strays
    assert (fix.strays, mode.strays, mode.count) == ("", "", 25)
    made = convert_log(path, Selection())
    assert list(made.columns) == ["time", "u"]
    left = [n.subjects for n in made.notes if n.code == "channels.left-out"]
    assert left == [("p", "fix", "mode")]


def test_offsets_from_utc_that_change_or_are_missing(tmp_path):
    # Summer time begins at 01:00 UTC: 01:59:59.8 +01:00 is followed by 03:00:00 +02:00.
    begin = datetime.datetime(2024, 3, 31, 0, 59, 59, tzinfo=datetime.UTC)
    berlin = zoneinfo.ZoneInfo("Europe/Berlin")
    cells = [
        (begin + datetime.timedelta(seconds=0.1 * k)).astimezone(berlin).isoformat()
        for k in range(60)
    ]
    seconds = seconds_of_dates(cells)
    np.testing.assert_allclose(np.diff(seconds), 0.1, atol=1e-9)
    assert seconds_of_dates([*cells, "2024-03-31T03:00:01"]) == 60
    assert seconds_of_dates(["2024-02-29 1:00:00".replace(" 1", " 01"), "2024-02-30 01:00:00"]) == 1
