"""Figures of the estimates: their correlation, their intervals, and what each start reached."""

from typing import TYPE_CHECKING

import numpy as np

from heli_jax.identification.identifiability.verdict import Verdict
from heli_jax.identification.result import Fit, StartRow
from heli_jax.identification.uncertainty.comparison import Intervals
from heli_jax.identification.uncertainty.profile_likelihood import Profile
from heli_jax.report import style
from heli_jax.report.figures.panels import Panels, panels
from heli_jax.report.style import legend_above, subtitle

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def correlation_matrix(verdict: Verdict, *, figure: "Figure | None" = None) -> Panels:
    """How the estimates of the parameters are correlated: near +1 or -1 the data cannot tell two
    of them apart."""
    names, r = verdict.names, verdict.correlation
    n = len(names)
    side = min(style.WIDTH, 1.5 + 0.62 * n)
    drawing = style.figure(side, min(style.WIDTH, side + 0.5)) if figure is None else figure
    if figure is None:
        # Slow, but names of any length stand beside the matrix, and no fixed margin suits all.
        drawing.set_layout_engine("constrained")
    ax = drawing.subplots()
    # Two colours of equal weight, told apart with every common kind of colour blindness.
    ax.pcolormesh(r, cmap="PuOr", vmin=-1.0, vmax=1.0, edgecolors="white", linewidth=1.5)
    ax.set_aspect("equal")
    _name_cells(ax, names)
    _write_correlations(ax, r)
    ax.set_title("Correlation of the estimates", loc="left")
    if verdict.undetermined:
        subtitle(ax, "directions that are not identifiable are left out")
    return (ax,)


def _name_cells(ax: "Axes", names: tuple[str, ...]) -> None:
    # The first parameter on top, as a matrix is read; pcolormesh counts from below.
    ax.invert_yaxis()
    centres = np.arange(len(names)) + 0.5
    ax.set_xticks(centres, names, rotation=35 if max(map(len, names)) > 4 else 0)
    ax.set_yticks(centres, names)
    ax.grid(visible=False)
    ax.tick_params(length=0)
    ax.spines[:].set_visible(False)


def _write_correlations(ax: "Axes", r: np.ndarray) -> None:
    size = 8.5 if len(r) < 9 else 6.0
    for (i, j), value in np.ndenumerate(r):
        color = "white" if abs(value) > 0.6 else "black"  # to be read on a dark cell
        text = _cell_text(float(value), i == j)
        ax.text(j + 0.5, i + 0.5, text, ha="center", va="center", size=size, color=color)


def _cell_text(r: float, diagonal: bool) -> str:
    """A correlation in two digits, five where the last ones count; 1 on the diagonal."""
    if diagonal:
        return "1"
    if not np.isfinite(r):
        return ""
    # 0.996 and 0.99996 differ by a factor of ten in what an interval gains from the other
    # parameter, sqrt(1 - r^2); at two digits both are 1.00.
    text = f"{r:+.5f}" if abs(r) > 0.995 else f"{r:+.2f}"
    return "0.00" if text in ("+0.00", "-0.00") else text.replace("-", "−")


def waterfall(starts: tuple[StartRow, ...], *, figure: "Figure | None" = None) -> Panels:
    """The cost that each start reached, best first; () where there is one start or none."""
    if len(starts) < 2:
        return ()
    [ax] = panels(figure, 2.8, [1.0])
    rows = sorted(starts, key=lambda s: s.cost if np.isfinite(s.cost) else np.inf)
    cost = np.array([s.cost for s in rows])
    finite = np.isfinite(cost)
    low, top = _cost_range(cost[finite])
    logarithmic = low > 0 and top > 30 * low
    # Where all starts agree to rounding, 2 % of the cost: an axis over rounding errors would show
    # differences where there are none.
    span = max(top - low, 0.02 * abs(top), 1e-300)
    shown = np.where(finite, cost, 3.0 * top if logarithmic else top + 0.4 * span)
    ok = np.array([s.converged for s in rows])
    x = np.arange(1, len(rows) + 1)
    ax.plot(x[finite], shown[finite], color=style.PALE, lw=0.8, zorder=1)
    ax.plot(x[ok], shown[ok], "o", ms=6, color=style.BLUE, label="converged")
    if not ok.all():
        ax.plot(x[~ok], shown[~ok], "X", ms=7, color=style.VERMILLION, label="failed")
    _number_optima(ax, rows, x, shown)
    _scale_cost(ax, 0.5 * (top + low), span, logarithmic=logarithmic)
    ax.set_xlim(0.4, len(rows) + 0.6)
    style.few_ticks(ax, "x", 16, integer=True)
    ax.set_xlabel("start, sorted by cost")
    ax.set_ylabel("cost")
    ax.set_title(_starts_title(rows), loc="left")
    if not finite.all():
        subtitle(ax, "starts that ended without a finite cost are drawn on top")
    legend_above(ax, raised=not finite.all())
    return (ax,)


