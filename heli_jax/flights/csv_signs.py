"""Decimal commas, and what stands between thousands: 1.577,25 and 1 577,25 and 1,577.25."""

import dataclasses
import itertools
import re
from collections.abc import Sequence
from typing import TYPE_CHECKING

from heli_jax.errors import InputError
from heli_jax.flights.csv_text import Body
from heli_jax.flights.csv_texts import compute
from heli_jax.flights.table import shown

# Imported again within the functions that need it: it takes a quarter of a second.
if TYPE_CHECKING:
    import pyarrow as pa

_SAMPLE, _ROWS = 1 << 20, 2000
"""bytes and rows by which the decimal sign of a file is told"""
_SPACES = "'’ \u00a0\u2009\u202f"
"""between thousands, beside the sign that is not the decimal one"""
_OTHER = {".": ",", ",": "."}
_WITH = {
    sign: re.compile(rf"[+-]?[0-9{re.escape(_OTHER[sign] + _SPACES)}]*{re.escape(sign)}[0-9]+"
                     r"(?:[eEdD][+-]?[0-9]+)?")
    for sign in _OTHER
}  # fmt: skip


class TwoDecimalSigns(Exception):
    """A file holds both decimal commas and decimal points."""


def _grouped(sign: str) -> str:
    """The pattern of a number with groups of thousands, where `sign` is decimal."""
    # No group begins with a zero: 0.125 is an eighth.
    mark = "[" + re.escape(_OTHER[sign]) + _SPACES + "]"
    return rf"[+-]?[1-9][0-9]{{0,2}}(?:{mark}[0-9]{{3}})+(?:{re.escape(sign)}[0-9]*)?"


def decimal_signs(body: Body) -> Sequence[str]:
    """The decimal sign of a file; both, in the order to try, where its first rows tell none.

    A file has one: of columns each by itself `1.577` beside `0,25` would be one and a half.
    """
    first = body.beginning(_SAMPLE)
    # A comma between cells is decimal only within quotes.
    if b'"' not in first if body.delimiter == "," else b"," not in first:
        return (".",)
    if body.size > len(first):
        first = first[: first.rfind(b"\n") + 1]
    sample = dataclasses.replace(body, rows=memoryview(first))
    seen: dict[str, list[str]] = {",": [], ".": []}
    try:
        for _, cells in itertools.islice(sample.records(), _ROWS):
            for cell in map(str.strip, cells):
                for sign, form in _WITH.items():
                    if form.fullmatch(cell):
                        seen[sign].append(cell)
    # What is wrong with the quotes is told where the cells are read.
    except InputError:
        return (".",)
    # What can only be thousands where the other sign is decimal says nothing of this one.
    sure = {
        sign: any(not re.fullmatch(_grouped(_OTHER[sign]), cell) for cell in cells)
        for sign, cells in seen.items()
    }
    if sure[","]:
        return (",",)
    return (".",) if sure["."] or (not seen[","] and body.delimiter == ",") else (".", ",")


def decimal_points(text: "pa.ChunkedArray", sign: str) -> tuple["pa.ChunkedArray", str]:
    """Cells with decimal points and without marks between thousands, and the first that had some,
    empty where none had.

    Args:
        text: a column (N,).
        sign: which is decimal in the file.

    Raises:
        TwoDecimalSigns: a number has the other sign where no thousands end.
    """
    pc = compute()
    grouped = pc.match_substring_regex(text, rf"^\s*{_grouped(sign)}\s*$")
    example = _first(text, grouped)
    if example:
        without = pc.replace_substring_regex(
            text, "[" + re.escape(_OTHER[sign]) + _SPACES + "]", ""
        )
        text = pc.if_else(grouped, without, text)
    if sign == ".":
        return text, example
    with_comma = _first(text, pc.match_substring_regex(text, r"^\s*[+-]?[0-9]*,[0-9]"))
    with_point = pc.match_substring_regex(text, r"^\s*[+-]?[0-9]*\.[0-9]+\s*$")
    other = _first(text, with_point)
    if other:
        both = f"both {shown(with_comma)} and {shown(other)}" if with_comma else shown(other)
        raise TwoDecimalSigns(f"got {both}, expected one decimal sign")
    return pc.replace_substring(text, ",", "."), example


def _first(text: "pa.ChunkedArray", flags: "pa.ChunkedArray") -> str:
    pc = compute()
    # `index` alone would do, and import pandas for its second argument.
    if not pc.any(flags).as_py():
        return ""
    return text[pc.index(flags, True).as_py()].as_py().strip()
