"""Bode figures: a fit beside its record, model beside data, a measured response, several runs.

Frequencies are in Hz, as configurations have bands; a phase lies on the branch nearest to that of
the smoothest curve.
"""

import itertools
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from heli_jax import naming
from heli_jax.analysis.operating_point import OperatingPoint
from heli_jax.analysis.response_curves import unnoticeable
from heli_jax.analysis.spectra import COHERENT, octave_mean
from heli_jax.dynamics.model import Model
from heli_jax.identification.equation_error.rls import Baseline
from heli_jax.identification.identifiability.verdict import Z95
from heli_jax.identification.result import Signals
from heli_jax.report import frequency, style
from heli_jax.report.fitted_responses import FittedPair
from heli_jax.report.frequency import FittedFlight, phase, sample_time
from heli_jax.report.style import Panels, legend_above, line, panels, subtitle

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_TURN = 2.0 * np.pi
"""rad/s of 1 Hz"""
_DB = 20.0 / np.log(10.0)
_CONTINUOUS, _RLS = "fit, continuous", "RLS"
_NYQUIST = "_nyquist"
"""a label with an underscore before it: matplotlib leaves it out of the legend"""
SEEN, BEYOND_CHANCE = 0.1, 0.3
"""mean coherence over an octave: below the first it is chance, the second is hardly made by it, of
three or four averages either, and up to the last such bin frequencies are drawn"""
_WIDE, _WIDE_DATA = 1.0, 0.5
"""relative random error of a measured response, and of one beside a model, past which a bin says
little, and is not drawn"""
_BY_CHANCE = 2.0
"""Bins neither set the axes nor tell the phase's branch below a mean coherence over an octave of
SEEN, nor of this times what chance makes of it, one over the number of averages."""
_MARGINS = (6.0, 45.0)
"""dB and deg beyond what sets the axes"""
_ERRORS = (12.0, 90.0)
"""dB and deg that the panels of the error show at most to either side"""
_FEW, _HUGE = 3, 1e9
"""bins that make a curve, or the axes' limits, at least; what no output of a machine reaches"""


def bode(flight: FittedFlight, baseline: Baseline | None) -> Panels:
    """Magnitude and phase of the fit, of the RLS and of the record, and the record's coherence.

    The fit is drawn twice: sampled with its input held, as a record can show it and as the RLS
    is, and thin as the continuous H(i omega). An estimated gain and time shift are included.

    Args:
        baseline: the RLS, whose input and output are taken; the first ones without it.
    """
    model, signals, dt = flight.model, flight.signals, sample_time(flight.signals)
    output = baseline.output if baseline else next(iter(signals.measured))
    input = baseline.input if baseline else next(iter(signals.inputs))
    nyquist = np.pi / dt
    # From two periods in the record, below which it shows nothing, to a little beyond Nyquist,
    # where the continuous response goes on and the sampled one does not.
    limits = 4 * np.pi / (dt * max(signals.times.size, 8)), 1.6 * nyquist
    at = frequency.at_record(flight)
    memory = frequency.memory(model, flight.params, at, dt * signals.times.size)
    record = frequency.empirical(signals.inputs[input], signals.measured[output], dt, memory)
    known = isinstance(record, frequency.Empirical)
    axes = _axes(6.0 if known else 4.6, [1.4, 1.2, 0.6] if known else [1.2, 1.0])
    reference = _draw_fit(axes, flight, (output, input), at, limits)
    if baseline is not None:
        below = frequency.log_grid(limits[0], 0.999 * nyquist)
        H = frequency.discrete(baseline, below)
        look: dict[str, Any] = {"color": style.ORANGE, "lw": 1.5, "ls": (0, (4, 2)), "label": _RLS}
        _curve(axes, below, H, reference.along(below, H), **look)
    note = _draw_record(axes, reference, record)
    others_move = any(np.ptp(u) > 0 for n, u in signals.inputs.items() if n != input)
    # H = Suy / Suu is that of this input alone only where the others are uncorrelated with it.
    note += "; other inputs taken as uncorrelated" if known and others_move else ""
    if not reference.finite:
        note = f"the model cannot be linearised about {at.words or 'zero'}; {note}"
    elif at.words:
        note = f"linearised about {at.words}; {note}"
    for ax in axes:
        ax.axvline(nyquist / _TURN, color=style.GREY, lw=0.9, ls="-.", label=_NYQUIST)
    words: dict[str, Any] = {"ha": "right", "fontsize": 8, "color": style.GREY}
    place = (nyquist / _TURN, 0.03)
    axes[0].annotate("Nyquist ", place, xycoords=("data", "axes fraction"), **words)
    _finish(axes, limits, f"{input} to {output}: frequency response", note)
    axes[0].set_ylim(*_within(axes[0], 40.0))
    axes[1].set_ylim(*_within(axes[1], 180.0))
    axes[0].set_ylabel(f"magnitude [{bode_unit(model, output, input)}]")
    return axes


