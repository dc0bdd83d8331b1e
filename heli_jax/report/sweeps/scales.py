"""The axes of panels: scales, ticks and labels, as far as there is room for them."""

import math
from typing import Literal, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.ticker import (
    FixedLocator,
    FuncFormatter,
    Locator,
    LogLocator,
    MaxNLocator,
    NullLocator,
)

from heli_jax.numbers import number
from heli_jax.report.style import label, pretty
from heli_jax.report.sweeps.columns import Column

# [inch] Width of a letter of a label, on average: matplotlib knows a text's width only once it is
# drawn, and the room is shared out before.
LETTER = 0.078

type Which = Literal["x", "y"]


class Taken(NamedTuple):
    """What is taken out of the numbers on an axis: number = offset + tick 10^power."""

    offset: float = 0.0
    power: int = 0


def scale(
    ax: Axes, which: Which, column: Column, view: tuple[float, float], *, margin: float = 0.04
) -> Taken:
    """Give an axis of a panel its scale, limits and ticks.

    Args:
        ax: the panel.
        which: its horizontal or its vertical axis.
        column: what is drawn along it.
        view: from the least to the largest place (see `Column.transform`).
        margin: on each side, as a part of the view.
    """
    span = margin * (view[1] - view[0])
    low, high = (float(v) for v in column.inverse(np.array([view[0] - span, view[1] + span])))
    set_limits = ax.set_xlim if which == "x" else ax.set_ylim
    set_scale = ax.set_xscale if which == "x" else ax.set_yscale
    if column.log and column.sign > 0:
        set_scale("log")
    elif column.log:
        # matplotlib's log scale has no negative numbers; below the least of these magnitudes the
        # symlog's linear part is never seen.
        set_scale("symlog", linthresh=0.5 * min(abs(low), abs(high)))
    set_limits(low, high)
    axis = ax.xaxis if which == "x" else ax.yaxis
    # [inch] a tick label with its gap takes: across the axis its width, along it its height.
    most = max(2, int(inches(ax, which) / (0.42 if which == "x" else 0.3)))
    if column.log:
        return log_axis(axis, low, high, max(most, 3))
    # A few whole numbers, such as seeds, are labelled each: even ticks would leave some out.
    few = column.whole and column.distinct.size <= most
    values = [float(v) for v in column.distinct] if few else []
    locator = FixedLocator(values) if few else even_ticks(column, most)
    return linear_axis(axis, locator, *view)


def log_axis(axis: Axis, low: float, high: float, most: int) -> Taken:
    """Give a logarithmic axis its ticks.

    Args:
        axis: of matplotlib.
        low: least value on it.
        high: largest value on it, of the same sign.
        most: ticks at most.
    """
    axis.set_major_locator(FixedLocator(_log_ticks(low, high, most)))
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(FuncFormatter(lambda v, _: _power_or_number(v)))
    return Taken()


def linear_axis(axis: Axis, locator: Locator, low: float, high: float) -> Taken:
    """Give a linear axis its ticks.

    Args:
        axis: of matplotlib.
        locator: where they are.
        low: least value on it.
        high: largest value on it.
    """
    taken = _taken(low, high)
    axis.set_major_locator(locator)
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(FuncFormatter(lambda v, _: _tick(v, taken)))
    return taken


def even_ticks(column: Column, most: int) -> Locator:
    return MaxNLocator(nbins=most, steps=[1, 2, 2.5, 5, 10], integer=column.whole)


def named(ax: Axes, which: Which, column: Column, taken: Taken, *, lines: int = 1) -> None:
    """Label an axis of a panel with name and unit, as long as there is room.

    Args:
        ax: the panel.
        which: its horizontal or its vertical axis.
        column: what is drawn along it.
        taken: what is taken out of the numbers on it, which stands in the label.
        lines: 2 where the unit may have a line of its own.
    """
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
    # Else the four digits of a label would be the same at each tick.
    if span < 1e-3 * largest:
        # A round number near the middle: a step of ten to a hundred spans.
        step = 10.0 ** (math.ceil(math.log10(span)) + 1)
        offset = round(0.5 * (low + high) / step) * step
        largest = max(abs(low - offset), abs(high - offset))
    power = math.floor(math.log10(1.1 * largest))  # up to 0.96: 1, not 9.6
    return Taken(offset, 0 if -3 <= power < 5 else power)


def _tick(v: float, taken: Taken) -> str:
    """The label of a tick."""
    text = f"{(v - taken.offset) / 10.0**taken.power:.4g}"
    # Ticks are multiples of a step that is no binary number: zero comes out as 1e-17.
    return "0" if abs(float(text)) < 1e-9 else text.replace("-", "−")


def _log_ticks(low: float, high: float, most: int) -> list[float]:
    """1, 2, 5 of each decade, or 1, 3, or 1, or 1 of each second one ...: at most so many."""
    # By magnitude, since SymmetricalLogLocator counts decades from 1 + |v| and finds none below 1.
    sign = -1.0 if high < 0 else 1.0
    low, high = sorted((abs(low), abs(high)))
    for subs in ((1.0, 2.0, 5.0), (1.0, 3.0), (1.0,)):
        # With less than two such ticks LogLocator gives those of a linear axis.
        ticks = np.asarray(LogLocator(subs=subs, numticks=most).tick_values(low, high))
        inside = ticks[(ticks >= low) & (ticks <= high)]
        if 0 < inside.size <= most:
            break
    else:
        # Less than a decade, with too many linear ticks.
        ticks = np.asarray(MaxNLocator(most - 1).tick_values(low, high))
        inside = ticks[(ticks >= low) & (ticks <= high)]
    return np.sort(sign * inside).tolist()


def _power_or_number(v: float) -> str:
    """0.002, 20, 10⁻⁵, 2·10⁻⁵."""
    if 1e-3 <= abs(v) < 1e5:
        return f"{v:g}".replace("-", "−")
    text = number(abs(v), 3)
    return ("−" if v < 0 else "") + text.removeprefix("1·")


def _unit(column: Column, taken: Taken) -> str | None:
    """The unit with the power of ten that was taken out of the numbers."""
    if not taken.power:
        return column.unit
    times = number(float(f"1e{taken.power}"), 1).removeprefix("1·")
    return times if pretty(column.unit) == "–" else f"{times} {column.unit}"
