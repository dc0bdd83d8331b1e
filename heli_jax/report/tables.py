"""What the report's page says, as words and as rows of text; the page itself is the template."""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from heli_jax import naming
from heli_jax.flights.flight import Flight
from heli_jax.identification.equation_error.baseline import Baseline
from heli_jax.identification.fit import Estimate, Fit
from heli_jax.identification.identifiability.analysis import ILL_CONDITIONED
from heli_jax.identification.identifiability.sentences import listed
from heli_jax.identification.identifiability.verdict import Verdict
from heli_jax.identification.model_selection import Choice
from heli_jax.identification.problem import Problem
from heli_jax.identification.uncertainty.comparison import Intervals
from heli_jax.identification.validation.metrics import Metrics, diverges
from heli_jax.numbers import NOTHING, measured, number, percent, relative, with_sd
from heli_jax.report.card import Gate, shown
from heli_jax.report.files import adequate_unjudged, whiteness_note
from heli_jax.report.style import pretty
from heli_jax.vehicle import Constant, of_helicopter

NOT_DETERMINED = "not determined"


class Table(NamedTuple):
    """Heads and rows of text; the first column names the row."""

    head: tuple[str, ...]
    rows: list[tuple[str, ...]]


class Headline(NamedTuple):
    """The verdict in one line."""

    level: str
    """good, warning or bad"""
    word: str
    text: str


def headline(fit: Fit) -> Headline:
    """Did the optimiser arrive; what do the data determine; is the model adequate."""
    level, word, text = _determined(fit)
    if not fit.adequate:
        worst = fit.adequacy.less_than_mean or level == "bad"
        level = "bad" if worst else "warning"
    if fit.adequacy.doubtful and level == "good":
        level = "warning"
    return Headline(level, word, f"{text}; adequate: {adequate(fit)}")


def adequate(fit: Fit) -> str:
    """`yes`, `no (...)`; what stopped before an optimum and looks adequate was not judged."""
    return "not judged" if adequate_unjudged(fit) else fit.adequacy.summary


def _determined(fit: Fit) -> Headline:
    """The status in words: what the data determine, and whether that may be believed."""
    v, names = fit.verdict, tuple(fit.estimates)
    if fit.status == "not-converged":
        text = "the optimiser stopped before an optimum; the numbers below are where it stopped"
        return Headline("bad", "not converged", text)
    if fit.status == "not-identifiable":
        lost = [n for n in v.names if n in v.undetermined or n in v.without_effect]
        text = f"the data do not determine {listed(lost or list(v.names))}"
        return Headline("bad", "converged, not identifiable", text)
    resting = bool(v.resting)
    who = "the data and the priors together" if resting else "the data"
    text = f"{who} determine {listed(names)}"
    doubts = [
        ("the intervals are too narrow", fit.overconfident),
        ("the residuals are not white", fit.coloured and not fit.white),
        ("residuals of outputs are correlated", fit.coloured and fit.white),
        ("they are hardly separated", v.condition > ILL_CONDITIONED or bool(v.pairs)),
        ("an estimate is at its bound", any(e.at_bound for e in fit.estimates.values())),
    ]
    said = [words for words, is_so in doubts if is_so]
    if said:
        text += f", but {listed(said)}"
    return Headline("warning" if said or resting else "good", "converged", text)


def warnings(fit: Fit) -> list[str]:
    """What a reader has to know before the numbers."""
    note = whiteness_note(fit)
    return ([note] if note else []) + list(fit.notes)


def model_remark(problem: Problem) -> str:
    """Why an inertia found here is a number of the paper's model; empty for other models."""
    if not of_helicopter(problem.model.Params):
        return ""
    factor = float(np.asarray(problem.vehicle.cyclic_moment))
    return (
        "Ixx and If are numbers of the paper's model, not of the machine: eqs 14-15 have the "
        f"factor 1/2 (cyclic_moment, here {factor:g}) where blade-element theory averaged over a "
        "turn gives 1/8 for two blades, and the inertia that is found grows and shrinks with it. "
        "Compare an estimate with a weighed or swung inertia only with that in mind."
    )


