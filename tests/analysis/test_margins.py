"""Gain and phase margins against python-control and formulas; independence of batch elements."""

import warnings

import control
import numpy as np
import pytest

from heli_jax.analysis.margins import Margins, margins


def loop(num, den):
    """Return A, B, C, D of a transfer function, each with a batch of one."""
    s = control.tf2ss(control.tf(num, den))
    return np.array(s.A)[None], np.array(s.B).T, np.array(s.C), np.array(s.D)[0]


def of(num, den, gain=1.0):
    found = margins(*loop(num, den), gain)
    return float(found.gain[0]), float(found.phase[0]), bool(found.stable[0])


def controls(A, B, C, D, gain):
    """Return python-control's smallest margins over all crossings, and True if stable."""
    # python-control's NumPy calls warn, and its result differs if warnings are errors.
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        s = control.ss(A, B[:, None], C[None], [[D]]) * float(gain)
        stable = control.feedback(s, 1).poles().real.max() < 0
        gm, pm, *_ = control.stability_margins(s, returnall=True)
        gm = np.abs(20 * np.log10(gm))
    # python-control ignores infinite frequency.
    gm = [*gm, *([abs(20 * np.log10(-gain * D))] if gain * D < 0 else [])]
    return min(gm, default=np.inf), min(np.abs(pm), default=np.inf), bool(stable)


def random_loop(rng):
    """Return a stable system of order 2 to 6, with poles from 0.1 to 30 rad/s."""
    n, i = int(rng.integers(2, 7)), 0
    A = np.zeros((n, n))
    while i < n:
        w = 10 ** rng.uniform(-1.0, 1.5)
        if n - i >= 2 and rng.random() < 0.6:
            z = 10 ** rng.uniform(-2.0, 0.0)
            A[i : i + 2, i : i + 2] = [[-z * w, w], [-w, -z * w]]
            i += 2
        else:
            A[i, i] = -w
            i += 1
    T = rng.standard_normal((n, n))
    D = float(rng.choice([0.0, 0.0, rng.uniform(-0.5, 0.5)]))
    return T @ A @ np.linalg.inv(T), rng.standard_normal(n), rng.standard_normal(n), D


# Some of these loops are unstable.
GAINS = np.array([0.02, 0.05, 0.2, 1.0, -0.1])


@pytest.mark.parametrize("seed", range(15))
def test_margins_are_those_of_python_control(seed):
    rng = np.random.default_rng(seed)
    A, B, C, D = random_loop(rng)
    found = margins(*(np.repeat(np.asarray(M)[None], 5, 0) for M in (A, B, C, D)), GAINS)
    for i, k in enumerate(GAINS):
        gain, phase, stable = controls(A, B, C, D, k)
        assert found.stable[i] == stable
        if not stable:
            assert np.isnan(found.gain[i])
            assert np.isnan(found.phase[i])
            continue
        np.testing.assert_allclose(found.gain[i], gain, rtol=1e-6)
        np.testing.assert_allclose(found.phase[i], phase, rtol=1e-6)


@pytest.mark.parametrize("k", [0.5, 2.0, 7.0])
def test_three_lags(k):
    gain, phase, stable = of([1.0], [1.0, 3.0, 3.0, 1.0], k)
    assert stable
    assert gain == pytest.approx(20 * np.log10(8 / k), rel=1e-9)
    # |L| is 1 where 1 + omega^2 is k^(2/3).
    wanted = 180 - 3 * np.degrees(np.arctan(np.sqrt(k ** (2 / 3) - 1))) if k > 1 else np.inf
    assert phase == pytest.approx(wanted, rel=1e-9)


def test_gain_may_have_to_fall_or_to_rise():
    # 4 (s + 1)^2 / s^3 has a phase of -180 deg at 1 rad/s, where its gain is 8.
    gain, _, stable = of([4.0, 8.0, 4.0], [1.0, 0.0, 0.0, 0.0])
    assert stable
    assert gain == pytest.approx(20 * np.log10(8.0), rel=1e-9)
    # k 20 / ((s - 1) (s + 10)) has the closed loop s^2 + 9 s + 20 k - 10: stable for k above 0.5.
    gain, _, stable = of([20.0], [1.0, 9.0, -10.0])
    assert stable
    assert gain == pytest.approx(20 * np.log10(2.0), rel=1e-9)


