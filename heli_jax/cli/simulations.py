"""Output of `simulate`, `sweep` and studies, without estimation."""

import contextlib
import json
import math
import sys
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from heli_jax import run_directory
from heli_jax.cli.terminal import print_table, print_text
from heli_jax.errors import InputError
from heli_jax.flights import write as tables
from heli_jax.numbers import rounded, terse

if TYPE_CHECKING:
    import xarray as xr


def write_table(out: Path | None, columns: dict[str, np.ndarray]) -> None:
    """Write a table as CSV or Parquet at `out`, complete or not at all, or as CSV on stdout.

    Raises:
        InputError: the place cannot be written to.
    """
    if out is None:
        tables.write_table(sys.stdout.buffer, columns)
        return
    with run_directory.whole_file(out, f"--out {out}") as temporary:
        tables.write_table(temporary, columns)


def print_sweep(out: Path) -> None:
    """Print the summary of a sweep on standard output."""
    # Read the file, since a resumed sweep prints the results of all its runs.
    totals = json.loads((out / "summary.json").read_text(encoding="utf-8"))
    counts = {k: v for k, v in totals["status"].items() if v}
    words = ", ".join(f"{v} {k.replace('_', ' ')}" for k, v in counts.items())
    backend = totals["split"]["backend"]
    print_text(f"{totals['elements']} elements of {totals['model']}: {words}; backend {backend}")
    rows = []
    for name, result in totals["results"].items():
        numbers = [
            terse(result[k]) if k in result else "" for k in ("min", "q05", "median", "q95", "max")
        ]
        rows.append((name, *numbers, result.get("unit", "")))
    print_table(("result", "min", "5 %", "median", "95 %", "max", "unit"), rows)
    for words in ("worst", "best"):
        for name, [element, *_] in totals[words].items():
            at = ", ".join(f"{n} = {terse(v)}" for n, v in element["axes"].items())
            value = f"{terse(element['value'])} {totals['results'].get(name, {}).get('unit', '')}"
            print_text(
                f"{words} {name}: {value.removesuffix(' 1').rstrip()}, element "
                f"{element['element']}, {at}"
            )
    for found in totals["notes"]:
        print_text(f"! {found['sentence']}")
    for name, result in totals["results"].items():
        # Quantiles cover only finite values, so the number of others is printed.
        apart = {"infinite": result.get("infinite", 0), "not a number": result.get("nan", 0)}
        if sum(apart.values()):
            words = " and ".join(f"{k} {what}" for what, k in apart.items() if k)
            of = result["n"] + sum(apart.values())
            print_text(f"! {name}: {words} of {of} values, which its line leaves out")
    timing = totals["timing"]
    # A sweep resumed after its end computes nothing and has no rate.
    if timing["computed_elements"]:
        print_text(
            f"{timing['computed_elements']} elements in {terse(timing['seconds'], 3)} s "
            f"({terse(timing['elements_per_s'], 3)} per second, with compilation)"
        )
    print_text(f"store: {out / 'sweep.zarr'}")
    if (out / "report.html").is_file():
        print_text(f"report: {out / 'report.html'}")


DONE, NOT_DETERMINED, NOT_CONVERGED = 0, 3, 4  # as for a single fit
_MOST_ROWS = 40
_WIDEST = 24
"""Longest value of an axis [characters]."""
_MOST_DOUBTS = 10


def study_exit_code(result: "xr.Dataset") -> int:
    """Return the exit code of the worst fit."""
    status, adequate, untrusted = (
        set(map(str, result[n].to_numpy().ravel())) for n in ("status", "adequate", "untrusted")
    )
    if status - {"converged", "not-identifiable"} or "no" in adequate:
        return NOT_CONVERGED
    return NOT_DETERMINED if "not-identifiable" in status or untrusted - {""} else DONE


