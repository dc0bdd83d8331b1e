"""Pages from the templates beside this file; whatever text is put into one is escaped."""

import base64
import functools
import hashlib
from pathlib import Path
from typing import Any

import jinja2
import markupsafe

from heli_jax.numbers import page_sentence

_FOLDER = Path(__file__).parent
_SCRIPTS = ("uplot/uPlot.iife.min.js", "charts.js", "flight.js", "tables.js")
_NOTHING: dict[str, Any] = {"arrays": [], "charts": [], "scenes": []}


def filled(template: str, **values: Any) -> str:
    """The page of a template, such as report.html.j2, with its values.

    Args:
        template: the file's name.
        **values: what it names; `numbers`, of `embedded.Numbers`, where it has figures that are
            drawn anew.
    """
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
    hashes = " ".join(f"'sha256-{base64.b64encode(d).decode('ascii')}'" for d in digests)
    return f"default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src {hashes}"
