"""Tables below titles, settings and names in several lines, as programs write them."""

import numpy as np
import pytest

from heli_jax.errors import InputError
from heli_jax.flights import describe_log
from heli_jax.flights.csv_table import open_csv

N = 40
T = 0.01 * np.arange(N)
U, P = np.round(np.sin(9.0 * T), 6), np.round(np.cos(7.0 * T), 6)


def rows(delimiter=",", end="", columns=(T, U, P)):
    return [delimiter.join(f"{x:.6f}" for x in row) + end for row in zip(*columns, strict=True)]


BLACKBOX = [
    '"Product","Blackbox flight data recorder by Nicholas Sherlock"',
    '"firmwareType",5',
    '"Data version",2',
    '"minthrottle",1070',
    '"maxthrottle",2000',
    '"rollPID","45,80,30"',
    '"loopIteration","time","gyroADC[0]"',
]
LABVIEW = [
    "LabVIEW Measurement\t",
    "Separator\tTab",
    "Decimal_Separator\t.",
    "Date\t2024/03/01",
    "Time\t17:18:18.938945770263671875",
    "***End_of_Header***\t",
    "",
    "Channels\t2\t\t",
    "Samples\t40\t40\t",
    "Time\t17:18:18.9389\t17:18:18.9389\t",
    "X0\t0.0000000000000000E+0\t0.0000000000000000E+0\t",
    "Delta_X\t0.010000\t0.010000\t",
    "***End_of_Header***\t\t\t",
    "X_Value\tStick\tRate\tComment",
]
MOTIVE = [
    "Format Version,1.23,Take Name,Take 1,Capture Frame Rate,100.000000,Total Frames,40",
    "",
    ",Rigid Body,Rigid Body",
    ",heli,heli",
    ",5E3A1B2C44,5E3A1B2C44",
    ",Rotation,Position",
    "Time (Seconds),X,X",
]
VICON = ["Trajectories", "100", ",heli:m1,heli:m2", "Time,X,X", "s,mm,mm"]
XPLANE = ["", "  _real,_time |    elev,stick |   ____P,_deg/s | "]

NOT_READ = {
    *(BLACKBOX[0], LABVIEW[0], MOTIVE[0], VICON[0]),
    *("Stand, roll", "Title,Stand", "s,deg/s,deg/s"),
}
"""first lines that are no part of a table"""


@pytest.mark.parametrize(
    ("name", "above", "body", "names", "line"),
    [
        ("a.csv", BLACKBOX, rows(), ("loopIteration", "time", "gyroADC[0]"), 7),
        ("a.csv", ["sep=;", "t;u;p"], rows(";"), ("t", "u", "p"), 2),
        ("a.csv", ['"sep=,"', "t,u,p"], rows(), ("t", "u", "p"), 2),
        ("a.csv", ["// logger 7", "# a, b, c", "t,u,p"], rows(), ("t", "u", "p"), 3),
        ("a.csv", ["// t,u,p"], rows(), ("t", "u", "p"), 1),
        ("a.lvm", LABVIEW, rows("\t"), ("X_Value", "Stick", "Rate"), 14),
        ("a.csv", MOTIVE, rows(), ("Time (Seconds)", "Rotation.X", "Position.X"), 7),
        ("a.csv", VICON, rows(), ("Time", "heli:m1.X", "heli:m2.X"), 4),
        ("a.csv", ["Time,Gyro,Gyro", ",x,y"], rows(), ("Time", "Gyro.x", "Gyro.y"), 2),
        (
            "Data.txt",
            XPLANE,
            rows(" | ", " | "),
            ("_real,_time", "elev,stick", "____P,_deg/s", ""),
            2,
        ),
        ("a.txt", ["Stand, roll", "Date: 3/1/2024", "", "t u p", "s % deg/s"], rows(" "), "tup", 4),
        ("a.csv", ["Title,Stand", "Rate,100", "Begin,12", "t,u,p"], rows(), "tup", 4),
        ("a.csv", ["t,u,p", "-----"], rows(), "tup", 1),
        ("a.csv", ["t,u,p", "double,double,single"], rows(), "tup", 1),
        ("a.csv", ["s,deg/s,deg/s", "t,u,p"], rows(), "tup", 2),
        ("a.csv", ["t,u,p"], rows(",", ","), ("t", "u", "p", ""), 1),
    ],
)
def test_a_table_is_found_below_what_stands_above_it(tmp_path, name, above, body, names, line):
    path = tmp_path / name
    path.write_text("\n".join((*above, *body)) + "\n")
    table = open_csv(path)
    assert table.names == tuple(names)
    first, second, third = table.names[:3]
    numbers = table.numbers([first, second, third])
    np.testing.assert_allclose(numbers[first], T, atol=1e-6)
    np.testing.assert_allclose(numbers[second], U, atol=1e-6)
    np.testing.assert_allclose(numbers[third], P, atol=1e-6)
    # Lines are counted from the top of the file, whatever stands above.
    lines = path.read_text().splitlines()
    assert lines[int(table.place(7).removeprefix("line ")) - 1] == body[7]
    assert [c.name for c in describe_log(path).columns] == [n for n in names if n]


