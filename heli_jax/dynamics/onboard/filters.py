r"""Filters of a flight controller between sensor and log: low-passes, notches, pure delays.

Their constants are firmware settings, so they are fixed. A low-pass of first order is
$H = \omega/(s+\omega)$, one of second order $H = \omega^2/(s^2 + s\,\omega/Q + \omega^2)$. A notch
is $H = (s^2 + d\,s\,\omega/Q + \omega^2)/(s^2 + s\,\omega/Q + \omega^2)$, with gain d at its
centre. The firmware's filters are digital; docs/onboard.md gives the difference.
"""

import functools
import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from heli_jax import naming
from heli_jax.dynamics.check_model import check_model
from heli_jax.dynamics.model import LowPass, Model, zeros
from heli_jax.dynamics.onboard.delays import ORDER, line_end, line_rates, line_states
from heli_jax.dynamics.onboard.device import Device, Parts, Quantity, quotient, require
from heli_jax.naming import Record

KINDS = ("pt1", "pt2", "pt3", "biquad", "notch")
LONGEST_DELAY = 1.0
"""Longest delay [s]: through a longer one, four states follow nothing above 4 rad/s."""
_BUTTERWORTH = 1.0 / math.sqrt(2.0)
_FASTEST_MOTION = 160.0
"""Highest frequency at which a delay line errs by less than `_LINE_ERROR` [rad/s] (25 Hz)."""
_LINE_ERROR = 1e-3


class Filter(NamedTuple):
    """Filter with a firmware's settings."""

    kind: str
    """One of `KINDS`. pt1, pt2 and pt3 are one, two and three equal lags, together 3 dB down at
    `hz` (Betaflight, Rotorflight). biquad is a second-order low-pass (LowPassFilter2p of PX4 and
    ArduPilot); a notch has second order too."""
    hz: float
    """Cutoff (3 dB) of a low-pass, for a biquad with Butterworth's Q, or centre of a notch [Hz]."""
    q: float | None = None
    """Quality factor: centre over width of a notch; for a biquad Butterworth's by default."""
    attenuation: float = math.inf
    """Attenuation of a notch at its centre [dB]."""

    def checked(self) -> "Filter":
        """Return the filter if its settings are valid.

        Raises:
            ValueError: a setting is invalid.
        """
        if self.kind not in KINDS:
            raise ValueError(f"kind: expected one of {', '.join(KINDS)}, got {self.kind!r:.40}")
        if not (math.isfinite(self.hz) and self.hz > 0):
            raise ValueError(f"hz: expected a frequency above zero, got {self.hz:g}")
        if self.kind == "notch" and self.q is None:
            raise ValueError("q: a notch needs its quality factor, got none")
        if self.kind not in ("notch", "biquad") and self.q is not None:
            raise ValueError(f"q: only for a biquad or a notch, got {self.kind}")
        if self.q is not None and not (math.isfinite(self.q) and self.q > 0):
            raise ValueError(f"q: expected a number above zero, got {self.q:g}")
        if not self.attenuation > 0 or (self.kind != "notch" and self.attenuation != math.inf):
            raise ValueError(
                "attenuation: expected for a notch, in decibels above zero, got "
                f"{self.attenuation:g}"
            )
        return self

    @property
    def delay(self) -> float:
        """Delay of slow signals [s]: minus the phase's slope at zero frequency."""
        return sum(section.delay for section in _sections(self))


def cutoff(filters: Sequence[Filter]) -> float:
    """Return the frequency at which low-passes in series are 3 dB down together [Hz]."""
    # Steps of 0.1 % give more digits than are shown. A section of high quality rises before it
    # falls, so the last crossing counts.
    hz = np.geomspace(0.01, 3.0, 5700) * min(f.hz for f in filters)
    size = gain(filters, hz)
    return float(hz[np.flatnonzero(size >= np.sqrt(0.5))[-1]])


