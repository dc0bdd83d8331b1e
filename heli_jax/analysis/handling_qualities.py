"""Handling qualities read off a frequency response: bandwidth, phase delay, crossover, margins.

Of the response of an attitude to a stick, as ADS-33E-PRF (2000), Figure 2, defines them:

- w180, the neutral stability frequency: where the phase is -180 deg;
- phase bandwidth: the highest frequency below it with 45 deg of phase margin, phase -135 deg;
- gain bandwidth: the highest one below it with 6 dB of gain margin, where the gain is 6 dB above
  that at w180;
- bandwidth: of rate responses the lesser of both, of attitude command the phase bandwidth;
- phase delay: (lag at 2 w180 - 180) / (57.3 * 2 w180), angles in degrees; where the phase is not
  straight between w180 and 2 w180 the lag is that of the line fitted to it by least squares.

Intervals rest on each number's derivative by all that the response hangs on (the delta method, by
finite differences), be it the parameters of a fit or the random errors of a measured response;
those of frequencies are where the response's own interval holds the level that defines them.

Compared with what others say of the standard, not with its own text: Ham, Gardner and Tischler
(1993), Flight testing and frequency domain analysis for rotorcraft handling qualities
characteristics: the attitude's response to the stick, a rate's over s in its place, the phase delay
by two points or by least squares from the neutral stability frequency to its double (CIFER weighs
that line by coherence, here it is not weighed); Frost and others (2002), AIAA 2002-4869: 45 deg of
phase margin for attitude command, the lesser of that and 6 dB of gain margin for rate responses.
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
"""of every number by its name"""
NUMBERS: dict[str, tuple[str, ...]] = {
    "rate": tuple(UNITS)[:6],
    "attitude-command": tuple(UNITS)[:6],
    "open-loop": ("crossover", "w180", "phase_margin", "gain_margin"),
}
"""by kind of response what may be known of it"""
_DB = 20.0 / np.log(10.0)
_Z95 = 1.959963984540054
_POINTS = 500
"""of the grid on which crossings are looked for"""
_STEP = 1e-4
"""of finite differences, in standard deviations"""
_LINE = 60
"""frequencies from w180 to 2 w180 through which the line of the phase delay is fitted"""
_RISES = np.radians(10.0)
"""of phase from the lowest frequency to the crossover, from which on a loop is called one of an
unstable vehicle"""
_VAGUE = 2.0
"""the factor by which a frequency's interval may reach to either side"""


class Number(NamedTuple):
    """One number with its 95 % interval; sd and interval are NaN where they are not known."""

    value: float
    sd: float
    lower95: float
    upper95: float

    @property
    def known(self) -> bool:
        """True if it has an interval: a model whose parameters the data do not determine, or whose
        fit did not converge, has none."""
        return self.sd >= 0.0


class HandlingQualities(NamedTuple):
    """Handling qualities of a response."""

    kind: Kind
    numbers: dict[str, Number]
    """by name, those that are determined; `UNITS` has the units"""
    sentences: tuple[str, ...]
    """why others are not, and what is to be heeded"""
    sign: int
    """-1 where the response was turned over: a stick that is logged the other way round"""
    band: tuple[float, float]
    """[rad/s] in which the response is known"""


