"""Spectra of records by Welch's method, as the report and the identification use them."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float

# numpy's FFT alone: scipy.signal has csd and welch, but one function of it imports all of it, which
# takes a second of every report, and the partial coherence needs the segments, not their averages.


_ROUNDING = 1e-20
"""of a signal's power: less is what rounding leaves where others explain all of it"""
OWN = 10.0
"""times what the window's sidelobes bring, from which on a spectrum is the signal's own"""


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


def partial_coherence(others: np.ndarray, u: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Coherence (k,) of u and y where what the other inputs explain of both is taken out.

    NaN where nothing is left of either. All are Fourier transforms of segments at k frequencies.

    Args:
        others: (k, segments, inputs); with no inputs the result is the ordinary coherence.
        u: (k, segments)
        y: (k, segments)

    Source: Bendat and Piersol, Random Data (2010), chapter 7.
    """
    # A coherence with the other inputs left in would count theirs as noise, and as u's own where
    # the pilot moves two sticks together.
    # A coherence has no size, and the squares of a simulation that diverged have none in numbers.
    u, y = u / size_of(u), y / size_of(y)
    left_u, left_y = without(others, u), without(others, y)
    uu, yy = np.sum(np.abs(left_u) ** 2, axis=1), np.sum(np.abs(left_y) ** 2, axis=1)
    uy = np.abs(np.sum(np.conj(left_u) * left_y, axis=1)) ** 2
    enough = uu > _ROUNDING * np.sum(np.abs(u) ** 2, axis=1)
    enough &= yy > _ROUNDING * np.sum(np.abs(y) ** 2, axis=1)
    return np.where(enough, uy / np.where(enough, uu * yy, 1.0), np.nan)


def size_of(x: np.ndarray) -> float:
    """The largest number, by which what hangs on no unit may be divided; 1 where there is none."""
    size = float(np.max(np.abs(x), initial=0.0))
    return size if size > 0 and np.isfinite(size) else 1.0


def without(others: np.ndarray, x: np.ndarray) -> np.ndarray:
    """x (k, segments) less its projection on the others (k, segments, inputs)."""
    if not others.shape[2]:
        return x
    # The pseudoinverse: two sticks that move as one have no unique gains, but a projection.
    gains = np.linalg.pinv(others) @ x[:, :, None]
    return x - (others @ gains)[:, :, 0]


def leakage(S: np.ndarray) -> np.ndarray:
    """What the Hann window's sidelobes bring to each frequency from all others, (k,).

    Args:
        S: spectral density (k,) of segments in a Hann window.

    Source: Harris (1978), Proceedings of the IEEE 66(1): the window's transform m lines away is at
    most 1/(pi m (m^2 - 1)) of its height.
    """
    m = np.arange(S.size, dtype=float)
    sidelobes = np.zeros(S.size)
    # Up to two lines away is the main lobe: there a signal is itself.
    far = m > 2
    # Its square, and of that the mean of a squared sine: where between two lines a frequency lies
    # is as good as random.
    sidelobes[far] = 0.5 / (np.pi * m[far] * (m[far] ** 2 - 1.0)) ** 2
    both = np.concatenate([sidelobes[:0:-1], sidelobes])
    return np.convolve(S, both)[S.size - 1 : 2 * S.size - 1]