def parameters(fit: Fit) -> Table:
    """The free parameters; where the data do not determine one, that is said in place of it."""
    head = ("parameter", "estimate", "sd", "sd / value", fit.interval, "unit", "start")
    rows = [_estimate(n, e) for n, e in fit.estimates.items()]
    if fit.coloured:
        rows = [
            (*row, NOTHING if e.sd_white is None else measured(e.sd_white, e.sd_white)[0])
            for row, e in zip(rows, fit.estimates.values(), strict=True)
        ]
        return Table((*head, "prior share", "at bound", "sd if white"), rows)
    return Table((*head, "prior share", "at bound"), rows)


def _estimate(name: str, e: Estimate) -> tuple[str, ...]:
    start, share = number(e.start, 5), percent(e.prior_share, 0)
    bound = "yes" if e.at_bound else "no"
    if e.sd is None or e.lower95 is None or e.upper95 is None:
        return (name, NOT_DETERMINED, *[NOTHING] * 3, pretty(e.unit), start, share, bound)
    value, low, high, sd = measured(e.sd, e.value, e.lower95, e.upper95)
    interval = f"{low} to {high}"
    share_sd = relative(e.sd, e.value)
    return (name, value, sd, share_sd, interval, pretty(e.unit), start, share, bound)


class Nuisances(NamedTuple):
    """Gains, time shifts and biases; initial states apart, for there may be many."""

    shown: Table
    folded: Table


def nuisances(fit: Fit) -> Nuisances:
    """What was estimated beside the parameters."""
    head = ("unknown", "estimate", "sd", "95 % interval", "unit")
    rows = {n: _nuisance(n, e) for n, e in fit.nuisance.items()}
    folded = [row for n, row in rows.items() if "/initial " in n]
    return Nuisances(
        Table(head, [row for n, row in rows.items() if "/initial " not in n]), Table(head, folded)
    )


def _nuisance(name: str, e: Estimate) -> tuple[str, ...]:
    if e.sd is None or e.lower95 is None or e.upper95 is None:
        return (name, NOT_DETERMINED, NOTHING, NOTHING, pretty(e.unit))
    value, low, high, sd = measured(e.sd, e.value, e.lower95, e.upper95)
    return (name, value, sd, f"{low} to {high}", pretty(e.unit))


def combinations(fit: Fit) -> Table:
    """What the data do determine where they do not determine every parameter."""
    rows = []
    for c in fit.verdict.combinations:
        value, low, high, sd = measured(c.sd, c.value, c.lower95, c.upper95)
        rows.append((c.name, value, sd, relative(c.sd, c.value), f"{low} to {high}"))
    return Table(("combination", "estimate", "sd", "sd / value", "95 % interval"), rows)


def agreement(fit: Fit, baseline: Baseline | None) -> Table:
    """The same metrics for fit, held-out flights and RLS, output by output."""
    head = ("output", "of", "VAF", "fit", "RMSE", "Theil")
    rows = []
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
            rows.append((*row[:2], "diverges", *[NOTHING] * 3) if diverges(run) else row)
        if output in fit.one_step_validation:
            one_step = fit.one_step_validation[output]
            rows.append(_agreement(output, "held out, one step ahead", one_step))
        if baseline is not None and baseline.output == output:
            rows.append(_agreement(output, f"RLS ({baseline.flight})", baseline.metrics))
    return Table(head, rows)


def choice(found: Choice) -> Table:
    """The models compared, best AIC first."""
    best_aic = min(c.aic for c in found.candidates)
    best_bic = min(c.bic for c in found.candidates)
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
        for c in found.candidates
    ]
    head = ("model", "log-likelihood", "unknowns", "AIC above", "BIC above", "white", "status")
    return Table(head, rows)


def intervals(found: Intervals, fit: Fit) -> Table:
    """95 % intervals by parameter and method."""
    methods = ("gaussian", "profile", "bootstrap", "nuts")
    have = [m for m in methods if any(m in by for by in found.by_parameter.values())]
    rows = []
    for name, by in found.by_parameter.items():
        cells = []
        for m in have:
            low, high, _ = measured(fit.estimates[name].sd, *by.get(m, (math.nan, math.nan)))
            cells.append(f"{low} to {high}" if m in by else NOTHING)
        rows.append((name, *cells, pretty(fit.estimates[name].unit)))
    heads = {"gaussian": "Gaussian", "nuts": "NUTS"}
    return Table(("parameter", *(heads.get(m, m) for m in have), "unit"), rows)


def acceptance(lines: tuple[Gate, ...]) -> Table:
    """The acceptance card: what, of what, value, gate, passed or failed, remark."""
    words = {True: "✓ passed", False: "✗ failed", None: NOTHING}
    rows = [(g.what, g.of, shown(g), g.gate or NOTHING, words[g.passed], g.remark) for g in lines]
    return Table(("", "of", "value", "gate", "", "remark"), rows)


