"""Readers of MATLAB (.mat), NetCDF (.nc), HDF5 (.h5, .hdf5) and JSON lines (.jsonl, .ndjson).

SciPy, h5py and pyarrow read them in a separate process.
"""

import importlib.util
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from heli_jax.flights.clock import is_date, seconds_of_dates
from heli_jax.flights.formats.apart import Content, Reader, read_apart
from heli_jax.flights.formats.arrays import (
    LARGEST,
    MOST_ELEMENTS,
    PACKING,
    UNIT_ATTRIBUTES,
    ArrayTable,
    DataSets,
    holds_numbers,
    text_of,
)
from heli_jax.flights.formats.arrow import column_floats, is_clock, is_number
from heli_jax.flights.log import Budget, shown, wrong
from heli_jax.regular_file import read_regular

HDF5_MAGIC = b"\x89HDF\r\n\x1a\n"
NETCDF_MAGICS = (b"CDF\x01", b"CDF\x02")
MATLAB_MAGIC = b"MATLAB "
_DEEPEST = 10
"""Deepest nesting of groups and structures."""
_LONGEST_LIST = 16
"""Most numbers of a list within a record."""
_NO_VARIABLE = "This is a netCDF dimension but not a netCDF variable"
"""Name that NetCDF 4 gives to a dimension without values, which the file stores as zeros."""


def open_mat(path: Path) -> ArrayTable:
    """Read a MATLAB file; version 7.3 needs h5py."""
    data = read_regular(path, "a MATLAB file", LARGEST)
    # MATLAB puts 512 bytes in front of HDF5's mark, which is 8 bytes long.
    is_hdf5 = data[:520].find(HDF5_MAGIC) >= 0 or data.startswith(b"MATLAB 7.3")
    if is_hdf5:
        return _read(path, "mat 7.3", read_matlab_73, "HDF5 file", data)
    return _read(path, "mat", read_matlab, "MATLAB file", data)


def open_netcdf(path: Path) -> ArrayTable:
    """Read a NetCDF file; version 4 needs h5py. Errors are as in `open_mat`."""
    data = read_regular(path, "a NetCDF file", LARGEST)
    if data.startswith(HDF5_MAGIC):
        return _read(path, "netcdf", read_hdf5, "HDF5 file", data)
    if not data.startswith(NETCDF_MAGICS):
        raise wrong(str(path), "is no NetCDF file, expected one that begins with its mark")
    return _read(path, "netcdf", read_netcdf_3, "NetCDF file", data)


def open_hdf5(path: Path) -> ArrayTable:
    """Read an HDF5 file, which needs h5py. Errors are as in `open_mat`."""
    data = read_regular(path, "an HDF5 file", LARGEST)
    if not data.startswith(HDF5_MAGIC):
        raise wrong(str(path), "is no HDF5 file, expected one that begins with its mark")
    return _read(path, "hdf5", read_hdf5, "HDF5 file", data)


def open_json_lines(path: Path) -> ArrayTable:
    """Read records in JSON, one a line."""
    data = read_regular(path, "a log of JSON lines", LARGEST)
    return _read(path, "json", read_json_lines, "file of JSON lines", data)


def _read(path: Path, kind: str, reader: Reader, what: str, data: bytes) -> ArrayTable:
    """Read the file with its reader in a separate process."""
    if what == "HDF5 file" and importlib.util.find_spec("h5py") is None:
        problem = "is an HDF5 file, which needs h5py: pip install 'heli_jax[logs]'"
        raise wrong(str(path), problem)
    facts, vectors, notes = read_apart(path, reader, what, len(data))
    arrays = dict(zip(facts["units"], vectors, strict=True))
    return ArrayTable(str(path), kind, data, arrays, facts["units"], tuple(notes))


def _content(sets: DataSets) -> Content:
    arrays, units, notes = sets.vectors()
    return Content({"units": units}, list(arrays.values()), notes)


