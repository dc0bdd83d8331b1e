"""Tables of the page and of the terminal: rows of text with headings."""

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from heli_jax import naming, units
from heli_jax.analysis.attitude_responses import Handling
from heli_jax.analysis.handling_qualities import NUMBERS, UNITS, HandlingQualities, Number
from heli_jax.analysis.response_agreement import USUAL_J, ResponseAgreement
from heli_jax.finding import sentences
from heli_jax.flights.flight import in_words
from heli_jax.identification.equation_error.rls import Baseline
from heli_jax.identification.equation_error.start import EquationErrorStart
from heli_jax.identification.identifiability.verdict import Combination
from heli_jax.identification.problem import Problem
from heli_jax.identification.result import Estimate, Fit
from heli_jax.identification.select import Choice, MethodComparison, MethodResult
from heli_jax.identification.uncertainty.comparison import Intervals
from heli_jax.identification.uncertainty.nuts import EFFECTIVE, RHAT, Posterior
from heli_jax.identification.validation.held_out import HeldOutFrequency
from heli_jax.identification.validation.metrics import diverges
from heli_jax.numbers import (
    NOTHING,
    explained_text,
    measured,
    number,
    p_value,
    page_sentence,
    percent,
    relative,
    vaf_percent,
    with_sd,
)
from heli_jax.report.card import Gate, shown
from heli_jax.report.style import pretty
from heli_jax.summaries import NOT_DETERMINED, cells_of
from heli_jax.vehicle import Constant


class Table(NamedTuple):
    """Headings and rows of text; the first column names the row."""

    head: tuple[str, ...]
    rows: list[tuple[str, ...]]


def pairs(content: Mapping[str, object], unit: str = "") -> Table:
    """Return a table of names and values."""
    return Table(
        ("", ""),
        [(n, f"{v:.2f}{unit}" if isinstance(v, float) else str(v)) for n, v in content.items()],
    )


class Bar(NamedTuple):
    """An estimate with its 95 % interval as a bar; ends in percent of the bar's width."""

    name: str
    value: str
    unit: str
    low: float | None
    """None without an interval."""
    high: float | None
    words: str
    """Interval as text."""


class Bars(NamedTuple):
    """The estimates on one axis, as relative deviations from the estimate."""

    rows: tuple[Bar, ...]
    reach: str
    """Half range of the axis; empty without a bar."""


def bars(fit: Fit) -> Bars:
    """Return free parameters and determined combinations with their relative intervals."""
    stopped = fit.status == "not-converged"
    rows = [(n, e, pretty(e.unit)) for n, e in fit.estimates.items()]
    rows += [(c.name, c, pretty(unit_of(fit, c))) for c in determined(fit)]
    parts = []
    for _, e, _ in rows:
        known = not stopped and e.sd is not None and e.value
        ends = [end / e.value - 1.0 for end in (e.lower95, e.upper95) if known and end is not None]
        parts.append(sorted(ends) if len(ends) == 2 and all(map(math.isfinite, ends)) else None)
    most = max((abs(v) for pair in parts if pair for v in pair), default=0.0)
    # Longer bars are cut.
    reach = next((r for r in (0.01, 0.02, 0.05, 0.1, 0.2, 0.5) if most <= r), 1.0)
    placed = []
    for (name, e, unit), pair in zip(rows, parts, strict=True):
        value, _, interval = cells_of(e, stopped=stopped)
        at = (50.0 + 50.0 * min(max(v / reach, -1.0), 1.0) for v in pair or ())
        low, high = at if pair else (None, None)
        placed.append(Bar(name, value, unit, low, high, interval))
    return Bars(tuple(placed), percent(reach, 0) if any(parts) else "")


def determined(fit: Fit) -> Sequence[Combination]:
    """Return the combinations that the data determine; none without an optimum."""
    return () if fit.status == "not-converged" else fit.verdict.combinations


def unit_of(fit: Fit, c: Combination) -> str:
    """Return the SI unit of a combination; empty if an unknown of it has no known unit."""
    every = {**fit.estimates, **fit.nuisance}
    members = {name: every[name].unit for name in c.exponents}
    if not all(unit and units.is_unit(unit) for unit in members.values()):
        return ""
    if c.kind == "sum":
        return next(iter(members.values()))
    return units.of_product(members, c.exponents)


def correlation(fit: Fit) -> list[tuple[str, list[tuple[str, float]]]]:
    """Return rows of the correlation matrix: name, and text and number of each cell."""
    rows = []
    for name, values in zip(fit.verdict.names, fit.verdict.correlation, strict=True):
        # Near 1 five digits are needed for sqrt(1 - r^2).
        numbers = [float(r) if math.isfinite(r) else 0.0 for r in values]
        cells = [(_signed(r, 5 if 0.995 < abs(r) < 1.0 else 2), r) for r in numbers]
        rows.append((name, cells))
    return rows


