"""Figures of a sweep, from a Dataset over `element`, and its page.

Medians exclude failed elements, which are marked in red, and values that are not finite. A result
of several flights is drawn as its mean over them.
"""

import functools
import itertools
import json
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Literal

import matplotlib
import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullLocator
from numpy.typing import ArrayLike
from scipy.stats import binned_statistic_2d

from heli_jax.numbers import NOTHING, number
from heli_jax.report import style, tables
from heli_jax.report.origin import origin
from heli_jax.report.page import Picture, filled, of_file
from heli_jax.report.style import pretty

RESULTS = 6
"""Results with their own figures."""
DRAWN = 1 << 16
"""Most elements drawn, chosen at random."""
_DOTS, _MARKS = 2000, 300
"""Most dots and red marks of a panel."""
_SLICES, _PAIRS = 8, 6
"""Most panels of slices and of maps."""
_TICKS = 6
"""Most ticks of an axis."""
_WIDE = 30.0
"""Range of positive numbers, as a factor, above which an axis is logarithmic."""
_BINS, _A_BIN = 20, 5
"""Most bins of an axis, and fewest elements in each."""
_CELLS, _GRID = 24, 180
"""Most cells along an axis, and most distinct values of a grid with their own cells."""
_DPI = 160
"""Resolution of bitmap parts of an SVG [dots per inch]."""
_OK = 0
"""Status of a successful element; defined here because importing heli_jax.sweeps loads JAX."""

type Which = Literal["x", "y"]


class Column:
    """Axis or result: a number (n,) for each drawn element, NaN if not finite."""

    def __init__(
        self, variable: xr.DataArray, elements: np.ndarray, ok: np.ndarray, *, axis: bool
    ) -> None:
        unit = variable.attrs.get("units")
        flights = variable.sizes.get("flight", 0)
        self.unit = None if unit is None else str(unit)
        self.name = str(variable.name)
        self.title = f"{self.name}, mean over {flights} flights" if flights else self.name
        self.mean_over = flights
        self.values = _numbers(variable, elements)
        self.finite = np.isfinite(self.values)
        self.used = self.finite & ok
        self.axis = axis
        # An axis shows failed elements too.
        seen = np.sort(self.values[self.finite if axis else self.used])
        self.empty = not seen.size
        if self.empty:
            return
        self.distinct = np.unique(seen)
        # In a grid each value occurs at least twice.
        chosen = axis and 2 * self.distinct.size <= seen.size
        self.few = self.distinct.size == 1 or (chosen and self.distinct.size <= _GRID)
        low, high = float(seen[0]), float(seen[-1])
        # The bulk of a result sets its view.
        first, last = (low, high) if axis else np.quantile(seen, [0.01, 0.99])
        declared = axis and variable.attrs.get("scale") == "log"
        wide = max(abs(first), abs(last)) > _WIDE * min(abs(first), abs(last))
        self.log = low > 0.0 and (declared or wide)
        if not (axis or self.log):
            beyond = 0.3 * (last - first)
            low, high = max(low, first - beyond), min(high, last + beyond)
        if not high - low > 1e-9 * max(abs(low), abs(high)):
            half = 0.05 * abs(low) or 0.5
            low, high = low - half, high + half
        self.view = low, high
        """Smallest and largest value drawn."""

    def edges(self, count: int) -> np.ndarray:
        """Return ascending edges of even cells, or of one cell for each value of a grid."""
        if self.few and self.distinct.size > 1:
            between = 0.5 * (self.distinct[1:] + self.distinct[:-1])
            first, last = 2 * self.distinct[0] - between[0], 2 * self.distinct[-1] - between[-1]
            if not self.log or first > 0.0:
                return np.array([first, *between, last])
        return (np.geomspace if self.log else np.linspace)(*self.view, count + 1)

    def scale(self, ax: Axes, which: Which, ends: ArrayLike) -> None:
        """Set scale, limits, ticks and label of an axis of a panel."""
        low, *_, high = map(float, np.asarray(ends))
        ax.set(**{f"{which}lim": (low, high)})
        axis = ax.xaxis if which == "x" else ax.yaxis
        if self.log:
            ax.set(**{f"{which}scale": "log"})
            style.plain_log_ticks(ax, which)
        else:
            style.limit_ticks(ax, which, _TICKS)
        axis.set_label_text(style.label(style.short(self.name), self.unit))


