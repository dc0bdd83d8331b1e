"""The median of a result over pairs of axes."""

import itertools
import math

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.collections import QuadMesh
from matplotlib.colors import LogNorm, Normalize, SymLogNorm
from matplotlib.figure import Figure

from heli_jax.report import style
from heli_jax.report.sweeps.columns import WIDE, Column, Table, widened
from heli_jax.report.sweeps.panels import (
    crosses,
    first,
    head,
    laid_out,
    marked,
    not_finite,
    nothing,
    say,
)
from heli_jax.report.sweeps.scales import even_ticks, linear_axis, log_axis, named, scale

_PAIRS = 6  # panels at most
_CELLS = 24  # cells along an axis at most
_COLOURS, _EMPTY = "viridis", "#F3F3F3"


def maps(ds: xr.Dataset, result: str) -> Figure | None:
    """The median of a result over each pair of axes. None as for `slices`, and for one axis."""
    return draw_maps(Table(ds), result)


def draw_maps(table: Table, result: str) -> Figure | None:
    """`maps` of a table, which the figures of a sweep share."""
    every = list(itertools.combinations(table.axes, 2))
    if result not in table.results or not every:
        return None
    # All pairs of four axes rather than one axis with many.
    pairs = sorted(every, key=lambda p: max(map(table.axes.index, p)))[:_PAIRS]
    z = table.column(result)
    columns = min(len(pairs), 2)
    left, gap, right = 0.72, 0.8, 1.12
    width = (style.WIDTH - left - right - (columns - 1) * gap) / columns
    size = width, 3.2 if columns == 1 else 2.0
    figure, panels = laid_out(range(len(pairs)), columns, size, gap=(gap, 0.58), left=left)
    # About four elements a cell: the median of fewer is as rough as they are.
    k = int(np.clip(math.sqrt(np.count_nonzero(z.used) / 4), 4, _CELLS))
    medians = [_medians(x, y, z, k) for x, y in pairs]
    norm = _norm(medians)
    mesh = None
    for ax, (x, y), m in zip(panels, pairs, medians, strict=True):
        ax.set_facecolor(_EMPTY)
        ax.grid(visible=False)
        failed = table.failed(x, y)
        crosses(ax, x.values[failed], y.values[failed], ms=2.8, alpha=0.8)
        named(ax, "x", x, scale(ax, "x", x, x.ends(k), margin=0.0))
        named(ax, "y", y, scale(ax, "y", y, y.ends(k), margin=0.0))
        ax.yaxis.set_label_coords(-0.5 / width, 0.5)
        if norm is None:
            say(ax, nothing(table))
        else:
            ex, ey = (c.inverse(c.cells(k)[0]) for c in (x, y))
            mesh = ax.pcolormesh(ex, ey, m.T, cmap=_COLOURS, norm=norm, rasterized=True)
    if mesh is not None:
        _colour_bar(figure, panels, mesh, z, medians)
    head(panels[0], z.title(), table, [
        "colour: median of the elements in each cell", *marked(table), *not_finite(table, z),
        *first(len(pairs), len(every), "pairs of axes"),
    ])  # fmt: skip
    return figure


def _medians(x: Column, y: Column, z: Column, k: int) -> np.ndarray:
    """The median of z in each cell, (cells of x, cells of y); NaN where there is none."""
    (ex, ix), (ey, iy) = x.cells(k), y.cells(k)
    shape = ex.size - 1, ey.size - 1
    # z is sorted once for all pairs of axes; then a stable sort by cell leaves each cell sorted,
    # and its median stands in its middle: no loop over the cells.
    elements = z.ranked
    cell = np.where((ix < 0) | (iy < 0), -1, ix * np.int16(shape[1]) + iy)[elements]
    elements, cell = elements[cell >= 0], cell[cell >= 0].astype(np.int16)  # sorts fast
    values = z.values[elements[np.argsort(cell, kind="stable")]]
    count = np.bincount(cell, minlength=shape[0] * shape[1])
    ends = np.cumsum(count)
    some = count > 0
    lower = (ends - count + (count - 1) // 2)[some]
    upper = (ends - count + count // 2)[some]
    medians = np.full(count.size, np.nan)
    medians[some] = 0.5 * (values[lower] + values[upper])
    return medians.reshape(shape)


def _norm(medians: list[np.ndarray]) -> Normalize | None:
    """Colours of all panels of a figure; a few cells far from the others do not count."""
    # One scale for all, so that a colour means one value wherever it stands.
    values = np.concatenate([m[np.isfinite(m)] for m in medians])
    if not values.size:
        return None
    low, high = widened(*(float(v) for v in np.quantile(values, [0.01, 0.99])))
    if values.min() > 0 and high > WIDE * low:
        return LogNorm(low, high)
    if values.max() < 0 and low < WIDE * high:
        return SymLogNorm(-0.5 * high, vmin=low, vmax=high)
    return Normalize(low, high)


def _colour_bar(
    figure: Figure, panels: list[Axes], mesh: QuadMesh, z: Column, medians: list[np.ndarray]
) -> None:
    """A colour bar for all panels, on their right; pointed where cells lie beyond it."""
    width, height = figure.get_size_inches()
    boxes = [ax.get_position() for ax in panels]
    bottom, top = min(b.y0 for b in boxes), max(b.y1 for b in boxes)
    tall = min(top - bottom, 3.2 / height)
    cax = figure.add_axes((1.0 - 0.95 / width, top - tall, 0.14 / width, tall))
    low, high = mesh.get_clim()
    below = any(np.nanmin(m, initial=low) < low for m in medians)
    above = any(np.nanmax(m, initial=high) > high for m in medians)
    extend = "both" if below and above else "min" if below else "max" if above else "neither"
    bar = figure.colorbar(mesh, cax=cax, extend=extend)
    if isinstance(mesh.norm, LogNorm | SymLogNorm):
        taken = log_axis(bar.ax.yaxis, low, high, 9)
    else:
        taken = linear_axis(bar.ax.yaxis, even_ticks(z, 8), low, high)
    bar.ax.grid(visible=False)
    bar.ax.spines["outline"].set_visible(False)
    named(bar.ax, "y", z, taken)
