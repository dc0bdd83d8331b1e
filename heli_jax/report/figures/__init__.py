"""The report's figures: each turns plain data into a `Chart`."""

from heli_jax.report.figures.bode import draw_response, match, quotient
from heli_jax.report.figures.signals import (
    overview,
    residual_correlation,
    response,
    rls_history,
    time_label,
)

__all__ = [
    "draw_response",
    "match",
    "overview",
    "quotient",
    "residual_correlation",
    "response",
    "rls_history",
    "time_label",
]
