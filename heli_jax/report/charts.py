"""What a drawn figure shows, panel by panel: as plain data, with which the page draws it anew
so that it can be zoomed, and in words for who does not see it.

A page holds each array once, in two or four bytes a number, as base64.
"""

import base64
import hashlib
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from heli_jax.numbers import number
from heli_jax.report.style import BARS, thinned

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D


PIXELS = 88.0
"""of the page in an inch of a figure"""


class Series(NamedTuple):
    """A line, points, or what lies between two lines; arrays (n,)."""

    label: str
    kind: str
    """line, step, points, bars or band"""
    color: str
    width: float
    dashed: bool
    x: np.ndarray
    y: np.ndarray
    """NaN where something is missing; of a band its lower edge"""
    low: np.ndarray | None = None
    """of bars and bands"""
    high: np.ndarray | None = None


class Panel(NamedTuple):
    """One pair of axes."""

    label: str
    """of the y axis"""
    limits: tuple[float, float]
    height: float
    """[pixel of a page]"""
    series: tuple[Series, ...]
    levels: tuple[float, ...] = ()
    """horizontal lines"""
    marks: tuple[float, ...] = ()
    """vertical lines"""
    shades: tuple[tuple[float, float], ...] = ()
    """stretches of x that are shaded"""


class Chart(NamedTuple):
    """Panels below each other with one x axis."""

    title: str
    note: str
    x_label: str
    logarithmic: bool
    x_limits: tuple[float, float]
    panels: tuple[Panel, ...]
    of: str = ""
    """what its x belongs to, as a flight: charts of the same share cursor and zoom"""


def chart_of(figure: "Figure") -> Chart:
    """A figure of panels below each other as plain data.

    Args:
        figure: drawn with lines, error bars, `fill_between` and spans; what else it holds is left
            out.
    """
    axes = figure.axes
    first = axes[0]
    notes = [t.get_text() for t in first.texts if getattr(t, "xy", None) == (0, 1)]
    height = float(figure.get_size_inches()[1])
    low, high = first.get_xlim()
    return Chart(
        first.get_title("left"),
        "; ".join(notes),
        axes[-1].get_xlabel(),
        first.get_xscale() == "log",
        (float(low), float(high)),
        tuple(_panel(ax, height) for ax in axes),
        str(figure.get_label()),
    )


def _panel(ax: "Axes", height: float) -> Panel:
    low, high = ax.get_ylim()
    flat, upright, lines = _straight(ax)
    return Panel(
        label=ax.get_ylabel(),
        limits=(float(low), float(high)),
        height=round(float(ax.get_position().height) * height * PIXELS),
        series=(*_bands(ax), *_lines(ax, lines)),
        levels=flat,
        marks=upright,
        shades=_shades(ax),
    )


def _straight(ax: "Axes") -> tuple[tuple[float, ...], tuple[float, ...], list["Line2D"]]:
    """Heights of the lines across the axes, places of those from top to bottom, and all others."""
    flat, upright, lines = [], [], []
    for line in ax.get_lines():
        # A line across has its x in parts of the axes, and only its y in numbers of the data.
        by_x, by_y = line.get_transform().contains_branch_seperately(ax.transData)
        if by_x and by_y:
            lines.append(line)
        elif by_y:
            flat.append(float(np.asarray(line.get_ydata())[0]))
        elif by_x:
            upright.append(float(np.asarray(line.get_xdata())[0]))
    return tuple(flat), tuple(upright), lines


def _lines(ax: "Axes", lines: list["Line2D"]) -> list[Series]:
    series: list[Series] = []
    for line in lines:
        if line.get_label() == BARS:
            ends = np.asarray(line.get_ydata(), float)
            series[-1] = series[-1]._replace(kind="bars", low=ends[::3], high=ends[1::3])
        else:
            series.append(_line(line, ax))
    return [s for s in series if s.x.size]


