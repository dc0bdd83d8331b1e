"""What is drawn of a sweep: its axes and results as columns of numbers, and which of them count.

A place is a value as it lies on the paper: its logarithm where the scale is logarithmic.
"""

import functools
from collections.abc import Iterable

import numpy as np
import xarray as xr

from heli_jax.sweeps.datasets import chunks_of

# Factor over which numbers of one sign are drawn logarithmically: on a linear scale the lower half
# of that range, in decades, would lie within a sixth of the panel.
WIDE = 30.0
# Elements that are ok and drawn at most, and of the others half as many: more change no quantile
# that the eye could see, and memory shall not grow with the sweep.
DRAWN = 1 << 18
# Elements that are marked in a panel at most.
MARKS = 300
# The status of an element that counts; that of heli_jax.sweeps, whose import takes JAX.
_OK = 0
# Distinct values that are cells of their own, so that a grid is seen at its own resolution. A map
# of two axes counts its cells in 16 bits: 181 by 181 at most.
_FEW_CELLS = 180


class Column:
    """An axis or a result: a number (n,) for each element drawn, NaN where it is not finite.

    `alone` says that it is the only axis of the sweep.
    """

    def __init__(
        self, variable: xr.DataArray, elements: np.ndarray, ok: np.ndarray, *, axis: bool,
        alone: bool,
    ) -> None:  # fmt: skip
        self.name = str(variable.name)
        unit = variable.attrs.get("units")
        self.unit = None if unit is None else str(unit)
        self.flights = variable.sizes.get("flight", 0)
        # The mean over flights of whole numbers is none.
        self.whole = variable.dtype.kind in "biu" and not self.flights
        self.values = _numbers(variable, elements)
        self.finite = np.isfinite(self.values)
        self.used = self.finite & ok
        self.axis = axis
        self._declared_log = axis and variable.attrs.get("scale") == "log"
        self._alone = alone
        # An axis shows where elements failed, too; of a result the failed have no value.
        self._seen = self.finite if axis else self.used
        self._cells: dict[int, tuple[np.ndarray, np.ndarray]] = {}

    def title(self) -> str:
        """Its name, and of what it is the mean."""
        if self.flights:
            return f"{self.name}, mean over {self.flights} flights"
        return self.name

    @functools.cached_property
    def _order(self) -> np.ndarray:
        """Elements that set the scale, by value."""
        # Sorted once for all panels: quantiles, medians of cells and distinct values come of it.
        order = np.argsort(self.values)
        return order[self._seen[order]]

    @functools.cached_property
    def ranked(self) -> np.ndarray:
        """Elements that count, by value."""
        return self._order[self.used[self._order]]

    @functools.cached_property
    def empty(self) -> bool:
        """Whether it has no finite value."""
        return not self._seen.any()

    @functools.cached_property
    def distinct(self) -> np.ndarray:
        """Distinct values, ascending."""
        ordered = self.values[self._order]
        return ordered[np.concatenate([[True], np.diff(ordered) > 0])]

    def few(self, most: int) -> np.ndarray | None:
        """The distinct values of an axis, or of whole numbers, if there are few for so many
        elements."""
        k = self.distinct.size
        # A sample of a continuous axis has few values where it has few elements: each must come
        # twice to be a value that was chosen. A single axis is taken at its word.
        often = 2 * k <= self._order.size or self._alone
        discrete = (self.axis or self.whole) and k <= most and often
        return self.distinct if discrete or k == 1 else None

    def _at(self, share: float) -> float:
        """The value that a share of the elements is below."""
        return float(self.values[self._order[round(share * (self._order.size - 1))]])

    @functools.cached_property
    def log(self) -> bool:
        """Whether it is drawn logarithmically; a result by its bulk, not by single elements."""
        ends = self._at(0.0), self._at(1.0)
        if ends[0] <= 0.0 <= ends[1] or (self.whole and not self.axis):
            return False
        if self._declared_log:
            return True
        low, high = ends if self.axis else (self._at(0.01), self._at(0.99))
        return max(abs(low), abs(high)) > WIDE * min(abs(low), abs(high))

    @functools.cached_property
    def sign(self) -> float:
        """Of all its values, where it is drawn logarithmically."""
        return -1.0 if self._at(1.0) < 0.0 else 1.0

    def transform(self, values: np.ndarray | float) -> np.ndarray:
        """The places of values."""
        # Ascending for negative numbers too, as matplotlib's symlog has them.
        return self.sign * np.log10(np.abs(values)) if self.log else np.asarray(values, float)

    def inverse(self, places: np.ndarray | float) -> np.ndarray:
        """The values at places."""
        places = np.asarray(places)
        return self.sign * 10.0 ** (self.sign * places) if self.log else places

    @functools.cached_property
    def _places(self) -> np.ndarray:
        with np.errstate(invalid="ignore", divide="ignore"):
            return self.transform(self.values)

    @functools.cached_property
    def _range(self) -> tuple[float, float]:
        return float(self.transform(self._at(0.0))), float(self.transform(self._at(1.0)))

    @functools.cached_property
    def view(self) -> tuple[float, float]:
        """From the least to the largest place drawn: all of an axis, and of a result without
        single elements that would press the others flat."""
        low, high = self._range
        inner = [float(self.transform(self._at(q))) for q in (0.01, 0.99)]
        bulk = inner[1] - inner[0]
        # Only where they press hard: most results have tails that belong in the picture.
        if not self.axis and 0.0 < 4.0 * bulk < high - low:
            low, high = max(low, inner[0] - 0.3 * bulk), min(high, inner[1] + 0.3 * bulk)
        return widened(low, high)

    @property
    def cut(self) -> bool:
        """Whether single elements lie beyond the view."""
        return self.view[0] > self._range[0] or self.view[1] < self._range[1]

    def cells(self, k: int) -> tuple[np.ndarray, np.ndarray]:
        """Edges of cells, as places, and the cell of each element (n,), -1 outside.

        There are k even cells, or one for each of few values.
        """
        if k not in self._cells:
            values = self.few(_FEW_CELLS)
            if values is None:
                low, high = self.view
                edges = np.linspace(low, high, k + 1)
                with np.errstate(invalid="ignore"):
                    # Even cells need no search among the edges. With some slack, or rounding would
                    # put the ends of the view outside.
                    scaled = (self._places - low) * (k / (high - low))
                    inside = (scaled >= -1e-9) & (scaled <= k + 1e-9) & self.finite
                which = np.where(inside, scaled, 0.0).astype(np.int16).clip(0, k - 1)
            else:
                edges, inside = _around(self.transform(values), self.view), self.finite
                which = np.searchsorted(0.5 * (values[1:] + values[:-1]), self.values)
            self._cells[k] = edges, np.where(inside, which, -1).astype(np.int16)
        return self._cells[k]

    def ends(self, k: int) -> tuple[float, float]:
        """The first and the last edge of the cells."""
        edges, _ = self.cells(k)
        return float(edges[0]), float(edges[-1])


