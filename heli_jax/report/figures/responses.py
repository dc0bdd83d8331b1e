"""The Bode figure of a measured response: gain and phase with 95 % intervals, and coherence."""

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from heli_jax.analysis.response_curves import COHERENT, octave_mean
from heli_jax.report import style
from heli_jax.report.figures.frequency_axis import SEEN, last_of
from heli_jax.report.figures.panels import Panels, panels
from heli_jax.report.frequency import phase
from heli_jax.report.style import legend_above, subtitle

_COLOURS = (style.VERMILLION, style.GREEN, style.PURPLE)
_WIDE = 1.0
"""relative random error past which a bin says nothing, and is not drawn"""
_BY_CHANCE = 2.0
"""Bins neither set the axes nor tell the phase's branch below a mean coherence over an octave of
SEEN, nor of this times what chance makes of it, one over the number of averages."""
_MARGINS = (6.0, 45.0)
"""dB and deg beyond what sets the axes"""


def draw_response(
    names: tuple[str, str],
    omega: np.ndarray,
    pair: Any,
    unit: str,
    note: str,
    averages: float,
    fits: Sequence[tuple[str, np.ndarray]] = (),
) -> Figure:
    """One response.

    Args:
        names: of the input and the output.
        omega: (k,) [rad/s]
        pair: with H, sd, coherence and picture, (k,) each, and half95 (`flight_responses.Pair`).
        unit: of output over input.
        note: below the title.
        averages: independent ones.
        fits: transfer functions, each a label and its response (k,).
    """
    hz = omega / (2.0 * np.pi)
    known = np.isfinite(pair.H) & (pair.sd < _WIDE * np.abs(pair.H))
    if (left_out := int(np.sum(~known))) > 0:
        note += f"; {left_out} of {omega.size} frequencies not drawn"
    axes = panels(None, 6.0 + style.ROW, [1.4, 1.2, 0.6], top=style.TOP + style.ROW)
    seen = seen_of(omega, pair, averages)
    branch = branch_of(omega, pair.H, seen)
    _draw_measured(axes, hz, pair, known, branch)
    _limit(axes, pair.H, branch, seen if seen.any() else known)
    if np.isfinite(pair.picture).any():
        # Bin by bin beside the dots: unwrapped by itself it may leave them by turns.
        own = _nearest(np.degrees(np.angle(pair.picture)), branch)
        _curve(axes, hz, pair.picture, own, known, color=style.SKY, lw=1.0, label="several windows")
    for (label, H), color in zip(fits, itertools.cycle(_COLOURS), strict=False):
        turned = phase(H)
        # As a whole: a transfer function is smooth, and its own phase tells its turns.
        apart = np.median((branch - turned)[seen]) if seen.any() else 0.0
        turned = turned + 360.0 * np.round(apart / 360.0)
        everywhere = np.ones(hz.size, bool)
        _curve(axes, hz, H, turned, everywhere, color=color, lw=1.4, label=label)
    axes[2].plot(hz, pair.coherence, color=style.BLACK, lw=0.9)
    axes[2].axhline(COHERENT, color=style.VERMILLION, lw=0.8, ls=":")
    axes[2].set_ylim(0.0, 1.05)
    axes[0].set_xscale("log")
    axes[0].set_xlim(hz[0], hz[last_of(omega, pair.coherence, known)])
    style.plain_log_ticks(axes[0])
    style.phase_ticks(axes[1])
    axes[0].set_ylabel(f"gain [dB re {unit}]" if unit != "1" else "gain [dB]")
    axes[1].set_ylabel("phase [deg]")
    axes[2].set_ylabel("coherence")
    axes[2].set_xlabel("frequency [Hz]")
    axes[0].set_title(f"{names[0]} to {names[1]}: measured response", loc="left")
    legend_above(axes[0])
    subtitle(axes[0], note, raised=True)
    drawn = axes[0].figure
    assert isinstance(drawn, Figure)
    return drawn


def seen_of(omega: np.ndarray, pair: Any, averages: float) -> np.ndarray:
    """The frequencies (k,) that tell the branch of the phase.

    Args:
        omega: (k,) [rad/s]
        pair: with H, sd and coherence, (k,) each.
        averages: independent ones.
    """
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


def _nearest(degrees: np.ndarray, along: np.ndarray) -> np.ndarray:
    """Phases on the branch within half a turn of others."""
    return degrees - 360.0 * np.round((degrees - along) / 360.0)


def _limit(axes: Panels, H: np.ndarray, branch: np.ndarray, seen: np.ndarray) -> None:
    if not seen.any():
        return
    gain = 20.0 * np.log10(np.abs(H[seen]))
    for ax, values, margin in zip(axes[:2], (gain, branch[seen]), _MARGINS, strict=True):
        ax.set_ylim(float(np.min(values)) - margin, float(np.max(values)) + margin)


def _draw_measured(
    axes: Panels, hz: np.ndarray, pair: Any, known: np.ndarray, branch: np.ndarray
) -> None:
    f, H = hz[known], pair.H[known]
    relative = pair.half95 * pair.sd[known] / np.abs(H)
    # Where the error is large the two ends of the gain are not as far away in decibels.
    down = -20.0 * np.log10(np.maximum(1.0 - relative, 1e-2))
    up = 20.0 * np.log10(1.0 + relative)
    gain = 20.0 * np.log10(np.abs(H))
    words = "one window, 95 % intervals"
    style.bars(axes[0], f, gain, [down, up], color=style.BLUE, label=words)
    error = np.degrees(np.minimum(relative, np.pi))
    style.bars(axes[1], f, branch[known], error, color=style.BLUE)


def _curve(
    axes: Panels,
    hz: np.ndarray,
    H: np.ndarray,
    degrees: np.ndarray,
    known: np.ndarray,
    **line_style: Any,
) -> None:
    # NaN breaks a line: joined, it would cross frequencies of which nothing is known.
    good = known & np.isfinite(H) & (np.abs(H) > 0)
    with np.errstate(divide="ignore"):
        gain = 20.0 * np.log10(np.abs(H))
    axes[0].plot(hz, np.where(good, gain, np.nan), **line_style)
    axes[1].plot(hz, np.where(good, degrees, np.nan), **line_style)
