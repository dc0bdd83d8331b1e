"""Files and page of a controller."""

import csv
import functools
import io
from pathlib import Path
from typing import Any

import numpy as np

from heli_jax import naming
from heli_jax.analysis.handling_qualities import handling_qualities
from heli_jax.analysis.response_curves import Curve, Point
from heli_jax.control.controller import gains_of
from heli_jax.control.laws import Cascade, StateFeedback, content_of
from heli_jax.control.loops import all_stable
from heli_jax.numbers import number, percent
from heli_jax.report import style
from heli_jax.report.charts import (
    Chart,
    Numbers,
    Panel,
    Series,
    band,
    described,
    panel,
    time_limits,
)
from heli_jax.report.figures.bode import phase
from heli_jax.report.files import as_json
from heli_jax.report.origin import origin
from heli_jax.report.page import filled, of_file, picture
from heli_jax.report.style import label
from heli_jax.report.tables import Table
from heli_jax.simulation.trajectory import STATUS

# `run` is a ControlRun of `heli_jax.control_workflow`, which imports this module.

_FILES = ("control.json", "gains.csv")
_SHARE = 0.99
"""Share of stable vehicles below which there is a doubt."""
_OUTSIDE = STATUS.index("outside the model's range")
_LOWEST = 0.1
"""Lowest frequency of Bode charts [rad/s]."""
_EDGES = (0.05, 0.95)
"""Quantiles of bands and tables."""


def summary(run: Any) -> str:
    """Return the share of stable vehicles, and the least margins, in a sentence or two."""
    count = len(run.margins[0].stable) + run.lost
    alone = run.fit is None
    if alone:
        stable = "stable" if run.stable == 1.0 else "unstable"
        words = f"The vehicle of the configuration is {stable}."
    else:
        words = f"{percent(run.stable, 1)} of {count} vehicles of the posterior are stable."
    if run.stable <= 1.0 - _EDGES[0]:
        return words
    least = []
    for kind, unit in (("gain", "dB"), ("phase", "deg")):
        # Of each vehicle's worst loop.
        values = np.array([getattr(m, kind) for m in run.margins])
        worst = run.commands[int(np.argmin(np.nanmedian(values, axis=1)))]
        size = _quantile(np.min(values, axis=0), _EDGES[0], run.lost)
        least.append(f"{kind} margin {number(size, 3)} {unit} ({worst})")
    often = "" if alone else "; 95 % of the vehicles have more"
    return f"{words} Least {' and '.join(least)}{often}."


def tuning(run: Any) -> str:
    """Return the effect of the tuning in a sentence; empty without one."""
    if run.tuned is None:
        return ""
    cost, distance = run.tuned.cost, run.tuned.distance
    count = min(run.config.config.control.vehicles, len(run.margins[0].stable))
    vehicles = "one vehicle" if count == 1 else f"{count} vehicles"
    return (
        f"Tuned for {vehicles}: cost from {number(cost[0], 3)} to {number(cost[1], 3)}, least "
        f"distance of a loop from -1 from {number(distance[0], 3)} to {number(distance[1], 3)}."
    )


def doubts(run: Any) -> list[str]:
    """Return what limits the trust in a controller."""
    found, tuned = [], run.tuned
    unstable = 1.0 - float(np.mean(all_stable(run.margins)))
    if unstable > 1.0 - _SHARE:
        found.append(f"{percent(unstable, 1)} of the vehicles are unstable. {_unstable(run)}")
    for words, share in (
        ("diverge in this flight", np.mean(run.flown.status > _OUTSIDE)),
        ("leave the model's range in this flight", np.mean(run.flown.status == _OUTSIDE)),
    ):
        if share > 1.0 - _SHARE:
            found.append(
                f"{percent(float(share), 1)} of the vehicles {words}, though the margins are those "
                "of small deviations: smaller steps and gusts, or limits of the commands."
            )
    if tuned is not None and not tuned.converged:
        wanted = run.config.config.control.distance
        reason = (
            f"keeps a distance of {number(tuned.distance[1], 3)} from -1 instead of {wanted:g}"
            if tuned.distance[1] < wanted - 0.02
            else "did not converge, or does not keep a bandwidth"
        )
        found.append(
            f"The tuning {reason}: a larger control.max_steps, smaller control.distance or "
            "bandwidth, or gentler weights."
        )
    if run.lost:
        found.append(f"{run.lost} vehicles have no such steady flight, and count as unstable.")
    if run.fit is None:
        found.append("No fit was given: the margins are those of one vehicle.")
    elif run.fit.distrust:
        found.append(f"The fit's intervals are not trusted: {run.fit.distrust}")
    elif run.fit.adequate is False:
        found.append(
            "The fit's model is not adequate, so the vehicles may differ from the real one."
        )
    if isinstance(run.controller, StateFeedback):
        outputs = naming.names(run.model.Outputs)
        same = {"phi": "roll", "theta": "pitch", "psi": "yaw"}
        hidden = [
            n
            for n in next(iter(run.controller.gains.values()))
            if n not in outputs and same.get(n) not in outputs
        ]
        if hidden:
            found.append(
                f"No output measures {', '.join(hidden)}, so this law cannot fly as it is: law: "
                "lqg estimates them."
            )
    return found


