"""Does the model explain what was measured, beside noise and disturbance?"""

from collections.abc import Iterator

import numpy as np

from heli_jax.finding import Finding, found, note
from heli_jax.identification.agreement import pooled_metrics
from heli_jax.identification.diagnostics.context import Context
from heli_jax.identification.validation.adequacy import (
    EXPECTED,
    EXPLAINED,
    GATE,
    WORSE,
    OutputAdequacy,
    advice_for,
)
from heli_jax.identification.validation.excitation_test import LEVEL


def outputs_explained(c: Context) -> Iterator[Finding]:
    """Outputs that the simulation, or predictions ahead, do not explain."""
    if not c.fitted or c.adequacy.by_chance:
        return
    doubted = [o for o in c.adequacy.judged if not o.adequate or o.doubtful]
    for output in doubted:
        yield found(
            _why(output, c.adequacy.ahead),
            "note" if output.adequate else "doubt",
            output.output,
            value=output.vaf,
            denies=not output.adequate,
            output=output.output,
            gate=GATE,
            expected=EXPLAINED,
            explained=max(output.explained, 0.0),
            lag1=output.lag1,
            times=np.sqrt(output.against_disturbance or np.nan),
            seconds=c.adequacy.ahead or 0.0,
            advice=advice_for(c.problem, output, c.records, c.adequacy.unstable),
        )


def _why(output: OutputAdequacy, ahead: float | None) -> str:
    """The code of what is wrong with an output."""
    ratio = output.against_disturbance
    if output.adequate:
        return "adequacy.below-gate"
    if ahead is not None:
        return "adequacy.prediction-misses"
    if not np.isfinite(output.vaf):
        return "adequacy.simulation-not-finite"
    if output.vaf < 0:
        return "adequacy.worse-than-mean"
    if ratio is None:
        return "adequacy.output-not-explained"
    return "adequacy.more-than-disturbance" if ratio > EXPECTED else "adequacy.innovations-coloured"


def simulation_as_expected(c: Context) -> Iterator[Finding]:
    """What looks bad and is what the estimated disturbance makes."""
    if not c.fitted or c.adequacy.by_chance:
        return
    if c.adequacy.ahead is not None:
        yield found(
            "adequacy.judged-ahead",
            "note",
            seconds=c.adequacy.ahead,
            outputs=[o.output for o in c.adequacy.judged],
            vafs=[o.vaf for o in c.adequacy.judged],
        )
        return
    for output in c.adequacy.judged:
        if output.disturbed_below_mean:
            yield found("adequacy.disturbance-hides", "note", output.output, value=output.vaf)


def outputs_unmoved(c: Context) -> Iterator[Finding]:
    """Outputs of which nothing is explained, and outputs that never move."""
    if not c.fitted:
        return
    if c.adequacy.by_chance and c.adequacy.judged:
        yield found(
            "adequacy.by-chance",
            "refuse",
            *(o.output for o in c.adequacy.judged),
            value=max(o.vaf for o in c.adequacy.judged),
            denies=True,
            distrusts=c.free,
            vafs=[o.vaf for o in c.adequacy.judged],
        )
        return
    for output in c.adequacy.judged:
        if output.output in c.adequacy.unmoved:
            filtered = output.against_disturbance is not None
            code = "adequacy.output-not-predicted" if filtered else "adequacy.output-unmoved"
            yield found(code, "doubt", output.output, value=output.vaf)
    for name in c.adequacy.still:
        yield found("quality.never-moves", "doubt", name)


def responses_explained(c: Context) -> Iterator[Finding]:
    """Whether fitted frequency responses are explained: by the squared errors over their variance,
    which gusts do not change."""
    if c.responses is None or c.unrelated:
        return
    if c.responses.misfit:
        doubted = bool(c.responses.doubt)
        yield found(
            "adequacy.response-errors",
            "doubt" if doubted else "note",
            value=c.responses.chi_squared,
            denies=doubted,
            misfit=c.responses.misfit,
            doubt=c.responses.doubt,
            low=c.responses.lower95,
            high=c.responses.upper95,
        )
    for words in c.responses.sentences:
        yield note("frequency.left-out", words)


_SURE = 1e-4
"""p value below which a residual that follows the excitation takes all intervals away"""
WRONG_OPTIMUM = "search.wrong-optimum"


def residual_follows_excitation(c: Context) -> Iterator[Finding]:
    """Whether what is left of a record in frequency still follows what excites the vehicle."""
    if not c.fitted or c.unrelated:
        return
    level, failed = LEVEL / max(len(c.followed), 1), c.failed
    if failed:
        bad = any(not f.explained >= EXPLAINED for f in failed.values())
        code = "dynamics.residual-follows-excitation"
        if c.astray:
            code = "dynamics.residual-follows-inputs" if c.nearly else WRONG_OPTIMUM
        least = min(f.p_value for f in failed.values())
        yield found(
            code,
            "doubt",
            *failed,
            value=least,
            denies=bad or c.astray,
            distrusts=c.at.layout.of_interest if least < _SURE else (),
            what="the excitation" if c.instruments else "the inputs",
            explained=[max(f.explained, 0.0) for f in failed.values()],
            level=level,
        )
    if c.left_record:
        yield found("adequacy.simulation-leaves-record", "note", *c.left_record)


def outputs_follow_excitation(c: Context) -> Iterator[Finding]:
    """Whether any output follows what excites the vehicle: residuals that do not are no merit where
    the outputs do not either."""
    if not c.unrelated:
        return
    least = min(c.unrelated.values())
    yield found(
        "excitation.no-output-follows",
        "refuse",
        *c.unrelated,
        value=least,
        denies=True,
        distrusts=c.free,
        what="excitation" if c.instruments else "inputs",
        p_values=list(c.unrelated.values()),
        level=LEVEL / len(c.unrelated),
    )


# Do the estimates predict flights that they were not fitted to?


def held_out_predicted(c: Context) -> Iterator[Finding]:
    """Flights held out that the model does not predict."""
    yield from c.held_out.notes
    if c.held_out.in_frequency is not None:
        yield from c.held_out.in_frequency.findings
        return
    # With gusts in the model, or no simulation in the fit, a simulation says little.
    if c.at.layout.noise_model != "white":
        return
    for name, m in pooled_metrics(c.held_out.signals).items():
        # By more than chance makes of an output that does not respond.
        if not m.vaf >= WORSE:
            yield found(
                "held-out.worse-than-mean", "doubt", name, value=m.vaf, denies=True, limit=WORSE
            )
