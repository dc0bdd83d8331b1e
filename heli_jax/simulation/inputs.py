"""Stick inputs to excite a vehicle with; each function gives (N,) samples of unit amplitude."""

import numpy as np


def random_steps(
    n: int, dt: float, rng: np.random.Generator, hold: tuple[float, float]
) -> np.ndarray:
    """Pilot-like steps: levels uniform in [-1, 1], each held for a uniform time in `hold` [s].

    Args:
        dt: [s].
        hold: the shortest and the longest time [s].
    """
    # Uneven times, since steps at a fixed interval leave gaps in the spectrum.
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
    """3-2-1-1 steps, in either direction, with neutral between.

    Args:
        dt: [s].
        unit: length of the shortest step [s].
        pause: of neutral between two of them [s].
    """
    # In either direction, so that a vehicle without stability does not wander off to one side.
    u = np.zeros(n)
    # Whole samples, one at least: a unit below the sample time would leave steps of no length.
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
    """A sine whose frequency rises exponentially over the record.

    Args:
        dt: [s].
        low: first frequency [Hz].
        high: last frequency [Hz].
    """
    # Exponentially: each octave gets the same time, and so the low end its few long periods. The
    # phase is the integral of the frequency; sin(2 pi f(t) t) would run past `high`.
    t = np.arange(n) * dt
    growth = np.log(high / low) / max(t[-1], dt)
    return np.sin(2.0 * np.pi * low * np.expm1(growth * t) / growth)