def _agreement(output: str, of: str, m: Metrics) -> tuple[str, ...]:
    fit_percent = percent(m.nrmse_fit_percent / 100)
    return (output, of, percent(m.vaf, 3), fit_percent, number(m.rmse), number(m.tic, 3))


def residuals(fit: Fit, problem: Problem) -> Table:
    """Noise and whiteness of every flight and output."""
    stated = {
        f"{s.flight}/{name}": sd
        for s, f in zip(fit.signals, problem.training, strict=False)
        for name, sd in f.sd.items()
    }
    rows = []
    for name, w in fit.whiteness.items():
        output = name.rsplit("/", 1)[-1]
        unit = pretty(naming.unit(problem.model.Outputs, output))
        rows.append(
            (
                name,
                number(fit.noise.get(name), 3),
                number(stated.get(name), 3),
                unit,
                "yes" if w.white else "no",
                number(w.p_value, 2),
                percent(w.outside, 1),
                f"{w.lag1:+.3f}".replace("-", "−"),
            )
        )
    head = ("flight/output", "residual sd", "stated sd", "unit", "white", "p", "lags outside")
    return Table((*head, "at one sample"), rows)


def verdict(fit: Fit) -> Table:
    """The verdict's numbers at the start values and at the estimates."""
    before, after = fit.verdict_before, fit.verdict
    n = len(after.names)

    def singular(v: Verdict) -> str:
        return ", ".join(number(float(s), 3) for s in v.singular_values)

    def pairs(v: Verdict) -> str:
        said = [f"{p.first}, {p.second}: {p.correlation:+.5f}" for p in v.pairs]
        return "; ".join(said).replace("-", "−") or "none"

    def null(v: Verdict) -> str:
        said = [
            ", ".join(f"{n} {x:+.2f}" for n, x in d.items() if abs(x) > 0.005)
            for d in v.null_directions
        ]
        return "; ".join(said).replace("-", "−") or "none"

    rows = [
        ("rank", f"{before.rank} of {n}", f"{after.rank} of {n}"),
        (
            "rank without priors",
            f"{before.rank_without_priors} of {n}",
            f"{after.rank_without_priors} of {n}",
        ),
        ("condition number", number(before.condition, 3), number(after.condition, 3)),
        ("singular values", singular(before), singular(after)),
        ("strong pairs (correlation beyond 0.99)", pairs(before), pairs(after)),
        ("undetermined directions (log coordinates)", null(before), null(after)),
    ]
    return Table(("", "at the start values", "at the estimates"), rows)


def starts(fit: Fit) -> Table:
    """Where every start led."""
    names = list(fit.starts[0].start) if fit.starts else []
    lost = {*fit.verdict.undetermined, *fit.verdict.without_effect}
    rows = [
        (
            str(i + 1),
            *(number(s.start[n], 4) for n in names),
            *(NOT_DETERMINED if n in lost else number(s.end[n], 6) for n in names),
            number(s.cost, 7),
            str(s.steps),
            f"optimum {s.optimum}" if s.converged else "failed",
        )
        for i, s in enumerate(fit.starts)
    ]
    moved = [*(f"{n}, start" for n in names), *(f"{n}, end" for n in names)]
    return Table(("", *moved, "cost", "steps", "led to"), rows)


def baseline_ratios(fit: Fit, baseline: Baseline) -> Table:
    """a/Ixx and the like: as the RLS has them and as the fit has them."""
    rows = []
    for name, value in baseline.combinations.items():
        ours = _ratio(fit, name)
        if ours is None:
            rows.append((name, number(value), NOT_DETERMINED, NOTHING))
            continue
        mean, sd = ours
        off = percent(value / mean - 1.0, 1) if mean else NOTHING
        rows.append((name, number(value), with_sd(mean, sd) if sd > 0 else number(mean, 6), off))
    return Table(("ratio", "RLS", "fit", "RLS against fit"), rows)


