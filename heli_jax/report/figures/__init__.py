"""The report's figures: each turns plain data into a `Chart`, or None if there is nothing to draw.

Scatter plots of samples use Matplotlib within `style.in_style()` and are images on the page.
"""

from heli_jax.report.figures.bode import draw_response, match, quotient
from heli_jax.report.figures.estimates import (
    bootstrap_pairs,
    posterior_pairs,
)
from heli_jax.report.figures.signals import (
    overview,
    residual_correlation,
    response,
    rls_history,
    time_label,
)

__all__ = [
    "bootstrap_pairs",
    "draw_response",
    "match",
    "overview",
    "posterior_pairs",
    "quotient",
    "residual_correlation",
    "response",
    "rls_history",
    "time_label",
]
