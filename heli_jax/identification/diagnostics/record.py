"""Findings on the record: quality of signals, times and rates, excitation and the next manoeuvre.

If possible, signals are tested as logged, since resampling hides flat tops.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from heli_jax import naming
from heli_jax.finding import Finding, Severity, found
from heli_jax.flights.flight import labels
from heli_jax.flights.marks import written_again
from heli_jax.flights.signal_facts import DROP_SHARE, RAIL_SHARE, STUCK_SECONDS
from heli_jax.identification.design.accuracy import unstated_gusts
from heli_jax.identification.design.library import plan_next_flight
from heli_jax.identification.diagnostics.context import Context
from heli_jax.identification.diagnostics.outliers import outliers
from heli_jax.identification.problem import Problem
from heli_jax.identification.unknowns.layout import unpack
from heli_jax.identification.validation.excitation import LEVEL
from heli_jax.identification.validation.logging_rate import (
    RATE,
    measurement_noise,
    power_between_samples,
    rates_against_modes,
)
from heli_jax.identification.validation.shifts import SHIFT, shift_in_time
from heli_jax.numerics.white_noise import without_noise

_CUT_OFF = 0.02
"""Share of an output's samples at its limits from which on no model of it is adequate."""


def saturation(c: Context) -> Iterator[Finding]:
    """Find signals that rest at an end of their range."""
    cut = [
        (label, name, kind, facts)
        for label, flight in c.flights
        for (name, kind), facts in flight.facts.items()
        if sum(facts.shares) > 0
    ]
    for label, name, kind, facts in sorted(cut, key=lambda one: -sum(one[3].shares)):
        share = sum(facts.shares)
        ends = zip((facts.low.value, facts.high.value), facts.shares, strict=True)
        yield found(
            "quality.saturation",
            "doubt",
            name,
            value=share,
            denies=kind == "output" and share >= _CUT_OFF,
            flight=label,
            ends=[value for value, part in ends if part],
            percent=100.0 * share,
            limit=RAIL_SHARE,
        )


def stuck_outputs(c: Context) -> Iterator[Finding]:
    """Find outputs that stay at one value while others move, or often jump to one value."""
    for label, flight in c.flights:
        signals = flight.source.outputs if flight.source else {}
        for (name, _), facts in flight.facts.items():
            if facts.dropouts is not None and facts.dropped >= DROP_SHARE:
                value = facts.dropouts.value
                logged = signals[name].from_si(np.array(value)) if name in signals else value
                yield found(
                    "quality.dropouts",
                    "doubt",
                    name,
                    value=facts.dropped,
                    denies=True,
                    flight=label,
                    at=value,
                    percent=100.0 * facts.dropped,
                    logged=float(logged),
                    limit=DROP_SHARE,
                )
            if facts.stuck is not None:
                yield found(
                    "quality.stuck-output",
                    "doubt",
                    name,
                    value=round(sum(s.end - s.begin for s in facts.stretches), 6),
                    flight=label,
                    count=len(facts.stretches),
                    longest=facts.stuck.end - facts.stuck.begin,
                    begin=facts.stuck.begin,
                    at=facts.stuck.value,
                    limit=STUCK_SECONDS,
                )


def held_values(c: Context) -> Iterator[Finding]:
    """Find outputs that hold values, in flights made of arrays: the readers leave them out."""
    for label, flight in c.flights:
        for name, y in {} if flight.source else flight.outputs.items():
            share = float(np.mean(written_again(y)))
            if share >= DROP_SHARE:
                yield found(
                    "quality.held-values",
                    "doubt",
                    name,
                    value=share,
                    distrusts=c.free,
                    flight=label,
                    percent=100.0 * share,
                    limit=DROP_SHARE,
                )


