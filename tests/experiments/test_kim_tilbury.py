"""The paper's eqs 34 and 35 in experiments/kim_tilbury_1997.py, against scipy and the print."""

import runpy
from pathlib import Path

import numpy as np
import pytest
import scipy.linalg
import scipy.signal

NUM_34, DEN_34 = (1.2553, 1.1580, 1.0541, 0.9502, 0.8514), (1, -0.6187, 0.5405, -0.2446, -0.4079)
NUM_35, DEN_35 = (1.25, 181.1, 11676.0, 780900.0, 19800000.0), (1, 44.83, 5648, 209600, 1012000)


@pytest.fixture(scope="module")
def script():
    path = Path(__file__).parents[2] / "experiments" / "kim_tilbury_1997.py"
    return runpy.run_path(str(path))


def test_eq_34_gives_every_digit_of_eq_35(script):
    rows = script["digits"]()
    assert [float(row["printed"]) for row in rows] == [*NUM_35, *DEN_35]
    assert all(abs(row["off_in_last_digits"]) < 1.0 for row in rows)
    A, B, C, D = scipy.signal.tf2ss(NUM_34, DEN_34)
    M = np.block([[A, B], [np.zeros((1, 4)), np.eye(1)]])
    L = scipy.linalg.logm(M.astype(complex)).real / 0.02
    num, den = scipy.signal.ss2tf(L[:4, :4], L[:4, 4:], C, D)
    np.testing.assert_allclose([r["computed"] for r in rows], [*num[0], *den], rtol=1e-9)


@pytest.mark.parametrize(
    ("printed", "worth"), [("1.25", 0.01), ("181.1", 0.1), ("5648", 1), ("209600", 100), ("1", 1)]
)
def test_worth_of_the_last_digit(script, printed, worth):
    assert script["last_digit"](printed) == pytest.approx(worth)


def test_the_way_back_is_another_system(script):
    assert "z = -0.506" in script["refusal"]()
    num, den = script["sampled_35"]()
    b, a, _ = scipy.signal.cont2discrete((NUM_35, DEN_35), 0.02)
    np.testing.assert_allclose(num, np.ravel(b), rtol=1e-8)
    np.testing.assert_allclose(den, a, rtol=1e-8)
    assert np.max(np.abs(den - DEN_34)) > 1.0
