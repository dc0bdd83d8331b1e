"""How figures look: colours, one set of rcParams, thinning of long lines, saving."""

import io
import weakref
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from heli_jax.report.sketch import SketchAxes
from heli_jax.report.thinning import MOST_POINTS, thinned
from heli_jax.report.unit_symbols import pretty

# Imported where it draws: the page of most fits needs none of it (`sketch`), and would wait half a
# second for it.
if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

# Okabe and Ito's palette: told apart with every common kind of colour blindness, and in grey.
BLACK, ORANGE, SKY, GREEN = "#000000", "#E69F00", "#56B4E9", "#009E73"
YELLOW, BLUE, VERMILLION, PURPLE = "#F0E442", "#0072B2", "#D55E00", "#CC79A7"
CYCLE = (BLUE, VERMILLION, GREEN, ORANGE, PURPLE, SKY, BLACK, "#7F7F7F")
GREY, PALE = "#6B6B6B", "#A8A8A8"

STYLE: dict[Any, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 9.0,
    "axes.titlesize": 10.0,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.labelsize": 9.0,
    "axes.edgecolor": "#444444",
    "axes.linewidth": 0.7,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    # Powers of ten only below 0.001 and from 10000 on.
    "axes.formatter.limits": (-3, 4),
    "axes.formatter.use_mathtext": False,
    "axes.unicode_minus": True,
    # Names come from logs: a dollar sign in one is no formula, and half a formula is an error.
    "text.parse_math": False,
    "grid.color": "#E4E4E4",
    "grid.linewidth": 0.6,
    "xtick.color": "#333333",
    "ytick.color": "#333333",
    "xtick.labelsize": 8.0,
    "ytick.labelsize": 8.0,
    "legend.fontsize": 8.0,
    "legend.frameon": False,
    "lines.linewidth": 1.1,
    "lines.solid_joinstyle": "round",
    "figure.facecolor": "white",
    "savefig.facecolor": "white",
    # Letters as outlines: the page looks the same where DejaVu is not installed.
    "svg.fonttype": "path",
    # Without a salt the ids in an SVG are random, and two runs of one fit differ in every figure.
    "svg.hashsalt": "heli_jax",
    # A fifth of a pixel: nobody sees it, and noisy lines lose many of their points.
    "path.simplify": True,
    "path.simplify_threshold": 0.2,
}

WIDTH = 7.4
"""width of a figure [inch]"""
TOP = 0.5
"""margin above the first panel [inch]: a title and a row below it"""
ROW = 15.0 / 72.0
"""height of a row between title and axes [inch]: a subtitle or a legend"""
BOTTOM = 0.48
"""margin below the last panel [inch]"""
_POINTS = 72.0
"""in an inch"""
_DPI = 110


def figure(height: float, width: float = WIDTH) -> "Figure":
    """An empty figure with its own canvas."""
    # Without pyplot, which keeps every figure alive in a global list, and is not for threads.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    drawing = Figure(figsize=(width, height))
    FigureCanvasAgg(drawing)
    return drawing


def place(
    drawing: "Figure", panels: int, *, right: float = 0.2, gap: float = 0.2, top: float = TOP
) -> None:
    """Margins and gaps between panels.

    Args:
        drawing: the figure.
        panels: how many there are below each other.
        right: margin at the right [inch].
        gap: between two panels [inch].
        top: margin above the first panel [inch].
    """
    # Fixed, for a layout engine draws every tick twice more and takes half the report's time.
    width, height = drawing.get_size_inches()
    left = 0.82
    # matplotlib takes margins as parts of the figure, and gaps as parts of a panel's height.
    each = panel_height(height, panels, gap=gap, top=top)
    drawing.subplots_adjust(
        left=left / width,
        right=1.0 - right / width,
        top=1.0 - top / height,
        bottom=BOTTOM / height,
        hspace=gap / each,
    )


def panel_height(height: float, panels: int, *, gap: float, top: float = TOP) -> float:
    """Of each panel, on average [inch].

    Args:
        height: of the figure [inch].
        panels: how many there are below each other.
        gap: between two [inch].
        top: margin above the first [inch].
    """
    return (height - top - BOTTOM - gap * (panels - 1)) / panels


_LONG: "weakref.WeakSet[Line2D]" = weakref.WeakSet()
"""lines that may be thinned: their x ascends"""


def thin(drawn: "Figure") -> None:
    """Thin the long lines of a figure to what can be seen of them."""
    # Not when they are drawn: the page's own drawing of a figure, which is zoomed, has all points.
    for ax in drawn.axes:
        for long in ax.get_lines():
            if long in _LONG and np.size(long.get_xdata()) > MOST_POINTS:
                long.set_data(*thinned(np.asarray(long.get_xdata()), np.asarray(long.get_ydata())))


def line(ax: "Axes", x: ArrayLike, y: ArrayLike, **line_style: Any) -> None:
    """Draw a line of any length; it is thinned when the figure is saved.

    Args:
        ax: where.
        x: (N,), ascending.
        y: (N,)
        **line_style: as of matplotlib's `plot`.
    """
    drawn = ax.plot(np.asarray(x), np.asarray(y), **line_style)
    if not isinstance(ax, SketchAxes):
        _LONG.update(drawn)


