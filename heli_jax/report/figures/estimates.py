"""Figures of the estimates: samples by pairs of parameters."""

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from heli_jax.identification.result import Estimate, Fit
from heli_jax.identification.uncertainty.bootstrap import Bootstrap
from heli_jax.identification.uncertainty.nuts import Posterior
from heli_jax.report import style

if TYPE_CHECKING:
    from matplotlib.figure import Figure


MOST = 6
"""Most parameters drawn, because smaller cells are unreadable."""
_RADIUS = 2.4477
"""Radius of the 95 % ellipse of a two-dimensional normal distribution [sd]: the root of
chi-squared's 95 % point with two degrees of freedom."""
_DOTS = 1500
"""Most samples drawn as dots, because more hide each other."""
_MARKS = 200
"""Most divergent steps that are marked."""


def posterior_pairs(posterior: Posterior, fit: Fit) -> "Figure":
    """Draw samples by pairs of parameters, with divergent ones marked."""
    draws = {name: np.asarray(v).ravel() for name, v in posterior.draws.items()}
    diverging = posterior.statistics.get("diverging")
    marked = None if diverging is None else np.asarray(diverging).ravel()
    return _pairs(draws, fit, "Draws from the posterior", style.PURPLE, marked)


def bootstrap_pairs(booted: Bootstrap, fit: Fit) -> "Figure | None":
    """Draw estimates from simulated records by pairs of parameters.

    Return None for fewer than two fitted parameters.
    """
    if len(next(iter(booted.values.values()), ())) < 2:
        return None
    return _pairs(booted.values, fit, "Estimates of the bootstrap", style.GREEN, None)


def _pairs(
    samples: Mapping[str, np.ndarray],
    fit: Fit,
    title: str,
    color: str,
    marked: np.ndarray | None,
) -> "Figure":
    names = list(samples)[:MOST]
    n = len(names)
    side = min(style.WIDTH, 2.2 + 1.3 * n)
    drawing = style.figure(side if n > 1 else 2.6, side)
    grid = drawing.subplots(n, n, squeeze=False, sharex="col")
    shown = slice(None, None, max(1, -(-next(iter(samples.values())).size // _DOTS)))
    for i, below in enumerate(names):
        grid[i, i].hist(samples[below], bins="auto", color=color)
        for j, left in enumerate(names[:i]):
            ax = grid[i, j]
            x, y = samples[left], samples[below]
            ax.plot(x[shown], y[shown], ".", color=color, ms=2.5, mew=0.0, rasterized=True)
            if marked is not None and marked.any():
                ax.plot(x[marked], y[marked], "x", color=style.BLACK, ms=4.0)
            _interval_lines(ax.axhline, fit.estimates[below])
            ellipse = gaussian_ellipse(fit, left, below)
            if ellipse is not None:
                ax.plot(*ellipse, color=style.BLUE, lw=1.2)
        for ax in grid[i, i + 1 :]:
            ax.set_visible(False)
    _label(grid, names, fit)
    diverged = "; ×: divergent" if marked is not None and marked.any() else ""
    left_out = f"; the first {MOST} of {len(samples)} parameters" if len(samples) > MOST else ""
    style.head(drawing, title, f"blue: Gaussian, dotted: its 95 % ends{diverged}{left_out}")
    return drawing


def _label(grid: np.ndarray, names: list[str], fit: Fit) -> None:
    """Write names at the left and at the foot only; ticks between cells would be ambiguous."""
    for i, name in enumerate(names):
        label = style.label(name, fit.estimates[name].unit)
        grid[-1, i].set_xlabel(label)
        # In narrow cells the power of ten must not overlap the label.
        power = grid[-1, i].xaxis.get_offset_text()
        power.set_horizontalalignment("left")
        for ax in grid[i:, i]:
            style.limit_ticks(ax, "x", 3)
            ax.tick_params(axis="x", rotation=30)
            _interval_lines(ax.axvline, fit.estimates[name])
        for j, ax in enumerate(grid[i, :i]):
            style.limit_ticks(ax, "y", 4)
            ax.tick_params(axis="y", labelleft=j == 0)
        if i:
            grid[i, 0].set_ylabel(label)
        # The heights of a histogram do not matter, only its shape.
        grid[i, i].set_yticks([])
        grid[i, i].spines["left"].set_visible(False)


# `draw` is axvline or axhline of Matplotlib.
def _interval_lines(draw: Callable[..., object], e: Estimate) -> None:
    for end in (e.lower95, e.upper95):
        if end is not None and np.isfinite(end):
            draw(end, color=style.BLUE, lw=0.8, ls=":")


def gaussian_ellipse(fit: Fit, x: str, y: str) -> Float[np.ndarray, "2 n"] | None:
    """Return the 95 % curve of the fit's Gaussian approximation for two parameters.

    It is an ellipse in the coordinates in which their intervals are symmetric. The result is None
    if the data do not determine both.
    """
    names, pair = fit.verdict.names, (fit.estimates[x], fit.estimates[y])
    if not {x, y} <= set(names) or not all(e.sd and np.isfinite(e.sd) for e in pair):
        return None
    r = float(fit.verdict.correlation[names.index(x), names.index(y)])
    if not abs(r) < 1.0:
        return None
    angle = np.linspace(0.0, 2.0 * np.pi, 181)
    # This is a circle times the Cholesky factor of a correlation matrix.
    unit = np.cos(angle), r * np.cos(angle) + np.sqrt(1.0 - r**2) * np.sin(angle)
    curve = []
    for away, e in zip(unit, pair, strict=True):
        reach = _RADIUS * float(e.sd or 0.0) * away
        # Intervals without zero are symmetric in logarithms.
        one_sign = (e.lower95 or 0.0) * (e.upper95 or 0.0) > 0.0
        curve.append(e.value * np.exp(reach / abs(e.value)) if one_sign else e.value + reach)
    return np.array(curve)
