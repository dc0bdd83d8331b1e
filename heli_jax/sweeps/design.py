"""Designs: which values the axes of a sweep take, element by element.

A design gives its values in slices, so that a sweep of any size takes little memory: a grid and a
Sobol sequence are computed where they are needed (a Latin hypercube and a table are held whole).
"""

import dataclasses
import functools
import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np

from heli_jax.sweeps.axes import Columns, Range, axis_values, check_axes, check_range, digest
from heli_jax.sweeps.sobol_points import MOST, scrambled_sobol


@runtime_checkable
class Design(Protocol):
    """What `sweep` needs of a design."""

    @property
    def names(self) -> tuple[str, ...]:
        """The axes."""
        ...

    @property
    def size(self) -> int:
        """How many elements there are."""
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
        if kind == "sobol" and n > MOST:
            raise ValueError(f"n must be at most {MOST} in a Sobol sequence, got {n}")
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
            points = scrambled_sobol(len(self.axes), self.seed, start, stop)
        return {n: axis.at(points[:, i]) for i, (n, axis) in enumerate(self.axes.items())}

    def describe(self) -> dict[str, Any]:
        axes = {n: [a.lower, a.upper, a.scale] for n, a in self.axes.items()}
        return {"design": self.kind, "axes": axes, "n": self._n, "seed": self.seed}


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
        n: elements.
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
    """Whether each value is the one before times the same, as those of a range in the logarithm."""
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
