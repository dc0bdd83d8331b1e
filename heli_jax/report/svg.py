"""A chart as SVG, written from its data: what a page shows without scripts and in print.

It takes a tenth of Matplotlib's time for the same lines; letters are text, in a font of the
reader's.
"""

import itertools
import math
from collections.abc import Iterable
from html import escape
from typing import NamedTuple

import numpy as np

from heli_jax.numbers import number
from heli_jax.report.charts import Chart, Panel, Series
from heli_jax.report.thinning import thinned
from heli_jax.report.ticks import decades, tick_texts, ticks

WIDTH = 720
_LEFT, _RIGHT = 84, 14
_POINTS = 1000
"""of a line: more than pixels between the axes"""
_LETTER = 0.56
"""width of a letter, in parts of its size: of common fonts without serifs on average"""
_INK, QUIET, _GRID = "#333333", "#6B6B6B", "#E4E4E4"
_BELOW = 46
"""pixels below the last panel: numbers and label of its x axis"""


class Drawing(NamedTuple):
    """An SVG and its size."""

    text: str
    size: tuple[int, int]
    """width and height [pixel]"""


class _Scale(NamedTuple):
    """From numbers to pixels."""

    low: float
    high: float
    begin: float
    end: float
    logarithmic: bool = False

    def __call__(self, values: np.ndarray | float) -> np.ndarray:
        values = np.asarray(values, float)
        low, high = self.low, self.high
        with np.errstate(invalid="ignore", divide="ignore"):
            if self.logarithmic:
                values, low, high = np.log(values), math.log(low), math.log(high)
            share = (values - low) / ((high - low) or 1.0)
            at = self.begin + share * (self.end - self.begin)
        # Far outside nothing is seen, and some programs stumble over huge numbers.
        reach = 4.0 * abs(self.end - self.begin)
        return np.clip(at, min(self.begin, self.end) - reach, max(self.begin, self.end) + reach)


def chart_svg(chart: Chart) -> Drawing:
    """Panels below each other, with title, note, legends and axes."""
    apart = len({p.x_limits or chart.x_limits for p in chart.panels}) > 1
    parts, y = _head(chart)
    shown: set[str] = set()
    for i, panel in enumerate(chart.panels):
        last = i == len(chart.panels) - 1
        # Not a line that its axis names, nor those of a panel above, which have the same colours.
        new = {s.label for s in panel.series if s.label != panel.label.partition(" [")[0]} - {""}
        legend, rows = _legend(panel, new if new - shown else set(), y + 13)
        shown |= new
        top = y + 16 * rows + 6
        parts += legend
        x_limits = panel.x_limits or chart.x_limits
        logarithmic = chart.logarithmic
        x = _Scale(*x_limits, _LEFT, WIDTH - _RIGHT, logarithmic)
        parts += _panel(panel, x, top, f"p{i}", numbered=last or apart, whole=chart.whole)
        y = top + panel.height + (20 if apart and not last else 6)
    if chart.x_label:
        parts.append(_text(_middle(), y + 32, chart.x_label, 12))
    height = round(y + _BELOW)
    return Drawing(opened(WIDTH, height) + "".join(parts) + "</svg>\n", (WIDTH, height))


def opened(width: int, height: int) -> str:
    """The begin of an SVG of so many pixels, with letters and a white ground."""
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width}" height="{height}" '
        f'viewBox="0 0 {width} {height}" font-family="DejaVu Sans, Verdana, Arial, sans-serif" '
        f'font-size="11" fill="{_INK}"><rect width="100%" height="100%" fill="white"/>'
    )


def _head(chart: Chart) -> tuple[list[str], float]:
    """Title and note, and where they end."""
    parts, y = [], 8.0
    if chart.title:
        y += 16
        parts.append(_text(_LEFT, y, chart.title, 13, "start", ' font-weight="bold"'))
    for line in _wrapped(chart.note, 11.0):
        y += 15
        parts.append(_text(_LEFT, y, line, 11, "start", f' fill="{QUIET}"'))
    return parts, y + 4


def _middle() -> float:
    return 0.5 * (_LEFT + WIDTH - _RIGHT)


def width_of(words: str, size: float) -> float:
    """Of words in letters of that size [pixel], about."""
    return _LETTER * size * len(words)


def _wrapped(words: str, size: float) -> list[str]:
    """Lines that fit beside the axes."""
    lines: list[str] = []
    for word in words.split():
        if lines and width_of(f"{lines[-1]} {word}", size) <= WIDTH - _LEFT - _RIGHT:
            lines[-1] += f" {word}"
        else:
            lines.append(word)
    return lines


