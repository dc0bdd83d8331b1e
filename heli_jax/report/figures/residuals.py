"""Whether residuals are white: their autocorrelation, and their correlation with the inputs."""

from typing import TYPE_CHECKING

import numpy as np

from heli_jax.identification.result import Signals
from heli_jax.identification.validation.metrics import (
    BAND99,
    Whiteness,
    band99,
    cross_correlation,
    lags_for,
    seen_autocorrelation,
    sequence,
    whiteness,
)
from heli_jax.numbers import number, percent
from heli_jax.report import style
from heli_jax.report.figures.panels import Panels, panels, sample_time
from heli_jax.report.style import subtitle

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def residual_correlation(
    signals: Signals,
    output: str,
    *,
    together: int = 1,
    test: Whiteness | None = None,
    figure: "Figure | None" = None,
) -> Panels:
    """Autocorrelation of the residual (filter error: the innovations) and its correlation with each
    input, with 99 % bands.

    Args:
        signals: one flight, measured and simulated.
        output: whose residual.
        together: how many residuals are tested side by side (Bonferroni, as in `whiteness`).
        test: of the fit, whose numbers the figure says; made here unless given.
        figure: to draw on; a new one where None.
    """
    residual, dt = signals.error(output), sample_time(signals)
    whole, residual = residual, sequence(residual)
    seen = np.arange(whole.size)
    if residual.size < whole.size:
        # Mostly missing: lags count in the sensor's own samples.
        seen = np.flatnonzero(~np.isnan(whole))
        dt *= float(np.median(np.diff(seen)))
    n, lags = residual.size, lags_for(residual.size)
    inputs = list(signals.inputs)
    axes = panels(figure, 2.4 + 1.6 * len(inputs), [1.2, *[1.0] * len(inputs)], sharex=False)
    # What the test of whiteness counts, missing samples left out; without lag 0, at which an
    # autocorrelation is 1 whatever the residual.
    at, r, pairs, whole = seen_autocorrelation(residual)
    _stems(axes[0], dt * at, r * whole, band99(pairs, whole))
    axes[0].set_xlim(0.0, dt * (at[-1] + 0.5))
    axes[0].set_ylabel("autocorrelation")
    _head(axes[0], signals, output, test or whiteness(residual, together))
    for ax, name in zip(axes[1:], inputs, strict=True):
        # Both signs: correlation at negative lags means that the input answers the residual (a
        # pilot, a controller), or that the clocks of the two differ.
        c = cross_correlation(signals.inputs[name][seen], residual, lags)
        band = np.full(c.size, BAND99 / np.sqrt(n))
        _stems(ax, dt * np.arange(-lags, lags + 1), c, band)
        ax.set_xlim(-dt * (lags + 0.5), dt * (lags + 0.5))
        ax.set_ylabel(f"with {name}")
    axes[-1].set_xlabel("lag [s]" + (" (positive: the input came first)" if inputs else ""))
    return axes


def _head(ax: "Axes", signals: Signals, output: str, test: Whiteness) -> None:
    """Title and subtitle: what of which flight, and the test of whiteness."""
    what = "Residual" if signals.innovations is None else "Innovations"
    result = "white" if test.white else "not white"
    flight = style.short(signals.flight)
    ax.set_title(f"{what} of {output}, {flight}: {result}", loc="left")
    lag1 = f"{test.lag1:+.2f}".replace("-", "−")
    subtitle(
        ax,
        f"{percent(test.outside, 1)} of {test.lags} lags outside the 99 % band; "
        f"{lag1} at one sample; Ljung-Box p = {number(test.p_value, 2)}",
    )


def _stems(ax: "Axes", x: np.ndarray, y: np.ndarray, band: np.ndarray) -> None:
    """Stems from zero over a band (lags,); those outside it in another colour and thicker."""
    ax.fill_between(x, -band, band, color=style.SKY, alpha=0.35, lw=0, label="99 % band")
    outside = np.abs(y) > band
    for which, color, width, label in (
        (~outside, style.GREY, 0.6, "within the 99 % band"),
        (outside, style.VERMILLION, 0.9, "outside it"),
    ):
        # One path, broken by NaN: stem() and vlines() write an element into the SVG for each of up
        # to a thousand stems.
        feet, gaps = np.zeros(which.sum()), np.full(which.sum(), np.nan)
        stems = np.stack([feet, y[which], gaps], axis=1).ravel()
        ax.plot(np.repeat(x[which], 3), stems, color=color, lw=width, label=label)
    ax.axhline(0.0, color="#444444", lw=0.6)
    # Twice the band at least: where all is white, the band shall look like one.
    most = 2.0 * float(band.max())
    low, high = min(-most, float(np.min(y))), max(most, float(np.max(y)))
    ax.set_ylim(low - 0.06 * (high - low), high + 0.06 * (high - low))
