"""Findings on feedback from the response to the inputs, and its effect on the estimates."""

from collections.abc import Iterator, Sequence

from heli_jax.finding import Finding, found
from heli_jax.identification.diagnostics.context import Context
from heli_jax.identification.estimation.frequency_instrument import STRONG, instruments_of
from heli_jax.identification.methods import objective_of
from heli_jax.identification.problem import Problem
from heli_jax.identification.validation.adequacy import is_unstable
from heli_jax.identification.validation.closed_loop_trust import (
    BESIDE,
    MAY_BE,
    weak_by_instrument,
)
from heli_jax.identification.validation.follows_response import LEVEL

FEEDBACK = "loop.feedback"
_HELD = 1.0
"""Growth of an unstable mode over a record that only a loop prevents [e-foldings]."""


def inputs_follow_response(c: Context) -> Iterator[Finding]:
    """Find a closed loop, and its effect on estimates by this method."""
    present = [one for one in c.feedback if one.present]
    objective, names = objective_of(c.problem.method), tuple(c.estimates)
    harmed = c.at_optimum and not c.independent and objective.noise_model == "white"
    if not present:
        if harmed and is_unstable(c.problem, c.params, _HELD):
            yield found("loop.held", "doubt", distrusts=names)
        elif c.feedback:
            least = min(c.feedback, key=lambda one: one.p_value)
            yield found("loop.no-feedback", "ok", least.input, value=least.p_value, level=LEVEL)
        return
    # White innovations show that the noise model is right. With disturbances in the model the
    # direct estimate is then unbiased in a closed loop too.
    if objective.noise_model == "disturbance" and c.fitted and c.white:
        return
    code = "loop.feedback-filtered" if objective.noise_model == "disturbance" else FEEDBACK
    # Before a fit feedback is a doubt; after one the residuals show whether it biases estimates.
    severity = "note" if c.fitted and not harmed else "doubt"
    inputs = tuple(dict.fromkeys(one.input for one in present))
    if objective.noise_model == "spectrum" and set(inputs) <= set(instruments_of(c.problem)):
        code, severity = "loop.excitation-logged", "ok"
    sure = min(present, key=lambda one: one.p_value)
    late = list(dict.fromkeys(one.input for one in present if not one.delay_known))
    yield found(
        code,
        severity,
        *inputs,
        value=sure.p_value,
        distrusts=names if harmed else (),
        inputs=inputs,
        flight=sure.flight,
        sure=sure.input,
        output=sure.output,
        correlation=sure.correlation,
        lag=sure.lag[0] if sure.lag[0] == sure.lag[1] else list(sure.lag),
        earlier=f"{sure.earlier:.2g} s" if sure.earlier else "",
        late=" and ".join(late),
        free=_frees_a_delay(c.problem, late),
        method=c.problem.method,
        level=LEVEL,
    )


def _frees_a_delay(problem: Problem, late: Sequence[str]) -> str:
    """Return the parameters to free, to distinguish late inputs from a closed loop."""
    own = dict(problem.model.delays)
    estimated = problem.nuisance.time_shift or all(own.get(name) in problem.free for name in late)
    return "" if estimated or not late else "fit.nuisance.time_shift, or delays of the model"


def moved_by_feedback(c: Context) -> Iterator[Finding]:
    """Find parameters that feedback may have biased in frequency, if no excitation was logged."""
    by = c.instruments
    closed = any(one.present for one in c.feedback) or (c.held and not by)
    direct = [one for one in c.feedback if one.input not in by]
    # Feedback to an input with an instrument may go to the other inputs as well.
    inputs = list(dict.fromkeys(one.input for one in [f for f in direct if f.present] or direct))
    limit = BESIDE if by else MAY_BE
    parts = {n: part for n, part in c.moved.items() if part > limit}
    if not (parts and closed) or (by and not inputs):
        return
    yield found(
        "loop.no-instrument",
        "doubt",
        *inputs,
        value=max(parts.values()),
        distrusts=parts,
        inputs=inputs if by else ["the inputs"],
        held="" if c.follows else "the vehicle is held",
        names=list(parts),
        shares=list(parts.values()),
        limit=limit,
    )


def weak_instruments(c: Context) -> Iterator[Finding]:
    """Find parameters on which the logged excitation has too little information."""
    names = weak_by_instrument(c.problem, c.at) if c.at_optimum else ()
    if names:
        yield found("loop.weak-instrument", "doubt", *names, distrusts=names, limit=STRONG)
