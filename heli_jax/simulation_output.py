"""What `simulate` and `sweep` print and write: without the estimation, which they need not load."""

import contextlib
import json
import math
import os
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from heli_jax import config as configuration
from heli_jax import run_directory
from heli_jax.finding import sentences
from heli_jax.flights import write as tables
from heli_jax.numbers import terse
from heli_jax.terminal_table import print_table, tell
from heli_jax.yaml_file import as_yaml

if TYPE_CHECKING:
    from heli_jax.generate import Simulated
    from heli_jax.sweeps.run import Progress


def write_table(out: Path | None, columns: dict[str, np.ndarray]) -> None:
    """A table as CSV or Parquet at `out`, which appears whole or not at all, or as CSV on stdout.

    Raises:
        InputError: the place cannot be written to.
    """
    if out is None:
        tables.write_table(sys.stdout.buffer, columns)
        return
    with run_directory.whole_file(out, f"--out {out}") as temporary:
        tables.write_table(temporary, columns)


def write_view(
    out: Path,
    experiment: configuration.Experiment,
    simulated: "Simulated",
    table: Path | None = None,
) -> None:
    """The page of what was simulated at `out`, which appears whole or not at all.

    Args:
        out: the HTML file to write.
        experiment: the configuration, of which the page shows the vehicle.
        simulated: the runs.
        table: the file with its samples, where one was written; the page links to it.

    Raises:
        InputError: the place cannot be written to.
    """
    # Imported here: no other command needs the page.
    from heli_jax.report.origin import origin
    from heli_jax.report.view import write_view as write

    title, params = experiment.path.stem, experiment.vehicle.params
    # From the page's folder on, so that both can be moved together.
    beside = (Path(os.path.relpath(p, out.parent)) for p in (experiment.path, table) if p)
    made = origin(as_yaml(configuration.resolved(experiment)), tuple(p.as_posix() for p in beside))
    notes = sentences(simulated.notes)
    with run_directory.whole_file(out, f"--view {out}") as temporary:
        write(temporary, simulated.runs, simulated.model, params, title, notes, made)


@contextlib.contextmanager
def sweep_progress(
    what: str = "sweep", of: str = "elements", *, quiet: bool = False
) -> Iterator["Callable[[Progress], None]"]:
    """What shows how far a sweep is, on standard error: a bar on a terminal, else now and then a
    line.

    Args:
        what: what goes on.
        of: what it has many of.
        quiet: show nothing.
    """
    if quiet:
        yield lambda _: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn

    # A bar in a log file is a line of carriage returns.
    if not sys.stderr.isatty():
        yield _Lines(what, of)
        return
    columns = (TextColumn(what), BarColumn(), TextColumn("{task.description}"))
    console = Console(stderr=True)
    with Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task("compiling", total=1.0)
        yield lambda p: bar.update(
            task,
            completed=p.done / p.total,
            # Beside the bar's name and the spaces between; rich would cut what is longer.
            description=_fitting_words(p, of, console.width - len(what) - 3),
        )


class _Lines:
    """A line at the first chunk, the last, and every ten seconds between."""

    def __init__(self, what: str, of: str) -> None:
        self.what, self.of, self.last = what, of, -math.inf

    def __call__(self, p: "Progress") -> None:
        now = time.monotonic()  # unlike time.time() it does not jump when a clock is set
        if p.done == p.total or now - self.last > 10.0:
            self.last = now
            words = f"heli-jax: {self.what}: {_progress_words(p, self.of)}"
            print(words, file=sys.stderr, flush=True)


def _progress_words(p: "Progress", of: str) -> str:
    return ", ".join(_progress(p, of))


def _progress(p: "Progress", of: str) -> list[str]:
    words = [f"{p.done} of {p.total} {of}"]
    # The first chunk compiles: a rate that contained it would foretell hours.
    if not math.isnan(p.rate):
        words.append(f"{terse(p.rate, 3)} a second")
        if p.done != p.total:
            left = max(0, round(p.remaining))
            words.append(f"{left // 3600}:{left // 60 % 60:02d}:{left % 60:02d} left")
    return words


def _fitting_words(p: "Progress", of: str, room: int) -> str:
    """What of it there is room for: the time left before the rate."""
    words = _progress(p, of)
    while len(words) > 1 and len(", ".join(words)) > room:
        words.pop(1)
    return ", ".join(words)


def _counted(elements: int) -> str:
    return "1 element" if elements == 1 else f"{elements} elements"


def print_sweep(out: Path) -> None:
    """The summary of a sweep on standard output."""
    # From the file, not from memory: a resumed sweep prints what all its runs have computed.
    totals = json.loads((out / "summary.json").read_text(encoding="utf-8"))
    counts = {k: v for k, v in totals["status"].items() if v}
    words = ", ".join(f"{v} {k.replace('_', ' ')}" for k, v in counts.items())
    # A store of an earlier version does not say: there was no other.
    backend = totals["split"].get("backend", "xla")
    tell(f"{_counted(totals['elements'])} of {totals['model']}: {words}; backend {backend}")
    rows = []
    for name, result in totals["results"].items():
        numbers = [
            terse(result[k]) if k in result else "" for k in ("min", "q05", "median", "q95", "max")
        ]
        error = totals.get("float32_error", {}).get(name)
        rows.append(
            (name, *numbers, result.get("unit", ""), "" if error is None else terse(error, 1))
        )
    # The last column only where the sweep compared single with double precision.
    head = ("result", "min", "5 %", "median", "95 %", "max", "unit", "float32 error")
    width = len(head) if "float32_error" in totals else len(head) - 1
    print_table(head[:width], [row[:width] for row in rows])
    for words in ("worst", "best"):
        for name, elements in totals[words].items():
            element = elements[0]
            at = ", ".join(f"{n} = {terse(v)}" for n, v in element["axes"].items())
            unit = totals["results"].get(name, {}).get("unit", "")
            value = f"{terse(element['value'])} {unit if unit != '1' else ''}".rstrip()
            tell(f"{words} {name}: {value}, element {element['element']}, {at}")
    for found in totals["notes"]:
        tell(f"! {found['sentence']}")
    for name, result in totals["results"].items():
        # Quantiles are of the finite values alone: how many were not is part of the answer.
        apart = {"infinite": result.get("infinite", 0), "not a number": result.get("nan", 0)}
        if sum(apart.values()):
            words = " and ".join(f"{k} {what}" for what, k in apart.items() if k)
            of = result["n"] + sum(apart.values())
            tell(f"! {name}: of {of} values {words}, which its line leaves out")
    if not totals["status"].get("ok"):
        tell("! no element is ok: see docs/sweeps.md for what each status means")
    timing = totals["timing"]
    # A sweep that was resumed when all was there has computed nothing, and has no rate.
    if timing["computed_elements"]:
        tell(
            f"{_counted(timing['computed_elements'])} in {terse(timing['seconds'], 3)} s "
            f"({terse(timing['elements_per_s'], 3)} a second, with compilation)"
        )
    tell(f"store: {out / 'sweep.zarr'}")
    if (out / "report.html").is_file():
        tell(f"report: {out / 'report.html'}")
