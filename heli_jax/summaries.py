"""Summaries of flights, problems, fits, runs and vehicles: text in a session, a table in a
notebook.

Each `of_...` function makes a `Summary` of one object; `as_text` and `as_html` format it. The
classes call these functions from `__repr__` and `_repr_html_`. They import this module, so it
imports none of them, and its arguments are `Any`.
"""

import html
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from heli_jax import naming
from heli_jax.finding import sentences
from heli_jax.numbers import NOTHING, measured, number, percent, vaf_percent

type Row = tuple[str, ...]


# Text and HTML share this content, so they cannot differ.
class Summary(NamedTuple):
    """Content of a summary."""

    title: str
    head: Row = ()
    rows: tuple[Row, ...] = ()
    notes: tuple[str, ...] = ()


def as_text(summary: Summary) -> str:
    """Return a summary as lines of text with aligned columns."""
    rows = [row for row in (summary.head, *summary.rows) if row]
    # Without rows and head there are no columns, and zip returns none.
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = [
        "  " + "  ".join(map(str.ljust, row, widths)).rstrip() if any(row) else "" for row in rows
    ]
    return "\n".join([summary.title, *lines, *(f"  {note}" for note in summary.notes)])


def as_html(summary: Summary) -> str:
    """Return a summary as HTML. All text is escaped, since names and notes come from logs and
    files.
    """

    def cells(row: Row, tag: str) -> str:
        return "".join(f"<{tag}>{html.escape(cell)}</{tag}>" for cell in row)

    head = f"<thead><tr>{cells(summary.head, 'th')}</tr></thead>" if summary.head else ""
    body = "".join(f"<tr>{cells(row, 'td')}</tr>" for row in summary.rows)
    table = f"<table>{head}<tbody>{body}</tbody></table>" if head or body else ""
    notes = "".join(f"<p>{html.escape(note)}</p>" for note in summary.notes)
    return f"<p><b>{html.escape(summary.title)}</b></p>{table}{notes}"


def of_flight(flight: Any) -> Summary:
    """Summarise the signals with ranges in SI, the hold of inputs, and the reader's notes."""
    rows = []
    for role in ("inputs", "outputs"):
        for name, values in getattr(flight, role).items():
            hold = flight.hold[name] if role == "inputs" else ""
            # Outputs have no hold, since they are compared only at their samples.
            rows.append((role[:-1], name, *_range(values), hold))
    used = ", held out" if flight.hold_out else ""
    known = [f"differs in {n} = {number(v, 6)}" for n, v in flight.known.items()]
    name = f" {flight.name!r}" if flight.name else ""
    return Summary(
        f"Flight{name}: {flight.n_samples} samples at {1 / flight.dt:g} Hz, "
        f"{flight.duration:.6g} s{used}",
        ("", "signal", "lowest", "highest", "hold"),
        tuple(rows),
        (*known, *(sentences(flight.source.notes) if flight.source else ())),
    )


def of_problem(problem: Any) -> Summary:
    """Summarise the free parameters with bounds and priors, and the fitted flights."""
    # Values as configured, without the transforms of the search.
    rows = []
    for name, free in problem.free.items():
        prior = "" if free.prior is None else f"{number(free.prior.mean)} ± {number(free.prior.sd)}"
        bounds = (number(v) if v is not None else "" for v in (free.start, free.lower, free.upper))
        unit = naming.unit(problem.model.Params, name) or ""
        rows.append((name, *bounds, prior, unit))
    held_out = len(problem.flights) - len(problem.training)
    flights = f"{len(problem.training)} flights" if len(problem.training) > 1 else "1 flight"
    return Summary(
        f"Problem: {problem.model.name} by {problem.method}, {flights}"
        + (f" and {held_out} held out" if held_out else ""),
        ("free", "start", "lower", "upper", "prior", "unit"),
        tuple(rows),
    )


def of_estimates(
    estimates: Mapping[str, Any], *, stopped: bool = False
) -> tuple[Row, tuple[Row, ...]]:
    """Return head and rows: value, sd, 95 % interval, unit and prior share of each estimate.

    Args:
        stopped: True if the optimiser did not converge, so that no number is a result.
    """
    # prior share: the priors' part of the estimate's variance.
    head = ("parameter", "estimate", "sd", "95 % interval", "unit", "prior share")
    rows = []
    for name, e in estimates.items():
        value, *others = cells_of(e, stopped=stopped)
        bound = " (at bound)" if e.at_bound and any(others) else ""
        rows.append((name, value + bound, *others, e.unit, percent(e.prior_share, 0)))
    return head, tuple(rows)