def _text(
    x: float, y: float, words: str, size: float, anchor: str = "middle", more: str = ""
) -> str:
    # A title may have a log's name in it, of any length: letters closer together, and none cut.
    room = 2 * min(x, WIDTH - x) if anchor == "middle" else WIDTH - x - _RIGHT
    if "transform" not in more and width_of(words, size) > room:
        more += f' textLength="{room:.0f}" lengthAdjust="spacingAndGlyphs"'
    return (
        f'<text x="{x:.1f}" y="{y:.1f}" font-size="{size:g}" text-anchor="{anchor}"{more}>'
        f"{escape(words)}</text>"
    )


def _legend(panel: Panel, names: set[str], y: float) -> tuple[list[str], int]:
    """The names of the lines in rows, and how many rows there are."""
    named = [s for s in panel.series if s.label in names]
    parts, x, row = [], float(_LEFT), 0
    for s in named:
        wide = 30.0 + width_of(s.label, 11.0)
        if x + wide > WIDTH - _RIGHT and x > _LEFT:
            x, row = float(_LEFT), row + 1
        at = y + 16 * row
        parts.append(_sample(s, x, at - 4))
        parts.append(_text(x + 22, at, s.label, 11, "start"))
        x += wide
    return parts, row + 1 if named else 0


def _sample(s: Series, x: float, y: float) -> str:
    """What a line looks like, beside its name."""
    if s.kind == "band":
        return f'<rect x="{x:.1f}" y="{y - 5:.1f}" width="18" height="10" {_filled(s)}/>'
    if s.kind in ("points", "bars"):
        return f'<circle cx="{x + 9:.1f}" cy="{y:.1f}" r="{_radius(s):.1f}" fill="{s.color}"/>'
    return f'<path d="M{x:.1f} {y:.1f}h18" {_stroked(s)}/>'


def _stroked(s: Series) -> str:
    dashes = ' stroke-dasharray="6 3"' if s.dashed else ""
    return f'fill="none" stroke="{s.color}" stroke-width="{1.33 * s.width:.2f}"{dashes}'


def _filled(s: Series) -> str:
    return f'fill="{s.color}" fill-opacity="0.35"'


def _radius(s: Series) -> float:
    return 0.67 * max(s.width, 1.5)


def _panel(
    panel: Panel, x: _Scale, top: float, name: str, *, numbered: bool, whole: bool
) -> list[str]:
    """One pair of axes with all that is drawn in it."""
    bottom = top + panel.height
    y = _Scale(*panel.limits, bottom, top)
    left, right = x.begin, x.end
    parts = [
        f'<clipPath id="{name}"><rect x="{left:.1f}" y="{top:.1f}" width="{right - left:.1f}" '
        f'height="{panel.height:.1f}"/></clipPath>'
    ]
    parts += _grid(panel, x, y, numbered=numbered, whole=whole)
    parts.append(f'<g clip-path="url(#{name})" stroke-linejoin="round">')
    for a, b in panel.shades:
        x0, x1 = float(x(a)), float(x(b))
        parts.append(
            f'<rect x="{x0:.1f}" y="{top:.1f}" width="{x1 - x0:.1f}" height="{panel.height}" '
            'fill="#E69F00" fill-opacity="0.22"/>'
        )
    parts += [_series(s, x, y) for s in panel.series]
    lines = [f"M{left:.1f} {float(y(v)):.1f}H{right:.1f}" for v in panel.levels]
    lines += [f"M{float(x(v)):.1f} {top:.1f}V{bottom:.1f}" for v in panel.marks]
    if lines:
        parts.append(
            f'<path d="{"".join(lines)}" stroke="{QUIET}" stroke-width="0.8" '
            'stroke-dasharray="4 3"/>'
        )
    parts.append("</g>")
    frame = (
        f'<path d="M{left:.1f} {top:.1f}V{bottom:.1f}H{right:.1f}" fill="none" stroke="#444444"/>'
    )
    return [*parts, frame, _label(panel, top)]


def _grid(panel: Panel, x: _Scale, y: _Scale, *, numbered: bool, whole: bool) -> list[str]:
    across = (decades if x.logarithmic else ticks)(x.low, x.high, 9)
    if whole:
        across = [v for v in across if v == round(v)]
    degrees = panel.label.endswith("[deg]")
    up = ticks(y.low, y.high, max(3, round(panel.height / 30)), degrees=degrees)
    lines = [f"M{float(x(v)):.1f} {y.begin:.1f}V{y.end:.1f}" for v in across]
    lines += [f"M{x.begin:.1f} {float(y(v)):.1f}H{x.end:.1f}" for v in up]
    parts = [f'<path d="{"".join(lines)}" stroke="{_GRID}" stroke-width="0.8"/>']
    for v, words in zip(up, tick_texts(up), strict=True):
        parts.append(_text(x.begin - 5, float(y(v)) + 4, words, 10.5, "end"))
    if numbered:
        words = [number(v, 2) for v in across] if x.logarithmic else tick_texts(across)
        for v, word in zip(across, words, strict=True):
            parts.append(_text(float(x(v)), y.begin + 14, word, 10.5))
    return parts


