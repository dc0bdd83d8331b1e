"""Diagnostics of a record and of a fit: one tuple, for `check` and for `fit`.

A diagnostic is a function of a `Context` that yields findings. To add one: a function, its entry
here, and its words in `messages.yaml`.
"""

from collections.abc import Callable, Iterable

from heli_jax.finding import Finding, distrusted, once, weighed
from heli_jax.identification.diagnostics import (
    adequacy,
    dynamics,
    excitation,
    loop,
    noise,
    quality,
    search,
    timing,
    units,
)
from heli_jax.identification.diagnostics.context import Context

Diagnostic = Callable[[Context], Iterable[Finding]]

DIAGNOSTICS: tuple[Diagnostic, ...] = (
    *units.DIAGNOSTICS,
    search.log_cautions,
    search.at_bound,
    search.search_stopped,
    *timing.DIAGNOSTICS,
    *quality.DIAGNOSTICS,
    *excitation.DIAGNOSTICS,
    loop.inputs_follow_response,
    loop.moved_by_feedback,
    loop.weak_instruments,
    dynamics.unmodelled_dynamics,
    dynamics.inputs_ask_otherwise,
    adequacy.outputs_follow_excitation,
    adequacy.outputs_explained,
    adequacy.responses_explained,
    adequacy.residual_follows_excitation,
    adequacy.outputs_unmoved,
    adequacy.simulation_as_expected,
    adequacy.held_out_predicted,
    noise.residuals_white,
    noise.residuals_correlated,
    noise.disturbance_shows,
    search.search_told,
    search.prior_contradicted,
    search.profile_intervals,
)
"""causes first: of two findings as severe the first one is shown first"""

MOOT: dict[str, tuple[str, ...]] = {
    "units.in-doubt": ("signs.rate-against-angle",),
    "signs.against-start": ("signs.rate-against-angle",),
    "timing.mode-past-nyquist": ("timing.logging-rate",),
}
"""by code those that say the same more surely, where they are more than a note"""


def diagnose(c: Context) -> tuple[Finding, ...]:
    """All findings at a point, the most severe first."""
    findings = once(weighed((f for d in DIAGNOSTICS for f in d(c)), c.estimates))
    sure = {f.code for f in findings if f.bad}
    # What changes the conclusion on a fit stays.
    kept = [f for f in findings if f.denies or f.distrusts or not sure & set(MOOT.get(f.code, ()))]
    return tuple(sorted(kept, key=lambda f: _rank(f, c)))


def _rank(f: Finding, c: Context) -> int:
    """Order: exit codes first, then doubts, notes and what is good."""
    if f.denies or f.severity == "refuse":
        return 0
    if distrusted([f], c.estimates):
        return 1
    return {"doubt": 2, "note": 3, "ok": 4}[f.severity]
