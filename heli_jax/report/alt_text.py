"""What figures show, in words and numbers, for who does not see them."""

import numpy as np

from heli_jax.numbers import number
from heli_jax.report.charts import Chart, Panel, Series

_MOST = 6
"""lines of a panel that are told one by one"""


def described(chart: Chart) -> str:
    """Title, note, and of each panel which lines it has and from where to where they go."""
    low, high = chart.x_limits
    over = f"Over {chart.x_label}, {number(low, 3)} to {number(high, 3)}" if chart.x_label else ""
    panels = [text for p in chart.panels if (text := _panel(p))]
    sentences = [chart.title, chart.note, over, *panels]
    return ". ".join(s for s in sentences if s) + "."


def _panel(panel: Panel) -> str:
    series = [s for s in panel.series if s.kind != "band" and np.isfinite(s.y).any()]
    words = [_range(s) for s in series[:_MOST]]
    if len(series) > _MOST:
        words.append(f"{len(series) - _MOST} further lines")
    return f"{panel.label}: {', '.join(words)}" if words else ""


def _range(series: Series) -> str:
    y = series.y[np.isfinite(series.y)]
    low, high = number(float(y.min()), 3), number(float(y.max()), 3)
    return f"{series.label} {low}" + (f" to {high}" if low != high else "")
