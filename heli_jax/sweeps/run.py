"""sweep: a design of many runs, computed chunk by chunk into a store."""

import math
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
import xarray as xr

from heli_jax import run_directory, stages
from heli_jax.dynamics.model import Model
from heli_jax.errors import InputError
from heli_jax.finding import Finding, as_data, note
from heli_jax.flights.flight import Flight
from heli_jax.stages import Note
from heli_jax.sweeps import store as stores
from heli_jax.sweeps.batching import split_for
from heli_jax.sweeps.design import Design, table
from heli_jax.sweeps.reducers import Reduce
from heli_jax.sweeps.spec import Job, RunOptions, unread
from heli_jax.sweeps.spec import job as checked
from heli_jax.sweeps.summary import write_summary
from heli_jax.sweeps.worker import Split, Worker
from heli_jax.versions import changed_since, versions

# `Any` below: Params of the user's own class, what may stand in JSON, and a dask Client, which is
# not imported where no worker is asked for.

_SAMPLED = 64  # elements on which float32 is compared with float64: enough to see its size


class Progress(NamedTuple):
    """Progress of a sweep."""

    done: int
    """elements finished, those of earlier runs too"""
    total: int
    rate: float
    """elements per second of this run; NaN while the first chunk is all there is, since that
    waited to be compiled"""
    remaining: float
    """[s]; NaN likewise"""


class Pace:
    """Counts what is done as steps of the stage under way, and calls `progress` with it."""

    def __init__(self, total: int, progress: Callable[[Progress], None]) -> None:
        self.total, self.progress = total, progress
        self.first: tuple[float, int] | None = None

    def __call__(self, done: int) -> None:
        """So many are done."""
        stages.reach(done)
        # The first waited for imports and the compiler: counted, it would make the time that is
        # left look ten times as long.
        now, rate = time.perf_counter(), math.nan
        if self.first is None:
            self.first = now, done
        else:
            rate = (done - self.first[1]) / max(now - self.first[0], 1e-9)
        self.progress(Progress(done, self.total, rate, (self.total - done) / rate))


class Options(NamedTuple):
    """Options of carrying out a sweep; none changes its numbers, but the division may change the
    last digit."""

    resume: bool = False
    chunk: int | None = None
    """elements written at a time; chosen unless given"""
    lanes: int | None = None
    """elements computed side by side on a device; chosen unless given"""
    backend: str = "auto"
    """what computes a run over time: "xla" step by step, "fused" as one program of machine code (on
    CPUs), or "auto", fused where it can be"""
    devices: Sequence[Any] | None = None
    """of this process: all unless given"""
    client: Any = None
    """a dask.distributed Client whose workers compute the chunks"""
    progress: Callable[[Progress], None] = lambda _: None
    say: Callable[[str], None] = lambda _: None


def sweep(
    model: Model,
    params: Any,
    flights: Flight | Sequence[Flight],
    design: Design,
    reduce: Mapping[str, Reduce],
    *,
    out: str | Path | None = None,
    **options: Any,
) -> xr.Dataset:
    """Run a model once for every element of a design, and keep numbers of each run.

    Args:
        model: what is simulated.
        params: the model's Params, SI; the axes of the design take the place of theirs.
        flights: what the model flies: inputs, and where results compare with them, outputs. With
            several each result has a dimension `flight`.
        design: which values the axes take, from `heli_jax.sweeps`: grid, paired, lhs, sobol, table,
            product or zipped. An axis is a parameter of the model, or `initial.STATE`,
            `gain.INPUT`, `offset.INPUT`, `delay` [s] or `seed` (of the model's noise).
        reduce: by name, what is kept of each run.
        out: a directory for sweep.zarr and summary.json; in memory unless given.
        **options: fields of `RunOptions`: solver, substeps, precision, trajectories, trimmed,
            pilot; and of `Options`: resume, chunk, lanes, backend, devices, client,
            progress.

    Returns:
        A Dataset over `element`, with axes and `status` as coordinates.

    Raises:
        ValueError: the model cannot have an axis or a result.
        TypeError: a keyword that is no option.
        InputError: the directory exists (without `resume`), is of another sweep, or cannot be
            written to.
    """
    runs = {n: options.pop(n) for n in RunOptions._fields if n in options}
    job = checked(model, params, flights, design, reduce, RunOptions(**runs))
    return run_sweep(job, None if out is None else Path(out), Options(**options))


