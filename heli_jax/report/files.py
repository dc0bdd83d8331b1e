"""Files of a fit: fit.json and the signals."""

import json
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from heli_jax.finding import Finding, as_data
from heli_jax.flights.write import write_table
from heli_jax.identification.equation_error.rls import Baseline
from heli_jax.identification.fit import Fit, Signals
from heli_jax.identification.problem import Problem
from heli_jax.identification.result import Check
from heli_jax.identification.select import Choice, MethodComparison
from heli_jax.identification.uncertainty.comparison import Intervals
from heli_jax.report.document import FitFile, VerdictContent, plain, written
from heli_jax.report.fitted_responses import FittedResponses


class SensorAgreement(NamedTuple):
    """Agreement of a log's sensors, from `heli-jax compatibility`."""

    compatible: bool
    verdict: str
    doubts: tuple[Finding, ...]
    """Doubts about the detected errors, in addition to the fit's notes."""
    head: tuple[str, ...]
    errors: tuple[tuple[str, ...], ...]
    """One row of text for each error."""


class SupplementaryAnalyses(NamedTuple):
    """Supplementary analyses of a fit: model selection, intervals by other methods, responses."""

    choice: Choice | None = None
    intervals: Intervals | None = None
    methods: MethodComparison | None = None
    """Methods other than the fit's own."""
    responses: FittedResponses | None = None
    """Responses of the model and the flights, with their handling qualities."""
    sensors: SensorAgreement | None = None
    """Only from `heli-jax compatibility`."""


class Analysis(NamedTuple):
    """A fit, and everything that its report needs."""

    fit: Fit
    problem: Problem
    baseline: Baseline | None = None
    supplementary: SupplementaryAnalyses = SupplementaryAnalyses()


def fit_json(
    fit: Fit,
    problem: Problem,
    baseline: Baseline | None,
    supplementary: SupplementaryAnalyses = SupplementaryAnalyses(),
) -> dict[str, Any]:
    """Return a fit as plain data for fit.json; numbers that are not finite are null."""
    # Keys are a public format, read by programs and `load_fit`. Old keys must stay.
    return written(FitFile, Analysis(fit, problem, baseline, supplementary))


def check_json(check: Check) -> dict[str, Any]:
    """Return the result of `heli-jax check` as plain data; a number that is not finite is null."""
    verdict, sd = check.verdict, np.sqrt(np.diag(check.verdict.covariance))
    # A parameter that is not identifiable has no meaningful expected sd.
    lacking = {*verdict.undetermined, *verdict.without_effect}
    pairs = zip(verdict.names, sd, strict=True)
    expected = {name: None if name in lacking else value for name, value in pairs}
    return plain(
        {
            "identifiable": verdict.identifiable,
            "refused": any(f.severity == "refuse" for f in check.findings),
            "expected_relative_sd": expected,
            "prior_share": verdict.prior_share,
            "verdict": written(VerdictContent, verdict),
            "noise_sd": check.noise,
            "noise_guessed": list(check.guessed),
            "findings": [as_data(f) for f in check.findings],
            "log_notes": [as_data(f) for f in check.log_notes],
        }
    )


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Write plain data as readable, strict JSON (no NaN)."""
    path.write_text(as_json(content) + "\n", encoding="utf-8")


def as_json(content: Any) -> str:
    """Return plain data as readable, strict JSON (no NaN)."""
    # Python would write NaN, which is invalid JSON.
    return json.dumps(content, indent=2, allow_nan=False)


def write_signals(path: Path, signals: tuple[Signals, ...]) -> None:
    """Write measurement, simulation and residual of all flights in one table, SI.

    `time` starts at the flight's first sample, `log_time` at the log's beginning, like windows.
    Flights without a log have no `log_time`. Missing signals of a flight are empty cells.
    """
    columns = [_columns(s) for s in signals]
    # Columns of all flights, in the order of their first appearance.
    names = list(dict.fromkeys(name for of_flight in columns for name in of_flight))
    write_table(path, _stacked(columns, names))


def _columns(s: Signals) -> dict[str, Any]:
    """Return the columns of one flight by name."""
    # Every row names its flight, so that table programs can group rows in any order.
    columns: dict[str, Any] = {"flight": [s.flight] * s.times.size, "time": s.times}
    if s.log_start is not None:
        # Rounding removes binary digits: 42 + 0.01 k may be 42.010000000000005.
        columns["log_time"] = np.round(s.log_times, 9)
    columns |= s.inputs
    for output, measured in s.measured.items():
        columns[f"{output}_measured"] = measured
        columns[f"{output}_simulated"] = s.simulated[output]
        columns[f"{output}_residual"] = s.residual(output)
        if s.innovations is not None:
            columns[f"{output}_innovation"] = s.innovations[output]
    return columns


def _stacked(parts: list[dict[str, Any]], names: list[str]) -> dict[str, Any]:
    """Stack tables vertically; a column that a part lacks is empty there.

    `names` are the columns of the result, in order.
    """
    out: dict[str, Any] = {}
    for name in names:
        if all(isinstance(part.get(name), list) for part in parts):
            out[name] = [cell for part in parts for cell in part[name]]
            continue
        if all(name in part for part in parts):
            out[name] = np.concatenate([np.asarray(part[name]) for part in parts])
            continue
        # A list, because no array of numbers holds an empty cell: NaN would be written as a value.
        cells: list[Any] = []
        for part in parts:
            n = len(next(iter(part.values())))
            cells += list(part[name]) if name in part else [None] * n
        out[name] = cells
    return out
