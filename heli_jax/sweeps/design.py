"""Designs: which values the axes of a sweep take, element by element.

A design gives its values in slices, so that a sweep of any size takes little memory: a grid and a
Sobol sequence are computed where they are needed (a Latin hypercube and a table are held whole).
Values are in SI; a configuration's units are converted before.
"""

import dataclasses
import functools
import hashlib
import math
import threading
from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple, Protocol, runtime_checkable

import numpy as np

_MOST_SOBOL = 2**30
"""points, after which SciPy's sequence would begin again"""
_engines = threading.Lock()
Columns = dict[str, np.ndarray]


class Range(NamedTuple):
    """An axis from `lower` to `upper`, in SI, evenly in the value or in its logarithm."""

    lower: float
    upper: float
    scale: Literal["linear", "log"] = "linear"
    n: int | None = None
    """points, for a grid"""

    def at(self, fraction: np.ndarray) -> np.ndarray:
        """The value at fractions (k,) of the way, 0 to 1; the ends are exact."""
        # A weighted mean and no difference: that of two huge ends would overflow.
        low, high = float(self.lower), float(self.upper)
        if self.scale == "log":
            # Both ends are negative or both positive, which was checked; the logarithm is of their
            # size.
            sign = math.copysign(1.0, low)
            values = sign * np.exp(
                (1.0 - fraction) * math.log(abs(low)) + fraction * math.log(abs(high))
            )
        else:
            values = (1.0 - fraction) * low + fraction * high
        # exp(log(0.1)) is not 0.1: who asks for an end gets it to the last bit.
        return np.where(fraction == 0.0, low, np.where(fraction == 1.0, high, values))


def digest(arrays: Mapping[str, np.ndarray]) -> str:
    """SHA-256 of named arrays, whatever their order."""
    sha = hashlib.sha256()
    # In order of the names, since two dictionaries with the same arrays may have been filled in
    # another order.
    for name in sorted(arrays):
        v = np.ascontiguousarray(arrays[name])
        # Type and shape too: the bytes of two arrays may be equal where their numbers are not.
        sha.update(f"{name}:{v.dtype.str}:{v.shape}:".encode())
        sha.update(v.tobytes())
    return sha.hexdigest()


def check_range(name: str, axis: Range) -> None:
    """Refuse an axis without a beginning below its end.

    Raises:
        ValueError: naming the axis.
    """
    low, high = axis.lower, axis.upper
    if not (math.isfinite(low) and math.isfinite(high) and low < high):
        raise ValueError(f"axes.{name}: expected finite lower < upper, got {low:g} and {high:g}")
    if axis.scale not in ("linear", "log"):
        raise ValueError(f"axes.{name}.scale: expected linear or log, got {axis.scale!r}")
    if axis.scale == "log" and low * high <= 0:
        raise ValueError(
            f"axes.{name}: expected lower and upper of one sign on a log scale, got {low:g} and "
            f"{high:g}"
        )


def check_axes(axes: Mapping[str, object]) -> None:
    """Refuse a design without axes.

    Raises:
        ValueError: there is none.
    """
    if not axes:
        raise ValueError("axes: none given, expected at least one")


def axis_values(name: str, axis: Range | Sequence[float] | np.ndarray) -> np.ndarray:
    """The values (k,) of one axis of a grid or a list.

    Raises:
        ValueError: there is none, or they are no numbers.
    """
    if isinstance(axis, Range):
        check_range(name, axis)
        if axis.n is None or axis.n < 2:
            got = "none" if axis.n is None else axis.n
            raise ValueError(f"axes.{name}.n: expected at least 2 points, got {got}")
        values = axis.at(np.linspace(0.0, 1.0, axis.n))
        even = axis.scale == "linear" and (axis.upper - axis.lower) % (axis.n - 1) == 0.0
        # From 0 to 9 in ten points: 7 and not 6.999999999999999, which as a seed would be 6.
        return np.round(values) if even and axis.lower == round(axis.lower) else values
    values = np.asarray(axis)
    if values.ndim != 1 or values.size == 0:
        raise ValueError(f"axes.{name}: no values, expected at least one")
    if values.dtype.kind not in "iuf":
        raise ValueError(f"axes.{name}: expected numbers, got {values[0]!r:.40}")
    # Whole numbers stay whole, so that seeds stand as integers in the store.
    return values if values.dtype.kind in "iu" else values.astype(np.float64)


def whole_seeds(values: np.ndarray) -> np.ndarray:
    """Seeds (k,) as whole numbers.

    Raises:
        ValueError: one is none.
    """
    # Refused and not rounded: 6.999, from a range that was not meant for seeds, would be seed 6.
    # They reach JAX as uint32, so larger ones would draw what smaller ones do.
    whole = np.isfinite(values) & (values == np.round(values)) & (values >= 0)
    wrong = values[~(whole & (values < 2**32))]
    if wrong.size:
        raise ValueError(
            f"axes.seed: expected whole numbers from 0 to 2^32 - 1, got {wrong[0]:.10g}"
        )
    return values.astype(np.int64)


