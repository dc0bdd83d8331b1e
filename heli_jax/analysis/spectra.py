"""Spectra of records by Welch's method, as the report and the identification use them."""

from typing import NamedTuple

import numpy as np


class Spectra(NamedTuple):
    """One-sided spectral densities of two signals, each (k,)."""

    omega: np.ndarray
    """[rad/s]"""
    uu: np.ndarray
    yy: np.ndarray
    uy: np.ndarray
    """complex: conj(U) Y, so that uy / uu estimates the response from u to y"""


def spectra(u: np.ndarray, y: np.ndarray, dt: float, length: int) -> Spectra:
    """Averages over half-overlapping segments, each less its straight line, in a Hann window.

    Args:
        u: the input (N,).
        y: the output (N,).
        dt: time between samples [s].
        length: samples of a segment, at most N.

    Source: Welch (1967), IEEE Trans. Audio and Electroacoustics 15(2).
    """
    from scipy import signal  # not at the start: commands without spectra need none of it

    # The symmetric window, not SciPy's periodic one: the coherences of `report.coherence` have it.
    options = {
        "fs": 1.0 / dt,
        "window": np.hanning(length),
        "nperseg": length,
        "noverlap": length // 2,
        "detrend": "linear",
    }
    f, uu = signal.welch(u, **options)
    _, yy = signal.welch(y, **options)
    _, uy = signal.csd(u, y, **options)
    return Spectra(2.0 * np.pi * f, uu, yy, uy)