def gain(filters: Sequence[Filter], hz: np.ndarray) -> np.ndarray:
    """Return the gain (K,) of low-passes in series.

    Args:
        hz: frequencies (K,) [Hz].
    """
    size = np.ones_like(hz)
    for section in (section for f in filters for section in _sections(f)):
        ratio = 2.0 * np.pi * hz / section.omega
        passed = 1.0 + ratio**2
        if section.order == 2:
            passed = (1.0 - ratio**2) ** 2 + (ratio / section.q) ** 2
        size /= np.sqrt(passed)
    return size


class _Section(NamedTuple):
    """Filter section of first or second order."""

    order: int
    omega: float
    """Corner frequency [rad/s]."""
    q: float = _BUTTERWORTH
    left: float | None = None
    """Gain of a notch at its centre; None for a low-pass."""

    @property
    def delay(self) -> float:
        """Delay of slow signals [s]."""
        if self.order == 1:
            return 1.0 / self.omega
        return (1.0 if self.left is None else 1.0 - self.left) / (self.q * self.omega)


def _sections(filter: Filter) -> tuple[_Section, ...]:
    omega = 2.0 * math.pi * filter.hz
    if filter.kind == "notch":
        assert filter.q is not None  # `Filter.checked`
        return (_Section(2, omega, filter.q, 10.0 ** (-filter.attenuation / 20.0)),)
    if filter.kind == "biquad":
        return (_Section(2, omega, filter.q or _BUTTERWORTH),)
    # n equal lags are 3 dB down together where each is 3/n dB down. Each is therefore faster by
    # this factor (CUTOFF_CORRECTION_PT2 and PT3 of Betaflight's filter.c).
    n = int(filter.kind[-1])
    return (_Section(1, omega / math.sqrt(2.0 ** (1.0 / n) - 1.0)),) * n


def with_filters(
    model: Model,
    filters: Mapping[str, Sequence[Filter]] | None = None,
    delays: Mapping[str, float] | None = None,
) -> Model:
    """Return the model with filtered outputs and fixed output delays.

    Each filter has states `OUTPUT_filter1` and, of second order, `OUTPUT_filter1_rate`. A delay is
    a delay line as in `with_delays`. Both are linear, with fixed constants.

    Args:
        delays: by output [s], at most `LONGEST_DELAY`; the delay follows the filters.

    Raises:
        ValueError: no such output, an invalid filter, a negative or too long delay, or an output
            that has a delay already.
    """
    check_model(model)
    filters, delays = filters or {}, delays or {}
    for name, each in filters.items():
        for i, filter in enumerate(each):
            try:
                filter.checked()
            except ValueError as e:
                raise ValueError(f"filter {i + 1} of {name}: {e}") from e
    for name, delay in delays.items():
        check_delay(delay, f"delay of {name}")
        if delay and name in dict(model.delay_lines):
            raise ValueError(
                f"delay of {name}: it has the delay {dict(model.delay_lines)[name]} already, "
                "expected one"
            )
    # Without a filter or delay the model stays the same object, so it is not compiled again.
    channels = tuple(
        (name, tuple(filters.get(name, ())), float(delays.get(name, 0.0)))
        for name in dict.fromkeys((*filters, *delays))
        if filters.get(name) or delays.get(name)
    )
    return _with_channels(model, channels) if channels else model


def check_delay(delay: float, where: str) -> None:
    """Raise if a number is not a possible output delay.

    Args:
        delay: [s].

    Raises:
        ValueError: it is negative, too long or not a number.
    """
    if not delay >= 0:
        raise ValueError(
            f"{where}: expected 0 s or more, because no output is logged before it happens, got "
            f"{delay:g}; if the inputs are logged late, give them a negative delay "
            "(onboard.delays)"
        )
    if not delay <= LONGEST_DELAY:
        raise ValueError(
            f"{where}: expected seconds, at most {LONGEST_DELAY:g}, got {delay:g}; 4 ms are 0.004"
        )


