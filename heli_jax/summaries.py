"""Summaries of flights, problems, fits and vehicles as text, for their `__repr__`.

The classes import this module, so it imports none of them, and its arguments are `Any`.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from heli_jax import naming
from heli_jax.finding import sentences
from heli_jax.numbers import NOTHING, measured, number, percent, vaf_percent

type Row = tuple[str, ...]


def as_text(title: str, head: Row = (), rows: Sequence[Row] = (), notes: Sequence[str] = ()) -> str:
    """Return a summary as lines of text with aligned columns."""
    cells = [row for row in (head, *rows) if row]
    # Without rows and head there are no columns, and zip returns none.
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    lines = [
        "  " + "  ".join(map(str.ljust, row, widths)).rstrip() if any(row) else "" for row in cells
    ]
    return "\n".join([title, *lines, *(f"  {note}" for note in notes)])


def of_flight(flight: Any) -> str:
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
    return as_text(
        f"Flight{name}: {flight.n_samples} samples at {1 / flight.dt:g} Hz, "
        f"{flight.duration:.6g} s{used}",
        ("", "signal", "lowest", "highest", "hold"),
        rows,
        (*known, *(sentences(flight.source.notes) if flight.source else ())),
    )


def of_problem(problem: Any) -> str:
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
    return as_text(
        f"Problem: {problem.model.name} by {problem.method}, {flights}"
        + (f" and {held_out} held out" if held_out else ""),
        ("free", "start", "lower", "upper", "prior", "unit"),
        rows,
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


def of_fit(fit: Any) -> str:
    """Summarise status, verdict, estimates with intervals, and agreement by output."""
    head, rows = of_estimates(fit.estimates)
    agreement = [f"{name}: VAF {vaf_percent(m.vaf)}" for name, m in fit.metrics.items()]
    by = f" by instrument ({', '.join(fit.instruments)})" if fit.instruments else ""
    return as_text(
        f"Fit of {fit.model} by {fit.method}{by}: {fit.status}",
        # This name states whether the interval allows for autocorrelated residuals.
        (*head[:3], fit.interval, *head[4:]),
        rows,
        (fit.verdict.text, *agreement, *fit.notes),
    )


def of_vehicle(vehicle: Any) -> str:
    """Summarise the given constants with unit and meaning; `vehicle` is any record of numbers."""
    record, rows, missing = type(vehicle), [], []
    for name, value in naming.asdict(vehicle).items():
        try:
            shown = number(float(value), 6)
        except Exception:  # an array, or a tracer of JAX within jit and vmap
            shown = repr(value)
        if shown == NOTHING:  # NaN marks a constant that the file does not give
            missing.append(name)
            continue
        rows.append((name, shown, naming.unit(record, name) or "", naming.meaning(record, name)))
    notes = (f"not given: {', '.join(missing)}",) if missing else ()
    return as_text(record.__name__, ("constant", "value", "unit", "meaning"), rows, notes)


def _range(values: np.ndarray) -> tuple[str, str]:
    # NaN marks missing samples, and a run after it diverged.
    finite = np.asarray(values, float)[np.isfinite(values)]
    if not finite.size:
        return NOTHING, NOTHING
    return number(float(finite.min())), number(float(finite.max()))
