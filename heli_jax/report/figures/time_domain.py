"""Figures over time: an output with its residual and inputs, and the coefficients of the RLS."""

from typing import TYPE_CHECKING

import numpy as np

from heli_jax import naming
from heli_jax.dynamics.model import Model
from heli_jax.identification.equation_error.baseline import Baseline
from heli_jax.identification.result import Signals
from heli_jax.identification.validation.metrics import metrics
from heli_jax.numbers import vaf_percent
from heli_jax.report import style
from heli_jax.report.figures.panels import Panels, panels
from heli_jax.report.style import label, legend_above, line, samples, subtitle

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def response(
    signals: Signals, output: str, model: Model, *, figure: "Figure | None" = None
) -> Panels:
    """Measured and simulated output, the residual, and the inputs, over time.

    Args:
        signals: one flight, measured and simulated, SI.
        output: the output to show.
        model: its records say the units, and which inputs there are.
        figure: to draw on; a new one where None.
    """
    # In the model's order: a log may have its columns in any, and figures shall be comparable.
    inputs = [n for n in naming.names(model.Inputs) if n in signals.inputs]
    axes = panels(figure, 4.0 + 0.8 * len(inputs), [2.4, 1.0, *[0.8] * len(inputs)])
    unit = naming.unit(model.Outputs, output)
    top, below, *rest = axes
    t = signals.log_times
    # The measured line is the wider and lies behind, so that it still shows as a rim where the
    # simulation covers it.
    samples(top, t, signals.measured[output], color=style.PALE, lw=1.9, label="measured")
    line(top, t, signals.simulated[output], color=style.BLUE, lw=0.9, label="simulated")
    top.set_ylabel(label(output, unit))
    top.set_title(_agreement(signals, output), loc="left")
    legend_above(top)
    residual = signals.residual(output)
    samples(below, t, residual, color=style.VERMILLION, lw=0.7)
    below.axhline(0.0, color="#444444", lw=0.6)
    below.set_ylabel(label("residual", unit))
    for ax, name in zip(rest, inputs, strict=True):
        line(ax, t, signals.inputs[name], color=style.BLACK, lw=0.8, drawstyle="steps-post")
        ax.set_ylabel(label(name, naming.unit(model.Inputs, name)))
    axes[-1].set_xlabel(time_label(signals.log_start))
    # Only panels of one flight share cursor and zoom: those of two have no moment in common.
    axes[0].figure.set_label(signals.flight)
    # A record of one sample has no duration, and matplotlib warns of an axis without length.
    top.set_xlim(t[0], t[-1] if t.size > 1 else t[0] + 1.0)
    return axes


def time_label(log_start: float | None) -> str:
    """Of an axis: time in the log where the flight has one, else from its first sample."""
    return "time [s]" if log_start is None else "time in the log [s]"


def _agreement(signals: Signals, output: str) -> str:
    agreement = metrics(signals.measured[output], signals.simulated[output])
    source = "held out, simulated" if signals.hold_out else "simulated"
    # NaN where the measured output never moves: it has no variance to account for.
    vaf = f", VAF {vaf_percent(agreement.vaf)}" if np.isfinite(agreement.vaf) else ""
    return f"{output}, {style.short(signals.flight)}: {source}{vaf}"


def rls_history(
    baseline: Baseline, *, log_start: float | None = None, figure: "Figure | None" = None
) -> Panels:
    """Every coefficient of the recursive least squares over time, the a's above the b's.

    Args:
        baseline: the recursive least squares.
        log_start: time in the log of its flight's first sample [s], where there is a log.
        figure: to draw on; a new one where None.
    """
    n, history = baseline.order, baseline.history
    begin = log_start or 0.0
    t = begin + baseline.dt * np.arange(history.shape[0])
    # The right margin holds the legends, which have a line for each of up to n + 1 coefficients.
    axes = panels(figure, 4.4, [1.0, 1.0], right=0.75)
    groups = (
        (axes[0], range(n), [f"-a{i + 1}" for i in range(n)]),
        (axes[1], range(n, history.shape[1]), [f"b{i}" for i in range(history.shape[1] - n)]),
    )
    for ax, columns, names in groups:
        _draw_coefficients(ax, t, history[:, list(columns)], names)
    axes[0].set_title(f"RLS coefficients over the record, order {n}", loc="left")
    subtitle(
        axes[0], f"{baseline.input} to {baseline.output}; scaled to the second half of the record"
    )
    axes[0].set_ylabel("-a")
    # b_i is output over input in SI, and each has the same unit; the a's are plain numbers.
    axes[1].set_ylabel("b (SI)")
    axes[1].set_xlabel(time_label(log_start))
    axes[0].figure.set_label(baseline.flight)
    axes[0].set_xlim(begin, max(t[-1], begin + baseline.dt))
    return axes


def _draw_coefficients(ax: "Axes", t: np.ndarray, values: np.ndarray, names: list[str]) -> None:
    """Columns of values (N, k) over t (N,), by their names."""
    ax.set_ylim(*_settled_range(values))
    for k, name in enumerate(names):
        # A high order has more coefficients than the palette has colours.
        dashes = "-" if k < len(style.CYCLE) else "--"
        color = style.CYCLE[k % len(style.CYCLE)]
        # The first samples, with P(0) = 1e12 I, throw coefficients over many powers of ten.
        inside = np.clip(values[:, k], *_widened(ax.get_ylim()))
        line(ax, t, inside, color=color, ls=dashes, label=name)
    ax.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), borderaxespad=0.3, handletextpad=1.0)


def _settled_range(values: np.ndarray) -> tuple[float, float]:
    """Limits that hold what the coefficients do in the second half of the record, and as much
    room again, half of it on either side."""
    later = values[values.shape[0] // 2 :]
    later = later[np.isfinite(later)]
    if not later.size:
        return -1.0, 1.0
    low, high = float(later.min()), float(later.max())
    # Where one coefficient alone has come to rest the range is zero: then a part of its value.
    margin = 0.5 * (high - low) or 0.1 * abs(high) or 1.0
    return low - margin, high + margin


def _widened(limits: tuple[float, float]) -> tuple[float, float]:
    """A little beyond the limits: lines leave the panel, but no path has huge numbers."""
    span = limits[1] - limits[0]
    return limits[0] - span, limits[1] + span
