"""Diagnostics of a record and of a fit: one tuple, for `check` and for `fit`.

A diagnostic is a function of a `Context` that yields findings. To add one: a function, its entry
here, and its words in `messages.yaml`.
"""

from collections.abc import Callable, Iterable

from heli_jax.finding import Finding, distrusted, rated, without_repeats
from heli_jax.identification.diagnostics import loop, record, residuals, search, units
from heli_jax.identification.diagnostics.context import Context

Diagnostic = Callable[[Context], Iterable[Finding]]

DIAGNOSTICS: tuple[Diagnostic, ...] = (
    *units.DIAGNOSTICS,
    search.log_cautions,
    search.at_bound,
    search.search_stopped,
    *record.DIAGNOSTICS,
    loop.inputs_follow_response,
    loop.moved_by_feedback,
    loop.weak_instruments,
    residuals.unmodelled_dynamics,
    residuals.inputs_prefer_other_values,
    residuals.outputs_explained,
    residuals.responses_explained,
    residuals.residual_follows_excitation,
    residuals.held_out_predicted,
    residuals.residuals_white,
    residuals.disturbance_shows,
    search.search_notes,
    search.prior_contradicted,
    search.profile_intervals,
    search.band_unused,
)
"""All diagnostics, causes first: among equally severe findings this order decides."""


def diagnose(c: Context) -> tuple[Finding, ...]:
    """Return all findings at a point, the most severe first."""
    findings = without_repeats(rated((f for d in DIAGNOSTICS for f in d(c)), c.estimates))
    return tuple(sorted(findings, key=lambda f: _rank(f, c)))


def _rank(f: Finding, c: Context) -> int:
    """Return the rank of a finding: exit codes first, then doubts, notes and good results."""
    if f.denies or f.severity == "refuse":
        return 0
    if distrusted([f], c.estimates):
        return 1
    return {"doubt": 2, "note": 3, "ok": 4}[f.severity]
