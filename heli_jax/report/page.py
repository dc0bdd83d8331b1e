"""Pages from the templates beside this file; whatever text is put into one is escaped.

A figure is there as an image that every browser shows, as words for who does not see it, and as
numbers for the page's own drawing.
"""

import functools
import hashlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import jinja2
import markupsafe

from heli_jax.numbers import page_sentence
from heli_jax.report import style
from heli_jax.report.charts import Logged, Numbers, as_base64, chart_of, described

if TYPE_CHECKING:
    from heli_jax.report.style import Panels


_FOLDER = Path(__file__).parent
_SCRIPTS = ("uplot/uPlot.iife.min.js", "charts.js", "flight.js", "tables.js")
_NOTHING: dict[str, Any] = {"arrays": [], "charts": [], "scenes": []}


def filled(template: str, **values: Any) -> str:
    """The page of a template, such as report.html.j2, with its values."""
    # Escaped throughout, and a missing value is an error: names come from logs, and a page with a
    # gap where a number belongs looks like a result.
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(_FOLDER),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        # Lines that hold a block alone leave no empty line in the page.
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["sentence"] = page_sentence
    environment.globals |= {"asset": _asset, "policy": _policy()}
    return environment.get_template(template).render(**{"numbers": _NOTHING, **values})


@functools.cache
def _asset(name: str) -> markupsafe.Markup:
    """A style or script of ours, as it stands."""
    return markupsafe.Markup((_FOLDER / "assets" / name).read_text(encoding="utf-8"))


@functools.cache
def _policy() -> str:
    """What a browser may do with a page: run the scripts of this package and no other, load
    nothing."""
    # The escaping alone keeps a log's text from being run; this is the second lock.
    digests = (hashlib.sha256(_asset(n).encode()).digest() for n in _SCRIPTS)
    hashes = " ".join(f"'sha256-{as_base64(d)}'" for d in digests)
    return f"default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src {hashes}"


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
    """An image that is drawn already."""
    from PIL import Image

    with Image.open(png) as image:
        size = image.size
    return Picture(png.stem, title, _address("png", png.read_bytes()), size, alt)


def picture(
    name: str,
    draw: Callable[[], "Panels"],
    numbers: Numbers,
    *,
    folder: Path | None = None,
    logged: Mapping[str, Logged] | None = None,
    kind: Kind = "live",
    png: bool = False,
) -> Picture | None:
    """Draw a figure for a page; None where there is nothing to draw.

    Args:
        folder: for NAME.svg, and NAME.png where that is asked for; no files unless given.
        kind: `live` is drawn anew by the page, to be zoomed, which panels of lines can be; of
            `panels` words are made alone; of an `image` the title is all.
    """
    with style.in_style():
        drawn = style.figure_of(draw())
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
    words = title if chart is None else described(chart)
    number = None
    if chart is not None and kind == "live":
        number = numbers.add_chart(chart, dict(logged or {}))
    return Picture(name, title, _address("svg+xml", svg), (width, height), words, number)


def _address(kind: str, data: bytes) -> str:
    return f"data:image/{kind};base64,{as_base64(data)}"
