"""Spectra of records by Welch's method, as the report and the identification use them."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float

# numpy's FFT alone: scipy.signal has csd and welch, but one function of it imports all of it, which
# takes a second of every report, and the partial coherence needs the segments, not their averages.


class Spectra(NamedTuple):
    """One-sided spectral densities of two signals, each (k,)."""

    omega: np.ndarray
    """[rad/s]"""
    uu: np.ndarray
    yy: np.ndarray
    uy: np.ndarray
    """complex: conj(U) Y, so that uy / uu estimates the response from u to y"""


def spectra(
    u: Float[np.ndarray, " N"], y: Float[np.ndarray, " N"], dt: float, length: int
) -> Spectra:
    """Averages over half-overlapping segments, each less its straight line, in a Hann window.

    Args:
        u: the input (N,).
        y: the output (N,).
        dt: time between samples [s].
        length: samples of a segment, at most N.

    Source: Welch (1967), IEEE Trans. Audio and Electroacoustics 15(2).
    """
    omega, transforms = segment_transforms(np.stack([u, y]), dt, length)
    U, Y = np.moveaxis(transforms, -1, 0)
    # A density over frequency in Hz; the window takes some of the power away.
    density = np.full(omega.size, 2.0 * dt / np.sum(np.hanning(length) ** 2))
    # Zero frequency and Nyquist's, which an odd length has not, have no twin of negative frequency.
    density[0] /= 2.0
    if length % 2 == 0:
        density[-1] /= 2.0
    uu, yy, uy = (np.mean(np.conj(a) * b, axis=1) for a, b in ((U, U), (Y, Y), (U, Y)))
    return Spectra(omega, density * uu.real, density * yy.real, density * uy)


def segment_transforms(
    signals: Float[np.ndarray, "channels N"], dt: float, length: int
) -> tuple[Float[np.ndarray, " k"], Complex[np.ndarray, "k segments channels"]]:
    """Fourier transforms of half-overlapping segments, each less its straight line, in a Hann
    window, at k = length // 2 + 1 frequencies [rad/s] from zero on.

    Args:
        signals: (channels, N), sampled together.
        dt: time between samples [s].
        length: samples of a segment, at most N.
    """
    # The next segment begins where the second half of this one does.
    step = length - length // 2
    segments = 1 + (signals.shape[1] - length) // step
    at = np.arange(segments)[:, None] * step + np.arange(length)
    # numpy's window is symmetric, SciPy's by default periodic; responses and coherences share it.
    windowed = _detrended(signals[:, at]) * np.hanning(length)
    omega = 2.0 * np.pi * np.fft.rfftfreq(length, dt)
    return omega, np.moveaxis(np.fft.rfft(windowed, axis=-1), -1, 0).swapaxes(1, 2)


def _detrended(segments: Float[np.ndarray, "... n"]) -> Float[np.ndarray, "... n"]:
    """Segments less the straight line that fits each best: a drift would leak into the lowest
    frequencies."""
    # Symmetric about zero, so that slope and mean are found apart from each other.
    t = np.linspace(-1.0, 1.0, segments.shape[-1])
    slopes = (segments @ t / (t @ t))[..., None]
    return segments - segments.mean(axis=-1, keepdims=True) - slopes * t