def samples(ax: "Axes", x: ArrayLike, y: ArrayLike, **line_style: Any) -> None:
    """Draw what was measured: a line, or where few samples have neighbours a dot for each, of which
    a line would show nothing.

    Args:
        ax: where.
        x: (N,), ascending.
        y: (N,), NaN where one is missing.
        **line_style: as of matplotlib's `plot`; of dots all but the width.
    """
    x, y = np.asarray(x), np.asarray(y)
    seen = ~np.isnan(y)
    beside = np.convolve(seen, [1, 0, 1], "same")[seen] > 0
    if seen.any() and beside.mean() < 0.5:
        line_style = {**line_style, "lw": 0.0, "ls": "none", "marker": "o", "ms": 2.2}
        x, y = x[seen], y[seen]
    line(ax, x, y, **line_style)


def label(name: str, unit: str | None) -> str:
    """`roll [rad]`; the name alone where the unit is not known."""
    return f"{name} [{pretty(unit)}]" if unit is not None else name


def subtitle(ax: "Axes", text: str, *, raised: bool = False) -> None:
    """A quiet line between the title and the axes.

    Args:
        ax: where; it has its title.
        text: of the line.
        raised: whether it lies over a legend (`legend_above`), the title over both.
    """
    if isinstance(ax, SketchAxes):
        ax.note = text
        return
    row = _POINTS * ROW if raised else 0.0
    ax.set_title(ax.get_title("left"), loc="left", pad=19 + row)
    ax.annotate(
        text,
        (0, 1),
        xytext=(0, 6 + row),
        xycoords="axes fraction",
        textcoords="offset points",
        fontsize=8,
        color=GREY,
    )


def legend_above(ax: "Axes", *, raised: bool = False) -> None:
    """A legend on top of the axes at the right, where no data are; `raised` beside the title
    where a subtitle lies between.

    Beside a title is room for two or three entries; more belong below a raised subtitle.
    """
    if isinstance(ax, SketchAxes):
        return  # a chart places its own
    from matplotlib.transforms import ScaledTranslation

    up = ScaledTranslation(0.0, ROW if raised else 0.0, ax.figure.dpi_scale_trans)
    ax.legend(
        loc="lower right",
        bbox_to_anchor=(1.005, 1.0),
        bbox_transform=ax.transAxes + up,
        ncols=5,
        borderaxespad=0.2,
        handlelength=1.6,
        columnspacing=1.2,
    )


def plain_log_ticks(ax: "Axes", which: Literal["x", "y"] = "x") -> None:
    """0.1, 0.2, 0.5, 1 on a logarithmic axis, powers where they are far from one."""
    if isinstance(ax, SketchAxes):
        return
    from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

    axis = ax.xaxis if which == "x" else ax.yaxis
    low, high = axis.get_view_interval()
    # Over more than three and a half decades the labels of 2 and 5 would overlap.
    subs = (1.0, 2.0, 5.0) if high < 3e3 * low else (1.0,)
    axis.set_major_locator(LogLocator(subs=subs, numticks=12))
    axis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}"))
    # Ticks without labels between 1, 2 and 5 would be taken for a linear division.
    axis.set_minor_locator(NullLocator())


def few_ticks(ax: "Axes", which: Literal["x", "y"], most: int, *, integer: bool = False) -> None:
    """At most so many numbers at an axis; `integer`: whole ones alone."""
    from matplotlib.ticker import MaxNLocator

    axis = ax.xaxis if which == "x" else ax.yaxis
    axis.set_major_locator(MaxNLocator(nbins=most, integer=integer))


def phase_ticks(ax: "Axes") -> None:
    """Steps of 15, 30, 45 and 90 degrees up the axis: a phase is read in parts of a right angle."""
    if isinstance(ax, SketchAxes):
        return
    from matplotlib.ticker import MaxNLocator

    ax.yaxis.set_major_locator(MaxNLocator(nbins=6, steps=[1, 1.5, 3, 4.5, 9, 10]))


def styled(draw: Callable[[], "Figure | None"]) -> "Figure | None":
    """Draw a figure in the style."""
    with in_style():
        return draw()


def in_style() -> AbstractContextManager[None]:
    """Matplotlib's settings for the style, as long as the context lasts."""
    import matplotlib

    return matplotlib.rc_context(STYLE)


def svg(draw: Callable[[], "Figure | None"]) -> tuple[str, bytes] | None:
    """Draw a figure in the style: its first title and the SVG; None where there is none."""
    with in_style():
        drawn = draw()
        return None if drawn is None else (drawn.axes[0].get_title("left"), as_svg(drawn))


def as_svg(drawn: "Figure") -> bytes:
    """A figure that was drawn in the style, within it, as SVG."""
    thin(drawn)
    buffer = io.BytesIO()
    # Without a date: the same fit gives the same file.
    drawn.savefig(buffer, format="svg", metadata={"Date": None})
    return buffer.getvalue()


def as_png(drawn: "Figure") -> bytes:
    """A figure that was drawn in the style, within it, as PNG."""
    thin(drawn)
    buffer = io.BytesIO()
    drawn.savefig(buffer, format="png", dpi=_DPI)
    return buffer.getvalue()


def saved(drawn: "Figure", path: Path) -> bytes:
    """Write a figure that was drawn in the style, within it, as `path`.svg and .png; the SVG."""
    data = as_svg(drawn)
    path.with_suffix(".png").write_bytes(as_png(drawn))
    path.with_suffix(".svg").write_bytes(data)
    return data


def save(draw: Callable[[], "Figure | None"], path: Path) -> tuple[str, bytes] | None:
    """Draw a figure in the style and write `path`.svg and `path`.png.

    Returns its first title and the SVG; None where there was nothing to draw.
    """
    # Saving reads the settings again (fonts, the SVG's salt): it belongs inside the context too.
    with in_style():
        drawn = draw()
        if drawn is None:
            return None
        data = saved(drawn, path)
    return drawn.axes[0].get_title("left"), data
