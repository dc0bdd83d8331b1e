"""What a sweep came to, in a page of JSON."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from heli_jax import run_directory
from heli_jax.sweeps.job import Job
from heli_jax.sweeps.program import MEANINGS, OK

_WORST = 5
_SMALL_IS_BAD = ("fit", "vaf")


def write_summary(
    path: Path, dataset: xr.Dataset, job: Job, timing: dict[str, Any], where: str
) -> None:
    """Write summary.json, which appears whole or not at all.

    Raises:
        InputError: it cannot be written.
    """
    text = json.dumps(summary(dataset, job, timing), indent=1, allow_nan=False)
    with run_directory.whole_file(path, f"{where}: summary.json") as temporary:
        temporary.write_text(text + "\n", encoding="utf-8")


def summary(dataset: xr.Dataset, job: Job, timing: dict[str, Any]) -> dict[str, Any]:
    """Counts by status, quantiles of every result over the elements that are ok, the worst."""
    status = dataset["status"].to_numpy()
    fine = status == OK
    results = {
        str(name): _quantiles(dataset[name], fine)
        for name in dataset.data_vars
        if not str(name).startswith("trajectory_")
    }
    found = {
        "model": job.model.name,
        "elements": int(status.size),
        "status": {word: int(np.count_nonzero(status == k)) for k, word in MEANINGS.items()},
        "axes": {
            n: {"min": float(v.min()), "max": float(v.max()), **_unit(dataset[n])}
            for n in job.design.names
            if (v := _finite(dataset[n].to_numpy())).size
        },
        "results": results,
        "worst": {name: _rows(dataset, job, name, k) for name, k in worst(dataset, job).items()},
        "split": dataset.attrs["split"],
        "timing": timing,
        "versions": dataset.attrs["versions"],
        "seed": dataset.attrs["seed"],
        "notes": dataset.attrs.get("notes", []),
    }
    if "float32_error" in dataset.attrs:
        found["float32_error"] = dataset.attrs["float32_error"]
    return found


def _finite(values: np.ndarray) -> np.ndarray:
    return values[np.isfinite(values)]


def _unit(variable: xr.DataArray) -> dict[str, str]:
    return {"unit": variable.attrs["units"]} if "units" in variable.attrs else {}


def _quantiles(variable: xr.DataArray, fine: np.ndarray) -> dict[str, Any]:
    values = _finite(variable.to_numpy()[fine].astype(np.float64))
    if not values.size:
        return {**_unit(variable), "n": 0}
    q = np.quantile(values, [0.0, 0.05, 0.5, 0.95, 1.0])
    names = ("min", "q05", "median", "q95", "max")
    return {
        **_unit(variable), "n": int(values.size), **dict(zip(names, map(float, q), strict=True))
    }  # fmt: skip


def worst(dataset: xr.Dataset, job: Job, count: int = _WORST) -> dict[str, np.ndarray]:
    """By result, the elements that are ok and worst in it: the largest, or for what agrees with a
    flight the smallest; of several flights the worst one counts."""
    fine = dataset["status"].to_numpy() == OK
    found = {}
    for name, one in job.reduce.items():
        if name not in dataset.data_vars:
            continue
        values = dataset[name].to_numpy().astype(np.float64)
        badness = -values if one.how in _SMALL_IS_BAD else np.abs(values)
        badness = badness.reshape(len(fine), -1).max(axis=1)
        badness = np.where(fine & np.isfinite(badness), badness, -np.inf)
        few = min(count, int(np.count_nonzero(badness > -np.inf)))
        if few:
            top = np.argpartition(badness, -few)[-few:]
            found[name] = top[np.argsort(-badness[top], kind="stable")]
    return found


def _rows(dataset: xr.Dataset, job: Job, name: str, elements: np.ndarray) -> list[dict[str, Any]]:
    values = dataset[name].to_numpy()[elements].tolist()
    axes = {n: dataset[n].to_numpy()[elements].astype(np.float64) for n in job.design.names}
    return [
        {"element": int(k), "value": v, "axes": {n: float(a[i]) for n, a in axes.items()}}
        for i, (k, v) in enumerate(zip(elements, values, strict=True))
    ]