def run_sweep(
    job: Job,
    out: Path | None,
    options: Options,
    *,
    files: Mapping[str, str] | None = None,
    attributes: Mapping[str, Any] | None = None,
    notes: Sequence[Finding] = (),
) -> xr.Dataset:
    """Run a checked sweep.

    Args:
        job: what is computed.
        out: a directory for the store, or None for one in memory.
        options: how it is carried out.
        files: by name, texts that are written beside the store when it is made.
        attributes: kept with the store; `seed` is 0 unless given.
        notes: said and kept.

    Raises:
        InputError: as `sweep`.
    """
    # The notes are kept too: who opens the store a year later has not seen what was printed.
    notes = [*notes, *_notes(job)]
    for found in notes:
        options.say(Note(found.sentence))
    kept = {"seed": 0, **(attributes or {}), "versions": versions()}
    kept["notes"] = [as_data(f) for f in notes]
    if out is None:
        # The same store as on disk, so that a sweep in memory goes through the same code.
        store = stores.create(None, job, *_cut(job, options, kept), "the sweep")
        _compute(job, store, store.done(), options)
        return store.dataset().load()
    if run_directory.is_new(out, options.resume):
        cut = _cut(job, options, kept)
        with run_directory.whole(out) as directory:
            for name, text in (files or {}).items():
                (directory / name).write_text(text, encoding="utf-8")
            stores.create(directory / "sweep.zarr", job, *cut, f"--out {out}")
    run_directory.require_writable(out)
    return _resume(job, out, options)


def _notes(job: Job) -> list[Finding]:
    """Return notes on settings without effect, or with an unexpected one."""
    name = job.model.name
    without_effect = [
        note(
            "sweep.axis-without-effect",
            f"axes.{n}: {name} does not read {n}: no run depends on it",
            n,
        )
        for n in unread(job)
    ]
    words = "the margins are those of the loop without the delay"
    delayed = [
        note("sweep.margins-without-delay", f"reduce.{n}: {words}", n)
        for n, r in job.reduce.items()
        if r.how == "margins" and ("delay" in job.design.names or job.model.delays)
    ]
    return [*without_effect, *delayed]


def _resume(job: Job, out: Path, options: Options) -> xr.Dataset:
    """Compute what is missing in a store on disk, and write its summary."""
    where = f"--out {out}"
    stores.require_files(out, where)
    with stores.only_writer(out, where):
        # A new store too is read as if it were an old one: it may have been made by a process that
        # was killed, or by one that came first.
        store = stores.reopen(out / "sweep.zarr", job, where)
        # With the lock held, so that no other process finishes a chunk between this question and
        # the answer.
        done = store.whole()
        if damaged := int(np.count_nonzero(store.done() & ~done)):
            options.say(Note(f"{where}: damaged chunks that are computed again: {damaged}"))
        _same_cut(store, job, options, where)
        # Said and not refused: to begin anew for a digit in the fifteenth place helps nobody.
        if changed := changed_since(store.attributes.get("versions", {})):
            options.say(Note(f"{where}: {changed}"))
        timing = _compute(job, store, done, options)
        dataset = store.dataset()
        with stores.readable(where):
            write_summary(out / "summary.json", dataset, job, timing, where)
    return dataset


def _cut(job: Job, options: Options, words: dict[str, Any]) -> tuple[Split, dict[str, Any]]:
    """Return the division of the sweep and the attributes of its store."""
    for name in ("chunk", "lanes"):
        number = getattr(options, name)
        if number is not None and number < 1:
            raise ValueError(f"{name} must be at least 1, got {number}")
    # More lanes than elements would fill the memory with copies of the last one.
    lanes = None if options.lanes is None else min(options.lanes, job.design.size)
    asked = {"chunk": options.chunk, "lanes": lanes, "backend": options.backend}
    if options.client is not None:
        from heli_jax.sweeps.cluster import split_there

        split = split_there(options.client, job, **asked)
    else:
        split = split_for(job, devices=options.devices, say=options.say, **asked)
    # Once, when the store is made: a resumed sweep shall not tell another error than the one that
    # it began with.
    if job.precision == "float32":
        words = {**words, "float32_error": float32_error(job)}
    return split, words


