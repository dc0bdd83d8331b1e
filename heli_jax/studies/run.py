"""run_study: many fits of one configuration, each written when it is done."""

import shutil
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import xarray as xr

from heli_jax import run_directory, stages
from heli_jax.config.experiment import from_content
from heli_jax.config.study import Study, read_study
from heli_jax.errors import InputError
from heli_jax.numerics.cores import cores
from heli_jax.report.origin import command
from heli_jax.stages import Note
from heli_jax.studies import directory
from heli_jax.studies.dataset import dataset
from heli_jax.studies.point import Outcome, Task, fit_point
from heli_jax.sweeps.store import only_writer
from heli_jax.versions import changed_since, versions

STORE = "study.zarr"


class Options(NamedTuple):
    """Options for the execution of a study; none changes a number."""

    resume: bool = False
    """Continue with an existing directory; failed fits are tried again."""
    workers: int | None = None
    """Number of processes on this computer; by default one per core."""
    # Any: a dask Client, an optional extra.
    client: Any = None
    """A dask.distributed Client whose workers fit, instead of processes."""
    reports: bool = False
    """Also write each fit's page and figures, which takes seconds per fit."""
    progress: Callable[[int, int], None] = lambda done, total: None
    """Called with the finished fits and their total."""
    say: Callable[[str], None] = lambda _: None


def run_study(
    config: str | Path,
    out: str | Path | None = None,
    over: Mapping[str, Sequence[Any]] | Sequence[str] = (),
    overrides: Sequence[str] | Mapping[str, Any] = (),
    **options: Any,
) -> xr.Dataset:
    """Fit a configuration for every combination of some keys' values.

    Args:
        config: path of the configuration; its section `study` comes first.
        out: a directory for study.zarr and the fits' directories; none is kept by default.
        over: values by key, `{"fit.free.a.start": [4, 5, 6]}`.
        overrides: values that replace those of the file, as in `load_config`.
        **options: fields of `Options`: resume, workers, client, reports, progress, say.

    Returns:
        A Dataset whose dimensions are the axes, with parameter and output. A failed fit has the
        status 'failed' and its sentence; it stops no other.

    Raises:
        InputError: something in the configuration is wrong, nothing takes several values, or `out`
            exists (without `resume`), belongs to another study, or cannot be written to.
        TypeError: a keyword that is no option.
    """
    study = read_study(config, overrides, over)
    if study is None:
        raise InputError(
            f"{config}: study: missing, expected keys with lists of values, here or in `over`"
        )
    carrying = Options(**options)
    if out is not None:
        return run(study, Path(out), carrying)
    with tempfile.TemporaryDirectory(prefix="heli_jax-study-") as folder:
        return run(study, Path(folder) / "study", carrying._replace(resume=False))


def run(study: Study, out: Path, options: Options) -> xr.Dataset:
    """Run a study.

    Raises:
        InputError: as `run_study`.
    """
    if options.workers is not None and options.workers < 1:
        raise InputError(f"workers: expected at least 1, got {options.workers}")
    new = run_directory.is_new(out, options.resume)
    described = study.described()
    tasks = _tasks(study, options.reports)
    if new:
        directory.create(out, study, described, versions())
    run_directory.require_writable(out)
    begun_with = directory.require_same(out, described)
    with only_writer(out, f"--out {out}"):
        directory.remove_remains(out)
        if changed := changed_since(begun_with):
            options.say(Note(changed))
        names = directory.names(study)
        places = [out / directory.FITS / name for name in names]
        with stages.stage("study", total=len(tasks)):
            _compute(tasks, places, options)
        result = dataset(study, names, [directory.read_fit(p) for p in places], begun_with)
        _write(out, result)
    return result


def _tasks(study: Study, reports: bool) -> list[Task]:
    """Return the workers' tasks; refuse a value that the configuration cannot have."""
    tasks = []
    path = str(study.path.absolute())
    for point in study.points():
        try:
            from_content(study.content_at(point), study.path)
        except InputError as e:
            at = ", ".join(f"{key} = {value!r:.60}" for key, value in point.items())
            raise InputError(f"{e} (study, at {at})") from e
        tasks.append(Task(path, study.content_at(point), point, reports, command()))
    return tasks


def _compute(tasks: Sequence[Task], places: Sequence[Path], options: Options) -> None:
    """Compute the missing fits, and write each when it is done."""
    todo = [k for k, place in enumerate(places) if not (place / "fit.json").is_file()]
    if not todo:
        return
    done = len(tasks) - len(todo)
    notices: set[str] = set()
    for number, outcome in _outcomes([tasks[k] for k in todo], options):
        place = places[todo[number]]
        directory.write_fit(place, outcome)
        # Fits of one log share the notes of its reader.
        for note in outcome.notes:
            if note not in notices:
                options.say(Note(note))
        notices.update(outcome.notes)
        if outcome.sentence is not None:
            options.say(Note(f"{place.name}: no fit: {outcome.sentence}"))
        done += 1
        stages.reach(done)
        options.progress(done, len(tasks))


def _outcomes(tasks: Sequence[Task], options: Options) -> Iterator[tuple[int, Outcome]]:
    if options.client is not None:
        # Here, because dask is an optional extra.
        from heli_jax.sweeps.cluster import mapped

        yield from mapped(options.client, fit_point, tasks)
        return
    from heli_jax.studies.processes import computed

    yield from computed(tasks, min(options.workers or cores(), len(tasks)))


def _write(out: Path, result: xr.Dataset) -> None:
    """Write the Dataset as a Zarr store, in place of an earlier one."""
    target = out / STORE
    with run_directory.whole(target) as folder:
        result.to_zarr(folder, mode="w", consolidated=False, zarr_format=3)
        shutil.rmtree(target, ignore_errors=True)
