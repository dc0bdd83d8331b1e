"""Bode figure of a fitted model over the flights' response, and of the error between both."""

from typing import TYPE_CHECKING

import numpy as np

from heli_jax.analysis.mismatch import unnoticeable
from heli_jax.analysis.response_curves import COHERENT, octave_mean
from heli_jax.report import style
from heli_jax.report.figures.frequency_axis import BEYOND_CHANCE, last_of
from heli_jax.report.figures.panels import Panels, panels
from heli_jax.report.fitted_responses import FittedPair
from heli_jax.report.frequency import phase
from heli_jax.report.style import legend_above, subtitle

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_DB = 20.0 / np.log(10.0)
_Z95 = 1.959963984540054
_WIDE = 0.5
"""relative random error past which a bin says little, and is not drawn"""
_FEW = 3
"""bins with coherence below which all of them make the axes' limits"""
_GAINS, _PHASES = 12.0, 90.0
"""[dB], [deg] that the panels of the error show at most to either side"""


def match(pair: FittedPair, unit: str, note: str, *, figure: "Figure | None" = None) -> Panels:
    """Gain, phase and partial coherence of data and model, and their quotient, all with 95 %
    intervals; the quotient within the envelopes of what pilots do not notice.

    Args:
        pair: what is drawn.
        unit: of gain, such as `dB re rad`.
        note: below the title.
        figure: to draw on; a new one where None.
    """
    axes = panels(figure, 8.4 + style.ROW, [1.4, 1.2, 0.6, 0.9, 0.9], top=style.TOP + style.ROW)
    known = np.isfinite(pair.H) & (pair.sd < _WIDE * np.abs(pair.H))
    modelled = np.isfinite(pair.model.log_gain) & np.isfinite(pair.model.phase)
    _draw_model(axes, pair, modelled)
    _draw_data(axes, pair, known, modelled)
    axes[2].plot(_hz(pair), pair.coherence, color=style.BLACK, lw=0.9)
    axes[2].axhline(COHERENT, color=style.VERMILLION, lw=0.8, ls=":")
    axes[2].set_ylim(0.0, 1.05)
    _draw_error(axes[3:], pair, known & modelled)
    axes[0].set_xscale("log")
    axes[0].set_xlim(_hz(pair)[0], _hz(pair)[last_of(pair.omega, pair.coherence, known)])
    style.plain_log_ticks(axes[0])
    style.phase_ticks(axes[1])
    labels = (f"gain [{unit}]", "phase [deg]", "coherence", "error [dB]", "error [deg]")
    for ax, words in zip(axes, labels, strict=True):
        ax.set_ylabel(words)
    axes[-1].set_xlabel("frequency [Hz]")
    axes[0].set_title(f"{pair.input} to {pair.output}: model and data", loc="left")
    legend_above(axes[0])
    subtitle(axes[0], note, raised=True)
    return axes


def _hz(pair: FittedPair) -> np.ndarray:
    # As in the figures of `heli-jax frf`, and as the configuration states bands.
    return pair.omega / (2.0 * np.pi)


def _model_phase(pair: FittedPair) -> np.ndarray:
    """[deg], on the branch that figures begin with."""
    return phase(np.exp(1j * np.nan_to_num(pair.model.phase)))


def _draw_model(axes: Panels, pair: FittedPair, good: np.ndarray) -> None:
    hz, model = _hz(pair)[good], pair.model
    curves = (
        (axes[0], _DB * model.log_gain, _DB * model.gain_sd),
        (axes[1], _model_phase(pair), np.degrees(model.phase_sd)),
    )
    for ax, value, sd in curves:
        ax.plot(hz, value[good], color=style.BLUE, lw=1.4, label="model")
        reach = _Z95 * np.nan_to_num(sd[good])
        ax.fill_between(
            hz, value[good] - reach, value[good] + reach, color=style.SKY, alpha=0.5, lw=0
        )


def _draw_data(axes: Panels, pair: FittedPair, known: np.ndarray, modelled: np.ndarray) -> None:
    hz, H = _hz(pair)[known], pair.H[known]
    relative = pair.half95 * pair.sd[known] / np.abs(H)
    gain, angle = _DB * np.log(np.abs(H)), np.degrees(np.angle(H))
    if modelled.all():
        # Beside the model: point by point, since data may have gaps.
        near = _model_phase(pair)[known]
        angle = near + (angle - near + 180.0) % 360.0 - 180.0
    _bars(axes[0], hz, gain, relative, _DATA)
    reach = np.degrees(np.minimum(relative, np.pi))
    style.bars(axes[1], hz, angle, reach, color=style.BLACK, label=_DATA)
    # What a bin without coherence says is mostly noise over a stick that hardly moved: it is drawn
    # where there is room, and makes none. In gusts a response has a coherence of 0.3 to 0.6, and
    # intervals that are read: such bins have to be within the axes.
    mean = octave_mean(pair.omega, pair.coherence)
    rule = (np.minimum(pair.coherence, mean) >= BEYOND_CHANCE)[known]
    rule = rule if np.count_nonzero(rule) >= _FEW else np.ones_like(rule)
    if hz.size:
        axes[0].set_ylim(np.min(gain[rule]) - 6.0, np.max(gain[rule]) + 6.0)
        axes[1].set_ylim(np.min(angle[rule]) - 45.0, np.max(angle[rule]) + 45.0)


_DATA = "data, 95 % intervals"


def _bars(
    ax: "Axes", hz: np.ndarray, gain: np.ndarray, relative: np.ndarray, label: str | None = None
) -> None:
    # Where the error is large the two ends of the gain are not as far away in decibels.
    down = -20.0 * np.log10(np.maximum(1.0 - relative, 1e-2))
    up = 20.0 * np.log10(1.0 + relative)
    style.bars(ax, hz, gain, [down, up], color=style.BLACK, label=label)


def _draw_error(axes: Panels, pair: FittedPair, known: np.ndarray) -> None:
    """Data over model."""
    hz = _hz(pair)
    error = pair.H[known] / pair.model.response[known]
    # The errors of both: the data's is of the random error, the model's of its parameters.
    own = pair.half95 * pair.sd[known] / np.abs(pair.H[known])
    gain_reach = np.hypot(own, _Z95 * np.nan_to_num(pair.model.gain_sd[known]))
    phase_reach = np.hypot(own, _Z95 * np.nan_to_num(pair.model.phase_sd[known]))
    envelope = unnoticeable(pair.omega)
    for ax, (low, high), most in zip(
        axes, (envelope.gain_db, envelope.phase_deg), (_GAINS, _PHASES), strict=True
    ):
        ax.fill_between(hz, low, high, color=style.PALE, alpha=0.3, lw=0)
        ax.axhline(0.0, color=style.BLUE, lw=1.0)
        ax.set_ylim(-most, most)
    _bars(axes[0], hz[known], _DB * np.log(np.abs(error)), gain_reach)
    reach = np.degrees(np.minimum(phase_reach, np.pi))
    style.bars(axes[1], hz[known], np.degrees(np.angle(error)), reach, color=style.BLACK)