def outlying_residuals(c: Context) -> Iterator[Finding]:
    """Find single samples far from the fitted response, and the estimates without them."""
    if not (c.at_optimum and c.explains) or c.at.layout.noise_model == "spectrum":
        return
    for one in outliers(c.problem, c.at, c.e):
        yield found(
            "quality.outliers",
            "doubt",
            one.output,
            value=float(one.values.size),
            shifts=one.shifts,
            percent=100.0 * one.share,
            low=one.values.min(),
            high=one.values.max(),
        )


# Sampling rates, and signals at another time than in the log.


_CODES = {
    "input": "timing.late-input",
    "output": "timing.late-output",
    "response": "timing.late-response",
    "hold": "timing.likelier-hold",
}


def signals_shifted(c: Context) -> Iterator[Finding]:
    """Find signals at another time, or inputs with the other hold, if this explains more."""
    if not (c.at_optimum and c.explains) or c.instruments:
        return
    one = shift_in_time(c.problem, c.at, c.e, _outputs_in_doubt(c))
    if one is None:
        return
    # A missing mode or lag may explain the residual better than a delay.
    closer = any(x.drive.kind == "input" and x.gain > one.gain for x in c.unmodelled[0])
    if one.kind == "response" and closer:
        return
    yield found(
        _CODES[one.kind],
        "doubt",
        *one.names,
        value=one.seconds,
        shifts=one.moved,
        names=one.names,
        ms=1e3 * one.seconds,
        gain=one.gain,
        limit=SHIFT.clear,
    )


def _outputs_in_doubt(c: Context) -> list[str]:
    """Return the outputs that may be late: of several, those whose residuals are not white."""
    # A single late output looks like early inputs; an inadequate model shows no time shift.
    if len(c.metrics) < 2 or c.e.innovations or c.adequacy.denied:
        return []
    return sorted({key.rsplit("/", 1)[1] for key, w in c.whiteness.items() if not w.white})


def loop_between_samples(c: Context) -> Iterator[Finding]:
    """Find inputs of a closed loop that act faster than they are logged."""
    follow = {(one.flight, one.input) for one in c.feedback if one.present}
    for label, flight in c.flights:
        for name in flight.inputs:
            fast = power_between_samples(flight, name) if (label, name) in follow else None
            if fast is not None:
                yield found(
                    "timing.loop-between-samples",
                    "doubt",
                    name,
                    value=fast[1],
                    distrusts=c.estimates,
                    flight=label,
                    input=name,
                    rate=fast[0],
                    percent=100.0 * fast[1],
                    limit=RATE.fast_share,
                )


def rates_enough(c: Context) -> Iterator[Finding]:
    """Compare rates of inputs and outputs with the fastest mode that matters."""
    if c.fitted:
        noise = measurement_noise(c.problem, c.at.noise.sd)
        yield from of_rates(c.problem, noise, c.params, white=c.white)
    else:
        yield from of_rates(c.problem, c.at.noise.sd)


def of_rates(
    problem: Problem, sd: Sequence[Mapping[str, Any]], params: Any = None, *, white: bool = False
) -> Iterator[Finding]:
    """Compare logging rates with the model's modes; if all suffice, report only the lowest.

    This needs no simulation.

    Args:
        sd: standard deviation of the assumed noise, by flight and output [SI].
        params: the model's Params with the estimates in place [SI]; by default the start values.
        white: True for a fit with white residuals.
    """
    where = "start values" if params is None else "estimates"
    params = problem.start_params() if params is None else params
    training = problem.training
    rates = [
        (label, one)
        for label, flight, noise in zip(labels(training), training, sd, strict=True)
        for one in rates_against_modes(problem, params, flight, noise)
    ]
    # White residuals show that such an input is known between its steps.
    rates = [(label, one) for label, one in rates if not (white and one.may_be_steps)]
    low = [(label, one) for label, one in rates if one.samples < RATE.enough]
    for label, one in low or sorted(rates, key=lambda pair: pair[1].samples)[:1]:
        severity: Severity = "ok"
        if low:
            hopeless = one.samples < one.least and not one.may_be_steps
            severity = "refuse" if hopeless else "doubt"
        yield found(
            "timing.logging-rate",
            severity,
            value=one.samples,
            flight=label,
            signals=one.signals,
            logged="" if one.may_be_steps else f"{one.hz:.3g} Hz",
            changes=f"{1.0 / one.hz:.3g} s" if one.may_be_steps else "",
            hz=one.mode.hz,
            output=one.mode.output,
            where=where,
            low=f"{RATE.enough * one.mode.hz:.3g} Hz" if low and not one.may_be_steps else "",
            enough=RATE.enough,
            least=one.least,
        )


