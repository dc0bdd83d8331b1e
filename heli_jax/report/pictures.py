"""Figures as a page holds them: an image that every browser shows, words for who does not see it,
and numbers for its own drawing."""

import base64
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Literal, NamedTuple

from heli_jax.report import style
from heli_jax.report.alt_text import described
from heli_jax.report.charts import chart_of
from heli_jax.report.embedded import Logged, Numbers

if TYPE_CHECKING:
    from matplotlib.figure import Figure

type Kind = Literal["live", "panels", "image"]


class Picture(NamedTuple):
    """A figure of a page."""

    name: str
    title: str
    image: str
    """a data: address"""
    size: tuple[int, int]
    """width and height [pixel]"""
    alt: str
    """what the figure shows, in words and numbers"""
    chart: int | None = None
    """its number among the page's charts; None where the image is all"""


def of_file(png: Path, title: str, alt: str) -> Picture:
    """An image that is drawn already.

    Args:
        png: its file.
        title: of the figure.
        alt: what it shows, in words.
    """
    from PIL import Image

    with Image.open(png) as image:
        size = image.size
    return Picture(png.stem, title, _address("png", png.read_bytes()), size, alt)


def picture(
    name: str,
    draw: "Callable[[], Figure | None]",
    numbers: Numbers,
    *,
    folder: Path | None = None,
    logged: Mapping[str, Logged] | None = None,
    kind: Kind = "live",
    png: bool = False,
) -> Picture | None:
    """Draw a figure for a page.

    Args:
        name: of its files.
        draw: draws it.
        numbers: the page's, to which it is added.
        folder: for NAME.svg, and NAME.png where that is asked for; no files unless given.
        logged: by signal how its log has it.
        kind: `live` is drawn anew by the page, to be zoomed, which panels of lines can be; of
            `panels` words are made alone; of an `image` the title is all.
        png: whether the folder gets NAME.png too.

    Returns:
        None where there is nothing to draw.
    """
    with style.in_style():
        drawn = draw()
        if drawn is None:
            return None
        # Saving thins the lines: the chart is taken from them before.
        chart = None if kind == "image" else chart_of(drawn)
        svg = style.as_svg(drawn)
        if folder is not None:
            (folder / f"{name}.svg").write_bytes(svg)
            if png:
                (folder / f"{name}.png").write_bytes(style.as_png(drawn))
    title = drawn.axes[0].get_title("left")
    width, height = (round(96 * v) for v in drawn.get_size_inches())
    return Picture(
        name,
        title,
        _address("svg+xml", svg),
        (width, height),
        title if chart is None else described(chart),
        None if chart is None or kind != "live" else numbers.add_chart(chart, dict(logged or {})),
    )


def _address(kind: str, data: bytes) -> str:
    return f"data:image/{kind};base64,{base64.b64encode(data).decode('ascii')}"
