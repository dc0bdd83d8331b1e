"""A fit as files: fit.json and the signals."""

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from heli_jax.analysis.response_agreement import USUAL_J, ResponseAgreement
from heli_jax.flights import Flight
from heli_jax.flights.origins import as_content
from heli_jax.flights.write import stacked, write_table
from heli_jax.identification.equation_error.baseline import Baseline
from heli_jax.identification.equation_error.first_guess import EquationErrorStart
from heli_jax.identification.fit import Estimate, Fit, Signals
from heli_jax.identification.identifiability.verdict import Verdict
from heli_jax.identification.method_comparison import MethodComparison
from heli_jax.identification.methods import estimator_of
from heli_jax.identification.model_selection import Choice
from heli_jax.identification.problem import Problem
from heli_jax.identification.result import Check
from heli_jax.identification.uncertainty.comparison import Intervals
from heli_jax.identification.validation.adequacy import EXPECTED, EXPLAINED, NEARLY_WHITE, Adequacy
from heli_jax.identification.validation.feedback import LEVEL
from heli_jax.identification.validation.finding import Finding
from heli_jax.report.card import card
from heli_jax.report.fitted_responses import FittedResponses
from heli_jax.report.handling_json import handling_json
from heli_jax.report.method_content import frequency_start_content, methods_content
from heli_jax.versions import versions


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
            "model": fit.model,
            "method": fit.method,
            "instruments": list(fit.instruments),
            "n_samples": fit.n_samples,
            "identifiable": fit.verdict.identifiable,
            "adequate": None if adequate_unjudged(fit) else fit.adequate,
            "adequacy": _adequacy(fit.adequacy),
            "null_directions": list(fit.verdict.null_directions),
            "determined_combinations": _combinations(fit.verdict),
            "verdict": _verdict(fit.verdict),
            "verdict_before": _verdict(fit.verdict_before),
            "parameters": {
                **_fixed(problem),
                **{n: _parameter(e) for n, e in fit.estimates.items()},
            },
            "nuisance": {n: _parameter(e) for n, e in fit.nuisance.items()},
            "noise_sd": fit.noise,
            **_metrics(fit),
            "acceptance": [g._asdict() for g in card(problem, fit)],
            "models": _choice(supplementary.choice),
            "methods": methods_content(supplementary.methods),
            "intervals": _intervals(supplementary.intervals),
            "record": [f._asdict() for f in supplementary.findings],
            "log_likelihood": fit.log_likelihood,
            "unknowns": fit.unknowns,
            "aic": fit.aic,
            "bic": fit.bic,
            # The words of the format, with which programs compare: not to be polished.
            "covariance": "coloured residuals" if fit.coloured else "white",
            **_residuals(fit),
            "responses": _responses(fit.responses),
            "baseline_rls": _baseline(baseline),
            "handling_qualities": handling_json(
                supplementary.responses.handling if supplementary.responses else ()
            ),
            "equation_error_start": _first_guess(problem),
            "frequency_error_start": frequency_start_content(problem),
            "starts": [row._asdict() for row in fit.starts],
            "steps": fit.steps,
            "notes": list(fit.notes),
            "timing_s": fit.timing,
            "versions": versions(),
            "data": [_source(f) for f in problem.flights],
            "inputs": [_holds(f) for f in problem.flights],
            "seed": fit.seed,
        }
    )


def _residuals(fit: Fit) -> dict[str, Any]:
    """Whether they are white, and whether inputs follow what they stand for."""
    whiteness = {name: w._asdict() for name, w in fit.whiteness.items()}
    return {
        "residuals": {"white": fit.white, "note": whiteness_note(fit), "by_output": whiteness},
        "feedback": [{**f._asdict(), "present": f.present, "level": LEVEL} for f in fit.feedback],
        "moved_by_feedback": {n: m._asdict() for n, m in fit.moved_by_feedback.items()},
        "held_upright": fit.held_upright,
        "untrusted": list(fit.untrusted),
    }


def _responses(agreement: ResponseAgreement | None) -> dict[str, Any] | None:
    """Measured frequency responses and the model's, where these were fitted."""
    if agreement is None:
        return None
    return {
        **agreement._asdict(),
        "averages": dict(agreement.averages),
        "pairs": [p._asdict() for p in agreement.pairs],
        "usual_J": USUAL_J,
    }