def parameters(fit: Fit) -> Table:
    """Return the table of the free parameters."""
    head = ("parameter", "estimate", "sd", "sd / value", fit.interval, "unit", "start")
    stopped, rows = fit.status == "not-converged", []
    for name, e in fit.estimates.items():
        share, bound = percent(e.prior_share, 0), "yes" if e.at_bound else "no"
        cells = _cells(e, stopped=stopped)
        row = (name, *cells, pretty(e.unit), number(e.start, 5), share, bound)
        if fit.coloured:
            white = NOTHING if e.sd_white is None else measured(e.sd_white, e.sd_white)[0]
            row = (*row, white)
        rows.append(row)
    return Table((*head, "prior share", "at bound", *["sd if white"] * fit.coloured), rows)


def _cells(e: Estimate | Combination, *, stopped: bool = False) -> tuple[str, str, str, str]:
    """Return value, sd, sd over value and interval."""
    value, sd, interval = cells_of(e, stopped=stopped)
    share = relative(e.sd, e.value) if sd else NOTHING
    return value, sd or NOTHING, share, interval or NOTHING


def _signed(value: float | None, digits: int) -> str:
    return NOTHING if value is None else f"{value:+.{digits}f}".replace("-", "−")


def nuisances(fit: Fit) -> tuple[Table, Table]:
    """Return the tables of gains, time shifts and biases, and of initial states."""
    head = ("unknown", "estimate", "sd", "95 % interval", "unit")
    rows = []
    for name, e in fit.nuisance.items():
        known = e if e.lower95 is not None and e.upper95 is not None else e._replace(sd=None)
        value, sd, _, interval = _cells(known)
        rows.append((name, value, sd, interval, pretty(e.unit)))
    states = [row for row in rows if "/initial " in row[0]]
    return Table(head, [row for row in rows if row not in states]), Table(head, states)


def combinations(fit: Fit) -> Table:
    """Return the table of combinations that the data determine."""
    rows = [(c.name, *_cells(c), pretty(unit_of(fit, c))) for c in determined(fit)]
    return Table(("combination", "estimate", "sd", "sd / value", "95 % interval", "unit"), rows)


_METHODS = {
    "gaussian": "Gaussian",
    "profile": "profile",
    "bootstrap": "bootstrap",
    "nuts": "NUTS",
}


def intervals(comparison: Intervals, fit: Fit) -> Table:
    """Return 95 % intervals by parameter and method."""
    present = [m for m in _METHODS if any(m in by for by in comparison.by_parameter.values())]
    rows = []
    for name, by_method in comparison.by_parameter.items():
        cells = []
        for m in present:
            # The digits are those of the Gaussian sd.
            ends = by_method.get(m, (math.nan, math.nan))
            low, high, _ = measured(fit.estimates[name].sd, *ends)
            cells.append(f"{low} to {high}" if m in by_method else NOTHING)
        rows.append((name, *cells, pretty(fit.estimates[name].unit)))
    return Table(("parameter", *(_METHODS[m] for m in present), "unit"), rows)


def sampling(posterior: Posterior) -> Table:
    """Return the table of NUTS convergence: R-hat, effective draws and divergent steps."""
    rows = [
        (name, f"{c.rhat:.3f}", f"{c.effective:.0f}", NOTHING)
        for name, c in posterior.convergence.items()
    ]
    chains, draws = next(iter(posterior.draws.values())).shape
    worst = (f"{posterior.rhat:.3f}", f"{posterior.effective:.0f}")
    total = f"{posterior.divergent} of {chains * draws}"
    rows.append((f"worst of {chains} chains of {draws} draws", *worst, total))
    rows.append(("expected", f"below {RHAT}", f"above {EFFECTIVE}", "0"))
    return Table(("parameter", "R-hat", "effective draws", "divergent steps"), rows)