def print_study(result: "xr.Dataset") -> None:
    """Print the fits of a study as a table, with the scatter of their estimates.

    Args:
        result: result of `run_study`.
    """
    axes, parameters = result.attrs["axes"], [str(p) for p in result["parameter"].to_numpy()]
    # If every fit failed, there are no parameters or outputs to stack.
    empty = [d for d in ("parameter", "output") if not result.sizes[d]]
    flat = result.drop_dims(empty).stack(fit=axes, create_index=False)
    status = [str(s) for s in flat["status"].to_numpy()]
    counts = ", ".join(f"{count} {words}" for words, count in Counter(status).items())
    adequate = Counter(str(a) for a in flat["adequate"].to_numpy() if a)
    judged = ", ".join(f"{count} {words}" for words, count in adequate.items())
    print_text(f"{len(status)} fits: {counts}" + (f"; adequate: {judged}" if judged else ""))
    outputs = [f"fit of {o} [%]" for o in result["output"].to_numpy()]
    rows = []
    for i in range(min(len(status), _MOST_ROWS)):
        one = flat.isel(fit=i)
        at = [_axis(one[axis].item()) for axis in axes]
        estimates = [_measured(one, p) for p in parameters]
        agreement = [f"{v:.1f}" for v in one["nrmse_fit_percent"].to_numpy()] if outputs else []
        rows.append((*at, status[i], *estimates, *agreement))
    # All axes name a row. With one alone, rows would look alike where the table is split.
    print_table((*axes, "status", *parameters, *outputs), rows, keys=len(axes))
    if len(status) > _MOST_ROWS:
        print_text(f"... and {len(status) - _MOST_ROWS} more")
    _print_scatter(flat, parameters)
    runs = [str(run) for run in flat["run"].to_numpy()]
    untrusted, failed = (list(map(str, flat[n].to_numpy())) for n in ("untrusted", "sentence"))
    doubts = [
        f"{r}: not trusted: {names}" for r, names in zip(runs, untrusted, strict=True) if names
    ]
    doubts += [f"{run}: {words}" for run, words in zip(runs, failed, strict=True) if words]
    for words in doubts[:_MOST_DOUBTS]:
        print_text(f"! {words}")
    if len(doubts) > _MOST_DOUBTS:
        more = len(doubts) - _MOST_DOUBTS
        print_text(f"! ... and {more} more: `untrusted` and `sentence` of study.zarr")


def _axis(value: Any) -> str:
    text = f"{value:g}" if isinstance(value, float) else str(value)
    return text if len(text) <= _WIDEST else f"...{text[3 - _WIDEST :]}"


# Any: a Dataset of one fit.
def _measured(one: Any, parameter: str) -> str:
    at = one.sel(parameter=parameter)
    value, sd = at["estimate"].item(), at["sd"].item()
    if math.isnan(sd):
        return "not determined" if str(one["status"].item()) != "failed" else "–"
    return " ± ".join(rounded(value, sd))


def _print_scatter(flat: "xr.Dataset", parameters: list[str]) -> None:
    """Print the scatter between the fits beside the sd of each."""
    rows = []
    arrived = flat["status"].to_numpy() != "not-converged"
    for i, parameter in enumerate(parameters):
        one = flat.sel(parameter=parameter)
        values, sds = (one[n].to_numpy() for n in ("estimate", "sd"))
        there = np.isfinite(values) & np.isfinite(sds) & arrived
        if np.count_nonzero(there) < 2:
            continue
        values, sds = values[there], sds[there]
        numbers = (values.min(), np.median(values), values.max(), values.std(ddof=1))
        cells = [terse(v, 5) for v in numbers[:3]]
        cells += [terse(v, 2) for v in (numbers[3], float(np.median(sds)))]
        rows.append((parameter, str(values.size), *cells, str(flat["unit"].to_numpy()[i])))
    if rows:
        head = ("parameter", "fits", "lowest", "median", "highest", "sd between fits")
        print_table((*head, "median sd of a fit", "unit"), rows)


# Any: dask.distributed is an extra, and only `sweeps.cluster` names its classes.
def dask_client(scheduler: str | None) -> contextlib.AbstractContextManager[Any]:
    """Return a dask client of --scheduler, if it is stated."""
    if scheduler is None:
        return contextlib.nullcontext()
    try:
        from heli_jax.sweeps.cluster import connected
    except ImportError as e:
        raise InputError(
            "--scheduler: dask.distributed is not installed, expected the extra distributed: "
            "pip install 'heli_jax[distributed]'"
        ) from e
    return connected(scheduler)
