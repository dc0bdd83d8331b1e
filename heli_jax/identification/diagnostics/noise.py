"""Findings on whiteness of residuals or innovations, and on disturbances."""

from collections.abc import Iterator

from heli_jax.dynamics.disturbance import disturbances_of
from heli_jax.finding import Finding, found
from heli_jax.identification.diagnostics.context import Context
from heli_jax.identification.estimation.disturbance_search import NO_DISTURBANCE

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
