"""Bode figures: model beside data, and a measured response.

Frequencies are in Hz, as in configurations. A phase lies on the branch nearest to that of the
smoothest curve.
"""

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np

from heli_jax import naming
from heli_jax.analysis.response_curves import unnoticeable
from heli_jax.analysis.spectra import COHERENT, octave_mean
from heli_jax.dynamics.model import Model
from heli_jax.identification.equation_error.rls import Baseline
from heli_jax.identification.identifiability.verdict import Z95
from heli_jax.report import style
from heli_jax.report.charts import Chart, Panel, Series, band, bars, limits_of, panel
from heli_jax.report.fitted_responses import FittedPair

_TURN = 2.0 * np.pi
"""rad/s of 1 Hz."""
_DB = 20.0 / np.log(10.0)
SEEN, BEYOND_CHANCE = 0.1, 0.3
"""Mean coherence over an octave below which it is chance, and above which it is not; the axis ends
at the last bin above the second."""
_WIDE, _WIDE_DATA = 1.0, 0.5
"""Relative random error above which a measured response, and one beside a model, is not drawn."""
_BY_CHANCE = 2.0
"""Least product of mean coherence over an octave and number of averages, for a bin that sets the
axes and the phase branch."""
_MARGINS = (6.0, 45.0)
"""Margins of the axes [dB, deg]."""
_ERRORS = (12.0, 90.0)
"""Half range of the error panels [dB, deg]."""
_FEW = 3
"""Fewest bins that set the axes."""


def _chart(title: str, note: str, limits: Sequence[float], panels: Sequence[Panel]) -> Chart:
    """Return a chart over frequency with limits [rad/s]."""
    hz = float(limits[0]) / _TURN, float(limits[-1]) / _TURN
    return Chart(title, "frequency [Hz]", hz, tuple(panels), note, logarithmic=True)


def _nearest(degrees: np.ndarray, along: np.ndarray) -> np.ndarray:
    """Return phases [deg] within half a turn of others."""
    return degrees - 360.0 * np.round((degrees - along) / 360.0)


def phase(H: np.ndarray) -> np.ndarray:
    """Return the unwrapped phase (k,) [deg], which starts between -270 and 90."""
    unwrapped = np.degrees(np.unwrap(np.angle(H)))
    first = unwrapped[0] if unwrapped.size else 0.0
    # 1e-6 allows for rounding at +90.
    return unwrapped - 360.0 * np.ceil((first - 90.0 - 1e-6) / 360.0)


def baseline_response(baseline: Baseline, omega: np.ndarray) -> np.ndarray:
    """Return Hd(e^{i omega dt}) (k,) of the recursive least squares, without its input's hold."""
    # The unit circle is used because the continuous form may be an approximation.
    turns = omega * baseline.dt
    z, hold = np.exp(1j * turns), np.sinc(turns / (2.0 * np.pi)) * np.exp(-0.5j * turns)
    with np.errstate(all="ignore"):
        return np.polyval(baseline.num, z) / np.polyval(baseline.den, z) / hold


def _curve(
    label: str, omega: np.ndarray, H: np.ndarray, degrees: np.ndarray, color: str, width: float
) -> tuple[Series, Series]:
    """Return magnitude [dB] and phase of a response."""
    # A zero has no phase; NaN breaks the line.
    good = np.isfinite(H) & (np.abs(H) > 0)
    gain = np.where(good, _DB * np.log(np.where(good, np.abs(H), 1.0)), np.nan)
    of_phase = np.where(good, degrees, np.nan)
    hz = omega / _TURN
    return (
        Series(label, hz, gain, color, width=width),
        Series(label, hz, of_phase, color, width=width),
    )


def _bars(
    omega: np.ndarray,
    gain: np.ndarray,
    degrees: np.ndarray,
    relative: tuple[np.ndarray, np.ndarray],
    color: str,
    label: str = "",
) -> tuple[Series, Series]:
    """Return gain [dB] and phase with error bars from the relative errors of both."""
    hz = omega / _TURN
    down = -_DB * np.log(np.maximum(1.0 - relative[0], 1e-2))
    reach = np.degrees(np.minimum(relative[1], np.pi))
    of_gain = bars(label, hz, gain, [down, _DB * np.log1p(relative[0])], color)
    return of_gain, bars(label, hz, degrees, reach, color)