def _axes(height: float, ratios: list[float]) -> Panels:
    """Panels with one row more above them than other figures have: title, subtitle and a legend of
    four entries are too long to stand beside each other."""
    return panels(height + style.ROW, ratios, top=style.TOP + style.ROW)


def _finish(axes: Panels, limits: Sequence[float], title: str, note: str) -> None:
    """Scales, ticks and words; limits in rad/s."""
    axes[0].set_xscale("log")
    axes[0].set_xlim(limits[0] / _TURN, limits[-1] / _TURN)
    style.plain_log_ticks(axes[0])
    style.phase_ticks(axes[1])
    axes[1].set_ylabel("phase [deg]")
    axes[-1].set_xlabel("frequency [Hz]")
    axes[0].set_title(title, loc="left")
    legend_above(axes[0])
    if note:
        subtitle(axes[0], note, raised=True)


class _Reference:
    """The continuous response of the fit: the phase that the other curves are laid beside."""

    def __init__(self, omega: np.ndarray, H: np.ndarray) -> None:
        self.finite = bool(np.isfinite(H).any())
        good = np.isfinite(H) & (np.abs(H) > 0)
        # Where the response is zero or not finite it has no phase.
        self.log_omega, self.phase = np.log(omega[good]), phase(H[good])

    def beside(self, omega: np.ndarray, H: np.ndarray) -> np.ndarray:
        """Phase [deg] of H, on the branch nearest to the reference's: point by point."""
        angle = np.degrees(np.angle(H))
        if not self.log_omega.size:
            return angle
        return _nearest(angle, np.interp(np.log(omega), self.log_omega, self.phase))

    def along(self, omega: np.ndarray, H: np.ndarray) -> np.ndarray:
        """The same for a curve: unwrapped, as a whole on the reference's branch."""
        good = np.isfinite(H)
        unwrapped = np.full(H.shape, np.nan)
        unwrapped[good] = np.degrees(np.unwrap(np.angle(H[good])))
        if not good.any():
            return unwrapped
        # The median, for point by point a curve half a turn away would jump between two branches.
        off = np.median(unwrapped[good] - self.beside(omega[good], H[good]))
        return unwrapped - 360.0 * np.round(off / 360.0)


def _nearest(degrees: np.ndarray, along: np.ndarray) -> np.ndarray:
    """Phases on the branch within half a turn of others."""
    return degrees - 360.0 * np.round((degrees - along) / 360.0)


def _curve(
    axes: Panels, omega: np.ndarray, H: np.ndarray, degrees: np.ndarray, **line_style: Any
) -> None:
    # A zero of the response has no decibels and no phase; a NaN breaks the line.
    good = np.isfinite(H) & (np.abs(H) > 0)
    gain = np.where(good, _DB * np.log(np.where(good, np.abs(H), 1.0)), np.nan)
    axes[0].plot(omega / _TURN, gain, **line_style)
    axes[1].plot(omega / _TURN, np.where(good, degrees, np.nan), **line_style)


def _bars(
    axes: Panels,
    omega: np.ndarray,
    gain: np.ndarray,
    degrees: np.ndarray,
    relative: tuple[np.ndarray, np.ndarray],
    color: str,
    label: str | None = None,
) -> None:
    """Gain [dB] and phase with error bars, by the relative errors of the two."""
    hz = omega / _TURN
    # Where the error is large the two ends of the gain are not as far away in decibels.
    down = -_DB * np.log(np.maximum(1.0 - relative[0], 1e-2))
    style.bars(axes[0], hz, gain, [down, _DB * np.log1p(relative[0])], color=color, label=label)
    reach = np.degrees(np.minimum(relative[1], np.pi))
    style.bars(axes[1], hz, degrees, reach, color=color, label=label)


def _coherence(ax: "Axes", omega: np.ndarray, coherence: np.ndarray) -> None:
    line(ax, omega / _TURN, coherence, color=style.BLACK, lw=0.9)
    ax.axhline(COHERENT, color=style.VERMILLION, lw=0.8, ls=":")
    ax.set_ylim(0.0, 1.05)
    ax.set_ylabel("coherence")