def verdict(fit: Fit) -> Table:
    """Return the numbers of the identifiability analysis at start values and estimates."""
    n = len(fit.verdict.names)
    columns = [
        (
            f"{v.rank} of {n}",
            f"{v.rank_without_priors} of {n}",
            number(v.condition, 3),
            ", ".join(number(float(s), 3) for s in v.singular_values),
            "; ".join(f"{p.first}, {p.second}: {_signed(p.correlation, 5)}" for p in v.pairs)
            or "none",
            "; ".join(
                ", ".join(f"{n} {_signed(x, 2)}" for n, x in d.items() if abs(x) > 0.005)
                for d in v.null_directions
            )
            or "none",
        )
        for v in (fit.verdict_before, fit.verdict)
    ]
    names = ("rank", "rank without priors", "condition number", "singular values",
             "strong pairs (correlation beyond 0.99)",
             "directions that are not identifiable (log parameters)")  # fmt: skip
    return Table(
        ("", "at the start values", "at the estimates"), list(zip(names, *columns, strict=True))
    )


def starts(fit: Fit) -> Table:
    """Return the table of starts."""
    names = list(fit.starts[0].start) if fit.starts else []
    missing = {*fit.verdict.undetermined, *fit.verdict.without_effect}
    rows = [
        (
            str(i + 1),
            *(number(s.start[n], 4) for n in names),
            *(NOT_DETERMINED if n in missing else number(s.end[n], 6) for n in names),
            number(s.cost, 7),
            str(s.steps),
            f"optimum {s.optimum}" if s.converged else "failed",
            f"{s.reason}, chosen" if s.chosen else s.reason,
        )
        for i, s in enumerate(fit.starts)
    ]
    ends = [*(f"{n}, start" for n in names), *(f"{n}, end" for n in names)]
    return Table(("", *ends, "cost", "steps", "led to", "run of"), rows)


def agreement(fit: Fit, baseline: Baseline | None) -> Table:
    """Return the metrics of fit, held-out flights and RLS by output."""
    head = ("output", "of", "VAF", "fit", "RMSE", "Theil")
    rows = []
    sources = (
        ("fit, simulated", fit.metrics),
        ("fit, one step ahead", fit.one_step),
        ("held out, simulated", fit.validation),
        (_IN_ONE_PIECE, fit.validation_free_run),
        ("held out, one step ahead", fit.one_step_validation),
        # RLS uses one flight.
        *([(f"RLS ({b.flight})", {b.output: b.metrics})] if (b := baseline) else ()),
    )
    for output in dict.fromkeys([*fit.metrics, *fit.validation]):
        for of, metrics in sources:
            if (m := metrics.get(output)) is None:
                continue
            cells = (
                *(vaf_percent(share) for share in (m.vaf, m.nrmse_fit_percent / 100)),
                number(m.rmse),
                number(m.tic, 3),
            )
            if of == _IN_ONE_PIECE and diverges(m):
                cells = ("diverges", *[NOTHING] * (len(cells) - 1))
            rows.append((output, of, *cells))
    return Table(head, rows)


_IN_ONE_PIECE = "held out, in one piece"


def responses(agreement: ResponseAgreement | None) -> Table | None:
    """Return the agreement of fitted frequency responses; None for other methods."""
    if agreement is None:
        return None
    usual = f"J (usual: < {USUAL_J:g})"
    head = ("response", "Hz", "lines", "coherence", "chi-squared", usual)
    rows = [
        (
            f"{p.input} to {p.output}",
            f"{number(p.low, 2)} to {number(p.high, 2)}",
            f"{p.lines}/{p.of}",
            number(p.coherence, 2),
            number(p.chi_squared, 3),
            number(p.J, 3) if math.isfinite(p.J) else NOTHING,
        )
        for p in agreement.pairs
        if p.lines
    ]
    between = f"{number(agreement.lower95, 3)} to {number(agreement.upper95, 3)}"
    rows.append(("all together", "", "", "", number(agreement.chi_squared, 3), ""))
    rows.append(("expected", "", "", "", between, ""))
    return Table(head, rows)


def held_out_flights(held: HeldOutFrequency | None) -> Table | None:
    """Return estimates and explained shares of held-out flights; None if there are none."""
    if held is None or not held.flights:
        return None
    rows = []
    for f in held.flights:
        p = NOTHING
        if f.estimates_p_value is not None:
            words = f"{'differ' if f.differs else 'agree'} (p {p_value(f.estimates_p_value)})"
            p = page_sentence(words)
        parts = (f"{n} {explained_text(v)}" for n, v in f.explained.items())
        rows.append((f.flight, p, ", ".join(parts) or NOTHING))
    return Table(("flight, held out", "its own estimates", "explained"), rows)


def choice(selection: Choice) -> Table:
    """Return the candidate models, best AIC first."""
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


def acceptance(gates: tuple[Gate, ...]) -> Table:
    """Return the acceptance card: name, subject, value, limit, passed or failed."""
    rows = [
        (g.what, g.of, page_sentence(shown(g)), g.gate, "✓ passed" if g.passed else "✗ failed")
        for g in gates
    ]
    return Table(("", "of", "value", "gate", ""), rows)


