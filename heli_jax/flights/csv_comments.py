"""Lines for people between the rows of a text, and behind the last of them."""

import dataclasses
import re

from heli_jax.finding import Finding, note
from heli_jax.flights.csv_text import Body, first_row
from heli_jax.flights.table import shown

# A sample that somebody marked is no comment: *0.02 0.5.
_COMMENT = re.compile(rb"^[ \t]*((?:#|%|//|[!*]+(?=[ \t]*[A-Za-z]))[^\r\n]*)", re.MULTILINE)
_MOST = 0.02
"""part of the lines: more of them are samples"""
_FEW = 10


def without_comments(body: Body) -> tuple[Body, Finding] | None:
    """The rows with blank lines in place of comments, and a note; None where there are none.

    Args:
        body: rows that are no plain numbers.
    """
    first = (first_row(body.beginning(1 << 20), 0) or "").encode()
    # A column may hold such signs.
    if body.has_quotes or _COMMENT.match(first):
        return None
    data = bytes(body.data)
    match = _COMMENT.search(data)
    if match is None:
        return None
    count = sum(1 for _ in _COMMENT.finditer(data))
    if count > max(_FEW, _MOST * data.count(b"\n")):
        return None
    line = body.first_line + data.count(b"\n", 0, match.start())
    words = shown(match[1].decode("utf-8", "replace").replace("\t", " "))
    what = f"line {line}" if count == 1 else f"{count} lines, the first line {line},"
    verb = "is a comment" if count == 1 else "are comments"
    rows = memoryview(_COMMENT.sub(b"", data))
    words = f"{what} {verb} and {'is' if count == 1 else 'are'} passed over: {words}"
    return dataclasses.replace(body, rows=rows), note("text.comments", words, value=count)