def _same_cut(store: stores.Store, job: Job, options: Options, where: str) -> None:
    """Refuse numbers other than those a store was begun with: its last digits depend on them."""
    for name in ("chunk", "lanes"):
        number, kept = getattr(options, name), getattr(store.split, name)
        # More than there are elements were cut down as the store was begun.
        if number not in (None, kept) and not number > kept >= job.design.size:
            raise InputError(
                f"{where}: was begun with {name} {kept}, expected the same, got {number}"
            )
    if options.backend not in ("auto", store.split.backend):
        raise InputError(
            f"{where}: was begun with backend {store.split.backend}, expected the same or auto, "
            f"got {options.backend}"
        )


def _compute(job: Job, store: stores.Store, done: np.ndarray, options: Options) -> dict[str, Any]:
    """Compute the chunks that are not done; returns what it took."""
    # Workers may give them in any order: what counts is each chunk's own status in the store.
    todo = [int(k) for k in np.flatnonzero(~done)]
    total, size = job.design.size, store.split.chunk
    before = sum(min(size, total - int(k) * size) for k in np.flatnonzero(done))
    begin, now, pace = time.perf_counter(), before, Pace(total, options.progress)
    if options.client is not None:
        # Here, since dask is an extra that is not installed everywhere.
        from heli_jax.sweeps.cluster import computed

        source: Iterable[Any] = computed(options.client, job, store.split, todo)
    else:
        source = _local(job, store.split, todo, options.devices)
    with stages.stage("sweep", total=total):
        for chunk, results in source:
            store.write(chunk, results)
            now += len(results["status"])
            pace(now)
    seconds = time.perf_counter() - begin
    return {
        "chunks": store.split.chunks(total),
        "computed_chunks": len(todo),
        "computed_elements": now - before,
        "seconds": seconds,
        "elements_per_s": (now - before) / seconds if now > before else None,
    }


def _local(
    job: Job, split: Split, todo: list[int], devices: Sequence[Any] | None
) -> Iterable[tuple[int, dict[str, np.ndarray]]]:
    """Chunks computed here; while one is written the devices work on the next."""
    if not todo:
        return
    worker = Worker(job, split, devices)
    # JAX returns before it has computed: one chunk ahead is enough to keep the devices busy, and
    # more would only take memory.
    begun = worker.begin(todo[0])
    for chunk, following in zip(todo, [*todo[1:], None], strict=True):
        pending = begun
        if following is not None:
            begun = worker.begin(following)
        yield chunk, worker.finish(pending)


def float32_error(job: Job) -> dict[str, float | str]:
    """Return the error of float32 against float64, relative to the largest of each result, on
    elements from all over the design."""
    if not jax.config.jax_enable_x64:  # pyright: ignore[reportAttributeAccessIssue]
        return {"note": "not measured: float64 is switched off in JAX"}
    n = job.design.size
    chosen = np.unique(np.linspace(0, n - 1, min(n, _SAMPLED)).astype(int))
    columns = [job.design.values(int(k), int(k) + 1) for k in chosen]
    some = table({name: np.concatenate([c[name] for c in columns]) for name in columns[0]})
    split = Split(len(chosen), len(chosen))
    # One device: for 64 elements the others would be compiled for in vain.
    devices = jax.local_devices()[:1]
    single = Worker(job._replace(design=some), split, devices).run(0)
    double = Worker(job._replace(design=some, precision="float64"), split, devices).run(0)
    errors: dict[str, float | str] = {}
    for name, exact in double.items():
        if name in some.names or exact.dtype.kind != "f":
            continue
        off = np.abs(single[name] - exact)
        off, size = off[np.isfinite(off)], np.abs(exact[np.isfinite(exact)])
        # Of the largest and not of each value: one that is zero but for rounding has no digits.
        largest = size.max(initial=0.0)
        errors[name] = float(off.max(initial=0.0) / largest) if largest > 0 else 0.0
    return errors
