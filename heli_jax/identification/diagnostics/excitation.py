"""Do the inputs excite what is asked, and what would excite it better?"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from heli_jax import naming
from heli_jax.finding import Finding, found
from heli_jax.identification.design.accuracy import unstated_gusts
from heli_jax.identification.design.next_flight import look_at_missing, plan_next_flight
from heli_jax.identification.diagnostics.context import Context
from heli_jax.identification.unknowns.layout import unpack
from heli_jax.identification.validation.excitation_test import outputs_against_excitation
from heli_jax.identification.validation.excited_band import NOTHING_FOLLOWS, least_rough


@dataclass(frozen=True)
class Limits:
    """Limits from which a record is doubted, and from which a number is told."""

    nothing: float = 0.2
    """part of the power of each output below which inputs that no output follows over a band tell
    nothing, where they follow the response or none of it is beyond chance: a vehicle that was not
    flying had 0.11"""
    chance: float = 0.1
    """p value of the output that follows the inputs most surely, from which on none is taken to: of
    a vehicle in strong gusts it is far less"""
    noise: float = 0.5
    """mean squared step of an output over that of white noise, above which it shows no motion"""
    feeble: float = 3.0
    """rms of a response over the noise, below which an input hardly excites the model"""
    narrows: float = 0.9
    """of an interval's width, below which an output that is not used is told"""
    halves: float = 0.5
    """of an interval's width: an output that does that is missed"""
    known: float = 0.1
    """relative sd of a parameter below which nothing is missed"""
    better: float = 0.98
    """of the sd that the same record again would leave: less is no reason to fly something else"""
    named: int = 3
    """outputs and parameters that are told"""


LIMITS = Limits()


def _explained(c: Context) -> bool:
    """True if a fit shows by itself that the inputs excite what is asked."""
    return c.fitted and c.status == "converged" and not c.adequacy.denied


def excited_bands(c: Context) -> Iterator[Finding]:
    """The band that each input excites, and the output that follows it there."""
    if _explained(c):
        return
    for name, (low, high) in c.excitation.powers.items():
        best = c.excitation.followed.get(name)
        code, severity = "excitation.excited-band", "ok"
        if not c.excitation.followed:
            code, severity = "excitation.coherence-unknown", "note"
        elif best is None:
            # No pass: this input alone moves nothing, though several together may.
            code, severity = "excitation.input-alone", "note"
        yield found(
            code,
            severity,
            name,
            value=best.coherence if best else None,
            low=low,
            high=high,
            output=best.output if best else "",
            begin=best.low if best else 0.0,
            end=best.high if best else 0.0,
            left_out=", ".join(c.excitation.left_out),
            limit=c.excitation.limit,
        )


def nothing_follows(c: Context) -> Iterator[Finding]:
    """Records in which no output follows any input, or no input moves."""
    if _explained(c):
        return
    limit, share = LIMITS.nothing, c.excitation.share
    if not c.excitation.powers:
        name, rough = least_rough(c.problem.training)
        if rough > LIMITS.noise:
            yield found(NOTHING_FOLLOWS, "refuse", value=0.0, limit=limit)
        else:
            yield found("excitation.free-motion", "note", name, value=rough, limit=LIMITS.noise)
    elif share is not None:
        severity = "doubt"
        if share < limit:
            # What the two have in common is chance, or comes from inputs that follow the response:
            # a rate loop on the ground.
            p_values = outputs_against_excitation(c.problem)
            by_chance = min(p_values.values(), default=1.0) >= LIMITS.chance
            severity = "refuse" if by_chance or c.follows else "doubt"
        yield found(NOTHING_FOLLOWS, severity, value=share, limit=limit)