def _draw_fit(
    axes: Panels,
    flight: FittedFlight,
    pair: tuple[str, str],
    at: OperatingPoint,
    limits: tuple[float, float],
) -> _Reference:
    """The fit's continuous and sampled response from pair's input to its output."""
    output, input = pair
    dt = sample_time(flight.signals)
    continuous, sampled = frequency.responses(flight.model, flight.params, output, input, dt, at)
    # Short of the Nyquist frequency: sampling puts a zero at or near z = -1 where the relative
    # degree is two, and decibels have no floor.
    omega, below = frequency.log_grid(*limits), frequency.log_grid(limits[0], 0.999 * np.pi / dt)
    H = continuous(omega) * frequency.nuisance_factor(flight.fit, input, omega)
    held = sampled(below) * frequency.nuisance_factor(flight.fit, input, below)
    reference = _Reference(omega, H)
    _curve(axes, omega, H, reference.along(omega, H), color=style.SKY, lw=1.0, label=_CONTINUOUS)
    look: dict[str, Any] = {"color": style.BLUE, "lw": 1.6, "label": "fit, sampled"}
    _curve(axes, below, held, reference.along(below, held), **look)
    return reference


def _draw_record(axes: Panels, reference: _Reference, record: frequency.Empirical | str) -> str:
    """The record's own response where it is coherent; what to say of it."""
    if isinstance(record, str):
        return f"no empirical response: {record}"
    coherent = record.coherence > COHERENT
    omega, H = record.omega[coherent], record.H[coherent]
    # Behind the curves: many points would hide a fit that goes through them.
    points: dict[str, Any] = {"ls": "", "marker": "o", "ms": 2.2, "mew": 0, "color": style.BLACK}
    points |= {"alpha": 0.6, "zorder": 1.5, "label": "record" if coherent.any() else None}
    _curve(axes, omega, H, reference.beside(omega, H), **points)
    _coherence(axes[2], record.omega, record.coherence)
    if not coherent.any():
        return f"no empirical response: coherence stays below {COHERENT}"
    # Short: with the operating point before it, the note must fit the figure's width.
    note = f"record: {record.segments} segments, coherence > {COHERENT}"
    return note + (f", from {record.lowest / _TURN:.2g} Hz" if record.lowest else "")


def bode_unit(model: Model, output: str, input: str) -> str:
    """`dB re rad/m`; plain dB where a unit is missing, or is a quotient and would need brackets."""
    out, into = naming.unit(model.Outputs, output), naming.unit(model.Inputs, input)
    if into == "1":
        return f"dB re {out}" if out and out != "1" else "dB"
    return f"dB re {out}/{into}" if out and into and "/" not in into else "dB"


def _within(ax: "Axes", beyond: float) -> tuple[float, float]:
    """Limits that hold what can be seen of fit and record, and the rest no more than `beyond`
    further: the RLS, and the continuous fit past the Nyquist frequency."""
    # Poles and zeros of the RLS near the unit circle would else press the fit flat. The Nyquist
    # line is left out as well: its y are parts of the axes, not data.
    left_out = (_RLS, _CONTINUOUS, _NYQUIST)
    curves = [c for c in ax.get_lines() if c.get_label() not in left_out]
    y = np.concatenate([np.asarray(c.get_ydata(), float) for c in curves] or [np.zeros(1)])
    y, (low, high) = y[np.isfinite(y)], ax.get_ylim()
    if not y.size:
        return low, high
    return max(low, float(y.min()) - beyond), min(high, float(y.max()) + beyond)


def _last_of(omega: np.ndarray, coherence: np.ndarray, known: np.ndarray) -> float:
    """The last frequency that the axes hold [rad/s].

    Single bins are coherent by chance up to the end of the band, far above what was excited.
    """
    mean = octave_mean(omega, coherence)
    for bins in (known & (mean >= BEYOND_CHANCE), known & (mean >= SEEN), known):
        if bins.any():
            return float(omega[np.flatnonzero(bins)[-1]])
    return float(omega[-1])


def _limit(axes: Panels, gain: np.ndarray, degrees: np.ndarray) -> None:
    for ax, values, margin in zip(axes[:2], (gain, degrees), _MARGINS, strict=True):
        if values.size:
            ax.set_ylim(float(np.min(values)) - margin, float(np.max(values)) + margin)


