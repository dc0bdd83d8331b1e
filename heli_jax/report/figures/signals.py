"""Figures over time and by lag: outputs with residuals and inputs, coefficients of the RLS,
whiteness, and a manoeuvre."""

import itertools
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from heli_jax import naming
from heli_jax.dynamics.model import Model
from heli_jax.identification.equation_error.rls import Baseline
from heli_jax.identification.result import Signals
from heli_jax.identification.validation.metrics import (
    BAND99,
    Whiteness,
    band99,
    cross_correlation,
    lags_for,
    metrics,
    seen_autocorrelation,
    sequence,
    whiteness,
)
from heli_jax.numbers import number, percent, vaf_percent
from heli_jax.report import style
from heli_jax.report.frequency import sample_time
from heli_jax.report.style import Panels, label, legend_above, line, panels, samples, subtitle
from heli_jax.simulation.trajectory import Trajectory

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def response(signals: Signals, output: str, model: Model) -> Panels:
    """Measured and simulated output, the residual, and the inputs, over time."""
    # In the model's order: a log may have its columns in any, and figures shall be comparable.
    inputs = [n for n in naming.names(model.Inputs) if n in signals.inputs]
    axes = panels(4.0 + 0.8 * len(inputs), [2.4, 1.0, *[0.8] * len(inputs)])
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


def rls_history(baseline: Baseline, *, log_start: float | None = None) -> Panels:
    """Every coefficient of the recursive least squares over time, the a's above the b's.

    Args:
        log_start: time in the log of its flight's first sample [s], where there is a log.
    """
    n, history = baseline.order, baseline.history
    begin = log_start or 0.0
    t = begin + baseline.dt * np.arange(history.shape[0])
    # The right margin holds the legends, which have a line for each of up to n + 1 coefficients.
    axes = panels(4.4, [1.0, 1.0], right=0.75)
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
    # What they do in the second half of the record, and as much room again; where one alone has
    # come to rest the range is zero: then a part of its value. The first samples, with P(0) = 1e12
    # I, throw them over many powers of ten: lines leave the panel, but no path has huge numbers.
    later = values[values.shape[0] // 2 :]
    later = later[np.isfinite(later)]
    low, high = (float(later.min()), float(later.max())) if later.size else (0.0, 0.0)
    margin = 0.5 * (high - low) or 0.1 * abs(high) or 1.0
    ax.set_ylim(low - margin, high + margin)
    for k, name in enumerate(names):
        inside = np.clip(values[:, k], low - 5 * margin, high + 5 * margin)
        # A high order has more coefficients than the palette has colours.
        dashes = "-" if k < len(style.CYCLE) else "--"
        line(ax, t, inside, color=style.CYCLE[k % len(style.CYCLE)], ls=dashes, label=name)
    ax.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), borderaxespad=0.3, handletextpad=1.0)


def residual_correlation(
    signals: Signals,
    output: str,
    *,
    together: int = 1,
    test: Whiteness | None = None,
) -> Panels:
    """Autocorrelation of the residual (filter error: the innovations) and its correlation with each
    input, with 99 % bands.

    Args:
        together: how many residuals are tested side by side (Bonferroni, as in `whiteness`).
        test: of the fit, whose numbers the figure says; made here unless given.
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
    axes = panels(2.4 + 1.6 * len(inputs), [1.2, *[1.0] * len(inputs)], sharex=False)
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
    for which, color, width, words in (
        (~outside, style.GREY, 0.6, "within the 99 % band"),
        (outside, style.VERMILLION, 0.9, "outside it"),
    ):
        # One path, broken by NaN: stem() and vlines() write an element into the SVG for each of up
        # to a thousand stems.
        feet, gaps = np.zeros(which.sum()), np.full(which.sum(), np.nan)
        stems = np.stack([feet, y[which], gaps], axis=1).ravel()
        ax.plot(np.repeat(x[which], 3), stems, color=color, lw=width, label=words)
    ax.axhline(0.0, color="#444444", lw=0.6)
    # Twice the band at least: where all is white, the band shall look like one.
    most = 2.0 * float(band.max())
    low, high = min(-most, float(np.min(y))), max(most, float(np.max(y)))
    ax.set_ylim(low - 0.06 * (high - low), high + 0.06 * (high - low))


_APART = "rotor_speed"
"""the one output that would press others of its unit flat"""
_KINDS = {
    "m": "position",
    "m/s": "velocity",
    "rad": "attitude",
    "rad/s": "rates",
}
_LENGTHS = (("m", 1.0), ("mm", 1e3), ("µm", 1e6))
_STILL = 0.05
"""span of an axis over the largest of its values, at least: what moves by less is nearly constant,
and not drawn as if it were not"""
_LEAST = {"m": 0.01, "m/s": 0.02, "rad": 0.005, "rad/s": 0.01, "m/s^2": 0.05, "1": 0.02}
"""by unit the span of an axis at least: about what the sensors of such a machine tell apart"""
_HEIGHT, _MARGINS = 1.25, 1.1
"""of a panel, and what is around them [inch]"""
_LEGEND = 1.05
"""right margin that holds the legends [inch]"""
# States and signals of a model are classes of the user's own, with arrays (N,): annotated Any.


def motion(run: Trajectory, model: Model) -> Panels:
    """The outputs over time, those of a unit together: position, velocity, attitude, rates.

    Shaded where the model's range was left.
    """
    shown = [n for n in naming.names(model.Outputs) if n != _APART]
    groups = []
    for unit, names in _by_unit(model.Outputs, shown):
        kind = _KINDS.get(unit or "", names[0]) if len(names) > 1 else names[0]
        groups.append((kind, unit, {n: getattr(run.outputs, n) for n in names}, {}))
    return _over_time(run, f"Motion of {model.name}", groups)


def sticks(run: Trajectory, model: Model) -> Panels:
    """The inputs as they acted, and the rotor's speed where the model has it."""
    groups = []
    for unit, names in _by_unit(model.Inputs, list(naming.names(model.Inputs))):
        values = {n: np.asarray(getattr(run.inputs, n)) for n in names}
        if unit == "m":
            unit, values = _short(values)
        kind = "wind" if names[0].startswith("wind") else "sticks"
        # Held from its sample to the next, as the simulation has it.
        held = {"drawstyle": "steps-post"}
        groups.append((kind if len(names) > 1 else names[0], unit, values, held))
    if _APART in naming.names(model.Outputs):
        values = {_APART: getattr(run.outputs, _APART)}
        groups.append(("rotor speed", naming.unit(model.Outputs, _APART), values, {}))
    return _over_time(run, f"Sticks of {model.name}", groups)


