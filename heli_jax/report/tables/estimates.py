"""Tables of the estimates: values and intervals, what the data determine, where starts led."""

import math
from typing import NamedTuple

from heli_jax.identification.identifiability.verdict import Verdict
from heli_jax.identification.problem import Problem
from heli_jax.identification.result import Estimate, Fit
from heli_jax.identification.uncertainty.comparison import Intervals
from heli_jax.identification.uncertainty.nuts import EFFECTIVE, RHAT, Posterior
from heli_jax.numbers import NOTHING, measured, number, percent, relative
from heli_jax.report.tables.table import NOT_DETERMINED, Table
from heli_jax.report.unit_symbols import pretty

_SHARE = 0.005
"""of the posterior variance: less is 0 % in the table, or 0.00"""


def parameters(fit: Fit) -> Table:
    """The free parameters; where the data do not determine one, that is said in place of it."""
    head = ("parameter", "estimate", "sd", "sd / value", fit.interval, "unit", "start")
    stopped = fit.status == "not-converged"
    rows = [_estimate(n, e, stopped=stopped) for n, e in fit.estimates.items()]
    if fit.coloured:
        # What the sd would be if residuals were white, so that the price of their autocorrelation
        # can be seen.
        rows = [
            (*row, NOTHING if e.sd_white is None else measured(e.sd_white, e.sd_white)[0])
            for row, e in zip(rows, fit.estimates.values(), strict=True)
        ]
        return Table((*head, "prior share", "at bound", "sd if white"), rows)
    return Table((*head, "prior share", "at bound"), rows)


def prior_note(problem: Problem, fit: Fit) -> str:
    """Where the prior share of parameters without a prior comes from; empty where there is none."""
    # A prior share without a prior would look like a mistake of the table.
    names = [
        n
        for n, e in fit.estimates.items()
        if problem.free[n].prior is None and e.prior_share >= _SHARE
    ]
    if not names:
        return ""
    others = [n for n, free in problem.free.items() if free.prior is not None]
    of = f"the prior of {' and '.join(others)} and " if others else ""
    return (
        f"{', '.join(names)}: the prior share is that of {of}the weak priors of biases, initial "
        "states and input offsets (ten times the signal)."
    )


def where_it_stopped(e: Estimate) -> str:
    """The cell of an estimate of a fit that did not converge: a number that is no result."""
    return f"{number(e.value, 3)} (no result)" if math.isfinite(e.value) else NOT_DETERMINED


def _estimate(name: str, e: Estimate, *, stopped: bool) -> tuple[str, ...]:
    start, share = number(e.start, 5), percent(e.prior_share, 0)
    bound = "yes" if e.at_bound else "no"
    if stopped:
        at = where_it_stopped(e)
        return (name, at, *[NOTHING] * 3, pretty(e.unit), start, share, bound)
    # Where the optimiser stopped in a direction that nothing determines is an accident: no number.
    if e.sd is None or not math.isfinite(e.sd):
        return (name, NOT_DETERMINED, *[NOTHING] * 3, pretty(e.unit), start, share, bound)
    value, low, high, sd = measured(e.sd, e.value, e.lower95, e.upper95)
    interval = "not trusted" if e.lower95 is None else f"{low} to {high}"
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
    # With windows there is one for each window and state, which would bury the gains and biases.
    folded = [row for n, row in rows.items() if "/initial " in n]
    return Nuisances(
        Table(head, [row for n, row in rows.items() if "/initial " not in n]), Table(head, folded)
    )


def _nuisance(name: str, e: Estimate) -> tuple[str, ...]:
    # An interval without an end says that nothing is known, and a number beside it that something
    # is.
    if e.sd is None or not math.isfinite(e.sd) or e.lower95 is None or e.upper95 is None:
        return (name, NOT_DETERMINED, NOTHING, NOTHING, pretty(e.unit))
    value, low, high, sd = measured(e.sd, e.value, e.lower95, e.upper95)
    return (name, value, sd, f"{low} to {high}", pretty(e.unit))


def combinations(fit: Fit) -> Table:
    """What the data do determine where they do not determine every parameter."""
    rows = []
    # Where no optimum was reached nothing is determined.
    for c in () if fit.status == "not-converged" else fit.verdict.combinations:
        value, low, high, sd = measured(c.sd, c.value, c.lower95, c.upper95)
        rows.append((c.name, value, sd, relative(c.sd, c.value), f"{low} to {high}"))
    return Table(("combination", "estimate", "sd", "sd / value", "95 % interval"), rows)


def intervals(comparison: Intervals, fit: Fit) -> Table:
    """95 % intervals by parameter and method."""
    methods = ("gaussian", "profile", "bootstrap", "nuts")
    present = [m for m in methods if any(m in by for by in comparison.by_parameter.values())]
    rows = []
    for name, by_method in comparison.by_parameter.items():
        cells = []
        for m in present:
            # All to the digits of the Gaussian sd, so that the ends can be compared by eye.
            ends = by_method.get(m, (math.nan, math.nan))
            low, high, _ = measured(fit.estimates[name].sd, *ends)
            cells.append(f"{low} to {high}" if m in by_method else NOTHING)
        rows.append((name, *cells, pretty(fit.estimates[name].unit)))
    heads = {"gaussian": "Gaussian", "nuts": "NUTS"}
    return Table(("parameter", *(heads.get(m, m) for m in present), "unit"), rows)


def sampling(posterior: Posterior) -> Table:
    """Whether the chains of NUTS agree: R-hat and effective draws by parameter, divergent steps."""
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
    """The verdict's numbers at the start values and at the estimates."""
    before, after = fit.verdict_before, fit.verdict
    n = len(after.names)
    rows = [
        ("rank", f"{before.rank} of {n}", f"{after.rank} of {n}"),
        (
            "rank without priors",
            f"{before.rank_without_priors} of {n}",
            f"{after.rank_without_priors} of {n}",
        ),
        ("condition number", number(before.condition, 3), number(after.condition, 3)),
        ("singular values", _singular_values(before), _singular_values(after)),
        ("strong pairs (correlation beyond 0.99)", _pairs(before), _pairs(after)),
        (
            "directions that are not identifiable (log parameters)",
            _null_directions(before),
            _null_directions(after),
        ),
    ]
    return Table(("", "at the start values", "at the estimates"), rows)


def _singular_values(v: Verdict) -> str:
    return ", ".join(number(float(s), 3) for s in v.singular_values)


def _pairs(v: Verdict) -> str:
    # Five digits: beyond 0.99 it is the last ones that count.
    cells = [f"{p.first}, {p.second}: {p.correlation:+.5f}" for p in v.pairs]
    return "; ".join(cells).replace("-", "−") or "none"


def _null_directions(v: Verdict) -> str:
    # Components of up to 0.005 would be printed as 0.00: the direction does not have them.
    cells = [
        ", ".join(f"{n} {x:+.2f}" for n, x in d.items() if abs(x) > 0.005)
        for d in v.null_directions
    ]
    return "; ".join(cells).replace("-", "−") or "none"


def starts(fit: Fit) -> Table:
    """Where every start led."""
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
        )
        for i, s in enumerate(fit.starts)
    ]
    # Starts beside ends: whether equal costs come from equal parameters is what several starts are
    # for.
    ends = [*(f"{n}, start" for n in names), *(f"{n}, end" for n in names)]
    return Table(("", *ends, "cost", "steps", "led to"), rows)