def match(pair: FittedPair, unit: str, note: str) -> Panels:
    """Gain, phase and partial coherence of data and model, and their quotient, all with 95 %
    intervals; the quotient within the envelopes of what pilots do not notice.
    """
    axes = _axes(8.4, [1.4, 1.2, 0.6, 0.9, 0.9])
    omega, model = pair.omega, pair.model
    known = np.isfinite(pair.H) & (pair.sd < _WIDE_DATA * np.abs(pair.H))
    modelled = np.isfinite(model.log_gain) & np.isfinite(model.phase)
    near = phase(np.exp(1j * np.nan_to_num(model.phase)))
    gain_sd, phase_sd = np.nan_to_num(model.gain_sd), np.nan_to_num(model.phase_sd)
    for ax, value, sd in (
        (axes[0], _DB * model.log_gain, _DB * gain_sd),
        (axes[1], near, np.degrees(phase_sd)),
    ):
        low, high = (value + sign * Z95 * sd for sign in (-1.0, 1.0))
        hz = omega[modelled] / _TURN
        ax.plot(hz, value[modelled], color=style.BLUE, lw=1.4, label="model")
        band: dict[str, Any] = {"color": style.SKY, "alpha": 0.5, "lw": 0}
        ax.fill_between(hz, low[modelled], high[modelled], **band)
    f, H = omega[known], pair.H[known]
    own = pair.half95 * pair.sd[known] / np.abs(H)
    gain, angle = _DB * np.log(np.abs(H)), np.degrees(np.angle(H))
    if modelled.all():
        # Beside the model: point by point, since data may have gaps.
        angle = _nearest(angle, near[known])
    _bars(axes, f, gain, angle, (own, own), style.BLACK, "data, 95 % intervals")
    # What a bin without coherence says is mostly noise over a stick that hardly moved: it is drawn
    # where there is room, and makes none. In gusts a response has a coherence of 0.3 to 0.6, and
    # intervals that are read: such bins have to be within the axes.
    mean = octave_mean(omega, pair.coherence)
    rule = (np.minimum(pair.coherence, mean) >= BEYOND_CHANCE)[known]
    rule = rule if np.count_nonzero(rule) >= _FEW else np.ones_like(rule)
    _limit(axes, gain[rule], angle[rule])
    _coherence(axes[2], omega, pair.coherence)
    # Data over model: the data's error is the random one, the model's that of its parameters.
    envelope = unnoticeable(omega)
    for ax, (low, high), most in zip(
        axes[3:], (envelope.gain_db, envelope.phase_deg), _ERRORS, strict=True
    ):
        ax.fill_between(omega / _TURN, low, high, color=style.PALE, alpha=0.3, lw=0)
        ax.axhline(0.0, color=style.BLUE, lw=1.0)
        ax.set_ylim(-most, most)
    both = modelled[known]
    error = H[both] / model.response[known & modelled]
    reach = [np.hypot(own[both], Z95 * sd[known & modelled]) for sd in (gain_sd, phase_sd)]
    off = _DB * np.log(np.abs(error)), np.degrees(np.angle(error))
    _bars(axes[3:], f[both], *off, (reach[0], reach[1]), style.BLACK)
    axes[3].set_ylabel("error [dB]")
    axes[4].set_ylabel("error [deg]")
    axes[0].set_ylabel(f"gain [{unit}]")
    limits = omega[0], _last_of(omega, pair.coherence, known)
    _finish(axes, limits, f"{pair.input} to {pair.output}: model and data", note)
    return axes


