"""Charts: data of a line figure, which the page draws by uPlot and Matplotlib as a file.

A page stores each array once as base64, with two or four bytes for each number.
"""

import base64
import hashlib
import itertools
from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import numpy as np

from heli_jax.numbers import number

PIXELS = 88.0
"""Pixels of the page for one inch of a figure."""


class Series(NamedTuple):
    """A line, points, bars, or a band; arrays (n,)."""

    label: str
    """Empty if the axis has the label."""
    x: np.ndarray
    y: np.ndarray
    """Values, NaN if missing; the lower edge of a band."""
    color: str
    kind: Literal["line", "step", "points", "bars", "band"] = "line"
    low: np.ndarray | None = None
    """Lower edge of bars and bands."""
    high: np.ndarray | None = None
    width: float = 1.1
    """Width of a line or size of a point."""
    dashed: bool = False


class Panel(NamedTuple):
    """One pair of axes."""

    label: str
    """Label of the y axis."""
    series: tuple[Series, ...]
    limits: tuple[float, float]
    height: float = 1.0
    """Height [inch]."""
    levels: tuple[float, ...] = ()
    """Horizontal lines."""
    logarithmic: bool = False


class Chart(NamedTuple):
    """Panels below each other with one x axis."""

    title: str
    x_label: str
    x_limits: tuple[float, float]
    panels: tuple[Panel, ...]
    note: str = ""
    logarithmic: bool = False
    of: str = ""
    """Flight or other owner of the x axis; charts of one owner share cursor and zoom."""


def panel(
    label: str,
    series: Sequence[Series],
    height: float = 1.0,
    *,
    limits: tuple[float, float] | None = None,
    **more: Any,
) -> Panel:
    """Return a panel; by default its limits contain every series with a margin of 5 %."""
    return Panel(label, tuple(series), limits or limits_of(series), height, **more)


def limits_of(series: Sequence[Series]) -> tuple[float, float]:
    """Return limits that contain every series with a margin of 5 %; 0 to 1 without numbers."""
    parts = [v for s in series for v in (s.y, s.low, s.high) if v is not None and v.size]
    y = np.concatenate(parts) if parts else np.empty(0)
    y = y[np.isfinite(y)]
    if not y.size:
        return 0.0, 1.0
    low, high = float(y.min()), float(y.max())
    room = 0.05 * (high - low) or 0.05 * abs(high) or 0.05
    return low - room, high + room


def samples(label: str, x: np.ndarray, y: np.ndarray, color: str, width: float) -> Series:
    """Return the series of a measurement, NaN if missing.

    It is a line, or dots if few samples have neighbours.
    """
    seen = ~np.isnan(y)
    neighbours = np.convolve(seen, [1, 0, 1], "same")[seen] > 0
    if seen.any() and neighbours.mean() < 0.5:
        return Series(label, x[seen], y[seen], color, "points", width=2.2)
    return Series(label, x, y, color, width=width)


def bars(label: str, x: np.ndarray, y: np.ndarray, reach: Any, color: str) -> Series:
    """Return dots with error bars.

    Args:
        reach: lengths of the bars down and up, (2, N), or of both, (N,).
    """
    down, up = np.broadcast_to(np.asarray(reach, float), (2, y.size))
    return Series(label, x, y, color, "bars", y - down, y + up, width=2.2)


def band(x: np.ndarray, low: np.ndarray, high: np.ndarray, color: str) -> Series:
    """Return the band between two lines."""
    return Series("", x, low, color, "band", low, high, width=0.0)


def time_limits(t: np.ndarray) -> tuple[float, float]:
    """Return the first and the last time; 1 s apart for a single sample."""
    return float(t[0]), float(t[-1] if t.size > 1 else t[0] + 1.0)


def thinned(x: np.ndarray, y: np.ndarray, most: int) -> tuple[np.ndarray, np.ndarray]:
    """Return at most `most` points of a line: the ends, and the lowest and highest of each bin.

    Args:
        x: (N,), ascending.
        y: (N,)
        most: number of points to keep, at least 4.
    """
    n = y.size
    if n <= most:
        return x, y
    bins = (most - 2) // 2  # two points for each bin, and the two ends
    edges = np.linspace(0, n, bins + 1).astype(int)
    # A missing sample is neither the lowest nor the highest.
    down, up = np.where(np.isnan(y), np.inf, y), np.where(np.isnan(y), -np.inf, y)
    low = [a + int(np.argmin(down[a:b])) for a, b in itertools.pairwise(edges)]
    high = [a + int(np.argmax(up[a:b])) for a, b in itertools.pairwise(edges)]
    keep = np.unique(np.concatenate([[0, n - 1], low, high]))
    return x[keep], y[keep]


_DESCRIBED = 6
"""Lines of a panel in the text alternative."""