def _first_guess(problem: Problem) -> dict[str, Any] | None:
    """How the starts were found: where the fit began, not its result."""
    guess = problem.first_guess
    # Not the fit's own `starts`: here stands how the first of them was found, with the noise's bias
    # that such values have.
    if not isinstance(guess, EquationErrorStart):
        return None
    selection = guess.selection
    return {
        "values": {n: v._asdict() for n, v in guess.values.items()},
        "equations": [e._asdict() for e in guess.equations],
        "smoothing_half_width_s": guess.half_width,
        "not_measured": list(guess.hidden),
        "stepwise": None
        if selection is None
        else {
            "selected": list(selection.selected),
            "steps": [s._asdict() for s in selection.steps],
            "f_ratios": selection.f_ratios,
        },
        "sentences": list(guess.sentences),
    }


def _metrics(fit: Fit) -> dict[str, Any]:
    return {
        "metrics": {n: m._asdict() for n, m in fit.metrics.items()},
        "validation": {n: m._asdict() for n, m in fit.validation.items()},
        "validation_free_run": {n: m._asdict() for n, m in fit.validation_free_run.items()},
        "one_step": {n: m._asdict() for n, m in fit.one_step.items()},
        "one_step_validation": {n: m._asdict() for n, m in fit.one_step_validation.items()},
    }


def _adequacy(adequacy: Adequacy) -> dict[str, Any]:
    return {
        # With the limits that it was judged against, so that a file can be read without the version
        # that wrote it.
        **adequacy._asdict(),
        "summary": adequacy.summary,
        "judged": [output._asdict() for output in adequacy.judged],
        # The limits of this version: a later one may have others.
        "against": {
            "explained_at_least": EXPLAINED,
            "or_other_than_white_noise_at_most": NEARLY_WHITE,
            "or_power_over_what_the_disturbance_makes_at_most": EXPECTED,
        },
    }


def adequate_unjudged(fit: Fit) -> bool:
    """Whether an adequate look means nothing, since no optimum was reached."""
    return fit.status == "not-converged" and fit.adequate


def _choice(choice: Choice | None) -> dict[str, Any] | None:
    if choice is None:
        return None
    return {
        "candidates": [c._asdict() for c in choice.candidates],
        "nested": [t._asdict() for t in choice.nested],
        "sentences": list(choice.sentences),
    }


def _intervals(comparison: Intervals | None) -> dict[str, Any] | None:
    if comparison is None:
        return None
    content: dict[str, Any] = {
        "by_parameter": comparison.by_parameter,
        "profiles": {n: p._asdict() for n, p in comparison.profiles.items()},
        "sentences": list(comparison.sentences),
    }
    # Of replicates and draws the counts and diagnostics alone: themselves they are megabytes.
    if comparison.bootstrap is not None:
        content["bootstrap_failures"] = comparison.bootstrap.failures
    if comparison.posterior is not None:
        p = comparison.posterior
        content["nuts"] = {
            "rhat": p.rhat,
            "effective": p.effective,
            "divergent": p.divergent,
            "trusted": p.trusted,
        }
    return content


def whiteness_note(fit: Fit) -> str:
    """Why the intervals cannot be taken at their word; empty where the residuals are white."""
    not_white = [name for name, w in fit.whiteness.items() if not w.white]
    if not not_white:
        return ""
    # By the correlation at one sample, which is the number that the sentence gives.
    worst = max((fit.whiteness[n] for n in not_white), key=lambda w: abs(w.lag1))
    estimator = estimator_of(fit.method)
    if estimator.noise_spectrum:
        return (
            f"The residuals in time of {', '.join(not_white)} are not white, as gusts make them: "
            "the noise's spectrum is estimated and the intervals allow for it."
        )
    what, better = estimator.errors, fit.disturbable
    if fit.coloured:
        consequence = (
            "White-noise (Cramer-Rao) intervals would be too narrow; those given allow for the "
            "residuals' autocorrelation"
            + (", which filter-error would use for a better estimate." if better else ".")
        )
    else:
        # Autocorrelated samples repeat one another, so that there are fewer pieces of news than
        # samples.
        consequence = "The intervals count every sample as news and are too narrow."
    return (
        f"The {what} of {', '.join(not_white)} are not white (autocorrelation {worst.lag1:+.2f} "
        f"at one sample, {worst.outside:.0%} of the lags outside the 99 % band): a disturbance or "
        f"dynamics that the model lacks is in them. {consequence}"
    )