def _line(line: "Line2D", ax: "Axes") -> Series:
    from matplotlib.colors import to_hex

    kind = "step" if line.get_drawstyle() == "steps-post" else "line"
    if line.get_linestyle() in ("None", "none", "", " "):
        kind = "points"
    return Series(
        _name(str(line.get_label()), ax),
        kind,
        to_hex(line.get_color()),
        float(line.get_linewidth()) if kind in ("line", "step") else float(line.get_markersize()),
        line.get_linestyle() not in ("-", "None"),
        np.asarray(line.get_xdata(), float),
        np.asarray(line.get_ydata(), float),
    )


def _name(label: str, ax: "Axes") -> str:
    """A line's label; that of the axis without its unit where it has none."""
    return label if label and not label.startswith("_") else ax.get_ylabel().partition(" [")[0]


def _bands(ax: "Axes") -> list[Series]:
    from matplotlib.collections import PolyCollection
    from matplotlib.colors import to_hex

    bands = []
    for collection in ax.collections:
        if not isinstance(collection, PolyCollection):
            continue
        for path in collection.get_paths():
            # As fill_between lays them: one corner, the first edge, one corner, the second back.
            corners = np.asarray(path.vertices)
            n = (len(corners) - 3) // 2
            one, other = corners[1 : n + 1], corners[n + 2 : 2 * n + 2][::-1]
            color = to_hex(collection.get_facecolor()[0])  # type: ignore[arg-type,index]
            low, high = np.minimum(one[:, 1], other[:, 1]), np.maximum(one[:, 1], other[:, 1])
            bands.append(Series("", "band", color, 0.0, False, one[:, 0], low, low, high))
    return bands


def _shades(ax: "Axes") -> tuple[tuple[float, float], ...]:
    from matplotlib.patches import Polygon, Rectangle

    shades = []
    for patch in ax.patches:
        by_x, by_y = patch.get_transform().contains_branch_seperately(ax.transData)
        if by_x and not by_y and isinstance(patch, Rectangle | Polygon):
            box = patch.get_path().transformed(patch.get_patch_transform()).get_extents()
            shades.append((float(box.x0), float(box.x1)))
    return tuple(shades)


_TOLD = 6
"""lines of a panel that are told one by one"""


def described(chart: Chart) -> str:
    """Title, note, and of each panel which lines it has and from where to where they go."""
    low, high = chart.x_limits
    over = f"Over {chart.x_label}, {number(low, 3)} to {number(high, 3)}" if chart.x_label else ""
    panels = [text for p in chart.panels if (text := _panel_in_words(p))]
    sentences = [chart.title, chart.note, over, *panels]
    return ". ".join(s for s in sentences if s) + "."


def _panel_in_words(panel: Panel) -> str:
    series = [s for s in panel.series if s.kind != "band" and np.isfinite(s.y).any()]
    words = [_range(s) for s in series[:_TOLD]]
    if len(series) > _TOLD:
        words.append(f"{len(series) - _TOLD} further lines")
    return f"{panel.label}: {', '.join(words)}" if words else ""


def _range(series: Series) -> str:
    y = series.y[np.isfinite(series.y)]
    low, high = number(float(y.min()), 3), number(float(y.max()), 3)
    return f"{series.label} {low}" + (f" to {high}" if low != high else "")


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
        """Keep a figure; its number on the page."""
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
                **p._asdict(),
                "logged": _logged_unit(p.label, logged),
                "series": [self._series(s, most) for s in p.series],
            }
            for p in chart.panels
        ]
        return {**chart._asdict(), "panels": panels}

    def _series(self, s: Series, most: int) -> dict[str, Any]:
        x, y = (s.x, s.y) if s.low is not None else thinned(s.x, s.y, most)
        ends = {n: self.array(v) for n, v in (("low", s.low), ("high", s.high)) if v is not None}
        kept = {"x": self.array(x, exact=True), "y": self.array(y), "width": round(s.width, 2)}
        return {**s._asdict(), "low": None, "high": None, **kept, **ends}


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
    """Bytes as text of a page."""
    return base64.b64encode(data).decode("ascii")