def _label(panel: Panel, top: float) -> str:
    """The y axis's, turned; in two lines where its panel is too low for one."""
    lines, size = [panel.label], 12.0
    if width_of(panel.label, size) > panel.height + 8 and " [" in panel.label:
        name, _, unit = panel.label.partition(" [")
        lines = [name, f"[{unit}"]
    longest = max(width_of(line, size) for line in lines)
    size = max(8.0, min(size, size * (panel.height + 8) / max(longest, 1.0)))
    middle, parts = top + 0.5 * panel.height, []
    for k, line in enumerate(lines):
        x = 14 + k * (size + 1)
        parts.append(
            _text(x, middle, line, size, more=f' transform="rotate(-90 {x:.1f} {middle:.1f})"')
        )
    return "".join(parts)


def _series(s: Series, x: _Scale, y: _Scale) -> str:
    if s.kind == "band":
        return _band(s, x, y)
    if s.kind in ("points", "bars"):
        return _dots(s, x, y)
    inside = (s.x >= x.low) & (s.x <= x.high)
    # Lines go on to the first point outside.
    seen = inside | np.append(inside[1:], False) | np.append(False, inside[:-1])
    at, values = thinned(s.x[seen], s.y[seen], _POINTS) if _ascends(s.x) else (s.x, s.y)
    joined = _joined(x(at), y(values), step=s.kind == "step")
    return f'<path d="{joined}" {_stroked(s)}/>'


def _ascends(x: np.ndarray) -> bool:
    return bool(np.all(np.diff(x) > 0))


def _joined(px: np.ndarray, py: np.ndarray, *, step: bool = False) -> str:
    """A line through points, broken where one is missing; relative steps in tenths of a pixel."""
    words: list[str] = []
    good = np.isfinite(px) & np.isfinite(py)
    a = np.round(10.0 * np.where(good, px, 0.0)).astype(int).tolist()
    b = np.round(10.0 * np.where(good, py, 0.0)).astype(int).tolist()
    before: tuple[int, int] | None = None
    for ok, u, v in zip(good.tolist(), a, b, strict=True):
        if not ok:
            before = None
            continue
        if before is None:
            words.append(f"M{u / 10:g} {v / 10:g}")
        elif step:
            words.append(f"h{(u - before[0]) / 10:g}v{(v - before[1]) / 10:g}")
        else:
            words.append(f"l{(u - before[0]) / 10:g} {(v - before[1]) / 10:g}")
        before = u, v
    return "".join(words)


def _band(s: Series, x: _Scale, y: _Scale) -> str:
    assert s.low is not None
    assert s.high is not None
    px, paths = x(s.x), []
    for part in _runs(np.isfinite(s.low) & np.isfinite(s.high)):
        there = _joined(px[part], y(s.high[part]))
        back = _joined(px[part][::-1], y(s.low[part])[::-1])
        paths.append(f"{there}L{back[1:]}z")
    return f'<path d="{"".join(paths)}" {_filled(s)}/>'


def _runs(good: np.ndarray) -> Iterable[slice]:
    """Stretches without a gap."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], good, [False]]).astype(int)))
    for a, b in itertools.batched(edges.tolist(), 2):
        yield slice(a, b)


def _dots(s: Series, x: _Scale, y: _Scale) -> str:
    good = np.isfinite(s.x) & np.isfinite(s.y)
    px, py = x(s.x[good]), y(s.y[good])
    dots = "".join(f"M{u:.1f} {v:.1f}h0" for u, v in zip(px.tolist(), py.tolist(), strict=True))
    parts = [
        f'<path d="{dots}" stroke="{s.color}" stroke-width="{2 * _radius(s):.1f}" '
        'stroke-linecap="round"/>'
    ]
    if s.low is not None and s.high is not None:
        ends = zip(px.tolist(), y(s.low[good]).tolist(), y(s.high[good]).tolist(), strict=True)
        bars = "".join(f"M{u:.1f} {a:.1f}V{b:.1f}" for u, a, b in ends)
        parts.append(f'<path d="{bars}" stroke="{s.color}" stroke-width="0.8"/>')
    return "".join(parts)
