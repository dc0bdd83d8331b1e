"""A result against each axis."""

from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from heli_jax.report import style
from heli_jax.report.sweeps.columns import Column, Table, by_lot
from heli_jax.report.sweeps.panels import (
    DOTS,
    crosses,
    dots,
    first,
    head,
    laid_out,
    marked,
    not_finite,
    nothing,
    say,
)
from heli_jax.report.sweeps.scales import Taken, named, scale

_AXES = 8  # panels at most
# Bins at most, and elements in each at least: a band from 5 to 95 % of fewer is their range.
_BINS, _A_BIN = 20, 5
_FEW = 20  # distinct values of an axis that are bins of their own
_MARGIN = 0.07  # of the result's scale, beyond its view: the marks of what failed lie there


def slices(ds: xr.Dataset, result: str) -> Figure | None:
    """A result against each axis: dots, and the median with a 5-95 % band in bins of equal count.

    An axis with few values has a bin for each. None where there is no element, no axis, or no
    number for each element.
    """
    return draw_slices(Table(ds), result)


def draw_slices(table: Table, result: str) -> Figure | None:
    """`slices` of a table, which the figures of a sweep share."""
    axes = table.axes[:_AXES]
    if result not in table.results or not axes:
        return None
    y = table.column(result)
    columns = _side_by_side(len(axes))
    left, gap = 0.82, 0.22
    width = (style.WIDTH - left - 0.2 - (columns - 1) * gap) / columns
    size = width, 2.9 if columns == 1 else 1.9
    figure, panels = laid_out(range(len(axes)), columns, size, gap=(gap, 0.55), left=left)
    binned = [_binned(x, y) for x in axes]
    view = _view(y, binned)
    shown = by_lot(np.flatnonzero(y.used), DOTS)
    for k, (ax, x, bins) in enumerate(zip(panels, axes, binned, strict=True)):
        dots(ax, x.values[shown], y.values[shown])
        if bins is not None:
            _draw_bins(ax, bins)
        # What failed has no result to be placed by: it is marked at the foot of the panel.
        failed = table.failed(x)
        foot = np.full(failed.size, 0.03)
        below = ax.get_xaxis_transform()
        crosses(ax, x.values[failed], foot, transform=below, marker="|", ms=7.0, alpha=0.4)
        named(ax, "x", x, scale(ax, "x", x, x.view))
        if view is None:
            ax.set_yticks([])
            say(ax, nothing(table))
            taken = Taken()
        else:
            taken = scale(ax, "y", y, view, margin=_MARGIN)
        if k % columns:
            ax.tick_params(axis="y", labelleft=False)
        else:
            named(ax, "y", y, taken)
            ax.yaxis.set_label_coords(-0.57 / width, 0.5)
    head(panels[0], y.title(), table, [
        *(["line: median, band: 5–95 %"] if any(b is not None for b in binned) else []),
        *([f"dots: elements, {DOTS} by lot"] if np.count_nonzero(y.used) > DOTS else []),
        *marked(table), *not_finite(table, y), *_beyond(y, view),
        *first(len(axes), len(table.axes), "axes"),
    ])  # fmt: skip
    return figure


def _side_by_side(count: int) -> int:
    # Four panels are two rows of two, and no row of three with one alone.
    return count if count < 3 else 2 if count == 4 else 3


class _Bins(NamedTuple):
    """Quantiles of a result in bins of an axis."""

    x: np.ndarray
    """value of the axis: that of all elements of a bin, or their median"""
    low: np.ndarray
    median: np.ndarray
    high: np.ndarray
    apart: bool
    """whether the axis has no values between"""


def _binned(x: Column, y: Column) -> _Bins | None:
    """Bins of equal count, or one for each of few values; None for fewer than two."""
    elements = x.ranked[y.used[x.ranked]]
    along, values = x.values[elements], y.values[elements]
    apart = x.few(_FEW) is not None
    if apart:
        starts = np.flatnonzero(np.diff(along, prepend=-np.inf) > 0)
    else:
        count = min(_BINS, along.size // _A_BIN)
        starts = np.linspace(0, along.size, count + 1).astype(int)[:-1]
        # Equal values stay together: an element's bin shall not hang on the order of the sweep.
        starts = np.unique(np.searchsorted(along, along[starts]))
    if starts.size < 2:
        return None
    parts = np.split(values, starts[1:])
    # Quantiles and not mean and sd: a few runs that nearly diverge would move both out of the
    # panel.
    quantiles = np.array([np.quantile(part, [0.05, 0.5, 0.95]) for part in parts]).T
    middle = np.array([np.median(part) for part in np.split(along, starts[1:])])
    return _Bins(middle, *quantiles, apart=apart)


def _draw_bins(ax: Axes, bins: _Bins) -> None:
    band: dict[str, Any] = {"color": style.SKY, "zorder": 2, "label": "5–95 %"}
    if bins.apart:
        ax.vlines(bins.x, bins.low, bins.high, lw=4.0, alpha=0.6, **band)
    else:
        ax.fill_between(bins.x, bins.low, bins.high, lw=0, alpha=0.35, **band)
    marks = {"marker": "o", "ms": 3.5} if bins.apart else {}
    ax.plot(bins.x, bins.median, color=style.BLUE, lw=1.5, zorder=4, label="median", **marks)


def _view(y: Column, binned: list[_Bins | None]) -> tuple[float, float] | None:
    """The result's view, with every median."""
    if y.empty:
        return None
    medians = [y.transform(b.median) for b in binned if b is not None]
    places = np.concatenate([y.view, *medians])
    return float(places.min()), float(places.max())


def _beyond(y: Column, view: tuple[float, float] | None) -> list[str]:
    """How many elements lie beyond the panel."""
    if view is None:
        return []
    slack = _MARGIN * (view[1] - view[0])
    low, high = y.inverse(np.array([view[0] - slack, view[1] + slack]))
    values = y.values[y.used]
    count = int(np.count_nonzero((values < low) | (values > high)))
    return [f"{count} beyond the panel"] if count else []