def _coherence(omega: np.ndarray, coherence: np.ndarray) -> Panel:
    series = Series("", omega / _TURN, coherence, style.BLACK, width=0.9)
    return panel("coherence", [series], 0.8, limits=(0.0, 1.05), levels=(COHERENT,))


def bode_unit(model: Model, output: str, input: str) -> str:
    """Return `dB re rad/m`; only `dB` if a unit is missing or would need brackets."""
    out, into = naming.unit(model.Outputs, output), naming.unit(model.Inputs, input)
    if into == "1":
        return f"dB re {out}" if out and out != "1" else "dB"
    return f"dB re {out}/{into}" if out and into and "/" not in into else "dB"


def _last_of(omega: np.ndarray, coherence: np.ndarray, known: np.ndarray) -> float:
    """Return the last frequency of the axes [rad/s], that of a coherent bin."""
    mean = octave_mean(omega, coherence)
    for bins in (known & (mean >= BEYOND_CHANCE), known & (mean >= SEEN), known):
        if bins.any():
            return float(omega[np.flatnonzero(bins)[-1]])
    return float(omega[-1])


def _room(values: np.ndarray, margin: float, series: Sequence[Series]) -> tuple[float, float]:
    """Return limits that contain given values, or all series if there are none."""
    if not values.size:
        return limits_of(series)
    return float(np.min(values)) - margin, float(np.max(values)) + margin


def match(pair: FittedPair, unit: str, note: str, baseline: Baseline | None = None) -> Chart:
    """Draw gain, phase and partial coherence of data and model, their ratio, and the envelopes.

    Args:
        baseline: the recursive least squares of this input and output, as an additional curve.
    """
    omega, model = pair.omega, pair.model
    known = np.isfinite(pair.H) & (pair.sd < _WIDE_DATA * np.abs(pair.H))
    modelled = np.isfinite(model.log_gain) & np.isfinite(model.phase)
    near = phase(np.exp(1j * np.nan_to_num(model.phase)))
    gain_sd, phase_sd = np.nan_to_num(model.gain_sd), np.nan_to_num(model.phase_sd)
    f, H = omega[known], pair.H[known]
    own = pair.half95 * pair.sd[known] / np.abs(H)
    gain, angle = _DB * np.log(np.abs(H)), np.degrees(np.angle(H))
    if modelled.all():
        angle = _nearest(angle, near[known])
    data = _bars(f, gain, angle, (own, own), style.BLACK, "data, 95 % intervals")
    rls = []
    if baseline is not None:
        R = baseline_response(baseline, omega)
        turned = _nearest(np.degrees(np.angle(R)), near)
        rls = [c._replace(dashed=True) for c in _curve("RLS", omega, R, turned, style.ORANGE, 1.2)]
    # Incoherent bins do not set the axes.
    mean = octave_mean(omega, pair.coherence)
    rule = (np.minimum(pair.coherence, mean) >= BEYOND_CHANCE)[known]
    rule = rule if np.count_nonzero(rule) >= _FEW else np.ones_like(rule)
    hz, panels = omega / _TURN, []
    for k, (words, value, sd, ruling, height) in enumerate(
        (
            (f"gain [{unit}]", _DB * model.log_gain, _DB * gain_sd, gain[rule], 1.7),
            ("phase [deg]", near, np.degrees(phase_sd), angle[rule], 1.4),
        )
    ):
        x, v, reach = hz[modelled], value[modelled], Z95 * sd[modelled]
        fitted = Series("model", x, v, style.BLUE, width=1.4)
        series = [
            band(x, v - reach, v + reach, style.SKY),
            fitted,
            *rls[k : k + 1],
            data[k],
        ]
        limits = _room(ruling, _MARGINS[k], series)
        panels.append(panel(words, series, height, limits=limits))
    panels.append(_coherence(omega, pair.coherence))
    # The ratio of data and model has the random error and that of the parameters.
    both = modelled[known]
    error = H[both] / model.response[known & modelled]
    reach = [np.hypot(own[both], Z95 * sd[known & modelled]) for sd in (gain_sd, phase_sd)]
    off = _DB * np.log(np.abs(error)), np.degrees(np.angle(error))
    errors = _bars(f[both], *off, (reach[0], reach[1]), style.BLACK)
    envelope = unnoticeable(omega)
    for (low, high), points, most, words in zip(
        (envelope.gain_db, envelope.phase_deg), errors, _ERRORS, ("dB", "deg"), strict=True
    ):
        series = [band(hz, low, high, style.PALE), points]
        limits = (-most, most)
        panels.append(panel(f"error [{words}]", series, 1.05, limits=limits, levels=(0.0,)))
    limits = omega[0], _last_of(omega, pair.coherence, known)
    return _chart(f"{pair.input} to {pair.output}: model and data", note, limits, panels)


