"""Texts and numbers of an HDF5 file that say what its arrays are: names of columns, a rate."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from heli_jax.flights.table import shown, wrong

_MOST_TEXTS, _LONGEST = 100, 1000
"""of a list, and bytes of each: others are data"""
_ATTRIBUTES = ("columns", "names", "labels", "channels", "column_names", "channel_names")
"""of a matrix, that may list its columns"""


# Any: h5py's classes cannot be named where it is not installed.
def content(item: Any) -> np.ndarray:
    """All of a data set. Nothing else here reads one.

    Args:
        item: a data set of h5py.

    Raises:
        InputError: it is kept in another file, any of which a log could name.
    """
    if item.is_virtual or item.external:
        problem = "is kept in another file, expected its numbers in this one"
        raise wrong(item.file.filename, problem, f"data set {shown(str(item.name))}")
    return np.asarray(item[()])


def list_of(item: Any) -> Sequence[Any] | None:
    """The texts of a data set that is a list of them; None of any other.

    Args:
        item: a data set of h5py.
    """
    if not 0 < (item.size or 0) <= _MOST_TEXTS:
        return None
    if item.dtype.kind == "S" and item.dtype.itemsize <= _LONGEST:
        return list(np.ravel(content(item)))
    if item.dtype.kind != "O":
        return None
    # Texts of any length, or in MATLAB's cells references to arrays of letters.
    values = list(np.ravel(content(item)))
    if all(isinstance(v, bytes | str) and len(v) <= _LONGEST for v in values):
        return values
    if _class_of(item) != "cell":
        return None
    letters = [item.file[v] if v else None for v in values]
    if not all(x is not None and is_text(x) and x.size <= _LONGEST for x in letters):
        return None
    return ["".join(map(chr, np.ravel(content(x)))) for x in letters]


def is_text(item: Any) -> bool:
    """Whether a data set of numbers holds letters, as MATLAB writes them."""
    return _class_of(item) == "char"


def _class_of(item: Any) -> str:
    stated = item.attrs.get("MATLAB_class", b"")
    return stated.decode("ascii", "replace") if isinstance(stated, bytes) else ""


def of_attributes(item: Any) -> dict[str, Sequence[Any]]:
    """Lists of texts among a data set's attributes that may name its columns, by attribute."""
    attributes = {}
    for name in _ATTRIBUTES:
        if name not in item.attrs:
            continue
        texts = np.ravel(item.attrs[name])
        if 1 < texts.size <= _MOST_TEXTS and texts.dtype.kind in "SUO":
            attributes[name] = list(texts)
    return attributes


def numbers_of(file: Any) -> dict[str, float]:
    """Single numbers among the attributes of a file, such as a rate."""
    numbers = {}
    for name in list(file.attrs)[:_MOST_TEXTS]:
        value = np.asarray(file.attrs[name])
        if value.size == 1 and value.dtype.kind in "iuf" and name not in file:
            numbers[name] = float(np.ravel(value)[0])
    return numbers
