"""Start values of a linear model's parameters from the records themselves, without a vehicle.

Equation error: each state's derivative is regressed on states and inputs. It needs no start, but
measurement noise on the regressors biases it, gusts do (states follow them), and hidden time
constants are beyond it: a start for a fit, never a result.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np

from heli_jax import naming
from heli_jax.dynamics.model import Model, require_constants
from heli_jax.finding import Finding, found
from heli_jax.flights.flight import Flight
from heli_jax.identification.equation_error.records import (
    coefficients,
    generic,
    hidden_constants,
    kernel_width,
    record,
    shortest,
    structure,
)
from heli_jax.identification.equation_error.regression import (
    Regression,
    Rows,
    Selection,
    covariance,
    search,
    select,
)
from heli_jax.identification.free import Free, Sign
from heli_jax.vehicle import of_helicopter

F_ENTER = 20.0
"""five times the 5 % point of F (Klein and Morelli): terms below it hardly help to predict"""
_ROUNDS = 3
"""of regression and weights of the equations"""
_NULL = 1e-5
"""singular value, of columns of length one, below which parameters are exchangeable"""
_TRIED = (1.0, 0.1, 10.0, 0.01, 100.0, -1.0, -0.1, -10.0)
"""values to begin with where nothing is known, and zero will not do"""

Origin = Literal["equation error", "frequency error", "as stated", "vehicle", "not selected"]


class StartValue(NamedTuple):
    """Where a fit begins with one parameter. The names of the fields are keys of fit.json."""

    value: float
    sd: float | None
    """standard error of the regression, without its bias, or that of frequency error; None where
    the value is from neither, and where several solutions fit as well"""
    unit: str
    origin: Origin
    reason: str
    """why it is not from the regression or from frequency error; empty where it is"""


class Equation(NamedTuple):
    """One equation as it was regressed."""

    name: str
    """the state whose derivative it gives, or the output"""
    r_squared: float


class EquationErrorStart(NamedTuple):
    """Start values, and how they were found."""

    values: dict[str, StartValue]
    equations: tuple[Equation, ...]
    half_width: float
    """of the smoothing kernel [s]"""
    hidden: tuple[str, ...]
    """states that nothing measured shows: integrated by their own equations"""
    selection: Selection | None = None

    @property
    def findings(self) -> list[Finding]:
        """What was taken from where."""
        out = [
            found(
                "start.equation-error",
                "note",
                names=[n for n, v in self.values.items() if v.origin == "equation error"]
                or ["nothing"],
                equations=[e.name for e in self.equations],
                explained=[e.r_squared for e in self.equations],
                half_width=self.half_width,
            )
        ]
        if self.hidden:
            out.append(found("start.hidden-states", "note", names=self.hidden))
        return out + reasons_of(self.values)


def reasons_of(values: Mapping[str, StartValue]) -> list[Finding]:
    """Return findings on the values that were not found, one for all of one reason."""
    grouped: dict[tuple[str, str], list[str]] = {}
    for name, v in values.items():
        if v.reason:
            grouped.setdefault((v.origin, v.reason), []).append(f"{name} {v.value:.4g}")
    return [
        found("start.not-found", "note", values=shown, where=_WHERE[origin], reason=reason)
        for (origin, reason), shown in grouped.items()
    ]


_WHERE = {
    "equation error": "moved inside",
    "as stated": "as stated",
    "vehicle": "the vehicle's",
    "not selected": "where it leaves the model as it is",
}


def equation_error_start(
    model: Model,
    vehicle: Any,  # the model's Params
    flights: Sequence[Flight],
    free: Mapping[str, Free],
    *,
    stepwise: tuple[float, float] | None = None,
) -> EquationErrorStart:
    """Return start values of the free parameters of a linear model.

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
    flights = [f for f in flights if not f.hold_out]
    regression, half, reasons = _regression(model, vehicle, flights, free)
    keep = {n for n in regression.names if _keeps_sign(model, n, free[n].sign, regression.base[n])}
    optimum = _optimum(regression, keep)
    # One parameter at a time is left out, and the rest regressed again: of two that are
    # exchangeable only one has to go, and the other is determined as soon as the first is held.
    while (out := _undetermined(regression, optimum.rows)) is not None:
        name, reasons[name] = out
        _require_value(regression.base, name, reasons[name])
        regression = regression._replace(names=tuple(n for n in regression.names if n != name))
        if not regression.names:
            raise _nothing("the equations determine none of the free parameters")
        optimum = _optimum(regression, keep)
    selection = None
    if stepwise is not None:
        forced = _forced(regression, keep, optimum)
        selection = select(optimum.rows, optimum.values, regression.names, forced, stepwise)
        # Terms that are out are zero from here on, and the others are regressed again: where
        # regressors are correlated the values of those that stay move.
        out = dict.fromkeys(set(regression.names) - set(selection.selected), 0.0)
        regression = regression._replace(names=selection.selected, base={**regression.base, **out})
        optimum = _optimum(regression, keep) if selection.selected else optimum
    sd = np.sqrt(np.maximum(np.diag(covariance(optimum.rows)), 0.0))
    estimates = dict(zip(regression.names, zip(optimum.values, sd, strict=False), strict=False))
    return EquationErrorStart(
        {n: _value(regression, n, free[n], estimates.get(n), reasons.get(n)) for n in free},
        _explained(regression, optimum),
        half * flights[0].dt,
        tuple(dict.fromkeys(n for one in regression.records for n in one.structure.hidden_names)),
        selection,
    )


