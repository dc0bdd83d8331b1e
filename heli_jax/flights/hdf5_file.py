"""HDF5 files, NetCDF 4 and MATLAB 7.3 among them, read in a process of their own.

libhdf5 may loop, crash or fill the memory over a damaged file, and hears no Ctrl-C meanwhile. So
`array_table` starts this module as a program: it reads one file within limits, writes a line of
JSON and the arrays behind it, as bytes, to standard output, and ends.
"""

import contextlib
import json
import signal
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from heli_jax.errors import InputError
from heli_jax.flights import hdf5_texts, packed
from heli_jax.flights.array_table import DataSets, guarded, holds_numbers
from heli_jax.flights.table import Budget, shown, wrong

_NO_VARIABLE = "This is a netCDF dimension but not a netCDF variable"
"""the name that NetCDF 4 gives to a dimension without values, which stands in the file as zeros"""
_BESIDE = 10**9
"""bytes for Python and its libraries"""
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

    read = DataSets(budget)

    # Any: h5py's classes have no annotations.
    def visit(name: str, item: Any) -> None:
        if not isinstance(item, h5py.Dataset):
            return
        # Of a damaged file h5py gives names that are no text as bytes.
        name = name.decode("utf-8", "replace") if isinstance(name, bytes) else name
        # A structure's path is as `open_mat` gives it for older versions, so that a configuration
        # does not depend on the version in which a file was saved.
        dotted = name.replace("/", ".") if kind == "mat 7.3" else name
        if (texts := hdf5_texts.list_of(item)) is not None:
            read.add_texts(dotted, texts)
            return
        if kind == "mat 7.3":
            read.references.add(dotted, item)
        if hdf5_texts.is_text(item):
            read.references.add_letters(dotted, item)
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
        for beside, texts in hdf5_texts.of_attributes(item).items():
            read.add_texts(f"{dotted}_{beside}", texts)
        for field, values, own in _fields(dotted, hdf5_texts.content(item), attributes):
            read.add(field, values, own)

    def refuse(name: str | bytes, link: Any) -> None:
        if isinstance(link, h5py.ExternalLink):
            problem = f"links to another file, {shown(link.filename)}: expected all data in one"
            raise wrong(str(path), problem, shown(str(name)))

    with h5py.File(path, "r") as file:
        file.visititems_links(refuse)
        # This visits every object once and follows no links, of which a circle would never end.
        file.visititems(visit)
        for name, number in hdf5_texts.numbers_of(file).items():
            read.add(name, np.array([number]), {})
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


if __name__ == "__main__":
    main()
