"""The report's figures: plain data in, Matplotlib Axes out, each on a figure of its own.

Draw within `style.in_style()` to get the report's look.
"""

from heli_jax.report.figures.bode import bode, bode_overlay, bode_unit, draw_response, match
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
    residual_correlation,
    response,
    rls_history,
    sticks,
    time_label,
)

__all__ = [
    "bode",
    "bode_overlay",
    "bode_unit",
    "bootstrap_pairs",
    "correlation_matrix",
    "draw_response",
    "intervals",
    "match",
    "motion",
    "posterior_pairs",
    "residual_correlation",
    "response",
    "rls_history",
    "sticks",
    "time_label",
    "trace",
    "waterfall",
]
