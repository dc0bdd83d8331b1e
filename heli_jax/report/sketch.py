"""Panels of lines without Matplotlib: the part of its `Figure` and `Axes` that our figures over
time, frequency and lag use, kept as plain data.

A figure drawn on a `Sketch` becomes the same chart as one drawn by Matplotlib, whose import alone
takes half a second of a fit. Limits that no figure sets are those that Matplotlib would choose.
"""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from heli_jax.report.charts import PIXELS, Chart, Panel, Series

_MARGIN = 0.05
"""beside the data, in parts of their range"""
_WIDTH, _SIZE = 1.1, 6.0
"""of lines and points of which none is stated [pt]"""


class SketchLine:
    """A line or points, as `Axes.get_lines` has them."""

    def __init__(self, x: ArrayLike, y: ArrayLike, style: dict[str, Any]) -> None:
        self.x, self.y = np.asarray(x, float), np.asarray(y, float)
        self.style = style
        self.ends: tuple[np.ndarray, np.ndarray] | None = None

    def get_label(self) -> str:
        return str(self.style.get("label") or "")

    def get_ydata(self) -> np.ndarray:
        return self.y

    def series(self, axis: str) -> Series:
        """As plain data.

        Args:
            axis: name of the y axis, which names a line without a label.
        """
        dashes, label = self.style.get("ls", "-"), self.get_label()
        kind = "step" if self.style.get("drawstyle") == "steps-post" else "line"
        if dashes in ("", "none"):
            kind = "points"
        if self.ends is not None:
            kind = "bars"
        thin = self.style.get("lw", _WIDTH), self.style.get("ms", _SIZE)
        low, high = self.ends or (None, None)
        return Series(
            label if label and not label.startswith("_") else axis,
            kind,
            str(self.style["color"]).lower(),
            float(thin[0] if kind in ("line", "step") else thin[1]),
            kind in ("line", "step") and dashes != "-",
            self.x,
            self.y,
            low,
            high,
        )


class SketchAxes:
    """One panel; methods as those of Matplotlib's `Axes`."""

    def __init__(self, figure: "Sketch") -> None:
        self.figure = figure
        self.title = self.x_label = self.y_label = self.x_scale = ""
        self.note = ""
        self.lines: list[SketchLine] = []
        self.bands: list[Series] = []
        self.levels: list[float] = []
        self.marks: list[float] = []
        self.x_limits: tuple[float, float] | None = None
        self.y_limits: tuple[float, float] | None = None

    # What is drawn.

    def plot(self, x: ArrayLike, y: ArrayLike, **style: Any) -> list[SketchLine]:
        self.lines.append(SketchLine(x, y, style))
        return self.lines[-1:]

    def errorbar(self, x: ArrayLike, y: ArrayLike, *, yerr: ArrayLike, **style: Any) -> None:
        # `fmt` says that points are drawn, and no line between them.
        drawn = SketchLine(x, y, {**style, "ls": ""})
        down, up = np.broadcast_to(np.asarray(yerr, float), (2, drawn.y.size))
        drawn.ends = drawn.y - down, drawn.y + up
        self.lines.append(drawn)

    def fill_between(
        self, x: ArrayLike, one: ArrayLike, other: ArrayLike, *, color: str, **_: Any
    ) -> None:
        x, one, other = (np.asarray(v, float) for v in (x, one, other))
        if x.size:
            low, high = np.minimum(one, other), np.maximum(one, other)
            self.bands.append(Series("", "band", color.lower(), 0.0, False, x, low, low, high))

    def axhline(self, y: float, **_: Any) -> None:
        self.levels.append(float(y))

    def axvline(self, x: float, **_: Any) -> None:
        self.marks.append(float(x))

    def get_lines(self) -> list[SketchLine]:
        return self.lines

    # Words.

    def set_title(self, title: str, **_: Any) -> None:
        self.title = title

    def set_xlabel(self, label: str) -> None:
        self.x_label = label

    def set_ylabel(self, label: str) -> None:
        self.y_label = label

    # Limits.

    def set_xscale(self, scale: str) -> None:
        self.x_scale = scale

    def set_xlim(self, low: float, high: float) -> None:
        self.x_limits = float(low), float(high)

    def set_ylim(self, low: float, high: float) -> None:
        self.y_limits = float(low), float(high)

    def get_ylim(self) -> tuple[float, float]:
        """As set, or about all that is drawn."""
        return self.y_limits or self._about()

    def _about(self) -> tuple[float, float]:
        drawn = [v for b in self.bands for v in (b.low, b.high)]
        drawn += [v for line in self.lines for v in (line.y, *(line.ends or ()))]
        y = np.concatenate([np.asarray(self.levels), *(v for v in drawn if v is not None)])
        y = y[np.isfinite(y)]
        low, high = (float(y.min()), float(y.max())) if y.size else (-_MARGIN, _MARGIN)
        # All at one height: room beside it, in parts of it.
        if high - low <= 1e-15 * max(abs(low), abs(high)):
            room = [_MARGIN * abs(v) if low or high else _MARGIN for v in (low, high)]
            low, high = low - room[0], high + room[1]
        room = _MARGIN * (high - low)
        return low - room, high + room

    def panel(self, height: float, x_limits: tuple[float, float]) -> Panel:
        """As plain data.

        Args:
            height: [pixel of a page].
            x_limits: of the figure, where the panel has none of its own.
        """
        axis = self.y_label.partition(" [")[0]
        return Panel(
            label=self.y_label,
            limits=self.get_ylim(),
            height=round(height),
            series=(*self.bands, *(v.series(axis) for v in self.lines if v.x.size)),
            levels=tuple(self.levels),
            marks=tuple(self.marks),
            x_limits=self.x_limits or x_limits,
        )


class Sketch:
    """A figure of panels below each other."""

    def __init__(self) -> None:
        self.axes: tuple[SketchAxes, ...] = ()
        self.heights: list[float] = []
        self.label = ""

    def panels(self, heights: list[float]) -> tuple[SketchAxes, ...]:
        """Panels of these heights [inch]."""
        self.axes = tuple(SketchAxes(self) for _ in heights)
        self.heights = heights
        return self.axes

    def set_label(self, label: str) -> None:
        """What the x axis belongs to, as a flight."""
        self.label = label

    def chart(self) -> Chart:
        """As plain data; the first panel has the limits of x, unless each has its own."""
        first = self.axes[0]
        assert first.x_limits is not None  # every figure sets them
        return Chart(
            first.title,
            first.note,
            self.axes[-1].x_label,
            first.x_scale == "log",
            first.x_limits,
            tuple(
                ax.panel(PIXELS * height, first.x_limits)
                for ax, height in zip(self.axes, self.heights, strict=True)
            ),
            self.label,
        )
