"""HDF5 files, NetCDF 4 and MATLAB 7.3 among them, read in a process of their own.

libhdf5 may loop, crash or fill the memory over a damaged file, and hears no Ctrl-C meanwhile. So
`array_table` starts this module as a program: it reads one file within limits, writes a line of
JSON and the arrays behind it, as bytes, to standard output, and ends.
"""

import contextlib
import json
import signal
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from heli_jax.errors import InputError
from heli_jax.flights import packed
from heli_jax.flights.array_table import DataSets, guarded, holds_numbers
from heli_jax.flights.table import Budget, shown, wrong

_NO_VARIABLE = "This is a netCDF dimension but not a netCDF variable"
"""the name that NetCDF 4 gives to a dimension without values, which stands in the file as zeros"""
_BESIDE = 10**9
"""bytes for Python and its libraries"""
_MOST_ELEMENTS = 1000
"""of an array of references that are looked at"""
_COPIES = 4
"""how often numbers may be in memory while they are unpacked"""


def main() -> None:
    """Read the file that the arguments name: its path, kind, size [bytes] and a limit [s]."""
    path, kind, size, seconds = Path(sys.argv[1]), sys.argv[2], int(sys.argv[3]), int(sys.argv[4])
    budget = Budget(str(path), size)
    # The default ends the process at once, also within libhdf5.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    with contextlib.suppress(ImportError):
        import resource

        resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds))
        most = _BESIDE + _COPIES * budget.most
        resource.setrlimit(resource.RLIMIT_AS, (most, most))
    arrays: Mapping[str, np.ndarray] = {}
    try:
        sets = guarded(path, "HDF5 file", lambda: _read(path, kind, budget))
        arrays, units, notes = sets.vectors()
        shapes = [(name, x.dtype.str, x.size) for name, x in arrays.items()]
        head = {
            "arrays": shapes,
            "units": units,
            "notes": [(n.code, n.sentence, n.subjects, n.value) for n in notes],
        }
    except InputError as e:
        head = {"error": str(e)}
    sys.stdout.buffer.write(json.dumps(head).encode() + b"\n")
    for x in arrays.values():
        sys.stdout.buffer.write(np.ascontiguousarray(x).data)


def _read(path: Path, kind: str, budget: Budget) -> DataSets:
    import h5py  # pyright: ignore[reportMissingImports]

    read, references, stored = DataSets(budget), References(), []

    # Any: h5py's classes have no annotations.
    def visit(name: str, item: Any) -> None:
        if not isinstance(item, h5py.Dataset):
            return
        # Of a damaged file h5py gives names that are no text as bytes.
        name = name.decode("utf-8", "replace") if isinstance(name, bytes) else name
        # A structure's path is as `open_mat` gives it for older versions, so that a configuration
        # does not depend on the version in which a file was saved.
        dotted = name.replace("/", ".") if kind == "mat 7.3" else name
        if (texts := list_of(item)) is not None:
            read.add_texts(dotted, texts)
            return
        if kind == "mat 7.3":
            references.add(dotted, item)
        if is_text(item):
            references.add_letters(dotted, item)
            return
        if not holds_numbers(item.dtype, item.ndim):
            read.leave_out(dotted, item.dtype, item.shape)
            return
        if packed.text_of(item.attrs.get("NAME", "")).startswith(_NO_VARIABLE):
            return
        # An empty one has no size. Of one in pieces a piece is unpacked as a whole.
        chunk = int(np.prod(item.chunks or (0,), dtype=object)) * item.dtype.itemsize
        budget.require(chunk)
        budget.take(int(item.size or 0) * item.dtype.itemsize)
        # Of others nothing is read: they may be of types that h5py does not know.
        counting = (*packed.ATTRIBUTES, *packed.UNIT_ATTRIBUTES)
        attributes = {n: item.attrs[n] for n in counting if n in item.attrs}
        for field, values, own in _fields(dotted, content(item), attributes):
            stored.append((field, values, own))

    def refuse(name: str | bytes, link: Any) -> None:
        if isinstance(link, h5py.ExternalLink):
            problem = f"links to another file, {shown(link.filename)}: expected all data in one"
            raise wrong(str(path), problem, shown(str(name)))

    with h5py.File(path, "r") as file:
        file.visititems_links(refuse)
        # This visits every object once and follows no links, of which a circle would never end.
        file.visititems(visit)
        stored += [(name, np.array([x]), {}) for name, x in numbers_of(file).items()]
    for name, values, own in stored:
        read.add(references.path(name), values, own)
    read.labels |= references.texts
    return read


