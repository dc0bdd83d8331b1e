"""A first guess of a linear model's parameters from the records themselves, without a vehicle.

Equation error: each state's derivative is regressed on states and inputs. It needs no start, but
measurement noise on the regressors biases it, gusts do (states follow them), and hidden time
constants are beyond it: a start for a fit, never a result.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from heli_jax import naming
from heli_jax.dynamics.model import Model, require_constants
from heli_jax.flights.flight import Flight
from heli_jax.identification.equation_error import records
from heli_jax.identification.equation_error.first_guess import (
    Equation,
    EquationErrorStart,
    Origin,
    StartValue,
)
from heli_jax.identification.equation_error.records import (
    Structure,
    generic,
    held,
    matrices,
    structure,
)
from heli_jax.identification.equation_error.regression import (
    Optimum,
    Regression,
    Rows,
    Selection,
    covariance,
    finite,
    search,
    select,
)
from heli_jax.identification.free import Free
from heli_jax.vehicle import of_helicopter

# Params is a class of each model, hence Any.

_ROUNDS = 3
"""of regression and weights of the equations"""
_NULL = 1e-5
"""singular value, of columns of length one, below which parameters are exchangeable"""
_TRIED = (1.0, 0.1, 10.0, 0.01, 100.0, -1.0, -0.1, -10.0)
"""values to begin with where nothing is known, and zero will not do"""


class _Setup(NamedTuple):
    """What the regressions have in common."""

    model: Model
    base: dict[str, float]
    """all parameters by name, those that are free at the values at hand; NaN where there is none"""
    free: Mapping[str, Free]
    flights: Sequence[Flight]
    structures: tuple[Structure, ...]
    half: int


def equation_error_start(
    model: Model,
    vehicle: Any,
    flights: Sequence[Flight],
    free: Mapping[str, Free],
    *,
    stepwise: tuple[float, float] | None = None,
) -> EquationErrorStart:
    """First guesses of the free parameters of a linear model.

    Args:
        model: with `linear=True`.
        vehicle: the model's Params, SI; what is free may be NaN in it.
        flights: to regress; those held out are left alone.
        free: of each free parameter the bounds and, where it is stated (not NaN), a start. That is
            taken where regression finds none, as for time constants of what is not measured.
        stepwise: F to enter and F to remove of a stepwise selection of terms; None for all terms.

    Raises:
        ValueError: nothing can be regressed, or a parameter has no start; the sentence says why
            and what to do.
    """
    setup = _setup(model, vehicle, [f for f in flights if not f.hold_out], free)
    # Any value will do for what has none: only where a parameter stands is asked.
    fixed = held(model, {**setup.base, **dict.fromkeys(free, 1.0)}, setup.structures)
    reasons = {n: _why_held(model, n) for n in free if n in fixed}
    names = [n for n in free if n not in fixed]
    if not names or not any(s.rows for s in setup.structures):
        raise ValueError(_nothing(setup, names))
    optimum, regression, null = _without_null(setup, names, reasons)
    selection = None
    if stepwise is not None:
        keeps = zip(regression.names, _keeps(setup, regression), strict=True)
        forced = [
            n for i, (n, keep) in enumerate(keeps) if keep or _divides(regression, optimum, i)
        ]
        selection = select(optimum.rows, optimum.values, regression.names, forced, stepwise)
        out = [n for n in regression.names if n not in selection.selected]
        # Terms that are out are zero from here on, and the others are regressed again: where
        # regressors go together the values of those that stay move.
        kept = setup._replace(base={**setup.base, **dict.fromkeys(out, 0.0)})
        if selection.selected:
            regression = regression._replace(names=selection.selected, base=kept.base)
            optimum = _optimum(kept, regression)
    sd = np.sqrt(np.maximum(np.diag(covariance(optimum.rows)), 0.0))
    coefficients = {
        n: (float(v), float(s))
        for n, v, s in zip(regression.names, optimum.values, sd, strict=True)
        if selection is None or n in selection.selected
    }
    values = {n: _value(setup, n, coefficients, {**reasons, **null}, selection) for n in free}
    hidden = {s.states[i]: None for s in setup.structures for i in s.hidden}
    return EquationErrorStart(
        values,
        _explained(regression, optimum),
        setup.half * setup.flights[0].dt,
        tuple(hidden),
        selection,
    )


def _setup(
    model: Model, vehicle: Any, flights: Sequence[Flight], free: Mapping[str, Free]
) -> _Setup:
    if not model.linear:
        raise ValueError(
            f"start: equation-error is for linear models, and {model.name} is none: expected a "
            "start of each free parameter"
        )
    params = {n: float(np.asarray(v)) for n, v in naming.asdict(vehicle).items()}
    stated = {n: f.start for n, f in free.items() if math.isfinite(f.start)}
    base = {**params, **stated}
    some = dict(zip(free, generic(len(free)), strict=True))
    for flight in flights:
        # Generic numbers stand for what is free, so that NaN is left only where a constant that
        # somebody has to give is missing.
        require_constants(model, model.Params(**{**base, **some, **flight.known}))
    # One structure a flight: what is measured may differ from flight to flight, and with it which
    # states are shown.
    structures = []
    for flight in flights:
        names = list(free)
        at = matrices(model, {**base, **some, **flight.known}, names, generic(len(names)))
        depends = (np.abs(at.slope) > 0).any(axis=-1)
        structures.append(structure(model, at.value, depends, list(flight.outputs)))
    return _Setup(model, base, free, flights, tuple(structures), records.width(flights))


def _regression(setup: _Setup, names: Sequence[str]) -> Regression:
    """The flights smoothed, inputs as late as the values at hand say."""
    late = dict(setup.model.delays)
    made = []
    for flight, one in zip(setup.flights, setup.structures, strict=True):
        known = {**setup.base, **flight.known}
        delays = {u: known[p] for u, p in late.items()}
        made.append(records.record(setup.model, flight, one, setup.half, delays))
    made = [one for one in made if one.segments and one.structure.rows]
    if not made:
        raise ValueError(
            "start: equation-error: no stretch without missing samples is as long as the "
            f"smoothing needs ({records.shortest(setup.half)} samples): expected a start of each "
            "free parameter"
        )
    return Regression(setup.model, setup.base, tuple(names), tuple(made))


def _keeps(setup: _Setup, regression: Regression) -> np.ndarray:
    """Of which parameters the sign is known."""
    ours = of_helicopter(setup.model.Params)
    keeps = []
    for name in regression.names:
        sign, at_hand = setup.free[name].sign, setup.base[name]
        known = name in setup.model.positive or (math.isfinite(at_hand) and at_hand != 0)
        asked = sign == "keep" or (sign is None and (ours or name in setup.model.positive))
        keeps.append(asked and known)
    return np.array(keeps, bool)


def _optimum(setup: _Setup, regression: Regression) -> Optimum:
    """The regression with the equations weighed by their own residuals."""
    keep = _keeps(setup, regression)
    # Equations differ in unit and noise, and share parameters. Before there are residuals each is
    # weighed by the size of its left-hand side; then by its own residuals, which least squares of
    # several equations asks for.
    weights = _sizes(regression)
    values, rows = _first_search(setup, regression, keep, weights)
    for _ in range(_ROUNDS - 1):
        weights = {
            # The floor keeps an equation that is met exactly from drowning all others.
            name: w / max(float(np.sqrt(np.mean(rows.r[rows.equation == i] ** 2))), 1e-9)
            for i, (name, w) in enumerate(weights.items())
        }
        again = search(regression, values, keep, weights)
        if again is None:
            break
        values, rows = again
    return Optimum(values, rows, weights)


def _first_search(
    setup: _Setup, regression: Regression, keep: np.ndarray, weights: Mapping[str, float]
) -> tuple[np.ndarray, Rows]:
    """The best of searches from several values."""
    at_hand = np.array([setup.base[n] for n in regression.names])
    known = np.isfinite(at_hand) & (at_hand != 0)
    # From nothing, and from the values at hand: products of parameters may have two optima.
    starts = [np.where(keep, np.where(known, at_hand, 1.0), 0.0)]
    if known.any():
        starts.append(np.where(known, at_hand, starts[0]))
    runs = [run for x in starts if (run := search(regression, x, keep, weights)) is not None]
    if len(runs) < len(starts):
        # Something is divided by one of them: begun with any size, and either sign.
        tries = [np.where(keep, np.where(known, at_hand, abs(x)), x) for x in _TRIED]
        tried = (search(regression, x, keep, weights) for x in tries)
        runs += [run for run in tried if run is not None]
    if not runs:
        raise ValueError(
            "start: equation-error: the equations are not finite at any value tried of "
            f"{', '.join(regression.names)} (zero, the vehicle's, {_TRIED[0]:g} and others): "
            "expected a start of each free parameter"
        )
    return min(runs, key=lambda run: run[1].cost)


def _divides(regression: Regression, optimum: Optimum, which: int) -> bool:
    """Whether something is divided by a parameter, by its number, so that it cannot be zero."""
    values = optimum.values.copy()
    values[which] = 0.0
    return finite(lambda: regression.rows(values, optimum.weights)) is None


def _sizes(regression: Regression) -> dict[str, float]:
    """One over the size of each equation's left-hand side."""
    left = {name: [] for name in regression.equations}
    for one in regression.records:
        for k, name in enumerate(one.structure.equations):
            left[name] += [s.left[k] - s.left[k].mean() for s in one.segments]
    return {n: 1.0 / max(float(np.std(np.concatenate(v))), 1e-300) for n, v in left.items()}


