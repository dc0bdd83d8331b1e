"""The report's figures: plain data in, a `Chart` out; None where there is nothing to draw.

Matrices, intervals and pairs of samples are no lines: they are Matplotlib's, drawn within
`style.in_style()`, and files alone.
"""

from heli_jax.report.figures.bode import bode_overlay, bode_unit, draw_response, match
from heli_jax.report.figures.estimates import (
    bootstrap_pairs,
    correlation_matrix,
    intervals,
    posterior_pairs,
    trace,
    waterfall,
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
    "bode_overlay",
    "bode_unit",
    "bootstrap_pairs",
    "correlation_matrix",
    "draw_response",
    "intervals",
    "match",
    "motion",
    "overview",
    "posterior_pairs",
    "residual_correlation",
    "response",
    "rls_history",
    "sticks",
    "time_label",
    "trace",
    "waterfall",
]
