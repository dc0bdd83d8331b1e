"""Spectra of signals in Hann windows, and flights in such windows.

Segments of a record in Hann windows are transformed to the requested frequencies (any band, any
resolution). Cross-spectra are means over segments and flights.

Sources: Bendat and Piersol, Random Data (2010), chapters 7 and 9; Welch (1967), IEEE Trans. Audio
and Electroacoustics 15(2); Harris (1978), Proceedings of the IEEE 66(1).
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from heli_jax.flights.flight import Flight

OWN = 10.0
"""Least ratio to the window's sidelobes at which a spectrum is the signal's own."""
OVERLAP = 2.0 / 3.0
"""Overlap of consecutive Hann windows [fraction of the length].

The squared windows add up to a constant, so all samples have the same weight except at the ends of
a record. Errors from responses cut off at a window's ends are proportional to the slope of the
square, and cancel. With half overlap they do not.
"""
LONGEST = 30.0
"""Longest default window [s], as is usual for rotorcraft responses."""
HIGHEST = 0.4
"""Highest frequency [fraction of the rate]. Above it an anti-aliasing filter changes the record."""
COHERENT = 0.6
"""Least mean coherence over an octave of a usable response: Tischler and Remple, Aircraft and
Rotorcraft System Identification (2012).
"""
_SMOOTHED = 3.4
"""Least number of independent lines over which the noise spectrum is smoothed."""
_SHARED = (
    1.0 / 3.0 + 3.0**0.5 / (4.0 * np.pi),
    1.0 / 6.0 - 3.0**0.5 / (4.0 * np.pi),
)
"""Correlation of white noise in a Hann window with that in the next window and the one after it."""
_FOR_MATRIX = 4.0
"""Averages for each output at which the inverse of a spectral matrix has about the right size."""
STEPS = round(1.0 / (1.0 - OVERLAP))
"""Window starts within one window length. With an overlap of a half, kappa of the disturbed bench
is 4 % less precise.
"""
PER_AVERAGE = 1.0 + 2.0 * sum(r**2 for r in _SHARED)
"""Windows for one independent average: the sum of the squared correlations of transforms of white
noise in one window with those in all others.
"""


class Spectra(NamedTuple):
    """Fourier transforms of c signals in W Hann windows at k frequencies."""

    omega: np.ndarray
    """Frequencies (k,) [rad/s]."""
    X: np.ndarray
    """Transforms (k, W, c), scaled so that squares are one-sided densities per Hz."""
    averages: float
    """Number of independent averages, smaller than the number of overlapping windows."""
    seconds: float
    """Length of a window [s]."""
    steep: np.ndarray | None = None
    """Transforms (k, W, m) of the first m signals with the window's derivative [1/s]."""

    @property
    def density(self) -> Complex[np.ndarray, "k c c"]:
        """Means of conj(X_a) X_b; the response from a to b is [a, b] / [a, a]."""
        return np.conj(np.swapaxes(self.X, 1, 2)) @ self.X / self.X.shape[1]


def octave_mean(
    omega: Float[np.ndarray, " k"], coherence: Float[np.ndarray, " k"]
) -> Float[np.ndarray, " k"]:
    """Return the mean coherence (k,) over an octave; zero where there is none.

    A single frequency that reaches a limit by chance also has too large a gain.
    """
    octaves = np.log2(omega)
    near = np.abs(octaves[:, None] - octaves[None, :]) <= 0.5
    seen = np.isfinite(coherence)
    count = near @ seen.astype(float)
    mean = near @ np.where(seen, coherence, 0.0) / np.maximum(count, 1.0)
    return np.where(seen, mean, 0.0)


