"""The page of a sweep: its summary as tables, and its figures; self-contained."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from heli_jax.numbers import NOTHING, number
from heli_jax.report.origin import origin
from heli_jax.report.page import Picture, filled, of_file
from heli_jax.report.style import pretty
from heli_jax.report.sweeps import stems
from heli_jax.report.tables import Table

_QUANTILES = ("min", "q05", "median", "q95", "max")
_FILES = ("config.yaml", "summary.json", "figures/")
_DIGITS = 4
_KINDS = {
    "slices": ("{} against each axis", "dots, and the median with a 5 to 95 % band"),
    "maps": ("{} over pairs of axes", "colours: median of the elements in each cell"),
}
"""by what a figure's file begins with: its title, and what it draws"""
_OTHERS = {
    "corner": ("Axes and results together", "histograms, and densities of each two of them"),
    "worst": ("Where the worst elements lie", "a line through the axes for each"),
}


def write_page(path: Path, directory: Path, title: str) -> None:
    """Write the page."""
    content = json.loads((directory / "summary.json").read_text(encoding="utf-8"))
    config = directory / "config.yaml"
    text = config.read_text(encoding="utf-8") if config.is_file() else ""
    files = tuple(name for name in _FILES if (directory / name).exists())
    page = filled(
        "sweep.html.j2",
        title=title,
        summary=content,
        counts=", ".join(f"{n} {s.replace('_', ' ')}" for s, n in content["status"].items() if n),
        results=_results(content),
        elements=_elements(content),
        pictures=list(_pictures(content, directory / "figures")),
        origin=origin(text, files),
    )
    path.write_text(page, encoding="utf-8")


# Any: what summary.json holds.
def _results(content: dict[str, Any]) -> Table:
    rows = [
        (name, *(number(r.get(k), _DIGITS) for k in _QUANTILES), pretty(r.get("unit")))
        for name, r in content["results"].items()
    ]
    return Table(("result", "min", "5 %", "median", "95 %", "max", "unit"), rows)


def _elements(content: dict[str, Any]) -> Table:
    """Result, whether worst or best, value, and where it lies: a column for each axis."""
    listed = [
        (name, words, pretty(content["results"].get(name, {}).get("unit")), element)
        for words in ("worst", "best")
        for name, elements in content[words].items()
        for element in elements
    ]
    axes = list(dict.fromkeys(axis for *_, e in listed for axis in e["axes"]))
    rows = []
    for name, words, unit, e in listed:
        # `number` writes a dash for what is not there.
        value, *places = (number(v, _DIGITS) for v in (e.get("value"), *map(e["axes"].get, axes)))
        rows.append((name, words, value, unit, str(e["element"]), *places))
    return Table(("result", "which", "value", "unit", "element", *axes), rows)


def _pictures(content: dict[str, Any], folder: Path) -> Iterator[tuple[Picture, str]]:
    """The figures with their captions: titles in words, and what they show in numbers."""
    results = {stem: name for name, stem in stems(list(content["results"])).items()}
    for png in sorted(folder.glob("*.png")):
        kind, _, stem = png.stem.partition("-")
        name = results.get(stem, stem)
        title, words = _OTHERS.get(png.stem) or _KINDS.get(kind, (png.stem, ""))
        title = title.format(name)
        names = [name] if kind in _KINDS else list(content["results"])
        numbers = "; ".join(_range(n, content["results"][n]) for n in names[:_TOLD])
        alt = f"{title}: {words}. Over the sweep {numbers}."
        yield of_file(png, title, alt), f"{title}: {words}. (figures/{png.stem}.svg, .png)"


_TOLD = 6
"""results whose numbers a figure's words give"""


def _range(name: str, result: dict[str, Any]) -> str:
    unit = pretty(result.get("unit"))
    ends = f"{number(result.get('min'), 3)} to {number(result.get('max'), 3)}"
    return f"{name} {ends}{'' if unit == NOTHING else f' {unit}'}"