def draw_response(
    names: tuple[str, str],
    omega: np.ndarray,
    pair: Any,
    unit: str,
    note: str,
    averages: float,
    fits: Sequence[tuple[str, np.ndarray]] = (),
) -> Chart:
    """Draw a measured response: gain and phase with 95 % intervals, and coherence.

    Args:
        omega: (k,) [rad/s]
        pair: with H, sd and coherence, (k,) each, and half95 (`flight_responses.Pair`).
        fits: transfer functions, each a label and its response (k,).
    """
    known = np.isfinite(pair.H) & (pair.sd < _WIDE * np.abs(pair.H))
    if left_out := int(np.sum(~known)):
        note += f"; {left_out} of {omega.size} frequencies not drawn"
    seen = seen_of(omega, pair, averages)
    branch = branch_of(omega, pair.H, seen)
    relative = pair.half95 * pair.sd[known] / np.abs(pair.H[known])
    gain = _DB * np.log(np.abs(np.where(known, pair.H, 1.0)))
    error, words = (relative, relative), "95 % intervals"
    curves = [_bars(omega[known], gain[known], branch[known], error, style.BLUE, words)]
    colours = itertools.cycle((style.VERMILLION, style.GREEN, style.PURPLE))
    for (label, H), color in zip(fits, colours, strict=False):
        turned = phase(H)
        # The whole curve moves to one branch.
        apart = np.median((branch - turned)[seen]) if seen.any() else 0.0
        turned = turned + 360.0 * np.round(apart / 360.0)
        curves.append(_curve(label, omega, H, turned, color, 1.4))
    shown = seen if seen.any() else known
    of_gain, of_phase = ([c[k] for c in curves] for k in (0, 1))
    by_gain = _room(gain[shown], _MARGINS[0], of_gain)
    by_phase = _room(branch[shown], _MARGINS[1], of_phase)
    panels = (
        panel(f"gain [dB re {unit}]" if unit != "1" else "gain [dB]", of_gain, 1.9, limits=by_gain),
        panel("phase [deg]", of_phase, 1.6, limits=by_phase),
        _coherence(omega, pair.coherence),
    )
    limits = omega[0], _last_of(omega, pair.coherence, known)
    return _chart(f"{names[0]} to {names[1]}: measured response", note, limits, panels)


def seen_of(omega: np.ndarray, pair: Any, averages: float) -> np.ndarray:
    """Return a mask (k,) of the frequencies that set the branch of the phase."""
    known = np.isfinite(pair.H) & (pair.sd < _WIDE * np.abs(pair.H))
    least = min(max(SEEN, _BY_CHANCE / averages), COHERENT)
    return known & (octave_mean(omega, pair.coherence) >= least)


def branch_of(omega: np.ndarray, H: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Return the phase (k,) [deg] on the branch of the nearest usable frequencies.

    Args:
        omega: (k,) [rad/s]
        H: (k,) complex; NaN stays NaN.
        seen: (k,) bool, usable frequencies; if there are none, the phase is within half a turn of
            zero.
    """
    along = np.zeros(omega.size)
    if seen.any():
        along = np.interp(np.log(omega), np.log(omega[seen]), phase(H[seen]))
    return _nearest(np.degrees(np.angle(H)), along)
