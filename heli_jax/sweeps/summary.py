"""Summary of a sweep, a page of JSON."""

import contextlib
import functools
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from heli_jax import run_directory
from heli_jax.finding import as_data, note
from heli_jax.sweeps.datasets import chunks_of
from heli_jax.sweeps.design_point import MEANINGS, OK
from heli_jax.sweeps.spec import Job

_WORST_COUNT = 5  # elements of each result: as many as the figure of them has dashes
_SMALL_IS_BAD = ("fit", "vaf")  # 100 % and 1 are perfect, and there is no lower end


def write_summary(
    path: Path, dataset: xr.Dataset, job: Job, timing: dict[str, Any], where: str
) -> None:
    """Write summary.json, which appears whole or not at all.

    Raises:
        InputError: it cannot be written.
    """
    content = summary(dataset, job, timing)
    if not timing["computed_chunks"] and path.exists():
        # Resumed when it was finished: what it took stays.
        with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
            content["timing"] = json.loads(path.read_text(encoding="utf-8"))["timing"]
    # NaN is no JSON, though Python writes it: other programs could not read the file.
    text = json.dumps(content, indent=1, allow_nan=False)
    with run_directory.whole_file(path, f"{where}: summary.json") as temporary:
        temporary.write_text(text + "\n", encoding="utf-8")


def summary(dataset: xr.Dataset, job: Job, timing: dict[str, Any]) -> dict[str, Any]:
    """Counts by status, quantiles of every result over the elements that are ok, the worst and the
    best.
    """
    # The status of all elements is held, a byte each; results are read in pieces.
    status = dataset["status"].values
    fine = status == OK
    results = {
        str(name): _quantiles(dataset[name], fine)
        for name in dataset.data_vars
        # Quantiles over times and elements together would say nothing of any run.
        if not str(name).startswith("trajectory_")
    }
    content = {
        "model": job.model.name,
        "elements": int(status.size),
        "status": {word: int(np.count_nonzero(status == k)) for k, word in MEANINGS.items()},
        "axes": {n: ends for n in job.design.names if (ends := _ends(dataset[n]))},
        "results": results,
        **{
            words: {n: _rows(dataset, job, n, k) for n, k in worst(dataset, job, sign).items()}
            for words, sign in (("worst", 1.0), ("best", -1.0))
        },
        "split": dataset.attrs["split"],
        "timing": timing,
        "versions": dataset.attrs["versions"],
        "seed": dataset.attrs["seed"],
        # A store of an earlier version has sentences alone.
        "notes": [
            n if isinstance(n, dict) else as_data(note("sweep.note", n))
            for n in dataset.attrs.get("notes", [])
        ],
    }
    if "float32_error" in dataset.attrs:
        content["float32_error"] = dataset.attrs["float32_error"]
    return content


def _finite(values: np.ndarray) -> np.ndarray:
    return values[np.isfinite(values)]


def _unit(variable: xr.DataArray) -> dict[str, str]:
    return {"unit": variable.attrs["units"]} if "units" in variable.attrs else {}


def _ends(variable: xr.DataArray) -> dict[str, Any]:
    """The least and the largest finite value; nothing where there is none."""
    parts = [part for _, values in chunks_of(variable) if (part := _finite(values)).size]
    if not parts:
        return {}
    ends = {"min": min(float(v.min()) for v in parts), "max": max(float(v.max()) for v in parts)}
    return {**ends, **_unit(variable)}


def _quantiles(variable: xr.DataArray, fine: np.ndarray) -> dict[str, Any]:
    """Return quantiles of the finite values of the elements that are ok, and the number of values
    that are not finite.

    Over flights and modes too, where a result has them.
    """
    # The values are held once: the partition for the quantiles is made where they are. A list of
    # parts that are joined would take twice the memory, of a million elements that counts.
    values, n = np.empty(np.count_nonzero(fine) * (variable.size // max(1, fine.size))), 0
    infinite = nan = 0
    for which, part in chunks_of(variable):
        used = part[fine[which]]
        infinite += int(np.count_nonzero(np.isinf(used)))
        nan += int(np.count_nonzero(np.isnan(used)))
        finite = _finite(used)
        values[n : n + finite.size] = finite
        n += finite.size
    others = {"infinite": infinite, "nan": nan}
    counts = {"n": n} | {k: v for k, v in others.items() if v}
    if not n:
        return {**_unit(variable), **counts}
    q = np.quantile(values[:n], [0.0, 0.05, 0.5, 0.95, 1.0], overwrite_input=True)
    names = ("min", "q05", "median", "q95", "max")
    return {**_unit(variable), **counts, **dict(zip(names, map(float, q), strict=True))}


def worst(dataset: xr.Dataset, job: Job, sign: float = 1.0) -> dict[str, np.ndarray]:
    """By result, the elements that are ok and worst in it, worst first, `_WORST_COUNT` at most: the
    largest, or for what agrees with a flight the smallest; of several flights the worst one counts.
    With a `sign` of -1 the best, best first."""
    fine = dataset["status"].values == OK
    by_result = {}
    for name, reduce in job.reduce.items():
        # Modes, margins and functions of several numbers have no variable of their own name, and
        # which of theirs should be small is not known.
        if name not in dataset.data_vars:
            continue
        badness = functools.partial(_badness, small_is_bad=reduce.how in _SMALL_IS_BAD, sign=sign)
        elements = _worst(dataset[name], fine, badness, _WORST_COUNT)
        if elements.size:
            by_result[name] = elements
    return by_result


def _badness(part: np.ndarray, *, small_is_bad: bool, sign: float) -> np.ndarray:
    """Return the measure (elements,) by which a result (elements, ...) is worst where it is
    large."""
    values = part.astype(np.float64)  # a bool or an integer has no minus
    bad = -values if small_is_bad else np.abs(values)
    # The worst flight first, whichever end is looked for.
    return sign * bad.reshape(len(values), -1).max(axis=1)


def _worst(
    variable: xr.DataArray,
    fine: np.ndarray,
    badness_of: Callable[[np.ndarray], np.ndarray],
    count: int,
) -> np.ndarray:
    """The elements that are fine and worst in a variable, worst first, (count,) or fewer."""
    badness, element = np.empty(0), np.empty(0, np.int64)
    for which, part in chunks_of(variable):
        bad = badness_of(part)
        usable = np.flatnonzero(fine[which] & np.isfinite(bad))
        most = min(count, usable.size)
        # Of each part the worst few, and of those the worst: all are never sorted, nor held.
        top = usable[np.argpartition(bad[usable], -most)[-most:]] if most else usable
        badness = np.concatenate([badness, bad[top]])
        element = np.concatenate([element, top + which.start])
    # Equal ones by their place, so that the order does not depend on how it was read.
    return element[np.lexsort((element, -badness))[:count]]


def _rows(dataset: xr.Dataset, job: Job, name: str, elements: np.ndarray) -> list[dict[str, Any]]:
    """Elements with their value of a result and their axes, as JSON has it."""
    few = dataset.isel(element=elements)
    values = few[name].transpose("element", ...).values.tolist()
    axes = {n: few[n].values.astype(np.float64) for n in job.design.names}
    return [
        {"element": int(k), "value": v, "axes": {n: float(a[i]) for n, a in axes.items()}}
        for i, (k, v) in enumerate(zip(elements, values, strict=True))
    ]
