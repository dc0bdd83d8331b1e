"""sweep: a design of many runs, computed chunk by chunk into a store."""

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

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
from heli_jax.sweeps.design import Design
from heli_jax.sweeps.reducers import Reduce
from heli_jax.sweeps.spec import Job, RunOptions, unread
from heli_jax.sweeps.spec import job as checked
from heli_jax.sweeps.summary import write_summary
from heli_jax.sweeps.worker import Split, Worker
from heli_jax.versions import changed_since, versions

# `Any` below: Params of the user's own class, JSON content, and a dask Client, which is imported
# only if workers are used.


class Options(NamedTuple):
    """Options for the execution of a sweep; only the division may change the last digit."""

    resume: bool = False
    chunk: int | None = None
    """Elements written at a time; chosen automatically by default."""
    lanes: int | None = None
    """Batch size: elements computed in parallel on a device; chosen automatically by default."""
    backend: str = "auto"
    """Backend of the simulation: "xla" step by step, "fused" as one program of machine code (on
    CPUs), or "auto", fused if possible."""
    devices: Sequence[Any] | None = None
    """Devices of this process; all by default."""
    client: Any = None
    """A dask.distributed Client whose workers compute the chunks."""
    progress: Callable[[int, int], None] = lambda done, total: None
    """Called with the finished elements, those of earlier runs included, and their total."""
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
        params: the model's Params, SI; the axes of the design override them.
        flights: inputs of the runs, and outputs for results that compare with them. With several
            flights each result has a dimension `flight`.
        design: values of the axes, from `heli_jax.sweeps`: grid, paired, lhs, sobol, table, product
            or zipped. An axis is a parameter of the model, or `initial.STATE`, `gain.INPUT`,
            `offset.INPUT`, `delay` [s] or `seed` (of the model's noise).
        reduce: results of each run by name.
        out: a directory for sweep.zarr and summary.json; in memory by default.
        **options: fields of `RunOptions`: solver, substeps, precision, trajectories, trimmed,
            pilot; and of `Options`: resume, chunk, lanes, backend, devices, client, progress.

    Returns:
        A Dataset over `element`, with axes and `status` as coordinates.

    Raises:
        ValueError: the model cannot have an axis or a result.
        TypeError: a keyword that is no option.
        InputError: the directory exists (without `resume`), belongs to another sweep, or cannot be
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
        out: a directory for the store, or None for one in memory.
        files: texts by name, written beside the store when it is made.
        attributes: attributes of the store; `seed` is 0 by default.
        notes: notes to report and to store.

    Raises:
        InputError: as `sweep`.
    """
    # The notes are stored too, for later readers who did not see the output.
    notes = [*notes, *_notes(job)]
    for found in notes:
        options.say(Note(found.sentence))
    kept = {"seed": 0, **(attributes or {}), "versions": versions()}
    kept["notes"] = [as_data(f) for f in notes]
    if out is None:
        # The same store as on disk, so that a sweep in memory uses the same code.
        store = stores.create(None, job, _cut(job, options), kept, "the sweep")
        _compute(job, store, store.done(), options)
        return store.dataset().load()
    if run_directory.is_new(out, options.resume):
        split = _cut(job, options)
        with run_directory.whole(out) as directory:
            for name, text in (files or {}).items():
                (directory / name).write_text(text, encoding="utf-8")
            stores.create(directory / "sweep.zarr", job, split, kept, f"--out {out}")
    run_directory.require_writable(out)
    return _resume(job, out, options)


def _notes(job: Job) -> list[Finding]:
    """Return notes on settings without effect, or with an unexpected one."""
    name = job.model.name
    without_effect = [
        note(
            "sweep.axis-without-effect",
            f"axes.{n}: {name} does not use {n}: it changes no run",
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
    """Compute the missing chunks of a store on disk, and write its summary."""
    where = f"--out {out}"
    stores.require_files(out, where)
    with stores.only_writer(out, where):
        # A new store is opened like an old one, because it may come from a killed process or from a
        # concurrent one.
        store = stores.reopen(out / "sweep.zarr", job, where)
        # With the lock held, so that no other process finishes a chunk between check and use.
        done = store.whole()
        if damaged := int(np.count_nonzero(store.done() & ~done)):
            options.say(Note(f"{where}: damaged chunks are computed again: {damaged}"))
        _same_cut(store, job, options, where)
        # Reported, not refused: a difference in the fifteenth digit does not justify a new start.
        if changed := changed_since(store.attributes.get("versions", {})):
            options.say(Note(f"{where}: {changed}"))
        timing = _compute(job, store, done, options)
        dataset = store.dataset()
        with stores.readable(where):
            write_summary(out / "summary.json", dataset, job, timing, where)
    return dataset


def _cut(job: Job, options: Options) -> Split:
    """Return the division of the sweep."""
    for name in ("chunk", "lanes"):
        number = getattr(options, name)
        if number is not None and number < 1:
            raise ValueError(f"{name} must be at least 1, got {number}")
    # More lanes than elements would fill the memory with copies of the last one.
    lanes = None if options.lanes is None else min(options.lanes, job.design.size)
    requested = {"chunk": options.chunk, "lanes": lanes, "backend": options.backend}
    if options.client is not None:
        from heli_jax.sweeps.cluster import split_there

        split = split_there(options.client, job, **requested)
    else:
        split = split_for(job, devices=options.devices, say=options.say, **requested)
    return split


def _same_cut(store: stores.Store, job: Job, options: Options, where: str) -> None:
    """Refuse a division other than the store's, because the last digits depend on it."""
    for name in ("chunk", "lanes"):
        number, kept = getattr(options, name), getattr(store.split, name)
        # A number above the count of elements was reduced when the store was made.
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
    """Compute the missing chunks; return timing statistics."""
    # Workers may finish in any order; each chunk's own status in the store counts.
    todo = [int(k) for k in np.flatnonzero(~done)]
    total, size = job.design.size, store.split.chunk
    before = sum(min(size, total - int(k) * size) for k in np.flatnonzero(done))
    begin, now = time.perf_counter(), before
    if options.client is not None:
        # Here, because dask is an optional extra.
        from heli_jax.sweeps.cluster import computed

        source: Iterable[Any] = computed(options.client, job, store.split, todo)
    else:
        source = _local(job, store.split, todo, options.devices)
    with stages.stage("sweep", total=total):
        for chunk, results in source:
            store.write(chunk, results)
            now += len(results["status"])
            stages.reach(now)
            options.progress(now, total)
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
    """Yield chunks computed here; while one is written, the devices work on the next."""
    if not todo:
        return
    worker = Worker(job, split, devices)
    # JAX returns before it has computed. One chunk ahead keeps the devices busy; more would only
    # take memory.
    begun = worker.begin(todo[0])
    for chunk, following in zip(todo, [*todo[1:], None], strict=True):
        pending = begun
        if following is not None:
            begun = worker.begin(following)
        yield chunk, worker.finish(pending)