def _unstable(run: Any) -> str:
    """Return the growing mode of an unstable vehicle, by participation factors, and a remedy."""
    at = int(np.argmin(all_stable(run.margins)))
    A = run.tuning.closed_matrix(run.controller, at)
    size, right = np.linalg.eig(A)
    left = np.linalg.pinv(right)
    k = int(np.argmax(np.abs(size)))
    names = naming.names(run.model.State)
    share = np.abs(left[k, : len(names)] * right[: len(names), k])
    rate = np.log(np.abs(size[k])) / run.controller.dt
    return (
        f"One grows at {number(float(rate), 2)} 1/s, mostly in {names[int(np.argmax(share))]}: "
        "expected feedback of this state, gentler weights or slower loops, or a higher rate."
    )


def margins_table(run: Any) -> Table:
    """Return the margins of each loop over the vehicles."""
    rows = []
    for name, m in zip(run.commands, run.margins, strict=True):
        cells = [_pair(m.gain, "dB"), _pair(m.phase, "deg")]
        rows.append((name, percent(float(np.mean(m.stable)), 1), *cells))
    return Table(("loop opened at", "stable", "gain margin", "phase margin"), rows)


def _pair(values: np.ndarray, unit: str, edge: float = _EDGES[0]) -> str:
    """Return a quantile (default 5 %) and the median of the vehicles."""
    worst, middle = _quantile(values, edge), _quantile(values, 0.5)
    if not len(values) > 1:
        return f"{number(middle, 3)} {unit}"
    return f"{number(worst, 3)} {unit} (median {number(middle, 3)})"


def _quantile(values: np.ndarray, share: float, lost: int = 0) -> float:
    """Return a quantile; unknown values and `lost` vehicles are the worst. NaN if it is one."""
    worst = -np.inf if share <= 0.5 else np.inf
    all_values = np.append(np.where(np.isnan(values), worst, values), np.full(lost, worst))
    # An infinite margin is no number to interpolate with.
    found = float(np.quantile(all_values, share, method="lower"))
    return float("nan") if found == worst else found


def flight_table(run: Any) -> Table:
    """Return the rms deviations of signals and commands over the vehicles."""
    settings = run.config.config.control
    stated = {**settings.signals, **settings.inputs}
    both, rows = {**run.flown.deviations, **run.flown.commands}, []
    for name, most in run.tuning.most.items():
        factor = stated[name].most / most
        rms = factor * np.sqrt(np.mean(np.square(both[name]), axis=1))
        rms = np.where(run.flown.status > _OUTSIDE, np.inf, rms)
        unit = stated[name].unit or naming_unit(run, name) or ""
        kind = "command" if name in run.commands else "deviation"
        low, high = (
            number(float(np.quantile(rms, q, method="higher")), 3) for q in (0.5, _EDGES[1])
        )
        rows.append(
            (name, kind, f"{low} {unit}", f"{high} {unit}", f"{stated[name].most:g} {unit}")
        )
    return Table(("signal", "", "rms, median", "rms, 95 %", "most"), rows)


def handling_table(run: Any) -> Table:
    """Return bandwidth and phase delay of the responses of angles to their set points."""
    omega, rows = run.tuning.omega, []
    for name in run.controller.references:
        if naming_unit(run, name) != "rad":
            continue
        found = []
        for H in run.tuning.followed(run.controller, name):
            curve = Curve(functools.partial(_interpolated, omega, H), (omega[0], omega[-1]))
            numbers = handling_qualities(curve, "attitude-command").numbers
            found.append(
                [numbers[n].value if n in numbers else np.nan for n in ("bandwidth", "phase_delay")]
            )
        bandwidth, delay = np.array(found).T
        rows.append((name, _pair(bandwidth, "rad/s"), _pair(delay, "s", _EDGES[1])))
    return Table(("set point", "bandwidth", "phase delay"), rows)