def _without_null(
    setup: _Setup, names: Sequence[str], reasons: Mapping[str, str]
) -> tuple[Optimum, Regression, dict[str, str]]:
    """The regression without what it does not determine, and why each was left out."""
    null: dict[str, str] = {}
    for n in reasons:
        if not math.isfinite(setup.base[n]):
            raise ValueError(
                f"free.{n}.start: missing, expected a value to begin with: {reasons[n]}"
            )
    names = list(names)
    # One at a time, and regressed again: of two that are exchangeable only one has to go, and the
    # other is determined as soon as the first is held.
    while names:
        regression = _regression(setup, names)
        optimum = _optimum(setup, regression)
        out = _undetermined(setup, regression, optimum)
        if out is None:
            return optimum, regression, null
        name, why = out
        if not math.isfinite(setup.base[name]):
            raise ValueError(f"free.{name}.start: missing, expected a value to begin with: {why}")
        null[name] = why
        names.remove(name)
    raise ValueError(_nothing(setup, names))


def _undetermined(
    setup: _Setup, regression: Regression, optimum: Optimum
) -> tuple[str, str] | None:
    """A parameter that the regression does not determine, and why."""
    norms = np.linalg.norm(optimum.rows.J, axis=0)
    names = regression.names
    for name, norm in zip(names, norms, strict=True):
        if norm == 0:
            return name, "no measured state or output moves with it"
    # Columns of one length: units must not decide which direction counts as small.
    _, sizes, directions = np.linalg.svd(optimum.rows.J / norms, full_matrices=False)
    if sizes[-1] > _NULL * sizes[0]:
        return None
    part = np.abs(directions[-1])
    involved = [i for i in np.argsort(-part) if part[i] > 0.1]
    # One of them has to stay where it is; one with a value at hand can.
    with_value = [i for i in involved if math.isfinite(setup.base[names[i]])]
    first = (with_value or involved)[-1] if len(involved) > 1 else involved[0]
    others = ", ".join(names[i] for i in involved if i != first)
    return names[first], f"the equations do not tell it from {others}"


