"""Pages from the templates beside this file; whatever text is put into one is escaped.

A figure of lines is there as numbers, which the page draws, and as words for who does not see it.
"""

import contextlib
import functools
import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import jinja2
import markupsafe

from heli_jax.numbers import page_sentence
from heli_jax.report import style
from heli_jax.report.charts import Chart, Numbers, as_base64, described

if TYPE_CHECKING:
    from matplotlib.figure import Figure

type Draw = "Callable[[], Chart | Figure | None]"
"""draws a figure; None where there is nothing to draw"""

MOST_FLIGHTS = 6
"""flights that get figures of their own; signals.csv has them all"""
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
    """Return the content security policy of a page: only this package's scripts, and nothing
    loaded."""
    # The escaping alone keeps a log's text from being run; this is the second lock.
    digests = (hashlib.sha256(_asset(n).encode()).digest() for n in _SCRIPTS)
    hashes = " ".join(f"'sha256-{as_base64(d)}'" for d in digests)
    return f"default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src {hashes}"


class Picture(NamedTuple):
    """A figure of a page: a chart that the page draws, or an image of a file."""

    name: str
    title: str
    alt: str
    """text alternative"""
    chart: int | None = None
    """its number among the page's charts; None of an image"""
    image: str = ""
    """a data: address; empty of a chart, and of what is a file alone"""
    size: tuple[int, int] = (0, 0)
    """of the image, width and height [pixel]"""
    file: str = ""
    """beside the page"""


def of_file(png: Path, title: str, alt: str) -> Picture:
    """An image that is drawn already."""
    from PIL import Image

    with Image.open(png) as image:
        size = image.size
    return Picture(png.stem, title, alt, None, _address("png", png.read_bytes()), size)


def picture(
    name: str,
    draw: Draw,
    numbers: Numbers,
    *,
    folder: Path | None = None,
    png: bool = False,
) -> Picture | None:
    """Draw a figure for a page; None where there is nothing to draw.

    Args:
        folder: for NAME.svg, and NAME.png where that is asked for; no files unless given.
    """
    # Charts alone need no Matplotlib, which takes a second to load.
    with style.in_style() if folder else contextlib.nullcontext():
        made = draw()
        svg = style.save(lambda: made, folder / name, png=png) if folder else None
    if made is None:
        return None
    file = f"{folder.name}/{name}.svg" if folder else ""
    if isinstance(made, Chart):
        number = numbers.add_chart(made)
        return Picture(name, made.title, described(made), number, file=file)
    title, size = made.get_suptitle().partition("\n")[0], made.get_size_inches()
    width, height = (round(96 * v) for v in size)
    image = _address("svg+xml", svg) if svg else ""
    return Picture(name, title, title, None, image, (width, height), file)


def _address(kind: str, data: bytes) -> str:
    return f"data:image/{kind};base64,{as_base64(data)}"
