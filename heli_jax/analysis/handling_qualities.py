"""Handling qualities from a frequency response: bandwidth, phase delay, crossover, margins.

Definitions for the response of an attitude to a stick, from ADS-33E-PRF (2000), Figure 2:

- w180, the neutral stability frequency: where the phase is -180 deg;
- phase bandwidth: the highest frequency below it with 45 deg of phase margin, phase -135 deg;
- gain bandwidth: the highest one below it with 6 dB of gain margin, where the gain is 6 dB above
  that at w180;
- bandwidth: the lesser of both for rate responses, the phase bandwidth for attitude command;
- phase delay: (lag at 2 w180 - 180) / (57.3 * 2 w180), angles in degrees. If the phase is not
  straight between w180 and 2 w180, a least-squares line gives the lag.

Intervals come from the delta method, with finite differences by a fit's parameters or by a measured
response's random errors. The interval of a frequency is where the response's interval contains the
defining level.

These were checked against publications, not against the standard's text. Ham, Gardner and Tischler
(1993), Flight testing and frequency domain analysis for rotorcraft handling qualities
characteristics, give the response and the phase delay. CIFER also weights the line by coherence.
Frost and others (2002), AIAA 2002-4869, give both bandwidths.
"""

from typing import Literal, NamedTuple

import numpy as np

from heli_jax.analysis.response_curves import Curve, Point

Kind = Literal["rate", "attitude-command", "open-loop"]

UNITS = {
    "bandwidth": "rad/s",
    "phase_bandwidth": "rad/s",
    "gain_bandwidth": "rad/s",
    "w180": "rad/s",
    "phase_delay": "s",
    "phase_delay_line": "s",
    "crossover": "rad/s",
    "phase_margin": "deg",
    "gain_margin": "dB",
}
"""Unit of each quantity, by name."""
NUMBERS: dict[str, tuple[str, ...]] = {
    "rate": tuple(UNITS)[:6],
    "attitude-command": tuple(UNITS)[:6],
    "open-loop": ("crossover", "w180", "phase_margin", "gain_margin"),
}
"""Quantities of each kind of response."""
_DB = 20.0 / np.log(10.0)
_Z95 = 1.959963984540054
_POINTS = 500
"""Number of grid points for the search for crossings."""
_STEP = 1e-4
"""Step of finite differences [sd]."""
_LINE = 60
"""Number of frequencies from w180 to 2 w180 for the line of the phase delay."""
_RISES = np.radians(10.0)
"""Least phase rise from the lowest frequency to the crossover that indicates an unstable vehicle
[rad].
"""
_VAGUE = 2.0
"""Largest factor from a frequency to either end of its interval."""


class Number(NamedTuple):
    """A value with its 95 % interval; sd and interval are NaN if unknown."""

    value: float
    sd: float
    lower95: float
    upper95: float

    @property
    def known(self) -> bool:
        """True if the number has an interval.

        There is none if the parameters are not identifiable or the fit did not converge.
        """
        return self.sd >= 0.0


class HandlingQualities(NamedTuple):
    """Handling qualities of a response."""

    kind: Kind
    numbers: dict[str, Number]
    """Determined quantities by name; units are in `UNITS`."""
    sentences: tuple[str, ...]
    """Reasons why others are missing, and cautions."""
    sign: int
    """-1 if the response was inverted, since the stick is logged with the opposite sign."""
    band: tuple[float, float]
    """Band in which the response is known [rad/s]."""