def _regression(
    model: Model, vehicle: Any, flights: Sequence[Flight], free: Mapping[str, Free]
) -> tuple[Regression, int, dict[str, str]]:
    """The flights smoothed, the kernel's half width [samples], and by parameter that no regression
    finds the reason."""
    if not model.linear:
        raise ValueError(
            f"start: equation-error is for linear models, and {model.name} is none: expected a "
            "start of each free parameter"
        )
    stated = {n: f.start for n, f in free.items() if math.isfinite(f.start)}
    base = {n: float(np.asarray(v)) for n, v in naming.asdict(vehicle).items()} | stated
    # What is free has generic numbers: NaN is left only where a constant is missing that somebody
    # has to give, and only where a parameter stands is asked.
    some = base | dict(zip(free, generic(len(free)), strict=True))
    structures = []
    for flight in flights:
        require_constants(model, model.Params(**{**some, **flight.known}))
        both = coefficients(model, {**some, **flight.known}, list(free), generic(len(free)))
        structures.append(structure(model, both, list(flight.outputs)))
    delays, constants = dict(model.delays), hidden_constants(model, some, structures)
    reasons = {
        n: "a delay is found by no regression"
        if n in delays.values()
        else "it is a time constant or frequency of states that are not measured"
        for n in free
        if n in constants
    }
    names = tuple(n for n in free if n not in constants)
    if not any(s.rows for s in structures):
        if any(s.shown for s in structures):
            raise _nothing("no equation of a measured state has a free parameter")
        measured = ", ".join({n: None for f in flights for n in f.outputs})
        raise _nothing(f"no output ({measured}) shows a state by itself", ", or other outputs")
    if not names:
        raise _nothing("all that is free are delays, or time constants of hidden states")
    for n, why in reasons.items():
        _require_value(base, n, why)
    half, records = kernel_width(flights), []
    for flight, shown in zip(flights, structures, strict=True):
        late = {u: {**base, **flight.known}[p] for u, p in delays.items()}
        records.append(record(model, flight, shown, half, late))
    records = tuple(one for one in records if one.segments and one.structure.rows)
    if not records:
        raise _nothing(
            "no stretch without missing samples is as long as the smoothing needs "
            f"({shortest(half)} samples)"
        )
    return Regression(model, base, names, records), half, reasons


def _nothing(why: str, remedy: str = "") -> ValueError:
    return ValueError(
        f"start: equation-error: nothing can be regressed, since {why}: expected a start of each "
        f"free parameter{remedy}"
    )


def _require_value(base: Mapping[str, float], name: str, why: str) -> None:
    if not math.isfinite(base[name]):
        raise ValueError(f"free.{name}.start: missing, expected a value to begin with: {why}")


class _Optimum(NamedTuple):
    values: np.ndarray
    rows: Rows
    weights: dict[str, float]


def _keeps_sign(model: Model, name: str, sign: Sign | None, at_hand: float) -> bool:
    """True for a parameter of a known sign."""
    positive = name in model.positive
    known = positive or (math.isfinite(at_hand) and at_hand != 0)
    by_default = positive or of_helicopter(model.Params)
    return known and (sign == "keep" or (sign is None and by_default))


