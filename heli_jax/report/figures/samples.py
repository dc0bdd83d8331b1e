"""Figures of what was sampled: chains by draw, and every pair of parameters beside the fit's
Gaussian approximation."""

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from heli_jax.identification.result import Estimate, Fit
from heli_jax.identification.uncertainty.bootstrap import Bootstrap
from heli_jax.identification.uncertainty.nuts import Posterior
from heli_jax.report import style
from heli_jax.report.figures.panels import Panels
from heli_jax.report.style import subtitle

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MOST = 6
"""parameters that are drawn: of more the cells are too small to be read"""
_RADIUS = 2.4477
"""sd that an ellipse reaches for 95 % of a normal distribution in two dimensions to lie in it: the
root of chi-squared's 95 % point at two degrees of freedom"""
_DOTS = 1500
"""samples of which dots are drawn: of more they hide one another"""


def trace(posterior: Posterior, fit: Fit, *, figure: "Figure | None" = None) -> Panels:
    """The chains by draw, one panel for each of the first parameters.

    Args:
        posterior: the draws.
        fit: its estimates are marked.
        figure: to draw on; a new one where None.
    """
    names = list(posterior.draws)[:MOST]
    drawing = style.figure(0.9 + 1.05 * len(names)) if figure is None else figure
    if figure is None:
        # Draws differ in their last digits, and ticks with all of them need the room they need.
        drawing.set_layout_engine("constrained")
    axes = tuple(drawing.subplots(len(names), 1, sharex=True, squeeze=False)[:, 0])
    for ax, name in zip(axes, names, strict=True):
        for i, chain in enumerate(posterior.draws[name]):
            style.line(ax, np.arange(chain.size), chain, color=style.CYCLE[i], lw=0.5)
        ax.axhline(fit.estimates[name].value, color=style.GREY, lw=0.9, ls=":")
        style.few_ticks(ax, "y", 4)
        ax.set_ylabel(style.label(name, fit.estimates[name].unit))
    _mark_divergent(axes[-1], posterior)
    axes[-1].set_xlabel("draw")
    axes[0].set_title("Draws of the chains", loc="left")
    subtitle(axes[0], f"dotted: the estimate{_left_out(len(posterior.draws))}")
    return axes


def _mark_divergent(ax: "Axes", posterior: Posterior) -> None:
    diverging = posterior.statistics.get("diverging")
    if diverging is None or not np.any(diverging):
        return
    at = np.flatnonzero(np.any(diverging, axis=0))
    # At the foot of the last panel, whatever the draws' values.
    foot = ax.get_xaxis_transform()
    ax.plot(at, np.zeros(at.size), "|", color=style.BLACK, ms=9, transform=foot, clip_on=False)


def posterior_pairs(posterior: Posterior, fit: Fit, *, figure: "Figure | None" = None) -> Panels:
    """Draws by pairs of parameters, divergent ones marked.

    Args:
        posterior: the draws.
        fit: whose Gaussian approximation is drawn beside them.
        figure: to draw on; a new one where None.
    """
    draws = {name: np.asarray(v).ravel() for name, v in posterior.draws.items()}
    diverging = posterior.statistics.get("diverging")
    marked = None if diverging is None else np.asarray(diverging).ravel()
    return _pairs(draws, fit, "Draws from the posterior", style.PURPLE, marked, figure)


def bootstrap_pairs(booted: Bootstrap, fit: Fit, *, figure: "Figure | None" = None) -> Panels:
    """Estimates from simulated records by pairs of parameters; () where fewer than two were fitted.

    Args:
        booted: the estimates.
        fit: whose Gaussian approximation is drawn beside them.
        figure: to draw on; a new one where None.
    """
    if len(next(iter(booted.values.values()), ())) < 2:
        return ()
    return _pairs(booted.values, fit, "Estimates of the bootstrap", style.GREEN, None, figure)


