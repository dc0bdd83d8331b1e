"""Do samples show the dynamics, and do signals stand in the log when they acted?"""

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from heli_jax.finding import Finding, Severity, found
from heli_jax.flights.flight import labels
from heli_jax.identification.diagnostics.context import Context
from heli_jax.identification.problem import Problem
from heli_jax.identification.validation.logging_rate import (
    RATE,
    Rate,
    measurement_noise,
    power_between_samples,
    rates_against_modes,
)
from heli_jax.identification.validation.other_hold import (
    BEYOND_DOUBT,
    moving_inputs,
    other_hold,
)
from heli_jax.identification.validation.shifts import (
    ANGLE,
    LEAD,
    SHIFT,
    input_shift,
    late_angles,
    late_steps,
    leads,
    stepped,
)

_IN_MS = 2.0
"""[Hz] at which no flight is logged: 500 Hz or more in ms, read as seconds"""
_LARGE = 0.1
"""of a parameter, by which half a sample of an input has to move it for a doubt before any fit"""
_NAMED = 3
"""parameters that a sentence names at most"""
_SEEN = 1e-3
"""of a parameter, below which a move is not named: of one held by a prior alone it is rounding"""


def angles_late(c: Context) -> Iterator[Finding]:
    """Angles that move later or earlier than the integral of their rate."""
    for label, rate, angle, one in late_angles(c.problem.model, c.flights) if not c.fitted else ():
        other, size = one.other, abs(one.late)
        yield found(
            "timing.late-output" if other is None else "timing.late-output-or-other",
            value=one.late,
            flight=label,
            late=angle if one.late > 0 else rate,
            early=rate if one.late > 0 else angle,
            size=size,
            sd=one.sd,
            other=other,
            least=ANGLE.least,
        )


def inputs_late(c: Context) -> Iterator[Finding]:
    """Inputs that an output precedes; after a fit, only where no likelihood tells how late."""
    layout, model = c.at.layout, c.problem.model
    if c.fitted:
        freed = layout.shift or set(model.delay_parameters) & set(c.free)
        judged = c.arrived and c.explains and layout.noise_model != "spectrum"
        if freed or judged:
            return
    follow = {(one.flight, one.input) for one in c.feedback if one.present}
    for lead in leads(c.flights):
        # Of an input that follows the response it is said that it may be late.
        if (lead.flight, lead.input) not in follow:
            yield found(
                "timing.output-leads",
                value=lead.share,
                flight=lead.flight,
                input=lead.input,
                output=lead.output,
                seconds=lead.seconds,
                limit=LEAD.share,
            )


def inputs_shifted(c: Context) -> Iterator[Finding]:
    """Inputs that the fitted model places at another time, and what each step is late by."""
    if not (c.arrived and c.explains) or c.instruments:
        return
    shift = c.estimates.get("time_shift")
    if shift is not None:
        names = stepped(c.problem.training)
        if names and shift.sd and -shift.value > SHIFT.clear * shift.sd:
            yield found("timing.steps-between-stamps", "note", *names, value=-shift.value)
        return
    one = input_shift(c.problem, c.at, c.e)
    # A lag that is missing shows in the residual too, and more closely.
    if one is None or (one.late < 0 and any(x.drive.kind == "input" for x in c.unmodelled[0])):
        return
    yield found(
        "timing.late-input" if one.late > 0 else "timing.late-response",
        "doubt",
        *one.inputs,
        value=abs(one.late),
        shifts=one.moved,
        inputs=one.inputs,
        ms=1e3 * abs(one.late),
        gain=one.gain,
        moves=_largest(_parts(c, one.moved)),
        clear=SHIFT.clear**2,
    )


def steps_late(c: Context) -> Iterator[Finding]:
    """Inputs that move in steps and are logged slowly, before a fit."""
    period, moved = late_steps(c.problem, c.at, c.e) if not c.fitted else (0.0, {})
    parts = {n: v for n, v in _parts(c, moved).items() if n not in c.undetermined}
    largest = max((abs(part) for part in parts.values()), default=0.0)
    if largest >= _LARGE:
        yield found(
            "timing.slow-stick",
            value=largest,
            inputs=stepped(c.problem.training),
            rate=1.0 / period,
            ms=1e3 * period,
            moves=_largest(parts),
            limit=_LARGE,
        )


def _parts(c: Context, moved: Mapping[str, float]) -> dict[str, float]:
    """How far parameters are moved, as parts of their values."""
    return {n: v / c.named[n] for n, v in moved.items() if c.named[n]}


def _largest(parts: Mapping[str, float]) -> list[str]:
    """The parameters that are moved most, each with how far."""
    first, *others = sorted(parts, key=lambda n: -abs(parts[n]))[:_NAMED]
    shown = [first, *(n for n in others if abs(parts[n]) >= _SEEN)]
    return [f"{n} by {100 * parts[n]:+.2g} %" for n in shown]


def loop_between_samples(c: Context) -> Iterator[Finding]:
    """Inputs of a closed loop that act faster than they are logged."""
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


