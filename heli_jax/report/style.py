"""Figures as files: colours, one set of rcParams, charts drawn by Matplotlib, saving."""

import io
import re
import textwrap
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from heli_jax.report.charts import Chart, Panel, thinned

# Matplotlib is imported only for drawing: `info` and `--help` would wait half a second for it.
if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Palette of Okabe and Ito, distinguishable with common colour blindness and in grey.
BLACK, ORANGE, SKY, GREEN = "#000000", "#E69F00", "#56B4E9", "#009E73"
BLUE, VERMILLION, PURPLE = "#0072B2", "#D55E00", "#CC79A7"
CYCLE = (BLUE, VERMILLION, GREEN, ORANGE, PURPLE, SKY, BLACK, "#7F7F7F")
GREY, PALE = "#6B6B6B", "#A8A8A8"

STYLE: dict[Any, Any] = {
    "font.family": "sans-serif",
    # The first font sets the widths; the others have similar widths.
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
    # Powers of ten are used only below 0.001 and from 10000.
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
    # Letters stay text in the reader's font; outlines would be most of the file.
    "svg.fonttype": "none",
    # Without a salt the ids in an SVG are random, and figures differ between runs.
    "svg.hashsalt": "heli_jax",
    # A fifth of a pixel is invisible, and noisy lines lose many points.
    "path.simplify": True,
    "path.simplify_threshold": 0.2,
}

WIDTH = 7.4
"""Width of a figure [inch]."""
_POINTS, _CORNERS = 800, 4000
"""Most points of a drawn line (lowest and highest of every 1.5 pixels), and of all lines of a
figure."""
_DPI = 110
# A hundredth of a point is precise enough, and half as long as a millionth.
_PLACES, _FURTHER = re.compile(rb' (?:d|x|y)="[^"]+"'), re.compile(rb"(?<=\.\d\d)\d+| \n")
_NOT_XML = bytes(set(range(32)) - {9, 10, 13})
"""Control characters."""


def figure(height: float, width: float = WIDTH) -> "Figure":
    """Return an empty figure of a size [inch] with its own canvas."""
    # pyplot is avoided, because it keeps all figures in a global list and is not thread-safe.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    drawing = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(drawing)
    return drawing


def head(drawing: "Figure", title: str, note: str = "") -> None:
    """Write a title, and a note below it."""
    text = "\n".join(filter(None, (title, textwrap.fill(note, 105))))
    drawing.suptitle(text, x=0.01, ha="left", fontsize=9)