def _pairs(
    samples: Mapping[str, np.ndarray],
    fit: Fit,
    title: str,
    color: str,
    marked: np.ndarray | None,
    figure: "Figure | None",
) -> Panels:
    names = list(samples)[:MOST]
    n = len(names)
    side = min(style.WIDTH, 2.2 + 1.3 * n)
    drawing = style.figure(side if n > 1 else 2.6, side) if figure is None else figure
    if figure is None:
        # The title is wider than the cell that it stands above: it has a row of its own.
        height = float(drawing.get_size_inches()[1])
        drawing.set_layout_engine("constrained", rect=(0.0, 0.0, 1.0, 1.0 - style.TOP / height))
    grid = drawing.subplots(n, n, squeeze=False, sharex="col")
    shown = slice(None, None, max(1, -(-next(iter(samples.values())).size // _DOTS)))
    for i, below in enumerate(names):
        _histogram(grid[i, i], samples[below], fit.estimates[below], color)
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
    first = grid[0, 0]
    heading = first.set_title(title, loc="left")
    diverged = "; ×: divergent" if marked is not None and marked.any() else ""
    subtitle(first, f"blue: Gaussian, dotted: its 95 % ends{diverged}{_left_out(len(samples))}")
    for text in (heading, first.texts[-1]):
        text.set_in_layout(False)
    return tuple(ax for i in range(n) for ax in grid[i, : i + 1])


def _label(grid: np.ndarray, names: list[str], fit: Fit) -> None:
    """Names at the left and at the foot; ticks between would be read for another cell's."""
    for i, name in enumerate(names):
        label = style.label(name, fit.estimates[name].unit)
        grid[-1, i].set_xlabel(label)
        # A power of ten beside the axis and not upon its label, in narrow cells.
        power = grid[-1, i].xaxis.get_offset_text()
        power.set_horizontalalignment("left")
        for ax in grid[i:, i]:
            style.few_ticks(ax, "x", 3)
            ax.tick_params(axis="x", rotation=30)
            _interval_lines(ax.axvline, fit.estimates[name])
        for j, ax in enumerate(grid[i, :i]):
            style.few_ticks(ax, "y", 4)
            ax.tick_params(axis="y", labelleft=j == 0)
        if i:
            grid[i, 0].set_ylabel(label)
        # Heights of a histogram are of no interest beside its shape.
        grid[i, i].set_yticks([])
        grid[i, i].spines["left"].set_visible(False)


# One of matplotlib's two methods: axvline or axhline.
def _interval_lines(draw: Callable[..., object], e: Estimate) -> None:
    for end in (e.lower95, e.upper95):
        if end is not None and np.isfinite(end):
            draw(end, color=style.BLUE, lw=0.8, ls=":")


def _histogram(ax: "Axes", values: np.ndarray, e: Estimate, color: str) -> None:
    ax.hist(values, bins=min(40, max(8, round(values.size**0.5))), density=True, color=color)
    x = np.linspace(*ax.get_xlim(), 200)
    sd = e.sd
    if sd is None or not sd > 0:
        return
    # By the coordinate in which the interval is symmetric, as the ellipses are.
    at, slope = coordinate(x, e), 1.0
    if logarithmic(e):
        sd, slope = sd / abs(e.value), 1.0 / np.abs(x)
    density = np.exp(-0.5 * (at / sd) ** 2) / (sd * np.sqrt(2.0 * np.pi)) * slope
    ax.plot(x, np.where(np.isfinite(density), density, 0.0), color=style.BLUE, lw=1.2)


def logarithmic(e: Estimate) -> bool:
    """Whether an estimate's interval reaches by equal factors and not by equal amounts."""
    if e.lower95 is None or e.upper95 is None or not min(e.lower95, e.upper95) * e.value > 0:
        return False
    if not max(e.lower95, e.upper95) * e.value > 0:
        return False
    by_factors = abs(np.log(e.upper95 / e.value) + np.log(e.lower95 / e.value))
    return bool(by_factors < abs(e.upper95 + e.lower95 - 2.0 * e.value) / abs(e.value))


def coordinate(values: np.ndarray, e: Estimate) -> np.ndarray:
    """Values less the estimate, in the coordinate in which the interval is symmetric: log |value|
    or the value itself."""
    if not logarithmic(e):
        return values - e.value
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.log(values / e.value)


def _factor(fit: Fit, x: str, y: str) -> Float[np.ndarray, "2 2"] | None:
    """Cholesky factor of the covariance of two estimates in those coordinates; None where there is
    none."""
    names = fit.verdict.names
    if x not in names or y not in names:
        return None
    sds = []
    for e in (fit.estimates[x], fit.estimates[y]):
        if e.sd is None or not (np.isfinite(e.sd) and e.sd > 0):
            return None
        sds.append(e.sd / abs(e.value) if logarithmic(e) else e.sd)
    r = float(fit.verdict.correlation[names.index(x), names.index(y)])
    if not abs(r) < 1.0:
        return None
    return np.array([[sds[0], 0.0], [r * sds[1], np.sqrt(1.0 - r**2) * sds[1]]])


def gaussian_ellipse(fit: Fit, x: str, y: str) -> Float[np.ndarray, "2 n"] | None:
    """The curve within which 95 % of the fit's Gaussian approximation lie, of two parameters.

    It is an ellipse in the coordinates in which their intervals are symmetric. None where the data
    do not determine both.

    Args:
        fit: with estimates, sd (that of the reported intervals) and correlation.
        x, y: the parameters.
    """
    factor = _factor(fit, x, y)
    if factor is None:
        return None
    angle = np.linspace(0.0, 2.0 * np.pi, 181)
    away = _RADIUS * factor @ np.array([np.cos(angle), np.sin(angle)])
    curve = []
    for d, e in zip(away, (fit.estimates[x], fit.estimates[y]), strict=True):
        curve.append(e.value * np.exp(d) if logarithmic(e) else e.value + d)
    return np.array(curve)


def share_within(fit: Fit, samples: Mapping[str, np.ndarray], x: str, y: str) -> float | None:
    """The share of the samples within the ellipse of two parameters; 0.95 where the Gaussian
    approximation holds."""
    factor = _factor(fit, x, y)
    if factor is None:
        return None
    away = np.array([coordinate(np.ravel(samples[n]), fit.estimates[n]) for n in (x, y)])
    white = np.linalg.solve(factor, away)
    # A sample of the other sign has no logarithm, and lies outside.
    return float(np.mean(np.sum(white**2, axis=0) < _RADIUS**2))


def _left_out(count: int) -> str:
    return f"; the first {MOST} of {count} parameters" if count > MOST else ""