def _scale_cost(ax: "Axes", middle: float, span: float, *, logarithmic: bool) -> None:
    if logarithmic:
        ax.set_yscale("log")
        ax.margins(y=0.25)
        style.plain_log_ticks(ax, "y")
    else:
        # More room above, where the optima's names stand.
        ax.set_ylim(middle - 0.9 * span, middle + 1.1 * span)
        # The cost itself, not its difference from a number that stands elsewhere on the axis.
        ax.ticklabel_format(axis="y", useOffset=False)


def _cost_range(cost: np.ndarray) -> tuple[float, float]:
    return (float(cost.min()), float(cost.max())) if cost.size else (1.0, 1.0)


def _number_optima(ax: "Axes", rows: list[StartRow], x: np.ndarray, shown: np.ndarray) -> None:
    """Name each optimum once, at the first start that reached it."""
    named: set[int] = set()
    for i, row in enumerate(rows):
        # Twelve at most: further ones are far from the best, and their names would overlap.
        if row.optimum and row.optimum not in named and len(named) < 12:
            named.add(row.optimum)
            ax.annotate(
                f"optimum {row.optimum}" if len(named) < 4 else f"{row.optimum}",
                (x[i], shown[i]),
                xytext=(0, 9),
                textcoords="offset points",
                ha="left" if i == 0 else "center",
                fontsize=8,
            )


def _starts_title(rows: list[StartRow]) -> str:
    best = sum(r.optimum == 1 for r in rows)
    failed = sum(not r.converged for r in rows)
    text = f"{best} of {len(rows)} starts reached the best optimum"
    return f"{text}, {failed} failed" if failed else text


_METHODS = {
    "gaussian": ("Gaussian", style.BLUE),
    "profile": ("profile", style.VERMILLION),
    "bootstrap": ("bootstrap", style.GREEN),
    "nuts": ("NUTS", style.PURPLE),
}


def intervals(comparison: Intervals, fit: Fit, *, figure: "Figure | None" = None) -> Panels:
    """95 % intervals by every method, and the likelihood of the profile; one panel a parameter.

    Args:
        comparison: the intervals, by parameter and method.
        fit: its estimates are marked.
        figure: to draw on; a new one where None.
    """
    names = list(comparison.by_parameter)
    if not names:
        return ()
    drawing = style.figure(1.9, style.WIDTH) if figure is None else figure
    if figure is None:
        drawing.set_layout_engine("constrained")
    axes = np.atleast_1d(drawing.subplots(1, len(names)))
    # The methods that any parameter has, so that a row is the same method in every panel.
    present = [m for m in _METHODS if any(m in by for by in comparison.by_parameter.values())]
    for ax, name in zip(axes, names, strict=True):
        by_method, estimate = comparison.by_parameter[name], fit.estimates[name]
        for k, m in enumerate(present):
            if m in by_method:
                ax.plot(by_method[m], [-k, -k], "|-", color=_METHODS[m][1], lw=2.2, ms=9)
        ax.axvline(estimate.value, color=style.GREY, lw=0.8, ls=":")
        if name in comparison.profiles:
            _draw_likelihood(ax, comparison.profiles[name], len(present))
        ax.set_yticks([-k for k in range(len(present))], [_METHODS[m][0] for m in present])
        ax.tick_params(axis="y", labelleft=name == names[0])
        ax.set_ylim(-len(present) + 0.4, 0.6)
        style.few_ticks(ax, "x", 3)
        ax.set_xlabel(style.label(name, estimate.unit))
    axes[0].set_title("95 % intervals", loc="left")
    return tuple(axes)


def _draw_likelihood(ax: "Axes", profile: Profile, rows: int) -> None:
    # A deviance of 9 is three standard deviations: further out lies what sets no interval.
    near = profile.deviance < 9.0
    # The likelihood, exp(-deviance/2), from 1 above the first row down to 0 at the last.
    height = 0.2 - (rows - 1) * (1.0 - np.exp(-0.5 * profile.deviance[near]))
    ax.plot(profile.values[near], height, color=style.VERMILLION, lw=0.8, alpha=0.6)
