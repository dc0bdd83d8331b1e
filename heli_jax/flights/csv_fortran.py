"""Numbers as Fortran's fixed formats leave them between blanks: glued at their signs, and with
exponents of three digits that have no letter."""

import re

_NUMBERS_ALONE = re.compile(r"[\s0-9.+\-eEdD]+")
_NO_LETTER = re.compile(r"(\.[0-9]*)([+-][0-9]{3})(?![0-9.])")
"""of 6.333892-103, which E14.6 writes of a number below 1E-99"""
# Behind a sign a point has to follow, which a date has not: 2024-03-01.
_GLUED = re.compile(r"(?<=[0-9.])(?=[+-][0-9]*\.)")


def parted(line: str) -> str:
    """A line of numbers with a blank between those that a sign alone parts, as in
    `6.3339E-03-7.8282E-04`, and `E` before exponents without a letter; any other as it is.

    Args:
        line: of a text whose columns have blanks between them.
    """
    if not is_fortran(line) or not _NUMBERS_ALONE.fullmatch(line):
        return line
    return _GLUED.sub(" ", _NO_LETTER.sub(r"\1E\2", line))


def is_fortran(text: str) -> bool:
    """Whether a text may hold numbers that have to be parted."""
    return bool(_GLUED.search(text) or _NO_LETTER.search(text))
