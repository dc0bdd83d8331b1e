"""Noise of a signal from its samples: size and whiteness."""

import numpy as np

_FEW_DIFFERENCES = 0.2
"""Third differences per sample below which they are computed across gaps."""
_WHITE, _INTEGRATED = -0.75, -2.0 / 3.0
"""Lag-one autocorrelation of third differences of white noise, and of integrated white noise."""
_SPREAD = 0.45
"""Standard deviation of the first one times the square root of the number of samples (Bartlett's
formula).
"""
_POWER_SPREAD = 2.15
"""Standard deviation of the log mean square of third differences, times the square root of the
number of samples: the root of twice the sum of squared autocorrelations.
"""
_FEWEST = 400
"""Fewest third differences that distinguish the two."""
_REPEATED = 0.3
"""Share of repeated samples from which the sensor is slower than the grid."""
_NO_NOISE = 1e-4
"""Noise level below which there is no sensor noise [fraction of the signal's sd]."""


def noise_guess(signal: np.ndarray) -> float:
    """Return the sd of white noise on a smooth signal, from third differences; NaN is skipped.

    Third differences of white noise have variance 20 sd^2, and those of a smooth signal almost
    vanish. The median of absolute values makes it robust against corners of a response.
    """
    # Only differences across a gap become NaN, so no sample has to be filled in.
    d, at = _third_differences(signal, 1), np.flatnonzero(np.isfinite(signal))
    d, signal = d[np.isfinite(d)], signal[at]
    # If gaps leave few consecutive samples, as for a slow sensor on a fast grid, use differences
    # between known samples.
    if d.size < _FEW_DIFFERENCES * signal.size:
        d = _divided_differences(at.astype(float), signal)
    # With three samples or fewer, the signal itself bounds its noise.
    if not d.size:
        d = signal - np.median(signal)
    guess = robust_sd(d)
    # A record without noise would lead to division by zero.
    floor = 1e-9 * float(np.sqrt(np.mean(signal**2)))
    return max(guess, floor, 1e-300)


def white_part(signal: np.ndarray) -> float:
    """Return a signal's white-noise sd: the smaller of the levels at both ends of its spectrum.

    Args:
        signal: (N,), NaN where nothing is measured.
    """
    # Third differences see only high frequencies, where an oscillation near the Nyquist frequency
    # looks like noise. Alternating signs exchange the ends of the spectrum.
    turned = signal * np.where(np.arange(signal.size) % 2, -1.0, 1.0)
    return min(noise_guess(signal), noise_guess(turned))


def _divided_differences(at: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return third divided differences (N - 3,) of samples (N,) at any times.

    They are scaled so that white noise keeps its variance; those of a parabola vanish.
    """
    if y.size < 4:
        return np.zeros(0)
    t, y = (np.lib.stride_tricks.sliding_window_view(x, 4) for x in (at, y))
    apart = t[:, :, None] - t[:, None, :] + np.eye(4)
    weights = 1.0 / np.prod(apart, axis=2)
    return np.sum(weights * y, axis=1) / np.linalg.norm(weights, axis=1)


def has_coloured_noise(signal: np.ndarray) -> bool:
    """True if a signal's high frequencies are not white noise, as for an angle integrated from a
    rate.

    Third differences have a lag-one autocorrelation of -3/4 for white noise and -2/3 for integrated
    white noise; smoothed signals have more. Too few samples give False.

    Args:
        signal: (N,), NaN where nothing is measured. Only the first of repeated values counts, as
            from a slower sensor.
    """
    known = signal[np.isfinite(signal)]
    repeated = np.diff(known) == 0.0
    # Only differences across a gap become NaN. For a sensor slower than the grid, use differences
    # between its own samples.
    if known.size > 1 and np.mean(repeated) > _REPEATED:
        signal = known[np.r_[True, ~repeated]]
    elif known.size < 0.5 * signal.size:
        signal = known
    d = _third_differences(signal, 1)
    pairs = np.isfinite(d[1:]) & np.isfinite(d[:-1])
    if np.sum(pairs) < _FEWEST:
        return False
    # Clip, so that corners of the motion do not outweigh the noise.
    d = _without_corners(d, noise_guess(signal))
    first, second = d[:-1][pairs], d[1:][pairs]
    square = 0.5 * float(np.sum(first**2) + np.sum(second**2))
    related = float(np.sum(first * second)) / square if square else _WHITE
    return related > max(0.5 * (_WHITE + _INTEGRATED), _WHITE + 3.0 * _SPREAD / first.size**0.5)


def rises_when_slower(signal: np.ndarray, every: int) -> bool:
    """True if a signal has more noise at a lower rate than at its own, as after a low-pass.

    White noise has equal third differences of every n-th sample and of neighbours.

    Args:
        signal: (N,), NaN where nothing is measured.
        every: sample distance at the lower rate, at least 2.
    """
    differences = (_third_differences(signal, 1), _third_differences(signal, every))
    fast, slow = (d[np.isfinite(d)] for d in differences)
    if min(fast.size, slow.size) < _FEWEST:
        return False
    powers = [float(np.mean(_without_corners(d, robust_sd(d)) ** 2)) for d in (fast, slow)]
    spread = _POWER_SPREAD * np.sqrt(1.0 / fast.size + 1.0 / slow.size)
    return bool(powers[1] > powers[0] * np.exp(3.0 * spread))


def _third_differences(signal: np.ndarray, every: int) -> np.ndarray:
    """Return third differences at a distance of `every` samples; NaN if a sample is missing.

    White noise keeps its sd.
    """
    y = signal
    for _ in range(3):
        y = y[every:] - y[:-every]
    return y / np.sqrt(20.0)  # 1 + 9 + 9 + 1


def robust_sd(d: np.ndarray) -> float:
    """Return the sd of normal numbers from the median of their sizes, 0.674 sd (robust)."""
    return float(np.median(np.abs(d)) / 0.6744897501960817)


def _without_corners(d: np.ndarray, sd: float) -> np.ndarray:
    """Clip differences at four times their sd."""
    return np.clip(d, -4.0 * sd, 4.0 * sd)


def without_noise(signal: np.ndarray) -> bool:
    """True if a signal has no sensor noise: it was smoothed, or simulated.

    Args:
        signal: (N,), NaN where nothing is measured.
    """
    known = signal[np.isfinite(signal)]
    return known.size >= _FEWEST and bool(noise_guess(known) < _NO_NOISE * np.std(known))


"""Noise level below which there is no sensor noise [fraction of the signal's sd]."""
