"""How figures look: colours, one set of rcParams, thinning of long lines, saving."""

import io
import itertools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator
from matplotlib.transforms import ScaledTranslation

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
    "axes.formatter.limits": (-3, 4),
    "axes.formatter.use_mathtext": False,
    "axes.unicode_minus": True,
    "text.parse_math": False,  # names come from logs
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
    "svg.fonttype": "path",
    "svg.hashsalt": "heli_jax",
    "path.simplify": True,
    "path.simplify_threshold": 0.2,
}

WIDTH = 7.4
"""width of a figure [inch]"""
MOST_POINTS = 2000
"""points of a drawn line at most: about three for each pixel of a page's width"""
_DPI = 110


def figure(height: float, width: float = WIDTH) -> Figure:
    """An empty figure with its own canvas; no pyplot, no global state."""
    made = Figure(figsize=(width, height))
    FigureCanvasAgg(made)
    return made


def place(made: Figure, panels: int, *, right: float = 0.2, gap: float = 0.2) -> None:
    """Margins and gaps between panels in inches.

    Fixed, for a layout engine draws every tick twice more and takes half the report's time.
    """
    width, height = made.get_size_inches()
    left, top, bottom = 0.82, 0.5, 0.48
    each = (height - top - bottom - gap * (panels - 1)) / panels
    made.subplots_adjust(
        left=left / width,
        right=1.0 - right / width,
        top=1.0 - top / height,
        bottom=bottom / height,
        hspace=gap / each,
    )


def thinned(x: np.ndarray, y: np.ndarray, most: int = MOST_POINTS) -> tuple[np.ndarray, np.ndarray]:
    """At most `most` (>= 4) points of a line (N,): the lowest and the highest of each bin.

    No peak is lost, and the first and the last point stay.
    """
    n = y.size
    if n <= most:
        return x, y
    bins = (most - 2) // 2
    edges = np.linspace(0, n, bins + 1).astype(int)
    low = [a + int(np.argmin(y[a:b])) for a, b in itertools.pairwise(edges)]
    high = [a + int(np.argmax(y[a:b])) for a, b in itertools.pairwise(edges)]
    keep = np.unique(np.concatenate([[0, n - 1], low, high]))
    return x[keep], y[keep]


def line(ax: Axes, x: np.ndarray, y: np.ndarray, **how: Any) -> None:
    """Draw a line of any length, thinned."""
    ax.plot(*thinned(np.asarray(x), np.asarray(y)), **how)


def pretty(unit: str | None) -> str:
    """A unit as it is printed: kg m², 1/s²; `–` for a plain number."""
    if unit is None or unit in ("", "1"):
        return "–"
    return unit.replace("^2", "²").replace("^3", "³").replace("^4", "⁴").replace("*", " ")


def label(name: str, unit: str | None) -> str:
    """`roll [rad]`; the name alone where the unit is not known."""
    return f"{name} [{pretty(unit)}]" if unit is not None else name


def subtitle(ax: Axes, text: str) -> None:
    """A quiet line between the title and the axes."""
    ax.set_title(ax.get_title("left"), loc="left", pad=19)
    ax.annotate(
        text,
        (0, 1),
        xytext=(0, 6),
        xycoords="axes fraction",
        textcoords="offset points",
        fontsize=8,
        color=GREY,
    )


def legend_above(ax: Axes, *, raised: bool = False) -> None:
    """A legend on top of the axes at the right, where no data are; `raised` beside the title
    where a subtitle lies between."""
    up = ScaledTranslation(0.0, (15.0 if raised else 0.0) / 72.0, ax.figure.dpi_scale_trans)
    ax.legend(
        loc="lower right",
        bbox_to_anchor=(1.005, 1.0),
        bbox_transform=ax.transAxes + up,
        ncols=5,
        borderaxespad=0.2,
        handlelength=1.6,
        columnspacing=1.2,
    )


def plain_log_ticks(axis: Axis) -> None:
    """0.1, 0.2, 0.5, 1 on a logarithmic axis, powers where they are far from one."""
    low, high = axis.get_view_interval()
    subs = (1.0, 2.0, 5.0) if high < 3e3 * low else (1.0,)
    axis.set_major_locator(LogLocator(subs=subs, numticks=12))
    axis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}"))
    axis.set_minor_locator(NullLocator())


def styled(draw: Callable[[], Figure | None]) -> Figure | None:
    """Draw a figure in the style."""
    with matplotlib.rc_context(STYLE):
        return draw()


def svg(draw: Callable[[], Figure | None]) -> tuple[str, bytes] | None:
    """Draw a figure in the style: its first title and the SVG; None where there is none."""
    with matplotlib.rc_context(STYLE):
        made = draw()
        return None if made is None else (made.axes[0].get_title("left"), _svg(made))


def _svg(made: Figure) -> bytes:
    buffer = io.BytesIO()
    made.savefig(buffer, format="svg", metadata={"Date": None})
    return buffer.getvalue()


def save(draw: Callable[[], Figure | None], path: Path) -> tuple[str, bytes] | None:
    """Draw a figure in the style and write `path`.svg and `path`.png.

    Returns its first title and the SVG; None where there was nothing to draw.
    """
    with matplotlib.rc_context(STYLE):
        made = draw()
        if made is None:
            return None
        data = _svg(made)
        made.savefig(path.with_suffix(".png"), dpi=_DPI)
    path.with_suffix(".svg").write_bytes(data)
    return made.axes[0].get_title("left"), data
