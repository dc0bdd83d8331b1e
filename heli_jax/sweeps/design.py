"""Designs: which values the axes of a sweep take, element by element.

A design gives its values in slices, so that a sweep of any size takes little memory: a grid and a
Sobol sequence are computed where they are needed (a Latin hypercube and a table are held whole).
"""

import dataclasses
import functools
import hashlib
import math
import warnings
from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple, Protocol

import numpy as np

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
        low, high = float(self.lower), float(self.upper)
        if self.scale == "log":
            sign = math.copysign(1.0, low)
            found = sign * np.exp(
                (1.0 - fraction) * math.log(abs(low)) + fraction * math.log(abs(high))
            )
        else:
            found = (1.0 - fraction) * low + fraction * high
        return np.where(fraction == 0.0, low, np.where(fraction == 1.0, high, found))


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


def digest(arrays: Mapping[str, np.ndarray]) -> str:
    """SHA-256 of named arrays, whatever their order."""
    found = hashlib.sha256()
    for name in sorted(arrays):
        v = np.ascontiguousarray(arrays[name])
        found.update(f"{name}:{v.dtype.str}:{v.shape}:".encode())
        found.update(v.tobytes())
    return found.hexdigest()


def _check_between(name: str, axis: Range) -> None:
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


def _check_axes(axes: Mapping[str, Any]) -> None:
    if not axes:
        raise ValueError("axes: none given, expected at least one")


def _points(name: str, axis: Range | Sequence[float] | np.ndarray) -> np.ndarray:
    """The values of one axis of a grid or a list."""
    if isinstance(axis, Range):
        _check_between(name, axis)
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
    return values if values.dtype.kind in "iu" else values.astype(np.float64)


class _Listed(NamedTuple):
    columns: Columns
    kind: str

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(self.columns)

    @property
    def size(self) -> int:
        return next(iter(self.columns.values())).size

    def values(self, start: int, stop: int) -> Columns:
        return {n: v[start:stop] for n, v in self.columns.items()}

    def describe(self) -> dict[str, Any]:
        found = {"design": self.kind, "axes": list(self.columns), "n": self.size}
        return {**found, "sha256": digest(self.columns)}


class _Grid(NamedTuple):
    axes: Columns

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(self.axes)

    @property
    def size(self) -> int:
        return math.prod(v.size for v in self.axes.values())

    def values(self, start: int, stop: int) -> Columns:
        k = np.arange(start, stop)
        found = {}
        for name, v in reversed(self.axes.items()):
            found[name] = v[k % v.size]
            k = k // v.size
        return {n: found[n] for n in self.axes}

    def describe(self) -> dict[str, Any]:
        return {"design": "grid", "axes": {n: v.tolist() for n, v in self.axes.items()}}


class _Sampled:
    """Points of the unit cube, mapped to the axes."""

    def __init__(self, axes: Mapping[str, Range], n: int, seed: int, kind: str) -> None:
        _check_axes(axes)
        for name, axis in axes.items():
            if not isinstance(axis, Range):
                raise ValueError(f"axes.{name}: expected lower and upper, for {kind}")
            _check_between(name, axis)
        if n < 1:
            raise ValueError(f"n must be at least 1, got {n}")
        self.axes, self._n, self.seed, self.kind = dict(axes), n, seed, kind
        self._idle: list[Any] = []

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(self.axes)

    @property
    def size(self) -> int:
        return self._n

    @functools.cached_property
    def _hypercube(self) -> np.ndarray:
        import scipy.stats.qmc  # not before it is needed: slow

        rng = np.random.default_rng(self.seed)
        return scipy.stats.qmc.LatinHypercube(len(self.axes), rng=rng).random(self._n)

    def values(self, start: int, stop: int) -> Columns:
        points = self._hypercube[start:stop] if self.kind == "lhs" else self._sobol(start, stop)
        return {n: axis.at(points[:, i]) for i, (n, axis) in enumerate(self.axes.items())}

    def _sobol(self, start: int, stop: int) -> np.ndarray:
        """Points (stop - start, axes). SciPy walks through all that it leaves out, so slice after
        slice goes on where the last one ended."""
        import scipy.stats.qmc

        # Taken out while it is used: another thread makes its own.
        try:
            engine = self._idle.pop()
        except IndexError:
            engine = None
        if engine is None or engine.num_generated > start:
            rng = np.random.default_rng(self.seed)
            engine = scipy.stats.qmc.Sobol(len(self.axes), rng=rng)
        if start > engine.num_generated:
            engine.fast_forward(start - engine.num_generated)
        points = _quiet_random(engine, stop - start)
        self._idle.append(engine)
        return points

    def describe(self) -> dict[str, Any]:
        axes = {n: [a.lower, a.upper, a.scale] for n, a in self.axes.items()}
        return {"design": self.kind, "axes": axes, "n": self._n, "seed": self.seed}


