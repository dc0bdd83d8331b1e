"""Findings on the excitation by the inputs, and on the next manoeuvre."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from heli_jax import naming
from heli_jax.finding import Finding, found
from heli_jax.identification.design.accuracy import unstated_gusts
from heli_jax.identification.design.next_flight import plan_next_flight
from heli_jax.identification.diagnostics.context import Context
from heli_jax.identification.unknowns.layout import unpack
from heli_jax.identification.validation.excitation import least_rough

NOTHING_FOLLOWS = "excitation.nothing-follows"
"""Code of a record in which no output follows the inputs."""


@dataclass(frozen=True)
class Limits:
    """Limits for findings on a record."""

    nothing: float = 0.2
    """Share of an output's power that must follow the inputs; a vehicle on the ground had 0.11."""
    chance: float = 0.1
    """Least p-value at which no output follows the inputs; in strong gusts it is far smaller."""
    together: float = 0.8
    """Partial coherence of two inputs from which on they move together.

    The variance of their effects is then 1 / (1 - 0.8) = 5 times that with the other input still.
    """
    noise: float = 0.5
    """Mean squared step of an output over that of white noise, above which it shows no motion."""
    better: float = 0.98
    """Largest sd after the next flight over that after the same record again, to suggest it."""


LIMITS = Limits()


def _explained(c: Context) -> bool:
    """True if a fit itself proves enough excitation: it converged to an adequate model."""
    return c.fitted and c.status == "converged" and not c.adequacy.denied


def nothing_follows(c: Context) -> Iterator[Finding]:
    """Find records in which no output follows the inputs, or no input moves."""
    if _explained(c):
        return
    limit, outputs = LIMITS.nothing, c.excitation.outputs.values()
    if not c.excitation.powers:
        name, rough = least_rough(c.problem.training)
        if rough > LIMITS.noise:
            yield found(NOTHING_FOLLOWS, "refuse", value=0.0, limit=limit)
        else:
            yield found("excitation.free-motion", "note", name, value=rough, limit=LIMITS.noise)
    elif outputs and (share := max(f.explained for f in outputs)) < limit:
        # The common part is chance, or feedback to the inputs, as in a rate loop on the ground.
        by_chance = min(f.p_value for f in outputs) >= LIMITS.chance
        severity = "refuse" if by_chance or c.follows else "doubt"
        yield found(NOTHING_FOLLOWS, severity, value=max(share, 0.0), limit=limit)


def excited_bands(c: Context) -> Iterator[Finding]:
    """Report the bands that the inputs excite, and the outputs that follow."""
    if c.fitted:
        return
    following = {
        n: f.explained for n, f in c.excitation.outputs.items() if f.explained >= LIMITS.nothing
    }
    if following:
        bands = c.excitation.powers
        yield found(
            "excitation.excited-band",
            "ok",
            *bands,
            value=max(following.values()),
            bands=[f"{n} {low:.2g} to {high:.2g} Hz" for n, (low, high) in bands.items()],
            outputs=list(following),
            shares=list(following.values()),
            limit=LIMITS.nothing,
        )


def inputs_together(c: Context) -> Iterator[Finding]:
    """Find inputs that move together, so that their effects cannot be separated."""
    for names, coherence in () if _explained(c) else c.excitation.pairs:
        if coherence >= LIMITS.together:
            yield found(
                "excitation.inputs-together",
                "doubt",
                *names,
                value=coherence,
                wider=max(1.0 - coherence, 1e-12) ** -0.5,
                limit=LIMITS.together,
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
    if plan is None or not plan.after < LIMITS.better * plan.again:
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
        limit=LIMITS.better,
    )


DIAGNOSTICS = (
    nothing_follows,
    excited_bands,
    inputs_together,
    gusts_guessed,
    next_flight,
)
