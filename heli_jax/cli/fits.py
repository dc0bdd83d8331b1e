"""Terminal and file output of the commands."""

import math
from collections.abc import Mapping, Sequence

from heli_jax import compatibility
from heli_jax.cli.terminal import print_page_table, print_table, print_text
from heli_jax.compatibility import Compatibility
from heli_jax.config.frequency import missing_handling
from heli_jax.finding import Finding, most_severe
from heli_jax.identification.design.accuracy import GUESSED
from heli_jax.identification.diagnostics.record import SMOOTHED
from heli_jax.identification.equation_error.rls import Baseline
from heli_jax.identification.fit import Check, Estimate
from heli_jax.identification.identifiability.verdict import Verdict
from heli_jax.numbers import (
    percent,
    plain_cell,
    plain_words,
    terse,
    vaf_text,
)
from heli_jax.report import tables as report_tables
from heli_jax.report.card import card, summary
from heli_jax.report.fit_page import lines
from heli_jax.report.fitted_responses import NO_RESPONSES
from heli_jax.summaries import cells_of, of_estimates
from heli_jax.workflow import FitRun


def print_fit(run: FitRun, *, verbose: bool = False) -> None:
    """Print the report's first screen: statements, estimates, worst findings; `verbose` adds the
    rest.
    """
    fit = run.fit
    for line in lines(fit):
        print_text(f"{line.word}: {line.text}")
    stopped = fit.status == "not-converged"
    head, rows = of_estimates({**fit.estimates, **_shown_nuisances(fit.nuisance)}, stopped=stopped)
    determined = [
        (c.name, *cells_of(c), report_tables.unit_of(fit, c), "")
        for c in report_tables.determined(fit)
    ]
    print_page_table(
        report_tables.Table((*head[:3], fit.interval, *head[4:]), [*rows, *determined])
    )
    print_findings(fit.findings, verbose=verbose)
    if verbose:
        _print_details(run)
    if run.directory is not None:
        print_text(f"report: {run.directory / 'report.html'}")


def _print_details(run: FitRun) -> None:
    """Print agreement by output, responses, acceptance card, and the requested supplementary
    analyses.
    """
    problem, fit, supplementary = run.problem, run.fit, run.supplementary
    if supplementary.intervals is not None:
        table = report_tables.intervals(supplementary.intervals, fit)
        if table.rows:
            print_page_table(table)
        for sentence in supplementary.intervals.sentences:
            print_text(f"! {sentence}")
    if supplementary.methods is not None:
        side_by_side = report_tables.methods(supplementary.methods)
        print_page_table(side_by_side)
        for sentence in supplementary.methods.sentences:
            print_text(f"! {sentence}")
    print_page_table(report_tables.agreement(fit, None))
    if (held := report_tables.held_out_flights(fit.held_out_frequency)) is not None:
        print_page_table(held)
    _print_handling(run)
    if (responses := report_tables.responses(fit.responses)) is not None:
        print_page_table(responses)
    if problem.first_guess is not None:
        print_text("Start values by equation error (not results):")
        print_page_table(report_tables.first_guess(problem.first_guess))
    gates = card(fit, supplementary.responses)
    print_text(plain_words(f"acceptance card: {summary(gates, _GATES)}"))
    if supplementary.choice is not None:
        compared = report_tables.choice(supplementary.choice)
        print_page_table(compared)
        for sentence in supplementary.choice.sentences:
            print_text(sentence)
    if run.baseline is not None:
        _print_baseline(run.baseline)


def _shown_nuisances(nuisance: Mapping[str, Estimate]) -> dict[str, Estimate]:
    """Return the nuisances that all flights share, and the most significant nonzero offsets of
    inputs.
    """
    # Others of a single flight ('flight/bias') appear only in fit.json and the report. An offset
    # shows that the stick's zero differs from the log's.
    common = {n: e for n, e in nuisance.items() if "/" not in n}
    offsets = {
        n: abs(e.value) / e.sd
        for n, e in nuisance.items()
        if "/offset " in n and e.sd and e.lower95 is not None and e.upper95 is not None
        # The interval excludes zero.
        if e.lower95 * e.upper95 > 0
    }
    most = sorted(offsets, key=lambda n: -offsets[n])[:_MOST_OFFSETS]
    return common | {n: nuisance[n] for n in most}