def described(chart: Chart) -> str:
    """Return the text alternative: title, note, and the lines of each panel with their ranges."""
    low, high = chart.x_limits
    over = f"Over {chart.x_label}, {number(low, 3)} to {number(high, 3)}" if chart.x_label else ""
    panels = [text for p in chart.panels if (text := _panel_in_words(p))]
    return ". ".join(s for s in (chart.title, chart.note, over, *panels) if s) + "."


def _panel_in_words(panel: Panel) -> str:
    series = [s for s in panel.series if s.kind != "band" and np.isfinite(s.y).any()]
    words = []
    for s in series[:_DESCRIBED]:
        y = s.y[np.isfinite(s.y)]
        low, high = number(float(y.min()), 3), number(float(y.max()), 3)
        name = s.label or panel.label.partition(" [")[0]
        words.append(f"{name} {low}" + (f" to {high}" if low != high else ""))
    if len(series) > _DESCRIBED:
        words.append(f"{len(series) - _DESCRIBED} further lines")
    return f"{panel.label}: {', '.join(words)}" if words else ""


_BYTES = 380_000
"""Size of all lines of a page above which they are thinned [bytes]."""
_LEAST = 2000
"""Fewest points of a thinned line."""
_MISSING = 65535
_STEPS = 65534
"""Steps of an array's range."""


class Numbers:
    """Arrays and charts of one page."""

    def __init__(self) -> None:
        self.arrays: list[dict[str, Any]] = []
        self._known: dict[bytes, int] = {}
        self._charts: list[Chart] = []

    def add_chart(self, chart: Chart) -> int:
        """Store a chart and return its number on the page."""
        self._charts.append(chart)
        return len(self._charts) - 1

    def content(self) -> dict[str, Any]:
        """Return everything as plain data for JSON."""
        # The number of points of a line depends on the number of different lines.
        lines = {
            hashlib.sha256(np.ascontiguousarray(s.y).tobytes()).digest(): s.y.size
            for chart in self._charts
            for p in chart.panels
            for s in p.series
        }
        most = _most(list(lines.values()))
        charts = [self._chart(chart, most) for chart in self._charts]
        return {"arrays": self.arrays, "charts": charts}

    def array(self, values: np.ndarray, *, exact: bool = False) -> int:
        """Store an array (n,) and return its number on the page.

        Args:
            values: finite, or NaN for a missing number.
            exact: store in single precision, else as fractions of the array's range.
        """
        values = np.ascontiguousarray(values, np.float64)
        key = hashlib.sha256(values.tobytes() + bytes([exact])).digest()
        if key not in self._known:
            self._known[key] = len(self.arrays)
            self.arrays.append(_uniform(values) or (_single(values) if exact else _coarse(values)))
        return self._known[key]

    def _chart(self, chart: Chart, most: int) -> dict[str, Any]:
        panels = []
        for p in chart.panels:
            name = p.label.partition(" [")[0]
            series = [self._series(s, most, name) for s in p.series if s.x.size]
            content = {"series": series, "height": round(p.height * PIXELS)}
            panels.append({**p._asdict(), **content})
        return {**chart._asdict(), "panels": panels}

    def _series(self, s: Series, most: int, name: str) -> dict[str, Any]:
        x, y = (s.x, s.y) if s.low is not None else thinned(s.x, s.y, most)
        ends = {n: self.array(v) for n, v in (("low", s.low), ("high", s.high)) if v is not None}
        kept = {"x": self.array(x, exact=True), "y": self.array(y), "label": s.label or name}
        return {**s._asdict(), "low": None, "high": None, **kept, **ends}


def _most(sizes: list[int]) -> int:
    """Return the most points of a line, so that all lines fit the size limit."""
    # A number takes two bytes, and base64 four letters for three bytes. A thinned line has its own
    # times.
    if sum(sizes) * 2 * 4 / 3 <= _BYTES:
        return max([_LEAST, *sizes])
    return max(_LEAST, int(_BYTES / (6 * 4 / 3) / len(sizes)))


def _uniform(values: np.ndarray) -> dict[str, Any] | None:
    """Return first value, step and count of an equally spaced array, else None."""
    if values.size < 3 or not np.isfinite(values).all():
        return None
    line, step = np.linspace(values[0], values[-1], values.size, retstep=True)
    if np.max(np.abs(values - line)) > 1e-6 * max(abs(step), 1e-300):
        return None
    return {"from": float(values[0]), "step": float(step), "n": values.size}


def _single(values: np.ndarray) -> dict[str, Any]:
    return {"f": as_base64(values.astype("<f4").tobytes())}


def _coarse(values: np.ndarray) -> dict[str, Any]:
    good = np.isfinite(values)
    low, high = (float(f(values[good])) for f in (np.min, np.max)) if good.any() else (0.0, 0.0)
    step = (high - low) / _STEPS
    parts = np.full(values.shape, _MISSING, "<u2")
    parts[good] = np.round((values[good] - low) / step) if step else 0
    return {"q": as_base64(parts.tobytes()), "low": low, "step": step}


def as_base64(data: bytes) -> str:
    """Return bytes as text of a page."""
    return base64.b64encode(data).decode("ascii")