def handling_qualities(curve: Curve, kind: Kind = "rate") -> HandlingQualities:
    """Return bandwidth and phase delay of an attitude, or crossover and margins of a loop.

    Args:
        curve: the response of an attitude to a stick, or of an open loop for negative unity
            feedback. The sign of an attitude's response does not matter: its lag is assumed to grow
            from 0 or 90 deg as the gain falls. The sign of an open loop is kept.
    """
    x = np.log(np.geomspace(*curve.band, _POINTS))
    points = curve.at(np.exp(x))
    sign, phase = (1, _loop_phase(x, points)) if kind == "open-loop" else _branch(x, points)
    response = _Response(x, points.log_gain, phase, points)
    values, by = _values(kind, x, response.gain, phase), _derivatives(kind, response)
    numbers: dict[str, Number] = {}
    sentences = [curve.caution] if curve.caution else []
    for name in NUMBERS[kind]:
        if name not in values:
            continue
        if name in _LEVELS:
            _put_frequency(name, response, values, by, numbers, sentences)
        # The delays depend on w180.
        elif kind == "open-loop" or "w180" in numbers:
            numbers[name] = _linear(values[name], by[name])
    if kind == "open-loop":
        _explain_loop(response, values, sentences)
    else:
        _put_bandwidth(kind, numbers, sentences)
        _explain_attitude(curve.band[1], values, numbers, sentences)
    return HandlingQualities(kind, numbers, tuple(sentences), sign, curve.band)