class Table:
    """Results of a sweep, read once; a random choice of elements if there are many."""

    def __init__(self, ds: xr.Dataset) -> None:
        self._ds = ds
        ok = ds["status"].to_numpy() == _OK
        self.size, self.n_ok = ok.size, int(np.count_nonzero(ok))
        lots = (
            _random_choice(np.flatnonzero(ok), DRAWN),
            _random_choice(np.flatnonzero(~ok), DRAWN // 2),
        )
        self.elements = np.sort(np.concatenate(lots))
        """Indices of the drawn elements, ascending, (n,)."""
        self.ok = ok[self.elements]
        self.results = results(ds)
        self._columns: dict[str, Column] = {}

    def column(self, name: str) -> Column:
        """Return an axis or a result, read once."""
        if name not in self._columns:
            axis = name in self._ds.attrs["axes"]
            self._columns[name] = Column(self._ds[name], self.elements, self.ok, axis=axis)
        return self._columns[name]

    @property
    def axes(self) -> list[Column]:
        """Return the axes with a finite value."""
        return [c for c in map(self.column, self._ds.attrs["axes"]) if not c.empty]

    def failed(self, *columns: Column) -> np.ndarray:
        """Return at most `_MARKS` failed elements for which these columns are finite."""
        where = np.logical_and.reduce([~self.ok, *(c.finite for c in columns)])
        return _random_choice(np.flatnonzero(where), _MARKS)

    def head(self, figure: Figure, what: str, *notes: str) -> None:
        """Write the title, with the number of successful elements, and the legend."""
        failed = self.size - self.n_ok
        lot = f"{self.elements.size} drawn, by lot" if self.elements.size < self.size else ""
        marks = "red marks: not ok" + (f" ({_MARKS} of {failed})" if failed > _MARKS else "")
        words = "; ".join(filter(None, (lot, *notes, marks if failed else "")))
        style.head(figure, f"{style.short(what)}: {self.n_ok} of {self.size} elements ok", words)

    @property
    def nothing(self) -> str:
        """Return the text of an empty panel."""
        return "no finite value" if self.n_ok else "no element is ok"


def write_figures(directory: Path, ds: xr.Dataset) -> list[Path]:
    """Write slices-RESULT and maps-RESULT of the first results as PNG and SVG; return the files."""
    table, written = Table(ds), []
    directory.mkdir(parents=True, exist_ok=True)
    # Figures are drawn one by one to save memory.
    for result, stem in file_names(table.results[:RESULTS]).items():
        for draw in (slices, maps):
            path = directory / f"{draw.__name__}-{stem}"
            with matplotlib.rc_context({"savefig.dpi": _DPI}):
                saved = style.save(functools.partial(draw, table, result), path)
            if saved:
                written += [path.with_suffix(".png"), path.with_suffix(".svg")]
    return written


def file_names(names: Sequence[str]) -> dict[str, str]:
    """Return a file name for each name, unique without regard to case."""
    file_names: dict[str, str] = {}
    for name in names:
        first = stem = re.sub(r"[^\w-]", "_", name)[:50]
        taken = {other.casefold() for other in file_names.values()}
        for k in itertools.count(2):
            if stem.casefold() not in taken:
                break
            stem = f"{first}-{k}"
        file_names[name] = stem
    return file_names


def results(ds: xr.Dataset) -> list[str]:
    """Return the results with a number for each element, or for each element and flight."""
    return [
        str(n)
        for n, v in ds.data_vars.items()
        if {"element"} <= set(v.dims) <= {"element", "flight"}
        and v.dtype.kind in "biuf"
        and not str(n).startswith("trajectory_")
    ]


def slices(table: Table, result: str) -> Figure | None:
    """Draw a result against each axis: dots, and the median with a 5-95 % band in bins.

    Return None without an axis, or if the result is not drawn.
    """
    axes = table.axes[:_SLICES]
    if result not in table.results or not axes:
        return None
    y = table.column(result)
    columns = {1: 1, 2: 2, 4: 2}.get(len(axes), 3)
    figure, panels = _panels(len(axes), columns, 2.9 if columns == 1 else 2.3)
    shown = _random_choice(np.flatnonzero(y.used), _DOTS)
    for k, (ax, x) in enumerate(zip(panels, axes, strict=True)):
        _dots(ax, x.values[shown], y.values[shown])
        if (bins := _binned(x, y)) is not None:
            middle, (low, median, high) = bins
            band = {"color": style.SKY, "alpha": 0.35, "lw": 0, "zorder": 2, "label": "5-95 %"}
            ax.fill_between(middle, low, high, **band)
            marks = {"marker": "o", "ms": 3.5} if x.few else {}
            ax.plot(middle, median, color=style.BLUE, lw=1.5, zorder=4, label="median", **marks)
        # Failed elements are marked at the foot of the panel.
        failed = table.failed(x)
        foot = np.full(failed.size, 0.03)
        _crosses(ax, x.values[failed], foot, transform=ax.get_xaxis_transform(), marker="|")
        x.scale(ax, "x", x.edges(1))
        if y.empty:
            ax.set_yticks([])
            ax.text(0.5, 0.5, table.nothing, transform=ax.transAxes, ha="center", color=style.GREY)
            continue
        y.scale(ax, "y", _with_margin(y))
        if k % columns:
            ax.set_ylabel("")
            ax.tick_params(axis="y", labelleft=False)
    low, high = (-np.inf, np.inf) if y.empty else _with_margin(y)
    beyond = np.count_nonzero((y.values[y.used] < low) | (y.values[y.used] > high))
    table.head(
        figure,
        y.title,
        "line: median, band: 5-95 %",
        f"dots: elements, {_DOTS} by lot" if np.count_nonzero(y.used) > _DOTS else "",
        _not_finite(table, y),
        f"{beyond} beyond the panel" if beyond else "",
        _first(len(axes), len(table.axes), "axes"),
    )
    return figure


def _with_margin(y: Column) -> tuple[float, float]:
    """Return the view with a margin."""
    low, high = y.view
    if y.log:
        wide = (high / low) ** 0.07
        return low / wide, high * wide
    return low - 0.07 * (high - low), high + 0.07 * (high - low)


def _binned(x: Column, y: Column) -> tuple[np.ndarray, np.ndarray] | None:
    """Return medians (b,) of an axis in bins of equal count, and quantiles of a result (3, b).

    A grid has its values as bins. The quantiles are 5, 50 and 95 %. The result is None for fewer
    than two bins.
    """
    order = np.flatnonzero(x.used & y.used)
    order = order[np.argsort(x.values[order])]
    along, values = x.values[order], y.values[order]
    if x.few:
        starts = np.flatnonzero(np.diff(along, prepend=-np.inf) > 0)
    else:
        count = min(_BINS, along.size // _A_BIN)
        starts = np.linspace(0, along.size, count + 1).astype(int)[:-1]
        # Equal values share a bin.
        starts = np.unique(np.searchsorted(along, along[starts]))
    if starts.size < 2:
        return None
    parts = [np.quantile(part, [0.05, 0.5, 0.95]) for part in np.split(values, starts[1:])]
    return np.array([np.median(p) for p in np.split(along, starts[1:])]), np.array(parts).T


def maps(table: Table, result: str) -> Figure | None:
    """Draw the median of a result over each pair of axes; None for fewer than two axes."""
    every = list(itertools.combinations(table.axes, 2))
    if result not in table.results or not every:
        return None
    # The first axes have all their pairs.
    pairs = sorted(every, key=lambda p: max(map(table.axes.index, p)))[:_PAIRS]
    z = table.column(result)
    columns = min(len(pairs), 2)
    figure, panels = _panels(len(pairs), columns, 3.2 if columns == 1 else 2.5)
    # A cell contains about four elements.
    k = int(np.clip(np.sqrt(np.count_nonzero(z.used) / 4), 4, _CELLS))
    grids = [(x.edges(k), y.edges(k)) for x, y in pairs]
    medians = [_medians(x, y, z, grid) for (x, y), grid in zip(pairs, grids, strict=True)]
    # All panels share one scale, without outliers.
    values = np.concatenate([m[np.isfinite(m)] for m in medians])
    low, high = np.quantile(values, [0.01, 0.99]) if values.size else (0.0, 1.0)
    norm = LogNorm(low, high) if low > 0.0 and high > _WIDE * low else None
    colours: dict[str, Any] = {"norm": norm} if norm else {"vmin": low, "vmax": high}
    mesh = None
    for ax, (x, y), (ex, ey), m in zip(panels, pairs, grids, medians, strict=True):
        ax.set_facecolor("#F3F3F3")
        ax.grid(visible=False)
        failed = table.failed(x, y)
        _crosses(ax, x.values[failed], y.values[failed])
        x.scale(ax, "x", ex)
        y.scale(ax, "y", ey)
        if values.size:
            mesh = ax.pcolormesh(ex, ey, m.T, cmap="viridis", rasterized=True, **colours)
        else:
            ax.text(0.5, 0.5, table.nothing, transform=ax.transAxes, ha="center", color=style.GREY)
    if mesh is not None:
        beyond = values.min() < low or values.max() > high
        bar = figure.colorbar(mesh, ax=panels, extend="both" if beyond else "neither", shrink=0.8)
        bar.ax.yaxis.set_major_formatter(FuncFormatter(lambda v, _: number(v, 4)))
        bar.ax.yaxis.set_minor_locator(NullLocator())
        bar.set_label(style.label(style.short(z.name), z.unit))
    table.head(
        figure,
        z.title,
        "colour: median of the elements in each cell",
        _not_finite(table, z),
        _first(len(pairs), len(every), "pairs of axes"),
    )
    return figure


def _medians(x: Column, y: Column, z: Column, grid: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """Return the median of z in each cell, (cells of x, cells of y); NaN if it is empty."""
    use = x.used & y.used & z.used
    if not use.any():
        return np.full([e.size - 1 for e in grid], np.nan)
    points = x.values[use], y.values[use], z.values[use]
    return binned_statistic_2d(*points, "median", bins=grid).statistic  # pyright: ignore


def _panels(count: int, columns: int, height: float) -> tuple[Figure, list[Axes]]:
    """Return a figure and its panels in rows of a height [inch]."""
    rows = -(-count // columns)
    figure = style.figure(0.6 + rows * height)
    every = figure.subplots(rows, columns, squeeze=False).ravel()
    for ax in every[count:]:
        ax.remove()
    return figure, list(every[:count])


def _dots(ax: Axes, x: np.ndarray, y: np.ndarray) -> None:
    """Draw elements as dots, many of them as pixels in an SVG."""
    size, alpha = (4.5, 0.8) if x.size <= 50 else (3.0, 0.6) if x.size <= 300 else (2.0, 0.45)
    look = {"ms": size, "mew": 0, "alpha": alpha, "color": style.PALE, "zorder": 1}
    ax.plot(x, y, "o", rasterized=x.size > 50, label="_elements", **look)


def _crosses(ax: Axes, x: np.ndarray, y: np.ndarray, **looks: Any) -> None:
    """Mark failed elements."""
    if x.size:
        look = {"ls": "", "marker": "x", "mew": 0.7, "ms": 4.0, "alpha": 0.7, "zorder": 3, **looks}
        colour = {"color": style.VERMILLION, "rasterized": x.size > 50, "clip_on": False}
        ax.plot(x, y, label="_not ok", **look, **colour)


def _first(shown: int, of: int, what: str) -> str:
    return f"the first {shown} of {of} {what}" if shown < of else ""


def _not_finite(table: Table, y: Column) -> str:
    count = int(np.count_nonzero(table.ok)) - int(np.count_nonzero(y.used))
    return f"{count} not finite" if count and not y.empty else ""


def _random_choice(elements: np.ndarray, most: int) -> np.ndarray:
    """Return at most `most` of the elements, a random choice."""
    if elements.size <= most:
        return elements
    # Every k-th element of a grid would show only a few values of an axis.
    return elements[np.sort(np.random.default_rng(0).choice(elements.size, most, replace=False))]


def _numbers(variable: xr.DataArray, elements: np.ndarray) -> np.ndarray:
    """Return a number (n,) for each of some elements, ascending: the mean over flights.

    It is NaN if not finite or too large for Matplotlib.
    """
    values = variable.isel(element=elements).transpose("element", ...).values.astype(np.float64)
    if values.ndim > 1:
        with np.errstate(invalid="ignore", over="ignore"):
            values = values.mean(axis=1)
    sizes = np.abs(values)
    return np.where(sizes < 1e100, np.where(sizes > 1e-100, values, 0.0), np.nan)


_QUANTILES = ("min", "q05", "median", "q95", "max")
_FILES = ("config.yaml", "summary.json", "figures/")
_DIGITS = 4
_KINDS = {
    "slices": ("{} against each axis", "dots, and the median with a 5 to 95 % band"),
    "maps": ("{} over pairs of axes", "colours: median of the elements in each cell"),
}
"""Title and caption of a figure by the beginning of its file name."""


def write_page(path: Path, directory: Path, title: str) -> None:
    """Write the page."""
    content = json.loads((directory / "summary.json").read_text(encoding="utf-8"))
    config = directory / "config.yaml"
    text = config.read_text(encoding="utf-8") if config.is_file() else ""
    files = tuple(name for name in _FILES if (directory / name).exists())
    page = filled(
        "sweep.html.j2",
        title=title,
        summary=content,
        counts=", ".join(f"{n} {s.replace('_', ' ')}" for s, n in content["status"].items() if n),
        results=_results(content),
        elements=_elements(content),
        pictures=list(_pictures(content, directory / "figures")),
        origin=origin(text, files),
    )
    path.write_text(page, encoding="utf-8")


# Any: content of summary.json.
def _results(content: dict[str, Any]) -> tables.Table:
    rows = [
        (name, *(number(r.get(k), _DIGITS) for k in _QUANTILES), pretty(r.get("unit")))
        for name, r in content["results"].items()
    ]
    return tables.Table(("result", "min", "5 %", "median", "95 %", "max", "unit"), rows)


def _elements(content: dict[str, Any]) -> tables.Table:
    """Return the worst and best elements of each result, with their axes."""
    listed = [
        (name, words, pretty(content["results"].get(name, {}).get("unit")), element)
        for words in ("worst", "best")
        for name, elements in content[words].items()
        for element in elements
    ]
    axes = list(dict.fromkeys(axis for *_, e in listed for axis in e["axes"]))
    rows = []
    for name, words, unit, e in listed:
        value, *places = (number(v, _DIGITS) for v in (e.get("value"), *map(e["axes"].get, axes)))
        rows.append((name, words, value, unit, str(e["element"]), *places))
    return tables.Table(("result", "which", "value", "unit", "element", *axes), rows)


def _pictures(content: dict[str, Any], folder: Path) -> Iterator[tuple[Picture, str]]:
    """Yield the figures with their captions."""
    for name, stem in file_names(list(content["results"])).items():
        result = content["results"][name]
        unit, ends = pretty(result.get("unit")), (number(result.get(k), 3) for k in ("min", "max"))
        numbers = f"{name} {' to '.join(ends)}{'' if unit == NOTHING else f' {unit}'}"
        for kind, (title, words) in _KINDS.items():
            png = folder / f"{kind}-{stem}.png"
            if png.is_file():
                words = f"{title.format(name)}: {words}."
                made = of_file(png, title.format(name), f"{words} Over the sweep {numbers}.")
                yield made, f"{words} (figures/{png.stem}.svg, .png)"
