"""MATLAB files to version 7.2, read with NumPy alone.

Source: 'MAT-File Format' of The MathWorks, levels 4 and 5. SciPy's reader is not used: of a file
with a few flipped bytes it ends the process. What is read are numbers, structures and cells, and
short texts; sparse arrays are passed over, and objects are named.
"""

import struct
import zlib
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from heli_jax.errors import InputError
from heli_jax.flights.table import Budget

# By the number that the format has for each type of data; 8, 10 and 11 are reserved.
_NUMBERS = {
    1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8",
}  # fmt: skip
_MATRIX, _COMPRESSED = 14, 15
_CELL, _STRUCT, _CHAR, _FIRST_NUMERIC, _LAST_NUMERIC, _OBJECT = 1, 2, 4, 6, 15, 17
_COMPLEX = 0x800
_LETTERS = {1: "latin-1", 2: "latin-1", 4: "utf-16", 16: "utf-8", 17: "utf-16"}
"""encodings by the number that the format has for each type of text"""
_LONGEST_TEXT = 1000
"""bytes of a name or a unit: longer texts are passed over"""
_MOST_LETTERS = 20_000
"""bytes of a list of names"""
_MOST_VALUES = 3 * 10**8
_DEEPEST = 8
"""structures within structures"""
_PATH = 100
"""bytes that a path takes in memory"""
_MOST_ELEMENTS = 100
"""of an array of structures: more are data of another shape than a log's"""


class DamagedMatFile(Exception):
    """The file is no MATLAB file, or not whole; in words what is wrong."""


class _Element(NamedTuple):
    """A piece of a file: its type and bytes, and where the next begins."""

    kind: int
    data: memoryview
    end: int


class MatFile(NamedTuple):
    """The arrays of numbers of a file by path, `log.roll.data`, `runs[0].phi`, its short texts in
    structures and cells, `runs[0].label`, and the classes of its objects, which are not read."""

    arrays: dict[str, np.ndarray]
    texts: dict[str, str]
    objects: dict[str, str]


class _Object(NamedTuple):
    """A table, a timetable or another object, of which only its class is known."""

    kind: str


def read_mat(data: bytes, budget: Budget) -> MatFile:
    """The arrays and texts of a file.

    Raises:
        DamagedMatFile: it cannot be read.
        InputError: its arrays would fill the memory.
    """
    try:
        # Level 5 ends its header of 128 bytes with the letters MI as a number of the machine that
        # wrote it, so their order tells that of all bytes. Level 4 has no header.
        mark = data[126:128]
        if len(data) <= 128 or mark not in (b"IM", b"MI"):
            raise DamagedMatFile("no header of level 5; save it anew, save('flight.mat', '-v7')")
        variables = dict(_level_5(memoryview(data), "<" if mark == b"IM" else ">", budget))
        return MatFile(
            # What MATLAB keeps of objects stands behind them without a name.
            {name: x for name, x in variables.items() if isinstance(x, np.ndarray) and name},
            {name: text for name, text in variables.items() if isinstance(text, str)},
            {name: x.kind for name, x in variables.items() if isinstance(x, _Object)},
        )
    except InputError:
        raise
    except (struct.error, ValueError, UnicodeDecodeError, zlib.error) as e:
        raise DamagedMatFile("a piece of it is no array") from e


type _Content = tuple[str, np.ndarray | str | _Object]
"""the path of an array, a text or an object, and what it is"""


def _level_5(data: memoryview, order: str, budget: Budget) -> Iterator[_Content]:
    at = 128
    while at + 8 <= len(data):
        element = _element(data, at, order)
        at = element.end
        # A compressed piece holds one whole piece with a head of its own.
        if element.kind == _COMPRESSED:
            claimed = _claimed(element.data, order)
            budget.take(claimed)
            # Stopped where it claims to end: what is behind is not looked at by any reader.
            content = zlib.decompressobj().decompress(element.data, claimed)
            element = _element(memoryview(content), 0, order)
        if element.kind == _MATRIX:
            yield from _matrix(element.data, order, "", 0, budget)


def _claimed(data: memoryview, order: str) -> int:
    """The bytes of a compressed piece, as its head says, which is all that is unpacked for it."""
    head = zlib.decompressobj().decompress(data, 8)
    if len(head) < 8:
        raise DamagedMatFile("it is cut off")
    word, size = struct.unpack(f"{order}2I", head)
    # A small piece is all in its head.
    return 8 if word >> 16 else 8 + size


def _element(data: memoryview, at: int, order: str) -> _Element:
    word, size = struct.unpack_from(f"{order}2I", data, at)
    # A small element has its size in the upper half of the first word and its data in the second.
    if word >> 16:
        kind, size, begin, end = word & 0xFFFF, word >> 16, at + 4, at + 8
        if size > 4:
            raise DamagedMatFile("a small piece claims more than 4 bytes")
    else:
        kind, begin = word, at + 8
        # All but compressed data are padded to 8 bytes.
        end = begin + size + (0 if kind == _COMPRESSED else -size % 8)
    # A view would silently be shorter than what was claimed.
    if begin + size > len(data):
        raise DamagedMatFile("it is cut off")
    return _Element(kind, data[begin : begin + size], end)


