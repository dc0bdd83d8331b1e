"""The report's figures: plain data in, matplotlib Axes out.

Each function draws on the `figure` it is given, or on one of its own (`axes[0].figure`). Draw
within `matplotlib.rc_context(style.STYLE)` to get the report's look.
"""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from matplotlib.transforms import ScaledTranslation

from heli_jax import naming
from heli_jax.dynamics.model import Model
from heli_jax.identification.equation_error.baseline import Baseline
from heli_jax.identification.fit import Fit, Signals, StartRow
from heli_jax.identification.identifiability.verdict import Verdict
from heli_jax.identification.uncertainty.comparison import Intervals
from heli_jax.identification.validation.metrics import (
    BAND99,
    autocorrelation,
    cross_correlation,
    lags_for,
    metrics,
    whiteness,
)
from heli_jax.numbers import percent
from heli_jax.report import frequency, style
from heli_jax.report.coherence import COHERENT
from heli_jax.report.style import label, legend_above, line, subtitle

_CONTINUOUS = "fit, continuous"

type Panels = tuple[Axes, ...]


def _panels(
    figure: Figure | None,
    height: float,
    ratios: list[float],
    *,
    sharex: bool = True,
    right: float = 0.2,
) -> Panels:
    """Panels below each other in a given figure or a new one, with their labels in line."""
    n = len(ratios)
    made = style.figure(height) if figure is None else figure
    axes = made.subplots(n, 1, sharex=sharex, squeeze=False, height_ratios=ratios)[:, 0]
    if figure is None:
        style.place(made, n, right=right, gap=0.22 if sharex else 0.36)
    for ax in axes:
        at = ax.transAxes + ScaledTranslation(-0.57, 0.0, made.dpi_scale_trans)
        ax.yaxis.set_label_coords(0.0, 0.5, transform=at)
    return tuple(axes)


def response(
    signals: Signals, output: str, model: Model, *, figure: Figure | None = None
) -> Panels:
    """Measured and simulated output, the residual, and the inputs, over time."""
    inputs = [n for n in naming.names(model.Inputs) if n in signals.inputs]
    axes = _panels(figure, 4.0 + 0.8 * len(inputs), [2.4, 1.0, *[0.8] * len(inputs)])
    unit = naming.unit(model.Outputs, output)
    top, below, *rest = axes
    t = signals.times
    line(top, t, signals.measured[output], color=style.PALE, lw=1.9, label="measured")
    line(top, t, signals.simulated[output], color=style.BLUE, lw=0.9, label="simulated")
    top.set_ylabel(label(output, unit))
    top.set_title(_agreement(signals, output), loc="left")
    legend_above(top)
    residual = signals.residual(output)
    line(below, t, residual, color=style.VERMILLION, lw=0.7)
    below.axhline(0.0, color="#444444", lw=0.6)
    below.set_ylabel(label("residual", unit))
    for ax, name in zip(rest, inputs, strict=True):
        line(ax, t, signals.inputs[name], color=style.BLACK, lw=0.8, drawstyle="steps-post")
        ax.set_ylabel(label(name, naming.unit(model.Inputs, name)))
    axes[-1].set_xlabel("time [s]")
    top.set_xlim(t[0], t[-1] if t.size > 1 else t[0] + 1.0)
    return axes


def _agreement(signals: Signals, output: str) -> str:
    m = metrics(signals.measured[output], signals.simulated[output])
    how = "held out, simulated" if signals.hold_out else "simulated"
    vaf = f", VAF {percent(m.vaf)}" if np.isfinite(m.vaf) else ""
    return f"{output}, {signals.flight}: {how}{vaf}"


def residual_correlation(
    signals: Signals, output: str, *, together: int = 1, figure: Figure | None = None
) -> Panels:
    """Autocorrelation of the residual (filter error: the innovations) and its correlation with each
    input, with 99 % bands."""
    residual, dt = signals.error(output), _dt(signals)
    n, lags = residual.size, lags_for(residual.size)
    names = list(signals.inputs)
    axes = _panels(figure, 2.4 + 1.6 * len(names), [1.2, *[1.0] * len(names)], sharex=False)
    w = whiteness(residual, together)
    found = "white" if w.white else "not white"
    what = "Residual" if signals.innovations is None else "Innovations"
    r = autocorrelation(residual, lags)[1:]
    _stems(axes[0], dt * np.arange(1, lags + 1), r, BAND99 / np.sqrt(n))
    axes[0].set_xlim(0.0, dt * (lags + 0.5))
    axes[0].set_ylabel("autocorrelation")
    axes[0].set_title(f"{what} of {output}, {signals.flight}: {found}", loc="left")
    first = f"{w.lag1:+.2f}".replace("-", "−")
    subtitle(
        axes[0],
        f"{100 * w.outside:.1f} % of {lags} lags outside the 99 % band; {first} at one sample; "
        f"Ljung-Box p = {w.p_value:.2g}",
    )
    for ax, name in zip(axes[1:], names, strict=True):
        c = cross_correlation(signals.inputs[name], residual, lags)
        _stems(ax, dt * np.arange(-lags, lags + 1), c, BAND99 / np.sqrt(n))
        ax.set_xlim(-dt * (lags + 0.5), dt * (lags + 0.5))
        ax.set_ylabel(f"with {name}")
    axes[-1].set_xlabel("lag [s]" + (" (positive: the input came first)" if names else ""))
    return axes


