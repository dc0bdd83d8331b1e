"""What a drawn figure shows, as plain data: its lines, error bars, bands and limits, panel by
panel. The page draws it anew, so that it can be zoomed, and words about it come from it."""

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from heli_jax.report.style import BARS

# Imported where a figure is read: `info` and `--help` need none of it.
if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

PIXELS = 88.0
"""of the page in an inch of a figure"""


class Series(NamedTuple):
    """A line, points, or what lies between two lines; arrays (n,)."""

    label: str
    kind: str
    """line, step, points, bars or band"""
    color: str
    width: float
    dashed: bool
    x: np.ndarray
    y: np.ndarray
    """NaN where something is missing; of a band its lower edge"""
    low: np.ndarray | None = None
    """of bars and bands"""
    high: np.ndarray | None = None


class Panel(NamedTuple):
    """One pair of axes."""

    label: str
    """of the y axis"""
    limits: tuple[float, float]
    height: float
    """[pixel of a page]"""
    series: tuple[Series, ...]
    levels: tuple[float, ...] = ()
    """horizontal lines"""
    marks: tuple[float, ...] = ()
    """vertical lines"""
    shades: tuple[tuple[float, float], ...] = ()
    """stretches of x that are shaded"""


class Chart(NamedTuple):
    """Panels below each other with one x axis."""

    title: str
    note: str
    x_label: str
    logarithmic: bool
    x_limits: tuple[float, float]
    panels: tuple[Panel, ...]
    of: str = ""
    """what its x belongs to, as a flight: charts of the same share cursor and zoom"""


def chart_of(figure: "Figure") -> Chart:
    """A figure of panels below each other as plain data.

    Args:
        figure: drawn with lines, error bars, `fill_between` and spans; what else it holds is left
            out.
    """
    axes = figure.axes
    first = axes[0]
    notes = [t.get_text() for t in first.texts if getattr(t, "xy", None) == (0, 1)]
    height = float(figure.get_size_inches()[1])
    low, high = first.get_xlim()
    return Chart(
        first.get_title("left"),
        "; ".join(notes),
        axes[-1].get_xlabel(),
        first.get_xscale() == "log",
        (float(low), float(high)),
        tuple(_panel(ax, height) for ax in axes),
        str(figure.get_label()),
    )


def _panel(ax: "Axes", height: float) -> Panel:
    low, high = ax.get_ylim()
    flat, upright, lines = _straight(ax)
    return Panel(
        label=ax.get_ylabel(),
        limits=(float(low), float(high)),
        height=round(float(ax.get_position().height) * height * PIXELS),
        series=(*_bands(ax), *_lines(ax, lines)),
        levels=flat,
        marks=upright,
        shades=_shades(ax),
    )


def _straight(ax: "Axes") -> tuple[tuple[float, ...], tuple[float, ...], list["Line2D"]]:
    """Heights of the lines across the axes, places of those from top to bottom, and all others."""
    flat, upright, lines = [], [], []
    for line in ax.get_lines():
        # A line across has its x in parts of the axes, and only its y in numbers of the data.
        by_x, by_y = line.get_transform().contains_branch_seperately(ax.transData)
        if by_x and by_y:
            lines.append(line)
        elif by_y:
            flat.append(float(np.asarray(line.get_ydata())[0]))
        elif by_x:
            upright.append(float(np.asarray(line.get_xdata())[0]))
    return tuple(flat), tuple(upright), lines


def _lines(ax: "Axes", lines: list["Line2D"]) -> list[Series]:
    series: list[Series] = []
    for line in lines:
        if line.get_label() == BARS:
            ends = np.asarray(line.get_ydata(), float)
            series[-1] = series[-1]._replace(kind="bars", low=ends[::3], high=ends[1::3])
        else:
            series.append(_line(line, ax))
    return [s for s in series if s.x.size]


def _line(line: "Line2D", ax: "Axes") -> Series:
    from matplotlib.colors import to_hex

    kind = "step" if line.get_drawstyle() == "steps-post" else "line"
    if line.get_linestyle() in ("None", "none", "", " "):
        kind = "points"
    return Series(
        _name(str(line.get_label()), ax),
        kind,
        to_hex(line.get_color()),
        float(line.get_linewidth()) if kind in ("line", "step") else float(line.get_markersize()),
        line.get_linestyle() not in ("-", "None"),
        np.asarray(line.get_xdata(), float),
        np.asarray(line.get_ydata(), float),
    )


def _name(label: str, ax: "Axes") -> str:
    """A line's label; that of the axis without its unit where it has none."""
    return label if label and not label.startswith("_") else ax.get_ylabel().partition(" [")[0]


def _bands(ax: "Axes") -> list[Series]:
    from matplotlib.collections import PolyCollection
    from matplotlib.colors import to_hex

    bands = []
    for collection in ax.collections:
        if not isinstance(collection, PolyCollection):
            continue
        for path in collection.get_paths():
            # As fill_between lays them: one corner, the first edge, one corner, the second back.
            corners = np.asarray(path.vertices)
            n = (len(corners) - 3) // 2
            one, other = corners[1 : n + 1], corners[n + 2 : 2 * n + 2][::-1]
            color = to_hex(collection.get_facecolor()[0])  # type: ignore[arg-type,index]
            low, high = np.minimum(one[:, 1], other[:, 1]), np.maximum(one[:, 1], other[:, 1])
            bands.append(Series("", "band", color, 0.0, False, one[:, 0], low, low, high))
    return bands


def _shades(ax: "Axes") -> tuple[tuple[float, float], ...]:
    from matplotlib.patches import Polygon, Rectangle

    shades = []
    for patch in ax.patches:
        by_x, by_y = patch.get_transform().contains_branch_seperately(ax.transData)
        if by_x and not by_y and isinstance(patch, Rectangle | Polygon):
            box = patch.get_path().transformed(patch.get_patch_transform()).get_extents()
            shades.append((float(box.x0), float(box.x1)))
    return tuple(shades)
