"""Figures of a manoeuvre: plain data in, matplotlib Axes out, as in `heli_jax.report.figures`."""

import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from heli_jax import naming
from heli_jax.dynamics.model import Model
from heli_jax.report import style
from heli_jax.report.figures import Panels
from heli_jax.report.style import line, subtitle
from heli_jax.simulation.trajectory import Trajectory

_APART = "rotor_speed"
"""the one output that would press others of its unit flat"""
_KINDS = {
    "m": "position",
    "m/s": "velocity",
    "rad": "attitude",
    "rad/s": "rates",
}
_LENGTHS = (("m", 1.0), ("mm", 1e3), ("µm", 1e6))
_STILL = 0.05
"""span of an axis over the largest of its values, at least: what moves by less is nearly constant,
and not drawn as if it were not"""
_LEAST = {"m": 0.01, "m/s": 0.02, "rad": 0.005, "rad/s": 0.01, "m/s^2": 0.05, "1": 0.02}
"""by unit the span of an axis at least: about what the sensors of such a machine tell apart"""
_HEIGHT = 1.25
"""of a panel [inch]"""
_LEGEND = 1.05
"""right margin that holds the legends [inch]"""
# States and signals of a model are classes of the user's own, with arrays (N,): annotated Any.


def motion(run: Trajectory, model: Model, *, figure: Figure | None = None) -> Panels:
    """The outputs over time, those of a unit together: position, velocity, attitude, rates.

    Shaded where the model's range was left.

    Args:
        run: one run, with NumPy arrays (N,), SI.
        model: its records say the units.
        figure: to draw on; a new one where None.
    """
    groups = _by_unit(model.Outputs, [n for n in naming.names(model.Outputs) if n != _APART])
    axes = _panels(len(groups), figure)
    for ax, (unit, names) in zip(axes, groups, strict=True):
        _lines(ax, run.times, {n: getattr(run.outputs, n) for n in names})
        kind = _KINDS.get(unit or "", names[0]) if len(names) > 1 else names[0]
        ax.set_ylabel(style.label(kind, unit))
        _not_magnified(ax, [getattr(run.outputs, n) for n in names], unit)
    return _finished(axes, run, f"Motion of {model.name}")


def sticks(run: Trajectory, model: Model, *, figure: Figure | None = None) -> Panels:
    """The inputs as they acted, and the rotor's speed where the model has it.

    Args:
        run: one run, with NumPy arrays (N,), SI.
        model: its records say the units.
        figure: to draw on; a new one where None.
    """
    groups = _by_unit(model.Inputs, list(naming.names(model.Inputs)))
    rotor = _APART in naming.names(model.Outputs)
    axes = _panels(len(groups) + rotor, figure)
    # strict=False: the last of the axes is the rotor's, which is an output.
    for ax, (unit, names) in zip(axes, groups, strict=False):
        values = {n: np.asarray(getattr(run.inputs, n)) for n in names}
        if unit == "m":
            unit, values = _short(values)
        # Held from its sample to the next, as the simulation has it.
        _lines(ax, run.times, values, drawstyle="steps-post")
        kind = "wind" if names[0].startswith("wind") else "sticks"
        ax.set_ylabel(style.label(kind if len(names) > 1 else names[0], unit))
        _not_magnified(ax, list(values.values()), unit)
    if rotor:
        _lines(axes[-1], run.times, {_APART: getattr(run.outputs, _APART)})
        unit = naming.unit(model.Outputs, _APART)
        axes[-1].set_ylabel(style.label("rotor speed", unit))
        _not_magnified(axes[-1], [getattr(run.outputs, _APART)], unit)
    return _finished(axes, run, f"Sticks of {model.name}")


def _by_unit(record: type, names: list[str]) -> list[tuple[str | None, list[str]]]:
    """The names of each unit, in the record's order; a field without one stands for itself."""
    groups: dict[str, list[str]] = {}
    for name in names:
        # What has no unit may be anything: two of them need not share a scale.
        groups.setdefault(naming.unit(record, name) or f"no unit: {name}", []).append(name)
    return [(naming.unit(record, group[0]), group) for group in groups.values()]


def _short(values: dict[str, np.ndarray]) -> tuple[str, dict[str, np.ndarray]]:
    """Lengths [m] in the unit that suits them: a stick moves by millimetres."""
    # One unit for all inputs of a panel, by the largest: they share its axis.
    largest = max(float(np.max(np.abs(v), initial=0.0)) for v in values.values())
    # The first unit in which the largest is 0.1 or more; metres where nothing moves.
    unit, factor = next((u for u in _LENGTHS if largest * u[1] >= 0.1), ("m", 1.0))
    return unit, {name: factor * v for name, v in values.items()}


def _panels(n: int, figure: Figure | None) -> Panels:
    """Panels below each other, with room for a legend at the right."""
    drawing = style.figure(1.1 + _HEIGHT * n) if figure is None else figure
    axes = drawing.subplots(n, 1, sharex=True, squeeze=False)[:, 0]
    if figure is None:
        style.place(drawing, n, right=_LEGEND, gap=0.18)
    drawing.align_ylabels(axes)
    return tuple(axes)


def _lines(ax: Axes, times: ArrayLike, values: Mapping[str, ArrayLike], **line_style: Any) -> None:
    for (name, y), color in zip(values.items(), itertools.cycle(style.CYCLE), strict=False):
        line(ax, times, y, color=color, lw=1.1, label=name, **line_style)
    ax.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), handlelength=1.2, borderaxespad=0.4)


def _not_magnified(ax: Axes, values: Sequence[ArrayLike], unit: str | None) -> None:
    """An axis that does not blow up what is nearly constant to the height of its panel.

    Args:
        ax: with the values drawn.
        values: each (N,).
        unit: of them.
    """
    all_of_them = np.concatenate([np.ravel(np.asarray(v, np.float64)) for v in values])
    seen = all_of_them[np.isfinite(all_of_them)]
    if seen.size == 0:
        return
    low, high = float(seen.min()), float(seen.max())
    least = max(_STILL * max(abs(low), abs(high)), _LEAST.get(unit or "", 0.0))
    if high - low < least:
        middle = 0.5 * (low + high)
        # With the margin of 5 % that matplotlib leaves to either side.
        ax.set_ylim(middle - 0.55 * least, middle + 0.55 * least)


def _finished(axes: Panels, run: Trajectory, title: str) -> Panels:
    t = np.asarray(run.times)
    axes[0].set_title(title, loc="left")
    axes[-1].set_xlabel("time [s]")
    axes[0].set_xlim(t[0], t[-1] if t.size > 1 else t[0] + 1.0)
    left = [name for name, out in run.outside.items() if np.any(out)]
    if left:
        # One shade for all limits together: their names stand above, and several would only darken.
        subtitle(axes[0], f"shaded where the model's range is left: {', '.join(left)}")
        outside = np.any([np.asarray(run.outside[name]) for name in left], axis=0)
        for begin, end in _stretches(outside):
            # Up to the next sample, so that a single one outside can be seen.
            last = t[min(end, t.size - 1)]
            for ax in axes:
                ax.axvspan(t[begin], last, color=style.ORANGE, alpha=0.22, lw=0, zorder=0)
    return axes


def _stretches(where: np.ndarray) -> list[tuple[int, int]]:
    """[begin, end) of each stretch of True in (N,)."""
    # A zero at either end makes an edge of a stretch that begins or ends with the record.
    edges = np.flatnonzero(np.diff(np.concatenate([[0], where.astype(int), [0]])))
    return [(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]
