"""Tables of the agreement: metrics, model selection, the acceptance card, residuals."""

from heli_jax import naming
from heli_jax.analysis.response_agreement import USUAL_J
from heli_jax.identification.equation_error.baseline import Baseline
from heli_jax.identification.model_selection import Choice
from heli_jax.identification.problem import Problem
from heli_jax.identification.result import Fit
from heli_jax.identification.validation.metrics import Metrics, Whiteness, diverges
from heli_jax.numbers import NOTHING, number, percent
from heli_jax.report.card import Gate, shown
from heli_jax.report.tables.table import Table
from heli_jax.report.unit_symbols import pretty


def agreement(fit: Fit, baseline: Baseline | None) -> Table:
    """The same metrics for fit, held-out flights and RLS, output by output."""
    head = ("output", "of", "VAF", "fit", "RMSE", "Theil")
    rows = []
    # An output may have been measured in the flights held out alone.
    for output in dict.fromkeys([*fit.metrics, *fit.validation]):
        if output in fit.metrics:
            rows.append(_agreement(output, "fit, simulated", fit.metrics[output]))
        if output in fit.one_step:
            rows.append(_agreement(output, "fit, one step ahead", fit.one_step[output]))
        if output in fit.validation:
            rows.append(_agreement(output, "held out, simulated", fit.validation[output]))
        if output in fit.validation_free_run:
            run = fit.validation_free_run[output]
            row = _agreement(output, "held out, in one piece", run)
            # Its numbers grow with the length of the record: they would say nothing of the model.
            rows.append((*row[:2], "diverges", *[NOTHING] * 3) if diverges(run) else row)
        if output in fit.one_step_validation:
            one_step = fit.one_step_validation[output]
            rows.append(_agreement(output, "held out, one step ahead", one_step))
        if baseline is not None and baseline.output == output:
            # With its flight, since it saw that one alone and the fit all.
            rows.append(_agreement(output, f"RLS ({baseline.flight})", baseline.metrics))
    return Table(head, rows)


def _agreement(output: str, of: str, m: Metrics) -> tuple[str, ...]:
    fit_percent = percent(m.nrmse_fit_percent / 100)
    return (output, of, percent(m.vaf, 3), fit_percent, number(m.rmse), number(m.tic, 3))


def responses(fit: Fit) -> Table | None:
    """The model's frequency responses against the measured ones, where these were fitted."""
    agreement = fit.responses
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
            number(p.chi_squared, 2),
            number(p.J, 3),
            "in windows" if p.simulated else "in windows, ends free",
        )
        for p in agreement.pairs
        if p.lines
    ]
    between = f"{number(agreement.lower95, 2)} to {number(agreement.upper95, 2)}"
    rows.append(("all together", "", "", "", number(agreement.chi_squared, 2), "", ""))
    rows.append(("expected", "", "", "", between, "", ""))
    return Table(head, rows)


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
    rows = [(g.what, g.of, shown(g), g.gate or NOTHING, words[g.passed], g.remark) for g in lines]
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
