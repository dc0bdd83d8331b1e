"""All axes and results at once: how often each value is there, and each two of them."""

import math

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.colors import PowerNorm
from matplotlib.figure import Figure

from heli_jax.report import style
from heli_jax.report.sweeps.columns import MARKS, Column, Table
from heli_jax.report.sweeps.panels import (
    DOTS,
    crosses,
    dots,
    first,
    head,
    laid_out,
    marked,
    nothing,
    say,
)
from heli_jax.report.sweeps.scales import named, scale, short

_VARIABLES = 7  # rows at most: more leave no room for a label
_BARS = 30  # bars of a histogram, and cells along an axis, at most
_MARKS = MARKS // 2  # the panels are smaller than those of other figures
_COLOURS = "Blues"


def corner(ds: xr.Dataset) -> Figure | None:
    """Histograms of axes and results, and densities of each two of them. None without an axis."""
    return draw_corner(Table(ds))


def draw_corner(table: Table) -> Figure | None:
    """`corner` of a table, which the figures of a sweep share."""
    considered = [table.column(r) for r in table.results[:_VARIABLES]]
    results = [c for c in considered if not c.empty]
    # Four axes in any case: without them the results are seen, but not what they come from.
    axes = table.axes[: max(4, _VARIABLES - len(results))]
    if not axes:
        return None
    shown = [*axes, *results][:_VARIABLES]
    n = len(shown)
    left, gap = 0.92, 0.1
    width = (style.WIDTH - left - 0.2 - (n - 1) * gap) / n
    size = width, min(width, 2.2)
    cells = [row * n + column for row in range(n) for column in range(row + 1)]
    figure, panels = laid_out(cells, n, size, gap=(gap, gap), left=left, bottom=0.88)
    drawn = np.count_nonzero(table.ok)
    # Rice's rule; and about ten elements a cell, or a density is mostly empty.
    bars = int(np.clip(2.0 * drawn ** (1.0 / 3.0), 4, _BARS))
    dense = int(np.clip(math.sqrt(drawn / 10), 4, _BARS))
    for ax, cell in zip(panels, cells, strict=True):
        row, column = divmod(cell, n)
        x, y = shown[column], shown[row]
        taken = scale(ax, "x", x, x.ends(bars))
        if row == n - 1:
            named(ax, "x", x, taken, lines=2)
            ax.xaxis.set_label_coords(0.5, -0.42 / size[1])
        ax.tick_params(axis="x", labelbottom=row == n - 1, labelrotation=40)
        if row == column:
            _histogram(ax, x, bars, table)
        else:
            taken = scale(ax, "y", y, y.ends(bars))
            if column == 0:
                named(ax, "y", y, taken, lines=2)
                ax.yaxis.set_label_coords(-0.5 / width, 0.5)
            ax.tick_params(axis="y", labelleft=column == 0)
            _density(ax, x, y, dense)
            if x.axis and y.axis:
                failed = table.failed(x, y, most=_MARKS)
                crosses(ax, x.values[failed], y.values[failed], ms=2.5, alpha=0.6)
        ax.tick_params(labelsize=7.0)
    empty = [c for c in considered if c.empty]
    there = len(table.axes) + len(table.results) - len(empty)
    without = f"{nothing(table)}: {', '.join(short(c.name, 24) for c in empty)}"
    head(panels[0], "Axes and results", table, [
        *marked(table, _MARKS),
        *[f"results are means over {c.flights} flights" for c in results if c.flights][:1],
        *(["values far from the others are left out"] if any(c.cut for c in shown) else []),
        *([without] if empty and table.n_ok else []),
        *first(n, there, "variables"),
    ])  # fmt: skip
    return figure


def _histogram(ax: Axes, x: Column, bars: int, table: Table) -> None:
    """How many elements that are ok each cell has."""
    edges, cells = x.cells(bars)
    inside = cells[x.used]
    count = np.bincount(inside[inside >= 0], minlength=edges.size - 1)
    ax.stairs(count, x.inverse(edges), fill=True, color=style.BLUE, alpha=0.75, lw=0)
    ax.set_yticks([])
    ax.set_ylim(0.0, 1.08 * max(1, int(count.max())))
    ax.spines["left"].set_visible(False)
    ax.grid(visible=False)
    if not count.any():
        say(ax, nothing(table).replace(" ", "\n", 2))


def _density(ax: Axes, x: Column, y: Column, k: int) -> None:
    """Dots of few elements, or how many are in each cell."""
    both = np.flatnonzero(x.used & y.used)
    if both.size <= DOTS:
        dots(ax, x.values[both], y.values[both])
        return
    (ex, ix), (ey, iy) = x.cells(k), y.cells(k)
    shape = ex.size - 1, ey.size - 1
    ix, iy = ix[both], iy[both]
    inside = (ix >= 0) & (iy >= 0)
    cell = ix[inside].astype(np.int32) * shape[1] + iy[inside]
    count = np.bincount(cell, minlength=shape[0] * shape[1]).reshape(shape).astype(float)
    # The root, or a few full cells would leave all others white; and lighter than its darkest, so
    # that the marks of what failed can be seen.
    norm = PowerNorm(0.5, 0.0, 1.3 * max(1.0, float(count.max())))
    count[count == 0] = np.nan
    ax.pcolormesh(x.inverse(ex), y.inverse(ey), count.T, cmap=_COLOURS, norm=norm, rasterized=True)
    ax.grid(visible=False)
