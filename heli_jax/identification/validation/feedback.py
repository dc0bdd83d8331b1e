"""What it means for a fit that inputs follow the response."""

import math
from collections.abc import Mapping, Sequence

import numpy as np

from heli_jax.dynamics.kinematics import is_kinematic
from heli_jax.dynamics.model import axes_of
from heli_jax.finding import Finding, note
from heli_jax.flights.flight import Flight
from heli_jax.identification.estimation.frequency_instrument import instruments_of
from heli_jax.identification.methods import estimator_of
from heli_jax.identification.problem import Problem
from heli_jax.identification.unknowns.initial_guess import labels
from heli_jax.identification.validation.follows_response import (
    LEVEL,
    RATE,
    SEEN,
    Feedback,
    Untested,
    decimated,
    feedback,
    rates_of,
    tested_at,
)
from heli_jax.numbers import percent

FEEDBACK = "loop.feedback"


def why_untested(problem: Problem) -> Untested | None:
    """Why nothing was tested of any flight; None where something was.

    Args:
        problem: whose flights are tested.
    """
    reasons = {
        label: tested
        for label, f in zip(labels(problem.training), problem.training, strict=True)
        if isinstance(tested := tested_at(f, {}, rates_of(f)[0]), Untested)
    }
    kinds = list(dict.fromkeys(reasons.values()))
    if len(kinds) < 2:
        return kinds[0] if kinds else None
    return Untested("; ".join(f"{label}: {one.reason}" for label, one in reasons.items()))


def feedback_of(
    problem: Problem, delays: Mapping[str, tuple[float, float | None]] | None = None
) -> tuple[Feedback, ...]:
    """Of all flights that are fitted; nothing where sensors are compared with each other, of which
    none is a stick that anybody moves.

    Args:
        problem: flights, and the model, which says what is delayed.
        delays: value and sd of what a fit found, among it `time_shift` and the parameters that are
            delays [s]; None before a fit, and of one that did not arrive.
    """
    if is_kinematic(problem.model):
        return ()
    flights, made = problem.training, []
    for label, flight in zip(labels(flights), flights, strict=True):
        of_inputs = {n: _delay(problem, flight, n, delays or {}) for n in flight.inputs}
        # As early as its interval has it: what is left of a late log would still be an alarm. One
        # that may be zero is none: an input that is moved for nothing hides a fast controller.
        earlier = {n: 2.0 * sd - d for n, (d, sd, _) in of_inputs.items() if d + 2.0 * sd < 0}
        made += [
            one._replace(flight=label, delay_known=of_inputs[one.input][2])
            for one in feedback(flight, len(flights), earlier)
        ]
    return tuple(made)


def _delay(
    problem: Problem, flight: Flight, name: str, delays: Mapping[str, tuple[float, float | None]]
) -> tuple[float, float, bool]:
    """Of an input its delay and its sd [s], as far as they are known, and whether that was
    estimated."""
    delay, variance, estimated = 0.0, 0.0, False
    own = dict(problem.model.delays).get(name)
    if own is not None and own not in delays:
        stated = flight.known.get(own)
        delay = float(getattr(problem.vehicle, own) if stated is None else stated)
    for parameter in ("time_shift", own):
        value, sd = delays.get(parameter or "", (0.0, None))
        if sd is not None:
            delay, variance, estimated = delay + value, variance + sd**2, True
    return delay, math.sqrt(variance), estimated


def untested(problem: Problem) -> list[Finding]:
    """A sentence for the outputs of which feedback cannot be told, since too much is missing."""
    flights, lacking = problem.training, {}
    for label, flight in zip(labels(flights), flights, strict=True):
        tested = decimated(flight, {}, RATE).outputs
        gappy = [n for n, y in flight.outputs.items() if n not in tested and np.isnan(y).any()]
        if gappy:
            # Flights that lack the same in one sentence: parts of a run do.
            lacking.setdefault((tuple(gappy), not tested), []).append(label)
    return [
        note(
            "loop.not-tested",
            f"{', '.join(those)}: whether the inputs follow {' or '.join(outputs)} was not tested, "
            f"since more than {percent(1 - SEEN, 0)} of the samples are missing"
            + (", and no other output was measured." if alone else "."),
            *outputs,
        )
        for (outputs, alone), those in lacking.items()
    ]


