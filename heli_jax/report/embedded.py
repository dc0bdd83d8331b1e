"""Numbers as a page holds them: each array once, in two or four bytes a number, as base64."""

import base64
import hashlib
from typing import Any, NamedTuple

import numpy as np

from heli_jax.report.charts import Chart, Series
from heli_jax.report.thinning import thinned

_BYTES = 380_000
"""of all lines of a page together: what is longer is thinned, its peaks kept"""
_LEAST = 2000
"""points that a line keeps in any case"""
_MISSING = 65535
_STEPS = 65534
"""parts of an array's range that are told apart: far below a pixel, and below a hundredth of a
percent"""


class Logged(NamedTuple):
    """How a log has a signal: SI times a factor, and an offset on top."""

    unit: str
    """or the column's name, where the log's numbers have no unit"""
    factor: float
    offset: float = 0.0


class Numbers:
    """Arrays and figures of one page."""

    def __init__(self) -> None:
        self.arrays: list[dict[str, Any]] = []
        self.charts: list[dict[str, Any]] = []
        self.scenes: list[dict[str, Any]] = []
        self._known: dict[bytes, int] = {}
        self._waiting: list[tuple[Chart, dict[str, Logged]]] = []

    def add_chart(self, chart: Chart, logged: dict[str, Logged] | None = None) -> int:
        """Keep a figure; its number on the page.

        Args:
            chart: the figure.
            logged: by signal how its log has it.
        """
        self._waiting.append((chart, logged or {}))
        return len(self._waiting) - 1

    def content(self) -> dict[str, Any]:
        """All as plain data for JSON."""
        # Not before all figures are known: how many points a line may keep depends on how many
        # lines there are. An input that five figures show counts once.
        lines = {
            hashlib.sha256(np.ascontiguousarray(s.y).tobytes()).digest(): s.y.size
            for chart, _ in self._waiting
            for p in chart.panels
            for s in p.series
        }
        most = _most(list(lines.values()))
        self.charts = [self._chart(chart, logged, most) for chart, logged in self._waiting]
        return {"arrays": self.arrays, "charts": self.charts, "scenes": self.scenes}

    def array(self, values: np.ndarray, *, exact: bool = False) -> int:
        """Keep an array (n,); its number on the page.

        Args:
            values: finite, or NaN where a number is missing.
            exact: in single precision; else as parts of the array's range.
        """
        values = np.ascontiguousarray(values, np.float64)
        key = hashlib.sha256(values.tobytes() + bytes([exact])).digest()
        if key not in self._known:
            self._known[key] = len(self.arrays)
            self.arrays.append(_uniform(values) or (_single(values) if exact else _coarse(values)))
        return self._known[key]

    def _chart(self, chart: Chart, logged: dict[str, Logged], most: int) -> dict[str, Any]:
        panels = [
            {
                "label": p.label,
                "limits": p.limits,
                "height": p.height,
                "levels": p.levels,
                "marks": p.marks,
                "shades": p.shades,
                "logged": _logged_unit(p.label, logged),
                "series": [self._series(s, most) for s in p.series],
            }
            for p in chart.panels
        ]
        return {
            "title": chart.title,
            "note": chart.note,
            "xLabel": chart.x_label,
            "log": chart.logarithmic,
            "xLimits": chart.x_limits,
            "of": chart.of,
            "panels": panels,
        }

    def _series(self, s: Series, most: int) -> dict[str, Any]:
        x, y = (s.x, s.y) if s.low is not None else thinned(s.x, s.y, most)
        content = {
            "label": s.label,
            "kind": s.kind,
            "color": s.color,
            "width": round(s.width, 2),
            "dashed": s.dashed,
            "x": self.array(x, exact=True),
            "y": self.array(y),
        }
        if s.low is not None and s.high is not None:
            content |= {"low": self.array(s.low), "high": self.array(s.high)}
        return content


def _most(sizes: list[int]) -> int:
    """Points that a line may have, so that all together stay within a page's share."""
    # Two bytes a number, four base64 letters for three bytes; where a line is thinned it has times
    # of its own, of four bytes.
    if sum(sizes) * 2 * 4 / 3 <= _BYTES:
        return max([_LEAST, *sizes])
    return max(_LEAST, int(_BYTES / (6 * 4 / 3) / len(sizes)))


def _logged_unit(label: str, logged: dict[str, Logged]) -> list[Any] | None:
    unit = logged.get(label.partition(" [")[0])
    return None if unit is None else [label.partition(" [")[2].rstrip("]"), *unit]


def _uniform(values: np.ndarray) -> dict[str, Any] | None:
    """First, step and count of what is equally spaced, as times are; None where it is not."""
    if values.size < 3 or not np.isfinite(values).all():
        return None
    step = (values[-1] - values[0]) / (values.size - 1)
    line = values[0] + step * np.arange(values.size)
    if np.max(np.abs(values - line)) > 1e-6 * max(abs(step), 1e-300):
        return None
    return {"from": float(values[0]), "step": float(step), "n": values.size}


def _single(values: np.ndarray) -> dict[str, Any]:
    return {"f": base64.b64encode(values.astype("<f4").tobytes()).decode("ascii")}


def _coarse(values: np.ndarray) -> dict[str, Any]:
    finite = values[np.isfinite(values)]
    low = float(finite.min()) if finite.size else 0.0
    step = (float(finite.max()) - low) / _STEPS if finite.size else 0.0
    good = np.isfinite(values)
    parts = np.full(values.shape, _MISSING, "<u2")
    parts[good] = np.round((values[good] - low) / step) if step else 0
    return {"q": base64.b64encode(parts.tobytes()).decode("ascii"), "low": low, "step": step}
