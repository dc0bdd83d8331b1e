"""A fit as files: fit.json and the signals."""

import json
import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from heli_jax.finding import Finding, as_data
from heli_jax.flights.write import stacked, write_table
from heli_jax.identification.equation_error.baseline import Baseline
from heli_jax.identification.fit import Fit, Signals
from heli_jax.identification.method_comparison import MethodComparison
from heli_jax.identification.model_selection import Choice
from heli_jax.identification.problem import Problem
from heli_jax.identification.result import Check
from heli_jax.identification.uncertainty.comparison import Intervals
from heli_jax.report import fit_content as content
from heli_jax.report.card import card
from heli_jax.report.fitted_responses import FittedResponses
from heli_jax.report.handling_json import handling_json
from heli_jax.report.method_content import frequency_start_content, methods_content
from heli_jax.versions import versions


class SensorAgreement(NamedTuple):
    """Whether a log's sensors agree: what `heli-jax compatibility` asked of the fit."""

    compatible: bool
    verdict: str
    doubts: tuple[Finding, ...]
    """on the errors that were found, beside the fit's own notes"""
    head: tuple[str, ...]
    errors: tuple[tuple[str, ...], ...]
    """a row of text for each"""


class SupplementaryAnalyses(NamedTuple):
    """What belongs to a fit: model selection, intervals by other methods, what the log is worth."""

    choice: Choice | None = None
    intervals: Intervals | None = None
    findings: tuple[Finding, ...] = ()
    """whether the log is enough, as it was before the fit"""
    methods: MethodComparison | None = None
    """further methods beside the fit's own"""
    responses: FittedResponses | None = None
    """of the model and of the flights, with their handling qualities"""
    sensors: SensorAgreement | None = None
    """of `heli-jax compatibility` alone"""


def fit_json(
    fit: Fit,
    problem: Problem,
    baseline: Baseline | None,
    supplementary: SupplementaryAnalyses = SupplementaryAnalyses(),
) -> dict[str, Any]:
    """A fit as plain data for fit.json; what is not a finite number is null.

    Args:
        fit: the fit.
        problem: what was fitted.
        baseline: the recursive least squares, where there is one.
        supplementary: model selection and further intervals, where they were asked for.
    """
    # Keys are a public format: programs read them, and `load_fit`. Old ones stay.
    return _plain(
        {
            "status": fit.status,
            "exit_code": fit.exit_code,
            "model": fit.model,
            "method": fit.method,
            "instruments": list(fit.instruments),
            "n_samples": fit.n_samples,
            "identifiable": fit.verdict.identifiable,
            "adequate": None if fit.status == "not-converged" else fit.adequate,
            "adequacy": content.adequacy(fit),
            "null_directions": list(fit.verdict.null_directions),
            "determined_combinations": content.combinations(fit.verdict),
            "verdict": content.verdict(fit.verdict),
            "verdict_before": content.verdict(fit.verdict_before),
            "parameters": {
                **content.fixed(problem),
                **{n: content.parameter(e, fit.status) for n, e in fit.estimates.items()},
            },
            "constants": content.constants(fit, problem),
            "nuisance": {n: content.parameter(e, fit.status) for n, e in fit.nuisance.items()},
            "noise_sd": fit.noise,
            **content.metrics(fit),
            "acceptance": [g._asdict() for g in card(problem, fit)],
            "models": content.choice(supplementary.choice),
            "methods": methods_content(supplementary.methods),
            "intervals": content.intervals(supplementary.intervals),
            "record": [as_data(f) for f in supplementary.findings],
            "compatibility": _sensors(supplementary.sensors),
            **content.likelihood(fit),
            # The words of the format, with which programs compare: not to be polished.
            "covariance": "coloured residuals" if fit.coloured else "white",
            **content.residuals(fit),
            "responses": content.responses(fit.responses),
            "held_out_frequency": content.held_out_frequency(fit.held_out_frequency),
            "baseline_rls": content.baseline(baseline),
            "handling_qualities": handling_json(
                supplementary.responses.handling if supplementary.responses else ()
            ),
            "equation_error_start": content.first_guess(problem),
            "frequency_error_start": frequency_start_content(problem),
            "starts": content.starts(fit),
            "steps": fit.steps,
            "findings": [as_data(f) for f in fit.findings],
            **_provenance(fit, problem),
        }
    )


