"""Rows of text, as the page and the command line print them."""

from collections.abc import Mapping
from typing import NamedTuple

NOT_DETERMINED = "not determined"


class Table(NamedTuple):
    """Heads and rows of text; the first column names the row."""

    head: tuple[str, ...]
    rows: list[tuple[str, ...]]


def pairs(content: Mapping[str, object], unit: str = "") -> Table:
    """Names and values."""
    return Table(
        ("", ""),
        [(n, f"{v:.2f}{unit}" if isinstance(v, float) else str(v)) for n, v in content.items()],
    )
