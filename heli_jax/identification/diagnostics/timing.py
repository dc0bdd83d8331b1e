"""Findings on sampling rates, and on signals at another time than in the log."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from heli_jax.finding import Finding, Severity, found
from heli_jax.flights.flight import labels
from heli_jax.identification.diagnostics.context import Context
from heli_jax.identification.problem import Problem
from heli_jax.identification.validation.logging_rate import (
    RATE,
    measurement_noise,
    power_between_samples,
    rates_against_modes,
)
from heli_jax.identification.validation.shifts import (
    SHIFT,
    shift_in_time,
)

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
        yield from of_rates(c.problem, measurement_noise(c.problem, c.at.noise.sd), c.params)
    else:
        yield from of_rates(c.problem, c.at.noise.sd)


def of_rates(
    problem: Problem, sd: Sequence[Mapping[str, Any]], params: Any = None
) -> Iterator[Finding]:
    """Compare logging rates with the model's modes; if all suffice, report only the lowest.

    This needs no simulation.

    Args:
        sd: standard deviation of the assumed noise, by flight and output [SI].
        params: the model's Params with the estimates in place [SI]; by default the start values.
    """
    where = "start values" if params is None else "estimates"
    params = problem.start_params() if params is None else params
    training = problem.training
    rates = [
        (label, one)
        for label, flight, noise in zip(labels(training), training, sd, strict=True)
        for one in rates_against_modes(problem, params, flight, noise)
    ]
    low = [(label, one) for label, one in rates if one.samples < RATE.enough]
    for label, one in low or sorted(rates, key=lambda pair: pair[1].samples)[:1]:
        severity: Severity = "ok"
        if low:
            severity = "refuse" if one.samples < one.least else "doubt"
        yield found(
            "timing.logging-rate",
            severity,
            value=one.samples,
            flight=label,
            signals=one.signals,
            rate=one.hz,
            hz=one.mode.hz,
            output=one.mode.output,
            where=where,
            low=f"{RATE.enough * one.mode.hz:.3g} Hz" if low else "",
            enough=RATE.enough,
            least=one.least,
        )


DIAGNOSTICS = (
    signals_shifted,
    loop_between_samples,
    rates_enough,
)
"""Diagnostics of timing, causes first."""
