"""Handling qualities read off a frequency response: bandwidth, phase delay, crossover, margins.

Of the response of an attitude to a stick, as ADS-33E-PRF (2000), Figure 2, defines them:

- w180, the neutral stability frequency: where the phase is -180 deg;
- phase bandwidth: the highest frequency below it with 45 deg of phase margin, phase -135 deg;
- gain bandwidth: the highest one below it with 6 dB of gain margin, where the gain is 6 dB above
  that at w180;
- bandwidth: of rate responses the lesser of both, of attitude command the phase bandwidth;
- phase delay: (lag at 2 w180 - 180) / (57.3 * 2 w180), angles in degrees; where the phase is not
  straight between w180 and 2 w180 the lag is that of the line fitted to it by least squares.

Intervals rest on each number's derivative by all that the response hangs on (the delta method), be
it the parameters of a fit or the random errors of a measured response; those of frequencies are
where the response's own interval holds the level that defines them.

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


class _Place(NamedTuple):
    """A frequency that is defined by the response."""

    omega: float
    at: Point
    """one frequency"""
    by: np.ndarray
    """(q,) derivative of its logarithm"""
    ends: tuple[float, float]
    """[rad/s] of its 95 % interval; beyond the band infinitely far away, NaN where not known"""


def handling_qualities(curve: Curve, kind: Kind = "rate") -> HandlingQualities:
    """Bandwidth and phase delay of an attitude's response, or crossover and margins of a loop.

    Args:
        curve: the response of an attitude to a stick, or an open loop's that is closed by negative
            unity feedback. The sign of an attitude's response does not matter: it is taken for
            that of a vehicle whose lag grows from 0 or 90 deg on, as its gain falls. An open loop
            is taken as it is.
    """
    grid = np.geomspace(*curve.band, _POINTS)
    points = curve.at(grid)
    sign, phase = (1, _loop_phase(points)) if kind == "open-loop" else _branch(grid, points)
    response = _Response(curve, grid, points, phase)
    numbers: dict[str, Number] = {}
    sentences = [curve.caution] if curve.caution else []
    if kind == "open-loop":
        _loop(response, numbers, sentences)
    else:
        _attitude(response, kind, numbers, sentences)
    return HandlingQualities(kind, numbers, tuple(sentences), sign, curve.band)


def _branch(grid: np.ndarray, points: Point) -> tuple[int, np.ndarray]:
    """The sign of the response, and its phase (k,) [rad] unwrapped, on the branch of its slope."""
    phase = np.unwrap(points.phase)
    # Bode's relation: a gain that falls with the n-th power of the frequency goes with n right
    # angles of lag, whatever the stick's sign. It fails near a mode that grows, and delays add to
    # the lag towards higher frequencies: what most of the lower half of the band says.
    low = slice(0, grid.size // 2)
    turns = np.round((phase - 0.5 * np.pi * points.gain_slope)[low] / np.pi)
    values, counts = np.unique(turns, return_counts=True)
    turn = int(values[np.argmax(counts)])
    return (-1 if turn % 2 else 1), phase - np.pi * turn


def _loop_phase(points: Point) -> np.ndarray:
    """An open loop's phase (k,) [rad] unwrapped, between -360 and 0 deg at the crossover: its sign
    is known, and that of an unstable vehicle may lag by 180 deg from the lowest frequency on."""
    phase = np.unwrap(points.phase)
    falls = np.flatnonzero((points.log_gain[:-1] > 0) & (points.log_gain[1:] <= 0))
    if falls.size:
        turns = np.ceil(phase[falls[-1]] / (2.0 * np.pi))
    else:
        turns = np.round(np.median(phase - 0.5 * np.pi * points.gain_slope) / (2.0 * np.pi))
    return phase - 2.0 * np.pi * turns


class _Response:
    """A curve with its phase on one branch."""

    def __init__(self, curve: Curve, grid: np.ndarray, points: Point, phase: np.ndarray) -> None:
        self.curve, self.grid, self.x = curve, grid, np.log(grid)
        self.gain, self.phase, self.points = points.log_gain, phase, points

    def at(self, omega: float) -> Point:
        """One frequency, on the branch."""
        point = self.curve.at(np.array([omega]))
        near = np.interp(np.log(omega), self.x, self.phase)
        turns = np.round((point.phase - near) / np.pi)
        return point._replace(phase=point.phase - np.pi * turns)

    def falls(
        self, quantity: str, level: float, below: float | None = None, first: bool = False
    ) -> float | None:
        """Return the highest frequency (or the first) at which gain or phase falls below a level;
        None if it does not within the band, or not below `below`.

        Args:
            quantity: log_gain or phase.
            below: [rad/s]
        """
        values = (self.gain if quantity == "log_gain" else self.phase) - level
        end = self.grid.size if below is None else int(np.searchsorted(self.grid, below))
        downward = np.flatnonzero((values[: end - 1] > 0) & (values[1:end] <= 0))
        if below is not None and end < self.grid.size and values[end - 1] > 0:
            # Between the last point of the grid and the frequency itself.
            downward = np.append(downward, end - 1)
        if not downward.size:
            return None
        i = downward[0 if first else -1]

        def off(x: float) -> float:
            return float(getattr(self.at(float(np.exp(x))), quantity)[0]) - level

        low, high = float(self.x[i]), float(self.x[i + 1])
        high = high if below is None else min(high, float(np.log(below)))
        ends = off(low), off(high)
        if ends[0] * ends[1] > 0:  # rounding, where a point of the grid lies on the level
            x = low if abs(ends[0]) < abs(ends[1]) else high
        else:
            # Here: a third of a second to load.
            from scipy.optimize import root_scalar

            x = root_scalar(off, bracket=(low, high), xtol=1e-13).root
        return float(np.exp(x))

    def place(self, omega: float, quantity: str, by_level: np.ndarray | float = 0.0) -> _Place:
        """A frequency where a quantity has a level, which itself may have a derivative (q,)."""
        at = self.at(omega)
        gain = quantity == "log_gain"
        gradient = (at.gain_gradient if gain else at.phase_gradient)[0] - by_level
        slope = at.gain_slope if gain else at.phase_slope
        every = (self.points.gain_gradient if gain else self.points.phase_gradient) - by_level
        off = (self.gain - at.log_gain[0]) if gain else (self.phase - at.phase[0])
        reach = _Z95 * np.linalg.norm(every, axis=1)
        start = _Z95 * float(np.linalg.norm(gradient))
        return _Place(omega, at, -gradient / slope[0], self._ends(omega, off, reach, start))

    def _ends(
        self, omega: float, off: np.ndarray, reach: np.ndarray, start: float
    ) -> tuple[float, float]:
        """Frequencies next to omega past which the curve's band (Fieller) leaves out the level.

        Not the error over the slope: of a noisy curve the slope is known worse than the value.

        Args:
            omega: where the curve has the level [rad/s].
            off: (k,) of the curve from the level, on the grid.
            reach: (k,) of the curve's interval.
        """
        if not np.isfinite(reach).all():
            return np.nan, np.nan
        i, x0, ends = int(np.searchsorted(self.grid, omega)), np.log(omega), []
        for where, beyond, missing in (
            (np.arange(i)[::-1], reach - off, 0.0),
            (np.arange(i, self.grid.size), reach + off, np.inf),
        ):
            left = where[beyond[where] <= 0]
            if not left.size:
                ends.append(missing)
                continue
            k = np.flatnonzero(where == left[0])[0]
            x1, f1 = (x0, start) if k == 0 else (self.x[where[k - 1]], beyond[where[k - 1]])
            x2, f2 = self.x[where[k]], beyond[where[k]]
            ends.append(float(np.exp(x1 + (x2 - x1) * f1 / (f1 - f2) if f1 > f2 else x1)))
        return ends[0], ends[1]


def _attitude(
    response: _Response, kind: Kind, numbers: dict[str, Number], sentences: list[str]
) -> None:
    neutral = response.falls("phase", -np.pi, first=True)
    phase = response.falls("phase", -0.75 * np.pi, neutral)
    places: dict[str, _Place] = {}
    if phase is not None:
        places["phase_bandwidth"] = response.place(phase, "phase")
    else:
        sentences.append(_missing("phase bandwidth", "the phase does not fall through -135 deg"))
    if neutral is None:
        words = f"the phase does not reach -180 deg up to {_hz(response.curve.band[1])}"
        sentences.append(_missing("w180, gain bandwidth and phase delay", words))
    else:
        places["w180"] = at = response.place(neutral, "phase")
        bandwidth = _gain_bandwidth(response, at)
        if bandwidth is not None:
            places["gain_bandwidth"] = bandwidth
        else:
            words = "the gain is nowhere in the band 6 dB above that at w180"
            sentences.append(_missing("gain bandwidth", words))
    for name, place in places.items():
        _put_frequency(name, place, numbers, sentences)
    _put_bandwidth(kind, numbers, sentences)
    if "w180" in numbers:
        _put_delays(response, places["w180"], numbers, sentences)


def _missing(what: str, why: str) -> str:
    return f"{what}: not determined, {why}"


def _hz(omega: float) -> str:
    return f"{omega / (2.0 * np.pi):.3g} Hz ({omega:.3g} rad/s)"


def _gain_bandwidth(response: _Response, neutral: _Place) -> _Place | None:
    level = float(neutral.at.log_gain[0]) + 6.0 / _DB
    omega = response.falls("log_gain", level, neutral.omega)
    if omega is None:
        return None
    # The level moves with the gain at w180, and with w180 itself.
    by = neutral.at.gain_gradient[0] + neutral.at.gain_slope[0] * neutral.by
    return response.place(omega, "log_gain", by)


def _put_frequency(
    name: str, place: _Place, numbers: dict[str, Number], sentences: list[str]
) -> None:
    sd, (low, high) = float(np.linalg.norm(place.by)), place.ends
    if low < place.omega / _VAGUE or high > place.omega * _VAGUE or sd > 1.0:
        words = "its interval reaches past half or twice its value, or out of the band"
        sentences.append(_missing(name.replace("_", " "), words))
        return
    numbers[name] = Number(place.omega, place.omega * sd, low, high)


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


def _put_delays(
    response: _Response, neutral: _Place, numbers: dict[str, Number], sentences: list[str]
) -> None:
    twice, high = 2.0 * neutral.omega, response.curve.band[1]
    if twice > high * (1.0 + 1e-9):
        words = f"the response is known to {_hz(high)}, 2 w180 is {_hz(twice)}"
        sentences.append(_missing("phase delay", words))
        return
    end = response.at(min(twice, high))
    value = -(float(end.phase[0]) + np.pi) / twice
    by = -(end.phase_gradient[0] + end.phase_slope[0] * neutral.by) / twice - value * neutral.by
    numbers["phase_delay"] = _linear(value, by)
    at = neutral.omega * np.linspace(1.0, 2.0, _LINE)
    each = [response.at(float(min(w, high))) for w in at]
    # The slope of a line is a weighted sum of the phases; w180 moves all of the frequencies.
    centred = np.linspace(-0.5, 0.5, _LINE)
    weights = centred / np.sum(centred**2)
    slope = float(weights @ [float(p.phase[0]) for p in each]) / neutral.omega
    moved = [p.phase_gradient[0] + p.phase_slope[0] * neutral.by for p in each]
    by = weights @ np.stack(moved) / neutral.omega - slope * neutral.by
    numbers["phase_delay_line"] = _linear(-0.5 * slope, -0.5 * by)


def _linear(value: float, by: np.ndarray) -> Number:
    sd = float(np.linalg.norm(by))
    return Number(float(value), sd, float(value - _Z95 * sd), float(value + _Z95 * sd))


def _loop(response: _Response, numbers: dict[str, Number], sentences: list[str]) -> None:
    crossover = response.falls("log_gain", 0.0)
    if crossover is None:
        sentences.append(_missing("crossover", "the gain does not fall through 0 dB in the band"))
    else:
        place = response.place(crossover, "log_gain")
        _put_frequency("crossover", place, numbers, sentences)
        at = place.at
        by = at.phase_gradient[0] + at.phase_slope[0] * place.by
        margin = 180.0 + np.degrees(float(at.phase[0]))
        numbers["phase_margin"] = _linear(margin, np.degrees(by))
        _low_gain(response, crossover, sentences)
    neutral = response.falls("phase", -np.pi, first=True)
    if neutral is None:
        sentences.append(_missing("gain margin", "the phase does not reach -180 deg in the band"))
        return
    place = response.place(neutral, "phase")
    _put_frequency("w180", place, numbers, sentences)
    by = place.at.gain_gradient[0] + place.at.gain_slope[0] * place.by
    numbers["gain_margin"] = _linear(-_DB * float(place.at.log_gain[0]), _DB * by)


def _low_gain(response: _Response, crossover: float, sentences: list[str]) -> None:
    """Return how far the gain of a loop around an unstable vehicle may fall."""
    below = response.grid < crossover
    values = response.phase[below] + np.pi
    upward = np.flatnonzero((values[:-1] <= 0) & (values[1:] > 0))
    i = upward[-1] if upward.size else 0
    if upward.size or (values.size and values[0] < values[-1] - _RISES):
        sentences.append(
            "caution: the phase rises up to the crossover, as where an unstable vehicle is in the "
            f"loop; it may have a margin towards low gain too, {-_DB * response.gain[i]:.3g} dB at "
            f"{_hz(response.grid[i])}, where the phase is {np.degrees(response.phase[i]):.0f} deg"
        )