def _dt(signals: Signals) -> float:
    return float(signals.times[1] - signals.times[0]) if signals.times.size > 1 else 1.0


def _stems(ax: Axes, x: np.ndarray, y: np.ndarray, band: float) -> None:
    """Stems from zero over a band; those outside the band in another colour and thicker."""
    ax.axhspan(-band, band, color=style.SKY, alpha=0.35, lw=0, label="99 % band")
    outside = np.abs(y) > band
    for which, color, width in ((~outside, style.GREY, 0.6), (outside, style.VERMILLION, 0.9)):
        feet, gaps = np.zeros(which.sum()), np.full(which.sum(), np.nan)
        stems = np.stack([feet, y[which], gaps], axis=1).ravel()  # one path, broken by NaN
        ax.plot(np.repeat(x[which], 3), stems, color=color, lw=width)
    ax.axhline(0.0, color="#444444", lw=0.6)
    low, high = min(-2.0 * band, float(np.min(y))), max(2.0 * band, float(np.max(y)))
    ax.set_ylim(low - 0.06 * (high - low), high + 0.06 * (high - low))


def bode(
    model: Model,
    params: Any,
    fit: Fit,
    baseline: Baseline | None,
    signals: Signals,
    *,
    output: str | None = None,
    input: str | None = None,
    figure: Figure | None = None,
) -> Panels:
    """Magnitude and phase of the fit, of the RLS and of the record, and the record's coherence.

    The fit is drawn twice: sampled with its input held, as a record can show it and as the RLS
    is, and thin as the continuous H(i omega). An estimated gain and time shift are included.
    `output` and `input` are those of the baseline, or the first ones, unless named.
    """
    output = output or (baseline.output if baseline else next(iter(signals.measured)))
    input = input or (baseline.input if baseline else next(iter(signals.inputs)))
    dt = _dt(signals)
    nyquist, top = np.pi / dt, 1.6 * np.pi / dt
    low = 2 * np.pi / (dt * max(signals.times.size, 8)) * 2
    at = frequency.at_record(model, params, signals, fit)
    memory = frequency.memory(model, params, at, dt * signals.times.size)
    record = frequency.empirical(signals.inputs[input], signals.measured[output], dt, memory)
    found = isinstance(record, frequency.Empirical)
    axes = _panels(figure, 6.0 if found else 4.6, [1.4, 1.2, 0.6] if found else [1.2, 1.0])
    axes[0].set_title(f"{input} to {output}: frequency response", loc="left")
    continuous, sampled = frequency.responses(model, params, output, input, dt, at)
    omega, below = frequency.log_grid(low, top), frequency.log_grid(low, 0.999 * nyquist)
    H = continuous(omega) * frequency.nuisance_factor(fit, input, omega)
    held = sampled(below) * frequency.nuisance_factor(fit, input, below)
    reference = _Reference(omega, H)
    _curve(axes, reference, omega, H, color=style.BLUE, lw=0.7, alpha=0.55, label=_CONTINUOUS)
    _curve(axes, reference, below, held, color=style.BLUE, lw=1.6, label="fit, sampled")
    if baseline is not None and (baseline.output, baseline.input) == (output, input):
        _curve(axes, reference, below, frequency.discrete(baseline, below),
               color=style.ORANGE, lw=1.5, ls=(0, (4, 2)), label="RLS")  # fmt: skip
    note = _draw_record(axes, reference, record, _others(signals, input))
    if not np.isfinite(H).any():
        note = f"the model cannot be linearised about {at.words or 'zero'}; {note}"
    elif at.words:
        note = f"linearised about {at.words}; {note}"
    _finish_bode(axes, nyquist, (low, top), _bode_unit(model, output, input), note)
    return axes


