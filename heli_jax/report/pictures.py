"""Figures as a page holds them: an image that every browser shows, words for who does not see it,
and numbers for its own drawing."""

import base64
import io
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Literal, NamedTuple

import matplotlib
from matplotlib.figure import Figure
from PIL import Image

from heli_jax.report import style
from heli_jax.report.alt_text import described
from heli_jax.report.charts import chart_of
from heli_jax.report.embedded import Logged, Numbers
from heli_jax.report.svg import chart_svg

_HEAVY = 45_000
"""bytes of an SVG from which on the page has a PNG in its place: noise has no short outline"""
_COLOURS = 16
"""of that PNG"""
type Draw = Callable[[], Figure | None]
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
    with Image.open(png) as image:
        size = image.size
    data = base64.b64encode(png.read_bytes()).decode("ascii")
    return Picture(png.stem, title, f"data:image/png;base64,{data}", size, alt)


def picture(
    name: str,
    draw: Draw,
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
        png: whether the folder gets NAME.png too, and both files are Matplotlib's.

    Returns:
        None where there is nothing to draw.
    """
    with matplotlib.rc_context(style.STYLE):
        drawn = draw()
        if drawn is None:
            return None
        # Saving thins the lines: the chart is taken from them before.
        chart = None if kind == "image" else chart_of(drawn)
        title = drawn.axes[0].get_title("left")
        width, height = (round(96 * v) for v in drawn.get_size_inches())
        if chart is None:
            file = style.as_svg(drawn)
            image = _of_svg(drawn, file)
        else:
            # From the data: Matplotlib takes ten times as long, which each fit would wait for.
            text, (width, height) = chart_svg(chart)
            file = text.encode("utf-8")
            image = _address("svg+xml", file)
        if folder is not None and png:
            style.saved(drawn, folder / name)
        elif folder is not None:
            (folder / f"{name}.svg").write_bytes(file)
    return Picture(
        name,
        title,
        image,
        (width, height),
        title if chart is None else described(chart),
        None if chart is None or kind != "live" else numbers.add_chart(chart, dict(logged or {})),
    )


def _of_svg(drawn: Figure, svg: bytes) -> str:
    """A drawn figure as an address: its SVG, or a PNG where that has no short outline."""
    return _address("svg+xml", svg) if len(svg) <= _HEAVY else _small(style.as_png(drawn))


def _small(png: bytes) -> str:
    """With a palette of few colours: lines on white need no more, and it is a third as large."""
    small = io.BytesIO()
    with Image.open(io.BytesIO(png)) as image:
        image.convert("RGB").quantize(_COLOURS).save(small, format="png")
    return _address("png", small.getvalue())


def _address(kind: str, data: bytes) -> str:
    return f"data:image/{kind};base64,{base64.b64encode(data).decode('ascii')}"
