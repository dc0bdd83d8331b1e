"""Chunks of a sweep, computed: what one process does, here or on another machine."""

import functools
import re
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from heli_jax import naming
from heli_jax.analysis.margins import margins
from heli_jax.sweeps import reducers
from heli_jax.sweeps.design import log_axes
from heli_jax.sweeps.program import (
    DIVERGED,
    MEANINGS,
    OUT_OF_RANGE,
    Found,
    Program,
    arguments,
    shapes,
)
from heli_jax.sweeps.spec import Job, axis_unit
from heli_jax.vehicle import of_helicopter, possible

BLOCKS = 2
"""Blocks that a device has at least, unless it is alone: XLA writes other code for one block than
for several, and how many devices there are shall change no digit."""


_NAME = re.compile(r"(?!\.|__)[^/\\\x00-\x1f]+")
"""of a result: it is a folder of the store"""
_TAKEN = ("element", "flight", "time", "mode", "zarr.json")


class Variable(NamedTuple):
    """A variable of the store over the elements."""

    dims: tuple[str, ...]
    """of which the first is element"""
    shape: tuple[int, ...]
    """without the elements"""
    dtype: str
    attributes: dict[str, Any]
    axis: bool = False


class Split(NamedTuple):
    """How a sweep is cut: part of what the store remembers, so that a resumed sweep computes each
    element in the same company."""

    chunk: int
    """elements written at a time"""
    lanes: int
    """elements computed side by side on a device"""

    def chunks(self, size: int) -> int:
        """How many chunks a sweep of so many elements has."""
        return -(-size // self.chunk)


def variables(job: Job) -> dict[str, Variable]:
    """The variables of the job's store, without the coordinates of their other dimensions."""
    found: dict[str, Variable] = {}
    for name, column in job.design.values(0, 1).items():
        kind = "int64" if column.dtype.kind in "iu" else "float64"
        found[name] = Variable(("element",), (), kind, _axis_words(job, name), True)
    flags = {
        "flag_values": list(MEANINGS),
        "flag_meanings": " ".join(MEANINGS.values()),
        "long_name": "what became of the element",
    }
    found["status"] = Variable(("element",), (), "uint8", flags)
    shape, several = shapes(job, 0), len(job.flights) > 1
    more = (("flight", len(job.flights)),) if several else ()

    def add(name: str, dims: tuple[tuple[str, int], ...], kind: str, words: dict[str, Any]) -> None:
        dims = (*more, *dims)
        if not _NAME.fullmatch(name) or name in _TAKEN:
            raise ValueError(
                f"reduce: a result would be called {name!r}, wanted is another name: not "
                f"{', '.join(_TAKEN)}, no slash, no '.' or '__' at its beginning"
            )
        if name in found:
            raise ValueError(f"reduce: two results or axes would be called {name!r}")
        found[name] = Variable(
            ("element", *(d for d, _ in dims)), tuple(k for _, k in dims), kind, words
        )

    order = list(job.reduce)
    for name, one in sorted(shape.results.items(), key=lambda r: _place(r[0], order)):
        if one.shape:
            raise ValueError(
                f"reduce.{name}: the result has shape {one.shape}, wanted is one number"
            )
        add(name, (), job.precision, _result_words(job, name))
    for name in job.reduce:
        if job.reduce[name].how == "modes":
            n = len(naming.names(job.model.State))
            for part in ("real", "imag"):
                words = {"units": "1/s", "long_name": f"eigenvalues, {part} part, slowest first"}
                add(f"{name}_{part}", (("mode", n),), "float64", words)
        elif job.reduce[name].how == "margins":
            of = f"{job.reduce[name].signal} to {job.reduce[name].input}"
            add(f"{name}_gain", (), "float64", {"units": "dB", "long_name": f"gain margin, {of}"})
            add(f"{name}_phase", (), "float64", {"units": "deg", "long_name": f"phase, {of}"})
            words = {"long_name": f"whether the loop {of} is stable", "flag_values": [0, 1]}
            add(f"{name}_stable", (), "uint8", words | {"flag_meanings": "unstable stable"})
    for name, one in shape.trajectories.items():
        words = _words(
            naming.unit(job.model.Outputs, name), naming.meaning(job.model.Outputs, name)
        )
        add(f"trajectory_{name}", (("time", one.shape[0]),), job.precision, words)
    return found


def _place(name: str, order: list[str]) -> int:
    """Where a result stands: with the reducer that it is of, named alike or before a key."""
    if name in order:
        return order.index(name)
    return next((i for i, n in enumerate(order) if name.startswith(f"{n}_")), len(order))


def _words(unit: str | None, meaning: str) -> dict[str, Any]:
    words = {"units": unit} if unit is not None else {}
    return words | ({"long_name": meaning} if meaning else {})


def _axis_words(job: Job, name: str) -> dict[str, Any]:
    kind, _, of = name.partition(".")
    if name in naming.names(job.model.Params):
        meaning = naming.meaning(job.model.Params, name)
    else:
        meaning = {
            "initial": f"{of} at the first sample",
            "offset": f"added to {of}",
            "gain": f"factor of {of}",
            "delay": "the inputs act this much later",
            "seed": "seed of the disturbance",
        }[kind]
    words = _words(axis_unit(job.model, name), meaning)
    return words | ({"scale": "log"} if name in log_axes(job.design) else {})


def _result_words(job: Job, name: str) -> dict[str, Any]:
    one = job.reduce.get(name)
    stream = None if one is None else reducers.streaming(one)
    if one is None or not isinstance(one.how, str) or one.signal is None or stream is None:
        return {} if stream is None or stream.unit is None else {"units": stream.unit}
    unit = stream.unit
    if unit is None:
        unit = naming.unit(job.model.Outputs, one.signal)
    return _words(unit, f"{one.how} of {one.signal}")


class Pending(NamedTuple):
    """A chunk that devices compute."""

    start: int
    stop: int
    columns: dict[str, np.ndarray]
    found: tuple[Found, ...]


class Worker:
    """Computes chunks of one job on some devices of this process."""

    def __init__(self, job: Job, split: Split, devices: Sequence[Any] | None = None) -> None:
        self.job, self.split = job, split
        devices = jax.local_devices() if devices is None else devices
        used = max(1, min(len(devices), split.chunk // (BLOCKS * split.lanes)))
        self.devices = tuple(devices[:used])
        self._programs = [
            Program(job, i, self.devices, split.lanes) for i in range(len(job.flights))
        ]

    def begin(self, chunk: int) -> Pending:
        """Set the devices to work on a chunk; `finish` waits for it."""
        start = chunk * self.split.chunk
        stop = min(start + self.split.chunk, self.job.design.size)
        columns = self.job.design.values(start, stop)
        values = arguments(self.job, columns)
        return Pending(
            start, stop, columns, tuple(p(values, self.split.chunk) for p in self._programs)
        )

    def finish(self, pending: Pending) -> dict[str, np.ndarray]:
        """The chunk's variables, arrays (stop - start, ...)."""
        count = pending.stop - pending.start
        found = jax.tree.map(lambda v: np.asarray(v)[:count], pending.found)
        parts = [self._results(one) for one in found]
        results = parts[0]
        if len(parts) > 1:
            results = {n: np.stack([p[n] for p in parts], axis=1) for n in results}
        status = functools.reduce(_worst, [one.status for one in found])
        impossible = self._impossible(pending.columns)
        finite = [np.isfinite(v) for v in pending.columns.values()]
        status = np.where(impossible, OUT_OF_RANGE, status)
        status = np.where(functools.reduce(np.logical_and, finite), status, DIVERGED)
        # What a run that diverged or a vehicle that cannot be left behind is no result.
        lost = impossible | (status == DIVERGED)
        names = (*found[0].results, *(f"trajectory_{n}" for n in found[0].trajectories))
        for name in names if lost.any() else ():
            results[name] = _blanked(results[name], lost)
        columns = {
            n: v if v.dtype.kind in "iu" else v.astype(np.float64)
            for n, v in pending.columns.items()
        }
        return {**columns, **results, "status": status.astype(np.uint8)}

    def run(self, chunk: int) -> dict[str, np.ndarray]:
        """A chunk from beginning to end."""
        return self.finish(self.begin(chunk))

    def _results(self, found: Found) -> dict[str, np.ndarray]:
        results = dict(found.results)
        results |= {f"trajectory_{n}": v for n, v in found.trajectories.items()}
        model = self.job.model
        for name, one in self.job.reduce.items():
            if one.how == "modes":
                values: Any = _eigenvalues(np.asarray(found.matrices.A, np.float64))
                results[f"{name}_real"], results[f"{name}_imag"] = values.real, values.imag
            elif one.how == "margins":
                i = naming.names(model.Outputs).index(str(one.signal))
                j = naming.names(model.Inputs).index(str(one.input))
                A, B, C, D = (np.asarray(M, np.float64) for M in found.matrices)
                loop = margins(A, B[:, :, j], C[:, i], D[:, i, j], one.gain)
                results[f"{name}_gain"], results[f"{name}_phase"] = loop.gain, loop.phase
                results[f"{name}_stable"] = loop.stable.astype(np.uint8)
        return results

    def _impossible(self, columns: dict[str, np.ndarray]) -> np.ndarray:
        """Which elements are no machine that can be, by their parameters alone."""
        count = len(next(iter(columns.values())))
        if not of_helicopter(self.job.model.Params):
            positive = [columns[n] for n in self.job.model.positive if n in columns]
            return np.any([~(v > 0) for v in positive], axis=0) | np.zeros(count, bool)
        swept = {n: columns[n] for n in columns if n in self.job.params}
        # The ends of the paddle are judged together.
        both = {n: self.job.params[n] for n in ("R1", "R2") if swept.keys() & {"R1", "R2"}}
        return ~np.broadcast_to(possible({**both, **swept}), count)


def _worst(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Diverged before out of range before ok."""
    both = (a == DIVERGED) | (b == DIVERGED)
    return np.where(both, DIVERGED, np.maximum(a, b)).astype(np.uint8)


def _blanked(values: np.ndarray, lost: np.ndarray) -> np.ndarray:
    lost = lost.reshape(-1, *(1,) * (values.ndim - 1))
    return np.where(lost, np.asarray(np.nan, values.dtype), values)


def _eigenvalues(A: np.ndarray) -> np.ndarray:
    """(k, n), slowest first, the lower one of a pair first; NaN where A is not finite."""
    finite = np.all(np.isfinite(A), axis=(1, 2))
    values = np.linalg.eigvals(np.where(finite[:, None, None], A, 0.0)).astype(np.complex128)
    order = np.lexsort((values.imag, np.abs(values)), axis=1)
    return np.where(finite[:, None], np.take_along_axis(values, order, axis=1), np.nan)
