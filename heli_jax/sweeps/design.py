"""Designs of experiments: values of a sweep's axes for each element.

A design yields its values in slices. A grid is computed on demand, so it takes little memory; other
designs are held whole. Values are in SI; a configuration's units are converted beforehand.
"""

import dataclasses
import functools
import hashlib
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np

_MOST_SOBOL = 2**30
"""Most points: SciPy's sequence then repeats."""
Columns = dict[str, np.ndarray]


class Range(NamedTuple):
    """An axis from `lower` to `upper`, in SI, with linear or logarithmic spacing."""

    lower: float
    upper: float
    scale: Literal["linear", "log"] = "linear"
    n: int | None = None
    """Number of points, for a grid."""

    def at(self, fraction: np.ndarray) -> np.ndarray:
        """Return the values at fractions (k,) from 0 to 1; the ends are exact."""
        # A weighted mean, because the difference of two huge ends would overflow.
        low, high = float(self.lower), float(self.upper)
        if self.scale == "log":
            # Both ends have the same sign, which was checked; the logarithm is of their magnitude.
            sign = math.copysign(1.0, low)
            values = sign * np.exp(
                (1.0 - fraction) * math.log(abs(low)) + fraction * math.log(abs(high))
            )
        else:
            values = (1.0 - fraction) * low + fraction * high
        # exp(log(0.1)) is not exactly 0.1, but the ends must be.
        return np.where(fraction == 0.0, low, np.where(fraction == 1.0, high, values))


def digest(arrays: Mapping[str, np.ndarray]) -> str:
    """Return the SHA-256 of named arrays, in any order."""
    sha = hashlib.sha256()
    # Sorted by name, because equal dictionaries may have another order.
    for name in sorted(arrays):
        v = np.ascontiguousarray(arrays[name])
        # With type and shape, because arrays with equal bytes may have different numbers.
        sha.update(f"{name}:{v.dtype.str}:{v.shape}:".encode())
        sha.update(v.tobytes())
    return sha.hexdigest()


def check_range(name: str, axis: Range) -> None:
    """Refuse an axis unless its lower end is below its upper end.

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
    """Return the values (k,) of one axis of a grid or a list.

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
    # Integers stay integers, so that seeds are integers in the store.
    return values if values.dtype.kind in "iu" else values.astype(np.float64)


def whole_seeds(values: np.ndarray) -> np.ndarray:
    """Return seeds (k,) as integers.

    Raises:
        ValueError: one is no valid seed.
    """
    # Refused, not rounded: 6.999, from a range that was not meant for seeds, would be seed 6. JAX
    # uses uint32, so larger seeds would repeat smaller ones.
    whole = np.isfinite(values) & (values == np.round(values)) & (values >= 0)
    wrong = values[~(whole & (values < 2**32))]
    if wrong.size:
        raise ValueError(
            f"axes.seed: expected whole numbers from 0 to 2^32 - 1, got {wrong[0]:.10g}"
        )
    return values.astype(np.int64)


@dataclasses.dataclass(frozen=True)
class Design:
    """Values of the axes of a sweep."""

    names: tuple[str, ...]
    """Names of the axes."""
    size: int
    """Number of elements."""
    values: Callable[[int, int], Columns]
    """Function of (start, stop) that returns their elements' values (stop - start,) by axis."""
    description: dict[str, Any]
    """Plain data that fully define the values; equal descriptions mean equal designs."""
    logarithmic: frozenset[str] = frozenset()
    """Axes with logarithmic spacing."""


def grid(axes: Mapping[str, Range | Sequence[float]]) -> Design:
    """Return every combination of the axes' values, the last axis fastest.

    Raises:
        ValueError: no axis, one without points, or invalid ends.
    """
    check_axes(axes)
    points = {n: axis_values(n, a) for n, a in axes.items()}

    def values(start: int, stop: int) -> Columns:
        # The element's number in mixed radix has a digit for each axis, so the product of the axes
        # need not be stored.
        k = np.arange(start, stop)
        columns = {}
        for name, v in reversed(points.items()):
            columns[name] = v[k % v.size]
            k = k // v.size
        return {n: columns[n] for n in points}

    size = math.prod(v.size for v in points.values())
    description = {"design": "grid", "axes": {n: v.tolist() for n, v in points.items()}}
    return Design(tuple(points), size, values, description, _logarithmic(axes))


def _logarithmic(axes: Mapping[str, Any]) -> frozenset[str]:
    return frozenset(
        n for n, axis in axes.items() if isinstance(axis, Range) and axis.scale == "log"
    )


def paired(axes: Mapping[str, Range | Sequence[float]]) -> Design:
    """Pair the axes' values: element k takes the k-th of each.

    Raises:
        ValueError: no axis, one without values, or axes of different length.
    """
    return _columns(axes, "list")


def table(columns: Mapping[str, np.ndarray]) -> Design:
    """Return the rows of a table, a column for each axis; an element with NaN will be flagged.

    Raises:
        ValueError: no column, no row, or columns of different length.
    """
    return _columns(columns, "table")