def _parameter(e: Estimate) -> dict[str, Any]:
    return {**e._asdict(), "fixed": False}


def _fixed(problem: Problem) -> dict[str, Any]:
    """The parameters a user might look for that were not free: those that flights replace."""
    names = {n for f in problem.flights for n in f.known}
    # A list, since each flight may have a value of its own; null where it has none.
    return {
        n: {"value": [f.known.get(n) for f in problem.flights], "fixed": True}
        for n in sorted(names)
    }


def _combinations(verdict: Verdict) -> list[dict[str, Any]]:
    return [c._asdict() for c in verdict.combinations]


def _verdict(verdict: Verdict) -> dict[str, Any]:
    # The covariance and the correlation have no names of their own: `names` is their order.
    return {
        "text": verdict.text,
        "identifiable": verdict.identifiable,
        "rank": verdict.rank,
        "rank_without_priors": verdict.rank_without_priors,
        "condition_number": verdict.condition,
        "singular_values": verdict.singular_values,
        "null_directions": list(verdict.null_directions),
        "determined_combinations": _combinations(verdict),
        "strong_pairs": [p._asdict() for p in verdict.pairs],
        "without_effect": list(verdict.without_effect),
        "resting_on_priors": list(verdict.resting),
        "exchangeable_nuisances": list(verdict.exchangeable),
        "names": list(verdict.names),
        "correlation": verdict.correlation,
        "covariance_log": verdict.covariance,
    }


def _baseline(b: Baseline | None) -> dict[str, Any] | None:
    if b is None:
        return None
    return {
        "flight": b.flight,
        "input": b.input,
        "output": b.output,
        "order": b.order,
        "forgetting": b.forgetting,
        "theta": b.theta,
        # JSON has no complex numbers: real and imaginary part.
        "poles": [[float(p.real), float(p.imag)] for p in b.poles],
        "continuous": {
            "num": b.continuous_num,
            "den": b.continuous_den,
            "exact": b.exact,
            "note": b.note,
        },
        "combinations": b.combinations,
        "metrics": {b.output: b.metrics._asdict()},
        "trusted": b.trusted,
        "sentences": list(b.sentences),
    }


def _holds(flight: Flight) -> dict[str, dict[str, str]]:
    """By input what it is taken to do between samples, and what of the log spoke for it."""
    reason = flight.hold_reason
    return {n: {"hold": h, "reason": reason.get(n, "as stated")} for n, h in flight.hold.items()}


def _source(flight: Flight) -> dict[str, Any]:
    # A flight that was given in memory: `null`, so that nobody looks for a file.
    if flight.source is None:
        return {
            "path": None,
            "sha256": None,
            "flight": flight.name,
            "hold_out": flight.hold_out,
            "n_samples": flight.n_samples,
            "dt": flight.dt,
        }
    return {
        "path": flight.source.path,
        "sha256": flight.source.sha256,
        "flight": flight.name,
        "hold_out": flight.hold_out,
        "n_samples": flight.n_samples,
        "dt": flight.dt,
        "window": list(flight.window),
        "notes": list(flight.source.notes),
        "signals": {
            "inputs": {n: as_content(s) for n, s in flight.source.inputs.items()},
            "outputs": {n: as_content(s) for n, s in flight.source.outputs.items()},
        },
    }


def check_json(check: Check, log_notes: Sequence[str] = ()) -> dict[str, Any]:
    """What `heli-jax check` found as plain data; what is not a finite number is null.

    Args:
        check: what is known before a fit.
        log_notes: what the reader of each log assumed, a sentence each.
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
            "verdict": _verdict(verdict),
            "noise_sd": check.noise,
            "noise_guessed": list(check.guessed),
            "record": [f._asdict() for f in check.findings],
            "notes": list(check.further_notes),
            "log_notes": list(log_notes),
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

    A flight without some signal has empty cells there.
    """
    # The columns of all flights, in the order in which they first appear.
    names = ["flight", "time"]
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
    for output, measured in s.measured.items():
        columns[f"{output}_measured"] = measured
        columns[f"{output}_simulated"] = s.simulated[output]
        columns[f"{output}_residual"] = s.residual(output)
        if s.innovations is not None:
            columns[f"{output}_innovation"] = s.innovations[output]
    return columns