def test_double_integrator_with_lead():
    a, T = 0.1, 2.0
    w = 1 / (T * np.sqrt(a))
    k = w**2 * np.sqrt(a)
    gain, phase, stable = of([k * T, k], [a * T, 1.0, 0.0, 0.0])
    assert stable
    assert gain == np.inf
    assert phase == pytest.approx(np.degrees(np.arcsin((1 - a) / (1 + a))), rel=1e-9)
    # With an additional lag.
    lag = 0.05
    gain, _, stable = of([k * T, k], np.polymul([a * T, 1.0, 0.0, 0.0], [lag, 1.0]))
    w = np.sqrt((1 - (a * T + lag) / T) / (a * T * lag))
    size = k * np.hypot(1, T * w) / (w**2 * np.hypot(1, a * T * w) * np.hypot(1, lag * w))
    assert stable
    assert gain == pytest.approx(abs(20 * np.log10(size)), rel=1e-9)


def test_a_pole_is_no_crossing():
    # The phase of (s + lead) / (s^2 + w^2) turns by 180 deg at its pole, through infinity, not
    # through the axis.
    lead, square = (M.ravel() for M in np.meshgrid([0.3, 1.0, 10.0], np.linspace(1.0, 20.0, 40)))
    A = np.zeros((lead.size, 2, 2))
    A[:, 0, 1], A[:, 1, 0] = 1.0, -square
    found = margins(A, np.tile([0.0, 1.0], (lead.size, 1)), np.stack([lead, lead**0], 1), 0 * lead)
    assert found.stable.all()
    assert np.isinf(found.gain).all()


@pytest.mark.parametrize("damping", [1e-1, 1e-3, 1e-5])
@pytest.mark.parametrize("peak", [-0.6, 3.0])
def test_narrow_resonance_is_not_missed(damping, peak):
    # An additional lag, and a resonance's circle through its middle `peak`.
    w = 7.3
    width = 2 * damping * w
    A = np.array([[-1.0, 0.0, 0.0], [0.0, 0.0, w], [0.0, -w, -width]])
    B, C = np.array([2.0, 0.0, 1.0]), np.array([1.0, 0.0, peak * width])
    gain, phase, stable = controls(A, B, C, 0.0, 1.0)
    found = margins(A[None], B[None], C[None], [0.0])
    assert stable
    assert found.stable[0]
    # python-control's polynomial roots lose digits if two of them are close.
    np.testing.assert_allclose(found.gain[0], gain, rtol=1e-5)
    np.testing.assert_allclose(found.phase[0], phase, rtol=1e-5)


def test_rounding_is_no_loop():
    # The input drives one mode and the output shows others, in mixed coordinates.
    T = np.linalg.qr(np.random.default_rng(2).standard_normal((20, 4, 4)))[0]
    A = T @ np.diag([-1.0, -2.0, -5.0, -9.0]) @ T.mT
    found = margins(A, T[:, :, 0], T[:, :, 1] + T[:, :, 2], np.zeros(20))
    assert np.isinf(found.gain).all()
    assert np.isinf(found.phase).all()
    assert found.stable.all()


def test_two_crossings_between_points_of_the_grid():
    # |k s / ((s + 1) (s + 10))| is k / 11 at most, at sqrt(10) rad/s.
    k = 11 * (1 + 1e-6)
    gain, phase, stable = of([k, 0.0], [1.0, 11.0, 10.0])
    w = np.sqrt(np.roots([1.0, 101.0 - k**2, 100.0]).real)
    angles = 90 - np.degrees(np.arctan(w) + np.arctan(w / 10))
    assert stable
    assert gain == np.inf
    assert phase == pytest.approx(np.min(180 - np.abs(angles)), rel=1e-6)


@pytest.mark.parametrize(
    ("D", "gain"),
    [(-0.5, 20 * np.log10(2)), (-4.0, 20 * np.log10(4)), (0.5, np.inf), (3.0, np.inf)],
)
@pytest.mark.parametrize("n", [0, 2])
def test_constant_loop(D, gain, n):
    found = margins(-np.eye(n)[None], np.zeros((1, n)), np.ones((1, n)), [D])
    assert found.gain[0] == pytest.approx(gain, rel=1e-12)
    assert found.phase[0] == np.inf
    assert found.stable[0]