class _Reference:
    """The phase that the other curves are laid beside."""

    def __init__(self, omega: np.ndarray, H: np.ndarray) -> None:
        good = np.isfinite(H) & (np.abs(H) > 0)
        self.log_omega, self.phase = np.log(omega[good]), frequency.phase(H[good])

    def beside(self, omega: np.ndarray, H: np.ndarray) -> np.ndarray:
        """Phase [deg] of H, on the branch nearest to the reference's."""
        if not self.log_omega.size:
            return np.degrees(np.angle(H))
        near = np.interp(np.log(omega), self.log_omega, self.phase)
        return near + (np.degrees(np.angle(H)) - near + 180.0) % 360.0 - 180.0

    def along(self, omega: np.ndarray, H: np.ndarray) -> np.ndarray:
        """The same for a curve: unwrapped, as a whole on the reference's branch."""
        unwrapped = np.degrees(np.unwrap(np.angle(H)))
        if not unwrapped.size:
            return unwrapped
        off = np.median(unwrapped - self.beside(omega, H))
        return unwrapped - 360.0 * np.round(off / 360.0)


def _curve(
    axes: Panels, reference: _Reference, omega: np.ndarray, H: np.ndarray, **how: Any
) -> None:
    good = np.isfinite(H) & (np.abs(H) > 0)
    axes[0].plot(omega[good], 20 * np.log10(np.abs(H[good])), **how)
    axes[1].plot(omega[good], reference.along(omega[good], H[good]), **how)


def _others(signals: Signals, input: str) -> bool:
    return any(np.std(u) > 0 for n, u in signals.inputs.items() if n != input)


def _draw_record(
    axes: Panels, reference: _Reference, record: frequency.Empirical | str, others: bool
) -> str:
    """The record's own response where it is coherent; what to say of it."""
    if isinstance(record, str):
        return f"no empirical response: {record}"
    clear = record.coherence > COHERENT
    omega, H = record.omega[clear], record.H[clear]
    how: dict[str, Any] = {"ls": "", "marker": "o", "ms": 2.2, "mew": 0, "color": style.BLACK}
    name = "record" if clear.any() else None
    axes[0].plot(omega, 20 * np.log10(np.abs(H)), alpha=0.6, label=name, zorder=1.5, **how)
    axes[1].plot(omega, reference.beside(omega, H), alpha=0.6, zorder=1.5, **how)
    line(axes[2], record.omega, record.coherence, color=style.BLACK, lw=0.8)
    axes[2].axhline(COHERENT, color=style.VERMILLION, lw=0.8, ls=":")
    axes[2].set_ylim(0.0, 1.05)
    axes[2].set_ylabel("coherence")
    note = f"record: {record.segments} half-overlapping segments, where coherence > {COHERENT}"
    if not clear.any():
        note = f"no empirical response: coherence stays below {COHERENT}"
    return note + ("; other inputs taken as uncorrelated" if others else "")


def _bode_unit(model: Model, output: str, input: str) -> str:
    out, into = naming.unit(model.Outputs, output), naming.unit(model.Inputs, input)
    return f"dB re {out}/{into}" if out and into and "/" not in into else "dB"


def _finish_bode(
    axes: Panels, nyquist: float, limits: tuple[float, float], unit: str, note: str
) -> None:
    for ax in axes:
        ax.axvline(nyquist, color=style.GREY, lw=0.9, ls="-.", label="_nyquist")
    axes[0].set_xscale("log")
    axes[0].set_xlim(*limits)
    style.plain_log_ticks(axes[0].xaxis)
    axes[0].set_ylim(*_within(axes[0], 40.0))
    axes[1].set_ylim(*_within(axes[1], 180.0))
    axes[0].annotate(
        "Nyquist ",
        (nyquist, 0.03),
        xycoords=("data", "axes fraction"),
        ha="right",
        fontsize=8,
        color=style.GREY,
    )
    axes[0].set_ylabel(f"magnitude [{unit}]")
    axes[1].set_ylabel("phase [deg]")
    axes[1].yaxis.set_major_locator(MaxNLocator(nbins=6, steps=[1, 1.5, 3, 4.5, 9, 10]))
    axes[-1].set_xlabel("frequency [rad/s]")
    subtitle(axes[0], note)
    legend_above(axes[0], raised=True)


