"""Discrete and continuous transfer functions: the paper's numbers, SciPy, and round trips."""

import numpy as np
import pytest
import scipy.signal
from hypothesis import given
from hypothesis import strategies as st

from heli_jax import c2d, d2c

# Kim & Tilbury, eqs 34 and 35, dt 0.02 s.
EQ34 = (
    [1.2553, 1.1580, 1.0541, 0.9502, 0.8514],
    [1.0, -0.6187, 0.5405, -0.2446, -0.4079],
)
EQ35_NUM = ["1.25", "181.1", "11676", "780900", "19800000"]
EQ35_DEN = ["1", "44.83", "5648", "209600", "1012000"]
# The same, computed once with another program: reading.md.
NUM = [1.2553, 181.147, 11675.1, 780919, 1.98072e7]
DEN = [1.0, 44.837, 5648.27, 209595, 1.01235e6]


def printed_step(text):
    """Return one unit of the last printed digit, without trailing zeros of whole numbers."""
    if "." in text:
        return 10.0 ** -len(text.split(".")[1])
    return 10.0 ** (len(text) - len(text.rstrip("0"))) if len(text) > 1 else 1e-9


def test_equation_34_gives_every_published_digit_of_35():
    num, den = d2c(*EQ34, 0.02, method="real-log")
    for found, printed in (*zip(num, EQ35_NUM, strict=True), *zip(den, EQ35_DEN, strict=True)):
        # The paper truncates some digits and rounds others: within one unit of the last.
        assert abs(found - float(printed)) <= printed_step(printed), printed
    np.testing.assert_allclose(num, NUM, rtol=5e-6)
    np.testing.assert_allclose(den, DEN, rtol=1e-5)


def test_equation_35_is_not_an_inverse_of_the_hold():
    with pytest.raises(ValueError, match=r"real pole at z = -0\.506.*real-log") as e:
        d2c(*EQ34, 0.02)
    assert "order 4" in str(e.value)
    _, den = c2d(*d2c(*EQ34, 0.02, method="real-log"), 0.02)
    np.testing.assert_allclose(den, [1.0, -1.631, 1.679, -1.368, 0.408], atol=6e-4)
    assert np.abs(den - EQ34[1]).max() > 0.9


@pytest.mark.parametrize("seed", range(10))
def test_c2d_is_scipys(seed):
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 6))
    poles = -rng.uniform(0.1, 30.0, n)
    den = np.poly(poles) * rng.uniform(0.5, 2.0)
    num = rng.standard_normal(int(rng.integers(1, n + 2)))
    dt = float(rng.uniform(0.005, 0.2))
    wanted_num, wanted_den, _ = scipy.signal.cont2discrete((num, den), dt)
    found_num, found_den = c2d(num, den, dt)
    assert found_num.shape == found_den.shape == (n + 1,)
    # SciPy's numerator is a difference of two denominators, with their rounding.
    size = 1e-10 * np.abs(wanted_num).max() + 1e-14 * np.abs(wanted_den).max()
    np.testing.assert_allclose(found_num, np.ravel(wanted_num), rtol=1e-8, atol=size)
    np.testing.assert_allclose(found_den, wanted_den, rtol=1e-9, atol=1e-12)


real_poles = st.lists(st.floats(-40.0, -0.05), min_size=0, max_size=2, unique=True)
pairs = st.lists(st.tuples(st.floats(1.0, 120.0), st.floats(0.05, 0.95)), min_size=0, max_size=1)