def read_netcdf_3(path: Path, budget: Budget) -> Content:
    """Read the variables of a NetCDF file of version 3."""
    from scipy.io import netcdf_file

    sets = DataSets(budget)
    with netcdf_file(path, mmap=False) as file:
        for name, variable in file.variables.items():
            values: Any = variable.data
            values = np.asarray(values)
            # In the computer's own byte order.
            values = values.astype(values.dtype.newbyteorder("="))
            sets.add(str(name), values, variable._attributes)
    return _content(sets)


def read_matlab(path: Path, budget: Budget) -> Content:
    """Read the arrays of a MATLAB file, also in structures and cells."""
    from scipy.io import loadmat

    sets, objects = DataSets(budget), list[str]()

    def take(name: str, value: Any, depth: int) -> None:
        if not isinstance(value, np.ndarray) or depth > _DEEPEST:
            return  # a sparse matrix, or a header
        kind = value.dtype
        if kind.names and "_Class" in kind.names:
            # A table, a timetable, ...
            objects.append(name)
            sets.leave_out(name, f"a MATLAB {value.ravel()[0]['_Class']}")
        elif kind.names or kind.kind == "O":
            # Structures or cells, in MATLAB's column-major order.
            elements = value.ravel("F")[:MOST_ELEMENTS]
            for path, element in zip(_indexed(name, value.size), elements, strict=False):
                for field in kind.names or ():
                    take(f"{path}.{field}", element[field], depth + 1)
                if not kind.names:
                    take(path, element, depth + 1)
        elif kind.kind != "U":
            sets.add(name, value, {})

    for name, value in loadmat(path).items():
        if not name.startswith("__"):
            take(name, value, 0)
    if objects and sets.longest < 2:
        problem = f"holds {shown(objects[0])}, a MATLAB object, expected arrays of numbers"
        way = f"writetable or writetimetable({objects[0]}, 'flight.csv') writes those of a table"
        raise wrong(str(path), f"{problem}; {way}")
    return _content(sets)


def _indexed(name: str, count: int) -> list[str]:
    """Return a path for each element of a list; the name itself for a single one."""
    return [name] if count == 1 else [f"{name}[{i}]" for i in range(min(count, MOST_ELEMENTS))]


def read_matlab_73(path: Path, budget: Budget) -> Content:
    """Read a MATLAB file of version 7.3, by `log.roll`."""
    return read_hdf5(path, budget, ".")


def read_hdf5(path: Path, budget: Budget, between: str = "/") -> Content:
    """Read the numbers of a file by their path of groups, `log/roll`."""
    import h5py as library  # pyright: ignore[reportMissingImports]

    sets = DataSets(budget)

    h5py: Any = library  # its classes have no annotations
    seen: set[int] = set()

    def visit(item: Any, name: str, depth: int) -> None:
        """Visit a group with its content, or a data set; each object once, whatever links to it."""
        address = h5py.h5o.get_info(item.id).addr
        if address in seen or depth > _DEEPEST:
            return
        seen.add(address)
        if isinstance(item, h5py.Dataset):
            _data_set(path, sets, item, name)
        for key in item if isinstance(item, h5py.Group) else ():
            link = item.get(key, getlink=True)
            # In a damaged file a name may be no text.
            leaf = key if isinstance(key, bytes) else key.encode("utf-8", "surrogateescape")
            leaf = leaf.decode("utf-8", "replace")
            if isinstance(link, h5py.ExternalLink):
                problem = f"links to another file, {shown(link.filename)}: expected all data in one"
                raise wrong(str(path), problem, shown(leaf))
            # MATLAB keeps cells and arrays of structures in a separate group, by numbers.
            if isinstance(link, h5py.HardLink) and not leaf.startswith("#"):
                visit(item[key], f"{name}{between}{leaf}" if name else leaf, depth + 1)

    with h5py.File(path, "r") as file:
        visit(file, "", 0)
    return _content(sets)


