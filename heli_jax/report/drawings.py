"""Which figures a report has, each drawn when it is asked for."""

import re
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import jax.numpy as jnp
import numpy as np

from heli_jax import naming, units
from heli_jax.flights.flight import Signal
from heli_jax.identification.equation_error.baseline import Baseline
from heli_jax.identification.fit import Fit
from heli_jax.identification.problem import Problem
from heli_jax.identification.uncertainty.comparison import Intervals
from heli_jax.report import figures
from heli_jax.report.embedded import Logged
from heli_jax.report.files import Analysis as Analysis
from heli_jax.report.fitted_responses import FittedPair
from heli_jax.report.frequency import FittedFlight

if TYPE_CHECKING:
    from matplotlib.figure import Figure

type Draw = Callable[[], Figure | None]
"""draws a figure; None where there is nothing to draw"""

MOST_FLIGHTS = 6
"""flights that get figures of their own; signals.csv has them all"""


def drawings(analysis: Analysis) -> dict[str, Draw]:
    """Every figure of the report by its file name, not yet drawn."""
    fit, problem, baseline, supplementary = analysis
    model, drawings = problem.model, {}
    if supplementary.intervals is not None:
        drawings["intervals"] = _drawing(figures.intervals, supplementary.intervals, fit)
        drawings |= _samples(supplementary.intervals, fit)
    parts = _parts([s.flight for s in fit.signals])
    for i in _drawn([s.hold_out for s in fit.signals]):
        s, part = fit.signals[i], parts[i]
        for output in s.measured:
            drawings[f"response{part}_{output}"] = _drawing(figures.response, s, output, model)
            # The fit did nothing to make the residuals of a flight held out white.
            if not s.hold_out:
                drawings[f"residual{part}_{output}"] = _drawing(
                    figures.residual_correlation,
                    s,
                    output,
                    together=len(fit.whiteness),
                    test=fit.whiteness.get(f"{s.flight}/{output}"),
                )
    if fit.signals[0].inputs:
        drawings["bode"] = _bode(fit, problem, baseline)
    if (responses := supplementary.responses) is not None:
        for group, pairs, whose in (
            ("match", responses.pairs, "flights together"),
            ("held", responses.held_out, "flights held out together"),
        ):
            for pair in pairs:
                drawings[f"{group}_{pair.output}-{pair.input}"] = _match(pair, analysis, whose)
    if len(fit.verdict.names) > 1:
        drawings["correlation"] = _drawing(figures.correlation_matrix, fit.verdict)
    drawings["starts"] = _drawing(figures.waterfall, fit.starts)
    if baseline is not None:
        drawings["rls"] = _drawing(
            figures.rls_history, baseline, log_start=_log_start(fit, baseline.flight)
        )
    return drawings


def _samples(comparison: Intervals, fit: Fit) -> dict[str, Draw]:
    """Of what was sampled; nothing where nothing was."""
    drawings, posterior, booted = {}, comparison.posterior, comparison.bootstrap
    if posterior is not None:
        drawings["trace"] = _drawing(figures.trace, posterior, fit)
        drawings["pairs_posterior"] = _drawing(figures.posterior_pairs, posterior, fit)
    if booted is not None:
        drawings["pairs_bootstrap"] = _drawing(figures.bootstrap_pairs, booted, fit)
    return drawings


def logged_units(analysis: Analysis) -> dict[str, dict[str, Logged]]:
    """By figure and signal how the log has it; signals that it has in SI are left out."""
    fit, problem, _, _ = analysis
    # In the order of the signals: the fitted flights first.
    flights = [*problem.training, *(f for f in problem.flights if f.hold_out)]
    parts, by_figure = _parts([s.flight for s in fit.signals]), {}
    for signals, flight, part in zip(fit.signals, flights, parts, strict=True):
        if flight.source is None:
            continue
        listed = {**flight.source.inputs, **flight.source.outputs}
        factors = {n: logged for n, s in listed.items() if (logged := as_logged(s))}
        for output in signals.measured:
            own = factors.get(output)
            # A difference of two numbers has no offset.
            residual = {"residual": own._replace(offset=0.0)} if own else {}
            by_figure[f"response{part}_{output}"] = factors | residual
    return by_figure