def _interpolated(omega: np.ndarray, H: np.ndarray, at: np.ndarray) -> Point:
    x, known = np.log(at), np.log(omega)
    exact = np.zeros((len(at), 0))
    gain, lag = (np.interp(x, known, v) for v in (np.log(np.abs(H)), np.unwrap(np.angle(H))))
    return Point(gain, lag, exact, exact)


def naming_unit(run: Any, name: str) -> str | None:
    """Return the SI unit of a signal or an input."""
    for record in (run.model.Inputs, run.model.Outputs, run.model.State):
        if name in naming.names(record):
            return naming.unit(record, name)
    return None


def write_control(folder: Path, run: Any, config: str) -> None:
    """Write control.json, gains.csv, parameters of autopilots, report.html and figures/."""
    (folder / "control.json").write_text(as_json(_content(run)) + "\n", encoding="utf-8")
    table = io.StringIO()
    rows = csv.writer(table, lineterminator="\n")
    rows.writerow(("gain", "value"))
    rows.writerows((n, repr(float(v))) for n, v in gains_of(run.controller).items())
    (folder / "gains.csv").write_text(table.getvalue(), encoding="utf-8")
    files = autopilot_files(run)
    for name, text in files.items():
        (folder / name).write_text(text, encoding="utf-8")
    (folder / "figures").mkdir()
    numbers, pictures = Numbers(), []
    pictures.append(
        picture("flight", functools.partial(_flight, run), numbers, folder=folder / "figures")
    )
    responses = run.tuning.responses(run.controller)
    for i, name in enumerate(run.commands):
        made = functools.partial(_bode, run, responses[:, i], name)
        pictures.append(picture(f"bode-{name}", made, numbers, folder=folder / "figures"))
        # An image, since charts of pages need rising x.
        chart, file = _nichols(responses[:, i], name), folder / "figures" / f"nichols-{name}"
        style.save(lambda chart=chart: chart, file)
        pictures.append(of_file(file.with_suffix(".png"), chart.title, described(chart)))
    page = filled(
        "control.html.j2",
        title=run.config.path.stem,
        summary=summary(run),
        tuning=tuning(run),
        doubts=doubts(run),
        margins=margins_table(run),
        handling=handling_table(run),
        flight=flight_table(run),
        gains=Table(
            ("gain", "value"), [(n, number(float(v))) for n, v in gains_of(run.controller).items()]
        ),
        pictures=[p for p in pictures if p is not None],
        numbers=numbers.content(),
        origin=origin(config, (*_FILES, *files)),
    )
    (folder / "report.html").write_text(page, encoding="utf-8")


def _content(run: Any) -> dict[str, Any]:
    tuned = run.tuned

    def over(values: np.ndarray) -> dict[str, float | None]:
        found = {f"q{100 * q:g}": _quantile(values, q) for q in (0.05, 0.5, 0.95)}
        return {n: v if np.isfinite(v) else None for n, v in found.items()}

    return {
        "model": run.model.name,
        "law": run.config.config.control.law,
        "fit": None if run.fit is None else str(run.fit.directory),
        "sample_time": run.controller.dt,
        "vehicles": len(run.margins[0].stable) + run.lost,
        "without_steady_flight": run.lost,
        "stable": run.stable,
        "loops": {
            n: {
                "stable": float(np.mean(m.stable)),
                "gain_margin_db": over(m.gain),
                "phase_margin_deg": over(m.phase),
            }
            for n, m in zip(run.commands, run.margins, strict=True)
        },
        "tuning": None
        if tuned is None
        else {
            "converged": tuned.converged,
            "cost": list(tuned.cost),
            "distance": list(tuned.distance),
            "stable": list(tuned.stable),
        },
        "controller": content_of(run.controller),
        "gains": {n: float(v) for n, v in gains_of(run.controller).items()},
        "doubts": doubts(run),
    }


_ARDUPILOT = {"roll": "RLL", "pitch": "PIT", "yaw": "YAW"}