def feedback_notes(
    problem: Problem, feedback: Sequence[Feedback], white: bool | None = None
) -> list[Finding]:
    """What a closed loop does to the estimates, and what to do; nothing where there is none.

    Args:
        problem: says the method and what can be disturbed.
        feedback: of `feedback_of`.
        white: whether the errors that the method asks to be white are; None before a fit.
    """
    present = [one for one in feedback if one.present]
    filtered = estimator_of(problem.method).process_noise
    # With disturbances in the model and white innovations the noise model is right, and the direct
    # estimate is unbiased in a closed loop too.
    if not present or (filtered and white):
        return []
    least = min(one.p_value for one in present)
    criterion, names = f"p value, {LEVEL:g}", tuple(dict.fromkeys(one.input for one in present))
    # Before a fit it is a doubt about the record; after one the residuals say whether it harms.
    severity = "doubt" if white is None else "note"
    begun = f"{_what_follows(problem, present)} unbiased only if the noise model is right. "
    if filtered:
        doubt = "" if white is None else ", and they are not: disturbances or dynamics are missing"
        words = f"{begun}Filter error asks for white innovations{doubt}."
        return [Finding(FEEDBACK, severity, words, least, criterion, names)]
    if _by_instrument(problem, present):
        return []
    words = (
        f"{begun}That of {problem.method} knows no gusts, which feedback brings into the inputs: "
        f"in gusts its estimates are biased, and {_advised(problem, present)} is advised."
    )
    return [Finding(FEEDBACK, severity, words, least, criterion, names)]


def _by_instrument(problem: Problem, present: Sequence[Feedback]) -> bool:
    """Whether all inputs that follow the response are taken by their instrument."""
    if not estimator_of(problem.method).by_instrument:
        return False
    return {one.input for one in present} <= set(instruments_of(problem))


def _advised(problem: Problem, present: Sequence[Feedback]) -> str:
    """Filter error with a disturbance where the response that is followed is disturbed."""
    axes, outputs = axes_of(problem.model), {one.output for one in present}
    own = [axis.name for axis in axes if outputs & {axis.rate, axis.angle}]
    if not axes:
        return "method: filter-error and process noise"
    if len(axes) == 1 or len(own) == 1:
        name = own[0] if own else axes[0].name
        return f"method: filter-error with disturbance: {{axis: {name}, poles: 1}}"
    named = ", ".join(own or [axis.name for axis in axes])
    return f"method: filter-error with a disturbance of each axis that gusts move ({named})"


def _what_follows(problem: Problem, present: Sequence[Feedback]) -> str:
    """Which inputs follow what, up to what holds of the estimates then."""
    sure = min(present, key=lambda one: one.p_value)
    names = list(dict.fromkeys(one.input for one in present))
    of = " and ".join(names)
    moved = f", taken {sure.earlier:.2g} s earlier as its delay says" if sure.earlier else ""
    first, last = (f"{lag:.2g}" for lag in sure.lag)
    lags = first if first == last else f"{first} to {last}"
    follows = (
        f"{of} {'follow' if len(names) > 1 else 'follows'} the response ({sure.flight}: "
        f"correlation {sure.correlation:+.2f} of what is unforeseen of {sure.input}{moved} with "
        f"what was unforeseen of {sure.output} {lags} s before)"
    )
    if all(one.delay_known for one in present):
        return f"The loop is closed: {follows}. Estimates are then"
    late = list(dict.fromkeys(one.input for one in present if not one.delay_known))
    return (
        f"{follows}: the loop is closed, or {' and '.join(late)} {'are' if len(late) > 1 else 'is'}"
        f" logged late ({_how_told(problem, late)}). In a closed loop estimates are"
    )


def _how_told(problem: Problem, late: Sequence[str]) -> str:
    """What tells inputs that are logged late from a closed loop."""
    own = dict(problem.model.delays)
    if problem.nuisance.time_shift or all(own.get(name) in problem.free for name in late):
        return "a fit that arrives tells, by its delay"
    return "free a delay: fit.nuisance.time_shift, or delays of the model"