class Table:
    """What is drawn of a sweep, read and sorted once: all of it, or of a large one a lot."""

    def __init__(self, ds: xr.Dataset, named: Iterable[np.ndarray] = ()) -> None:
        """`named` are elements that are drawn in any case."""
        self._ds = ds
        ok = ds["status"].to_numpy() == _OK
        self.size, self.n_ok = ok.size, int(np.count_nonzero(ok))
        self.elements = _drawn(ok, named)
        """which elements, ascending, (n,)"""
        self.ok = ok[self.elements]
        self._axes = [str(n) for n in ds.attrs["axes"]]
        self.results = results(ds)
        self._columns: dict[str, Column] = {}

    def column(self, name: str) -> Column:
        """An axis or a result, read when it is first asked for."""
        if name not in self._columns:
            axis, alone = name in self._axes, len(self._axes) == 1
            self._columns[name] = Column(
                self._ds[name], self.elements, self.ok, axis=axis, alone=alone
            )
        return self._columns[name]

    @functools.cached_property
    def axes(self) -> list[Column]:
        """The axes that have a finite value."""
        return [c for c in map(self.column, self._axes) if not c.empty]

    @property
    def some(self) -> bool:
        """Whether not all elements are drawn."""
        return self.elements.size < self.size

    def at(self, elements: np.ndarray) -> np.ndarray:
        """Where elements of the sweep stand in the columns."""
        return np.searchsorted(self.elements, elements)

    def failed(self, *columns: Column, most: int = MARKS) -> np.ndarray:
        """Elements that are not ok where these columns are finite, so many at most."""
        where = ~self.ok
        for c in columns:
            where = where & c.finite
        return by_lot(np.flatnonzero(where), most)