type _Channel = tuple[str, tuple[Filter, ...], float]


@functools.cache
def _with_channels(model: Model, channels: tuple[_Channel, ...]) -> Model:
    require((name for name, *_ in channels), model.Outputs, "output", model)
    device = _Filtered(model, channels)
    return device.made(
        "filtered",
        lambda bare: _with_channels(bare, channels),
        fastest=max(model.fastest, device.fastest),
        low_passes=(
            *model.low_passes,
            *(_low_pass(name, filters) for name, filters, _ in channels if _lowpasses(filters)),
        ),
    )


def _lowpasses(filters: Iterable[Filter]) -> list[Filter]:
    return [f for f in filters if f.kind != "notch"]


def _low_pass(name: str, filters: tuple[Filter, ...]) -> LowPass:
    """Return the state where white noise before an output's filters enters, and its intensity.

    A notch before the first low-pass is left out, since noise behind it is still nearly white.
    """
    named = list(_named(name, tuple(s for filter in filters for s in _sections(filter))))
    while named[0][2].left is not None:
        named = named[1:]
    A, b, c = _chain([section for *_, section in named])
    # The covariance X of its states solves A X + X A' = -b b'.
    eye = np.eye(b.size)
    X = np.linalg.solve(np.kron(A, eye) + np.kron(eye, A), -np.outer(b, b).ravel()).reshape(A.shape)
    sd = math.sqrt((c @ X @ c).item())
    state, speed, first = named[0]
    entry, gain = (state, first.omega) if first.order == 1 else (speed, first.omega**2)
    return LowPass(name, entry, gain / sd, cutoff(_lowpasses(filters)))