def as_logged(signal: Signal) -> Logged | None:
    """How the log has a signal; None where it is constant, or logged in SI."""
    if signal.constant is not None:
        return None
    if signal.scale == 1.0 and not signal.offset and not signal.invert:
        factor = from_si(signal)
        return None if factor == 1.0 else Logged(signal.unit, factor)
    # The configuration's unit is not the log's, as metres of a pulse width: the column says which.
    zero, one = map(float, signal.from_si(np.array([0.0, 1.0])))
    return Logged(signal.name, one - zero, zero)


def logged_outputs(analysis: Analysis) -> dict[str, tuple[str, float]]:
    """By output the unit of the logs, and what SI is times to be in it; those alone that all
    flights have in one unit other than SI."""
    by_output: dict[str, set[tuple[str, float]]] = {}
    for flight in analysis.problem.flights:
        listed = flight.source.outputs if flight.source else {}
        for name in flight.outputs:
            unit = (listed[name].unit, from_si(listed[name])) if name in listed else ("", 1.0)
            by_output.setdefault(name, set()).add(unit)
    alike = {name: next(iter(units)) for name, units in by_output.items() if len(units) == 1}
    return {name: unit for name, unit in alike.items() if unit[1] != 1.0}


def from_si(signal: Signal) -> float:
    """What a number in SI is times to be in the unit that the configuration states for it."""
    try:
        return 1.0 / units.factor(signal.unit, signal.si)
    except ValueError:  # of no known unit: it was never converted
        return 1.0


def _log_start(fit: Fit, flight: str) -> float | None:
    """Time in the log of a flight's first sample [s]."""
    return next((s.log_start for s in fit.signals if s.flight == flight), None)


def _drawn(hold_out: list[bool]) -> list[int]:
    """Which flights get figures: where there are too many, not only the fitted ones, which come
    first, but half of them held out."""
    held = [i for i, out in enumerate(hold_out) if out][: MOST_FLIGHTS // 2]
    fitted = [i for i, out in enumerate(hold_out) if not out][: MOST_FLIGHTS - len(held)]
    rest = [i for i in range(len(hold_out)) if i not in {*held, *fitted}]
    return sorted([*fitted, *held, *rest[: MOST_FLIGHTS - len(held) - len(fitted)]])


def _parts(flights: list[str]) -> list[str]:
    """What tells the flights' file names apart; nothing where there is one flight."""
    if len(flights) == 1:
        return [""]
    # Names come from logs and may hold slashes, and two may be equal but for what is left out: the
    # number keeps their files apart.
    return [
        f"_{i + 1}_{re.sub('[^A-Za-z0-9]+', '-', f).strip('-')[:40]}".rstrip("_")
        for i, f in enumerate(flights)
    ]


def _drawing(function: Callable[..., figures.Panels], *args: Any, **options: Any) -> Draw:
    # Drawn when it is asked for: `FitRun.figure` wants one of them and draws no other.
    def draw() -> "Figure | None":
        axes = function(*args, **options)
        return axes[0].figure if axes else None  # type: ignore[return-value]

    return draw


def _bode(fit: Fit, problem: Problem, baseline: Baseline | None) -> Draw:
    """The frequency response of the flight that the baseline saw, with what is known of it."""
    # The first flight where there is no baseline.
    i = next((i for i, s in enumerate(fit.signals) if baseline and s.flight == baseline.flight), 0)
    # What the flight states of the vehicle goes before the estimates, as in the fit.
    # Signals hold the fitted flights first, in the order of `training`; those held out follow.
    known = problem.training[i].known if i < len(problem.training) else {}
    params = naming.replace(fit.params, **{n: jnp.asarray(v) for n, v in known.items()})
    flight = FittedFlight(problem.model, params, fit, fit.signals[i])
    return _drawing(figures.bode, flight, baseline)


def _match(pair: FittedPair, analysis: Analysis, whose: str) -> Draw:
    responses = analysis.supplementary.responses
    assert responses is not None
    about = f"model linearised about {responses.about}" if responses.about else "continuous model"
    note = f"{about}; data without the hold of the input, {whose}"
    unit = figures.bode_unit(analysis.problem.model, pair.output, pair.input)
    return _drawing(figures.match, pair, unit, note)