def read_json_lines(path: Path, budget: Budget) -> Content:
    """Read the numbers of records, with nested ones by path: `imu.gyro[0]`."""
    import pyarrow as pa
    import pyarrow.compute as functions
    import pyarrow.json as reader

    sets = DataSets(budget)
    pc: Any = functions  # its functions are made at import

    def take(name: str, values: pa.ChunkedArray, depth: int) -> None:
        kind = values.type
        if pa.types.is_struct(kind) and depth < _DEEPEST:
            for i in range(kind.num_fields):
                take(f"{name}.{kind.field(i).name}", pc.struct_field(values, [i]), depth + 1)
        elif pa.types.is_list(kind) and depth < _DEEPEST:
            # A shorter list has no last numbers.
            for i in range(min(pc.max(pc.list_value_length(values)).as_py() or 0, _LONGEST_LIST)):
                cut = pc.list_slice(values, i, i + 1, return_fixed_size_list=True)
                take(f"{name}[{i}]", pc.list_element(cut, 0), depth + 1)
        elif is_number(kind):
            sets.add(name, column_floats(values), {"units": kind.unit} if is_clock(kind) else {})
        elif isinstance(seconds := _dates(values.to_pylist()), np.ndarray):
            sets.add(name, seconds, {"units": "s"})
        else:
            sets.leave_out(name, "text")

    data = path.read_bytes()
    try:
        table = reader.read_json(pa.BufferReader(data))
    except pa.ArrowInvalid:
        # The last record may be cut off, if the logger lost its power.
        table = reader.read_json(pa.BufferReader(data[: data.rstrip().rfind(b"\n") + 1]))
    for name, values in zip(table.column_names, table.columns, strict=True):
        take(name, values, 0)
    return _content(sets)


def _dates(texts: list[Any]) -> np.ndarray | int | None:
    """Return the seconds of dates (N,), or what is no date."""
    first = next((x for x in texts if x is not None), None)
    return seconds_of_dates(texts) if isinstance(first, str) and is_date(first) else None


def _data_set(path: Path, sets: DataSets, item: Any, name: str) -> None:
    """Add the numbers of one data set."""
    size, kind = int(item.size or 0), item.dtype
    if item.is_virtual or item.external:
        problem = "is kept in another file, expected its numbers in this one"
        raise wrong(str(path), problem, f"data set {shown(str(item.name))}")
    if text_of(item.attrs.get("MATLAB_class", "")) == "char" or kind.kind in "SO":
        return
    if not holds_numbers(kind, item.ndim):
        sets.leave_out(name, f"{kind} of {item.ndim} dimensions")
    elif not text_of(item.attrs.get("NAME", "")).startswith(_NO_VARIABLE):
        # A chunked data set is unpacked one whole chunk at a time.
        sets.budget.require(int(np.prod(item.chunks or (0,), dtype=object)) * kind.itemsize)
        sets.budget.require(size * kind.itemsize)
        # Other attributes are not read: they may have types that h5py does not know.
        counting = (*PACKING, *UNIT_ATTRIBUTES)
        attributes = {n: item.attrs[n] for n in counting if n in item.attrs}
        for field, values, own in _fields(name, np.asarray(item[()]), attributes):
            sets.add(field, values, own)


def _fields(
    name: str, values: np.ndarray, attributes: Mapping[str, Any]
) -> Iterator[tuple[str, np.ndarray, Mapping[str, Any]]]:
    """Yield a data set, or the fields of its table as data sets, each with its own attributes."""
    names = values.dtype.names
    if names is None:
        yield name, values, attributes
        return
    # A table's attribute belongs to its fields only if it has one text for each.
    stated = next((attributes[n] for n in UNIT_ATTRIBUTES if n in attributes), ())
    units = list(np.ravel(stated)) if np.size(stated) == len(names) else [""] * len(names)
    for field, unit in zip(names, units, strict=True):
        yield from _fields(f"{name}/{field}", values[field], {"units": unit})
