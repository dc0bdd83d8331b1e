"""Transfer functions with a fast pole that the data do not separate from its mirror image."""

import numpy as np

from heli_jax.analysis.transfer_fit import Measured, fit_transfer

NUMERATOR, DENOMINATOR, DELAY = [480.0], [1.0, 21.7, 160.0], 0.06
"""Roll rate over stick: a mode at 2 Hz."""


def _response(omega: np.ndarray, numerator: list[float], denominator: list[float]) -> np.ndarray:
    s = 1j * omega
    return np.polyval(numerator, s) / np.polyval(denominator, s) * np.exp(-DELAY * s)


def _fits(numerator: list[float], denominator: list[float], relative: float, last: float) -> list:
    """Fit ten responses known from 0.08 to `last` Hz, with relative random errors."""
    omega = 2.0 * np.pi * np.arange(0.08, last, 2.0 / 24.0)
    H = _response(omega, numerator, denominator)
    fits = []
    for seed in range(10):
        noise = np.random.default_rng(seed).standard_normal((2, omega.size))
        sd = relative * np.abs(H)
        measured = Measured(omega, H + sd * (noise[0] + 1j * noise[1]), sd, 24.0, 0.0 * sd + 0.9)
        fits.append(fit_transfer(measured, len(numerator) - 1, len(denominator) - 1))
    return fits


def test_a_pole_beyond_the_band_is_not_taken_for_a_growing_one() -> None:
    # 1 / (p - s) with a longer delay fits about as well, by chance better.
    fits = _fits(NUMERATOR, DENOMINATOR, 0.15, 2.2)
    assert all(np.all(np.real(f.poles) < 0) for f in fits)
    inside = [c.lower95 < 21.7 < c.upper95 for c in (f.denominator[0] for f in fits)]
    assert sum(inside) >= 8


def test_a_growing_pole_that_the_data_show_stays() -> None:
    for growing in (0.5, 4.0):  # [1/s], below the middle of the band and within its upper half
        fits = _fits([10.0], [1.0, 8.0 - growing, -8.0 * growing], 0.05, 5.0)
        found = [float(np.max(np.real(f.poles))) for f in fits]
        assert np.allclose(found, growing, rtol=0.2)