def _fields(
    name: str, values: np.ndarray, attributes: Mapping[str, Any]
) -> Iterator[tuple[str, np.ndarray, Mapping[str, Any]]]:
    """A data set, or the fields of its table as data sets in a group of its name, each with the
    attributes that are its own."""
    names = values.dtype.names
    if names is None:
        yield name, values, attributes
        return
    # What stands beside a table is of none of its fields, unless it is as many texts.
    stated = next((attributes[n] for n in packed.UNIT_ATTRIBUTES if n in attributes), ())
    units = list(np.ravel(stated)) if np.size(stated) == len(names) else [""] * len(names)
    for field, unit in zip(names, units, strict=True):
        yield from _fields(f"{name}/{field}", values[field], {"units": unit})


_MOST_TEXTS, _LONGEST = 100, 1000
"""of a list, and bytes of each: others are data"""


# Any: h5py's classes cannot be named where it is not installed.
def content(item: Any) -> np.ndarray:
    """All of a data set. Nothing else here reads one.

    Raises:
        InputError: it is kept in another file, any of which a log could name.
    """
    if item.is_virtual or item.external:
        problem = "is kept in another file, expected its numbers in this one"
        raise wrong(item.file.filename, problem, f"data set {shown(str(item.name))}")
    return np.asarray(item[()])


def list_of(item: Any) -> Sequence[Any] | None:
    """The texts of a data set that is a list of them; None of any other."""
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


def numbers_of(file: Any) -> dict[str, float]:
    """Single numbers among the attributes of a file, such as a rate."""
    numbers = {}
    for name in list(file.attrs)[:_MOST_TEXTS]:
        value = np.asarray(file.attrs[name])
        if value.size == 1 and value.dtype.kind in "iuf" and name not in file:
            numbers[name] = float(np.ravel(value)[0])
    return numbers


_KEPT = "#refs#"
_DEEPEST = 10
"""references within references, that are followed"""


class References:
    """The paths of referred elements, as in older versions of MATLAB: `signals[0].values`.

    MATLAB 7.3 keeps the elements of cells and of arrays of structures in a group `#refs#`, by names
    that mean nothing, each referred to from its place.
    """

    def __init__(self) -> None:
        self._paths: dict[str, str] = {}
        self._letters: dict[str, str] = {}

    # Any: h5py's classes cannot be named where it is not installed.
    def add(self, path: str, item: Any) -> None:
        """A data set of references."""
        if item.dtype.kind != "O" or not 0 < (item.size or 0) <= _MOST_ELEMENTS:
            return
        parent, _, field = path.rpartition(".")
        for i, reference in enumerate(np.ravel(content(item))):
            if not reference or isinstance(reference, bytes | str):
                continue
            target = item.file[reference].name.strip("/").replace("/", ".")
            # A cell has elements by itself, of structures each field has all elements'.
            is_cell = "MATLAB_class" in item.attrs or not parent
            self._paths.setdefault(target, f"{path}[{i}]" if is_cell else f"{parent}[{i}].{field}")

    def add_letters(self, path: str, item: Any) -> None:
        """A data set of letters, which may be the label of an array."""
        if 0 < (item.size or 0) <= _LONGEST:
            self._letters[path] = "".join(map(chr, np.ravel(content(item))))

    def path(self, name: str) -> str:
        """Where an array belongs; its own name where nothing refers to it."""
        for _ in range(_DEEPEST):
            if not name.startswith(_KEPT):
                break
            parts = name.split(".")
            known = (k for k in range(len(parts), 1, -1) if ".".join(parts[:k]) in self._paths)
            if (k := next(known, None)) is None:
                break
            name = ".".join([self._paths[".".join(parts[:k])], *parts[k:]])
        return name

    @property
    def texts(self) -> Mapping[str, str]:
        """Texts by the paths where they belong."""
        return {self.path(name): text for name, text in self._letters.items()}


if __name__ == "__main__":
    main()