def _ratio(fit: Fit, name: str) -> tuple[float, float] | None:
    """Value and sd of `x/y` by the fit; None where it is not determined or not of the model."""
    for c in fit.verdict.combinations:
        if c.name == name:
            return c.value, c.sd
    over, _, under = name.partition("/")
    known = naming.names(type(fit.params))
    if over not in known or under not in known:
        return None
    value = float(getattr(fit.params, over)) / float(getattr(fit.params, under))
    v = fit.verdict
    weights = np.array([(n == over) - float(n == under) for n in v.names])
    lost = {*v.undetermined, *v.without_effect}
    if any(w and n in lost for w, n in zip(weights, v.names, strict=True)):
        return None
    sds = np.array([_relative_sd(fit, n) for n in v.names]) * weights
    return value, abs(value) * math.sqrt(max(0.0, float(sds @ v.correlation @ sds)))


def _relative_sd(fit: Fit, name: str) -> float:
    e = fit.estimates.get(name)
    return e.sd / abs(e.value) if e is not None and e.sd is not None and e.value else 0.0


def baseline_facts(b: Baseline) -> Table:
    """What the recursive least squares found, in full."""
    poles = [_complex(p) for p in sorted(b.poles, key=lambda p: (-abs(p), p.imag))]
    rows = [
        ("from, to", f"{b.input} to {b.output}, {b.flight}"),
        ("order, forgetting", f"{b.order}, {b.forgetting:g}"),
        ("coefficients −a", _polynomial(b.theta[: b.order])),
        ("coefficients b", _polynomial(b.theta[b.order :])),
        ("poles of Hd(z)", ";  ".join(poles)),
    ]
    if b.continuous_num is not None and b.continuous_den is not None:
        kind = "exact inverse of the hold" if b.exact else "not exact"
        rows += [
            (f"H(s), numerator ({kind})", _polynomial(b.continuous_num)),
            (f"H(s), denominator ({kind})", _polynomial(b.continuous_den)),
        ]
    else:
        rows.append(("H(s)", "none"))
    return Table(("", "highest power first"), rows)


def _polynomial(c: np.ndarray) -> str:
    return ",  ".join(number(float(x), 6) for x in c)


def _complex(p: complex) -> str:
    size = f"size {abs(p):.4f}"
    if abs(p.imag) < 1e-12:
        return f"{number(p.real, 5)} ({size})"
    sign = "+" if p.imag > 0 else "−"
    return f"{number(p.real, 5)} {sign} {number(abs(p.imag), 5)}i ({size})"


class Origin(NamedTuple):
    """Where one flight came from."""

    flight: str
    facts: Table
    notes: tuple[str, ...]


def origins(fit: Fit, problem: Problem) -> list[Origin]:
    """The flights, in order: the fitted ones first."""
    flights = [*problem.training, *(f for f in problem.flights if f.hold_out)]
    found = []
    for signals, flight in zip(fit.signals, flights, strict=True):
        rows = [
            ("used for", "validation alone" if flight.hold_out else "the fit"),
            (
                "samples",
                f"{flight.n_samples} at {1 / flight.dt:g} Hz, {flight.duration:.6g} s",
            ),
        ]
        if flight.known:
            known = ", ".join(f"{n} = {number(v, 6)}" for n, v in flight.known.items())
            rows.append(("differs in", known))
        rows += [(f"{n} between samples", words) for n, words in _holds(flight).items()]
        source = flight.source
        rows.append(("file", source.path if source else "given in memory, no file"))
        if source:
            rows.append(("sha256", source.sha256))
        found.append(Origin(signals.flight, Table(("", ""), rows), source.notes if source else ()))
    return found


def _holds(flight: Flight) -> dict[str, str]:
    """By input what it is taken to do between samples, and why."""
    return {
        n: f"{hold} ({flight.hold_reason.get(n, 'as stated')})" for n, hold in flight.hold.items()
    }


def constants(problem: Problem, given: Mapping[str, Constant]) -> Table:
    """The vehicle as it was given: value in SI, unit, meaning, source."""
    rows = []
    for name, c in given.items():
        unit = naming.unit(problem.model.Params, name) or c.unit
        role = "estimated, this is the file's value" if name in problem.free else "fixed"
        meaning = naming.meaning(problem.model.Params, name)
        rows.append((name, number(c.value, 8), pretty(unit), role, meaning, c.source))
    return Table(("constant", "value", "unit", "in this fit", "meaning", "source"), rows)


def pairs(content: Mapping[str, Any], unit: str = "") -> Table:
    """Names and values."""
    return Table(
        ("", ""),
        [(n, f"{v:.2f}{unit}" if isinstance(v, float) else str(v)) for n, v in content.items()],
    )
