"""Zarr store of a sweep: labelled variables over the elements, written chunk by chunk.

The status of a chunk is written last, so a chunk with a status is complete. Zarr replaces files in
one step, so a killed process leaves each file either old or new.
"""

import contextlib
import errno
import json
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import filelock
import numpy as np
import xarray as xr
import zarr
from zarr.codecs import ZstdCodec
from zarr.storage import MemoryStore

from heli_jax.errors import InputError
from heli_jax.regular_file import require_regular
from heli_jax.sweeps.description import described, require_same
from heli_jax.sweeps.design_point import NOT_RUN
from heli_jax.sweeps.spec import Job
from heli_jax.sweeps.worker import Split, Variable, variables

# Fill values of missing data: NaN, and for the status (unsigned) 'not run', which marks an
# unfinished chunk. Seeds (signed) are written before the status and need no mark.
_FILL = {"f": np.nan, "u": NOT_RUN, "i": 0}


class Store:
    """Results of a sweep, in a directory or in memory."""

    def __init__(self, group: zarr.Group, where: str) -> None:
        self.group, self.where = group, where
        attributes: dict[str, Any] = dict(group.attrs)
        # The store's division, not today's choice: another one would change the last digits.
        self.split = Split(**attributes["split"])
        self.attributes = attributes
        self._results: list[str] = list(attributes["results"])
        # An all-NaN chunk is a result too: its file distinguishes it from a removed one.
        with zarr.config.set({"array.write_empty_chunks": True}):
            # Looked up once, because it takes as long as a write.
            self._arrays: dict[str, Any] = dict(group.arrays())

    @property
    def names(self) -> set[str]:
        """Names of the variables."""
        return set(self._arrays)

    def done(self) -> np.ndarray:
        """Return a mask of finished chunks, (number of chunks,)."""
        # The first element of each is enough: the status of a chunk is one file, which is complete
        # or absent.
        return np.asarray(self._arrays["status"][:: self.split.chunk]) != NOT_RUN

    def whole(self) -> np.ndarray:
        """Return finished chunks as `done`, except those with unreadable files.

        Raises:
            InputError: a file is missing, or the store cannot be read.
        """
        with readable(self.where):
            done = self.done()
            finished = int(np.count_nonzero(done))
            # Zarr reads a missing file as its fill value: NaN that was never computed.
            for name in self._results:
                there = self._arrays[name].nchunks_initialized
                if there < finished:
                    raise InputError(
                        f"{self.where}: {name} has {there} of {finished} finished chunks, "
                        "expected a complete store, or another --out"
                    )
        for chunk in np.flatnonzero(done):
            which = slice(chunk * self.split.chunk, (chunk + 1) * self.split.chunk)
            try:
                for array in self._arrays.values():
                    if array.ndim and array.shape[0] == self._arrays["status"].shape[0]:
                        array[which]
            except (OSError, RuntimeError, ValueError):
                done[chunk] = False
        return done

    def write(self, chunk: int, results: Mapping[str, np.ndarray]) -> None:
        """Write a chunk's variables, its status last.

        Raises:
            InputError: the place cannot be written to.
        """
        start = chunk * self.split.chunk
        stop = start + len(results["status"])
        with _words(self.where):
            for name, values in results.items():
                if name != "status":
                    self._arrays[name][start:stop] = values
            # Last, because it marks the chunk as complete. A kill before it loses only this chunk.
            self._arrays["status"][start:stop] = results["status"]

    def dataset(self) -> xr.Dataset:
        """Return the store as an xarray Dataset, read on demand."""
        # chunks=None: dask arrays would require dask.
        dataset = xr.open_zarr(self.group.store, consolidated=False, chunks=None)
        # In the requested order; files in a directory have none.
        return dataset[self.attributes["results"]]


@contextlib.contextmanager
def readable(where: str) -> Iterator[None]:
    """Report Zarr's error on a damaged file as a sentence."""
    try:
        yield
    except InputError:
        raise
    except (OSError, RuntimeError, ValueError) as e:
        raise InputError(
            f"{where}: a file of sweep.zarr cannot be read ({e}), expected an undamaged store, or "
            "another --out"
        ) from e


@contextlib.contextmanager
def _words(where: str) -> Iterator[None]:
    """Report the system's error on a file that cannot be written as a sentence."""
    try:
        yield
    except OSError as e:
        # No space, no quota, or a file too large for the file system: these have a remedy.
        full = e.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
        hint = ", expected space for the rest" if full else ""
        raise InputError(
            f"{where}: cannot be written ({e.strerror or e}){hint}; finished elements are kept"
        ) from e


