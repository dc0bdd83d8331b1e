"""Tables of the agreement: metrics, model selection, the acceptance card, residuals."""

import math
from collections.abc import Iterator, Mapping

from heli_jax import naming
from heli_jax.analysis.response_agreement import USUAL_J, ResponseAgreement
from heli_jax.identification.equation_error.baseline import Baseline
from heli_jax.identification.model_selection import Choice
from heli_jax.identification.problem import Problem
from heli_jax.identification.result import Fit
from heli_jax.identification.validation.held_out_agreement import HeldOutFrequency
from heli_jax.identification.validation.metrics import Metrics, Whiteness, diverges
from heli_jax.numbers import (
    NOTHING,
    explained_text,
    number,
    p_value,
    page_sentence,
    percent,
    vaf_percent,
)
from heli_jax.report.card import Gate, shown
from heli_jax.report.tables.table import Table
from heli_jax.report.unit_symbols import pretty


def agreement(
    fit: Fit, baseline: Baseline | None, logged: Mapping[str, tuple[str, float]] | None = None
) -> Table:
    """The same metrics for fit, held-out flights and RLS, output by output.

    Args:
        fit: the fit.
        baseline: the RLS, where there is one.
        logged: by output the unit of its log, and what SI is times to be in it.
    """
    head = ("output", "of", "VAF", "fit", "RMSE", "Theil")
    rows, units = [], logged or {}
    # An output may have been measured in the flights held out alone.
    for output in dict.fromkeys([*fit.metrics, *fit.validation]):
        for of, m in _metrics(fit, baseline, output):
            row = (output, of, *_cells(m))
            if of == _IN_ONE_PIECE and diverges(m):
                # Its numbers grow with the length of the record: they would say nothing of the
                # model.
                rows.append((*row[:2], "diverges", *[NOTHING] * 3, *([NOTHING] if units else ())))
                continue
            unit, factor = units.get(output, ("", math.nan))
            rows.append((*row, *([f"{number(m.rmse * factor)} {unit}".strip()] if units else ())))
    return Table((*head, "RMSE as logged") if units else head, rows)


_IN_ONE_PIECE = "held out, in one piece"


def _metrics(fit: Fit, baseline: Baseline | None, output: str) -> Iterator[tuple[str, Metrics]]:
    """The metrics of an output that there are, in words of what."""
    sources = (
        ("fit, simulated", fit.metrics),
        ("fit, one step ahead", fit.one_step),
        ("held out, simulated", fit.validation),
        (_IN_ONE_PIECE, fit.validation_free_run),
        ("held out, one step ahead", fit.one_step_validation),
    )
    yield from ((of, metrics[output]) for of, metrics in sources if output in metrics)
    if baseline is not None and baseline.output == output:
        # With its flight, since it saw that one alone and the fit all.
        yield f"RLS ({baseline.flight})", baseline.metrics


def _cells(m: Metrics) -> tuple[str, ...]:
    fit_percent = vaf_percent(m.nrmse_fit_percent / 100)
    return (vaf_percent(m.vaf), fit_percent, number(m.rmse), number(m.tic, 3))


def responses(agreement: ResponseAgreement | None) -> Table | None:
    """The model's frequency responses against the measured ones, where these were fitted."""
    if agreement is None:
        return None
    usual = f"J (usual: < {USUAL_J:g})"
    head = ("response", "Hz", "lines", "coherence", "chi-squared", usual, "model")
    rows = [
        (
            f"{p.input} to {p.output}",
            f"{number(p.low, 2)} to {number(p.high, 2)}",
            f"{p.lines}/{p.of}",
            number(p.coherence, 2),
            number(p.chi_squared, 3),
            number(p.J, 3) if math.isfinite(p.J) else NOTHING,
            "in windows" if p.simulated else "in windows, ends free",
        )
        for p in agreement.pairs
        if p.lines
    ]
    between = f"{number(agreement.lower95, 3)} to {number(agreement.upper95, 3)}"
    rows.append(("all together", "", "", "", number(agreement.chi_squared, 3), "", ""))
    rows.append(("expected", "", "", "", between, "", ""))
    return Table(head, rows)