def inputs_together(c: Context) -> Iterator[Finding]:
    """Inputs that move together, so that their effects cannot be told apart."""
    if _explained(c):
        return
    limit = c.excitation.pair_limit
    for i, (names, coherence) in enumerate(c.excitation.pairs):
        if coherence >= limit:
            yield found(
                "excitation.inputs-together",
                "doubt",
                *names,
                value=coherence,
                wider=max(1.0 - coherence, 1e-12) ** -0.5,
                limit=limit,
            )
        elif i == 0:
            yield found("excitation.inputs-apart", "ok", *names, value=coherence, limit=limit)


def feeble_inputs(c: Context) -> Iterator[Finding]:
    """Outputs that the inputs hardly move at the start values: worth most while a record can still
    be flown again."""
    if c.fitted:
        return
    for (label, _), outputs in zip(c.flights, c.start.simulated, strict=True):
        for name, y in outputs.items():
            # About its mean: a trim value that the model holds excites nothing.
            moved, noise = float(np.std(y)), c.noise[f"{label}/{name}"]
            if moved < LIMITS.feeble * noise:
                yield found(
                    "excitation.feeble",
                    "note",
                    name,
                    value=moved / noise,
                    flight=label,
                    moved=moved,
                    noise=noise,
                    limit=LIMITS.feeble,
                )


def gusts_guessed(c: Context) -> Iterator[Finding]:
    """Sizes of disturbances that are what the record says at the start values."""
    guessed = [] if c.fitted else unstated_gusts(c.problem)
    if guessed:
        taken = unpack(c.at.layout, c.at.data, c.at.z).noise
        units = {n: naming.unit(c.problem.model.Params, n) or "" for n in guessed}
        sizes = [f"{n} of {float(taken[n]):.2g} {units[n]}".rstrip() for n in guessed]
        yield found("noise.gusts-guessed", "note", *guessed, sizes=sizes)


def missing_outputs(c: Context) -> Iterator[Finding]:
    """Outputs that the model has and the log lacks, and that would narrow intervals."""
    unknowns, missing = (None if c.fitted else look_at_missing(c.problem, c.at)) or ((), [])
    missing = sorted(missing, key=lambda m: float(np.min(m.ratios)))
    if missing and not np.min(missing[0].ratios) < LIMITS.narrows:
        least = float(np.min(missing[0].ratios))
        yield found(
            "excitation.no-missing-output", "ok", missing[0].name, value=least, limit=LIMITS.narrows
        )
        return
    for m in missing[: LIMITS.named]:
        order = [i for i in np.argsort(m.ratios) if m.ratios[i] < LIMITS.narrows][: LIMITS.named]
        if not order:
            continue
        # What is known well already need not be known better.
        missed = np.any((m.ratios < LIMITS.halves) & ~(m.before < LIMITS.known))
        yield found(
            "excitation.missing-output",
            "doubt" if missed else "ok",
            m.name,
            value=float(m.ratios[order[0]]),
            sd=m.sd,
            unit=naming.unit(c.problem.model.Outputs, m.name) or "",
            parameters=[unknowns[i] for i in order],
            ratios=[float(m.ratios[i]) for i in order],
            limit=LIMITS.halves,
        )


def next_flight(c: Context) -> Iterator[Finding]:
    """The manoeuvre that narrows the widest interval most."""
    plan = None if c.fitted else plan_next_flight(c.problem, c.at, c.e)
    if plan is None:
        return
    determines = np.isfinite(plan.after)
    ratio = plan.after / plan.again if determines and plan.again > 0 else 1.0
    code = "excitation.next-flight" if ratio < LIMITS.better else "excitation.fly-again"
    if not determines:
        code = "excitation.no-flight-determines"
    elif not np.isfinite(plan.before):
        code = "excitation.flight-determines"
    unit = naming.unit(c.problem.model.Inputs, plan.best.input) or ""
    yield found(
        code,
        "note",
        plan.parameter,
        value=ratio,
        before=100.0 * plan.before,
        again=100.0 * plan.again,
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
    feeble_inputs,
    gusts_guessed,
    missing_outputs,
    next_flight,
)
