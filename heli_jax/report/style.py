"""How figures look: colours, one set of rcParams, thinning of long lines, saving."""

import io
import itertools
import re
import warnings
import weakref
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike

# Imported where it draws: `info` and `--help` need none of it, and would wait half a second for it.
if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

# Okabe and Ito's palette: told apart with every common kind of colour blindness, and in grey.
BLACK, ORANGE, SKY, GREEN = "#000000", "#E69F00", "#56B4E9", "#009E73"
BLUE, VERMILLION, PURPLE = "#0072B2", "#D55E00", "#CC79A7"
CYCLE = (BLUE, VERMILLION, GREEN, ORANGE, PURPLE, SKY, BLACK, "#7F7F7F")
GREY, PALE = "#6B6B6B", "#A8A8A8"

STYLE: dict[Any, Any] = {
    "font.family": "sans-serif",
    # Beside the first, which sets the widths, fonts of about its widths.
    "font.sans-serif": ["DejaVu Sans", "Verdana", "Arial", "sans-serif"],
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
    # Letters as text, in a font of the reader's: as outlines they are most of a file.
    "svg.fonttype": "none",
    # Without a salt the ids in an SVG are random, and two runs of one fit differ in every figure.
    "svg.hashsalt": "heli_jax",
    # A fifth of a pixel: nobody sees it, and noisy lines lose many of their points.
    "path.simplify": True,
    "path.simplify_threshold": 0.2,
}

type Panels = tuple[Axes, ...]

WIDTH = 7.4
"""width of a figure [inch]"""
TOP = 0.5
"""margin above the first panel [inch]: a title and a row below it"""
ROW = 15.0 / 72.0
"""height of a row between title and axes [inch]: a subtitle or a legend"""
BOTTOM = 0.48
"""margin below the last panel [inch]"""
MOST_POINTS = 800
"""points of a drawn line at most: the lowest and the highest of every 1.5 pixels of a page"""
_POINTS = 72.0
"""in an inch"""
_DPI = 110
_CORNERS = 4000
"""of the long lines of a figure together"""
# A hundredth of a point is enough, and half as long as a millionth.
_PLACES, _FURTHER = re.compile(rb' (?:d|x|y)="[^"]+"'), re.compile(rb"(?<=\.\d\d)\d+| \n")
_NOT_XML = bytes(set(range(32)) - {9, 10, 13})
"""control characters"""


def figure(height: float, width: float = WIDTH, *, constrained: bool = False) -> "Figure":
    """An empty figure with its own canvas; `constrained`: laid out by Matplotlib, which is slow and
    gives labels of any length their room."""
    # Without pyplot, which keeps every figure alive in a global list, and is not for threads.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    drawing = Figure(figsize=(width, height), layout="constrained" if constrained else None)
    FigureCanvasAgg(drawing)
    return drawing


def panels(
    height: float,
    ratios: Sequence[float],
    *,
    sharex: bool = True,
    right: float = 0.2,
    top: float = TOP,
) -> Panels:
    """Panels below each other in a new figure, their labels in line.

    Args:
        height: of the figure [inch].
        right: margin [inch].
    """
    from matplotlib.transforms import ScaledTranslation

    n, drawing = len(ratios), figure(height)
    axes = drawing.subplots(n, 1, sharex=sharex, squeeze=False, height_ratios=ratios)[:, 0]
    # Margins are fixed, for a layout engine draws every tick twice more and takes half the report's
    # time. Panels with an x axis each need room for its tick labels. Matplotlib takes margins as
    # parts of the figure, and gaps as parts of a panel's height.
    gap = 0.22 if sharex else 0.36
    each = (height - top - BOTTOM - gap * (n - 1)) / n
    drawing.subplots_adjust(
        left=0.82 / WIDTH,
        right=1.0 - right / WIDTH,
        top=1.0 - top / height,
        bottom=BOTTOM / height,
        hspace=gap / each,
    )
    # As far away in every figure: `align_ylabels` measures the tick labels of every panel at each
    # drawing, and figures of the same kind would differ with their numbers' widths.
    for ax in axes:
        at = ax.transAxes + ScaledTranslation(-0.57, 0.0, drawing.dpi_scale_trans)
        ax.yaxis.set_label_coords(0.0, 0.5, transform=at)
    return tuple(axes)


