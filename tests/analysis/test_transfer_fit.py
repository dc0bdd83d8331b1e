"""Transfer functions with a delay from measured frequency responses."""

import numpy as np
import pytest
import scipy.signal

from heli_jax.analysis.transfer_fit import Hold, Measured, fit_transfer, mismatch

OMEGA = np.geomspace(0.5, 30.0, 60)


def servo(omega: np.ndarray, delay: float = 0.06) -> np.ndarray:
    """A low-pass of 8 rad/s and damping 0.6 with a zero at -20 1/s."""
    s = 1j * omega
    return 3.2 * (s + 20.0) / (s**2 + 9.6 * s + 64.0) * np.exp(-s * delay)


def measured(seed: int | None = 0, relative: float = 0.02, omega: np.ndarray = OMEGA) -> Measured:
    H = servo(omega)
    sd = relative * np.abs(H)
    rng = np.random.default_rng(seed)
    noise = 0.0 if seed is None else rng.standard_normal((2, omega.size)) * sd
    # Windows are so long that frequencies are independent.
    e = noise if seed is None else noise[0] + 1j * noise[1]
    return Measured(omega, H + e, sd, 1000.0, np.full(omega.size, 0.95))


def test_without_noise_the_coefficients_come_back():
    fitted = fit_transfer(measured(None), 1, 2)
    assert [c.value for c in fitted.numerator] == pytest.approx([3.2, 64.0], rel=1e-8)
    assert [c.value for c in fitted.denominator] == pytest.approx([9.6, 64.0], rel=1e-8)
    assert fitted.delay is not None
    assert fitted.delay.value == pytest.approx(0.06, rel=1e-8)
    assert np.sort(np.abs(fitted.poles)) == pytest.approx([8.0, 8.0], rel=1e-8)
    assert fitted.zeros == pytest.approx([-20.0], rel=1e-8)
    assert fitted.J < 1e-10


def test_intervals_cover_the_truth_and_chi_squared_is_near_one():
    inside, chi = [], []
    for seed in range(60):
        fitted = fit_transfer(measured(seed), 1, 2)
        assert fitted.delay is not None
        found = (*fitted.numerator, *fitted.denominator, fitted.delay)
        truth = (3.2, 64.0, 9.6, 64.0, 0.06)
        inside += [c.lower95 <= v <= c.upper95 for c, v in zip(found, truth, strict=True)]
        chi.append(fitted.chi_squared)
    # There is an upper limit too: chi-squared above one widens the intervals.
    assert 0.92 < np.mean(inside) < 0.985
    assert np.mean(chi) == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize(("hold", "method"), [("zero-order", "zoh"), ("linear", "foh")])
def test_of_samples_the_continuous_machine_comes_back(hold, method):
    """Test SciPy's discrete equivalents up to 0.8 of the Nyquist frequency, where images matter."""
    dt = 0.05
    b, a, _ = scipy.signal.cont2discrete(([3.0, 40.0], [1.0, 9.0, 64.0]), dt, method=method)
    omega = np.linspace(1.0, 0.8 * np.pi / dt, 80)
    H = scipy.signal.freqz(b.ravel(), a, omega * dt)[1]
    m = Measured(omega, H, 0.01 * np.abs(H), 1e3, np.ones(80), Hold(hold, dt))
    fitted = fit_transfer(m, 1, 2)
    found = [c.value for c in (*fitted.numerator, *fitted.denominator)]
    assert found == pytest.approx([3.0, 40.0, 9.0, 64.0], rel=4e-3)
    assert fitted.delay is not None
    assert abs(fitted.delay.value) < 1e-4


def test_too_low_an_order_is_seen_in_chi_squared():
    assert fit_transfer(measured(), 0, 1).chi_squared > 20.0


def test_a_pole_that_nothing_shows_is_not_determined():
    fitted = fit_transfer(measured(None), 2, 3, delay=True)
    assert any(not np.isfinite(c.sd) or c.sd > abs(c.value) for c in fitted.denominator)


def test_denser_frequencies_say_no_more():
    """Test that two frequencies within one line of the window have equal information."""
    few, many = (
        measured(None, omega=np.linspace(0.5, 30.0, n))._replace(seconds=5.0) for n in (60, 600)
    )
    sds = [fit_transfer(m, 1, 2).denominator[0].sd for m in (few, many)]
    assert sds[1] == pytest.approx(sds[0], rel=0.05)


def test_mismatch_is_that_of_the_book():
    """Test an error of 1 dB and 10 degrees everywhere, with coherence 0.95, by hand."""
    m = measured(None)
    model = m.H * 10 ** (1.0 / 20.0) * np.exp(1j * np.radians(10.0))
    weight = (1.58 * (1.0 - np.exp(-0.95))) ** 2
    assert mismatch(m, model) == pytest.approx(20.0 * weight * (1.0 + 0.01745 * 100.0), rel=1e-9)


@pytest.mark.parametrize(
    ("orders", "seconds"), [((2, 1), 20.0), ((0, 0), 20.0), ((0, 9), 20.0), ((1, 2), 0.5)]
)
def test_orders_that_cannot_be_fitted_are_refused(orders, seconds):
    with pytest.raises(ValueError):  # noqa: PT011
        fit_transfer(measured()._replace(seconds=seconds), *orders)