NOT_DETERMINED = "not determined"


def cells_of(e: Any, *, stopped: bool = False) -> tuple[str, str, str]:
    """Return value, sd and 95 % interval of an estimate or a combination.

    The last two are empty if it is not identifiable or the fit stopped before an optimum.
    """
    if stopped:
        known = math.isfinite(e.value)
        return f"{number(e.value, 3)} (no result)" if known else NOT_DETERMINED, "", ""
    # fit.json keeps the value of a parameter that is not identifiable. Here it would look like an
    # estimate.
    if e.sd is None or not math.isfinite(e.sd):
        return NOT_DETERMINED, "", ""
    # All four numbers have the digits that the sd allows.
    value, low, high, sd = measured(e.sd, e.value, e.lower95, e.upper95)
    untrusted = e.lower95 is None or e.upper95 is None
    return value, sd, "not trusted" if untrusted else f"{low} to {high}"


def of_fit(fit: Any) -> Summary:
    """Summarise status, verdict, estimates with intervals, and agreement by output."""
    head, rows = of_estimates(fit.estimates)
    agreement = [f"{name}: VAF {vaf_percent(m.vaf)}" for name, m in fit.metrics.items()]
    by = f" by instrument ({', '.join(fit.instruments)})" if fit.instruments else ""
    return Summary(
        f"Fit of {fit.model} by {fit.method}{by}: {fit.status}",
        # This name states whether the interval allows for autocorrelated residuals.
        (*head[:3], fit.interval, *head[4:]),
        rows,
        (fit.verdict.text, *agreement, *fit.notes),
    )


def of_trajectory(run: Any, statuses: Sequence[str]) -> Summary:
    """Summarise the signals with ranges in SI and the end of a run.

    For batches, and within jit, only shapes are shown. `statuses` are the words for the status
    codes.
    """
    signals = [
        (role, name, values)
        for role, record in (("state", run.states), ("output", run.outputs), ("input", run.inputs))
        for name, values in naming.asdict(record).items()
    ]
    # A repr must never fail. Within jit only shapes are known.
    if np.ndim(run.times) != 1 or not _concrete([run.times, run.finite, *(v for *_, v in signals)]):
        shape = tuple(np.shape(run.times))
        rows = tuple((role, name, str(tuple(np.shape(v)))) for role, name, v in signals)
        head = ("", "signal", "shape")
        return Summary(f"Trajectory, times of shape {shape}", head, rows)
    times = np.asarray(run.times)
    # The key includes the role, since an output and a state of the same name may differ in unit.
    units = {
        (role, name): naming.unit(type(record), name) or ""
        for role, record in (("state", run.states), ("output", run.outputs), ("input", run.inputs))
        for name in naming.names(type(record))
    }
    return Summary(
        f"Trajectory: {times.size} samples, {float(times[-1]):.6g} s, "
        f"{statuses[int(np.asarray(run.status))]}",
        ("", "signal", "lowest", "highest", "unit"),
        tuple((role, n, *_range(np.asarray(v)), units[role, n]) for role, n, v in signals),
        tuple(f"outside: {n}" for n, where in run.outside.items() if np.any(np.asarray(where))),
    )


def of_vehicle(vehicle: Any) -> Summary:
    """Summarise the given constants with unit and meaning; `vehicle` is any record of numbers."""
    record, rows, missing = type(vehicle), [], []
    for name, value in naming.asdict(vehicle).items():
        if not _concrete([value]) or np.ndim(value) != 0:
            shown = f"shape {tuple(np.shape(value))}" if hasattr(value, "shape") else repr(value)
        elif np.isnan(float(value)):  # NaN marks a constant that the file does not give
            missing.append(name)
            continue
        else:
            shown = number(float(value), 6)
        rows.append((name, shown, naming.unit(record, name) or "", naming.meaning(record, name)))
    notes = (f"not given: {', '.join(missing)}",) if missing else ()
    return Summary(record.__name__, ("constant", "value", "unit", "meaning"), tuple(rows), notes)


def _concrete(values: Iterable[Any]) -> bool:
    """True if all values are numbers and none is a tracer of JAX."""
    try:
        for value in values:
            np.asarray(value, dtype=float)
    except Exception:  # JAX's tracers raise various errors within jit and vmap
        return False
    return True


def _range(values: np.ndarray) -> tuple[str, str]:
    # NaN marks missing samples, and a run after it diverged.
    finite = np.asarray(values, float)[np.isfinite(values)]
    if not finite.size:
        return NOTHING, NOTHING
    return number(float(finite.min())), number(float(finite.max()))
