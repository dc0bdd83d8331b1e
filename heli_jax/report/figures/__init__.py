"""The report's figures: plain data in, a `Chart` out; None where there is nothing to draw.

Pairs of samples are no lines: they are Matplotlib's, drawn within `style.in_style()`, and images on
the page.
"""

from heli_jax.report.figures.bode import bode_unit, draw_response, match
from heli_jax.report.figures.estimates import (
    bootstrap_pairs,
    posterior_pairs,
)
from heli_jax.report.figures.signals import (
    motion,
    overview,
    residual_correlation,
    response,
    rls_history,
    sticks,
    time_label,
)

__all__ = [
    "bode_unit",
    "bootstrap_pairs",
    "draw_response",
    "match",
    "motion",
    "overview",
    "posterior_pairs",
    "residual_correlation",
    "response",
    "rls_history",
    "sticks",
    "time_label",
]