def autopilot_files(run: Any) -> dict[str, str]:
    """Return the gains of attitude and rate loops as parameters of ArduPilot and PX4.

    Both take rates in rad/s and give shares of full output, so inputs need `full_stick`.
    """
    settings = run.config.config.control
    if not isinstance(run.controller, Cascade) or run.stable < _SHARE:
        return {}
    ardupilot, px4 = [], []
    for name, loops in run.controller.loops.items():
        full = settings.inputs[name].full_stick
        if full is None:
            continue
        # In SI, as the gains.
        full *= run.tuning.most[name] / settings.inputs[name].most
        for i, loop in enumerate(loops):
            axis, _, rate = loop.signal.partition("_")
            if axis not in _ARDUPILOT or rate not in ("", "rate"):
                continue
            # Both have angle loops with one gain, around a rate loop.
            if not rate and (loop.i is not None or loop is loops[-1]):
                continue
            if rate and i < len(loops) - 1:
                continue
            scale = 1.0 / full if rate else 1.0
            terms = {"P": loop.p, "I": loop.i, "D": loop.d}
            for term, gain in ((t, g) for t, g in terms.items() if g is not None):
                value = f"{abs(scale * float(gain)):.6g}"
                kind = "RAT" if rate else "ANG"
                ardupilot.append(f"ATC_{kind}_{_ARDUPILOT[axis]}_{term},{value}")
                px4.append(f"param set MC_{axis.upper()}{'RATE' if rate else ''}_{term} {value}")
    if not ardupilot:
        return {}
    return {"ardupilot.param": "\n".join(ardupilot) + "\n", "px4.txt": "\n".join(px4) + "\n"}


def _flight(run: Any) -> Chart:
    """Draw deviations and commands of the vehicles, as bands with the mode."""
    settings, dt = run.config.config.control, run.controller.dt
    stated = {**settings.signals, **settings.inputs}
    both = {**run.flown.deviations, **run.flown.commands}
    panels: list[Panel] = []
    t = dt * np.arange(run.tuning.scenario.samples)
    for name, most in run.tuning.most.items():
        factor = stated[name].most / most
        values = factor * np.asarray(both[name])
        unit = stated[name].unit or naming_unit(run, name)
        low, high = _band(values)
        series = [band(t, low, high, style.BLUE), Series("", t, values[0], style.BLACK, width=0.9)]
        # A diverging vehicle would flatten the others.
        reach = 5.0 * stated[name].most
        ends = (max(float(low.min()), -reach), min(float(high.max()), reach))
        room = 0.05 * (ends[1] - ends[0]) or 0.1 * stated[name].most
        panels.append(
            panel(label(name, unit), series, 0.8, limits=(ends[0] - room, ends[1] + room))
        )
    words = "Black: the vehicle of the estimates."
    if run.fit is not None:
        words += " Band: 5 to 95 % of the vehicles of the posterior."
    return Chart(
        "Flight: deviations from set points, and commands", "time [s]", time_limits(t),
        tuple(panels), words,
    )  # fmt: skip


def _band(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    sound = values[np.isfinite(values).all(axis=1)]
    low, high = np.quantile(sound if len(sound) else np.zeros_like(values), _EDGES, axis=0)
    return low, high


def _bode(run: Any, L: np.ndarray, name: str) -> Chart:
    """Draw size and phase of a loop, opened at a command."""
    shown = run.tuning.omega >= _LOWEST
    hz, size = run.tuning.omega[shown] / (2.0 * np.pi), 20.0 * np.log10(np.abs(L[:, shown]))
    turns = np.stack([phase(row) for row in L[:, shown]])
    panels = [
        panel(text, [band(hz, *_band(v), style.BLUE), Series("", hz, v[0], style.BLACK)], 1.2,
              levels=levels)
        for text, v, levels in (("|L| [dB]", size, (0.0,)), ("phase [deg]", turns, (-180.0,)))
    ]  # fmt: skip
    title = f"Loop opened at {name}"
    return Chart(title, "frequency [Hz]", (float(hz[0]), float(hz[-1])), tuple(panels), "", True)


def _nichols(L: np.ndarray, name: str) -> Chart:
    """Draw size over phase of a loop, for the estimates and some vehicles."""
    lines: list[Series] = []
    for k in range(min(len(L), 20) - 1, -1, -1):
        color, width = (style.BLACK, 1.2) if k == 0 else (style.BLUE, 0.5)
        lines.append(Series("", phase(L[k]), 20.0 * np.log10(np.abs(L[k])), color, width=width))
    point = Series("-1", np.array([-180.0]), np.zeros(1), style.VERMILLION, "points", width=5.0)
    shown = panel("|L| [dB]", [*lines, point], 2.6, limits=(-40.0, 40.0), levels=(0.0,))
    words = "Black: the vehicle of the estimates. Blue: other vehicles."
    title = f"Nichols chart, loop opened at {name}"
    return Chart(title, "phase [deg]", (-360.0, 0.0), (shown,), words)
