"""Findings on the excitation by the inputs, and on the next manoeuvre."""

from collections.abc import Iterator

import numpy as np

from heli_jax import naming
from heli_jax.finding import Finding, found
from heli_jax.identification.design.accuracy import unstated_gusts
from heli_jax.identification.design.next_flight import plan_next_flight
from heli_jax.identification.diagnostics.context import Context
from heli_jax.identification.unknowns.layout import unpack
from heli_jax.identification.validation.excitation import LEVEL

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
    plan = None if c.fitted else plan_next_flight(c.problem, c.at, c.e)
    if plan is None or not plan.after < BETTER * plan.again:
        return
    unit = naming.unit(c.problem.model.Inputs, plan.best.input) or ""
    determined = bool(np.isfinite(plan.before))
    yield found(
        "excitation.next-flight",
        "note",
        plan.parameter,
        value=plan.after / plan.again if determined else 0.0,
        before=f"{100.0 * plan.before:.2g} %" if determined else "",
        again=f"{100.0 * plan.again:.2g} %",
        after=100.0 * plan.after,
        manoeuvre=plan.best.words,
        input=plan.best.input,
        amplitude=plan.amplitude,
        unit="" if unit == "1" else f" {unit}",
        seconds=plan.duration,
        left_out=", ".join(plan.left_out),
        limit=BETTER,
    )


DIAGNOSTICS = (
    nothing_follows,
    gusts_guessed,
    next_flight,
)