def held_out_flights(held: HeldOutFrequency | None) -> Table | None:
    """By flight held out what it says in frequency; None where nothing was asked."""
    if held is None or not held.flights:
        return None
    # Of responses no share is asked for, and a column of dashes says nothing.
    shares = any(f.responses is None for f in held.flights)
    rows = []
    for f in held.flights:
        p = NOTHING
        if f.estimates_p_value is not None:
            words = f"{'differ' if f.differs else 'agree'} (p {p_value(f.estimates_p_value)})"
            p = page_sentence(words)
        parts = (f"{n} {explained_text(v)}" for n, v in f.explained.items())
        between = f"{number(f.lower95, 3)} to {number(f.upper95, 3)}"
        explained = (", ".join(parts) or NOTHING,) if shares else ()
        rows.append((f.flight, number(f.chi_squared, 3), between, p, *explained))
    head = ("flight, held out", "chi-squared", "expected", "its own estimates")
    return Table((*head, "explained") if shares else head, rows)


def held_out_bands(held: HeldOutFrequency | None) -> Table | None:
    """By output and band the errors of the flights held out; None where there are none."""
    if held is None or not held.bands:
        return None
    rows = [
        (
            b.output,
            f"{number(b.low, 2)} to {number(b.high, 2)}",
            number(b.chi_squared, 3),
            f"{number(b.lower95, 3)} to {number(b.upper95, 3)}",
        )
        for b in held.bands
    ]
    return Table(("output, held out", "Hz", "chi-squared", "expected"), rows)


def choice(selection: Choice) -> Table:
    """The models compared, best AIC first."""
    # Differences from the best: the criteria themselves grow with the record and mean nothing.
    best_aic = min(c.aic for c in selection.candidates)
    best_bic = min(c.bic for c in selection.candidates)
    rows = [
        (
            c.name,
            f"{c.log_likelihood:.1f}".replace("-", "−"),
            str(c.unknowns),
            f"{c.aic - best_aic:.1f}",
            f"{c.bic - best_bic:.1f}",
            "yes" if c.white else "no",
            c.status,
        )
        for c in selection.candidates
    ]
    head = ("model", "log-likelihood", "unknowns", "AIC above", "BIC above", "white", "status")
    return Table(head, rows)


def acceptance(lines: tuple[Gate, ...]) -> Table:
    """The acceptance card: what, of what, value, gate, passed or failed, remark."""
    words = {True: "✓ passed", False: "✗ failed", None: NOTHING}
    rows = [
        (g.what, g.of, page_sentence(shown(g)), g.gate or NOTHING, words[g.passed], g.remark)
        for g in lines
    ]
    return Table(("", "of", "value", "gate", "", "remark"), rows)


def residuals(fit: Fit, problem: Problem) -> Table:
    """Noise and whiteness of every flight and output."""
    # strict=False: behind the signals of the fitted flights come those held out, without noise.
    stated = {
        f"{s.flight}/{name}": sd
        for s, f in zip(fit.signals, problem.training, strict=False)
        for name, sd in f.sd.items()
    }
    rows = []
    for name, w in fit.whiteness.items():
        output = name.rsplit("/", 1)[-1]  # a flight's name may hold slashes as well
        unit = pretty(naming.unit(problem.model.Outputs, output))
        sd = number(fit.noise.get(name), 3), number(stated.get(name), 3)
        rows.append((name, *sd, unit, *_whiteness(w)))
    head = ("flight/output", "residual sd", "stated sd", "unit", "white", "p-value", "lags outside")
    return Table((*head, "at one sample"), rows)


def _whiteness(w: Whiteness) -> tuple[str, ...]:
    # With a minus sign, not a hyphen, as everywhere on the page.
    lag1 = f"{w.lag1:+.3f}".replace("-", "−")
    return ("yes" if w.white else "no", number(w.p_value, 2), percent(w.outside, 1), lag1)
