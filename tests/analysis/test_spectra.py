"""Spectra in Hann windows against matplotlib's."""

import numpy as np
import pytest
from matplotlib import mlab

from heli_jax.analysis.spectra import hann, window_transforms


@pytest.mark.parametrize("length", [64, 256])
def test_as_matplotlib_has_them(length):
    rng = np.random.default_rng(0)
    u = rng.standard_normal(4096) + 0.01 * np.arange(4096)
    y = 2.0 * u - 0.7 * np.roll(u, 1) + 0.1 * rng.standard_normal(4096)
    lines = np.arange(1, length // 2)
    starts = range(0, 4096 - length + 1, length // 2)
    U, Y = np.asarray(window_transforms(np.stack([u, y]), starts, length, lines, 0.02))
    options = {"NFFT": length, "Fs": 50.0, "noverlap": length // 2, "detrend": "mean"}
    expected = mlab.csd(u, y, window=hann(length), **options)[0][1:-1]
    crossed = np.mean(np.conj(U) * Y, axis=0)
    np.testing.assert_allclose(crossed, expected, atol=1e-9 * np.abs(expected).max())
    np.testing.assert_allclose(
        np.mean(np.abs(U) ** 2, axis=0),
        mlab.psd(u, window=hann(length), **options)[0][1:-1],
        rtol=1e-9,
    )