@given(real_poles, pairs, st.integers(0, 4), st.integers(0, 10**6))
def test_a_stable_system_below_nyquist_comes_back(real, oscillating, zeros, seed):
    dt = 0.02  # Nyquist at 157 rad/s
    poles = list(real)
    for omega, damping in oscillating:
        poles += list(np.roots([1.0, 2.0 * damping * omega, omega**2]))
    poles = np.array(poles)
    gaps = np.abs(poles[:, None] - poles[None, :])[~np.eye(len(poles), dtype=bool)]
    # A logarithm near a multiple pole loses half of the digits, which is not tested here.
    if poles.size == 0 or (gaps.size and gaps.min() < 3.0):
        return
    den = np.real(np.poly(poles))
    num = np.random.default_rng(seed).standard_normal(min(zeros, len(poles)) + 1)
    back_num, back_den = d2c(*c2d(num, den, dt), dt)
    # Compared on the frequency axis, in units of the largest response.
    s = 1j * np.geomspace(0.1, 150.0, 40)
    wanted = np.polyval(num, s) / np.polyval(den, s)
    found = np.polyval(back_num, s) / np.polyval(back_den, s)
    np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-6 * np.abs(wanted).max())
    size = np.max(np.abs(poles)) ** np.arange(den.size)
    np.testing.assert_allclose(back_den / size, den / size, rtol=0, atol=1e-6)


def test_integrator_and_gain():
    num, den = c2d([3.0], [1.0, 0.0], 0.1)
    np.testing.assert_allclose(num, [0.0, 0.3], atol=1e-15)
    np.testing.assert_allclose(den, [1.0, -1.0], atol=1e-15)
    num, den = d2c(num, den, 0.1)
    np.testing.assert_allclose(num, [0.0, 3.0], atol=1e-10)
    np.testing.assert_allclose(den, [1.0, 0.0], atol=1e-10)
    num, den = c2d([2.0], [1.0, 1.0], 0.5)  # 2 (1 - e^-0.5) / (z - e^-0.5)
    np.testing.assert_allclose(num, [0.0, 2.0 * (1.0 - np.exp(-0.5))], atol=1e-14)
    np.testing.assert_allclose(den, [1.0, -np.exp(-0.5)], atol=1e-14)


@pytest.mark.parametrize("go", [c2d, d2c])
@pytest.mark.parametrize(
    ("num", "den", "dt"),
    [
        ([1.0, 2.0, 3.0], [1.0, 2.0], 0.1),
        ([1.0], [0.0, 0.0, 4.0], 0.1),
        ([1.0], [], 0.1),
        ([1.0], [1.0, np.nan], 0.1),
        ([[1.0, 2.0]], [1.0, 2.0], 0.1),
        ([1.0], [1.0, 2.0], 0.0),
        ([1.0], [1.0, 2.0], np.inf),
    ],
)
def test_wrong_arguments(go, num, den, dt):
    with pytest.raises(ValueError):  # noqa: PT011
        go(num, den, dt)


@pytest.mark.parametrize("method", ["zoh", "real-log", "tustin"])
def test_a_pole_at_zero_has_no_logarithm(method):
    with pytest.raises(ValueError, match=r"z = 0|method"):
        d2c([1.0], [1.0, -0.5, 0.0], 0.1, method=method)


@pytest.mark.parametrize("poles", [[-0.5], [-0.5, 0.3], [-0.9, -0.2, 0.1], [-1.2, 0.4]])
def test_every_negative_pole_is_named(poles):
    with pytest.raises(ValueError, match="real pole") as e:
        d2c([1.0], np.poly(poles), 0.1)
    for pole in poles:
        assert (f"{pole:.3f}" in str(e.value)) == (pole < 0)


@pytest.mark.parametrize("size", [1e-18, 1e-9, 1e9, 1e18])
@pytest.mark.parametrize("go", [c2d, d2c])
def test_the_unit_of_the_output_does_not_matter(go, size):
    """Test linearity in num: a response in micrometres is a response."""
    num, den = np.array([1.0, -2.0, 3.0]), [1.0, -1.2, 0.6]
    wanted, same = go(num, den, 0.1)
    found, other = go(size * num, den, 0.1)
    np.testing.assert_allclose(found / size, wanted, rtol=1e-9)
    np.testing.assert_allclose(other, same, rtol=1e-12)
