"""The fits of a study, in the terminal."""

import math
from collections import Counter
from typing import TYPE_CHECKING, Any

import numpy as np

from heli_jax.numbers import rounded, terse
from heli_jax.terminal import print_table, tell

if TYPE_CHECKING:
    import xarray as xr

DONE, NOT_DETERMINED, NOT_CONVERGED = 0, 3, 4  # as of a single fit
_MOST_ROWS = 40
_WIDEST = 24
"""characters of an axis's value"""
_MOST_FAILURES = 10
_NAMED = 3
"""runs that are named of many"""


def exit_code(result: "xr.Dataset") -> int:
    """The exit code of the worst fit."""
    status, adequate, untrusted = (
        set(map(str, result[n].to_numpy().ravel())) for n in ("status", "adequate", "untrusted")
    )
    if status - {"converged", "not-identifiable"} or "no" in adequate:
        return NOT_CONVERGED
    return NOT_DETERMINED if "not-identifiable" in status or untrusted - {""} else DONE


def print_study(result: "xr.Dataset") -> None:
    """The fits of a study as a table, and how their estimates scatter, on standard output.

    Args:
        result: of `run_study`.
    """
    axes, parameters = result.attrs["axes"], [str(p) for p in result["parameter"].to_numpy()]
    # Where every fit failed there is neither a parameter nor an output, and nothing to lay flat.
    empty = [d for d in ("parameter", "output") if not result.sizes[d]]
    flat = result.drop_dims(empty).stack(fit=axes, create_index=False)
    status = [str(s) for s in flat["status"].to_numpy()]
    counts = ", ".join(f"{count} {words}" for words, count in Counter(status).items())
    fits = "1 fit" if len(status) == 1 else f"{len(status)} fits"
    adequate = Counter(str(a) for a in flat["adequate"].to_numpy() if a)
    judged = ", ".join(f"{count} {words}" for words, count in adequate.items())
    tell(f"{fits}: {counts}" + (f"; adequate: {judged}" if judged else ""))
    outputs = [f"fit of {o} [%]" for o in result["output"].to_numpy()]
    rows = []
    for i in range(min(len(status), _MOST_ROWS)):
        one = flat.isel(fit=i)
        at = [_axis(one[axis].item()) for axis in axes]
        estimates = [_measured(one, p) for p in parameters]
        agreement = [_percent(v) for v in one["nrmse_fit_percent"].to_numpy()] if outputs else []
        rows.append((*at, status[i], *estimates, *agreement))
    # One axis alone names no fit: rows of two would look alike in all tables but the first.
    print_table((*axes, "status", *parameters, *outputs), rows, keys=len(axes))
    if len(status) > _MOST_ROWS:
        tell(f"... and {len(status) - _MOST_ROWS} more")
    _print_scatter(flat, parameters)
    for names, runs in _distrusted(flat).items():
        more = f" and {len(runs) - _NAMED} more" if len(runs) > _NAMED else ""
        tell(f"! Not trusted: {names} of {', '.join(runs[:_NAMED])}{more}")
    failures = _failures(flat)
    for run, sentence in failures[:_MOST_FAILURES]:
        tell(f"! {run}: {sentence}")
    if len(failures) > _MOST_FAILURES:
        tell(
            f"! ... and {len(failures) - _MOST_FAILURES} more that failed: `sentence` of study.zarr"
        )


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


def _percent(value: float) -> str:
    return "–" if math.isnan(value) else f"{value:.1f}"


def _print_scatter(flat: "xr.Dataset", parameters: list[str]) -> None:
    """What lies between the fits beside what each of them claims."""
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


def _distrusted(flat: "xr.Dataset") -> dict[str, list[str]]:
    """By the parameters whose intervals are not trusted the fits."""
    by_names: dict[str, list[str]] = {}
    for run, names in zip(flat["run"].to_numpy(), flat["untrusted"].to_numpy(), strict=True):
        if names:
            by_names.setdefault(str(names), []).append(str(run))
    return by_names


def _failures(flat: "xr.Dataset") -> list[tuple[str, str]]:
    pairs = zip(flat["run"].to_numpy(), flat["sentence"].to_numpy(), strict=True)
    return [(str(run), str(words)) for run, words in pairs if words]