def _matrix(
    data: memoryview, order: str, prefix: str, depth: int, budget: Budget
) -> Iterator[_Content]:
    """The arrays in one matrix; `prefix` is its path, empty where it has a name of its own."""
    if not data or depth > _DEEPEST:
        return
    flags = _element(data, 0, order)
    # The class of an array is the lowest byte; those above say whether it is complex or logical.
    word = struct.unpack_from(f"{order}I", flags.data)[0]
    kind, is_complex = word & 0xFF, bool(word & _COMPLEX)
    if kind == _OBJECT:
        # Without a shape: its name, the system that made its class (MCOS), and the class.
        name, system = _element(data, flags.end, order), None
        if not prefix:
            system = _element(data, name.end, order)
        made = _element(data, (system or name).end, order)
        yield prefix or _letters(name), _Object(_letters(made))
        return
    shape, at = _numbers(data, flags.end, order)
    # As floating point: the product of what a damaged shape claims could overflow integers, and
    # come out small.
    if shape.size < 2 or shape.min() < 0 or np.prod(shape, dtype=float) > _MOST_VALUES:
        raise DamagedMatFile(f"an array claims the shape {shape.tolist()[:8]}")
    label = _element(data, at, order)
    name = prefix or bytes(label.data).decode("utf-8", "replace")
    if _FIRST_NUMERIC <= kind <= _LAST_NUMERIC:
        # The numbers may be stored in a smaller type than the array has: MATLAB saves a double of
        # whole numbers as bytes. What counts is the type that stands with them.
        values, _ = _numbers(data, label.end, order, budget)
        budget.take(16 * values.size if is_complex else 0)
        if values.size != np.prod(shape):
            raise DamagedMatFile(f"an array of {values.size} values claims {np.prod(shape)}")
        # The real part comes first, and is what is read; the type says that there is another.
        yield name, (values + 0j if is_complex else values).reshape(shape, order="F")
    elif kind == _CHAR and shape.size == 2 and shape[0] == 1:
        if text := _text(_element(data, label.end, order), order):
            yield name, text
    elif kind == _CHAR and shape.size == 2 and 0 < shape[0] <= _MOST_ELEMENTS:
        # A list of names, filled up with blanks to one length; letters go down the columns.
        text = _text(_element(data, label.end, order), order, _MOST_LETTERS)
        if len(text) == np.prod(shape):
            for i, path in enumerate(_indexed(name, shape[:1])):
                yield path, text[i :: shape[0]].strip("\0 ")
    elif kind == _CELL:
        yield from _members(data, label.end, order, [_indexed(name, shape)], depth, budget)
    elif kind == _STRUCT:
        # All names of a structure's fields are of one width, filled up with zeros.
        width, at = _numbers(data, label.end, order)
        fields = _element(data, at, order)
        if width.size != 1 or not 0 < width[0] <= 1000:
            raise DamagedMatFile("a structure has no names of fields")
        budget.take(len(fields.data) // int(width[0]) * _MOST_ELEMENTS * _PATH)
        names = _field_names(bytes(fields.data), int(width[0]))
        paths = [[f"{each}.{field}" for field in names] for each in _indexed(name, shape)]
        yield from _members(data, fields.end, order, paths, depth, budget)


def _text(element: _Element, order: str, longest: int = 0) -> str:
    """A line of text; empty where it is long, or of no encoding that is known. As it is, with the
    blanks around it, where it may be `longest` bytes."""
    encoding = _LETTERS.get(element.kind, "")
    if not encoding or len(element.data) > (longest or _LONGEST_TEXT):
        return ""
    if encoding == "utf-16":
        encoding += "-le" if order == "<" else "-be"
    text = bytes(element.data).decode(encoding, "replace")
    return text if longest else text.strip("\0 ")


def _letters(element: _Element) -> str:
    return bytes(element.data[:_LONGEST_TEXT]).decode("utf-8", "replace").strip("\0 ")


def _field_names(text: bytes, width: int) -> list[str]:
    pieces = [text[i : i + width] for i in range(0, len(text), width)]
    return [piece.split(b"\0")[0].decode("utf-8", "replace") for piece in pieces]


def _indexed(name: str, shape: np.ndarray) -> list[str]:
    """A path for each element of a cell or an array of structures, of the first of them."""
    count = int(np.prod(shape))
    return [name] if count == 1 else [f"{name}[{i}]" for i in range(min(count, _MOST_ELEMENTS))]


def _members(
    data: memoryview, at: int, order: str, paths: list[list[str]], depth: int, budget: Budget
) -> Iterator[_Content]:
    """The arrays in matrices that follow each other, by their paths."""
    for path in (path for row in paths for path in row):
        element = _element(data, at, order)
        at = element.end
        if element.kind != _MATRIX:
            raise DamagedMatFile("a structure or cell holds something else than arrays")
        # Members have no names of their own in the file: the path is what tells them apart.
        yield from _matrix(element.data, order, path, depth + 1, budget)


def _numbers(
    data: memoryview, at: int, order: str, budget: Budget | None = None
) -> tuple[np.ndarray, int]:
    """The numbers of a piece, in the machine's own order, and where the next begins."""
    element = _element(data, at, order)
    if element.kind not in _NUMBERS:
        raise DamagedMatFile(f"numbers are of kind {element.kind}, which is none")
    kind = np.dtype(order + _NUMBERS[element.kind])
    if budget is not None:
        budget.take_numbers(len(element.data) // kind.itemsize, len(element.data))
    return np.frombuffer(element.data, kind).astype(kind.newbyteorder("=")), element.end
