"""The Bode figure: fit, recursive least squares and the record's own response."""

from typing import TYPE_CHECKING, Any

import numpy as np

from heli_jax import naming
from heli_jax.analysis.operating_point import OperatingPoint
from heli_jax.analysis.response_curves import COHERENT
from heli_jax.dynamics.model import Model
from heli_jax.identification.equation_error.baseline import Baseline
from heli_jax.identification.result import Signals
from heli_jax.report import frequency, style
from heli_jax.report.figures.panels import Panels, panels, sample_time
from heli_jax.report.frequency import FittedFlight
from heli_jax.report.style import legend_above, line, subtitle

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_CONTINUOUS = "fit, continuous"
_RLS = "RLS"
_TURN = 2.0 * np.pi
"""rad/s of 1 Hz, in which figures have frequencies, as configurations have bands"""
_NYQUIST = "_nyquist"
"""a label with an underscore before it: matplotlib leaves it out of the legend"""


def bode(
    flight: FittedFlight,
    baseline: Baseline | None,
    *,
    output: str | None = None,
    input: str | None = None,
    figure: "Figure | None" = None,
) -> Panels:
    """Magnitude and phase of the fit, of the RLS and of the record, and the record's coherence.

    The fit is drawn twice: sampled with its input held, as a record can show it and as the RLS
    is, and thin as the continuous H(i omega). An estimated gain and time shift are included.

    Args:
        flight: the fitted model at one flight.
        baseline: the RLS; drawn where it has the same input and output.
        output: that of the baseline, or the first one, unless given.
        input: likewise.
        figure: to draw on; a new one where None.
    """
    model, signals = flight.model, flight.signals
    output = output or (baseline.output if baseline else next(iter(signals.measured)))
    input = input or (baseline.input if baseline else next(iter(signals.inputs)))
    dt = sample_time(signals)
    nyquist = np.pi / dt
    # From two periods in the record, below which it shows nothing, to a little beyond Nyquist,
    # where the continuous response goes on and the sampled one does not.
    limits = 4 * np.pi / (dt * max(signals.times.size, 8)), 1.6 * nyquist
    at = frequency.at_record(flight)
    memory = frequency.memory(model, flight.params, at, dt * signals.times.size)
    record = frequency.empirical(signals.inputs[input], signals.measured[output], dt, memory)
    axes = _bode_panels(figure, with_coherence=isinstance(record, frequency.Empirical))
    axes[0].set_title(f"{input} to {output}: frequency response", loc="left")
    reference = _draw_fit(axes, flight, (output, input), at, limits)
    if baseline is not None and (baseline.output, baseline.input) == (output, input):
        below = frequency.log_grid(limits[0], 0.999 * nyquist)
        _curve(axes, reference, below, frequency.discrete(baseline, below),
               color=style.ORANGE, lw=1.5, ls=(0, (4, 2)), label=_RLS)  # fmt: skip
    note = _draw_record(axes, reference, record, _others_move(signals, input))
    if not reference.finite:
        note = f"the model cannot be linearised about {at.words or 'zero'}; {note}"
    elif at.words:
        note = f"linearised about {at.words}; {note}"
    _finish_bode(axes, nyquist, limits, bode_unit(model, output, input), note)
    return axes


def _bode_panels(figure: "Figure | None", *, with_coherence: bool) -> Panels:
    """With one row more above them than other figures have: title, subtitle and a legend of four
    entries are too long to stand beside each other."""
    height, ratios = (6.0, [1.4, 1.2, 0.6]) if with_coherence else (4.6, [1.2, 1.0])
    return panels(figure, height + style.ROW, ratios, top=style.TOP + style.ROW)


class _Reference:
    """The continuous response of the fit: the phase that the other curves are laid beside."""

    def __init__(self, omega: np.ndarray, H: np.ndarray) -> None:
        self.finite = bool(np.isfinite(H).any())
        good = np.isfinite(H) & (np.abs(H) > 0)
        # Where the response is zero or not finite it has no phase.
        self.log_omega, self.phase = np.log(omega[good]), frequency.phase(H[good])

    def beside(self, omega: np.ndarray, H: np.ndarray) -> np.ndarray:
        """Phase [deg] of H, on the branch nearest to the reference's: point by point."""
        if not self.log_omega.size:
            return np.degrees(np.angle(H))
        near = np.interp(np.log(omega), self.log_omega, self.phase)
        return near + (np.degrees(np.angle(H)) - near + 180.0) % 360.0 - 180.0

    def along(self, omega: np.ndarray, H: np.ndarray) -> np.ndarray:
        """The same for a curve: unwrapped, as a whole on the reference's branch."""
        unwrapped = np.degrees(np.unwrap(np.angle(H)))
        if not unwrapped.size:
            return unwrapped
        # The median, for point by point a curve half a turn away would jump between two branches.
        off = np.median(unwrapped - self.beside(omega, H))
        return unwrapped - 360.0 * np.round(off / 360.0)


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
    _curve(axes, reference, omega, H, color=style.SKY, lw=1.0, label=_CONTINUOUS)
    _curve(axes, reference, below, held, color=style.BLUE, lw=1.6, label="fit, sampled")
    return reference