def _within(ax: Axes, beyond: float) -> tuple[float, float]:
    """Limits that hold what can be seen of fit and record, and the rest no more than `beyond`
    further: the RLS, and the continuous fit past the Nyquist frequency."""
    curves = [c for c in ax.get_lines() if c.get_label() not in ("RLS", _CONTINUOUS, "_nyquist")]
    y = np.concatenate([np.asarray(c.get_ydata(), float) for c in curves] or [np.zeros(1)])
    low, high = ax.get_ylim()
    if not y.size:
        return low, high
    return max(low, float(y.min()) - beyond), min(high, float(y.max()) + beyond)


def correlation_matrix(verdict: Verdict, *, figure: Figure | None = None) -> Panels:
    """How the estimates of the parameters hang together: +1 and -1 cannot be told apart."""
    names, r = verdict.names, verdict.correlation
    n = len(names)
    side = min(style.WIDTH, 1.5 + 0.62 * n)
    made = style.figure(side, min(style.WIDTH, side + 0.5)) if figure is None else figure
    if figure is None:
        made.set_layout_engine("constrained")  # names may be long
    ax = made.subplots()
    ax.pcolormesh(r, cmap="PuOr", vmin=-1.0, vmax=1.0, edgecolors="white", linewidth=1.5)
    ax.set_aspect("equal")
    ax.invert_yaxis()
    centres = np.arange(n) + 0.5
    ax.set_xticks(centres, names, rotation=35 if max(map(len, names)) > 4 else 0)
    ax.set_yticks(centres, names)
    ax.grid(visible=False)
    ax.tick_params(length=0)
    ax.spines[:].set_visible(False)
    size = 8.5 if n < 9 else 6.0
    for i in range(n):
        for j in range(n):
            color = "white" if abs(r[i, j]) > 0.6 else "black"
            text = _correlation(float(r[i, j]), i == j)
            ax.text(j + 0.5, i + 0.5, text, ha="center", va="center", size=size, color=color)
    ax.set_title("Correlation of the estimates", loc="left")
    if verdict.undetermined:
        subtitle(ax, "what the data leave open is left out")
    return (ax,)


def _correlation(r: float, diagonal: bool) -> str:
    """Two digits, five where the last ones count."""
    if diagonal:
        return "1"
    text = f"{r:+.5f}" if abs(r) > 0.995 else f"{r:+.2f}"
    return "0.00" if text in ("+0.00", "-0.00") else text.replace("-", "−")


def waterfall(starts: tuple[StartRow, ...], *, figure: Figure | None = None) -> Panels:
    """The cost that each start reached, best first; () where there is one start or none."""
    if len(starts) < 2:
        return ()
    rows = sorted(starts, key=lambda s: s.cost if np.isfinite(s.cost) else np.inf)
    cost = np.array([s.cost for s in rows])
    finite = np.isfinite(cost)
    ok = np.array([s.converged for s in rows])
    [ax] = _panels(figure, 2.8, [1.0])
    low, top = _cost_range(cost[finite])
    many = low > 0 and top > 30 * low
    spread = max(top - low, 0.02 * abs(top), 1e-300)
    shown = np.where(finite, cost, 3.0 * top if many else top + 0.4 * spread)
    x = np.arange(1, len(rows) + 1)
    ax.plot(x[finite], shown[finite], color=style.PALE, lw=0.8, zorder=1)
    ax.plot(x[ok], shown[ok], "o", ms=6, color=style.BLUE, label="converged")
    if not ok.all():
        ax.plot(x[~ok], shown[~ok], "X", ms=7, color=style.VERMILLION, label="failed")
    _number_optima(ax, rows, x, shown)
    if many:
        ax.set_yscale("log")
        ax.margins(y=0.25)
        style.plain_log_ticks(ax.yaxis)
    else:
        middle = 0.5 * (top + low)
        ax.set_ylim(middle - 0.9 * spread, middle + 1.1 * spread)
        ax.ticklabel_format(axis="y", useOffset=False)
    ax.set_xlim(0.4, len(rows) + 0.6)
    ax.xaxis.set_major_locator(MaxNLocator(integer=True, nbins=16))
    ax.set_xlabel("start, sorted by cost")
    ax.set_ylabel("cost")
    ax.set_title(_starts_said(rows), loc="left")
    if not finite.all():
        subtitle(ax, "starts that ended without a finite cost are drawn on top")
    legend_above(ax, raised=not finite.all())
    return (ax,)


def _cost_range(cost: np.ndarray) -> tuple[float, float]:
    return (float(cost.min()), float(cost.max())) if cost.size else (1.0, 1.0)


def _number_optima(ax: Axes, rows: list[StartRow], x: np.ndarray, shown: np.ndarray) -> None:
    """Name each optimum once, at the first start that reached it."""
    named: set[int] = set()
    for i, row in enumerate(rows):
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