def draw_response(
    names: tuple[str, str],
    omega: np.ndarray,
    pair: Any,
    unit: str,
    note: str,
    averages: float,
    fits: Sequence[tuple[str, np.ndarray]] = (),
) -> Panels:
    """A measured response: gain and phase with 95 % intervals, and coherence.

    Args:
        omega: (k,) [rad/s]
        pair: with H, sd and coherence, (k,) each, and half95 (`flight_responses.Pair`).
        fits: transfer functions, each a label and its response (k,).
    """
    known = np.isfinite(pair.H) & (pair.sd < _WIDE * np.abs(pair.H))
    if left_out := int(np.sum(~known)):
        note += f"; {left_out} of {omega.size} frequencies not drawn"
    axes = _axes(6.0, [1.4, 1.2, 0.6])
    seen = seen_of(omega, pair, averages)
    branch = branch_of(omega, pair.H, seen)
    relative = pair.half95 * pair.sd[known] / np.abs(pair.H[known])
    gain = _DB * np.log(np.abs(np.where(known, pair.H, 1.0)))
    error = (relative, relative)
    words = "95 % intervals"
    _bars(axes, omega[known], gain[known], branch[known], error, style.BLUE, words)
    shown = seen if seen.any() else known
    _limit(axes, gain[shown], branch[shown])
    colours = itertools.cycle((style.VERMILLION, style.GREEN, style.PURPLE))
    for (label, H), color in zip(fits, colours, strict=False):
        turned = phase(H)
        # As a whole: a transfer function is smooth, and its own phase tells its turns.
        apart = np.median((branch - turned)[seen]) if seen.any() else 0.0
        turned = turned + 360.0 * np.round(apart / 360.0)
        _curve(axes, omega, H, turned, color=color, lw=1.4, label=label)
    _coherence(axes[2], omega, pair.coherence)
    axes[0].set_ylabel(f"gain [dB re {unit}]" if unit != "1" else "gain [dB]")
    limits = omega[0], _last_of(omega, pair.coherence, known)
    _finish(axes, limits, f"{names[0]} to {names[1]}: measured response", note)
    return axes


def seen_of(omega: np.ndarray, pair: Any, averages: float) -> np.ndarray:
    """The frequencies (k,) that tell the branch of the phase."""
    known = np.isfinite(pair.H) & (pair.sd < _WIDE * np.abs(pair.H))
    # Of few averages chance makes much, but what passes for coherent is no chance.
    least = min(max(SEEN, _BY_CHANCE / averages), COHERENT)
    return known & (octave_mean(omega, pair.coherence) >= least)


def branch_of(omega: np.ndarray, H: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """The phase (k,) [deg] at every frequency, on the branch of the nearest that are seen.

    Unwrapped through noise it would turn by chance, and through a missing bin be lost.

    Args:
        omega: (k,) [rad/s]
        H: (k,) complex; NaN stays NaN.
        seen: (k,) bool; with none of them the phase is within half a turn of zero.
    """
    along = np.zeros(omega.size)
    if seen.any():
        along = np.interp(np.log(omega), np.log(omega[seen]), phase(H[seen]))
    return _nearest(np.degrees(np.angle(H)), along)


OVERLAY_WORDS = (
    "By the spectra of the record's input with the measured and with each simulated output, in the "
    f"same segments, where coherence is above {COHERENT}: what leakage and other inputs do to one "
    "they do to all."
)


def bode_overlay(
    by_run: Sequence[tuple[str, Signals]], flight: str, output: str, input: str
) -> Panels:
    """Gain and phase from an input to the measured output and to each run's simulated one.

    () where no run's simulated output has a coherent response to the input.
    """
    with_input = [(label, s) for label, s in by_run if input in s.inputs]
    simulated = [(label, _coherent(s, input, s.simulated[output])) for label, s in with_input]
    if all(response is None for _, response in simulated):
        return ()
    first = with_input[0][1]
    measured = ("measured", _coherent(first, input, first.measured[output]))
    axes = panels(4.0, [1.2, 1.0])
    dots = {"ls": "", "marker": "o", "ms": 2.6, "mew": 0, "color": style.GREY}
    looks = [dots, *({"color": c, "lw": 1.2} for c in itertools.islice(
        itertools.cycle(style.CYCLE), len(simulated)))]  # fmt: skip
    for (label, response), look in zip([measured, *simulated], looks, strict=True):
        if response is not None:
            _curve(axes, response.omega, response.H, phase(response.H), label=label, **look)
    axes[0].set_ylabel("magnitude [dB]")
    omega = np.concatenate([r.omega for _, r in simulated if r is not None])
    limits = omega.min(), omega.max()
    _finish(axes, limits, f"{input} to {output}, {style.short(flight)}", "")
    return axes


def _coherent(s: Signals, input: str, y: np.ndarray) -> frequency.Empirical | None:
    """Where it is coherent; None where that is nowhere, samples are missing or y diverges."""
    if not (np.isfinite(y).all() and np.max(np.abs(y)) < _HUGE):
        return None
    # The memory of zero: how long a machine remembers is not known here, and all have the same
    # segments.
    record = frequency.empirical(s.inputs[input], y, sample_time(s), 0.0)
    if isinstance(record, str):
        return None
    good = (record.coherence > COHERENT) & (np.abs(record.H) > 0)
    if good.sum() < _FEW:
        return None
    return record._replace(omega=record.omega[good], H=record.H[good])
