"""Flights in Hann windows that overlap by two thirds, each less its mean, at its lines.

Sources: Welch (1967); Bendat and Piersol, Random Data (2010), chapters 7 and 9; Harris (1978).
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from heli_jax.analysis.flight_responses import one_rate, require_window
from heli_jax.analysis.response_options import ResponseOptions
from heli_jax.analysis.spectral import OVERLAP, OWN, leakage
from heli_jax.flights.flight import Flight

_LONGEST = 30.0
"""window [s] unless one is stated"""
_HIGHEST = 0.4
"""of the rate: above it an anti-aliasing filter has changed what was logged"""
_SMOOTHED = 3.4
"""independent lines at least over which the noise's spectrum is smoothed"""
_SHARED = (
    1.0 / 3.0 + 3.0**0.5 / (4.0 * np.pi),
    1.0 / 6.0 - 3.0**0.5 / (4.0 * np.pi),
)
"""correlation of white noise in a Hann window with that in the next one and in the one after it"""
_FOR_MATRIX = 4.0
"""averages for each output from which a spectral matrix has an inverse of about the right size"""
STEPS = round(1.0 / (1.0 - OVERLAP))
"""from a window to the next, in the length of one. With an overlap of a half kappa of the disturbed
bench is 4 % less precise"""
PER_AVERAGE = 1.0 + 2.0 * sum(r**2 for r in _SHARED)
"""windows that make one independent average: the sum of the squared correlations of transforms of
white noise in one window with those in all others"""


class Windowed(NamedTuple):
    """Flights of one rate, W windows of them at k lines; transforms scaled to densities per Hz."""

    inputs: tuple[str, ...]
    """the m that move"""
    instruments: tuple[str, ...]
    """those of them that are taken by an excitation that was logged"""
    outputs: tuple[str, ...]
    """the p of which windows are complete"""
    dt: float
    """[s]"""
    length: int
    """samples of a window"""
    numbers: tuple[int, ...]
    """of the k lines, in periods of a window"""
    starts: tuple[tuple[int, ...], ...]
    """by flight the first sample of each window"""
    Z: np.ndarray
    """(W, k, m) of the instruments, or of the inputs themselves"""
    U: np.ndarray
    """(W, k, m) of the inputs"""
    Y: np.ndarray
    """(W, k, p) of the outputs; zero where a sample is missing"""
    seen: np.ndarray
    """(W, p) 1 where all samples of an output are there, else 0"""
    own: np.ndarray
    """(k, p, m) where an input and an output have more power than the window's sidelobes bring"""
    left_out: dict[str, str]
    """by output that is left out, why"""

    @property
    def lines(self) -> np.ndarray:
        """(k,) numbers of the lines"""
        return np.asarray(self.numbers)

    @property
    def hz(self) -> np.ndarray:
        """(k,) frequencies [Hz]"""
        return self.lines / (self.length * self.dt)

    @property
    def seconds(self) -> float:
        """length of a window"""
        return self.length * self.dt

    @property
    def step(self) -> int:
        """samples from the beginning of a window to that of the next"""
        return _step(self.length)

    def later(self, steps: int) -> np.ndarray:
        """(W - steps,) whether the window so many after each is of the same flight."""
        flight = np.repeat(np.arange(len(self.starts)), [len(s) for s in self.starts])
        return flight[steps:] == flight[: len(flight) - steps]

    @property
    def common(self) -> np.ndarray:
        """(W,) 1 where a window has every sample of all outputs, else 0"""
        return np.min(np.asarray(self.seen), axis=1)

    @property
    def together(self) -> bool:
        """Whether there are windows enough to say how the errors of outputs go together: the
        inverse of a spectral matrix from few averages is too large."""
        left = np.sum(self.common) / PER_AVERAGE - len(self.inputs)
        return len(self.outputs) == 1 or bool(left * _SMOOTHED >= _FOR_MATRIX * len(self.outputs))

    @property
    def averages(self) -> np.ndarray:
        """(p,) independent averages of each output"""
        return np.sum(self.seen, axis=0) / PER_AVERAGE

    def by_flight(self, v: np.ndarray) -> list[np.ndarray]:
        """An array (W, ...) of all windows in parts, flight by flight."""
        return np.split(v, np.cumsum([len(s) for s in self.starts])[:-1])


def window_transforms(
    x: Float[np.ndarray | Array, "c N"],
    starts: Sequence[int],
    length: int,
    lines: Sequence[int] | np.ndarray,
    dt: float,
) -> Complex[np.ndarray | Array, "c W k"]:
    """Fourier transforms of Hann windows, scaled so that squares are one-sided densities per Hz.

    Args:
        starts: first samples of the W windows.
        length: samples of each.
        lines: the k lines of the window that are kept.
        dt: between two samples [s].
    """
    xp = jnp if isinstance(x, jax.Array) else np
    window = hann(length)
    parts = x[:, np.asarray(starts, int)[:, None] + np.arange(length)]
    # A constant is in the first line alone, and that is kept.
    parts = parts - xp.mean(parts, axis=-1, keepdims=True)
    transforms = xp.fft.rfft(parts * window[None, None], axis=-1)[..., np.asarray(lines, int)]
    return transforms * float((2.0 * dt / np.sum(window**2)) ** 0.5)


def hann(length: int) -> Float[np.ndarray, " n"]:
    """The window."""
    return 0.5 - 0.5 * np.cos(2.0 * np.pi * np.arange(length) / length)


