"""Figures as a page holds them: an image that every browser shows, words for who does not see it,
and numbers for its own drawing."""

import base64
import io
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Literal, NamedTuple

from heli_jax.report import style
from heli_jax.report.alt_text import described
from heli_jax.report.charts import Chart, chart_of
from heli_jax.report.embedded import Logged, Numbers
from heli_jax.report.sketch import Sketch
from heli_jax.report.svg import Drawing, chart_svg

# The page of most fits needs neither Matplotlib nor PIL, and would wait half a second for them.
if TYPE_CHECKING:
    from matplotlib.figure import Figure

_HEAVY = 45_000
"""bytes of an SVG from which on the page has a PNG in its place: noise has no short outline"""
_COLOURS = 16
"""of that PNG"""
type Kind = Literal["live", "panels", "image"]


class Draw(NamedTuple):
    """A figure that can be drawn: by Matplotlib, and where it has one by its own writer."""

    figure: "Callable[[], Figure | None]"
    chart: Callable[[], Chart | None] | None = None
    """its lines as plain data"""
    svg: Callable[[], tuple[str, Drawing] | None] | None = None
    """title and image of what has no lines"""

    def __call__(self) -> "Figure | None":
        return self.figure()


def sketched(draw: Callable[[Sketch], tuple[object, ...]]) -> Chart | None:
    """The chart of a figure that is drawn on a sketch; None where nothing is.

    Args:
        draw: draws on what it is given, and returns the axes.
    """
    sketch = Sketch()
    return sketch.chart() if draw(sketch) else None


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
    data = base64.b64encode(png.read_bytes()).decode("ascii")
    return Picture(png.stem, title, f"data:image/png;base64,{data}", size, alt)


def picture(
    name: str,
    draw: "Draw | Callable[[], Figure | None]",
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
    if isinstance(draw, Draw) and not png and (draw.chart or draw.svg):
        made = _own(name, draw, numbers, dict(logged or {}), kind)
        if made is not None and folder is not None:
            (folder / f"{name}.svg").write_text(made[1].text, encoding="utf-8")
        return made[0] if made else None
    with style.in_style():
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


def _own(
    name: str, draw: Draw, numbers: Numbers, logged: dict[str, Logged], kind: Kind
) -> tuple[Picture, Drawing] | None:
    """A figure by our own writer."""
    chart, number = draw.chart() if draw.chart else None, None
    if chart is not None:
        title, alt, drawing = chart.title, described(chart), chart_svg(chart)
        number = numbers.add_chart(chart, logged) if kind == "live" else None
    elif draw.svg is not None and (made := draw.svg()) is not None:
        (title, drawing), alt = made, made[0]
    else:
        return None
    image = _address("svg+xml", drawing.text.encode("utf-8"))
    return Picture(name, title, image, drawing.size, alt, number), drawing


def _of_svg(drawn: "Figure", svg: bytes) -> str:
    """A drawn figure as an address: its SVG, or a PNG where that has no short outline."""
    return _address("svg+xml", svg) if len(svg) <= _HEAVY else _small(style.as_png(drawn))


def _small(png: bytes) -> str:
    """With a palette of few colours: lines on white need no more, and it is a third as large."""
    from PIL import Image

    small = io.BytesIO()
    with Image.open(io.BytesIO(png)) as image:
        image.convert("RGB").quantize(_COLOURS).save(small, format="png")
    return _address("png", small.getvalue())


def _address(kind: str, data: bytes) -> str:
    return f"data:image/{kind};base64,{base64.b64encode(data).decode('ascii')}"
