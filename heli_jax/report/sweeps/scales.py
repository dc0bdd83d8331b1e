"""The axes of panels: scales, ticks and labels, as far as there is room for them."""

import math
from typing import Literal, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.ticker import FixedLocator, FuncFormatter, Locator, MaxNLocator, NullLocator

from heli_jax.numbers import number
from heli_jax.report.style import label, pretty
from heli_jax.report.sweeps.columns import Column

LETTER = 0.078
"""width of a letter of a label [inch]"""

type Which = Literal["x", "y"]


class Taken(NamedTuple):
    """What is taken out of the numbers on an axis: number = offset + tick 10^power."""

    offset: float = 0.0
    power: int = 0


def scale(
    ax: Axes, which: Which, column: Column, view: tuple[float, float], *, margin: float = 0.04
) -> Taken:
    """Give an axis of a panel its scale, limits and ticks."""
    span = margin * (view[1] - view[0])
    low, high = (float(v) for v in column.unbent(np.array([view[0] - span, view[1] + span])))
    set_limits = ax.set_xlim if which == "x" else ax.set_ylim
    set_scale = ax.set_xscale if which == "x" else ax.set_yscale
    if column.log and column.sign > 0:
        set_scale("log")
    elif column.log:
        set_scale("symlog", linthresh=0.5 * min(abs(low), abs(high)))
    set_limits(low, high)
    axis = ax.xaxis if which == "x" else ax.yaxis
    most = max(2, int(inches(ax, which) / (0.42 if which == "x" else 0.3)))
    if column.log:
        return log_axis(axis, low, high, max(most, 3))
    own = column.distinct
    few = column.whole and own.size <= most
    locator = FixedLocator([float(v) for v in own]) if few else even_ticks(column, most)
    return linear_axis(axis, locator, *view)


def log_axis(axis: Axis, low: float, high: float, most: int) -> Taken:
    """Give a logarithmic axis its ticks."""
    axis.set_major_locator(FixedLocator(_log_ticks(low, high, most)))
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(FuncFormatter(lambda v, _: _power_or_number(v)))
    return Taken()


def linear_axis(axis: Axis, locator: Locator, low: float, high: float) -> Taken:
    """Give a linear axis its ticks, which are numbers from low to high."""
    taken = _taken(low, high)
    axis.set_major_locator(locator)
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(FuncFormatter(lambda v, _: _tick(v, taken)))
    return taken


def even_ticks(column: Column, most: int) -> Locator:
    return MaxNLocator(nbins=most, steps=[1, 2, 2.5, 5, 10], integer=column.whole)


def named(ax: Axes, which: Which, column: Column, taken: Taken, *, lines: int = 1) -> None:
    """Label an axis of a panel with name and unit, as long as there is room; on two lines if need
    be and `lines` is 2."""
    room = int((inches(ax, which) + 0.15) / LETTER)
    unit, less = _unit(column, taken), ""
    if taken.offset:
        less = f" {'+' if taken.offset < 0 else '−'} {abs(taken.offset):.10g}"
    text = label(column.name + less, unit)
    if len(text) > room and lines == 2 and unit is not None:
        text = f"{short(column.name, room - len(less))}{less}\n[{pretty(unit)}]"
    elif len(text) > room:
        text = label(short(column.name, room - len(label(less, unit))) + less, unit)
    if which == "x":
        ax.set_xlabel(text)
    else:
        ax.set_ylabel(text)


def short(text: str, most: int) -> str:
    """Text of at most so many letters, without its middle if need be."""
    most = max(most, 5)
    if len(text) <= most:
        return text
    return f"{text[: most // 2]}…{text[len(text) - (most - 1) // 2 :]}"


def inches(ax: Axes, which: Which) -> float:
    """Width or height of a panel."""
    width, height = ax.figure.get_size_inches()  # pyright: ignore
    box = ax.get_position()
    return float(box.width * width if which == "x" else box.height * height)


def _taken(low: float, high: float) -> Taken:
    """For numbers from low to high: nothing where they read well as they are."""
    largest, span = max(abs(low), abs(high)), high - low
    offset = 0.0
    if span < 1e-3 * largest:
        step = 10.0 ** (math.ceil(math.log10(span)) + 1)
        offset = round(0.5 * (low + high) / step) * step
        largest = max(abs(low - offset), abs(high - offset))
    power = math.floor(math.log10(1.1 * largest))  # up to 0.96: 1, not 9.6
    return Taken(offset, 0 if -3 <= power < 5 else power)


def _tick(v: float, taken: Taken) -> str:
    text = f"{(v - taken.offset) / 10.0**taken.power:.4g}"
    return "0" if abs(float(text)) < 1e-9 else text.replace("-", "−")


def _log_ticks(low: float, high: float, most: int) -> list[float]:
    """1, 2, 5 of each decade, or 1, 3, or 1, or 1 of each second one ...: at most so many."""
    sign = -1.0 if high < 0 else 1.0
    low, high = sorted((abs(low), abs(high)))
    decades = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    found: list[float] = []
    for subs, step in [((1.0, 2.0, 5.0), 1), ((1.0, 3.0), 1), *(((1.0,), k) for k in range(1, 40))]:
        every = [float(f"{s}e{d}") for d in decades if d % step == 0 for s in subs]
        found = [v for v in every if low <= v <= high]
        if len(found) <= most:
            break
    return sorted(sign * v for v in found)


def _power_or_number(v: float) -> str:
    """0.002, 20, 10⁻⁵."""
    if 1e-3 <= abs(v) < 1e5:
        return f"{v:g}".replace("-", "−")
    return number(v, 1).replace("1·10", "10")


def _unit(column: Column, taken: Taken) -> str | None:
    """The unit with the power of ten that was taken out of the numbers."""
    if not taken.power:
        return column.unit
    times = number(float(f"1e{taken.power}"), 1).removeprefix("1·")
    return times if pretty(column.unit) == "–" else f"{times} {column.unit}"