def _curve(
    axes: Panels, reference: _Reference, omega: np.ndarray, H: np.ndarray, **line_style: Any
) -> None:
    # A zero of the response has no decibels and no phase.
    good = np.isfinite(H) & (np.abs(H) > 0)
    axes[0].plot(omega[good] / _TURN, 20 * np.log10(np.abs(H[good])), **line_style)
    axes[1].plot(omega[good] / _TURN, reference.along(omega[good], H[good]), **line_style)


def _others_move(signals: Signals, input: str) -> bool:
    return any(np.std(u) > 0 for n, u in signals.inputs.items() if n != input)


def _draw_record(
    axes: Panels, reference: _Reference, record: frequency.Empirical | str, others_move: bool
) -> str:
    """The record's own response where it is coherent; what to say of it."""
    if isinstance(record, str):
        return f"no empirical response: {record}"
    coherent = record.coherence > COHERENT
    omega, H = record.omega[coherent], record.H[coherent]
    points: dict[str, Any] = {"ls": "", "marker": "o", "ms": 2.2, "mew": 0, "color": style.BLACK}
    name = "record" if coherent.any() else None
    # Behind the curves: many points would hide a fit that goes through them.
    axes[0].plot(
        omega / _TURN, 20 * np.log10(np.abs(H)), alpha=0.6, label=name, zorder=1.5, **points
    )
    axes[1].plot(
        omega / _TURN, reference.beside(omega, H), alpha=0.6, label=name, zorder=1.5, **points
    )
    line(axes[2], record.omega / _TURN, record.coherence, color=style.BLACK, lw=0.8)
    axes[2].axhline(COHERENT, color=style.VERMILLION, lw=0.8, ls=":")
    axes[2].set_ylim(0.0, 1.05)
    axes[2].set_ylabel("coherence")
    # Short: with the operating point before it, the note must fit the figure's width.
    note = f"record: {record.segments} segments, coherence > {COHERENT}"
    if record.lowest:
        note += f", from {record.lowest / _TURN:.2g} Hz"
    if not coherent.any():
        note = f"no empirical response: coherence stays below {COHERENT}"
    # H = Suy / Suu is that of this input alone only where the others are uncorrelated with it.
    return note + ("; other inputs taken as uncorrelated" if others_move else "")


def bode_unit(model: Model, output: str, input: str) -> str:
    """`dB re rad/m`; plain dB where a unit is missing, or is a quotient and would need brackets."""
    out, into = naming.unit(model.Outputs, output), naming.unit(model.Inputs, input)
    if into == "1":
        return f"dB re {out}" if out and out != "1" else "dB"
    return f"dB re {out}/{into}" if out and into and "/" not in into else "dB"


def _finish_bode(
    axes: Panels, nyquist: float, limits: tuple[float, float], unit: str, note: str
) -> None:
    for ax in axes:
        ax.axvline(nyquist / _TURN, color=style.GREY, lw=0.9, ls="-.", label=_NYQUIST)
    axes[0].set_xscale("log")
    axes[0].set_xlim(limits[0] / _TURN, limits[1] / _TURN)
    style.plain_log_ticks(axes[0])
    axes[0].set_ylim(*_within(axes[0], 40.0))
    axes[1].set_ylim(*_within(axes[1], 180.0))
    axes[0].annotate(
        "Nyquist ",
        (nyquist / _TURN, 0.03),
        xycoords=("data", "axes fraction"),
        ha="right",
        fontsize=8,
        color=style.GREY,
    )
    axes[0].set_ylabel(f"magnitude [{unit}]")
    axes[1].set_ylabel("phase [deg]")
    style.phase_ticks(axes[1])
    axes[-1].set_xlabel("frequency [Hz]")
    legend_above(axes[0])
    subtitle(axes[0], note, raised=True)


def _within(ax: "Axes", beyond: float) -> tuple[float, float]:
    """Limits that hold what can be seen of fit and record, and the rest no more than `beyond`
    further: the RLS, and the continuous fit past the Nyquist frequency."""
    # Poles and zeros of the RLS near the unit circle would else press the fit flat. The Nyquist
    # line is left out as well: its y are parts of the axes, not data.
    left_out = (_RLS, _CONTINUOUS, _NYQUIST)
    curves = [c for c in ax.get_lines() if c.get_label() not in left_out]
    y = np.concatenate([np.asarray(c.get_ydata(), float) for c in curves] or [np.zeros(1)])
    low, high = ax.get_ylim()
    if not y.size:
        return low, high
    return max(low, float(y.min()) - beyond), min(high, float(y.max()) + beyond)