@runtime_checkable
class Design(Protocol):
    """Interface of a design for `sweep`."""

    @property
    def names(self) -> tuple[str, ...]:
        """The axes."""
        ...

    @property
    def size(self) -> int:
        """Number of elements."""
        ...

    def values(self, start: int, stop: int) -> Columns:
        """The values of the elements from start to stop: an array (stop - start,) for each axis."""
        ...

    def describe(self) -> dict[str, Any]:
        """All that fixes the values, as plain data: two designs with the same are the same."""
        ...


class _Paired(NamedTuple):
    """Columns that are held whole, the k-th of each for element k."""

    columns: Columns
    kind: str
    """list or table: the word that stores have for it"""

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(self.columns)

    @property
    def size(self) -> int:
        return next(iter(self.columns.values())).size

    def values(self, start: int, stop: int) -> Columns:
        return {n: v[start:stop] for n, v in self.columns.items()}

    def describe(self) -> dict[str, Any]:
        # A digest in place of the values: a table may be larger than all results.
        words = {"design": self.kind, "axes": list(self.columns), "n": self.size}
        return {**words, "sha256": digest(self.columns)}


class _Grid(NamedTuple):
    """Every combination of the axes' values."""

    axes: Columns

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(self.axes)

    @property
    def size(self) -> int:
        return math.prod(v.size for v in self.axes.values())

    def values(self, start: int, stop: int) -> Columns:
        # An element's number in mixed radix, a digit for each axis, the last one least: no product
        # of the axes has to be held.
        k = np.arange(start, stop)
        columns = {}
        for name, v in reversed(self.axes.items()):
            columns[name] = v[k % v.size]
            k = k // v.size
        return {n: columns[n] for n in self.axes}

    def describe(self) -> dict[str, Any]:
        return {"design": "grid", "axes": {n: v.tolist() for n, v in self.axes.items()}}


class _Sampled:
    """Points of the unit cube, mapped to the axes."""

    def __init__(self, axes: Mapping[str, Range], n: int, seed: int, kind: str) -> None:
        # At once and not with the first points: a sweep may run for a while before it asks for
        # these.
        check_axes(axes)
        for name, axis in axes.items():
            if not isinstance(axis, Range):
                raise ValueError(f"axes.{name}: expected lower and upper, for {kind}")
            check_range(name, axis)
        if n < 1:
            raise ValueError(f"n must be at least 1, got {n}")
        if kind == "sobol" and n > _MOST_SOBOL:
            raise ValueError(f"n must be at most {_MOST_SOBOL} in a Sobol sequence, got {n}")
        self.axes, self._n, self.seed, self.kind = dict(axes), n, seed, kind

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(self.axes)

    @property
    def size(self) -> int:
        return self._n

    @functools.cached_property
    def _hypercube(self) -> np.ndarray:
        import scipy.stats.qmc  # not before it is needed: slow

        # Whole, since where a point lies depends on all others: a slice cannot be drawn alone.
        rng = np.random.default_rng(self.seed)
        return scipy.stats.qmc.LatinHypercube(len(self.axes), rng=rng).random(self._n)

    def values(self, start: int, stop: int) -> Columns:
        if self.kind == "lhs":
            points = self._hypercube[start:stop]
        else:
            points = _sobol_points(len(self.axes), self.seed, start, stop)
        return {n: axis.at(points[:, i]) for i, (n, axis) in enumerate(self.axes.items())}

    def describe(self) -> dict[str, Any]:
        axes = {n: [a.lower, a.upper, a.scale] for n, a in self.axes.items()}
        return {"design": self.kind, "axes": axes, "n": self._n, "seed": self.seed}


@functools.lru_cache(maxsize=8)
def _sobol_engine(axes: int, seed: int) -> Any:
    import scipy.stats.qmc  # not before it is needed: slow

    return scipy.stats.qmc.Sobol(axes, rng=np.random.default_rng(seed))


def _sobol_points(axes: int, seed: int, start: int, stop: int) -> np.ndarray:
    """Points start to stop (stop - start, axes) of a scrambled sequence in the unit cube."""
    # One engine goes along with the slices in turn: to come to a point takes as long as to draw all
    # before it.
    with _engines:
        engine = _sobol_engine(axes, seed)
        if engine.num_generated > start:
            engine.reset()
        if start > engine.num_generated:
            engine.fast_forward(start - engine.num_generated)
        # SciPy warns of numbers that are no power of two, which is right for a sequence and not for
        # a slice: the first point alone is 1.
        first = [engine.random(1)] if start == 0 < stop else []
        return np.concatenate([*first, engine.random(stop - start - len(first))])


@dataclasses.dataclass(frozen=True)
class _Combined:
    """Designs that together are one, each with axes of its own."""

    parts: tuple[Design, ...]

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(n for part in self.parts for n in part.names)


class _Product(_Combined):
    @property
    def size(self) -> int:
        return math.prod(part.size for part in self.parts)

    def values(self, start: int, stop: int) -> Columns:
        k = np.arange(start, stop)
        columns: Columns = {}
        for part in reversed(self.parts):
            index = k % part.size
            k = k // part.size
            # Only the rows of the part that the slice touches: the part may be as large as a sweep.
            # An empty slice has no least row; it still has its axes, with no values.
            low, high = (int(index.min()), int(index.max()) + 1) if index.size else (0, 0)
            rows = part.values(low, high)
            columns = {**{n: v[index - low] for n, v in rows.items()}, **columns}
        return columns

    def describe(self) -> dict[str, Any]:
        return {"design": "product", "of": [part.describe() for part in self.parts]}


