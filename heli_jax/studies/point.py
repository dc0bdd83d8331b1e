"""One fit of a study, from its configuration to its files: the work of a local or remote worker.

The requesting process writes the files, so workers need no common disk and only one process writes.
"""

import json
import tempfile
import traceback
from pathlib import Path
from typing import Any, NamedTuple

from heli_jax.errors import InputError
from heli_jax.finding import sentences

_MAPPED = 30_000
"""Memory regions above which compiled programs are released. Linux grants a process 65530, every
compiled kernel takes some, and beyond the limit the process dies."""


class Task(NamedTuple):
    """Task of a worker, as plain data for JSON."""

    path: str
    """Path of the configuration, which need not exist there; relative paths begin at its folder."""
    content: dict[str, Any]
    """Content of the YAML file."""
    point: dict[str, Any]
    """Value of each key of the study."""
    reports: bool = False
    """True to make the page and its figures, which takes seconds."""
    command: str = ""
    """Command of the study; a worker's own differs."""


class Outcome(NamedTuple):
    """Outcome of a fit."""

    files: dict[str, bytes]
    """Files by path within its directory."""
    sentence: str | None = None
    """Reason why there is no fit; None if there is one."""
    notes: tuple[str, ...] = ()
    """Notes of the log readers, in sentences."""


def fit_point(task: Task) -> Outcome:
    """Fit one point of a study; any error becomes part of the outcome and affects no other fit."""
    try:
        return _fitted(task)
    except InputError as e:
        return failure(" ".join(str(e).split()), task)
    except Exception as e:  # a fault of ours, whose traceback a report needs
        sentence = " ".join(f"{type(e).__name__}: {e}".split())
        return failure(sentence, task, traceback.format_exc())
    finally:
        _let_programs_go()


def failure(sentence: str, task: Task, trace: str = "") -> Outcome:
    """Return the outcome of a failed fit."""
    content = {"sentence": sentence, "point": task.point} | ({"traceback": trace} if trace else {})
    text = json.dumps(content, indent=1)
    return Outcome({"failed.json": text.encode()}, sentence)


def _fitted(task: Task) -> Outcome:
    # Here, because the requesting process needs neither.
    from heli_jax import workflow
    from heli_jax.config.experiment import from_content
    from heli_jax.config.logs import log_notes
    from heli_jax.report.origin import made_for

    run = workflow.run_fit(from_content(task.content, Path(task.path)))
    with (
        tempfile.TemporaryDirectory(prefix="heli_jax-study-") as folder,
        made_for(task.command, _in_words(task.point)),
    ):
        place = Path(folder) / "fit"
        workflow.write_report(run, place, page=task.reports)
        files = {
            file.relative_to(place).as_posix(): file.read_bytes()
            for file in sorted(place.rglob("*"))
            if file.is_file()
        }
    return Outcome(files, notes=tuple(sentences(log_notes(run.problem.flights))))


def _in_words(point: dict[str, Any]) -> str:
    """Return keys and values, as on the Dataset's axes."""
    texts = {k: v if isinstance(v, str) else json.dumps(v) for k, v in point.items()}
    return ", ".join(f"{key} = {text}" for key, text in texts.items())


def _let_programs_go() -> None:
    regions = Path("/proc/self/maps")
    if not regions.exists():
        return
    if regions.read_bytes().count(b"\n") > _MAPPED:
        import gc

        import jax

        jax.clear_caches()
        gc.collect()
