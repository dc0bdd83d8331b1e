"""Lines as they arrive: any cut, order within a second and repetition give the same rows."""

import numpy as np
import pytest

from heli_jax.errors import InputError
from heli_jax.flights import Signal
from heli_jax.stream.rows import Sorter

DT, N = 0.02, 400
TIME = Signal("t", "s", "s")
NAMES = ["u", "phi"]
HEAD = b"t,u,phi\n"


def table(seed=0):
    rng = np.random.default_rng(seed)
    return np.c_[DT * np.arange(N), rng.standard_normal(N), 10.0 * rng.standard_normal(N)]


def lines_of(rows):
    return [b"%.3f,%.6g,%.6g" % tuple(row) for row in rows]


def text_of(rows):
    return HEAD + b"\n".join(lines_of(rows)) + b"\n"


def taken(pieces):
    """Return the rows given out, those at the end, and the sorter."""
    sorter = Sorter("log.csv", TIME, NAMES)
    before = [row for piece in pieces for row in sorter.take(piece)]
    return before, sorter.finish(), sorter


def cut(text, rng, pieces=40):
    at = np.sort(rng.integers(0, len(text), pieces))
    return [text[a:b] for a, b in zip([0, *at], [*at, len(text)], strict=True)]


def test_order_cuts_and_repetitions_do_not_matter():
    rows, rng = table(), np.random.default_rng(1)
    # Each row may come up to 0.9 s later, and a third of them twice.
    late = np.r_[rows[:, 0], rows[::3, 0]] + rng.uniform(0.0, 0.9, N + len(rows[::3]))
    mixed = np.r_[rows, rows[::3]][np.argsort(late)]
    before, after, sorter = taken(cut(text_of(mixed), rng))
    assert [line for _, line in (*before, *after)] == lines_of(rows)
    assert [t for t, _ in (*before, *after)] == pytest.approx(rows[:, 0])
    assert (sorter.head, sorter.late, sorter.repeated) == (HEAD, 0, len(rows[::3]))
    # Only the last second is held back.
    assert len(after) == pytest.approx(1.0 / DT, abs=1)


def test_a_line_without_its_end_is_not_read():
    for lost in (1, 3, 9, 15):
        before, after, _ = taken([text_of(table())[:-lost]])
        assert [line for _, line in (*before, *after)] == lines_of(table()[:-1])


def test_a_row_that_comes_too_late_is_left_out():
    rows = table()
    mixed = np.r_[rows[:50], rows[51:200], rows[50:51], rows[200:]]
    before, after, sorter = taken(cut(text_of(mixed), np.random.default_rng(2), 300))
    assert sorter.late == 1
    assert len(before) + len(after) == N - 1


@pytest.mark.parametrize(
    "damage",
    [
        lambda t: t.replace(b"phi", b"psi"),
        lambda t: t.replace(b"\n4.000,", b"\nx,"),
        lambda t: t.replace(b"\n4.000,", b"\n,"),
        lambda t: t.replace(b"\n4.000,", b"\n4.000,1,"),
        lambda t: t.replace(b"\n4.000,", b"\n4.0\n00,"),
        lambda t: t[60:],
    ],
)
def test_wrong_lines_end_in_one_sentence(damage):
    with pytest.raises(InputError) as e:
        taken([damage(text_of(table()))])
    assert str(e.value).startswith("log.csv")
    assert "\n" not in str(e.value)


def test_a_damaged_line_has_its_number_and_the_rows_before_it():
    lines = text_of(table()).split(b"\n")
    lines[200] = b"3.980,x,1"
    sorter, text = Sorter("log.csv", TIME, NAMES), b"\n".join(lines)
    given = sorter.take(text[:1000])
    with pytest.raises(InputError) as e:
        sorter.take(text[1000:])
    assert "line 201," in str(e.value)
    # Rows of the call that failed are held.
    assert len(given) + len(sorter.finish()) == 199