class _Zipped(_Combined):
    @property
    def size(self) -> int:
        # `zipped` has checked that all parts are of one size.
        return self.parts[0].size

    def values(self, start: int, stop: int) -> Columns:
        # No axis is in two parts, so none is lost here.
        return {n: v for part in self.parts for n, v in part.values(start, stop).items()}

    def describe(self) -> dict[str, Any]:
        return {"design": "zip", "of": [part.describe() for part in self.parts]}


def grid(axes: Mapping[str, Range | Sequence[float]]) -> Design:
    """Every combination of the axes' values, the last axis fastest.

    Raises:
        ValueError: no axis, one without points, or ends that do not fit.
    """
    check_axes(axes)
    return _Grid({n: axis_values(n, a) for n, a in axes.items()})


def paired(axes: Mapping[str, Range | Sequence[float]]) -> Design:
    """The axes' values side by side: element k takes the k-th of each.

    Raises:
        ValueError: no axis, one without values, or axes of different length.
    """
    check_axes(axes)
    columns = {n: axis_values(n, a) for n, a in axes.items()}
    lengths = {n: v.size for n, v in columns.items()}
    if len(set(lengths.values())) > 1:
        words = ", ".join(f"{n} has {k}" for n, k in lengths.items())
        # Told with all lengths: which of the axes is the wrong one only the user knows.
        raise ValueError(f"axes: {words} values, expected the same number in a list")
    return _Paired(columns, "list")


def table(columns: Mapping[str, np.ndarray]) -> Design:
    """The rows of a table, a column for each axis; not-a-number is an element that will be flagged.

    Raises:
        ValueError: no column, no row, or columns of different length.
    """
    check_axes(columns)
    axes = {n: axis_values(n, v) for n, v in columns.items()}
    if len({v.size for v in axes.values()}) > 1:
        words = ", ".join(f"{n} has {v.size}" for n, v in axes.items())
        raise ValueError(f"the table's columns differ in length: {words}, expected one length")
    return _Paired(axes, "table")


def lhs(axes: Mapping[str, Range], n: int, seed: int = 0) -> Design:
    """A Latin hypercube of n points (`scipy.stats.qmc.LatinHypercube`).

    Args:
        axes: by name, from where to where, SI.
        seed: of the points; the same one gives the same.

    Raises:
        ValueError: no axis, ends that do not fit, or no points.
    """
    return _Sampled(axes, n, seed, "lhs")


def sobol(axes: Mapping[str, Range], n: int, seed: int = 0) -> Design:
    """The first n points of a scrambled Sobol sequence (`scipy.stats.qmc.Sobol`).

    Args:
        axes: by name, from where to where, SI.
        n: elements; a power of two is most even.
        seed: of the scrambling; the same one gives the same points.

    Raises:
        ValueError: no axis, ends that do not fit, or no points.
    """
    return _Sampled(axes, n, seed, "sobol")


def log_axes(design: Design) -> set[str]:
    """The axes that a design fills evenly in the logarithm."""
    # Designs nest to any depth, and each axis is in one of them.
    if isinstance(design, _Combined):
        return set().union(*map(log_axes, design.parts))
    if isinstance(design, _Sampled):
        return {n for n, axis in design.axes.items() if axis.scale == "log"}
    if isinstance(design, _Grid):
        return {n for n, values in design.axes.items() if _geometric(values)}
    return set()


def _geometric(values: np.ndarray) -> bool:
    """True if each value is the one before times the same factor."""
    if values.size < 3 or not (np.all(values > 0) or np.all(values < 0)):
        return False
    steps = np.diff(np.log(np.abs(values)))
    return bool(steps[0]) and bool(np.allclose(steps, steps[0], rtol=1e-6, atol=0.0))


def _check_parts(parts: tuple[Design, ...]) -> None:
    if not parts:
        raise ValueError("of: no designs, expected at least one")
    seen: set[str] = set()
    for name in (n for part in parts for n in part.names):
        # Which of two designs sets the axis would depend on their order.
        if name in seen:
            raise ValueError(f"the axis {name!r} is in two designs, expected one")
        seen.add(name)


def product(*parts: Design) -> Design:
    """Every element of each design with every element of the others, the last fastest.

    Raises:
        ValueError: no design, or an axis in two of them.
    """
    _check_parts(parts)
    return _Product(parts)


def zipped(*parts: Design) -> Design:
    """Designs of one size side by side.

    Raises:
        ValueError: no design, an axis in two of them, or designs of different sizes.
    """
    _check_parts(parts)
    sizes = [part.size for part in parts]
    if len(set(sizes)) > 1:
        words = " and ".join(str(s) for s in sizes)
        raise ValueError(f"the designs have {words} elements, expected the same number in a zip")
    return _Zipped(parts)