def create(
    path: Path | None, job: Job, split: Split, attributes: Mapping[str, Any], where: str
) -> Store:
    """Create a new store without elements.

    Args:
        path: path of the store; None for one in memory.
        attributes: attributes of the store.
        where: place for messages.

    Raises:
        OSError: the place cannot be written to.
    """
    store: Any = MemoryStore() if path is None else str(path)
    group = zarr.create_group(store, zarr_format=3)
    laid_out = variables(job)
    size = job.design.size
    for name, variable in laid_out.items():
        _array(group, name, variable, size, split)
    dims = {d for variable in laid_out.values() for d in variable.dims}
    if "flight" in dims:
        _labels(group, "flight", np.asarray([_label(job, i) for i in range(len(job.flights))]))
    if "time" in dims and job.options.trajectories is not None:
        flight, every = job.flights[0], job.options.trajectories.every
        times = flight.times[::every]
        _labels(group, "time", times, {"units": "s", "long_name": "from the first sample"})
    group.attrs.update(
        {
            **attributes,
            "title": f"sweep of {job.model.name}",
            "axes": list(job.design.names),
            "results": [n for n, v in laid_out.items() if not v.axis and n != "status"],
            "split": split._asdict(),
            "description": json.dumps(described(job), sort_keys=True),
            # xarray makes these names coordinates.
            "coordinates": " ".join([*job.design.names, "status"]),
        }
    )
    return Store(group, where)


def _label(job: Job, i: int) -> str:
    """Return the flight's name, with its number if another has the same."""
    # A label must be unique, because xarray's sel() would return both.
    name = job.flights[i].name
    if not name:
        return f"flight {i + 1}"
    alone = sum(f.name == name for f in job.flights) == 1
    return name if alone else f"{name} ({i + 1})"


def _array(group: zarr.Group, name: str, variable: Variable, size: int, split: Split) -> None:
    dtype = np.dtype(variable.dtype)
    group.create_array(
        name,
        shape=(size, *variable.shape),
        # Zarr's chunks are those of the sweep, so that a chunk is written without reading others.
        chunks=(split.chunk, *variable.shape),
        dtype=dtype,
        # A checksum detects later damage of a file.
        compressors=[ZstdCodec(level=0, checksum=True)],
        fill_value=_FILL[dtype.kind],
        dimension_names=variable.dims,
        attributes=variable.attributes,
    )


def _labels(
    group: zarr.Group, name: str, values: np.ndarray, attributes: dict[str, Any] | None = None
) -> None:
    labels = group.create_array(
        name,
        shape=values.shape,
        dtype=values.dtype if values.dtype.kind != "U" else str,
        dimension_names=(name,),
        attributes=attributes or {},
    )
    labels[:] = values


def reopen(path: Path, job: Job, where: str) -> Store:
    """Open the store of the same sweep, to continue it.

    Raises:
        InputError: it is no store of a sweep, or one of another sweep.
    """
    try:
        store = Store(zarr.open_group(str(path), mode="r+"), where)
        old = json.loads(store.attributes["description"])
    except (OSError, KeyError, ValueError, TypeError) as e:
        raise InputError(f"{where}: {path} is not a store of a sweep ({e})") from e
    require_same(old, described(job), f"{where}: {path} belongs to another sweep")
    # A variable's folder may have been removed since the store was made.
    missing = sorted(variables(job).keys() - store.names)
    if missing:
        raise InputError(
            f"{where}: {path} is not a complete store of a sweep: {missing[0]} is missing"
        )
    return store


# [bytes] of a file in a store; Zarr reads each as a whole.
_LARGEST_METADATA = 10**8
_LARGEST_CHUNK = 4 * 10**9


def require_files(directory: Path, where: str) -> None:
    """Refuse a sweep's directory that contains irregular files.

    Zarr would wait for a pipe, and read a device or a sparse file until the memory is full.

    Raises:
        InputError: naming the file.
    """
    # Before the lock is taken: opening a pipe in its place would block forever.
    others = (directory / ".lock", directory / "summary.json")
    for path in others:
        if os.path.lexists(path):
            _require_file(path, _LARGEST_METADATA, where)
    folders = [directory / "sweep.zarr"]
    while folders:
        folder = folders.pop()
        try:
            entries = list(os.scandir(folder))
        except OSError as e:
            raise InputError(f"{where}: {folder} is not a store of a sweep ({e.strerror})") from e
        for entry in entries:
            # Links to folders are not followed, because one may lead back here.
            if entry.is_dir(follow_symlinks=False):
                folders.append(Path(entry.path))
                continue
            metadata = entry.name == "zarr.json"
            _require_file(entry.path, _LARGEST_METADATA if metadata else _LARGEST_CHUNK, where)


def _require_file(path: str | Path, at_most: int, where: str) -> None:
    try:
        require_regular(path, "a regular file of a sweep", at_most)
    except InputError as e:
        raise InputError(f"{where}: {e}") from e


@contextlib.contextmanager
def only_writer(directory: Path, where: str) -> Iterator[None]:
    """Hold the directory's lock; the system releases it when the process ends in any way.

    Raises:
        InputError: another process holds it, or the directory cannot be written to.
    """
    # Refused at once: the other process may run for hours.
    lock = filelock.FileLock(directory / ".lock", timeout=0)
    with _words(where):
        try:
            lock.acquire()
        except filelock.Timeout:
            raise InputError(
                f"{where}: another process is writing to it, expected only one"
            ) from None
    try:
        yield
    finally:
        lock.release()
