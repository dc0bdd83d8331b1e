"""Bode figures: model beside data, and a measured response.

Frequencies are in Hz, as in configurations. A phase lies on the branch nearest to that of the
smoothest curve.
"""

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np

from heli_jax.analysis.response_curves import unnoticeable
from heli_jax.analysis.spectra import COHERENT, octave_mean
from heli_jax.identification.equation_error.rls import Baseline
from heli_jax.identification.identifiability.verdict import Z95
from heli_jax.report import style
from heli_jax.report.charts import Chart, Panel, Series, band, bars, limits_of, panel
from heli_jax.report.fitted_responses import FittedPair

_TURN = 2.0 * np.pi
"""rad/s of 1 Hz."""
_DB = 20.0 / np.log(10.0)
SEEN, BEYOND_CHANCE = 0.1, 0.3
"""Mean coherence over an octave below which it is chance, and above which it is not; the axes hold
the bins above the second."""
_WIDE, _WIDE_DATA = 1.0, 0.5
"""Relative random error above which a measured response, and one beside a model, is not drawn."""
_BY_CHANCE = 2.0
"""Least product of mean coherence over an octave and number of averages, for a bin that sets the
phase branch."""
_MARGINS = (6.0, 45.0)
"""Margins of the axes [dB, deg]."""
_ERRORS = (12.0, 90.0)
"""Half range of the error panels [dB, deg]."""


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
    gain = np.where(good, _decibels(np.where(good, H, 1.0)), np.nan)
    hz, degrees = omega / _TURN, np.where(good, degrees, np.nan)
    of_gain = Series(label, hz, gain, color, width=width)
    return of_gain, of_gain._replace(y=degrees)


def _decibels(H: np.ndarray) -> np.ndarray:
    return _DB * np.log(np.abs(H))


def _bars(
    omega: np.ndarray,
    H: np.ndarray,
    degrees: np.ndarray,
    relative: tuple[np.ndarray, np.ndarray],
    color: str,
    label: str = "",
) -> tuple[Series, Series]:
    """Return gain [dB] and phase with error bars from the relative errors of both."""
    hz = omega / _TURN
    down = -_DB * np.log(np.maximum(1.0 - relative[0], 1e-2))
    reach = np.degrees(np.minimum(relative[1], np.pi))
    of_gain = bars(label, hz, _decibels(H), [down, _DB * np.log1p(relative[0])], color)
    return of_gain, bars(label, hz, degrees, reach, color)


def _bode(
    heading: tuple[str, str],
    unit: str,
    at: tuple[np.ndarray, np.ndarray, np.ndarray],
    values: tuple[np.ndarray, np.ndarray],
    series: Sequence[Sequence[Series]],
    further: Sequence[Panel] = (),
) -> Chart:
    """Return gain, phase and coherence over frequency; coherent bins set the axes.

    Args:
        heading: title and note.
        at: frequencies [rad/s], coherence, and True for known bins; (k,) each.
        values: measured gain [dB] and phase [deg], (k,).
        series: series of gain and phase, in pairs.
        further: panels below.
    """
    omega, coherence, known = at
    mean = octave_mean(omega, coherence)
    coherent = (known & (mean >= least) for least in (BEYOND_CHANCE, SEEN))
    shown = next((bins for bins in coherent if bins.any()), known)
    gain_label = f"gain [dB re {unit}]" if unit not in ("", "1") else "gain [dB]"
    looks = ((gain_label, 1.7), ("phase [deg]", 1.4))
    panels = []
    for (label, height), v, margin, lines in zip(
        looks, values, _MARGINS, zip(*series, strict=True), strict=True
    ):
        limits = limits_of(lines)
        if shown.any():
            limits = float(np.min(v[shown])) - margin, float(np.max(v[shown])) + margin
        panels.append(panel(label, lines, height, limits=limits))
    line = Series("", omega / _TURN, coherence, style.BLACK, width=0.9)
    panels.append(panel("coherence", [line], 0.8, limits=(0.0, 1.05), levels=(COHERENT,)))
    last = omega[shown][-1] if shown.any() else omega[-1]
    hz = float(omega[0]) / _TURN, float(last) / _TURN
    panels = (*panels, *further)
    return Chart(heading[0], "frequency [Hz]", hz, panels, heading[1], logarithmic=True)


def quotient(output: str | None, input: str | None) -> str:
    """Return the unit of output over input; empty if one is unknown."""
    if output is None or input is None:
        return ""
    if input == "1":
        return output
    return f"{output}/({input})" if "/" in input else f"{output}/{input}"