def modes_past_nyquist(c: Context) -> Iterator[Finding]:
    """Modes that the samples cannot show, whose aliases fit as well."""
    for mode in c.fast_modes:
        yield found(
            "timing.mode-past-nyquist",
            "doubt" if mode.undetermined else "note",
            mode.flight,
            value=mode.frequency,
            distrusts=mode.undetermined,
            flight=mode.flight,
            hz=mode.frequency / (2.0 * math.pi),
            nyquist=mode.nyquist,
            nyquist_hz=mode.nyquist / (2.0 * math.pi),
            about=mode.about,
            past=1 if mode.frequency >= mode.nyquist else 2,
        )


def rates_enough(c: Context) -> Iterator[Finding]:
    """Rates of inputs and outputs against the fastest mode that matters."""
    if c.fitted:
        yield from of_rates(c.problem, measurement_noise(c.problem, c.at.noise.sd), c.params)
    else:
        yield from of_rates(c.problem, c.at.noise.sd)


def of_rates(
    problem: Problem, sd: Sequence[Mapping[str, Any]], params: Any = None
) -> Iterator[Finding]:
    """Findings on logging rates, which need no simulation; where all are enough the lowest alone.

    Args:
        sd: by flight and output the noise that is assumed, SI.
        params: the model's Params with the estimates in place, SI; the start values unless given.
    """
    where = "start values" if params is None else "estimates"
    params = problem.start_params() if params is None else params
    enough: list[tuple[float, Finding]] = []
    bad = False
    training = problem.training
    for label, flight, noise in zip(labels(training), training, sd, strict=True):
        rates, hidden = rates_against_modes(problem, params, flight, noise)
        if hidden:
            bad = True
            yield found("timing.rate-not-judged", flight=label, hz=hidden, where=where)
        for one in rates:
            finding = _of_rate(label, one, where)
            bad = bad or finding.bad
            if finding.bad:
                yield finding
            else:
                enough.append((one.samples, finding))
    if enough and not bad:
        yield min(enough, key=lambda pair: pair[0])[1]


def _of_rate(label: str, one: Rate, where: str) -> Finding:
    severity: Severity = "doubt"
    if one.samples >= RATE.enough:
        severity = "ok"
    elif one.samples < one.least:
        severity = "refuse"
    return found(
        "timing.rate-enough" if severity == "ok" else "timing.logging-rate",
        severity,
        value=one.samples,
        flight=label,
        signals=one.signals,
        rate=one.hz,
        hz=one.mode.hz,
        output=one.mode.output,
        where=where,
        needed=RATE.enough * one.mode.hz,
        enough=RATE.enough,
        least=one.least,
        ms="ms" if severity == "refuse" and one.hz <= _IN_MS else "",
        steps=one.signals[0] if one.staircase else "",
    )


def hold_matters(c: Context) -> Iterator[Finding]:
    """Estimates that the other hold of the inputs would change by more than their sd."""
    if c.fitted:
        sds = {n: x.sd for n, x in c.estimates.items() if x.sd is not None}
        other = other_hold(c.problem, c.at, c.e, sds, in_doubt=True) if c.arrived else None
    else:
        other = other_hold(c.problem, c.at, c.e, skip=c.undetermined)
    if other is None:
        return
    changes = other.changes
    large = sorted((n for n in changes if changes[n][1] > 1.0), key=lambda n: -changes[n][1])
    if not large:
        return
    taken = {
        n: f.hold[n]
        for _, f in c.flights
        for n in f.inputs
        if n in moving_inputs(c.problem, f, in_doubt=c.fitted)
    }
    # Autocorrelated residuals make the record worth fewer samples.
    wider = max((e.sd / e.sd_white for e in c.estimates.values() if e.sd and e.sd_white), default=1)
    gain = other.gain / wider**2
    contradicted = c.fitted and gain > BEYOND_DOUBT
    yield found(
        "timing.likelier-hold" if contradicted else "timing.other-hold",
        "doubt" if contradicted else "note",
        *taken,
        *large,
        value=changes[large[0]][1],
        inputs=list(taken),
        holds=list(dict.fromkeys(taken.values())),
        names=large[:_NAMED],
        sds=[changes[n][1] for n in large[:_NAMED]],
        gain=gain,
        distrusts=large if contradicted else (),
    )


def delays_negative(c: Context) -> Iterator[Finding]:
    """Delays, and the shift of the inputs, below zero: the other estimates are right with them."""
    for name in (*c.problem.model.delay_parameters, "time_shift"):
        estimate = c.estimates.get(name)
        if estimate is not None and estimate.upper95 is not None and estimate.upper95 < 0:
            value = estimate.value
            yield found("timing.delay-negative", "note", name, value=value, ms=1e3 * value)


DIAGNOSTICS = (
    angles_late,
    inputs_late,
    inputs_shifted,
    steps_late,
    loop_between_samples,
    modes_past_nyquist,
    rates_enough,
    hold_matters,
    delays_negative,
)
"""causes first"""
