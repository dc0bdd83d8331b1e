"""Panels of a figure: where they lie, marks of elements, and what is said about them."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from heli_jax.report import style
from heli_jax.report.sweeps.columns import MARKS, Column, Table
from heli_jax.report.sweeps.scales import short

DOTS = 2000  # elements that are dots in a panel at most: more are a cloud without inside


def laid_out(
    cells: Sequence[int],
    columns: int,
    size: tuple[float, float],
    *,
    gap: tuple[float, float],
    left: float,
    bottom: float = 0.48,
) -> tuple[Figure, list[Axes]]:
    """Panels in some cells of a grid, row by row.

    Args:
        cells: numbers of the cells, 0 top left.
        columns: cells in a row.
        size: width and height of a panel [inch].
        gap: between panels side by side, and above each other [inch].
        left: margin [inch].
        bottom: margin [inch].
    """
    # In inches and not by matplotlib's layout engines: labels keep their size however many panels
    # there are, and panels of one figure lie where those of another do.
    rows = max(cells) // columns + 1
    top = 0.52
    height = top + bottom + rows * size[1] + (rows - 1) * gap[1]
    figure = style.figure(height)
    width = float(figure.get_size_inches()[0])
    axes = []
    for cell in cells:
        row, column = divmod(cell, columns)
        x = left + column * (size[0] + gap[0])
        y = height - top - size[1] - row * (size[1] + gap[1])
        axes.append(figure.add_axes((x / width, y / height, size[0] / width, size[1] / height)))
    return figure, axes


def dots(ax: Axes, x: np.ndarray, y: np.ndarray) -> None:
    """Elements, the fainter the more there are.

    Args:
        ax: the panel.
        x: values along it, (n,).
        y: values up it, (n,).
    """
    # Many are pixels in an SVG, or a browser takes seconds to draw them.
    size, alpha = (4.5, 0.8) if x.size <= 50 else (3.0, 0.6) if x.size <= 300 else (2.0, 0.45)
    ax.plot(
        x, y, "o", ms=size, mew=0, alpha=alpha, color=style.PALE, rasterized=x.size > 50, zorder=1,
        label="_elements",
    )  # fmt: skip


def crosses(ax: Axes, x: np.ndarray, y: np.ndarray, **looks: Any) -> None:
    """Marks of elements that are not ok; the plainer the fewer there are.

    Args:
        ax: the panel.
        x: values along it, (n,).
        y: values up it, (n,).
        **looks: keywords of `Axes.plot`.
    """
    if x.size:
        ax.plot(x, y, **{
            "ls": "", "marker": "x", "mew": 0.7, "color": style.VERMILLION,
            "rasterized": x.size > 50, "zorder": 3, "clip_on": False, "label": "_not ok", **looks,
            **({"ms": 5.0, "alpha": 1.0} if x.size <= 50 else {}),
        })  # fmt: skip


def say(ax: Axes, text: str) -> None:
    """Words in the middle of a panel that has nothing else."""
    ax.text(0.5, 0.5, text, transform=ax.transAxes, ha="center", va="center", color=style.GREY)


def head(ax: Axes, what: str, table: Table, notes: Sequence[str]) -> None:
    """Title with the number of elements that are ok, and a quiet line below.

    Args:
        ax: the first panel.
        what: the figure shows.
        table: of the sweep.
        notes: what the line below says.
    """
    counted = f"{table.n_ok} of {table.size} elements ok"
    ax.set_title(f"{short(what, 78 - len(counted))}: {counted}", loc="left")
    lot = [f"{table.elements.size} drawn, by lot"] if table.some else []
    style.subtitle(ax, "; ".join([*lot, *notes]))


# What is said: words for the line below the title.


def nothing(table: Table) -> str:
    """Why there is no number to draw."""
    drawn = " drawn" if table.some else ""
    return f"no finite value{drawn}" if table.n_ok else "no element is ok"


def marked(table: Table, most: int = MARKS) -> list[str]:
    """What the marks are."""
    count = table.size - table.n_ok
    shown = f" ({most} of {count})" if count > most else ""
    return [f"red marks: not ok{shown}"] if count else []


def first(shown: int, of: int, what: str) -> list[str]:
    """That not all are shown, if so.

    Args:
        shown: how many are.
        of: how many there are.
        what: they are.
    """
    return [f"the first {shown} of {of} {what}"] if shown < of else []


def not_finite(table: Table, y: Column) -> list[str]:
    """How many values of a result are not drawn for that."""
    count = int(np.count_nonzero(table.ok)) - int(np.count_nonzero(y.used))
    return [f"{count} not finite"] if count and not y.empty else []