def _drawn(ok: np.ndarray, named: Iterable[np.ndarray]) -> np.ndarray:
    """All elements, or a lot of those that are ok, one of the others, and those named."""
    if ok.size <= DRAWN:
        return np.arange(ok.size)
    lots = by_lot(np.flatnonzero(ok), DRAWN), by_lot(np.flatnonzero(~ok), DRAWN // 2)
    return np.unique(np.concatenate([*lots, *(np.asarray(e, np.int64) for e in named)]))


def widened(low: float, high: float) -> tuple[float, float]:
    """A range that is more than a point."""
    if high - low > 1e-9 * max(abs(low), abs(high)):
        return low, high
    middle, half = 0.5 * (low + high), 0.05 * max(abs(low), abs(high)) or 0.5
    return middle - half, middle + half


def by_lot(elements: np.ndarray, most: int) -> np.ndarray:
    """At most so many of the elements, drawn by lot."""
    if elements.size <= most:
        return elements
    # Not every k-th: of a grid that would show a few values of an axis alone. The seed is always
    # the same, so that a figure that is drawn again is the same.
    return elements[np.sort(np.random.default_rng(0).choice(elements.size, most, replace=False))]


def results(ds: xr.Dataset) -> list[str]:
    """The results that are drawn: those with a number for each element."""
    return [str(n) for n, v in ds.data_vars.items() if _is_result(v)]


def _is_result(variable: xr.DataArray) -> bool:
    """Whether a variable has one number for each element, or for each and each flight."""
    dims = {str(d) for d in variable.dims}
    return (
        "element" in dims
        and dims <= {"element", "flight"}
        and variable.dtype.kind in "biuf"
        and not str(variable.name).startswith("trajectory_")
    )


def _numbers(variable: xr.DataArray, elements: np.ndarray) -> np.ndarray:
    """A number (n,) for each of some elements, ascending: the mean over flights, NaN where it is
    not finite.

    Numbers that no picture can hold are taken as infinite, or as zero.
    """
    parts = []
    for which, part in chunks_of(variable):
        first, last = np.searchsorted(elements, [which.start, which.stop])
        parts.append(part[elements[first:last] - which.start].astype(np.float64))
    values = np.concatenate(parts) if parts else np.empty(0)
    if values.ndim > 1:
        with np.errstate(invalid="ignore", over="ignore"):
            values = values.mean(axis=1)
    # matplotlib multiplies and divides them, which near the ends of float64 makes infinities.
    sizes = np.abs(values)
    return np.where(sizes < 1e100, np.where(sizes > 1e-100, values, 0.0), np.nan)


def _around(places: np.ndarray, view: tuple[float, float]) -> np.ndarray:
    """Edges (k + 1,) of cells around places (k,), ascending."""
    if places.size == 1:
        return np.asarray(view)
    between = 0.5 * (places[1:] + places[:-1])
    first, last = 2 * places[0] - between[0], 2 * places[-1] - between[-1]
    return np.concatenate([[first], between, [last]])