def _print_handling(run: FitRun) -> None:
    """Print the handling qualities of model and data, and the axes without them."""
    if run.supplementary.responses is None:
        return
    # A stated band or window is a request for responses.
    if run.config.config.frequency is not None:
        for found in run.supplementary.responses.notes:
            if found.code == NO_RESPONSES:
                print_text(f"! {found.sentence}")
    if handling := run.supplementary.responses.handling:
        print_page_table(report_tables.handling(handling))
    logged = {n for f in run.problem.training for n in f.outputs}
    for found in missing_handling(run.config, logged):
        print_text(f"! {found.sentence}")


def print_compatibility(result: Compatibility) -> None:
    """Print the agreement of a log's sensors and their errors on standard output."""
    print_text(result.verdict)
    for found in result.doubts:
        print_text(f"! {found.sentence}")
    head, rows = compatibility.table(result)
    print_table(head, [tuple(map(plain_cell, row)) for row in rows])
    r_squared = ", ".join(f"{n} {r:.4f}" for n, r in result.r_squared.items())
    print_text(f"R2 of the reconstructed signals: {r_squared}")
    assert result.run.directory is not None
    print_text(f"corrections: {result.run.directory / compatibility.FILE}")
    print_text(f"report: {result.run.directory / 'report.html'}")


_MOST_OFFSETS = 4
"""Most offsets of inputs that the terminal shows."""
_GATES = 5
"""Most failed gates that the terminal names; the report has all."""


def _print_baseline(b: Baseline) -> None:
    ratios = ", ".join(f"{n} = {terse(v)}" for n, v in b.combinations.items())
    vaf = (
        f"VAF {vaf_text(b.metrics.vaf, 2)}"
        if math.isfinite(b.metrics.vaf)
        else "its simulation diverges"
    )
    print_text(f"RLS (order {b.order}, {b.output}): {vaf}" + (f"; {ratios}" if ratios else ""))
    for sentence in b.sentences:
        print_text(f"  ! {sentence}")


def print_check(check: Check, *, verbose: bool = False) -> None:
    """Print the identifiability at the initial guess on standard output."""
    verdict = check.verdict
    # The fit's result at its estimates may differ, since sensitivities depend on the parameters.
    print_text("At the start values (a fit repeats this at its estimates):")
    print_text(verdict.text)
    rows, smoothed = [], any(f.code == SMOOTHED for f in check.findings)
    for i, name in enumerate(verdict.names):
        # The covariance is that of the logarithms, so its root is the relative sd.
        relative = math.sqrt(verdict.covariance[i, i])
        lacking = name in verdict.undetermined or name in verdict.without_effect
        expected = f"{terse(100 * relative, 2)} %"
        if name in check.at_zero:
            size, unit = check.at_zero[name]
            expected = f"{terse(size * relative, 2)} {unit}"
        expected = "not determined" if lacking else "-" if smoothed else expected
        rows.append((name, expected, percent(verdict.prior_share[name], 0)))
    print_table(("parameter", "expected sd", "prior share"), rows)
    for name, sd in check.noise.items():
        if verbose or name in check.guessed:
            guess = f" ({GUESSED})" if name in check.guessed else ""
            print_text(f"noise of {name}: {terse(sd, 3)}{guess}")
    if verbose:
        _print_rank(verdict)
    print_text("\nIs this log enough?")
    print_findings(check.findings, verbose=verbose)


def print_findings(findings: Sequence[Finding], *, verbose: bool) -> None:
    """Print the most severe findings in full, and the others by their titles."""
    shown = findings if verbose else most_severe(findings)
    for f in shown:
        print_text(f"{_MARKS[f.severity]} {f.topic}: {f.sentence}")
    rest = [f for f in findings if f not in shown]
    for label, severities in (
        ("also in doubt", ("refuse", "doubt")),
        ("notes", ("note",)),
        ("passed", ("ok",)),
    ):
        subjects: dict[str, dict[str, None]] = {}
        for f in rest:
            if f.severity in severities:
                subjects.setdefault(f.topic, {}).update(dict.fromkeys(f.subjects))
        if subjects:
            each = (f"{t} ({', '.join(of)})" if of else t for t, of in subjects.items())
            print_text(f"  {label}: {', '.join(each)}")


_MARKS = {"ok": " ", "note": "-", "doubt": "!", "refuse": "x"}


def _print_rank(verdict: Verdict) -> None:
    values = ", ".join(terse(s, 3) for s in verdict.singular_values)
    print_text(
        f"rank {verdict.rank} of {len(verdict.names)} ({verdict.rank_without_priors} without "
        f"priors), condition number {terse(verdict.condition, 3)}, singular values {values}"
    )
    for direction in verdict.null_directions:
        words = ", ".join(f"{n} {v:+.4f}" for n, v in direction.items())
        print_text(f"null direction (log coordinates): {words}")
