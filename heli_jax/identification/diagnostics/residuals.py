"""Findings on residuals: adequacy, unmodelled dynamics, noise, and held-out flights."""

from collections.abc import Iterator

import numpy as np

from heli_jax.dynamics.disturbance import disturbances_of
from heli_jax.finding import Finding, found, note
from heli_jax.identification.diagnostics.context import Context
from heli_jax.identification.estimation.noise_covariance import NO_DISTURBANCE
from heli_jax.identification.validation.adequacy import EXPLAINED, WORSE
from heli_jax.identification.validation.excitation import LEVEL
from heli_jax.identification.validation.metrics import pooled_metrics
from heli_jax.identification.validation.unmodelled import LEVEL_COLOURED

# Adequacy of the model.


def outputs_explained(c: Context) -> Iterator[Finding]:
    """Find outputs that the simulation, or predictions ahead, do not explain."""
    for output in c.adequacy.judged if c.fitted else ():
        if output.adequate:
            continue
        yield found(
            "adequacy.output-not-explained",
            "doubt",
            output.output,
            value=output.vaf,
            denies=True,
            output=output.output,
            expected=EXPLAINED,
            lag1=output.lag1,
            times=f"{np.sqrt(ratio):.2g}" if (ratio := output.against_disturbance) else "",
            ahead=f"up to {c.adequacy.ahead:g} s ahead" if c.adequacy.ahead else "",
        )


def responses_explained(c: Context) -> Iterator[Finding]:
    """Test the squared errors of fitted responses over their variance.

    Gusts do not change this ratio.
    """
    if c.responses is None or c.unrelated:
        return
    if c.responses.outside:
        doubted = c.responses.doubted
        yield found(
            "adequacy.response-errors",
            "doubt" if doubted else "note",
            value=c.responses.chi_squared,
            denies=doubted,
            low=c.responses.lower95,
            high=c.responses.upper95,
        )
    for words in c.responses.sentences:
        yield note("frequency.left-out", words)


_SURE = 1e-4
"""P-value below which a residual that follows the excitation makes all intervals untrusted."""


def residual_follows_excitation(c: Context) -> Iterator[Finding]:
    """Find residuals in frequency that still follow the excitation."""
    # Feedback without an instrument correlates inputs and residual also for the right model.
    if not c.fitted or c.unrelated or (c.follows and not c.instruments):
        return
    level = LEVEL / max(len(c.followed), 1)
    failed = {n: f for n, f in c.followed.items() if f.p_value < level}
    if failed:
        bad = any(not f.explained >= EXPLAINED for f in failed.values())
        least = min(f.p_value for f in failed.values())
        yield found(
            "dynamics.residual-follows-excitation",
            "doubt",
            *failed,
            value=least,
            denies=bad,
            distrusts=c.at.layout.of_interest if least < _SURE else (),
            what="the excitation" if c.instruments else "the inputs",
            explained=[max(f.explained, 0.0) for f in failed.values()],
            level=level,
        )


# Residuals that still follow an input, the amplitude, or time.


RESIDUAL_FOLLOWS_INPUT = "dynamics.residual-follows-input"
_CODES = {
    "input": RESIDUAL_FOLLOWS_INPUT,
    "amplitude": "dynamics.depends-on-amplitude",
    "flights": "dynamics.flights-differ",
    "time": "dynamics.changes-over-record",
}


def unmodelled_dynamics(c: Context) -> Iterator[Finding]:
    """Find a missing mode, or a response that depends on amplitude, flight or time."""
    for one in c.unmodelled[0]:
        yield found(
            _CODES[one.drive.kind],
            "doubt",
            one.output,
            *one.drive.of,
            value=one.p_value,
            shifts=one.shifts,
            distrusts=one.far,
            output=one.output,
            of=one.drive.of,
            gain=one.gain,
            near=f"{one.frequency:.2g} rad/s" if one.frequency else "",
            lacks="a mode or a lag" if one.frequency else "dynamics",
            level=LEVEL,
        )


