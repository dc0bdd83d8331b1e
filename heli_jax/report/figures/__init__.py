"""The report's figures: plain data in, matplotlib Axes out.

Each function draws on the `figure` it is given, or on one of its own (`axes[0].figure`). Draw
within `matplotlib.rc_context(style.STYLE)` to get the report's look.
"""

from heli_jax.report.figures.estimates import correlation_matrix, intervals, waterfall
from heli_jax.report.figures.frequency_domain import bode, bode_unit
from heli_jax.report.figures.match import match
from heli_jax.report.figures.panels import Panels
from heli_jax.report.figures.residuals import residual_correlation
from heli_jax.report.figures.samples import bootstrap_pairs, posterior_pairs, trace
from heli_jax.report.figures.time_domain import response, rls_history

__all__ = [
    "Panels",
    "bode",
    "bode_unit",
    "bootstrap_pairs",
    "correlation_matrix",
    "intervals",
    "match",
    "posterior_pairs",
    "residual_correlation",
    "response",
    "rls_history",
    "trace",
    "waterfall",
]
