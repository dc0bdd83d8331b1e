"""The page of a sweep: its summary as tables, and its figures; self-contained, without scripts."""

import base64
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jinja2

_QUANTILES = ("min", "q05", "median", "q95", "max")


def write_page(path: Path, directory: Path, title: str) -> None:
    """Write the page.

    Args:
        path: the HTML file.
        directory: of the sweep, with summary.json and figures/.
        title: of the page.
    """
    content = json.loads((directory / "summary.json").read_text(encoding="utf-8"))
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("heli_jax.report", "."), autoescape=True
    )
    page = environment.get_template("sweep.html.j2").render(
        title=title,
        summary=content,
        counts=", ".join(f"{n} {s.replace('_', ' ')}" for s, n in content["status"].items() if n),
        results=[_result(name, result) for name, result in content["results"].items()],
        elements=list(_elements(content)),
        pictures=[
            (png.stem, base64.b64encode(png.read_bytes()).decode("ascii"))
            for png in sorted((directory / "figures").glob("*.png"))
        ],
    )
    path.write_text(page, encoding="utf-8")


# Any: what summary.json holds.
def _result(name: str, result: dict[str, Any]) -> tuple[str, ...]:
    numbers = (f"{result[k]:.4g}" if k in result else "" for k in _QUANTILES)
    return (name, *numbers, result.get("unit", ""))


def _elements(content: dict[str, Any]) -> Iterator[tuple[str, str, str, str]]:
    """Result, whether worst or best, number, and where it lies: worst and best first."""
    for words in ("worst", "best"):
        for name, elements in content[words].items():
            for element in elements:
                at = ", ".join(f"{n} = {v:.4g}" for n, v in element["axes"].items())
                yield name, words, str(element["element"]), at