@pytest.mark.parametrize(
    ("row", "units"),
    [
        ("Y_Unit_Label\tV\tdeg/s\t", ("", "V", "deg/s")),
        ("Y_Unit_Label\tV\tdeg/s", ("", "V", "deg/s")),
        ("Einheit\t\tdeg/s\t", ("", "", "deg/s")),
        # Words that are no units are none.
        ("Y_Unit_Label\tsome\tthing\t", ("", "", "")),
    ],
)
def test_a_line_of_units_among_the_settings_and_a_mark_of_their_end(tmp_path, row, units):
    # Where no cell stands alone, the mark would be a group of all columns.
    mark = "***End_of_Header***\t\t\t"
    path = tmp_path / "a.lvm"
    path.write_text("\n".join((*LABVIEW[:11], row, mark, LABVIEW[-1], *rows("\t", "\t"))) + "\n")
    table = open_csv(path)
    assert table.names == ("X_Value", "Stick", "Rate", "Comment")
    assert tuple(table.units.get(n, "") for n in table.names[:3]) == units


def test_units_of_columns_that_have_clocks_of_their_own_are_left(tmp_path):
    labels = ["Y_Unit_Label\tV\tdeg/s\t\t", "X_Value\tStick\tX_Value\tRate\tComment"]
    path = tmp_path / "a.lvm"
    body = rows("\t", "\t", (T, U, T, P))
    path.write_text("\n".join((*LABVIEW[:6], *labels, *body)) + "\n")
    assert not any(open_csv(path).units.values())


def test_two_tables_in_a_file_and_samples_without_names_are_refused(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("\n".join(("Devices", "t,u,p", *rows(), "", "Markers", "t,x,y", *rows())))
    with pytest.raises(InputError, match="tables with names in line 2 and in line 45"):
        open_csv(path)
    path.write_text("\n".join(f"2024-03-01T12:30:01.{i:03d},FE,roll,{i},p,1" for i in range(99)))
    with pytest.raises(InputError, match=r"line 1: got '2024-03-01T12:30:01.000', expected the na"):
        open_csv(path)
    # One cell too many, which is none of a delimiter at the end.
    path.write_text("\n".join(("t,u,p", *rows(",", ",7"))))
    with pytest.raises(
        InputError,
        match=r"line 2: 4 cells, expected 3 as in the header in line 1; no line of names",
    ):
        open_csv(path).numbers(["t"])


@pytest.mark.parametrize("cell", ["NA", "auto", ""])
def test_samples_without_numbers_at_the_beginning_are_no_names(tmp_path, cell):
    path = tmp_path / "a.csv"
    first = [f"{0.01 * i - 1:.2f},{cell},{cell},{cell}" for i in range(20)]
    path.write_text("\n".join(("t,u,p,q", *first, *(f"{row},1" for row in rows()))))
    table = open_csv(path)
    assert table.names == ("t", "u", "p", "q")
    assert table.numbers(["t"])["t"].size == 20 + N


def test_only_what_can_stand_between_cells_is_a_separator(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("\n".join(("sep=\u00a7", "t,u,p", *rows())))
    assert open_csv(path).names == ("t", "u", "p")