def _sensors(agreement: SensorAgreement | None) -> dict[str, Any] | None:
    if agreement is None:
        return None
    return {
        "compatible": agreement.compatible,
        "verdict": agreement.verdict,
        "doubts": [as_data(f) for f in agreement.doubts],
        "shows": {row[0]: row[agreement.head.index("shows")] for row in agreement.errors},
    }


def _provenance(fit: Fit, problem: Problem) -> dict[str, Any]:
    return {
        "timing_s": fit.timing,
        "versions": versions(),
        "data": [content.source(f) for f in problem.flights],
        "inputs": [content.holds(f) for f in problem.flights],
        "seed": fit.seed,
    }


def check_json(check: Check) -> dict[str, Any]:
    """What `heli-jax check` found as plain data; what is not a finite number is null.

    Args:
        check: what is known before a fit.
    """
    verdict, sd = check.verdict, np.sqrt(np.diag(check.verdict.covariance))
    # Of a parameter that is not determined the number would be no expectation.
    lacking = {*verdict.undetermined, *verdict.without_effect}
    pairs = zip(verdict.names, sd, strict=True)
    expected = {name: None if name in lacking else value for name, value in pairs}
    return _plain(
        {
            "identifiable": verdict.identifiable,
            "refused": any(f.severity == "refuse" for f in check.findings),
            "expected_relative_sd": expected,
            "prior_share": verdict.prior_share,
            "verdict": content.verdict(verdict),
            "noise_sd": check.noise,
            "noise_guessed": list(check.guessed),
            "record": [as_data(f) for f in check.findings],
            "notes": [as_data(f) for f in check.further_notes],
            "log_notes": [as_data(f) for f in check.log_notes],
        }
    )


def _plain(value: Any) -> Any:
    """Only what JSON has; a number that is not finite becomes null."""
    if isinstance(value, dict):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple | np.ndarray):
        return [_plain(v) for v in value]
    if isinstance(value, bool | np.bool_):  # before int: True is one
        return bool(value)
    if isinstance(value, int | np.integer):
        return int(value)
    # Infinite counts as missing too: strict JSON has neither, and a reader has one case to think
    # of.
    if isinstance(value, float | np.floating):
        return float(value) if math.isfinite(value) else None
    return value


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Write plain data, readable and strict (no NaN)."""
    path.write_text(as_json(content) + "\n", encoding="utf-8")


def as_json(content: dict[str, Any]) -> str:
    """Plain data as text, readable and strict (no NaN)."""
    # Python would write NaN, which JSON does not have and other languages refuse to read.
    return json.dumps(content, indent=2, allow_nan=False)


def write_signals(path: Path, signals: tuple[Signals, ...]) -> None:
    """Measured, simulated and residual of all flights in one table, SI.

    `time` counts from the flight's first sample, `log_time` from the log's beginning, as windows
    do; flights without a log have none. A flight without some signal has empty cells there.
    """
    # The columns of all flights, in the order in which they first appear.
    names = ["flight", "time"]
    if any(s.log_start is not None for s in signals):
        names.append("log_time")
    for s in signals:
        names += [n for n in s.inputs if n not in names]
        names += [
            f"{n}_{what}"
            for n in s.measured
            for what in ("measured", "simulated", "residual", "innovation")
            if (what != "innovation" or s.innovations is not None) and f"{n}_{what}" not in names
        ]
    write_table(path, stacked([_columns(s) for s in signals], names))


def _columns(s: Signals) -> dict[str, Any]:
    """The columns of one flight by their names."""
    # The name of the flight in every row: a table program can group by it, whatever the rows'
    # order.
    columns: dict[str, Any] = {"flight": [s.flight] * s.times.size, "time": s.times, **s.inputs}
    if s.log_start is not None:
        # Rounded: 42 + 0.01 k in binary is 42.010000000000005, and nobody's clock has its digits.
        columns["log_time"] = np.round(s.log_times, 9)
    for output, measured in s.measured.items():
        columns[f"{output}_measured"] = measured
        columns[f"{output}_simulated"] = s.simulated[output]
        columns[f"{output}_residual"] = s.residual(output)
        if s.innovations is not None:
            columns[f"{output}_innovation"] = s.innovations[output]
    return columns
