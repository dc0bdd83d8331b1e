"""Where the worst elements of each result lie: upright axes side by side, a line for each."""

from collections.abc import Mapping

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.transforms import ScaledTranslation

from heli_jax.numbers import number
from heli_jax.report import style
from heli_jax.report.style import pretty
from heli_jax.report.sweeps.columns import Column, Table, by_lot
from heli_jax.report.sweeps.panels import crosses, dots, first, head, marked
from heli_jax.report.sweeps.scales import LETTER, inches, short

_AXES = 12  # at most: more leave no room for their names
_LINES = 300  # faint ones at most: more are a grey area
# As many results as colours, as many elements of each as dashes.
_COLOURS = (style.BLUE, style.GREEN, style.PURPLE, style.ORANGE, style.BLACK, style.SKY)
_DASHES = ("-", (0, (5, 1.5)), (0, (2, 1)), (0, (1, 1)), (0, (5, 1, 1, 1)))


def worst(ds: xr.Dataset, elements: Mapping[str, np.ndarray]) -> Figure | None:
    """Where the worst elements of each result lie: a line through its axes for each.

    `elements` has those of each result, worst first. None where it has none.
    """
    return draw_worst(Table(ds, elements.values()), elements)


def draw_worst(table: Table, by_result: Mapping[str, np.ndarray]) -> Figure | None:
    """`worst` of a table, which the figures of a sweep share."""
    axes = table.axes[:_AXES]
    chosen = [
        (table.column(name), np.asarray(elements)[: len(_DASHES)])
        for name, elements in by_result.items()
        if name in table.results and len(elements)
    ][: len(_COLOURS)]
    if not axes or not chosen:
        return None
    entries = sum(e.size for _, e in chosen)
    below = 0.62 + 0.175 * -(-entries // 2)
    figure = style.figure(0.52 + 2.8 + below)
    width, height = figure.get_size_inches()
    ax = figure.add_axes((0.6 / width, below / height, 1.0 - 1.2 / width, 2.8 / height))
    # Each axis by its own scale, from 0 to 1: they have no unit in common.
    places = np.stack([(c.transform(c.values) - c.view[0]) / (c.view[1] - c.view[0]) for c in axes])
    x = np.arange(len(axes), dtype=float)
    _bundle(ax, x, places[:, by_lot(np.flatnonzero(table.ok), _LINES)])
    # What failed is marked beside the axes, or it would hide among the lines.
    failed = table.failed()
    aside = ax.transData + ScaledTranslation(0.06, 0.0, figure.dpi_scale_trans)
    at = np.repeat(x, failed.size)
    crosses(ax, at, places[:, failed].ravel(), ms=2.5, alpha=0.5, transform=aside)
    for k, (column, elements) in enumerate(chosen):
        for dashes, e in zip(_DASHES, elements, strict=False):
            here = int(table.at(e))
            text = f"{short(column.name, 24)}: element {e}, {_value(column, here)}"
            # Thinner for each further result: where lines coincide the one below still shows.
            ax.plot(
                x, places[:, here], color=_COLOURS[k], ls=dashes, lw=2.6 - 0.3 * k, marker="o",
                ms=5.0 - 0.5 * k, label=text, zorder=4 + k,
            )  # fmt: skip
    _upright(ax, axes)
    figure.legend(
        loc="lower left", ncols=2, bbox_to_anchor=(0.35 / width, 0.05 / height), borderaxespad=0.0,
        handlelength=2.6,
    )  # fmt: skip
    lot = f", {_LINES} by lot" if table.n_ok > _LINES else ""
    head(ax, "Worst elements", table, [
        f"grey: elements that are ok{lot}", *marked(table),
        *[f"values are means over {c.flights} flights" for c, _ in chosen if c.flights][:1],
        *first(len(axes), len(table.axes), "axes"),
    ])  # fmt: skip
    return figure


def _bundle(ax: Axes, x: np.ndarray, places: np.ndarray) -> None:
    """Faint lines (axes, lines); dots where there is one axis."""
    if x.size == 1:
        dots(ax, np.zeros(places.shape[1]), places[0])
        return
    lines = [np.column_stack([x, p]) for p in places.T]
    alpha = 0.7 if len(lines) < 50 else 0.3
    # One collection: hundreds of artists of their own are slow to draw.
    drawn = LineCollection(lines, colors=style.PALE, linewidths=0.6, alpha=alpha, zorder=1)
    ax.add_collection(drawn, autolim=False)


def _value(column: Column, at: int) -> str:
    """The number of the element at a place of the columns, with its unit."""
    unit = "" if pretty(column.unit) == "–" else f" {pretty(column.unit)}"
    return f"{number(float(column.values[at]))}{unit}"


def _upright(ax: Axes, axes: list[Column]) -> None:
    """The axes, each with its ends."""
    n = len(axes)
    room = int(inches(ax, "x") / max(n - 1, 2) / LETTER)
    size, digits = (8.0, 3) if n < 8 else (7.0, 2)
    units = ["" if c.unit is None else f"\n[{pretty(c.unit)}]" for c in axes]
    names = [short(c.name, room) + unit for c, unit in zip(axes, units, strict=True)]
    ax.set_xticks(range(n), names, size=size)
    side = 0.04 * max(n - 1, 1)
    ax.set_xlim(-side, n - 1 + side)
    ax.set_ylim(-0.09, 1.09)
    ax.set_yticks([])
    ax.grid(visible=False)
    ax.spines[["left", "bottom"]].set_visible(False)
    ax.tick_params(axis="x", length=0, pad=4)
    for k, c in enumerate(axes):
        ax.vlines(k, 0.0, 1.0, color="#444444", lw=0.8, zorder=2)
        for place, y, va in ((c.view[0], -0.03, "top"), (c.view[1], 1.03, "bottom")):
            # Rounded before, since `number` would take a power of ten out of 0.09998, which is 0.1.
            end = number(float(f"{float(c.inverse(place)):.{digits}g}"), digits)
            ax.text(k, y, end, size=size, ha="center", va=va, color=style.GREY)