def leakage(S: np.ndarray) -> np.ndarray:
    """Return the power (k,) that the Hann window's sidelobes add to each frequency from all others.

    Args:
        S: spectral density (k,) of segments in a Hann window.

    Source: Harris (1978), Proceedings of the IEEE 66(1). At m lines, the window's transform is at
    most 1/(pi m (m^2 - 1)) of its peak.
    """
    m = np.arange(S.size, dtype=float)
    sidelobes = np.zeros(S.size)
    # The main lobe reaches two lines away.
    far = m > 2
    # Squared sidelobe times the mean of a squared sine, since the position of a frequency between
    # two lines is arbitrary.
    sidelobes[far] = 0.5 / (np.pi * m[far] * (m[far] ** 2 - 1.0)) ** 2
    both = np.concatenate([sidelobes[:0:-1], sidelobes])
    return np.convolve(S, both)[S.size - 1 : 2 * S.size - 1]


def is_own(S: np.ndarray) -> np.ndarray:
    """True (k,) where a density is the signal's own and not from sidelobes."""
    return OWN * leakage(S) < S


def cross_spectra(
    records: Sequence[Float[np.ndarray, "c N"]],
    dt: float,
    omega: Float[np.ndarray, " k"],
    seconds: float,
    overlap: float = 0.5,
    sloped: int = 0,
) -> Spectra:
    """Transform all records in Hann windows, each segment without its mean, to any frequencies.

    Args:
        records: the same c signals in each, (c, N) with any N, without missing samples.
        dt: time between samples [s].
        omega: (k,) [rad/s], above zero and below the Nyquist frequency.
        seconds: length of a segment [s]; shorter records are left out.
        overlap: overlap of consecutive segments, from 0 to below 1.
        sloped: number of first signals that are also transformed with the window's derivative.

    Raises:
        ValueError: no record has a segment, a sample is missing, or a frequency is out of range.
    """
    length = round(seconds / dt)
    step = max(round(length * (1.0 - overlap)), 1)
    _require(records, dt, omega, length)
    window, t = hann(length), np.arange(length)
    # Derivative of the cosine window [1/s].
    slope = np.pi / (length * dt) * np.sin(2.0 * np.pi * t / length)
    turns = np.exp(-1j * np.outer(t, omega * dt)) * np.sqrt(2.0 * dt / np.sum(window**2))

    def transforms(record: Float[np.ndarray, "c N"], window: np.ndarray) -> np.ndarray:
        segments = np.lib.stride_tricks.sliding_window_view(record, length, axis=1)[:, ::step]
        kernel = window[:, None] * turns
        # Removing the kernel's mean equals removing each segment's. Two real products take fewer
        # operations.
        kernel = kernel - kernel.mean(axis=0)
        rows = segments.reshape(-1, length)
        X = rows @ kernel.real + 1j * (rows @ kernel.imag)
        return X.reshape(*segments.shape[:2], -1).transpose(2, 1, 0)

    long = [np.asarray(r, np.float64) for r in records if r.shape[1] >= length]
    # Remove most of the mean first, since rounding would leave part of it in each segment.
    long = [r - r.mean(axis=1, keepdims=True) for r in long]
    X = np.concatenate([transforms(r, window) for r in long], axis=1)
    steep = None
    if sloped:
        steep = np.concatenate([transforms(r[:sloped], slope) for r in long], axis=1)
    averages = sum(_independent(window, step, 1 + (r.shape[1] - length) // step) for r in long)
    return Spectra(np.asarray(omega), X, averages, length * dt, steep)


def _require(records: Sequence[np.ndarray], dt: float, omega: np.ndarray, length: int) -> None:
    longest = max((r.shape[1] for r in records), default=0)
    if length < 8 or longest < length:
        raise ValueError(
            f"seconds: expected a segment of 8 samples at least and no longer than the longest "
            f"record, {longest * dt:.6g} s; got {length * dt:.6g} s"
        )
    if not all(np.isfinite(r).all() for r in records):
        raise ValueError("records: expected no missing sample; cut them where one is missing")
    if not (np.all(omega > 0) and np.all(omega < np.pi / dt)):
        raise ValueError(
            f"omega: expected frequencies between 0 and the Nyquist frequency, "
            f"{np.pi / dt:.6g} rad/s; got {np.min(omega):.6g} to {np.max(omega):.6g} rad/s"
        )


def _independent(window: np.ndarray, step: int, count: int) -> float:
    """Return the number of independent averages of overlapping segments (Welch 1967, flat
    spectrum).
    """
    # For white noise, the transforms of two segments correlate as the windows overlap. Their
    # squares, which form spectra, correlate as the square of that.
    n, power, total = window.size, float(np.sum(window**2)), 1.0
    for j in range(1, min(count, -(-n // step))):
        shared = float(np.sum(window[: n - j * step] * window[j * step :])) / power
        total += 2.0 * (1.0 - j / count) * shared**2
    return count / total


# Flights in windows that overlap by two thirds, each without its mean, at the window's lines.


class PairOptions(NamedTuple):
    """One selected response."""

    input: str
    output: str
    band: tuple[float, float] | None = None
    """First and last frequency [Hz]; None: that of all responses."""
    coherence: float | None = None
    """Least partial coherence; None: that of all responses."""


class ResponseOptions(NamedTuple):
    """Frequencies, windows and selected responses."""

    band: tuple[float, float] | None = None
    """First and last frequency [Hz]; None: from a period in a window to 0.4 of the rate."""
    window: float | None = None
    """Length [s]; None: a fifth of the longest flight, at most 30 s."""
    points: int | None = None
    """Number of frequencies, about equally spaced in the logarithm; None: all lines of the window.
    """
    coherence: float = 0.0
    """Least mean partial coherence over an octave; 0 uses all frequencies, with their weights."""
    pairs: tuple[PairOptions, ...] = ()
    """Selected responses; empty: all."""


class Choice(NamedTuple):
    """Windows of the flights, and the signals that move in them."""

    dt: float
    """Sample time [s]."""
    window: float
    """Length of a window [s]."""
    inputs: tuple[str, ...]
    """Inputs that move."""


def chosen(flights: Sequence[Flight], window: float | None) -> Choice:
    """Return the windows for the responses of some flights.

    Args:
        window: length [s]; None: a fifth of the longest flight, at most 30 s.

    Raises:
        ValueError: rates differ, no flight holds a window, or no input moves.
    """
    rates = sorted({round(1.0 / f.dt, 6) for f in flights})
    if len(rates) > 1:
        listed = ", ".join(f"{r:g}" for r in rates)
        raise ValueError(f"expected flights of one rate, got {listed} Hz; set flights[].rate")
    dt = float(flights[0].dt)
    longest = max(f.duration for f in flights) + dt
    window = window or min(longest / 5.0, LONGEST)
    if window > longest * (1.0 + 1e-9):
        raise ValueError(
            f"window: the longest flight is {longest:.4g} s, too short for a window of "
            f"{window:g} s; expected at most a fifth of it, {longest / 5.0:.3g} s, for an average"
        )
    inputs = tuple(n for n in flights[0].inputs if any(np.ptp(f.inputs[n]) > 0 for f in flights))
    if not inputs:
        raise ValueError(
            "no input moves, so that there is no response; fit a free decay by output-error or "
            "frequency-error"
        )
    return Choice(dt, window, inputs)


class Windowed(NamedTuple):
    """Flights of one rate in W windows at k lines; transforms are scaled to densities per Hz."""

    inputs: tuple[str, ...]
    """The m inputs that move."""
    instruments: tuple[str, ...]
    """Inputs that use a logged excitation."""
    outputs: tuple[str, ...]
    """The p outputs with complete windows."""
    dt: float
    """Sample time [s]."""
    length: int
    """Length of a window [samples]."""
    numbers: tuple[int, ...]
    """Numbers of the k lines [periods in a window]."""
    starts: tuple[tuple[int, ...], ...]
    """First sample of each window in which no output lacks a sample, by flight."""
    Z: np.ndarray
    """Transforms (W, k, m) of the instruments, or of the inputs themselves."""
    U: np.ndarray
    """Transforms (W, k, m) of the inputs."""
    Y: np.ndarray
    """Transforms (W, k, p) of the outputs."""
    left_out: dict[str, str]
    """Reasons why outputs are left out, by output."""

    @property
    def lines(self) -> np.ndarray:
        """Numbers (k,) of the lines."""
        return np.asarray(self.numbers)

    @property
    def hz(self) -> np.ndarray:
        """Frequencies (k,) [Hz]."""
        return self.lines / (self.length * self.dt)

    @property
    def seconds(self) -> float:
        """Length of a window [s]."""
        return self.length * self.dt

    @property
    def step(self) -> int:
        """Distance between the starts of consecutive windows [samples]."""
        return _step(self.length)

    def pairs(self, steps: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the indices of windows that are `steps` steps apart in one flight."""
        at = np.concatenate(
            [[(i, s // self.step) for s in v] for i, v in enumerate(self.starts) if v]
        )
        first, second = np.nonzero(
            (at[:, None, 0] == at[None, :, 0]) & (at[:, None, 1] + steps == at[None, :, 1])
        )
        return first, second

    @property
    def averages(self) -> float:
        """Number of independent averages."""
        return len(self.Z) / PER_AVERAGE

    @property
    def together(self) -> bool:
        """True if the windows suffice to estimate the correlation of the outputs' errors.

        The inverse of a spectral matrix from few averages is too large.
        """
        left = self.averages - len(self.inputs)
        return len(self.outputs) == 1 or bool(left * _SMOOTHED >= _FOR_MATRIX * len(self.outputs))


def window_transforms(
    x: Float[np.ndarray | Array, "c N"],
    starts: Sequence[int],
    length: int,
    lines: Sequence[int] | np.ndarray,
    dt: float,
) -> Complex[np.ndarray | Array, "c W k"]:
    """Return Fourier transforms of Hann windows, scaled to one-sided densities per Hz when squared.

    Args:
        dt: time between samples [s].
    """
    xp = jnp if isinstance(x, jax.Array) else np
    window = hann(length)
    parts = x[:, np.asarray(starts, int)[:, None] + np.arange(length)]
    # A constant appears only in the first line, which is kept.
    parts = parts - xp.mean(parts, axis=-1, keepdims=True)
    transforms = xp.fft.rfft(parts * window[None, None], axis=-1)[..., np.asarray(lines, int)]
    return transforms * float((2.0 * dt / np.sum(window**2)) ** 0.5)


def hann(length: int) -> Float[np.ndarray, " n"]:
    """Return a periodic Hann window."""
    return 0.5 - 0.5 * np.cos(2.0 * np.pi * np.arange(length) / length)


def windowed(
    flights: Sequence[Flight],
    options: ResponseOptions = ResponseOptions(),
    by: Sequence[str] | None = None,
) -> Windowed:
    """Transform flights in windows.

    Args:
        flights: flights of one rate with the same inputs; samples of outputs may be missing.
        by: inputs that use their instrument (`Flight.instruments`); default: all that have one in
            every flight.

    Raises:
        ValueError: rates differ, nothing moves, the band does not fit the window or the rate, or
            every output has too few windows without a missing sample.
    """
    dt, seconds, inputs = chosen(flights, options.window)
    # An even length makes half a window a whole number of samples.
    length = 2 * round(0.5 * seconds / dt)
    lines = _lines(options, length, dt)
    instruments = tuple(
        n for n in inputs if all(n in f.instruments for f in flights) and (by is None or n in by)
    )
    outputs, starts, left_out = _complete(flights, length, len(inputs))

    def transforms(signals: list[np.ndarray]) -> np.ndarray:
        """Return transforms (W, k, c) of signals (c, N) by flight."""
        parts = [
            window_transforms(x, s, length, lines, dt) for x, s in zip(signals, starts, strict=True)
        ]
        return np.moveaxis(np.concatenate(parts, axis=1), 0, -1)

    Z = U = transforms([np.stack([f.inputs[n] for n in inputs]) for f in flights])
    if instruments:
        kinds = [[f.instruments if n in instruments else f.inputs for n in inputs] for f in flights]
        signals = [[s[n] for n, s in zip(inputs, each, strict=True)] for each in kinds]
        Z = transforms([np.stack(s) for s in signals])
    # Zeros stand for samples outside of the windows.
    absent = [np.zeros(f.n_samples) for f in flights]
    measured = [
        np.stack([np.nan_to_num(f.outputs.get(n, none)) for n in outputs])
        for f, none in zip(flights, absent, strict=True)
    ]
    Y = transforms(measured)
    names, numbers = (inputs, instruments, outputs), tuple(lines.tolist())
    return Windowed(*names, dt, length, numbers, starts, Z, U, Y, left_out)


def _complete(
    flights: Sequence[Flight], length: int, inputs: int
) -> tuple[tuple[str, ...], tuple[tuple[int, ...], ...], dict[str, str]]:
    """Return outputs, the starts of windows in which all of them are complete, and left-out outputs
    with reasons.

    The output with the fewest complete windows is left out until enough windows remain.
    """
    kept = list(dict.fromkeys(n for f in flights for n in f.outputs))
    begins = [range(0, f.n_samples - length + 1, _step(length)) for f in flights]
    seen = {
        n: [_complete_windows(f, n, s, length) for f, s in zip(flights, begins, strict=True)]
        for n in kept
    }
    many = "1 input" if inputs == 1 else f"{inputs} inputs"
    left_out = {}
    while True:
        masks = [np.all([seen[n][i] for n in kept], axis=0) for i in range(len(flights))]
        averages = sum(int(np.sum(v)) for v in masks) / PER_AVERAGE
        if averages >= inputs + 1:
            starts = (np.asarray(s)[v] for s, v in zip(begins, masks, strict=True))
            return tuple(kept), tuple(tuple(v.tolist()) for v in starts), left_out
        worst = min(kept, key=lambda n: sum(int(np.sum(v)) for v in seen[n]))
        left_out[worst] = (
            f"expected at least {inputs + 1} independent averages for {many}, got {averages:.2g} "
            f"from windows of {length * flights[0].dt:g} s without a missing sample"
        )
        kept.remove(worst)
        if not kept:
            raise ValueError(f"{left_out[worst]}; a shorter window, or longer flights")


def _complete_windows(flight: Flight, output: str, starts: range, length: int) -> np.ndarray:
    """Return a mask of the windows that have every sample of an output."""
    if output not in flight.outputs:
        return np.zeros(len(starts), bool)
    missing = np.concatenate([[0], np.cumsum(~np.isfinite(flight.outputs[output]))])
    return np.array([missing[s + length] == missing[s] for s in starts], bool)


def _lines(options: ResponseOptions, length: int, dt: float) -> np.ndarray:
    """Return the lines of the band, or those nearest to logarithmic points."""
    if length < 16:
        raise ValueError(f"window: expected at least 16 samples, {16 * dt:.3g} s; got {length}")
    low, high = options.band or (1.0 / (length * dt), HIGHEST / dt)
    if high >= 0.5 / dt:
        raise ValueError(
            f"band: expected frequencies below half the rate of {1.0 / dt:.4g} Hz, got {high:g} Hz"
        )
    if low < 1.0 / (length * dt) * (1.0 - 1e-9):
        raise ValueError(
            f"band: expected at least one period in a window of {length * dt:g} s, from "
            f"{1.0 / (length * dt):.3g} Hz on; got {low:g} Hz"
        )
    first, last = (f * length * dt for f in (low, high))
    lines = np.arange(int(np.ceil(first - 1e-6)), int(last + 1e-6) + 1)
    if not lines.size:
        raise ValueError(
            f"band: expected one that holds a line of the window, every {1 / (length * dt):.3g} "
            f"Hz; got {low:g} to {high:g} Hz"
        )
    if options.points is None or options.points >= lines.size:
        return lines
    spaced = np.geomspace(lines[0], lines[-1], options.points)
    return lines[np.unique(np.argmin(np.abs(lines[:, None] - spaced), axis=0))]


def _step(length: int) -> int:
    # Rounded up, so that windows this many steps apart share no sample.
    return -(-length // STEPS)
