"""Welch's spectra against matplotlib's and a known response."""

import numpy as np
import pytest
from matplotlib import mlab

from heli_jax.analysis.spectra import segment_transforms


@pytest.fixture(scope="module")
def record():
    rng = np.random.default_rng(0)
    u = rng.standard_normal(4096) + 0.01 * np.arange(4096)
    y = 2.0 * u - 0.7 * np.roll(u, 1) + 0.1 * rng.standard_normal(4096)
    return u, y


@pytest.mark.parametrize("length", [64, 255, 256])
def test_as_matplotlib_has_them(record, length):
    u, y = record
    s = segment_transforms(np.stack([u, y]), 0.02, length)
    S = s.density
    options = {"NFFT": length, "Fs": 50.0, "noverlap": length // 2, "detrend": "linear"}
    uu, f = mlab.psd(u, **options)
    np.testing.assert_allclose(s.omega, 2 * np.pi * f, rtol=1e-12)
    np.testing.assert_allclose(S[:, 0, 0].real, uu, rtol=1e-9)
    np.testing.assert_allclose(S[:, 1, 1].real, mlab.psd(y, **options)[0], rtol=1e-9)
    expected = mlab.csd(u, y, **options)[0]
    np.testing.assert_allclose(S[:, 0, 1], expected, atol=1e-9 * np.abs(expected).max())


def test_the_response_of_a_known_filter(record):
    s = segment_transforms(np.stack(record), 0.02, 256)
    S = s.density
    inner = slice(4, -4)
    expected = 2.0 - 0.7 * np.exp(-1j * s.omega * 0.02)
    np.testing.assert_allclose((S[:, 0, 1] / S[:, 0, 0])[inner], expected[inner], atol=0.1)