def thinned(x: np.ndarray, y: np.ndarray, most: int = MOST_POINTS) -> tuple[np.ndarray, np.ndarray]:
    """At most `most` points of a line: the lowest and the highest of each bin.

    No peak is lost, and the first and the last point stay.

    Args:
        x: (N,), ascending.
        y: (N,)
        most: points to keep, 4 at least.
    """
    # Not every k-th sample: that aliases an oscillation and misses spikes.
    n = y.size
    if n <= most:
        return x, y
    bins = (most - 2) // 2  # two points each, and the two ends
    edges = np.linspace(0, n, bins + 1).astype(int)
    # A missing sample is neither the lowest nor the highest.
    down, up = np.where(np.isnan(y), np.inf, y), np.where(np.isnan(y), -np.inf, y)
    low = [a + int(np.argmin(down[a:b])) for a, b in itertools.pairwise(edges)]
    high = [a + int(np.argmax(up[a:b])) for a, b in itertools.pairwise(edges)]
    keep = np.unique(np.concatenate([[0, n - 1], low, high]))
    return x[keep], y[keep]


_LONG: "weakref.WeakSet[Line2D]" = weakref.WeakSet()
"""lines that may be thinned: their x ascends"""


def thin(drawn: "Figure") -> None:
    """Thin the long lines of a figure to what can be seen of them."""
    # Not when they are drawn: the page's own drawing of a figure, which is zoomed, has all points.
    lines = [v for ax in drawn.axes for v in ax.get_lines() if v in _LONG]
    corners = [1 if v.get_drawstyle() == "default" else 2 for v in lines]
    # Noise in many panels has no short outline: its lines share what a figure may have.
    most = min(MOST_POINTS, _CORNERS // max(sum(corners), 1))
    for v in lines:
        v.set_data(*thinned(np.asarray(v.get_xdata()), np.asarray(v.get_ydata()), max(most, 4)))


def line(ax: "Axes", x: ArrayLike, y: ArrayLike, **line_style: Any) -> None:
    """Draw a line of any length; it is thinned when the figure is saved."""
    _LONG.update(ax.plot(np.asarray(x), np.asarray(y), **line_style))


def samples(ax: "Axes", x: ArrayLike, y: ArrayLike, **line_style: Any) -> None:
    """Draw what was measured, NaN where it is missing: a line, or where few samples have neighbours
    a dot for each, of which a line would show nothing."""
    x, y = np.asarray(x), np.asarray(y)
    seen = ~np.isnan(y)
    beside = np.convolve(seen, [1, 0, 1], "same")[seen] > 0
    if seen.any() and beside.mean() < 0.5:
        line_style = {**line_style, "lw": 0.0, "ls": "none", "marker": "o", "ms": 2.2}
        x, y = x[seen], y[seen]
    line(ax, x, y, **line_style)


def bars(
    ax: "Axes",
    x: np.ndarray,
    y: np.ndarray,
    reach: ArrayLike,
    *,
    color: str,
    label: str | None = None,
) -> None:
    """Draw dots with error bars; `reach`: of the bars down and up, (2, N), or of both, (N,)."""
    ax.plot(x, y, "o", ms=2.2, mew=0.0, color=color, label=label)
    down, up = np.broadcast_to(np.asarray(reach, float), (2, y.size))
    # One path, broken by NaN: `errorbar` writes two elements into the SVG for each bar.
    ends = np.stack([y - down, y + up, np.full(y.size, np.nan)], axis=1).ravel()
    ax.plot(np.repeat(x, 3), ends, lw=0.6, color=color, label=BARS)


BARS = "_bars"
"""label of the bars of the dots that were drawn before them"""


def pretty(unit: str | None) -> str:
    """A unit as it is printed: kg m², 1/s²; `–` for a plain number."""
    if unit is None or unit in ("", "1"):
        return "–"
    return unit.replace("^2", "²").replace("^3", "³").replace("^4", "⁴").replace("*", " ")


def label(name: str, unit: str | None) -> str:
    """`roll [rad]`; the name alone where the unit is not known."""
    return f"{name} [{pretty(unit)}]" if unit is not None else name


def subtitle(ax: "Axes", text: str, *, raised: bool = False) -> None:
    """A quiet line between the title and the axes."""
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


_BESIDE = 42
"""letters of a title that leave room for a legend at its right"""
_NAME = 26
"""letters of a name in a title"""


def short(name: str) -> str:
    """A name from a log, which may have any length, as a title has it."""
    half = _NAME // 2
    return name if len(name) <= _NAME else f"{name[:half]}…{name[-half:]}"


def legend_above(ax: "Axes", *, raised: bool = False) -> None:
    """A legend on top of the axes at the right, where no data are; `raised` beside the title
    where a subtitle lies between.

    Beside a short title is room for two or three entries; more belong below a raised subtitle.
    """
    title = ax.get_title("left")
    if not raised and len(title) > _BESIDE:
        ax.set_title(title, loc="left", pad=19)
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
    from matplotlib.ticker import MaxNLocator

    ax.yaxis.set_major_locator(MaxNLocator(nbins=6, steps=[1, 1.5, 3, 4.5, 9, 10]))


def figure_of(axes: Panels) -> "Figure | None":
    """The figure of panels; None where there are none."""
    return axes[0].figure if axes else None  # type: ignore[return-value]


def styled(draw: Callable[[], Panels]) -> "Figure | None":
    """Draw panels in the style; None where there is nothing to draw."""
    with in_style():
        return figure_of(draw())


@contextmanager
def in_style() -> Iterator[None]:
    """Matplotlib's settings for the style, as long as the context lasts."""
    import matplotlib

    with matplotlib.rc_context(STYLE), warnings.catch_warnings():
        # A name of a log in letters that this machine's font lacks; the reader's may have them.
        warnings.filterwarnings("ignore", "Glyph .* missing", UserWarning)
        yield


def as_svg(drawn: "Figure") -> bytes:
    """A figure that was drawn in the style, within it, as SVG."""
    thin(drawn)
    buffer = io.BytesIO()
    # Without a date: the same fit gives the same file.
    drawn.savefig(buffer, format="svg", metadata={"Date": None})
    text = _PLACES.sub(lambda m: _FURTHER.sub(b"", m[0]), buffer.getvalue())
    # What XML cannot hold, from a name of a log.
    return text.translate(None, _NOT_XML)


def as_png(drawn: "Figure") -> bytes:
    """A figure that was drawn in the style, within it, as PNG."""
    thin(drawn)
    buffer = io.BytesIO()
    drawn.savefig(buffer, format="png", dpi=_DPI)
    return buffer.getvalue()


def save(draw: Callable[[], "Figure | None"], path: Path) -> tuple[str, bytes] | None:
    """Draw a figure in the style and write `path`.svg and `path`.png.

    Returns its first title and the SVG; None where there was nothing to draw.
    """
    # Saving reads the settings again (fonts, the SVG's salt): it belongs inside the context too.
    with in_style():
        drawn = draw()
        if drawn is None:
            return None
        if drawn.get_layout_engine() is not None:
            # Once, and not for each of the files.
            drawn.draw_without_rendering()
            drawn.set_layout_engine("none")
        data = as_svg(drawn)
        path.with_suffix(".svg").write_bytes(data)
        path.with_suffix(".png").write_bytes(as_png(drawn))
    return drawn.axes[0].get_title("left"), data
