"""Computation of a sweep's chunks in one process, here or on another computer."""

import functools
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import numpy as np

from heli_jax import naming
from heli_jax.analysis.margins import margins
from heli_jax.sweeps import reducers
from heli_jax.sweeps.design_point import DIVERGED, MEANINGS, OUT_OF_RANGE, ElementResults
from heli_jax.sweeps.program import Program, arguments, shapes
from heli_jax.sweeps.spec import Job, axis_unit
from heli_jax.vehicle import of_helicopter, possible

# Fewest blocks per device, unless it is alone: XLA generates different code for a single block, and
# the number of devices must not change any digit.
BLOCKS = 2

# Allowed names of a result, which is a folder of the store: no path, nothing hidden, and no name
# reserved by Zarr.
_NAME = re.compile(r"(?!\.|__)[^/\\\x00-\x1f]+")
# Names of dimensions, which xarray would confuse with the result, and of Zarr's own file.
_TAKEN = ("element", "flight", "time", "mode", "zarr.json")
# Attributes of the status by the CF conventions: xarray and others decode the words.
_FLAGS = {
    "flag_values": list(MEANINGS),
    "flag_meanings": " ".join(MEANINGS.values()),
    "long_name": "what became of the element",
}


class Variable(NamedTuple):
    """A variable of the store over the elements."""

    dims: tuple[str, ...]
    """Names of the dimensions, element first."""
    shape: tuple[int, ...]
    """Shape without the elements."""
    dtype: str
    attributes: dict[str, Any]
    axis: bool = False