def _chain(sections: Sequence[_Section]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return A (n, n), b (n,) and c (n,) of sections in series, with the states of `_Filtered`."""
    n = sum(section.order for section in sections)
    rows, unit = np.zeros((n, n + 1)), np.eye(n + 1)
    # The signal is a combination of the states and, last, the input.
    value, i = unit[n], 0
    for section in sections:
        x = unit[i]
        if section.order == 1:
            rows[i], value, i = section.omega * (value - x), x, i + 1
            continue
        v, band = unit[i + 1], section.omega / section.q
        rows[i], rows[i + 1] = v, section.omega**2 * (value - x) - band * v
        left = section.left
        value = x if left is None else value - (1.0 - left) * v / (section.omega * section.q)
        i += 2
    return rows[:, :n], rows[:, n], value[:n]


class _Filtered(Device):
    """Filters, then a delay line, on some outputs."""

    def __init__(self, model: Model, channels: tuple[_Channel, ...]) -> None:
        self.sections = {
            name: tuple(s for filter in filters for s in _sections(filter))
            for name, filters, _ in channels
        }
        self.delays = {name: delay for name, _, delay in channels if delay}
        self.orders = {name: line_order(delay) for name, delay in self.delays.items()}
        lines = (line_rate(self.orders[n], delay) for n, delay in self.delays.items())
        omegas = (s.omega for sections in self.sections.values() for s in sections)
        self.fastest = max((*lines, *omegas))
        states = {}
        for n, sections in self.sections.items():
            unit = naming.unit(model.Outputs, n)
            for state, speed, section in _named(n, sections):
                states[state] = Quantity(unit, f"{n}, low-passed at {section.omega:.5g} rad/s")
                if section.order == 2:
                    states[speed] = Quantity(quotient(unit, "s"), f"rate of {state}")
            for i, state in enumerate(line_states(n, self.orders.get(n, 0))):
                states[state] = Quantity(unit, f"past of {n}, Legendre coefficient {i}")
        super().__init__(model, Parts({}, states))

    def rates(self, p: Record, s: Record, u: Record) -> dict[str, Any]:
        """Return the time derivatives of filters and delay lines."""
        measured, rates = self.measured(p, s, u), {}
        for n, sections in self.sections.items():
            value = getattr(measured, n)
            for state, speed, section in _named(n, sections):
                x = getattr(s, state)
                if section.order == 1:
                    rates[state] = section.omega * (value - x)
                else:
                    v = getattr(s, speed)
                    rates[state] = v
                    rates[speed] = section.omega**2 * (value - x) - section.omega / section.q * v
                value = self._behind(s, state, speed, section, value)
            if n in self.delays:
                line = line_states(n, self.orders[n])
                past = [getattr(s, state) for state in line]
                rates |= zip(line, line_rates(past, value, self.delays[n]), strict=True)
        return rates

    def shown(self, p: Record, s: Record, u: Record, y: Record) -> Record:
        """Return the outputs as logged."""
        logged = {}
        for n, sections in self.sections.items():
            value = getattr(y, n)
            for state, speed, section in _named(n, sections):
                value = self._behind(s, state, speed, section, value)
            if n in self.delays:
                value = line_end([getattr(s, state) for state in line_states(n, self.orders[n])])
            logged[n] = value
        return naming.replace(y, **logged)

    def _behind(self, s: Record, state: str, speed: str, section: _Section, value: Any) -> Any:
        """Return the signal behind a section."""
        if section.left is None:
            return getattr(s, state)
        # The low-passed signal's rate over omega Q is the band that a notch removes.
        band = getattr(s, speed) / (section.omega * section.q)
        return value - (1.0 - section.left) * band

    def first(self, p: Record) -> dict[str, Any]:
        # The filters have settled at the first output, with rates zero.
        y = self.model.output(p, self.model.initial_state(p), zeros(self.model.Inputs))
        first = super().first(p)
        for n, sections in self.sections.items():
            settled = {state: getattr(y, n) for state, *_ in _named(n, sections)}
            if n in self.delays:
                settled[line_states(n, 1)[0]] = getattr(y, n)
            first |= settled
        return first


def _named(name: str, sections: tuple[_Section, ...]) -> Iterator[tuple[str, str, _Section]]:
    """Yield the names of each section's state and rate state, and the section."""
    for i, section in enumerate(sections):
        yield f"{name}_filter{i + 1}", f"{name}_filter{i + 1}_rate", section


def states_behind(model: Model) -> frozenset[str]:
    """Return the states of filters and delay lines behind a model's outputs."""
    names = "|".join(map(re.escape, naming.names(model.Outputs)))
    pattern = re.compile(rf"({names})_(filter\d+(_rate)?|late\d+)")
    return frozenset(n for n in naming.names(model.State) if pattern.fullmatch(n))


@functools.cache
def line_order(delay: float) -> int:
    """Return the smallest order of a fixed delay's line with an error below 0.1 % up to 25 Hz, at
    most 4.

    Args:
        delay: [s].
    """
    # Higher orders have faster rates, which a fixed-step solver must follow. A delay of 3 ms needs
    # two states; its fastest rate is then four times slower than with four.
    for order in range(1, ORDER):
        A, b = _line(order)
        x = 1j * _FASTEST_MOTION * delay
        late = np.sum(np.linalg.solve(x * np.eye(order) - A, b))
        if abs(late - np.exp(-x)) < _LINE_ERROR:
            return order
    return ORDER


def line_rate(order: int, delay: float) -> float:
    """Return the fastest rate of a delay line [rad/s].

    Args:
        delay: [s].
    """
    return float(np.max(np.abs(np.linalg.eigvals(_line(order)[0])))) / delay


def _line(order: int) -> tuple[np.ndarray, np.ndarray]:
    """Return A and b of a delay line of 1 s."""
    no = [0.0] * order
    b = np.array(line_rates(no, 1.0, 1.0))
    columns = [line_rates([float(i == j) for i in range(order)], 0.0, 1.0) for j in range(order)]
    return np.array(columns).T, b
