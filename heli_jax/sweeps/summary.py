"""Summary of a sweep, as JSON."""

import contextlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from heli_jax import run_directory
from heli_jax.sweeps.design_point import MEANINGS, OK
from heli_jax.sweeps.spec import Job

_WORST_COUNT = 5  # elements of each result, as many as dashes in its figure
_SMALL_IS_BAD = ("fit", "vaf")  # 100 % and 1 are perfect, and there is no lower end


def write_summary(
    path: Path, dataset: xr.Dataset, job: Job, timing: dict[str, Any], where: str
) -> None:
    """Write summary.json, which appears complete or not at all.

    Raises:
        InputError: it cannot be written.
    """
    content = summary(dataset, job, timing)
    if not timing["computed_chunks"] and path.exists():
        # The sweep was already finished, so its timing stays.
        with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
            content["timing"] = json.loads(path.read_text(encoding="utf-8"))["timing"]
    # NaN is no valid JSON, though Python writes it: other programs could not read the file.
    text = json.dumps(content, indent=1, allow_nan=False)
    with run_directory.whole_file(path, f"{where}: summary.json") as temporary:
        temporary.write_text(text + "\n", encoding="utf-8")


def summary(dataset: xr.Dataset, job: Job, timing: dict[str, Any]) -> dict[str, Any]:
    """Return counts by status, and quantiles, the worst and the best valid elements by result."""
    status = dataset["status"].values
    fine = status == OK
    results = {
        str(name): _quantiles(dataset[name], fine)
        for name in dataset.data_vars
        # Quantiles over times and elements together have no meaning for a run.
        if not str(name).startswith("trajectory_")
    }
    return {
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
        "notes": dataset.attrs["notes"],
    }


def _finite(values: np.ndarray) -> np.ndarray:
    return values[np.isfinite(values)]


def _unit(variable: xr.DataArray) -> dict[str, str]:
    return {"unit": variable.attrs["units"]} if "units" in variable.attrs else {}


def _ends(variable: xr.DataArray) -> dict[str, Any]:
    """Return the smallest and the largest finite value; empty if there is none."""
    values = _finite(variable.values)
    if not values.size:
        return {}
    return {"min": float(values.min()), "max": float(values.max()), **_unit(variable)}


def _quantiles(variable: xr.DataArray, fine: np.ndarray) -> dict[str, Any]:
    """Return quantiles of the finite values of the valid elements, and the count of other values.

    Flights and modes are included if a result has them.
    """
    used = _by_element(variable)[fine]
    values = _finite(used).astype(np.float64)
    others = {"infinite": int(np.isinf(used).sum()), "nan": int(np.isnan(used).sum())}
    counts = {"n": values.size} | {k: v for k, v in others.items() if v}
    if not values.size:
        return {**_unit(variable), **counts}
    q = np.quantile(values, [0.0, 0.05, 0.5, 0.95, 1.0], overwrite_input=True)
    names = ("min", "q05", "median", "q95", "max")
    return {**_unit(variable), **counts, **dict(zip(names, map(float, q), strict=True))}


def worst(dataset: xr.Dataset, job: Job, sign: float = 1.0) -> dict[str, np.ndarray]:
    """Return the worst valid elements by result, worst first, at most `_WORST_COUNT`.

    The worst are the largest, or the smallest for a measure of agreement with a flight; of several
    flights the worst one counts. A `sign` of -1 returns the best, best first.
    """
    fine = dataset["status"].values == OK
    by_result = {}
    for name, reduce in job.reduce.items():
        # Modes, margins and functions with several numbers have no variable of their own name, and
        # which numbers should be small is unknown.
        if name not in dataset.data_vars:
            continue
        # A bool or an integer has no minus.
        values = _by_element(dataset[name]).astype(np.float64)
        bad = -values if reduce.how in _SMALL_IS_BAD else np.abs(values)
        # The worst flight counts, for either sign.
        bad = sign * bad.reshape(len(values), -1).max(axis=1)
        usable = np.flatnonzero(fine & np.isfinite(bad))
        elements = usable[np.argsort(-bad[usable], kind="stable")][:_WORST_COUNT]
        if elements.size:
            by_result[name] = elements
    return by_result


def _by_element(variable: xr.DataArray) -> np.ndarray:
    """Return the values (elements, ...); they may be stored with the elements last."""
    return variable.transpose("element", ...).values


def _rows(dataset: xr.Dataset, job: Job, name: str, elements: np.ndarray) -> list[dict[str, Any]]:
    """Return elements with their value of a result and their axes, as plain data for JSON."""
    few = dataset.isel(element=elements)
    values = _by_element(few[name]).tolist()
    axes = {n: few[n].values.astype(np.float64) for n in job.design.names}
    return [
        {"element": int(k), "value": v, "axes": {n: float(a[i]) for n, a in axes.items()}}
        for i, (k, v) in enumerate(zip(elements, values, strict=True))
    ]
