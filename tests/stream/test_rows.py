"""Lines as they arrive: any cut, order within a second and repetition give the same samples."""

import numpy as np
import pytest

from heli_jax.errors import InputError
from heli_jax.flights import Flight, Signal
from heli_jax.flights.flight import Source
from heli_jax.stream.rows import Grid, Rows, Sorter

DT, N = 0.02, 400
TIME = Signal("t", "s", "s")
NAMES = ["u", "phi"]


def text_of(rows):
    return b"t,u,phi\n" + b"".join(b"%.3f,%.6g,%.6g\n" % tuple(row) for row in rows)


def table(seed=0):
    rng = np.random.default_rng(seed)
    return np.c_[DT * np.arange(N), rng.standard_normal(N), 10.0 * rng.standard_normal(N)]


def flight_of(**hold):
    source = Source(
        "log.csv",
        "",
        inputs={"x": Signal("u", "um", "m")},
        outputs={"roll": Signal("phi", "deg", "rad", missing=(-9.0,))},
    )
    return Flight(
        dt=DT, inputs={"x": np.zeros(9)}, outputs={"roll": np.ones(9)}, source=source, hold=hold
    )


def samples_of(pieces, *, even=True):
    sorter, grid, first = Sorter("log.csv", TIME, NAMES), None, None
    taken = []
    for i, piece in enumerate([*pieces, None]):
        rows = sorter.finish() if piece is None else sorter.take(piece)
        if first is None and rows.lines:
            first = Rows(DT * np.arange(9), np.ones((9, 2)), [])
            first = first._replace(seconds=first.seconds + rows.seconds[0])
            grid = Grid(flight_of(), NAMES, first, even=even)
        if grid is not None:
            taken.append(grid.take(rows, last=i == len(pieces)))
    return (*(np.concatenate(v)[:, 0] for v in zip(*taken, strict=True)), sorter)


def cut(text, rng, pieces=40):
    at = np.sort(rng.integers(0, len(text), pieces))
    return [text[a:b] for a, b in zip([0, *at], [*at, len(text)], strict=True)]


@pytest.mark.parametrize("even", [True, False])
def test_order_cuts_and_repetitions_do_not_matter(even):
    rows, rng = table(), np.random.default_rng(1)
    u, y, _ = samples_of([text_of(rows)], even=even)
    assert u == pytest.approx(1e-6 * rows[:, 1], rel=1e-5)
    assert y == pytest.approx(np.radians(rows[:, 2]), rel=1e-5)
    # Each row may come up to 0.9 s later, and a third of them twice.
    late = np.r_[rows[:, 0], rows[::3, 0]] + rng.uniform(0.0, 0.9, N + len(rows[::3]))
    mixed = np.r_[rows, rows[::3]][np.argsort(late)]
    again_u, again_y, sorter = samples_of(cut(text_of(mixed), rng), even=even)
    assert np.array_equal(u, again_u)
    assert np.array_equal(y, again_y)
    assert (sorter.late, sorter.repeated) == (0, len(rows[::3]))


def test_a_line_without_its_end_is_not_read():
    whole = samples_of([text_of(table()[:-1])])
    for lost in (1, 3, 9, 15):
        torn = samples_of([text_of(table())[:-lost]])
        assert all(np.array_equal(a, b) for a, b in zip(whole[:2], torn[:2], strict=True))


def test_a_row_that_comes_too_late_is_left_out():
    rows = table()
    mixed = np.r_[rows[:50], rows[51:200], rows[50:51], rows[200:]]
    u, _, sorter = samples_of(cut(text_of(mixed), np.random.default_rng(2), 300))
    assert sorter.late == 1
    # A single missing sample is bridged: the input keeps its value.
    assert u[50] == u[49]
    assert u.size == N


def test_short_gaps_are_bridged_and_long_ones_are_missing():
    rows = table()
    rows[:, 2] = np.linspace(0.0, 40.0, N)
    logged = rows.copy()
    logged[20, 2] = -9.0
    kept = np.r_[0:100, 102:200, 205:250, 350:N]
    u, y, _ = samples_of([text_of(logged[kept])])
    assert y[18:22] == pytest.approx(np.radians(rows[18:22, 2]), rel=1e-3)
    assert y[99:103] == pytest.approx(np.radians(rows[99:103, 2]), rel=1e-3)
    assert np.isnan(y[200:205]).all()
    assert np.isnan(u[200:205]).all()
    assert np.isfinite(y[205:250]).all()
    # Two seconds without rows are cut to ten samples, one of which is seen.
    assert y.size == N - 100 + 9


def test_rounded_stamps_of_an_even_clock_give_the_samples_themselves():
    rows = table()
    text = b"t,u,phi\n" + b"".join(
        b"%.2f,%.6g,%.6g\n" % (round(r[0] * 1.0003 / 0.01) * 0.01, *r[1:]) for r in rows
    )
    u, _, _ = samples_of([text])
    assert u == pytest.approx(1e-6 * rows[:, 1], rel=1e-5)


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
        samples_of([damage(text_of(table()))])
    assert str(e.value).startswith("log.csv")
    assert "\n" not in str(e.value)
