"""Stick inputs for excitation; each function returns (N,) samples of unit amplitude."""

import numpy as np


def random_steps(
    n: int, dt: float, rng: np.random.Generator, hold: tuple[float, float]
) -> np.ndarray:
    """Return pilot-like steps: levels uniform in [-1, 1], each held for a uniform time in `hold`
    [s].

    Args:
        dt: sample time [s].
        hold: shortest and longest time [s].
    """
    # Random times, since steps at a fixed interval leave gaps in the spectrum.
    u = np.empty(n)
    k = 0
    while k < n:
        length = max(1, round(rng.uniform(*hold) / dt))
        u[k : k + length] = rng.uniform(-1.0, 1.0)
        k += length
    return u


def multistep_3211(
    n: int, dt: float, rng: np.random.Generator, unit: float, pause: float
) -> np.ndarray:
    """Return 3-2-1-1 steps in random directions, with neutral pauses.

    Args:
        dt: sample time [s].
        unit: length of the shortest step [s].
        pause: neutral time between two of them [s].
    """
    # Random directions keep a vehicle without stability from drifting to one side.
    u = np.zeros(n)
    # At least one sample, since a unit below the sample time would give steps of zero length.
    step, rest = max(1, round(unit / dt)), max(1, round(pause / dt))
    k = rest
    while k < n:
        sign = rng.choice([-1.0, 1.0])
        for length, level in ((3, 1.0), (2, -1.0), (1, 1.0), (1, -1.0)):
            u[k : k + length * step] = sign * level
            k += length * step
        k += rest
    return u


def chirp(n: int, dt: float, low: float, high: float) -> np.ndarray:
    """Return a sine whose frequency rises exponentially over the record.

    Args:
        dt: sample time [s].
        low: first frequency [Hz].
        high: last frequency [Hz].
    """
    # Each octave takes the same time, so the low end has a few long periods. The phase is the
    # integral of the frequency; sin(2 pi f(t) t) would exceed `high`.
    t = np.arange(n) * dt
    growth = np.log(high / low) / max(t[-1], dt)
    return np.sin(2.0 * np.pi * low * np.expm1(growth * t) / growth)
