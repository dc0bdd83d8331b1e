"""Pages from the templates beside this file; all inserted text is escaped.

A line figure is stored as numbers, which the page draws, and as words for screen readers.
"""

import functools
import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jinja2
import markupsafe

from heli_jax.numbers import page_sentence
from heli_jax.report import style
from heli_jax.report.charts import Chart, Numbers, as_base64, described

type Draw = Callable[[], Chart]
"""Function that draws a figure."""

MOST_FLIGHTS = 6
"""Most flights with their own figures; signals.csv has all flights."""
_FOLDER = Path(__file__).parent
_SCRIPTS = ("uplot/uPlot.iife.min.js", "charts.js", "tables.js")
_NOTHING: dict[str, Any] = {"arrays": [], "charts": []}


def filled(template: str, **values: Any) -> str:
    """Return a page made from a template, such as report.html.j2, and its values."""
    # Everything is escaped, because names come from logs. Missing values are errors, because a page
    # with gaps would look like a result.
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(_FOLDER),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        # Lines that contain only a block leave no empty line.
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["sentence"] = page_sentence
    environment.globals |= {"asset": _asset, "policy": _policy()}
    return environment.get_template(template).render(**{"numbers": _NOTHING, **values})


@functools.cache
def _asset(name: str) -> markupsafe.Markup:
    """Return an own style or script unchanged."""
    return markupsafe.Markup((_FOLDER / "assets" / name).read_text(encoding="utf-8"))


@functools.cache
def _policy() -> str:
    """Return the content security policy of a page: only this package's scripts, no loading."""
    # Escaping already keeps text of a log from running; this is a second protection.
    digests = (hashlib.sha256(_asset(n).encode()).digest() for n in _SCRIPTS)
    hashes = " ".join(f"'sha256-{as_base64(d)}'" for d in digests)
    return f"default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src {hashes}"


class Picture(NamedTuple):
    """A figure of a page: a chart that the page draws, or an image of a file."""

    name: str
    title: str
    alt: str
    """Text alternative."""
    chart: int | None = None
    """Number of the chart on the page; None for an image."""
    image: str = ""
    """data: address; empty for a chart."""
    size: tuple[int, int] = (0, 0)
    """Width and height of the image [pixel]."""
    file: str = ""
    """File beside the page."""


def of_file(png: Path, title: str, alt: str) -> Picture:
    """Return the picture of an existing image."""
    from PIL import Image

    with Image.open(png) as image:
        size = image.size
    address = f"data:image/png;base64,{as_base64(png.read_bytes())}"
    return Picture(png.stem, title, alt, None, address, size)


def picture(
    name: str,
    draw: Draw,
    numbers: Numbers,
    *,
    folder: Path | None = None,
    png: bool = False,
) -> Picture:
    """Draw a figure for a page.

    Args:
        folder: directory for NAME.svg, and NAME.png if requested; default no files.
    """
    made, file = draw(), ""
    if folder is not None:
        style.save(lambda: made, folder / name, png=png)
        file = f"{folder.name}/{name}.svg"
    return Picture(name, made.title, described(made), numbers.add_chart(made), file=file)