def _why_held(model: Model, name: str) -> str:
    if name in dict(model.delays).values():
        return "a delay is found by no regression"
    return "it is a time constant or frequency of states that are not measured"


def _nothing(setup: _Setup, names: Sequence[str]) -> str:
    begun = "start: equation-error: nothing can be regressed, since "
    remedy = "expected a start of each free parameter"
    if not any(s.shown for s in setup.structures):
        measured = ", ".join({n: None for f in setup.flights for n in f.outputs})
        return f"{begun}no output ({measured}) shows a state by itself: {remedy}, or other outputs"
    if not names:
        return (
            f"{begun}all that is free are delays, or time constants of states that are not "
            f"measured: {remedy}"
        )
    return f"{begun}no equation of a measured state has a free parameter: {remedy}"


def _value(
    setup: _Setup,
    name: str,
    coefficients: Mapping[str, tuple[float, float]],
    reasons: Mapping[str, str],
    selection: Selection | None,
) -> StartValue:
    unit = naming.unit(setup.model.Params, name) or "1"
    if name in coefficients:
        value, sd = coefficients[name]
        inside = _inside(setup.free[name], value)
        moved = "" if inside == value else f"{value:.4g} lies outside its bounds"
        return StartValue(inside, sd, unit, "equation error", moved)
    if selection is not None and name not in reasons:
        inside = _inside(setup.free[name], 0.0)
        return StartValue(inside, None, unit, "not selected", "its term hardly helps to predict")
    stated = math.isfinite(setup.free[name].start)
    origin: Origin = "as stated" if stated else "vehicle"
    return StartValue(setup.base[name], None, unit, origin, reasons[name])


def _inside(free: Free, value: float) -> float:
    """The value, or where it lies outside the bounds the nearest one a little inside."""
    low = -math.inf if free.lower is None else free.lower
    high = math.inf if free.upper is None else free.upper
    # Strictly inside: in the coordinates of a bounded parameter its bounds are at infinity, and so
    # is zero in those of a logarithm.
    if low < value < high:
        return value
    span = high - low if math.isfinite(high - low) else max(abs(low if value <= low else high), 1.0)
    return low + 0.01 * span if value <= low else high - 0.01 * span


def _explained(regression: Regression, optimum: Optimum) -> tuple[Equation, ...]:
    sizes, made = _sizes(regression), []
    for i, name in enumerate(regression.equations):
        r = optimum.rows.r[optimum.rows.equation == i] / optimum.weights[name]
        made.append(Equation(name, 1.0 - float(np.mean(r**2)) * sizes[name] ** 2))
    return tuple(made)
