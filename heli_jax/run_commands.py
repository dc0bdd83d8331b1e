"""Commands about runs that were made: `heli-jax runs`, `heli-jax compare`."""

import argparse
import json
import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from heli_jax import run_directory
from heli_jax.errors import InputError
from heli_jax.numbers import ADEQUATE
from heli_jax.regular_file import read_regular
from heli_jax.terminal_table import print_table, tell

_LARGEST = 10**9
"""bytes of a fit.json"""
_DEEPEST = 3
"""folders below the one that is asked for"""


def runs(options: argparse.Namespace) -> int:
    """`heli-jax runs`: what fits a folder holds, the latest last."""
    folder = Path(options.directory)
    if not folder.exists():
        raise InputError(
            f"{folder}: there is no such folder, expected one that holds runs of heli-jax fit: "
            "heli-jax runs DIR"
        )
    if not folder.is_dir():
        raise InputError(f"{folder}: expected a folder of runs, got a file")
    listed = sorted(_found(folder), key=lambda run: run["date"])
    if options.json:
        print(json.dumps(listed, indent=1))
        return 0
    if not listed:
        raise InputError(f"{folder}: holds no run of heli-jax fit")
    keys = ("run", "date", "model", "method", "status", "adequate", "untrusted")
    rows = [tuple(str(run[k]) for k in keys) for run in listed]
    print_table(keys, rows)
    return 0


def _found(folder: Path) -> Iterator[dict[str, Any]]:
    for path in _files(folder, _DEEPEST):
        try:
            content = json.loads(read_regular(path, "the fit.json of a run", _LARGEST))
            # Without its reasons, for which a table has no room.
            adequate = ADEQUATE[content["adequate"]]
            row = {k: content[k] for k in ("model", "method", "status")}
            untrusted = ", ".join(map(str, content.get("untrusted") or ()))
            date = time.strftime("%Y-%m-%d %H:%M", time.localtime(path.stat().st_mtime))
        # Any file may be called so: what no fit wrote is no run.
        except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
            continue
        name = str(path.parent.relative_to(folder))
        yield {"run": name, "date": date, **row, "adequate": adequate, "untrusted": untrusted}


def _files(folder: Path, deepest: int) -> Iterator[Path]:
    # Also one that may be listed and not entered says of nothing in it what it is.
    try:
        inside = sorted(os.scandir(folder), key=lambda entry: entry.name)
        files = [e.path for e in inside if e.name == "fit.json" and e.is_file()]
        folders = [e.path for e in inside if e.is_dir(follow_symlinks=False)]
    except OSError:
        return
    yield from map(Path, files)
    for path in folders if deepest else ():
        yield from _files(Path(path), deepest - 1)


def compare(options: argparse.Namespace, say: Callable[[str], None]) -> int:
    """`heli-jax compare`: fits side by side."""
    from heli_jax.report.compared_runs import compare_runs

    place = None if options.out is None else Path(options.out)
    endings = (".html", ".csv", ".tex")
    if place is not None and place.suffix.lower() not in endings:
        raise InputError(f"--out {place}: expected a name ending in {', '.join(endings)}")
    compared = compare_runs(options.runs)
    # Numbers for names: several directories' names are wider than a terminal.
    numbered = compared._replace(labels=tuple(str(i + 1) for i in range(len(compared.runs))))
    for number, row in zip(numbered.labels, compared.verdicts.rows, strict=True):
        label, model, method, status, verdict, adequate = row
        tell(f"{number}: {label}: {model} by {method}, {status}. {verdict} adequate: {adequate}")
    print_table(numbered.estimates.head, list(numbered.estimates.rows))
    # Output, flights and metric are a row's name, where a narrow terminal parts the table too.
    print_table(numbered.agreement.head, list(numbered.agreement.rows), keys=3)
    for found in numbered.notes:
        tell(f"! {found.sentence}")
    if place is None:
        return 0
    run_directory.require_place(place, f"--out {place}")
    with run_directory.whole_file(place, f"--out {place}") as temporary:
        if place.suffix.lower() == ".html":
            from heli_jax.report.compared_page import write_page

            write_page(temporary, compared)
        else:
            csv = place.suffix.lower() == ".csv"
            temporary.write_text(
                compared.to_csv() if csv else compared.to_latex(), encoding="utf-8"
            )
    say(f"wrote {place}")
    return 0