def crowd(batch=300):
    """Return loops of four states with different gains, more than one block."""
    rng = np.random.default_rng(7)
    A = rng.standard_normal((batch, 4, 4)) - 2.5 * np.eye(4)
    B, C = rng.standard_normal((2, batch, 4))
    return A, B, C, 0.1 * rng.standard_normal(batch), rng.uniform(0.1, 3.0, batch)


def same(found, wanted):
    for f, w in zip(found, wanted, strict=True):
        np.testing.assert_array_equal(f, w)


def test_a_batch_is_its_elements_one_by_one():
    loops = crowd()
    found = margins(*loops)
    assert 50 < found.stable.sum() < 290
    assert np.isfinite(found.gain).sum() > 50
    assert np.isfinite(found.phase).sum() > 50
    for i in (*range(0, 300, 7), 255, 256, 299):
        one = margins(*(M[i : i + 1] for M in loops))
        same(one, Margins(*(M[i : i + 1] for M in found)))


def test_elements_that_mean_nothing_leave_the_others_alone():
    loops = crowd()
    wanted = margins(*loops)
    broken = [M.copy() for M in loops]
    for where, (which, value) in enumerate(
        [(0, np.nan), (1, np.inf), (2, np.nan), (3, -np.inf), (4, np.nan), (0, 1e308), (1, 1e308)]
    ):
        broken[which][10 * where] = value
    broken[3][100], broken[4][100] = -0.5, 2.0
    # One has a matrix that is singular at a point of the grid.
    broken[0][110] = np.kron(np.eye(2), [[0.0, 1.0], [-1.0, 0.0]])
    found = margins(*broken)
    bad = [0, 10, 20, 30, 40, 50, 60, 100]
    assert np.isnan(found.gain[bad]).all()
    assert np.isnan(found.phase[bad]).all()
    assert not found.stable[bad].any()
    rest = np.delete(np.arange(300), [*bad, 110])
    same(Margins(*(M[rest] for M in found)), Margins(*(M[rest] for M in wanted)))


# States are sway speed, roll, roll rate, flapping and a servo lag; the loop is from stick to roll
# with roll rate.
HELI = (
    np.array(
        [
            [-0.1, 9.81, 0.0, 9.81, 0.0],
            [0.0, 0.0, 1.0, 0.0, 0.0],
            [-0.3, 0.0, 0.0, 400.0, 0.0],
            [0.02, 0.0, -1.0, -10.0, 10.0],
            [0.0, 0.0, 0.0, 0.0, -20.0],
        ]
    ),
    np.array([0.0, 0.0, 0.0, 0.0, 20.0]),
    np.array([0.0, 1.0, 0.1, 0.0, 0.0]),
)


def with_chains(T=None):
    """Return the same with position and heading, each integrated from an undamped speed."""
    A = np.zeros((9, 9))
    A[:5, :5] = HELI[0]
    A[5, 0] = A[5, 1] = A[6, 5] = A[7, 2] = A[8, 7] = 1.0
    B, C = np.r_[HELI[1], np.zeros(4)], np.r_[HELI[2], np.zeros(4)]
    if T is None:
        return A, B, C
    return T @ A @ T.T, T @ B, T @ C


@pytest.mark.parametrize("gain", [0.2, 0.3, 0.5, 1.0, -0.01])
def test_positions_that_the_output_does_not_see(gain):
    T = np.linalg.qr(np.random.default_rng(5).standard_normal((9, 9)))[0]
    alone = margins(*(M[None] for M in HELI), [0.0], gain)
    chained = margins(*(M[None] for M in with_chains()), [0.0], gain)
    mixed = margins(*(M[None] for M in with_chains(T)), [0.0], gain)
    # At 0.2 the crossing is slow, where rounding of the mixed chains matters most.
    for found, tolerance in ((chained, 1e-9), (mixed, 1e-4)):
        assert found.stable[0] == alone.stable[0] == (0.1 < gain < 1.0)
        np.testing.assert_allclose(found.gain, alone.gain, rtol=tolerance)
        np.testing.assert_allclose(found.phase, alone.phase, rtol=tolerance)


def test_wrong_shapes_are_refused():
    A, B, C, D = loop([1.0], [1.0, 1.0, 1.0])
    for wrong in ((A[0], B, C, D), (A, B[..., None], C, D), (A, B, C, 0.0), (A, B, C, D, [1, 2])):
        with pytest.raises(ValueError, match="shape"):
            margins(*wrong)