def _columns(axes: Mapping[str, Any], kind: str) -> Design:
    """Return a design from stored columns, the k-th value of each for element k."""
    check_axes(axes)
    columns = {n: axis_values(n, a) for n, a in axes.items()}
    if len({v.size for v in columns.values()}) > 1:
        # With all lengths, because only the user knows which axis is wrong.
        words = ", ".join(f"{n} has {v.size}" for n, v in columns.items())
        raise ValueError(f"axes: {words} values, expected the same number in a {kind}")
    size = next(iter(columns.values())).size
    # A digest instead of the values, because a table may be larger than all results.
    description = {"design": kind, "axes": list(columns), "n": size, "sha256": digest(columns)}

    def values(start: int, stop: int) -> Columns:
        return {n: v[start:stop] for n, v in columns.items()}

    return Design(tuple(columns), size, values, description)


def lhs(axes: Mapping[str, Range], n: int, seed: int = 0) -> Design:
    """Return a Latin hypercube of n points (`scipy.stats.qmc.LatinHypercube`).

    Args:
        axes: ranges by name, SI.
        n: number of elements.
        seed: seed of the points; equal seeds give equal points.

    Raises:
        ValueError: no axis, invalid ends, or no points.
    """
    return _sampled(axes, n, seed, "lhs")


def sobol(axes: Mapping[str, Range], n: int, seed: int = 0) -> Design:
    """Return the first n points of a scrambled Sobol sequence (`scipy.stats.qmc.Sobol`).

    Args:
        axes: ranges by name, SI.
        n: number of elements; powers of two are most uniform.
        seed: seed of the scrambling; equal seeds give equal points.

    Raises:
        ValueError: no axis, invalid ends, or no points.
    """
    if n > _MOST_SOBOL:
        raise ValueError(f"n must be at most {_MOST_SOBOL} in a Sobol sequence, got {n}")
    return _sampled(axes, n, seed, "sobol")


def _sampled(axes: Mapping[str, Range], n: int, seed: int, kind: str) -> Design:
    """Map points of the unit cube to the axes."""
    check_axes(axes)
    for name, axis in axes.items():
        if not isinstance(axis, Range):
            raise ValueError(f"axes.{name}: expected lower and upper, for {kind}")
        check_range(name, axis)
    if n < 1:
        raise ValueError(f"n must be at least 1, got {n}")
    ends = {name: [a.lower, a.upper, a.scale] for name, a in axes.items()}

    def values(start: int, stop: int) -> Columns:
        cube = _cube(kind, len(axes), n, seed)[start:stop]
        return {name: axis.at(cube[:, i]) for i, (name, axis) in enumerate(axes.items())}

    description = {"design": kind, "axes": ends, "n": n, "seed": seed}
    return Design(tuple(axes), n, values, description, _logarithmic(axes))


# Whole, because a point of a hypercube depends on all others.
@functools.lru_cache(maxsize=8)
def _cube(kind: str, axes: int, n: int, seed: int) -> np.ndarray:
    """Return the points (n, axes) of a design in the unit cube."""
    from scipy.stats import qmc  # imported on demand: slow

    rng = np.random.default_rng(seed)
    if kind == "lhs":
        return qmc.LatinHypercube(axes, rng=rng).random(n)
    engine = qmc.Sobol(axes, rng=rng)
    # SciPy warns of a count that is no power of two, unless the first point is drawn alone.
    return np.concatenate([engine.random(1), engine.random(n - 1)])


def product(*parts: Design) -> Design:
    """Combine every element of each design with every element of the others, the last fastest.

    Raises:
        ValueError: no design, or an axis in two of them.
    """

    def values(start: int, stop: int) -> Columns:
        k = np.arange(start, stop)
        columns: Columns = {}
        for part in reversed(parts):
            index = k % part.size
            k = k // part.size
            # Only the rows of the part that the slice touches, because the part may be as large as
            # a sweep. An empty slice has no smallest row, but it has axes without values.
            low, high = (int(index.min()), int(index.max()) + 1) if index.size else (0, 0)
            rows = part.values(low, high)
            columns = {**{n: v[index - low] for n, v in rows.items()}, **columns}
        return columns

    return _combined(parts, math.prod(part.size for part in parts), values, "product")


def zipped(*parts: Design) -> Design:
    """Pair designs of one size.

    Raises:
        ValueError: no design, an axis in two of them, or designs of different sizes.
    """
    sizes = [part.size for part in parts]
    if len(set(sizes)) > 1:
        words = " and ".join(str(s) for s in sizes)
        raise ValueError(f"the designs have {words} elements, expected the same number in a zip")

    def values(start: int, stop: int) -> Columns:
        return {n: v for part in parts for n, v in part.values(start, stop).items()}

    return _combined(parts, max(sizes, default=0), values, "zip")


def _combined(
    parts: tuple[Design, ...], size: int, values: Callable[[int, int], Columns], kind: str
) -> Design:
    """Combine designs with different axes into one."""
    if not parts:
        raise ValueError("of: no designs, expected at least one")
    names = tuple(n for part in parts for n in part.names)
    # Otherwise the order of the designs would decide the axis.
    if twice := [n for n in names if names.count(n) > 1]:
        raise ValueError(f"the axis {twice[0]!r} is in two designs, expected one")
    description = {"design": kind, "of": [part.description for part in parts]}
    logarithmic = frozenset().union(*(part.logarithmic for part in parts))
    return Design(names, size, values, description, logarithmic)