def inputs_prefer_other_values(c: Context) -> Iterator[Finding]:
    """Find parameters whose values by the response to the inputs alone differ from the fit's."""
    p, shifts = c.unmodelled[1]
    if shifts:
        yield found(
            "agreement.inputs-ask-otherwise",
            "doubt",
            *c.at.layout.of_interest,
            value=p,
            shifts=shifts,
            level=LEVEL_COLOURED,
        )


# Whiteness of residuals or innovations, and disturbances.


COLOURED, TOO_NARROW = "noise.residuals-coloured", "noise.intervals-too-narrow"
_FAR_TOO_NARROW = 0.2
"""Autocorrelation at one sample above which intervals that ignore it are not trusted.

They are then too narrow by more than a fifth, or the noise model is wrong."""


def residuals_white(c: Context) -> Iterator[Finding]:
    """Find residuals or innovations that are not white, and the effect on the intervals."""
    not_white = [name for name, w in c.whiteness.items() if not w.white] if c.fitted else []
    if not not_white:
        return
    # Select by the correlation at one sample, since the message shows this number.
    worst = max((c.whiteness[n] for n in not_white), key=lambda w: abs(w.lag1))
    objective, converged = c.at.layout.objective, c.status != "not-converged"
    allowed = objective.noise_model == "spectrum" or c.errors.coloured
    narrow = converged and not allowed
    yield found(
        TOO_NARROW if narrow else COLOURED,
        "doubt" if narrow else "note",
        *not_white,
        value=worst.lag1,
        distrusts=c.free if narrow and abs(worst.lag1) > _FAR_TOO_NARROW else (),
        errors="innovations" if objective.noise_model == "disturbance" else "residuals",
        outside=worst.outside,
        limit=_FAR_TOO_NARROW,
        allowed="the intervals allow for it" if converged and allowed else "",
    )


def disturbance_shows(c: Context) -> Iterator[Finding]:
    """Find disturbances that were estimated and are not significant."""
    if c.optimum is None:
        return
    absent = c.absent
    names = [d.name for d in disturbances_of(c.at.layout.model) if d.sigma in absent]
    if names:
        yield found("noise.no-disturbance", "note", *names, limit=NO_DISTURBANCE)


# Held-out flights.


def held_out_predicted(c: Context) -> Iterator[Finding]:
    """Find held-out flights that the model does not predict."""
    held = c.held_out
    astray = [
        s.flight
        for s in held.signals
        if not all(np.isfinite(v).all() for v in s.simulated.values())
    ]
    if astray:
        yield found("held-out.not-finite", "note", *astray)
    if held.in_frequency is not None:
        for label in held.in_frequency.not_judged:
            yield found("held-out.not-judged", "note", label, flight=label)
        for flight in held.in_frequency.flights:
            label, furthest = flight.flight, flight.furthest
            if flight.worse:
                code = "held-out.worse-than-none"
                numbers = {"flight": label, "names": flight.worse}
                yield found(code, "doubt", label, *flight.worse, denies=True, **numbers)
            if flight.differs and furthest is not None:
                yield found(
                    "held-out.other-estimates",
                    "doubt",
                    label,
                    value=flight.estimates_p_value,
                    shifts={furthest.parameter: furthest.own - furthest.fitted},
                    limit=LEVEL,
                    flight=label,
                    **furthest._asdict(),
                )
    # A simulation shows little if gusts are in the model, or if the fit does not simulate.
    elif c.at.layout.noise_model == "white":
        for name, m in pooled_metrics(held.signals).items():
            # An output that does not respond may be slightly worse than its mean by chance.
            if not m.vaf >= WORSE:
                code = "held-out.worse-than-mean"
                yield found(code, "doubt", name, value=m.vaf, denies=True, limit=WORSE)