def figure_of(chart: Chart) -> "Figure":
    """Return a chart drawn by Matplotlib for a file; call within `in_style`."""
    panels = chart.panels
    drawing = figure(0.9 + 1.1 * sum(p.height for p in panels))
    ratios = [p.height for p in panels]
    grid = drawing.subplots(len(panels), 1, sharex=True, squeeze=False, height_ratios=ratios)
    axes = grid[:, 0]
    lines = sum(2 if s.kind == "step" else 1 for p in panels for s in p.series)
    most = max(4, min(_POINTS, _CORNERS // max(lines, 1)))
    for ax, p in zip(axes, panels, strict=True):
        _draw(ax, p, most)
        if sum(bool(s.label) for s in p.series) > 1:
            ax.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=6, borderaxespad=0.2)
    head(drawing, chart.title, chart.note)
    if chart.logarithmic:
        axes[0].set_xscale("log")
    axes[0].set_xlim(*chart.x_limits)
    if chart.logarithmic:
        plain_log_ticks(axes[0])
    axes[-1].set_xlabel(chart.x_label)
    drawing.align_ylabels(axes)
    return drawing


def _draw(ax: "Axes", p: Panel, most: int) -> None:
    from matplotlib.ticker import MaxNLocator

    for s in p.series:
        look: dict[str, Any] = {"color": s.color, "label": s.label or None}
        if s.kind == "band" and s.low is not None and s.high is not None:
            ax.fill_between(s.x, s.low, s.high, alpha=0.4, lw=0, **look)
        elif s.kind == "bars" and s.low is not None and s.high is not None:
            ax.plot(s.x, s.y, "o", ms=s.width, mew=0.0, **look)
            # One path broken by NaN is smaller: `errorbar` writes two SVG elements for each bar.
            ends = np.stack([s.low, s.high, np.full(s.y.size, np.nan)], axis=1).ravel()
            ax.plot(np.repeat(s.x, 3), ends, lw=0.6, color=s.color)
        elif s.kind == "points":
            ax.plot(s.x, s.y, "o", ms=s.width, mew=0.0, **look)
        else:
            steps = "steps-post" if s.kind == "step" else "default"
            look |= {"lw": s.width, "ls": (0, (4, 2)) if s.dashed else "-", "drawstyle": steps}
            ax.plot(*thinned(s.x, s.y, most), **look)
    for y in p.levels:
        ax.axhline(y, color="#444444", lw=0.7, ls="-" if y == 0.0 else ":")
    ax.set_ylabel(p.label)
    if p.logarithmic:
        ax.set_yscale("log")
    elif p.label.endswith("[deg]"):
        # Steps of 15, 30, 45 and 90 degrees suit a phase.
        ax.yaxis.set_major_locator(MaxNLocator(nbins=6, steps=[1, 1.5, 3, 4.5, 9, 10]))
    ax.set_ylim(*p.limits)
    if p.logarithmic:
        plain_log_ticks(ax, "y")


def pretty(unit: str | None) -> str:
    """Return a unit for print: kg m², 1/s²; `–` for a plain number."""
    if unit is None or unit in ("", "1"):
        return "–"
    return unit.replace("^2", "²").replace("^3", "³").replace("^4", "⁴").replace("*", " ")


def label(name: str, unit: str | None) -> str:
    """Return a label such as `roll [rad]`; the name alone if the unit is unknown."""
    return f"{name} [{pretty(unit)}]" if unit is not None else name


_NAME = 26
"""Most letters of a name in a title."""


def short(name: str) -> str:
    """Return a name from a log, shortened for a title."""
    half = _NAME // 2
    return name if len(name) <= _NAME else f"{name[:half]}…{name[-half:]}"


def plain_log_ticks(ax: "Axes", which: Literal["x", "y"] = "x") -> None:
    """Label a logarithmic axis with 0.1, 0.2, 0.5, 1, and with powers far from one."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

    axis = ax.xaxis if which == "x" else ax.yaxis
    low, high = axis.get_view_interval()
    # Over more than three and a half decades the labels of 2 and 5 would overlap.
    subs = (1.0, 2.0, 5.0) if high < 3e3 * low else (1.0,)
    axis.set_major_locator(LogLocator(subs=subs, numticks=12))
    axis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}"))
    # Unlabelled ticks between 1, 2 and 5 would suggest a linear axis.
    axis.set_minor_locator(NullLocator())


def limit_ticks(ax: "Axes", which: Literal["x", "y"], most: int) -> None:
    """Set the largest number of ticks of an axis."""
    from matplotlib.ticker import MaxNLocator

    axis = ax.xaxis if which == "x" else ax.yaxis
    axis.set_major_locator(MaxNLocator(nbins=most))


@contextmanager
def in_style() -> Iterator[None]:
    """Apply Matplotlib's settings of the style within the context."""
    import matplotlib

    with matplotlib.rc_context(STYLE), warnings.catch_warnings():
        # A log's name may contain letters that this font lacks, but the reader's font has.
        warnings.filterwarnings("ignore", "Glyph .* missing", UserWarning)
        yield


def styled(draw: Callable[[], "Chart | Figure | None"]) -> "Figure | None":
    """Draw in the style; return None if there is nothing to draw."""
    with in_style():
        made = draw()
        return figure_of(made) if isinstance(made, Chart) else made


def save(
    draw: Callable[[], "Chart | Figure | None"], path: Path, *, png: bool = True
) -> bytes | None:
    """Draw in the style and write `path`.svg and `path`.png.

    The SVG is returned, or None if there is nothing to draw.
    """
    # Saving reads the settings again (fonts, the SVG's salt), so it must be inside the context.
    with in_style():
        drawn = styled(draw)
        if drawn is None:
            return None
        # The layout is computed once for both files.
        drawn.draw_without_rendering()
        drawn.set_layout_engine("none")
        buffer = io.BytesIO()
        # Without a date the same fit gives the same file.
        drawn.savefig(buffer, format="svg", metadata={"Date": None})
        text = _PLACES.sub(lambda m: _FURTHER.sub(b"", m[0]), buffer.getvalue())
        # Names of a log may contain characters that XML forbids.
        data = text.translate(None, _NOT_XML)
        path.with_suffix(".svg").write_bytes(data)
        if png:
            drawn.savefig(path.with_suffix(".png"), format="png", dpi=_DPI)
    return data
