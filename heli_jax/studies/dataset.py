"""Fits of a study as one Dataset, whose dimensions are the study's axes."""

import json
import math
from collections.abc import Mapping, Sequence
from typing import Any, TypeGuard

import numpy as np
import xarray as xr

from heli_jax.config.study import Study
from heli_jax.identification.validation.metrics import Metrics
from heli_jax.numbers import ADEQUATE
from heli_jax.yaml_file import as_yaml

FAILED, NOT_RUN = "failed", "not run"
_TEXT = np.dtypes.StringDType()
_ESTIMATE = {
    "estimate": ("value", "NaN where the data do not determine it"),
    "sd": ("sd", "standard deviation"),
    "low": ("lower95", "lower end of the 95 % interval"),
    "high": ("upper95", "upper end of the 95 % interval"),
}
_NUMBERS = ("n_samples", "steps", "log_likelihood", "aic", "bic")

# Any below: content of fit.json.
Fits = Sequence[Mapping[str, Any] | None]


def dataset(
    study: Study, names: Sequence[str], fits: Fits, versions: Mapping[str, str]
) -> xr.Dataset:
    """Return the Dataset of a study.

    Args:
        names: directories of the fits.
        fits: content of fit.json or failed.json by fit; None if it was not run.
        versions: versions of the packages.
    """
    axes = tuple(study.axes)
    estimates = [_estimates(fit) for fit in fits]
    parameters = list(dict.fromkeys(name for by_name in estimates for name in by_name))
    units = [_unit(name, estimates) for name in parameters]

    def over_fits(values: Sequence[Any], dtype: Any, further: tuple[int, ...] = ()) -> np.ndarray:
        return np.array(list(values), dtype).reshape(*study.shape, *further)

    coordinates: dict[str, Any] = {
        key: (key, _coordinate(values)) for key, values in study.axes.items()
    }
    coordinates["parameter"] = ("parameter", np.array(parameters, _TEXT))
    coordinates["unit"] = ("parameter", np.array(units, _TEXT))
    variables: dict[str, Any] = {}
    for name, (key, words) in _ESTIMATE.items():
        numbers = [[_of(by_name, p, key) for p in parameters] for by_name in estimates]
        values = over_fits(numbers, float, (len(parameters),))
        variables[name] = ((*axes, "parameter"), values, {"long_name": words})
    texts = {
        "status": [NOT_RUN if f is None else str(f.get("status", FAILED)) for f in fits],
        "verdict": [str(f["verdict"]["text"]) if _is_fit(f) else "" for f in fits],
        "untrusted": [", ".join(f["untrusted"]) if _is_fit(f) else "" for f in fits],
        "adequate": ["" if not _is_fit(f) else ADEQUATE[f["adequate"]] for f in fits],
        "sentence": ["" if fit is None else str(fit.get("sentence", "")) for fit in fits],
        "run": [f"fits/{name}" for name in names],
    }
    for name, values in texts.items():
        variables[name] = (axes, over_fits(values, _TEXT), {"long_name": _WORDS[name]})
    for name in _NUMBERS:
        values = [_number(fit.get(name)) if _is_fit(fit) else math.nan for fit in fits]
        variables[name] = (axes, over_fits(values, float))
    outputs = list(dict.fromkeys(o for f in fits for part in _PARTS for o in _metrics(f, part)))
    coordinates["output"] = ("output", np.array(outputs, _TEXT))
    for part, prefix in _PARTS.items():
        # Without a held-out flight, these variables would be empty.
        if prefix and not any(_metrics(f, part) for f in fits):
            continue
        for field in Metrics._fields:
            numbers = [
                [_number(_metrics(f, part).get(o, {}).get(field)) for o in outputs] for f in fits
            ]
            values = over_fits(numbers, float, (len(outputs),))
            variables[prefix + field] = ((*axes, "output"), values)
    attributes = {
        "title": f"study of {study.path.stem}",
        "axes": list(axes),
        "configuration": as_yaml(study.content),
        "versions": dict(versions),
    }
    return xr.Dataset(variables, coordinates, attributes)


_PARTS = {"metrics": "", "validation": "held_out_"}
_WORDS = {
    "status": "converged, not-converged, not-identifiable, failed or not run",
    "verdict": "what the data determine",
    "untrusted": "parameters whose intervals may not be used",
    "adequate": "true if the model explains the measured signals",
    "sentence": "why there is no fit",
    "run": "directory of the fit, within the study's",
}


def _coordinate(values: Sequence[Any]) -> np.ndarray:
    """Return an axis as numbers if it has only numbers, otherwise as text."""
    if all(isinstance(v, int | float) and not isinstance(v, bool) for v in values):
        return np.asarray(values, None if all(isinstance(v, int) for v in values) else float)
    return np.array([v if isinstance(v, str) else json.dumps(v) for v in values], _TEXT)


def _is_fit(fit: Mapping[str, Any] | None) -> TypeGuard[Mapping[str, Any]]:
    return fit is not None and "status" in fit


def _estimates(fit: Mapping[str, Any] | None) -> dict[str, Mapping[str, Any]]:
    """Return the estimates by name: parameters, and nuisance parameters common to all flights."""
    if not _is_fit(fit):
        return {}
    free = {n: e for n, e in fit["parameters"].items() if not e.get("fixed", False)}
    return free | {n: e for n, e in fit["nuisance"].items() if "/" not in n}


def _of(estimates: Mapping[str, Mapping[str, Any]], parameter: str, key: str) -> float:
    estimate = estimates.get(parameter)
    # fit.json has the optimiser's last value even if it is no estimate.
    if estimate is None or estimate["sd"] is None:
        return math.nan
    return _number(estimate[key])


def _number(value: float | None) -> float:
    return math.nan if value is None else float(value)


def _unit(name: str, estimates: Sequence[Mapping[str, Mapping[str, Any]]]) -> str:
    units = {by_name[name]["unit"] for by_name in estimates if name in by_name}
    return units.pop() if len(units) == 1 else "differs"


def _metrics(fit: Mapping[str, Any] | None, part: str) -> Mapping[str, Any]:
    return fit[part] if _is_fit(fit) else {}
