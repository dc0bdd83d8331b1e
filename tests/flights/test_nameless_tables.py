"""Tables of numbers alone, as books on flight test and Fortran leave them, and comments in them."""

import numpy as np
import pytest

from heli_jax.errors import InputError
from heli_jax.flights.csv_table import open_csv
from heli_jax.flights.describe import describe_log

N = 40
TABLE = np.c_[
    0.02 * np.arange(N), 0.1 * np.sin(0.3 * np.arange(N)), -0.02 - 1e-3 * np.cos(np.arange(N))
]


def of_lines(tmp_path, lines, name="roll.dat"):
    path = tmp_path / name
    path.write_text("\n".join(lines) + "\n")
    return path


def rows(form="{:15.7E}", between=" "):
    return [between.join(form.format(x) for x in row) for row in TABLE]


def columns(path):
    table = open_csv(path)
    return np.stack(list(table.numbers(table.names).values()), axis=1), table


GLUED = ["".join(f"{x:11.4E}" if x < 0 else f" {x:10.4E}" for x in row) for row in TABLE]
NO_LETTER = [line.replace("E-", "-0").replace("E+", "+0") for line in rows("{:14.7E}")]


@pytest.mark.parametrize(
    ("lines", "name"),
    [
        (rows(), "a.asc"),
        (rows(between=","), "a.csv"),
        (rows(between=";"), "a.csv"),
        ([r.replace(".", ",") for r in rows(between=";")], "a.csv"),
        (rows("{:.7f}", "\t"), "a.tsv"),
        ([r.replace("E", "D") for r in rows()], "a.dat"),
        (GLUED, "a.dat"),
        (NO_LETTER, "a.dat"),
        ([f"{N} 3", *rows()], "a.dat"),
        (["  ".join(rows()[:1]), "", *rows()[1:]], "a.txt"),
    ],
)
def test_columns_without_names_are_called_by_their_numbers(tmp_path, lines, name):
    values, table = columns(of_lines(tmp_path, lines, name))
    assert table.names == ("column1", "column2", "column3")
    np.testing.assert_allclose(values, TABLE, atol=2e-6)


@pytest.mark.parametrize("sign", ["%", "#", "//", "!", "*", "C ", "'"])
def test_names_in_a_comment_of_any_program_are_names(tmp_path, sign):
    above = [f"{sign} Roll, dt = 0.02 s", f"{sign} time aileron p"]
    values, table = columns(of_lines(tmp_path, [*above, *rows()]))
    assert table.names == ("time", "aileron", "p")
    np.testing.assert_allclose(values, TABLE, atol=1e-7)


def test_comments_between_rows_are_passed_over_and_told(tmp_path):
    lines = ["t,u,p", *rows(between=",")]
    lines[12:12] = ["# marker, one", "% two"]
    values, table = columns(of_lines(tmp_path, [*lines, "// the, end,"], "a.csv"))
    np.testing.assert_allclose(values, TABLE, atol=1e-7)
    assert (table.notes[-1].code, table.notes[-1].value) == ("text.comments", 3)
    # Behind them lines count as before.
    lines[20] = "0.32,x,1"
    with pytest.raises(InputError, match="line 21, column 'u': got 'x'"):
        columns(of_lines(tmp_path, lines, "b.csv"))


def test_what_a_column_holds_and_a_marked_sample_are_no_comments(tmp_path):
    hashes = [f"#{i},{row}" for i, row in enumerate(rows(between=","))]
    info = describe_log(of_lines(tmp_path, ["id,t,u,p", *hashes], "a.csv"))
    assert info.n_rows == N
    lines = ["t u p", *rows()]
    lines[5] = f"* {lines[5]}"
    with pytest.raises(InputError, match="line 6: 4 cells, expected 3"):
        columns(of_lines(tmp_path, lines))


@pytest.mark.parametrize("names", ["t,p", "t,u,p,q"])
def test_a_name_too_few_is_a_slip_and_no_comment(tmp_path, names):
    with pytest.raises(InputError, match="3 cells, expected"):
        columns(of_lines(tmp_path, [names, *rows(between=",")], "a.csv"))