# Excitation by the inputs, and the next manoeuvre.


NOTHING_FOLLOWS = "excitation.nothing-follows"
"""Code of a record in which no output follows the inputs."""
BETTER = 0.98
"""Largest sd after the next flight over that after the same record again, to suggest it."""


def nothing_follows(c: Context) -> Iterator[Finding]:
    """Find records in which no output follows the excitation beyond chance.

    A residual that does not follow it is then no sign of a good model.
    """
    if c.unrelated:
        yield found(
            NOTHING_FOLLOWS,
            "refuse",
            *c.unrelated,
            value=min(c.unrelated.values()),
            denies=True,
            distrusts=c.free,
            what="excitation" if c.instruments else "inputs",
            p_values=list(c.unrelated.values()),
            level=LEVEL / len(c.unrelated),
        )


SMOOTHED = "noise.smoothed"
"""Code of a record without sensor noise, which gives no expected standard deviations."""


def smoothed_outputs(c: Context) -> Iterator[Finding]:
    """Find outputs without sensor noise before a fit, whose accuracy nothing predicts."""
    for label, flight in [] if c.fitted else c.flights:
        smooth = [n for n, y in flight.outputs.items() if n not in flight.sd and without_noise(y)]
        if smooth:
            yield found(SMOOTHED, "doubt", *smooth, flight=label)


def gusts_guessed(c: Context) -> Iterator[Finding]:
    """Report sizes of disturbances that were estimated from the record at the start values."""
    guessed = [] if c.fitted else unstated_gusts(c.problem)
    if guessed:
        taken = unpack(c.at.layout, c.at.data, c.at.z).noise
        units = {n: naming.unit(c.problem.model.Params, n) or "" for n in guessed}
        sizes = [f"{n} of {float(taken[n]):.2g} {units[n]}".rstrip() for n in guessed]
        yield found("noise.gusts-guessed", "note", *guessed, sizes=sizes)


def next_flight(c: Context) -> Iterator[Finding]:
    """Suggest the manoeuvre that narrows the widest interval more than the same record again."""
    unknown = c.fitted or any(True for _ in smoothed_outputs(c))
    plan = None if unknown else plan_next_flight(c.problem, c.at, c.e)
    if plan is None or not plan.after < BETTER * plan.again:
        return
    unit = naming.unit(c.problem.model.Inputs, plan.input) or ""
    determined = bool(np.isfinite(plan.before))
    yield found(
        "excitation.next-flight",
        "note",
        plan.parameter,
        value=plan.after / plan.again if determined else 0.0,
        before=f"{100.0 * plan.before:.2g} %" if determined else "",
        again=f"{100.0 * plan.again:.2g} %",
        after=100.0 * plan.after,
        manoeuvre=plan.manoeuvre,
        input=plan.input,
        amplitude=float(np.max(np.abs(plan.excitation))),
        unit="" if unit == "1" else f" {unit}",
        seconds=plan.duration,
        left_out=", ".join(plan.left_out),
        limit=BETTER,
    )


DIAGNOSTICS = (
    signals_shifted,
    loop_between_samples,
    rates_enough,
    saturation,
    stuck_outputs,
    held_values,
    outlying_residuals,
    nothing_follows,
    smoothed_outputs,
    gusts_guessed,
    next_flight,
)
"""Diagnostics of the record, causes first."""