class Split(NamedTuple):
    """Division of a sweep; the store keeps it, so that a resumed sweep uses the same batches."""

    chunk: int
    """Elements written at a time."""
    lanes: int
    """Batch size: elements computed in parallel on a device."""
    backend: str = "xla"
    """Backend of the simulation: "xla", or "fused", one program of machine code for a run."""

    def chunks(self, size: int) -> int:
        """Return the number of chunks of a sweep of `size` elements."""
        return -(-size // self.chunk)


def variables(job: Job) -> dict[str, Variable]:
    """Return the variables of the job's store, without the coordinates of other dimensions.

    Raises:
        ValueError: a result that is no number, or a name that a store cannot have.
    """
    laid_out: dict[str, Variable] = {}
    for name, column in job.design.values(0, 1).items():
        kind = "int64" if column.dtype.kind in "iu" else "float64"
        laid_out[name] = Variable(("element",), (), kind, _axis_words(job, name), True)
    laid_out["status"] = Variable(("element",), (), "uint8", dict(_FLAGS))
    flights = (("flight", len(job.flights)),) if len(job.flights) > 1 else ()
    for name, (dims, kind, words) in _result_variables(job):
        # A single flight makes no dimension of length one, which every plot would have to remove.
        dims = (*flights, *dims)
        _check_name(name, laid_out)
        laid_out[name] = Variable(
            ("element", *(d for d, _ in dims)), tuple(k for _, k in dims), kind, words
        )
    return laid_out


def _check_name(name: str, laid_out: Mapping[str, Variable]) -> None:
    """Refuse a name that is invalid or already used."""
    if not _NAME.fullmatch(name) or name in _TAKEN:
        raise ValueError(
            f"reduce: a result would be called {name!r}, expected another name: not "
            f"{', '.join(_TAKEN)}, no slash, no '.' or '__' at its beginning"
        )
    if name in laid_out:
        raise ValueError(f"reduce: two results or axes would be called {name!r}")


_Sized = tuple[tuple[tuple[str, int], ...], str, dict[str, Any]]
"""Dimensions with their lengths, beyond elements and flights; data type; attributes."""


def _result_variables(job: Job) -> Iterator[tuple[str, _Sized]]:
    """Yield the variables of results and trajectories of one flight, in the requested order."""
    # All flights have the same variables; different lengths of trajectories were refused before.
    shape, order = shapes(job, 0), list(job.reduce)
    # JAX sorts dictionaries by key, so the order of the results is restored.
    for name, result in sorted(shape.results.items(), key=lambda r: _place(r[0], order)):
        if result.shape:
            raise ValueError(
                f"reduce.{name}: the result has shape {result.shape}, expected one number"
            )
        yield name, ((), job.options.precision, _result_words(job, name))
    for name, reduce in job.reduce.items():
        if reduce.how == "modes":
            n = len(naming.names(job.model.State))
            # In two variables, because not every reader of Zarr and NetCDF supports complex
            # numbers.
            for part in ("real", "imag"):
                words = {"units": "1/s", "long_name": f"eigenvalues, {part} part, slowest first"}
                yield f"{name}_{part}", ((("mode", n),), "float64", words)
        elif reduce.how == "margins":
            yield from _margin_variables(name, f"{reduce.signal} to {reduce.input}")
    outputs = job.model.Outputs
    for name, kept in shape.trajectories.items():
        words = _words(naming.unit(outputs, name), naming.meaning(outputs, name))
        yield f"trajectory_{name}", ((("time", kept.shape[0]),), job.options.precision, words)


def _margin_variables(name: str, loop: str) -> Iterator[tuple[str, _Sized]]:
    yield f"{name}_gain", ((), "float64", _words("dB", f"gain margin, {loop}"))
    yield f"{name}_phase", ((), "float64", _words("deg", f"phase, {loop}"))
    words = {"long_name": f"true if the loop {loop} is stable", "flag_values": [0, 1]}
    yield f"{name}_stable", ((), "uint8", words | {"flag_meanings": "unstable stable"})


def _place(name: str, order: list[str]) -> int:
    """Return the position of a result: at its reducer, by equal name or by its prefix."""
    # A function with several numbers has results NAME_KEY.
    if name in order:
        return order.index(name)
    return next((i for i, n in enumerate(order) if name.startswith(f"{n}_")), len(order))


def _words(unit: str | None, meaning: str) -> dict[str, Any]:
    """Return attributes by the CF conventions, which xarray uses as plot labels."""
    words = {"units": unit} if unit is not None else {}
    return words | ({"long_name": meaning} if meaning else {})


def _axis_words(job: Job, name: str) -> dict[str, Any]:
    """Return unit and meaning of an axis, and a mark for logarithmic spacing."""
    kind, _, of = name.partition(".")
    if name in naming.names(job.model.Params):
        meaning = naming.meaning(job.model.Params, name)
    else:
        meaning = {
            "initial": f"{of} at the first sample",
            "offset": f"added to {of}",
            "gain": f"factor of {of}",
            "delay": "delay of the inputs",
            "seed": "seed of the disturbance",
        }[kind]
    words = _words(axis_unit(job.model, name), meaning)
    return words | ({"scale": "log"} if name in job.design.logarithmic else {})


def _result_words(job: Job, name: str) -> dict[str, Any]:
    """Return unit and meaning of a result, if known; a user's function has none."""
    reduce = job.reduce.get(name)
    stream = None if reduce is None else reducers.streaming(reduce)
    if reduce is None or not isinstance(reduce.how, str) or reduce.signal is None or stream is None:
        return {} if stream is None or stream.unit is None else {"units": stream.unit}
    unit = stream.unit
    if unit is None:
        unit = naming.unit(job.model.Outputs, reduce.signal)
    return _words(unit, f"{reduce.how} of {reduce.signal}")


class Pending(NamedTuple):
    """A chunk in computation."""

    start: int
    stop: int
    columns: dict[str, np.ndarray]
    """Values of the axes, (stop - start,)."""
    by_flight: tuple[Callable[[], ElementResults], ...]
    """Functions that return arrays of the padded chunk's size, which JAX may still be computing."""


class Worker:
    """Computes chunks of one job on some devices of this process."""

    def __init__(self, job: Job, split: Split, devices: Sequence[Any] | None = None) -> None:
        self.job, self.split = job, split
        devices = jax.local_devices() if devices is None else devices
        # Fewer if a chunk has less than BLOCKS blocks for each: the others would compute copies.
        used = max(1, min(len(devices), split.chunk // (BLOCKS * split.lanes)))
        self.devices = tuple(devices[:used])
        kind = Program
        if split.backend == "fused":
            # Here, because XLA alone needs no other compiler.
            from heli_jax.sweeps.fused_program import FusedProgram

            kind = FusedProgram
        self._programs = [kind(job, i, self.devices, split.lanes) for i in range(len(job.flights))]
        self._beside = ThreadPoolExecutor(1)

    def begin(self, chunk: int) -> Pending:
        """Start the computation of a chunk; `finish` waits for it."""
        # Axes stay in float64 for the store, in any precision of the sweep.
        start = chunk * self.split.chunk
        stop = min(start + self.split.chunk, self.job.design.size)
        columns = self.job.design.values(start, stop)
        values = arguments(self.job, columns)
        # In a parallel thread: JAX returns before it has computed, other programs do not.
        begun = [self._beside.submit(p, values, self.split.chunk) for p in self._programs]
        return Pending(start, stop, columns, tuple(f.result for f in begun))

    def finish(self, pending: Pending) -> dict[str, np.ndarray]:
        """Return the chunk's variables, arrays (stop - start, ...)."""
        count = pending.stop - pending.start
        # Without the padding of the last chunk.
        computed = [result() for result in pending.by_flight]
        by_flight = jax.tree.map(lambda v: np.asarray(v)[:count], computed)
        parts = [self._results(of_flight) for of_flight in by_flight]
        results = parts[0]
        if len(parts) > 1:
            results = {n: np.stack([p[n] for p in parts], axis=1) for n in results}
        impossible = self._impossible(pending.columns)
        status = _status(by_flight, pending.columns, impossible)
        # A diverged run or an impossible vehicle has no valid results.
        lost = impossible | (status == DIVERGED)
        # Modes and margins stay: they belong to the start of the run, and are NaN if that is.
        first = by_flight[0]
        names = (*first.results, *(f"trajectory_{n}" for n in first.trajectories))
        for name in names if lost.any() else ():
            results[name] = _blanked(results[name], lost)
        columns = {
            n: v if v.dtype.kind in "iu" else v.astype(np.float64)
            for n, v in pending.columns.items()
        }
        return {**columns, **results, "status": status}

    def run(self, chunk: int) -> dict[str, np.ndarray]:
        """Compute a chunk and return it."""
        return self.finish(self.begin(chunk))

    def _results(self, computed: ElementResults) -> dict[str, np.ndarray]:
        """Return the variables of one flight's results, (elements, ...)."""
        results = dict(computed.results)
        results |= {f"trajectory_{n}": v for n, v in computed.trajectories.items()}
        model = self.job.model
        for name, reduce in self.job.reduce.items():
            if reduce.how == "modes":
                values: Any = _eigenvalues(np.asarray(computed.matrices.A, np.float64))
                results[f"{name}_real"], results[f"{name}_imag"] = values.real, values.imag
            elif reduce.how == "margins":
                i = naming.names(model.Outputs).index(str(reduce.signal))
                j = naming.names(model.Inputs).index(str(reduce.input))
                A, B, C, D = (np.asarray(M, np.float64) for M in computed.matrices)
                loop = margins(A, B[:, :, j], C[:, i], D[:, i, j], reduce.gain)
                results[f"{name}_gain"], results[f"{name}_phase"] = loop.gain, loop.phase
                results[f"{name}_stable"] = loop.stable.astype(np.uint8)
        return results

    def _impossible(self, columns: dict[str, np.ndarray]) -> np.ndarray:
        """Return the elements whose parameters are impossible."""
        count = len(next(iter(columns.values())))
        # A user's model states which parameters must be positive; the limits of a helicopter are
        # known here.
        if not of_helicopter(self.job.model.Params):
            positive = [columns[n] for n in self.job.model.positive if n in columns]
            return np.any([~(v > 0) for v in positive], axis=0) | np.zeros(count, bool)
        swept = {n: columns[n] for n in columns if n in self.job.params}
        # The two ends of the paddle are checked together.
        both = {n: self.job.params[n] for n in ("R1", "R2") if swept.keys() & {"R1", "R2"}}
        return ~np.broadcast_to(possible({**both, **swept}), count)


def _status(
    by_flight: Sequence[ElementResults], columns: dict[str, np.ndarray], impossible: np.ndarray
) -> np.ndarray:
    """Return the status (elements,) of a chunk's elements over all flights."""
    status = functools.reduce(_worst, [computed.status for computed in by_flight])
    finite = functools.reduce(np.logical_and, [np.isfinite(v) for v in columns.values()])
    # An impossible vehicle is out of range even if its run diverged, because it is the cause. An
    # axis without a number has priority.
    status = np.where(impossible, OUT_OF_RANGE, status)
    return np.where(finite, status, DIVERGED).astype(np.uint8)


def _worst(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the worse status: diverged, then out of range, then ok."""
    # Explicitly, because diverged is the smaller number.
    both = (a == DIVERGED) | (b == DIVERGED)
    return np.where(both, DIVERGED, np.maximum(a, b)).astype(np.uint8)


def _blanked(values: np.ndarray, lost: np.ndarray) -> np.ndarray:
    """Return values (elements, ...) with NaN for some elements (elements,)."""
    lost = lost.reshape(-1, *(1,) * (values.ndim - 1))
    return np.where(lost, np.asarray(np.nan, values.dtype), values)


def _eigenvalues(A: np.ndarray) -> np.ndarray:
    """Return eigenvalues (k, n), slowest first, lower of a pair first; NaN unless A is finite."""
    # NumPy raises if one matrix has NaN, and then no element of the chunk would have eigenvalues.
    finite = np.all(np.isfinite(A), axis=(1, 2))
    values = np.linalg.eigvals(np.where(finite[:, None, None], A, 0.0)).astype(np.complex128)
    order = np.lexsort((values.imag, np.abs(values)), axis=1)
    return np.where(finite[:, None], np.take_along_axis(values, order, axis=1), np.nan)