def residuals(fit: Fit, problem: Problem) -> Table:
    """Return noise and whiteness by flight and output."""
    # Signals of held-out flights follow those of the fitted ones.
    stated = {
        f"{s.flight}/{name}": sd
        for s, f in zip(fit.signals, problem.training, strict=False)
        for name, sd in f.sd.items()
    }
    rows = []
    for name, w in fit.whiteness.items():
        output = name.rsplit("/", 1)[-1]  # a flight's name may contain slashes too
        unit = pretty(naming.unit(problem.model.Outputs, output))
        sd = number(fit.noise.get(name), 3), number(stated.get(name), 3)
        rows.append(
            (
                name,
                *sd,
                unit,
                "yes" if w.white else "no",
                number(w.p_value, 2),
                percent(w.outside, 1),
                _signed(w.lag1, 3),
            )
        )
    head = ("flight/output", "residual sd", "stated sd", "unit", "white", "p-value", "lags outside")
    return Table((*head, "at one sample"), rows)


def baseline_ratios(fit: Fit, baseline: Baseline) -> Table:
    """Return the ratios of RLS, such as a/Ixx, beside those of the fit."""
    rows = []
    for name, value in baseline.combinations.items():
        cells = (NOT_DETERMINED, NOTHING)
        if (found := _ratio(fit, name)) is not None:
            ratio, sd = found
            off = percent(value / ratio - 1.0, 1) if ratio else NOTHING
            cells = (with_sd(ratio, sd) if sd > 0 else number(ratio, 6), off)
        rows.append((name, number(value), *cells))
    return Table(("ratio", "RLS", "fit", "RLS against fit"), rows)


def _ratio(fit: Fit, name: str) -> tuple[float, float] | None:
    """Return the ratio `x/y` of parameters and its sd; None if it is not determined or unknown."""
    v, params = fit.verdict, naming.asdict(fit.params)
    if (stated := next((c for c in v.combinations if c.name == name), None)) is not None:
        return stated.value, stated.sd
    over, _, under = name.partition("/")
    if not {over, under} <= params.keys() or {over, under} & {*v.undetermined, *v.without_effect}:
        return None
    free = {n: fit.estimates[n] for n in (over, under) if n in fit.estimates}
    if not free or any(e.sd is None for e in free.values()):
        return None
    values = {n: free[n].value if n in free else float(params[n]) for n in (over, under)}
    if not all(value > 0.0 for value in values.values()):
        return None
    # The sd of the logarithm includes the correlation.
    at = [v.names.index(n) for n in free]
    signs = np.array([1.0 if n == over else -1.0 for n in free])
    logs = signs * [(e.sd or 0.0) / values[n] for n, e in free.items()]
    ratio = values[over] / values[under]
    return ratio, ratio * math.sqrt(max(float(logs @ v.correlation[np.ix_(at, at)] @ logs), 0.0))


def baseline_facts(b: Baseline) -> Table:
    """Return the facts of the recursive least squares."""
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


def first_guess(start: EquationErrorStart) -> Table:
    """Return the table of start values, with the method that found each."""
    rows = []
    for name, v in start.values.items():
        rows.append((name, number(v.value, 4), v.unit, v.origin))
    return Table(("parameter", "start", "unit", "from"), rows)


def methods(comparison: MethodComparison) -> Table:
    """Return estimates with 95 % intervals by method, and differences in joint sd."""
    main, *others = comparison.results
    head = ["", main.label]
    verdicts, times = ["verdict", main.word], ["time", _seconds(main)]
    for other in others:
        head += [other.label, "difference [joint sd]"]
        verdicts += [other.word, ""]
        times += [_seconds(other), ""]
    rows = []
    for name in comparison.names:
        cells = [name, _by_method(comparison.estimate(main, name))]
        for other in others:
            d = comparison.difference(other, name)
            cells += [_by_method(comparison.estimate(other, name)), _signed(d, 1)]
        rows.append(tuple(cells))
    return Table(tuple(head), [*rows, tuple(verdicts), tuple(times)])


def _by_method(e: Estimate | None) -> str:
    """Return an estimate as `0.02403 (0.02395 to 0.02411)`."""
    if e is None:
        return NOTHING
    value, _, _, interval = _cells(e)
    return value if e.sd is None else f"{value} ({interval})"


def _seconds(result: MethodResult) -> str:
    return f"{result.seconds:.1f} s" if result.fit is not None else NOTHING