def _quiet_random(engine: Any, n: int) -> np.ndarray:
    """Points of a Sobol sequence; SciPy's warning that n is no power of two is left out, since a
    slice of a sequence never is one."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="The balance properties of Sobol")
        return engine.random(n)


@dataclasses.dataclass(frozen=True)
class _Combined:
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
        found: Columns = {}
        for part in reversed(self.parts):
            index = k % part.size
            k = k // part.size
            low, high = (int(index.min()), int(index.max()) + 1) if index.size else (0, 0)
            piece = part.values(low, high)
            found = {**{n: v[index - low] for n, v in piece.items()}, **found}
        return found

    def describe(self) -> dict[str, Any]:
        return {"design": "product", "of": [part.describe() for part in self.parts]}


class _Zipped(_Combined):
    @property
    def size(self) -> int:
        return self.parts[0].size

    def values(self, start: int, stop: int) -> Columns:
        return {n: v for part in self.parts for n, v in part.values(start, stop).items()}

    def describe(self) -> dict[str, Any]:
        return {"design": "zip", "of": [part.describe() for part in self.parts]}


def grid(axes: Mapping[str, Range | Sequence[float]]) -> Design:
    """Every combination of the axes' values, the last axis fastest.

    Raises:
        ValueError: no axis, one without points, or ends that do not fit.
    """
    _check_axes(axes)
    return _Grid({n: _points(n, a) for n, a in axes.items()})


def paired(axes: Mapping[str, Range | Sequence[float]]) -> Design:
    """The axes' values side by side: element k takes the k-th of each.

    Raises:
        ValueError: no axis, one without values, or axes of different length.
    """
    _check_axes(axes)
    columns = {n: _points(n, a) for n, a in axes.items()}
    lengths = {n: v.size for n, v in columns.items()}
    if len(set(lengths.values())) > 1:
        words = ", ".join(f"{n} has {k}" for n, k in lengths.items())
        raise ValueError(f"axes: {words} values, expected the same number in a list")
    return _Listed(columns, "list")


def table(columns: Mapping[str, np.ndarray]) -> Design:
    """The rows of a table, a column for each axis; not-a-number is an element that will be flagged.

    Raises:
        ValueError: no column, no row, or columns of different length.
    """
    _check_axes(columns)
    found = {n: _points(n, v) for n, v in columns.items()}
    if len({v.size for v in found.values()}) > 1:
        raise ValueError("the table's columns differ in length")
    return _Listed(found, "table")


def lhs(axes: Mapping[str, Range], n: int, seed: int = 0) -> Design:
    """A Latin hypercube of n points (`scipy.stats.qmc.LatinHypercube`).

    Raises:
        ValueError: no axis, ends that do not fit, or no points.
    """
    return _Sampled(axes, n, seed, "lhs")


def sobol(axes: Mapping[str, Range], n: int, seed: int = 0) -> Design:
    """The first n points of a scrambled Sobol sequence (`scipy.stats.qmc.Sobol`).

    Raises:
        ValueError: no axis, ends that do not fit, or no points.
    """
    return _Sampled(axes, n, seed, "sobol")


def whole_seeds(values: np.ndarray) -> np.ndarray:
    """Seeds (k,) as whole numbers.

    Raises:
        ValueError: one is none.
    """
    whole = np.isfinite(values) & (values == np.round(values)) & (values >= 0)
    wrong = values[~(whole & (values < 2**32))]
    if wrong.size:
        raise ValueError(
            f"axes.seed: expected whole numbers from 0 to 2^32 - 1, got {wrong[0]:.10g}"
        )
    return values.astype(np.int64)


def log_axes(design: Design) -> set[str]:
    """The axes that a design fills evenly in the logarithm."""
    if isinstance(design, _Combined):
        return set().union(*map(log_axes, design.parts))
    if isinstance(design, _Sampled):
        return {n for n, axis in design.axes.items() if axis.scale == "log"}
    return set()


def _check_parts(parts: tuple[Design, ...]) -> None:
    if not parts:
        raise ValueError("of: no designs, expected at least one")
    seen: set[str] = set()
    for name in (n for part in parts for n in part.names):
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