def windowed(
    flights: Sequence[Flight],
    options: ResponseOptions = ResponseOptions(),
    by: Sequence[str] | None = None,
) -> Windowed:
    """Flights in windows.

    Args:
        flights: of one rate, with the same inputs; samples of outputs may be missing.
        by: inputs that are taken by their instrument (`Flight.instruments`); all that have one in
            every flight unless given.

    Raises:
        ValueError: rates differ, nothing moves, the band does not fit the window or the rate, or
            no output has windows enough.
    """
    dt = one_rate(flights)
    longest = max(f.duration for f in flights) + dt
    seconds = options.window or min(longest / 5.0, _LONGEST)
    require_window(seconds, longest)
    # Even, so that half of it is a number of samples.
    length = 2 * round(0.5 * seconds / dt)
    lines = _lines(options, length, dt)
    inputs = tuple(n for n in flights[0].inputs if any(np.ptp(f.inputs[n]) > 0 for f in flights))
    if not inputs:
        raise ValueError(
            "no input moves, and a response is one to an input; a free decay is fitted by "
            "output-error or frequency-error"
        )
    instruments = tuple(
        n for n in inputs if all(n in f.instruments for f in flights) and (by is None or n in by)
    )
    starts = tuple(_starts(f, length) for f in flights)
    outputs, seen, left_out = _complete(flights, starts, length, (length * dt, len(inputs)))
    cut = _Cut(starts, length, lines, dt)
    U, of_inputs = cut.transforms([np.stack([f.inputs[n] for n in inputs]) for f in flights])
    Z = U
    if instruments:
        kinds = [[f.instruments if n in instruments else f.inputs for n in inputs] for f in flights]
        signals = [[s[n] for n, s in zip(inputs, each, strict=True)] for each in kinds]
        Z = cut.transforms([np.stack(s) for s in signals])[0]
    Y, of_outputs = cut.transforms([_filled(f, outputs) for f in flights])
    own = of_inputs[:, None, :] & of_outputs[:, :, None]
    Y = Y * seen[:, None, :]
    names, numbers = (inputs, instruments, outputs), tuple(lines.tolist())
    return Windowed(*names, dt, length, numbers, starts, Z, U, Y, seen, own, left_out)


class _Cut(NamedTuple):
    """How flights are cut into windows."""

    starts: tuple[tuple[int, ...], ...]
    length: int
    lines: np.ndarray
    dt: float

    def transforms(self, signals: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """(W, k, c) of signals (c, N) by flight, and (k, c) where they have more power than the
        window's sidelobes bring from other lines."""
        # Of all lines first: what leaks into those that are kept comes from any.
        parts = [
            window_transforms(x, s, self.length, range(self.length // 2), self.dt)
            for x, s in zip(signals, self.starts, strict=True)
        ]
        whole = np.moveaxis(np.concatenate(parts, axis=1), 0, -1)
        power = np.mean(np.abs(whole) ** 2, axis=0).T
        own = [(OWN * leakage(S) < S)[self.lines] for S in power]
        return whole[:, self.lines], np.stack(own, axis=1)


def _complete(
    flights: Sequence[Flight],
    starts: tuple[tuple[int, ...], ...],
    length: int,
    asked: tuple[float, int],
) -> tuple[tuple[str, ...], np.ndarray, dict[str, str]]:
    """The outputs that have windows enough, which windows (W, p), and why others have not.

    Args:
        length: samples of a window.
        asked: the same in seconds, and how many inputs move.
    """
    outputs = tuple(dict.fromkeys(n for f in flights for n in f.outputs))
    seen = np.concatenate(
        [_seen(f, s, length, outputs) for f, s in zip(flights, starts, strict=True)]
    )
    seconds, inputs = asked
    averages = np.sum(seen, axis=0) / PER_AVERAGE
    kept = averages >= inputs + 1
    many = "1 input" if inputs == 1 else f"{inputs} inputs"
    need = f"expected at least {inputs + 1} independent averages for {many}, got"
    windows = f"from windows of {seconds:g} s without a missing sample"
    if not kept.any():
        raise ValueError(
            f"{need} {np.max(averages, initial=0.0):.2g} {windows}; a shorter window, or longer "
            "flights"
        )
    each = list(zip(outputs, averages, kept, strict=True))
    left_out = {n: f"{need} {count:.2g} {windows}" for n, count, fine in each if not fine}
    return tuple(n for n, _, fine in each if fine), seen[:, kept], left_out


def _lines(options: ResponseOptions, length: int, dt: float) -> np.ndarray:
    """The lines of the band, or of these the ones nearest to points of a logarithm."""
    if length < 16:
        raise ValueError(f"window: expected at least 16 samples, {16 * dt:.3g} s; got {length}")
    low, high = options.band or (1.0 / (length * dt), _HIGHEST / dt)
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


def _starts(flight: Flight, length: int) -> tuple[int, ...]:
    return tuple(range(0, flight.n_samples - length + 1, _step(length)))


def _step(length: int) -> int:
    # Rounded up: windows so many steps apart share no sample.
    return -(-length // STEPS)


def _seen(
    flight: Flight, starts: tuple[int, ...], length: int, outputs: tuple[str, ...]
) -> np.ndarray:
    """(windows, p) 1 where a window has every sample of an output."""
    seen = np.zeros((len(starts), len(outputs)))
    for j, name in enumerate(outputs):
        if name in flight.outputs:
            missing = np.concatenate([[0], np.cumsum(~np.isfinite(flight.outputs[name]))])
            seen[:, j] = [missing[s + length] == missing[s] for s in starts]
    return seen


def _filled(flight: Flight, outputs: tuple[str, ...]) -> np.ndarray:
    """(p, N), zero where nothing is measured."""
    absent = np.zeros(flight.n_samples)
    return np.stack([np.nan_to_num(flight.outputs.get(n, absent), nan=0.0) for n in outputs])
