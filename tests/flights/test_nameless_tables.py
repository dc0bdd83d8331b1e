"""Tables of numbers alone, and comments between their rows."""

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


@pytest.mark.parametrize(("between", "name"), [(" ", "a.asc"), (",", "a.csv"), (";", "a.csv")])
def test_a_table_without_names_is_refused_with_what_to_write(tmp_path, between, name):
    with pytest.raises(InputError, match="write a line of names above"):
        open_csv(of_lines(tmp_path, rows(between=between), name))


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