_WORDS = {
    "bandwidth": "bandwidth",
    "phase_bandwidth": "phase bandwidth",
    "gain_bandwidth": "gain bandwidth",
    "w180": "ω₁₈₀",
    "phase_delay": "phase delay",
    "phase_delay_line": "phase delay by the line",
    "crossover": "crossover",
    "phase_margin": "phase margin",
    "gain_margin": "gain margin",
}
_NO_RESULT = "the parameters in it are not determined or not trusted, or no optimum was reached."
_AS_READ = {"s": ("ms", 1e3)}
"""Displayed unit by SI unit, with its factor."""


def handling(entries: Sequence[Handling]) -> Table:
    """Return a row for each number of each response."""
    sources = _sources(entries)
    rows = []
    for entry in entries:
        for name in NUMBERS[entry.pair.kind]:
            cells = (_cell(getattr(entry, s), name) for s in sources)
            rows.append((entry.pair.words, _WORDS[name], *cells, _unit(name)[0]))
    return Table(("response", "", *sources, "unit"), rows)


def _sources(entries: Sequence[Handling]) -> tuple[str, ...]:
    return tuple(s for s in ("model", "data") if any(getattr(e, s) is not None for e in entries))


def _cell(of: HandlingQualities | str | None, name: str) -> str:
    value = of.numbers.get(name) if isinstance(of, HandlingQualities) else None
    if value is None or not value.known:
        return NOT_DETERMINED
    hz = f", {number(value.value / (2.0 * np.pi), 3)} Hz" if UNITS[name] == "rad/s" else ""
    return _shown(value, _unit(name)[1]) + hz


def _unit(name: str) -> tuple[str, float]:
    return _AS_READ.get(UNITS[name], (UNITS[name], 1.0))


def _shown(n: Number, times: float) -> str:
    value, low, high, _ = measured(
        times * n.sd, *(times * v for v in (n.value, n.lower95, n.upper95))
    )
    return f"{value} ({low} to {high})"


def handling_sentences(entries: Sequence[Handling]) -> list[str]:
    """Explain missing numbers of handling qualities, and give cautions."""
    remarks = []
    for entry in entries:
        for source in _sources(entries):
            of = getattr(entry, source)
            sentences = (of,) if isinstance(of, str) else () if of is None else of.sentences
            if isinstance(of, HandlingQualities) and not all(n.known for n in of.numbers.values()):
                sentences = (*sentences, _NO_RESULT)
            remarks += [f"{entry.pair.words}, {source}: {s}" for s in sentences]
    return remarks


def origins(fit: Fit, problem: Problem) -> list[tuple[str, Table, list[str]]]:
    """Return name, facts and notes of each flight, fitted ones first."""
    flights = [*problem.training, *(f for f in problem.flights if f.hold_out)]
    listed = []
    for signals, flight in zip(fit.signals, flights, strict=True):
        source, rows = (
            flight.source,
            [
                ("used for", "validation alone" if flight.hold_out else "the fit"),
                ("samples", f"{flight.n_samples} at {1 / flight.dt:g} Hz, {flight.duration:.6g} s"),
            ],
        )
        if source:
            start, end = flight.window
            rows.append(("window", f"{start:.6g} s to {end:.6g} s from the log's beginning"))
            first = f"{source.first_time:.15g} s of the log's own clock"
            rows.append(("log's beginning", first))
        if flight.known:
            values = ", ".join(f"{n} = {number(v, 6)}" for n, v in flight.known.items())
            rows.append(("differs in", values))
        rows += [
            (f"{n} between samples", f"{hold} ({flight.hold_reason.get(n, 'as stated')})")
            for n, hold in flight.hold.items()
        ]
        if source:
            logged = (*source.inputs.items(), *source.outputs.items())
            rows += [(f"{n} in the log", in_words(signal)) for n, signal in logged]
            rows += [("file", source.path), ("sha256", source.sha256)]
        else:
            rows.append(("file", "given in memory, no file"))
        notes = sentences(source.notes) if source else []
        listed.append((signals.flight, Table(("", ""), rows), notes))
    return listed


def constants(problem: Problem, vehicle_constants: Mapping[str, Constant]) -> Table:
    """Return the constants of the vehicle: value [SI], unit, meaning, source."""
    rows = []
    for name, c in vehicle_constants.items():
        unit = naming.unit(problem.model.Params, name) or c.unit
        role = "estimated, this is the file's value" if name in problem.free else "fixed"
        meaning = naming.meaning(problem.model.Params, name)
        rows.append((name, number(c.value, 8), pretty(unit), role, meaning, c.source))
    return Table(("constant", "value", "unit", "in this fit", "meaning", "source"), rows)