def _branch(x: np.ndarray, points: Point) -> tuple[int, np.ndarray]:
    """Return the response's sign and its unwrapped phase (k,) [rad], on the branch of its slope."""
    phase = np.unwrap(points.phase)
    # Bode's relation: a gain that falls with the n-th power of frequency has n right angles of lag,
    # for any sign of the stick. It fails near a growing mode, and delays add lag at high
    # frequencies. The majority in the lower half of the band therefore decides.
    low = slice(0, x.size // 2)
    turns = np.round((phase - 0.5 * np.pi * np.gradient(points.log_gain, x))[low] / np.pi)
    values, counts = np.unique(turns, return_counts=True)
    turn = int(values[np.argmax(counts)])
    return (-1 if turn % 2 else 1), phase - np.pi * turn


def _loop_phase(x: np.ndarray, points: Point) -> np.ndarray:
    """Return an open loop's unwrapped phase (k,) [rad], between -360 and 0 deg at the crossover.

    Its sign is known. With an unstable vehicle the lag may be 180 deg at the lowest frequency.
    """
    phase = np.unwrap(points.phase)
    falls = np.flatnonzero((points.log_gain[:-1] > 0) & (points.log_gain[1:] <= 0))
    if falls.size:
        turns = np.ceil(phase[falls[-1]] / (2.0 * np.pi))
    else:
        turns = np.round(
            np.median(phase - 0.5 * np.pi * np.gradient(points.log_gain, x)) / (2.0 * np.pi)
        )
    return phase - 2.0 * np.pi * turns


class _Response(NamedTuple):
    """A curve on a grid, with its phase on one branch; arrays (k,)."""

    x: np.ndarray
    """Natural logarithm of the frequency."""
    gain: np.ndarray
    """Natural logarithm of the gain."""
    phase: np.ndarray
    """Phase [rad]."""
    points: Point


_LEVELS: dict[str, tuple[str, float]] = {
    "w180": ("phase", -np.pi),
    "phase_bandwidth": ("phase", -0.75 * np.pi),
    "gain_bandwidth": ("gain", np.nan),
    "crossover": ("gain", 0.0),
}
"""Quantity and level that define each frequency. The level of the gain bandwidth moves with the
gain at w180.
"""


def _values(kind: Kind, x: np.ndarray, gain: np.ndarray, phase: np.ndarray) -> dict[str, float]:
    """Return the existing quantities of a response on a grid; frequencies as logarithms.

    `level` is the level of the gain bandwidth.
    """
    found: dict[str, float | None] = {"w180": _fall(x, phase, -np.pi, first=True)}
    neutral = found["w180"]
    if kind == "open-loop":
        crossover = found["crossover"] = _fall(x, gain, 0.0)
        if crossover is not None:
            found["phase_margin"] = 180.0 + np.degrees(np.interp(crossover, x, phase))
        if neutral is not None:
            found["gain_margin"] = -_DB * np.interp(neutral, x, gain)
    else:
        found["phase_bandwidth"] = _fall(x, phase, -0.75 * np.pi, below=neutral)
        if neutral is not None:
            level = found["level"] = float(np.interp(neutral, x, gain)) + 6.0 / _DB
            found["gain_bandwidth"] = _fall(x, gain, level, below=neutral)
            if neutral + np.log(2.0) <= x[-1] + 1e-9:
                found |= _delays(x, phase, neutral)
    return {name: float(value) for name, value in found.items() if value is not None}


def _fall(
    x: np.ndarray, values: np.ndarray, level: float, below: float | None = None, first: bool = False
) -> float | None:
    """Return the last place (or the first) where values (k,) fall below a level.

    Returns None if there is none before `below`.
    """
    off = values - level
    i = np.flatnonzero((off[:-1] > 0) & (off[1:] <= 0))
    places = x[i] + (x[i + 1] - x[i]) * off[i] / (off[i] - off[i + 1])
    places = places if below is None else places[places < below]
    return float(places[0 if first else -1]) if places.size else None


def _delays(x: np.ndarray, phase: np.ndarray, neutral: float) -> dict[str, float | None]:
    """Return the phase delay between w180 and its double, by two points and by a line."""
    omega = np.exp(neutral) * np.linspace(1.0, 2.0, _LINE)
    lag = np.interp(np.log(omega), x, phase)
    return {
        "phase_delay": -(lag[-1] + np.pi) / omega[-1],
        "phase_delay_line": -0.5 * np.polyfit(omega - omega.mean(), lag, 1)[0],
    }


def _derivatives(kind: Kind, response: _Response) -> dict[str, np.ndarray]:
    """Return the derivatives (q,) of the quantities; NaN where unknown."""
    x, gain, phase, points = response
    steps = []
    for by_gain, by_phase in zip(points.gain_gradient.T, points.phase_gradient.T, strict=True):
        ends = [_values(kind, x, gain + h * by_gain, phase + h * by_phase) for h in (_STEP, -_STEP)]
        steps.append(ends)
    names = (*NUMBERS[kind], "level")
    return {
        n: np.array([(a.get(n, np.nan) - b.get(n, np.nan)) / (2.0 * _STEP) for a, b in steps])
        for n in names
    }


def _ends(
    response: _Response, name: str, values: dict[str, float], by: dict[str, np.ndarray]
) -> tuple[float, float]:
    """Return a frequency's interval [rad/s], where the curve's band contains the level (Fieller).

    An end outside the band is infinite; unknown errors give NaN. The error over the slope is not
    used, since for a noisy curve the slope is less certain than the value.
    """
    of_gain = _LEVELS[name][0] == "gain"
    level, by_level = _LEVELS[name][1], 0.0
    if name == "gain_bandwidth":
        level, by_level = values["level"], by["level"]
    points, x, x0 = response.points, response.x, values[name]
    off = (response.gain if of_gain else response.phase) - level
    gradient = points.gain_gradient if of_gain else points.phase_gradient
    reach = _Z95 * np.linalg.norm(gradient - by_level, axis=1)
    if not np.isfinite(reach).all():
        return np.nan, np.nan
    i, ends = int(np.searchsorted(x, x0)), []
    for where, beyond, missing in (
        (np.arange(i)[::-1], reach - off, 0.0),
        (np.arange(i, x.size), reach + off, np.inf),
    ):
        left = np.flatnonzero(beyond[where] <= 0)
        if not left.size:
            ends.append(missing)
            continue
        k = where[left[0]]
        start = (x0, np.interp(x0, x, reach)) if left[0] == 0 else None
        x1, f1 = start or (x[where[left[0] - 1]], beyond[where[left[0] - 1]])
        f2 = beyond[k]
        ends.append(float(np.exp(x1 + (x[k] - x1) * f1 / (f1 - f2) if f1 > f2 else x1)))
    return ends[0], ends[1]


def _put_frequency(
    name: str,
    response: _Response,
    values: dict[str, float],
    by: dict[str, np.ndarray],
    numbers: dict[str, Number],
    sentences: list[str],
) -> None:
    """Add a frequency to the numbers, or a sentence if its interval is too wide."""
    omega, sd = float(np.exp(values[name])), float(np.linalg.norm(by[name]))
    low, high = _ends(response, name, values, by)
    if low < omega / _VAGUE or high > omega * _VAGUE or sd > 1.0:
        words = "its interval reaches beyond half or twice its value, or out of the band"
        sentences.append(_missing(name.replace("_", " "), words))
        return
    numbers[name] = Number(omega, omega * sd, low, high)


def _linear(value: float, by: np.ndarray) -> Number:
    sd = float(np.linalg.norm(by))
    return Number(value, sd, value - _Z95 * sd, value + _Z95 * sd)


def _missing(what: str, why: str) -> str:
    return f"{what}: not determined, {why}"


def _hz(omega: float) -> str:
    return f"{omega / (2.0 * np.pi):.3g} Hz ({omega:.3g} rad/s)"


def _explain_attitude(
    high: float, values: dict[str, float], numbers: dict[str, Number], sentences: list[str]
) -> None:
    """State why numbers of an attitude's response are missing.

    Args: high: upper end of the band [rad/s].
    """
    if "phase_bandwidth" not in values:
        sentences.append(_missing("phase bandwidth", "the phase does not fall through -135 deg"))
    if "w180" not in values:
        words = f"the phase does not reach -180 deg up to {_hz(high)}"
        sentences.append(_missing("w180, gain bandwidth and phase delay", words))
        return
    if "gain_bandwidth" not in values:
        words = "the gain is nowhere in the band 6 dB above that at w180"
        sentences.append(_missing("gain bandwidth", words))
    if "w180" in numbers and "phase_delay" not in values:
        twice = 2.0 * numbers["w180"].value
        words = f"the response is known to {_hz(high)}, 2 w180 is {_hz(twice)}"
        sentences.append(_missing("phase delay", words))


def _put_bandwidth(kind: Kind, numbers: dict[str, Number], sentences: list[str]) -> None:
    gain, phase = numbers.get("gain_bandwidth"), numbers.get("phase_bandwidth")
    if kind == "attitude-command":
        if phase is None:
            return
        numbers["bandwidth"] = phase
        if gain is None or gain.value < phase.value:
            sentences.append(
                "caution: the gain bandwidth is "
                + ("indeterminate" if gain is None else "below the phase bandwidth")
                + ", so that the vehicle may be prone to pilot-induced oscillations in "
                "super-precision tasks or with an aggressive pilot (ADS-33E-PRF, Figure 2)"
            )
    elif gain is not None and phase is not None:
        numbers["bandwidth"] = min(gain, phase, key=lambda n: n.value)
    else:
        lacking = "gain" if gain is None else "phase"
        sentences.append(
            f"bandwidth unknown: it is the lower of two limits, and the {lacking} limit is unknown"
        )


def _explain_loop(response: _Response, values: dict[str, float], sentences: list[str]) -> None:
    """State why numbers of a loop are missing, and the gain limit of an unstable vehicle."""
    if "crossover" not in values:
        sentences.append(_missing("crossover", "the gain does not fall through 0 dB in the band"))
    else:
        _explain_low_gain(response, values["crossover"], sentences)
    if "w180" not in values:
        sentences.append(_missing("gain margin", "the phase does not reach -180 deg in the band"))


def _explain_low_gain(response: _Response, crossover: float, sentences: list[str]) -> None:
    values = response.phase[response.x < crossover] + np.pi
    upward = np.flatnonzero((values[:-1] <= 0) & (values[1:] > 0))
    i = upward[-1] if upward.size else 0
    if upward.size or (values.size and values[0] < values[-1] - _RISES):
        at, degrees = _hz(float(np.exp(response.x[i]))), np.degrees(response.phase[i])
        sentences.append(
            "caution: the phase rises up to the crossover, as with an unstable vehicle in the "
            f"loop; there may also be a lower gain margin of {-_DB * response.gain[i]:.3g} dB at "
            f"{at}, where the phase is {degrees:.0f} deg"
        )