def handling_qualities(curve: Curve, kind: Kind = "rate") -> HandlingQualities:
    """Bandwidth and phase delay of an attitude's response, or crossover and margins of a loop.

    Args:
        curve: the response of an attitude to a stick, or an open loop's that is closed by negative
            unity feedback. The sign of an attitude's response does not matter: it is taken for
            that of a vehicle whose lag grows from 0 or 90 deg on, as its gain falls. An open loop
            is taken as it is.
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
        # The delays hang on w180.
        elif kind == "open-loop" or "w180" in numbers:
            numbers[name] = _linear(values[name], by[name])
    if kind == "open-loop":
        _explain_loop(response, values, sentences)
    else:
        _put_bandwidth(kind, numbers, sentences)
        _explain_attitude(curve.band[1], values, numbers, sentences)
    return HandlingQualities(kind, numbers, tuple(sentences), sign, curve.band)


def _branch(x: np.ndarray, points: Point) -> tuple[int, np.ndarray]:
    """The sign of the response, and its phase (k,) [rad] unwrapped, on the branch of its slope."""
    phase = np.unwrap(points.phase)
    # Bode's relation: a gain that falls with the n-th power of the frequency goes with n right
    # angles of lag, whatever the stick's sign. It fails near a mode that grows, and delays add to
    # the lag towards higher frequencies: what most of the lower half of the band says.
    low = slice(0, x.size // 2)
    turns = np.round((phase - 0.5 * np.pi * np.gradient(points.log_gain, x))[low] / np.pi)
    values, counts = np.unique(turns, return_counts=True)
    turn = int(values[np.argmax(counts)])
    return (-1 if turn % 2 else 1), phase - np.pi * turn


def _loop_phase(x: np.ndarray, points: Point) -> np.ndarray:
    """An open loop's phase (k,) [rad] unwrapped, between -360 and 0 deg at the crossover: its sign
    is known, and that of an unstable vehicle may lag by 180 deg from the lowest frequency on."""
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
    """logarithm of the frequency"""
    gain: np.ndarray
    """natural logarithm"""
    phase: np.ndarray
    """[rad]"""
    points: Point


_LEVELS: dict[str, tuple[str, float]] = {
    "w180": ("phase", -np.pi),
    "phase_bandwidth": ("phase", -0.75 * np.pi),
    "gain_bandwidth": ("gain", np.nan),
    "crossover": ("gain", 0.0),
}
"""by frequency the quantity whose level defines it, and the level; that of the gain bandwidth moves
with the gain at w180"""


def _values(kind: Kind, x: np.ndarray, gain: np.ndarray, phase: np.ndarray) -> dict[str, float]:
    """The numbers of a response on a grid, those that there are; of frequencies the logarithms.

    `level` is that of the gain bandwidth.
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
    """Return the last place (or the first) where values (k,) fall below a level; None where there
    is none before `below`."""
    off = values - level
    i = np.flatnonzero((off[:-1] > 0) & (off[1:] <= 0))
    places = x[i] + (x[i + 1] - x[i]) * off[i] / (off[i] - off[i + 1])
    places = places if below is None else places[places < below]
    return float(places[0 if first else -1]) if places.size else None


def _delays(x: np.ndarray, phase: np.ndarray, neutral: float) -> dict[str, float | None]:
    """The phase delay between w180 and its double, by two points and by a line."""
    omega = np.exp(neutral) * np.linspace(1.0, 2.0, _LINE)
    lag = np.interp(np.log(omega), x, phase)
    return {
        "phase_delay": -(lag[-1] + np.pi) / omega[-1],
        "phase_delay_line": -0.5 * np.polyfit(omega - omega.mean(), lag, 1)[0],
    }


def _derivatives(kind: Kind, response: _Response) -> dict[str, np.ndarray]:
    """Derivatives (q,) of the numbers; NaN where they are not known."""
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
    """Frequencies [rad/s] next to a number's past which the curve's band (Fieller) leaves out the
    level; beyond the band infinitely far away, NaN where errors are not known.

    Not the error over the slope: of a noisy curve the slope is known worse than the value.
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
    """Put a frequency among the numbers, or a sentence where its interval says nothing."""
    omega, sd = float(np.exp(values[name])), float(np.linalg.norm(by[name]))
    low, high = _ends(response, name, values, by)
    if low < omega / _VAGUE or high > omega * _VAGUE or sd > 1.0:
        words = "its interval reaches past half or twice its value, or out of the band"
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

    Args:
        high: end of the band [rad/s].
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
                + ", the vehicle may be prone to pilot-induced oscillations in super-precision "
                "tasks or where the pilot is aggressive (ADS-33E-PRF, Figure 2)"
            )
    elif gain is not None and phase is not None:
        numbers["bandwidth"] = min(gain, phase, key=lambda n: n.value)
    else:
        lacking = "gain" if gain is None else "phase"
        sentences.append(
            _missing("bandwidth", f"the {lacking} bandwidth, which may be less, is not")
        )


def _explain_loop(response: _Response, values: dict[str, float], sentences: list[str]) -> None:
    """State why numbers of a loop are missing, and how far the gain of one around an unstable
    vehicle may fall."""
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
            "caution: the phase rises up to the crossover, as where an unstable vehicle is in the "
            f"loop; it may have a margin towards low gain too, {-_DB * response.gain[i]:.3g} dB at "
            f"{at}, where the phase is {degrees:.0f} deg"
        )
