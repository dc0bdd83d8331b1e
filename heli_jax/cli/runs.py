"""Fits of a folder, and fits side by side."""

import json
import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from heli_jax import run_directory
from heli_jax.cli.terminal import print_page_table, print_text
from heli_jax.errors import InputError
from heli_jax.numbers import adequacy_of
from heli_jax.regular_file import read_regular

if TYPE_CHECKING:
    from heli_jax.report.compared_runs import ComparedRuns

_LARGEST_FIT = 10**9
"""Largest fit.json that is read [bytes]."""
_DEEPEST = 3
"""Depth to which a folder is searched [folders]."""


def listed(folder: Path) -> list[dict[str, Any]]:
    """Return the fits of a folder, the oldest first.

    Raises:
        InputError: there is no such folder.
    """
    if not folder.exists():
        raise InputError(
            f"{folder}: does not exist, expected a folder with runs of heli-jax fit: heli-jax "
            "runs DIR"
        )
    if not folder.is_dir():
        raise InputError(f"{folder}: expected a folder of runs, got a file")
    return sorted(_found(folder), key=lambda run: run["date"])


def _found(folder: Path) -> Iterator[dict[str, Any]]:
    for path in _files(folder, _DEEPEST):
        try:
            content = json.loads(read_regular(path, "the fit.json of a run", _LARGEST_FIT))
            # The table has no room for the reasons.
            adequate = adequacy_of(content).partition(" (")[0]
            row = {k: content[k] for k in ("model", "method", "status")}
            untrusted = ", ".join(map(str, content.get("untrusted") or ()))
            date = time.strftime("%Y-%m-%d %H:%M", time.localtime(path.stat().st_mtime))
        # Another program may have written a fit.json, which is no run.
        except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
            continue
        name = str(path.parent.relative_to(folder))
        yield {"run": name, "date": date, **row, "adequate": adequate, "untrusted": untrusted}


def _files(folder: Path, deepest: int) -> Iterator[Path]:
    # A folder may be listed but not entered. Its entries then have no type.
    try:
        inside = sorted(os.scandir(folder), key=lambda entry: entry.name)
        files = [e.path for e in inside if e.name == "fit.json" and e.is_file()]
        folders = [e.path for e in inside if e.is_dir(follow_symlinks=False)]
    except OSError:
        return
    yield from map(Path, files)
    for path in folders if deepest else ():
        yield from _files(Path(path), deepest - 1)


def print_compared(compared: "ComparedRuns") -> None:
    """Print fits side by side."""
    # Directory names may be wider than a terminal, so runs have numbers.
    numbered = compared._replace(labels=tuple(str(i + 1) for i in range(len(compared.runs))))
    for number, row in zip(numbered.labels, compared.verdicts.rows, strict=True):
        label, model, method, status, verdict, adequate = row
        print_text(
            f"{number}: {label}: {model} by {method}, {status}. {verdict} adequate: {adequate}"
        )
    print_page_table(numbered.estimates)
    # Output, flights and metric name a row, also where a narrow terminal splits the table.
    print_page_table(numbered.agreement, keys=3)
    for found in numbered.notes:
        print_text(f"! {found.sentence}")


def write_compared(place: Path, compared: "ComparedRuns") -> None:
    """Write a page (.html) or the estimates (.csv)."""
    run_directory.require_place(place, f"--out {place}")
    with run_directory.whole_file(place, f"--out {place}") as temporary:
        if place.suffix.lower() == ".html":
            from heli_jax.report.compared_runs import write_page

            write_page(temporary, compared)
        else:
            temporary.write_text(compared.to_csv(), encoding="utf-8")