def _optimum(regression: Regression, keep_sign: set[str]) -> _Optimum:
    """The regression with the equations weighted by their own residuals."""
    keep = np.array([n in keep_sign for n in regression.names], bool)
    # Equations differ in unit and noise, and share parameters. Before there are residuals each is
    # weighted by the size of its left-hand side; then by its own residuals, which least squares of
    # several equations asks for.
    weights = {n: 1.0 / size for n, size in _sizes(regression).items()}
    values, rows = _first_search(regression, keep, weights)
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
    return _Optimum(values, rows, weights)


def _first_search(
    regression: Regression, keep: np.ndarray, weights: Mapping[str, float]
) -> tuple[np.ndarray, Rows]:
    """The best of searches from several values."""
    at_hand = np.array([regression.base[n] for n in regression.names])
    known = np.isfinite(at_hand) & (at_hand != 0)
    # From nothing, and from the values at hand: products of parameters may have two optima.
    starts = [np.where(keep, np.where(known, at_hand, 1.0), 0.0)]
    if known.any():
        starts.append(np.where(known, at_hand, starts[0]))
    runs = [search(regression, x, keep, weights) for x in starts]
    if None in runs:
        # Something is divided by one of them: begun with any size, and either sign.
        tries = [np.where(keep, np.where(known, at_hand, abs(x)), x) for x in _TRIED]
        runs += [search(regression, x, keep, weights) for x in tries]
    finite = [run for run in runs if run is not None]
    if not finite:
        raise ValueError(
            "start: equation-error: the equations are not finite at any value tried of "
            f"{', '.join(regression.names)} (zero, the vehicle's, {_TRIED[0]:g} and others): "
            "expected a start of each free parameter"
        )
    return min(finite, key=lambda run: run[1].cost)


def _sizes(regression: Regression) -> dict[str, float]:
    """The standard deviation of each equation's left-hand side."""
    left = {name: [] for name in regression.equations}
    for one in regression.records:
        for k, name in enumerate(one.structure.equations):
            left[name] += [s.left[k] - s.left[k].mean() for s in one.segments]
    return {n: max(float(np.std(np.concatenate(v))), 1e-300) for n, v in left.items()}


def _explained(regression: Regression, optimum: _Optimum) -> tuple[Equation, ...]:
    equations = []
    for i, (name, size) in enumerate(_sizes(regression).items()):
        r = optimum.rows.r[optimum.rows.equation == i] / optimum.weights[name]
        equations.append(Equation(name, 1.0 - float(np.mean(r**2)) / size**2))
    return tuple(equations)


def _undetermined(regression: Regression, rows: Rows) -> tuple[str, str] | None:
    """A parameter that the regression does not determine, and why."""
    norms, names = np.linalg.norm(rows.J, axis=0), regression.names
    if not norms.all():
        return names[int(np.argmin(norms))], "no measured state or output moves with it"
    # Columns of one length: units must not decide which direction counts as small.
    _, sizes, directions = np.linalg.svd(rows.J / norms, full_matrices=False)
    if sizes[-1] > _NULL * sizes[0]:
        return None
    part = np.abs(directions[-1])
    involved = [i for i in np.argsort(-part) if part[i] > 0.1]
    # One of them has to stay where it is; one with a value at hand can.
    first = ([i for i in involved if math.isfinite(regression.base[names[i]])] or involved)[-1]
    others = ", ".join(names[i] for i in involved if i != first)
    return names[first], f"the equations do not tell it from {others}"


def _forced(regression: Regression, keep_sign: set[str], optimum: _Optimum) -> list[str]:
    """The parameters that cannot be zero: of a known sign, or something is divided by them."""
    forced = []
    for i, name in enumerate(regression.names):
        values = optimum.values.copy()
        values[i] = 0.0
        if name in keep_sign or regression.rows(values, optimum.weights) is None:
            forced.append(name)
    return forced


def _value(
    regression: Regression,
    name: str,
    free: Free,
    estimate: tuple[float, float] | None,
    reason: str | None,
) -> StartValue:
    unit = naming.unit(regression.model.Params, name) or "1"
    if estimate is not None:
        value, sd = map(float, estimate)
        inside = _inside(free, value)
        moved = "" if inside == value else f"{value:.4g} lies outside its bounds"
        return StartValue(inside, sd, unit, "equation error", moved)
    if reason is None:
        inside = _inside(free, 0.0)
        return StartValue(inside, None, unit, "not selected", "its term hardly helps to predict")
    origin: Origin = "as stated" if math.isfinite(free.start) else "vehicle"
    return StartValue(regression.base[name], None, unit, origin, reason)


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