def _known(pair: Any, widest: float) -> np.ndarray:
    return np.isfinite(pair.H) & (pair.sd < widest * np.abs(pair.H))


def match(pair: FittedPair, unit: str, note: str, baseline: Baseline | None = None) -> Chart:
    """Draw gain, phase and partial coherence of data and model, their ratio, and the envelopes.

    Args:
        baseline: the recursive least squares of this input and output, as an additional curve.
    """
    omega, model, known = pair.omega, pair.model, _known(pair, _WIDE_DATA)
    modelled = np.isfinite(model.log_gain) & np.isfinite(model.phase)
    near = phase(np.exp(1j * np.nan_to_num(model.phase)))
    gain_sd, phase_sd = np.nan_to_num(model.gain_sd), np.nan_to_num(model.phase_sd)
    H, own = pair.H, pair.half95 * pair.sd[known] / np.abs(pair.H[known])
    angle = np.degrees(np.angle(H))
    if modelled.all():
        angle = _nearest(angle, near)
    hz = omega[modelled] / _TURN
    edges, lines = [], []
    for value, sd in ((_DB * model.log_gain, _DB * gain_sd), (near, np.degrees(phase_sd))):
        v, reach = value[modelled], Z95 * sd[modelled]
        edges.append(band(hz, v - reach, v + reach, style.SKY))
        lines.append(Series("model", hz, v, style.BLUE, width=1.4))
    series: list[Sequence[Series]] = [edges, lines]
    if baseline is not None:
        R = baseline_response(baseline, omega)
        turned = _nearest(np.degrees(np.angle(R)), near)
        curve = _curve("RLS", omega, R, turned, style.ORANGE, 1.2)
        series.append([c._replace(dashed=True) for c in curve])
    words = "data, 95 % intervals"
    series.append(_bars(omega[known], H[known], angle[known], (own, own), style.BLACK, words))
    # The ratio of data and model has the random error and that of the parameters.
    both = known & modelled
    error = H[both] / model.response[both]
    reach = [np.hypot(own[modelled[known]], Z95 * sd[both]) for sd in (gain_sd, phase_sd)]
    degrees = np.degrees(np.angle(error))
    errors = _bars(omega[both], error, degrees, (reach[0], reach[1]), style.BLACK)
    envelope, further = unnoticeable(omega), []
    for (low, high), points, most, words in zip(
        (envelope.gain_db, envelope.phase_deg), errors, _ERRORS, ("dB", "deg"), strict=True
    ):
        drawn = [band(omega / _TURN, low, high, style.PALE), points]
        limits = (-most, most)
        further.append(panel(f"error [{words}]", drawn, 1.05, limits=limits, levels=(0.0,)))
    heading = f"{pair.input} to {pair.output}: model and data", note
    with np.errstate(all="ignore"):
        values = _decibels(H), angle
    return _bode(heading, unit, (omega, pair.coherence, known), values, series, further)


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
    known = _known(pair, _WIDE)
    if left_out := int(np.sum(~known)):
        note += f"; {left_out} of {omega.size} frequencies not drawn"
    seen = seen_of(omega, pair, averages)
    branch, H = branch_of(omega, pair.H, seen), pair.H[known]
    relative = pair.half95 * pair.sd[known] / np.abs(H)
    error, words = (relative, relative), "95 % intervals"
    series = [_bars(omega[known], H, branch[known], error, style.BLUE, words)]
    colours = itertools.cycle((style.VERMILLION, style.GREEN, style.PURPLE))
    for (label, fitted), color in zip(fits, colours, strict=False):
        turned = phase(fitted)
        # The whole curve moves to one branch.
        apart = np.median((branch - turned)[seen]) if seen.any() else 0.0
        turned = turned + 360.0 * np.round(apart / 360.0)
        series.append(_curve(label, omega, fitted, turned, color, 1.4))
    heading = f"{names[0]} to {names[1]}: measured response", note
    values = _decibels(np.where(known, pair.H, 1.0)), branch
    return _bode(heading, unit, (omega, pair.coherence, known), values, series)


def seen_of(omega: np.ndarray, pair: Any, averages: float) -> np.ndarray:
    """Return a mask (k,) of the frequencies that set the branch of the phase."""
    least = min(max(SEEN, _BY_CHANCE / averages), COHERENT)
    return _known(pair, _WIDE) & (octave_mean(omega, pair.coherence) >= least)


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
