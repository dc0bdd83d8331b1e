"""What `simulate` and `sweep` print and write: without the estimation, which they need not load."""

import json
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from heli_jax import config as configuration
from heli_jax import run_directory
from heli_jax.finding import sentences
from heli_jax.flights import write as tables
from heli_jax.numbers import terse
from heli_jax.terminal import print_table, tell
from heli_jax.yaml_file import as_yaml

if TYPE_CHECKING:
    from heli_jax.generate import Simulated


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
