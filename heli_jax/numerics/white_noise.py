"""The noise in a signal by its own samples: how much there is, and whether it is white."""

import numpy as np

_FEW_DIFFERENCES = 0.2
"""third differences of neighbours for each sample, below which they are taken across gaps"""
_WHITE, _INTEGRATED = -0.75, -2.0 / 3.0
"""autocorrelation at one sample of the third differences of white noise and of its sum"""
_SPREAD = 0.45
"""sd of the first of them times the root of the number of samples (Bartlett's formula)"""
_POWER_SPREAD = 2.15
"""sd of the logarithm of their mean square times the root of the number of samples: the root of
twice the sum of their squared autocorrelations"""
_FEWEST = 400
"""third differences that tell the two apart"""
_REPEATED = 0.3
"""share of samples equal to the one before from which on they are those of a slower sensor"""
_NO_NOISE = 1e-4
"""of a signal's sd, below which its noise is that of no sensor"""


def noise_guess(signal: np.ndarray) -> float:
    """White measurement noise sd of a smooth signal, from its third differences; NaN is skipped.

    Third differences of white noise have variance 20 sd^2; what is smooth all but vanishes in
    them. Robust against the corners of a response (median of absolute values).
    """
    # A gap makes NaN of the differences across it alone: no sample has to be filled in.
    d, at = _third_differences(signal, 1), np.flatnonzero(np.isfinite(signal))
    d, signal = d[np.isfinite(d)], signal[at]
    # Where gaps leave few samples in a row, as of a slow sensor on a fast grid, from one sample to
    # the next wherever they stand.
    if d.size < _FEW_DIFFERENCES * signal.size:
        d = _divided_differences(at.astype(float), signal)
    # Of three samples and fewer, the signal itself bounds its noise.
    if not d.size:
        d = signal - np.median(signal)
    guess = _noise_sd(d)
    # A record without noise: rows divided by zero would be infinite.
    floor = 1e-9 * float(np.sqrt(np.mean(signal**2)))
    return max(guess, floor, 1e-300)


def white_part(signal: np.ndarray) -> float:
    """The sd of the white noise in a signal: what is there at its fastest and at its slowest.

    Args:
        signal: (N,), NaN where nothing is measured.
    """
    # Third differences look at the fast end of the spectrum alone, where a swing near the Nyquist
    # frequency passes for noise. With every other sign turned the ends change places.
    turned = signal * np.where(np.arange(signal.size) % 2, -1.0, 1.0)
    return min(noise_guess(signal), noise_guess(turned))


def _divided_differences(at: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Third divided differences (N - 3,) of samples (N,) at any instants, scaled so that those of
    white noise have its variance; a parabola has none."""
    if y.size < 4:
        return np.zeros(0)
    t, y = (np.lib.stride_tricks.sliding_window_view(x, 4) for x in (at, y))
    apart = t[:, :, None] - t[:, None, :] + np.eye(4)
    weights = 1.0 / np.prod(apart, axis=2)
    return np.sum(weights * y, axis=1) / np.linalg.norm(weights, axis=1)


def wanders(signal: np.ndarray) -> bool:
    """True if a signal's fastest part is no white noise, as in an angle integrated from a rate.

    In third differences white noise has an autocorrelation of -3/4 at one sample, white noise that
    was summed once has -2/3, what was smoothed has more than that. Too few samples tell nothing.

    Args:
        signal: (N,), NaN where nothing is measured. Of values repeated as a slower sensor's are,
            the first counts.
    """
    known = signal[np.isfinite(signal)]
    repeated = np.diff(known) == 0.0
    # A gap makes NaN of the differences across it alone; a sensor slower than the grid leaves none
    # but those from one of its samples to the next.
    if known.size > 1 and np.mean(repeated) > _REPEATED:
        signal = known[np.r_[True, ~repeated]]
    elif known.size < 0.5 * signal.size:
        signal = known
    d = _third_differences(signal, 1)
    pairs = np.isfinite(d[1:]) & np.isfinite(d[:-1])
    if np.sum(pairs) < _FEWEST:
        return False
    # Corners of the motion must not outweigh the noise.
    d = _without_corners(d, noise_guess(signal))
    first, second = d[:-1][pairs], d[1:][pairs]
    square = 0.5 * float(np.sum(first**2) + np.sum(second**2))
    related = float(np.sum(first * second)) / square if square else _WHITE
    return related > max(0.5 * (_WHITE + _INTEGRATED), _WHITE + 3.0 * _SPREAD / first.size**0.5)


def rises_when_slower(signal: np.ndarray, every: int) -> bool:
    """True if a signal has more noise below a lower rate than near its own, as noise has behind a
    low-pass.

    White noise has as much in the third differences of every n-th sample as in those of neighbours.

    Args:
        signal: (N,), NaN where nothing is measured.
        every: samples from one to the next at the lower rate, at least 2.
    """
    differences = (_third_differences(signal, 1), _third_differences(signal, every))
    fast, slow = (d[np.isfinite(d)] for d in differences)
    if min(fast.size, slow.size) < _FEWEST:
        return False
    powers = [float(np.mean(_without_corners(d, _noise_sd(d)) ** 2)) for d in (fast, slow)]
    spread = _POWER_SPREAD * np.sqrt(1.0 / fast.size + 1.0 / slow.size)
    return bool(powers[1] > powers[0] * np.exp(3.0 * spread))


def _third_differences(signal: np.ndarray, every: int) -> np.ndarray:
    """Return third differences of every so-many-th sample, NaN if one is missing; white noise keeps
    its sd."""
    y = signal
    for _ in range(3):
        y = y[every:] - y[:-every]
    return y / np.sqrt(20.0)  # 1 + 9 + 9 + 1


def _noise_sd(d: np.ndarray) -> float:
    """The sd of normal numbers by the median of their sizes, 0.674 of it, which corners of the
    motion do not move."""
    return float(np.median(np.abs(d)) / 0.6744897501960817)


def _without_corners(d: np.ndarray, sd: float) -> np.ndarray:
    """Differences clipped at four times their sd."""
    return np.clip(d, -4.0 * sd, 4.0 * sd)


def without_noise(signal: np.ndarray) -> bool:
    """True if a signal has no sensor noise: it was smoothed, or simulated.

    Args:
        signal: (N,), NaN where nothing is measured.
    """
    known = signal[np.isfinite(signal)]
    return known.size >= _FEWEST and bool(noise_guess(known) < _NO_NOISE * np.std(known))