def _starts_said(rows: list[StartRow]) -> str:
    best = sum(r.optimum == 1 for r in rows)
    failed = sum(not r.converged for r in rows)
    said = f"{best} of {len(rows)} starts reached the best optimum"
    return f"{said}, {failed} failed" if failed else said


def rls_history(baseline: Baseline, *, figure: Figure | None = None) -> Panels:
    """Every coefficient of the recursive least squares over time, the a's above the b's."""
    n, h = baseline.order, baseline.history
    t = baseline.dt * np.arange(h.shape[0])
    axes = _panels(figure, 4.4, [1.0, 1.0], right=0.75)
    groups = (
        (axes[0], range(n), [f"-a{i + 1}" for i in range(n)]),
        (axes[1], range(n, h.shape[1]), [f"b{i}" for i in range(h.shape[1] - n)]),
    )
    for ax, columns, names in groups:
        ax.set_ylim(*_settled_range(h[:, list(columns)]))
        for k, (column, name) in enumerate(zip(columns, names, strict=True)):
            dashes = "-" if k < len(style.CYCLE) else "--"
            color = style.CYCLE[k % len(style.CYCLE)]
            inside = np.clip(h[:, column], *_far(ax.get_ylim()))
            line(ax, t, inside, color=color, ls=dashes, label=name)
        ax.legend(
            loc="center left", bbox_to_anchor=(1.0, 0.5), borderaxespad=0.3, handletextpad=1.0
        )
    axes[0].set_title(f"RLS coefficients over the record, order {n}", loc="left")
    subtitle(
        axes[0], f"{baseline.input} to {baseline.output}; scaled to the second half of the record"
    )
    axes[0].set_ylabel("-a")
    axes[1].set_ylabel("b (SI)")
    axes[1].set_xlabel("time [s]")
    axes[0].set_xlim(0.0, max(t[-1], baseline.dt))
    return axes


def _settled_range(values: np.ndarray) -> tuple[float, float]:
    """Limits that hold what the coefficients do in the second half of the record, and as much
    room again, half of it on either side."""
    later = values[values.shape[0] // 2 :]
    later = later[np.isfinite(later)]
    if not later.size:
        return -1.0, 1.0
    low, high = float(later.min()), float(later.max())
    margin = 0.5 * (high - low) or 0.1 * abs(high) or 1.0
    return low - margin, high + margin


def _far(limits: tuple[float, float]) -> tuple[float, float]:
    """A little beyond the limits: lines leave the panel, but no path has huge numbers."""
    span = limits[1] - limits[0]
    return limits[0] - span, limits[1] + span


_METHODS = {
    "gaussian": ("Gaussian", style.BLUE),
    "profile": ("profile", style.VERMILLION),
    "bootstrap": ("bootstrap", style.GREEN),
    "nuts": ("NUTS", style.PURPLE),
}


def intervals(found: Intervals, fit: Fit, *, figure: Figure | None = None) -> Panels:
    """95 % intervals by every method, and the likelihood of the profile; one panel a parameter."""
    names = list(found.by_parameter)
    if not names:
        return ()
    made = style.figure(1.9, style.WIDTH) if figure is None else figure
    if figure is None:
        made.set_layout_engine("constrained")
    axes = np.atleast_1d(made.subplots(1, len(names)))
    have = [m for m in _METHODS if any(m in by for by in found.by_parameter.values())]
    for ax, name in zip(axes, names, strict=True):
        by, one = found.by_parameter[name], fit.estimates[name]
        for k, m in enumerate(have):
            if m in by:
                ax.plot(by[m], [-k, -k], "|-", color=_METHODS[m][1], lw=2.2, ms=9)
        ax.axvline(one.value, color=style.GREY, lw=0.8, ls=":")
        if name in found.profiles:
            p = found.profiles[name]
            near = p.deviance < 9.0
            height = 0.2 - (len(have) - 1) * (1.0 - np.exp(-0.5 * p.deviance[near]))
            ax.plot(p.values[near], height, color=style.VERMILLION, lw=0.8, alpha=0.6)
        ax.set_yticks([-k for k in range(len(have))], [_METHODS[m][0] for m in have])
        ax.tick_params(axis="y", labelleft=name == names[0])
        ax.set_ylim(-len(have) + 0.4, 0.6)
        ax.xaxis.set_major_locator(MaxNLocator(nbins=3))
        ax.set_xlabel(style.label(name, one.unit))
    axes[0].set_title("95 % intervals", loc="left")
    return tuple(axes)
