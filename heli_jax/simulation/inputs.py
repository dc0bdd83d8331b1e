"""Library of excitations: each function returns (N,) samples with a largest deflection of 1.

Sources: Schroeder (1970) and Guillaume and others (1991) for multisines of low crest factor; Klein
and Morelli (2006) for orthogonal multisines; Tischler and Remple (2012) for frequency sweeps with
fades; Plaetschke and Schulz (1979) for multistep inputs; Golomb (1967) for shift registers.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

type Samples = Float[np.ndarray, " n"]


def random_steps(n: int, dt: float, rng: np.random.Generator, hold: tuple[float, float]) -> Samples:
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


DOUBLET = ((1, 1.0), (1, -1.0))
STEPS_3211 = ((3, 1.0), (2, -1.0), (1, 1.0), (1, -1.0))
"""Multistep inputs: lengths [shortest steps] and levels."""


def multistep(
    n: int,
    dt: float,
    rng: np.random.Generator,
    step: float,
    pause: float,
    pattern: Sequence[tuple[int, float]] = STEPS_3211,
) -> Samples:
    """Return a pattern of steps again and again, in random directions, with neutral pauses.

    Args:
        dt: sample time [s].
        step: length of the shortest step [s].
        pause: neutral time between two patterns [s].
        pattern: lengths [shortest steps] and levels.
    """
    # Random directions keep a vehicle without stability from drifting to one side.
    u = np.zeros(n)
    # At least one sample, since a step below the sample time would have no length.
    shortest, rest = max(1, round(step / dt)), max(1, round(pause / dt))
    k = rest
    while k < n:
        sign = rng.choice([-1.0, 1.0])
        for length, level in pattern:
            u[k : k + length * shortest] = sign * level
            k += length * shortest
        k += rest
    return u


def chirp(n: int, dt: float, low: float, high: float, fade: float = 0.0) -> Samples:
    """Return a sine whose frequency rises exponentially over the record.

    Args:
        dt: sample time [s].
        low: first frequency [Hz].
        high: last frequency [Hz].
        fade: time in which the amplitude grows at the begin and falls at the end [s]. A sweep that
            begins and ends in trim has the same spectrum as the response it excites.
    """
    # Each octave takes the same time, so the low end has a few long periods. The phase is the
    # integral of the frequency; sin(2 pi f(t) t) would exceed `high`.
    t = np.arange(n) * dt
    growth = np.log(high / low) / max(t[-1], dt)
    u = np.sin(2.0 * np.pi * low * np.expm1(growth * t) / growth)
    return u * np.clip(np.minimum(t, t[-1] - t) / fade, 0.0, 1.0) if fade else u


def ardupilot_chirp(n: int, dt: float, band: tuple[float, float], fade: float) -> Samples:
    """Return the chirp of ArduPilot's mode SYSTEMID (`chirp.cpp`, `mode_systemid.cpp`): two periods
    of the first frequency, then an exponential sweep.

    Args:
        dt: sample time [s].
        band: first and last frequency [Hz].
        fade: times of the cosine-shaped begin and end, SID_T_FADE_IN and SID_T_FADE_OUT [s].

    Raises:
        ValueError: two periods take the whole record.
    """
    t, record, (low, high) = np.arange(n) * dt, n * dt, band
    dwell = 2.0 / low
    if not dwell < record:
        raise ValueError(
            f"band: two periods of {low:g} Hz take {dwell:g} s, expected less than {record:g} s"
        )
    growth = np.log(high / low) / (record - dwell)
    periods = np.where(t < dwell, t - dwell, np.expm1(growth * np.maximum(t - dwell, 0)) / growth)
    share = np.clip(np.minimum(t, record - t) / fade, 0.0, 1.0) if fade else (t > 0).astype(float)
    return np.sin(2.0 * np.pi * low * periods) * (0.5 - 0.5 * np.cos(np.pi * share))


def betaflight_chirp(n: int, dt: float, band: tuple[float, float]) -> Samples:
    """Return the chirp of Betaflight's mode CHIRP without its filter (`chirp.c`): an exponential
    sweep of cosines in whole seconds, smaller below 1 Hz.

    Args:
        dt: sample time [s].
        band: first and last frequency [Hz].
    """
    t, record, (low, high) = np.arange(n) * dt, math.floor(n * dt + 1e-9), band
    growth = np.log(high / low) / max(record, dt)
    frequency = low * np.exp(growth * t)
    u = np.minimum(frequency, 1.0) * np.cos(2.0 * np.pi * (frequency - low) / growth)
    return np.where(t < record, u, 0.0)


def prbs(n: int, dt: float, rng: np.random.Generator, step: float) -> Samples:
    """Return a pseudo-random binary sequence of maximum length, from a random place in it.

    Its spectrum is flat up to about 0.4 / step.

    Args:
        dt: sample time [s].
        step: shortest time at a level [s].
    """
    from scipy.signal import max_len_seq

    length = max(1, round(step / dt))
    count = -(-n // length)
    bits = max(5, count.bit_length())
    register = rng.integers(0, 2, bits)
    register[0] |= not register.any()
    levels = 1.0 - 2.0 * max_len_seq(bits, register, count)[0]
    return np.repeat(levels, length)[:n]


def multisine(
    n: int, dt: float, band: tuple[float, float], place: tuple[int, int] = (0, 1)
) -> Samples:
    """Return sines of equal amplitude at harmonics of the record, with a low crest factor.

    Inputs that are excited together take turns in the harmonics, so they are orthogonal over the
    record.

    Args:
        dt: sample time [s].
        band: lowest and highest frequency [Hz].
        place: place of this input among those that are excited together, and their number.

    Raises:
        ValueError: the band has no harmonic for this input.
    """
    own, number = place
    first = max(1, int(np.ceil(band[0] * n * dt)))
    last = min(int(band[1] * n * dt), (n - 1) // 2)
    lines = np.arange(first + own, last + 1, number)
    if not lines.size:
        raise ValueError(
            f"band: {band[0]:g} to {band[1]:g} Hz has no line for {number} inputs in "
            f"{n * dt:g} s, expected a wider band or a longer record"
        )
    spectrum = np.zeros(n // 2 + 1, complex)
    spectrum[lines] = np.exp(1j * least_crest(lines))
    u = np.fft.irfft(spectrum, n)
    return u / np.max(np.abs(u))


_POWERS, _STEPS = (4, 16, 64, 256), 40
_FINE = 16
"""Points in a period of the highest line."""


def least_crest(lines: np.ndarray) -> Float[np.ndarray, " k"]:
    """Return phases (k,) [rad] of sines of equal amplitude with a low crest factor.

    The norms of growing power approach the largest value. Each begins where the last one ended
    (Guillaume and others, 1991).

    Args:
        lines: harmonics (k,) of the sines.
    """
    from scipy.optimize import minimize

    size = _FINE * int(lines[-1])

    def norm(phases: np.ndarray, power: int) -> tuple[float, np.ndarray]:
        """Return the norm of the wave and its derivatives by the phases."""
        spectrum = np.zeros(size // 2 + 1, complex)
        spectrum[lines] = 0.5 * size * np.exp(1j * phases)
        u = np.fft.irfft(spectrum, size)
        top = np.max(np.abs(u))
        mean = np.mean((u / top) ** power)
        by_wave = np.fft.rfft((u / top) ** (power - 1))[lines] / size
        slopes = -np.imag(np.exp(1j * phases) * np.conj(by_wave))
        return top * mean ** (1.0 / power), mean ** (1.0 / power - 1.0) * slopes

    # Schroeder's phases are good for lines beside each other.
    k = np.arange(lines.size)
    phases, steps = -np.pi * k**2 / k.size, {"maxiter": _STEPS}
    for power in _POWERS:
        found = minimize(norm, phases, args=(power,), method="L-BFGS-B", jac=True, options=steps)
        phases = found.x
    return phases


class Kind(NamedTuple):
    """One excitation of the library."""

    name: str
    make: Callable[..., Samples]
    """Samples of a number, a sample time [s], a generator and the settings."""
    settings: tuple[str, ...] = ()
    """Keywords of `make`: keys of `simulate.inputs`, and the place as in `multisine`."""
    smooth: bool = False
    """True for sines; a limited rate lowers their amplitude, but turns steps into ramps."""


KINDS = (
    Kind("random-steps", random_steps, ("hold",)),
    Kind("doublet", partial(multistep, pattern=DOUBLET), ("step", "pause")),
    Kind("3-2-1-1", multistep, ("step", "pause")),
    Kind("prbs", prbs, ("step",)),
    Kind(
        "chirp",
        lambda n, dt, _, band, fade: chirp(n, dt, band[0], band[1], fade),
        ("band", "fade"),
        smooth=True,
    ),
    Kind(
        "ardupilot-chirp",
        lambda n, dt, _, **of: ardupilot_chirp(n, dt, **of),
        ("band", "fade"),
        smooth=True,
    ),
    Kind(
        "betaflight-chirp",
        lambda n, dt, _, band: betaflight_chirp(n, dt, band),
        ("band",),
        smooth=True,
    ),
    Kind(
        "multisine", lambda n, dt, _, **of: multisine(n, dt, **of), ("band", "place"), smooth=True
    ),
    Kind("neutral", lambda n, dt, _: np.zeros(n)),
)
"""All excitations of `simulate`, configurations and designs. To add one: a function and its
entry."""


def excitation(
    kind: str,
    n: int,
    dt: float,
    rng: np.random.Generator,
    settings: Mapping[str, Any],
    *,
    amplitude: float = 1.0,
    rate: float = np.inf,
) -> Samples:
    """Return an excitation within limits.

    Args:
        kind: name in `KINDS`.
        n: number of samples.
        dt: sample time [s].
        settings: those of the kind; others are ignored.
        amplitude: largest deflection.
        rate: largest rate of change [deflection/s].

    Raises:
        ValueError: a band without a line.
    """
    [found] = [k for k in KINDS if k.name == kind]
    u = amplitude * found.make(n, dt, rng, **{k: settings[k] for k in found.settings})
    fastest = float(np.max(np.abs(np.diff(u)), initial=0.0)) / dt
    if fastest <= rate:
        return u
    return u * (rate / fastest) if found.smooth else slewed(u, rate * dt)


def slewed(u: Samples, most: float) -> Samples:
    """Return steps (N,) as ramps of at most `most` in a sample."""
    at, out = float(u[0]), np.empty(u.size)
    for k, x in enumerate(u.tolist()):
        at = min(max(x, at - most), at + most)
        out[k] = at
    return out