def _by_unit(record: type, names: list[str]) -> list[tuple[str | None, list[str]]]:
    """The names of each unit, in the record's order; a field without one stands for itself."""
    groups: dict[str, list[str]] = {}
    for name in names:
        # What has no unit may be anything: two of them need not share a scale.
        groups.setdefault(naming.unit(record, name) or f"no unit: {name}", []).append(name)
    return [(naming.unit(record, group[0]), group) for group in groups.values()]


def _short(values: dict[str, np.ndarray]) -> tuple[str, dict[str, np.ndarray]]:
    """Lengths [m] in the unit that suits them: a stick moves by millimetres."""
    # One unit for all inputs of a panel, by the largest: they share its axis.
    largest = max(float(np.max(np.abs(v), initial=0.0)) for v in values.values())
    # The first unit in which the largest is 0.1 or more; metres where nothing moves.
    unit, factor = next((u for u in _LENGTHS if largest * u[1] >= 0.1), ("m", 1.0))
    return unit, {name: factor * v for name, v in values.items()}


# Of each panel the words and the unit of its axis, what it shows by name, and how lines look.
type _Shown = tuple[str, str | None, Mapping[str, ArrayLike], Mapping[str, Any]]


def _over_time(run: Trajectory, title: str, groups: Sequence[_Shown]) -> Panels:
    n, t = len(groups), np.asarray(run.times)
    axes = panels(_MARGINS + _HEIGHT * n, [1.0] * n, right=_LEGEND)
    for ax, (kind, unit, values, look) in zip(axes, groups, strict=True):
        for (name, y), color in zip(values.items(), itertools.cycle(style.CYCLE), strict=False):
            line(ax, t, y, color=color, lw=1.1, label=name, **look)
        ax.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), handlelength=1.2, borderaxespad=0.4)
        ax.set_ylabel(label(kind, unit))
        _not_magnified(ax, np.concatenate([np.ravel(np.asarray(v)) for v in values.values()]), unit)
    axes[0].set_title(title, loc="left")
    axes[-1].set_xlabel("time [s]")
    axes[0].set_xlim(t[0], t[-1] if t.size > 1 else t[0] + 1.0)
    left = [name for name, out in run.outside.items() if np.any(out)]
    if left:
        # One shade for all limits together: their names stand above, and several would only darken.
        subtitle(axes[0], f"shaded where the model's range is left: {', '.join(left)}")
        outside = np.any([np.asarray(run.outside[name]) for name in left], axis=0)
        # A zero at either end makes an edge of a stretch that begins or ends with the record.
        edges = np.flatnonzero(np.diff(np.concatenate([[0], outside.astype(int), [0]])))
        for begin, end in edges.reshape(-1, 2).tolist():
            # Up to the next sample, so that a single one outside can be seen.
            for ax in axes:
                last = float(t[min(end, t.size - 1)])
                ax.axvspan(float(t[begin]), last, color=style.ORANGE, alpha=0.22, lw=0, zorder=0)
    return axes


def _not_magnified(ax: "Axes", values: np.ndarray, unit: str | None) -> None:
    """An axis that does not blow up what is nearly constant to the height of its panel."""
    seen = values[np.isfinite(values)]
    if not seen.size:
        return
    low, high = float(seen.min()), float(seen.max())
    least = max(_STILL * max(abs(low), abs(high)), _LEAST.get(unit or "", 0.0))
    if high - low < least:
        middle = 0.5 * (low + high)
        # With the margin of 5 % that matplotlib leaves to either side.
        ax.set_ylim(middle - 0.55 * least, middle + 0.55 * least)
