"""Start values of a linear model's parameters by equation error.

Each state's derivative is regressed on states and inputs (Klein and Morelli, Aircraft System
Identification, 2006, chapter 5). Gusts, and measurement noise on the regressors, bias the result.
It therefore only starts a fit.

Hidden states are integrated by their own equations from the measured signals. Their initial values,
and a constant for each equation and flight (trim, bias), are projected out. Levenberg-Marquardt
minimises the sum of squares; if parameters enter linearly its first step is the regression.
"""

import functools
import math
from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
import scipy.linalg
from jaxtyping import Float

from heli_jax import naming
from heli_jax.dynamics.model import Model, require_constants
from heli_jax.finding import Finding, found
from heli_jax.flights.flight import Flight
from heli_jax.identification.equation_error.records import (
    Record,
    Segment,
    Structure,
    coefficients,
    generic,
    hidden_constants,
    kernel_width,
    record,
    shortest,
    structure,
)
from heli_jax.identification.problem import Free, Sign
from heli_jax.vehicle import of_helicopter

_EVALUATIONS = 40
"""Most evaluations of the residuals in one search."""
_SMALL = 1e-6
"""Relative decrease of the sum of squares, and relative step, that end the search."""
_NOT_FINITE = 1e100
"""Replacement for residuals that are not finite."""
_DEPENDENT = 1e-9
"""Fraction of the largest singular value below which nuisances are dependent."""


class Rows(NamedTuple):
    """Weighted residuals of all flights and equations at one point."""

    r: Float[np.ndarray, " n"]
    J: Float[np.ndarray, "n q"]
    """Derivative of r."""
    equation: np.ndarray
    """Index of the equation in `Regression.equations`, (n,)."""

    @property
    def cost(self) -> float:
        """Sum of squares."""
        return float(self.r @ self.r)


class Regression(NamedTuple):
    """Equations, records and parameters of a regression."""

    model: Model
    base: Mapping[str, float]
    """All parameters by name, SI."""
    names: tuple[str, ...]
    """Estimated parameters (q,)."""
    records: tuple[Record, ...]

    @property
    def equations(self) -> tuple[str, ...]:
        """States and outputs whose equations are regressed."""
        return tuple(dict.fromkeys(e for r in self.records for e in r.structure.equations))

    def rows(self, values: Float[np.ndarray, " q"], weights: Mapping[str, float]) -> Rows | None:
        """Return residuals and derivatives at values (q,), SI; None if they are not finite
        (division by zero)."""
        parts = []
        for flight in self.records:
            equations = flight.structure.equations
            weight = np.array([weights[n] for n in equations])[:, None, None]
            known = {**self.base, **flight.known}
            try:
                with np.errstate(all="ignore"):
                    matrices = coefficients(self.model, known, self.names, values)
                    x = _flight_residuals(flight, matrices, weight)
            except (ValueError, np.linalg.LinAlgError):  # infinite matrix or signal
                return None
            index = [self.equations.index(n) for n in equations]
            parts.append(Rows(x[:, 0], x[:, 1:], np.repeat(index, x.shape[0] // len(index))))
        rows = Rows(*(np.concatenate(column) for column in zip(*parts, strict=True)))
        with np.errstate(all="ignore"):
            return rows if np.isfinite(rows.cost) and np.isfinite(rows.J).all() else None


def _flight_residuals(
    record: Record, matrices: Float[np.ndarray, "r c 1+q"], weight: Float[np.ndarray, "e 1 1"]
) -> Float[np.ndarray, "en 1+q"]:
    """Return the weighted residuals of a flight and their derivatives, equation by equation."""
    pairs = [_residual(segment, record.structure, matrices) for segment in record.segments]
    residual = np.concatenate([r for r, _ in pairs], axis=1)
    e, n, c = residual.shape
    # Initial values and constants enter linearly and are projected out. J neglects that the
    # responses to initial values depend on the parameters.
    initial = [scipy.linalg.block_diag(*(free[i] for _, free in pairs)) for i in range(e)]
    constants = np.broadcast_to(np.eye(e)[:, None, :], (e, n, e))
    nuisances = weight * np.concatenate([np.array(initial), constants], axis=-1)
    x, N = (weight * residual).reshape(e * n, c), nuisances.reshape(e * n, -1)
    size = np.linalg.norm(N, axis=0)
    N = N[:, size > 0] / size[size > 0]
    # The columns of the constant and of a very slow free motion are nearly dependent.
    return x - N @ np.linalg.lstsq(N, x, rcond=_DEPENDENT)[0]


def _residual(
    segment: Segment, structure: Structure, matrices: Float[np.ndarray, "r c 1+q"]
) -> tuple[Float[np.ndarray, "e n 1+q"], Float[np.ndarray, "e n h"]]:
    """Return residuals with their derivatives, and responses to initial hidden states."""
    n, known = len(structure.states), segment.known
    rows, hidden = list(structure.rows), list(structure.hidden)
    columns = [*structure.shown, *range(n, matrices.shape[1])]
    residual = -np.einsum("ekc,kN->eNc", matrices[np.ix_(rows, columns)], known)
    residual[..., 0] += segment.left
    if not hidden:
        return residual, np.zeros((*residual.shape[:2], 0))
    # h' = A h + f starts from zero; the free motions are separate.
    A, through = matrices[np.ix_(hidden, hidden)], matrices[np.ix_(rows, hidden)]
    phi, first, second = _first_order_hold(A[..., 0], segment.step)
    f = np.einsum("hkc,kN->Nhc", matrices[np.ix_(hidden, columns)], known)

    def integrated(f: np.ndarray) -> np.ndarray:
        return _recurrence(phi, np.concatenate([0.0 * f[:1], first @ f[:-1] + second @ f[1:]]))

    h = integrated(f[..., :1])
    # Sensitivities have the same dynamics, driven by the derivatives of A and f.
    f[..., 1:] += np.einsum("hjq,Nj->Nhq", A[..., 1:], h[..., 0])
    h = np.concatenate([h, integrated(f[..., 1:])], axis=-1)
    residual -= np.einsum("eh,Nhc->eNc", through[..., 0], h)
    residual[..., 1:] -= np.einsum("ehq,Nh->eNq", through[..., 1:], h[..., 0])
    impulse = np.zeros((known.shape[1], len(hidden), len(hidden)))
    impulse[0] = np.eye(len(hidden))
    return residual, np.einsum("eh,Nhj->eNj", through[..., 0], _recurrence(phi, impulse))


def _first_order_hold(A: Float[np.ndarray, "h h"], step: float) -> tuple[np.ndarray, ...]:
    """Return phi, first and second of x(k+1) = phi x(k) + first f(k) + second f(k+1).

    This solves x' = A x + f with f linear between samples, by one matrix exponential (Van Loan,
    1978).
    """
    h = A.shape[0]
    block = np.zeros((3 * h, 3 * h))
    block[:h, :h], block[:h, h : 2 * h] = A * step, np.eye(h) * step
    block[h : 2 * h, 2 * h :] = np.eye(h)
    whole = scipy.linalg.expm(block)
    second = whole[:h, 2 * h :]
    return whole[:h, :h], whole[:h, h : 2 * h] - second, second


def _recurrence(
    phi: Float[np.ndarray, "h h"], f: Float[np.ndarray, "N h c"]
) -> Float[np.ndarray, "N h c"]:
    """Return x(0) = f(0), x(k) = phi x(k-1) + f(k), in log2(N) steps."""
    x, done = f.copy(), 1
    # x(k) holds the sum over the last `done` samples.
    while done < len(x):
        x[done:] += phi @ x[:-done]
        phi, done = phi @ phi, 2 * done
    return x


def search(
    regression: Regression,
    start: Float[np.ndarray, " q"],
    keep_sign: np.ndarray,
    weights: Mapping[str, float],
) -> "_Optimum | None":
    """Minimise the equation error from `start` (q,), SI; return None if it is not finite there.

    Parameters with `keep_sign` (q,) are searched in their logarithms.
    """
    from scipy.optimize import least_squares

    first = regression.rows(start, weights)
    if first is None:
        return None

    def values(z: np.ndarray) -> np.ndarray:
        return np.where(keep_sign, start * np.exp(np.clip(z, -50.0, 50.0)), z)

    @functools.lru_cache(maxsize=2)
    def at(z: tuple[float, ...]) -> Rows | None:
        return regression.rows(values(np.array(z)), weights)

    def residuals(z: np.ndarray) -> np.ndarray:
        rows = at(tuple(z))
        return np.full(first.r.shape, _NOT_FINITE) if rows is None else rows.r

    def slopes(z: np.ndarray) -> np.ndarray:
        return (at(tuple(z)) or first).J * np.where(keep_sign, values(z), 1.0)

    z = np.where(keep_sign, 0.0, start)
    end = least_squares(
        residuals,
        z,
        slopes,  # pyright: ignore[reportArgumentType]
        method="lm",
        x_scale="jac",
        ftol=_SMALL,
        xtol=_SMALL,
        max_nfev=_EVALUATIONS,
    ).x
    return _Optimum(values(end), at(tuple(end)) or first, weights)


_ROUNDS = 3
"""Rounds of regression; each takes its weights from the previous residuals."""
_NULL = 1e-5
"""Singular value of unit columns below which parameters are exchangeable."""
Origin = Literal["equation error", "frequency error", "as stated", "vehicle"]


class StartValue(NamedTuple):
    """Start of one parameter; the fields are keys of fit.json."""

    value: float
    unit: str
    origin: Origin
    reason: str
    """Reason why neither regression nor fit found it; empty if one did."""


class Equation(NamedTuple):
    """One regressed equation."""

    name: str
    """State or output on the left-hand side."""
    r_squared: float


class EquationErrorStart(NamedTuple):
    """Start values and their origin."""

    values: dict[str, StartValue]
    equations: tuple[Equation, ...]
    half_width: float
    """Half width of the smoothing kernel [s]."""
    hidden: tuple[str, ...]
    """States that no output determines, integrated by their own equations."""

    @property
    def findings(self) -> list[Finding]:
        """Origin of each value."""
        names = [n for n, v in self.values.items() if v.origin == "equation error"]
        explained = {
            "equations": [e.name for e in self.equations],
            "explained": [e.r_squared for e in self.equations],
            "half_width": self.half_width,
        }
        out = [found("start.equation-error", "note", names=names or ["nothing"], **explained)]
        if self.hidden:
            out.append(found("start.hidden-states", "note", names=self.hidden))
        return out + reasons_of(self.values)


def reasons_of(values: Mapping[str, StartValue]) -> list[Finding]:
    """Return one finding for each reason for missing values."""
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
}


def equation_error_start(
    model: Model,
    vehicle: Any,  # the model's Params
    flights: Sequence[Flight],
    free: Mapping[str, Free],
) -> EquationErrorStart:
    """Return start values of the free parameters of a linear model.

    Args:
        model: model with `linear=True`.
        vehicle: the model's Params, SI; free parameters may be NaN.
        flights: held-out flights are ignored.
        free: bounds and start by parameter. A start other than NaN is kept if the regression does
            not determine the parameter, such as a time constant of a hidden state.

    Raises:
        ValueError: nothing can be regressed, or a parameter has no start.
    """
    flights = [f for f in flights if not f.hold_out]
    regression, half, reasons = _regression(model, vehicle, flights, free)
    keep = {n for n in regression.names if _keeps_sign(model, n, free[n].sign, regression.base[n])}
    optimum = _optimum(regression, keep)
    # Parameters are fixed one at a time: fixing one of two exchangeable parameters determines the
    # other.
    while (out := _undetermined(regression, optimum.rows)) is not None:
        name, reasons[name] = out
        _require_value(regression.base, name, reasons[name])
        regression = regression._replace(names=tuple(n for n in regression.names if n != name))
        if not regression.names:
            raise _no_regression("the equations determine none of the free parameters")
        optimum = _optimum(regression, keep)
    structures, rows = [one.structure for one in regression.records], optimum.rows
    equations = []
    for i, (name, size) in enumerate(_sizes(regression).items()):
        left = float(np.mean((rows.r[rows.equation == i] / optimum.weights[name]) ** 2))
        equations.append(Equation(name, 1.0 - left / size**2))
    estimates = dict(zip(regression.names, optimum.values.tolist(), strict=True))
    return EquationErrorStart(
        {n: _value(regression, n, free[n], estimates.get(n), reasons.get(n, "")) for n in free},
        tuple(equations),
        half * flights[0].dt,
        tuple(dict.fromkeys(s.states[i] for s in structures for i in s.hidden)),
    )


def _regression(
    model: Model, vehicle: Any, flights: Sequence[Flight], free: Mapping[str, Free]
) -> tuple[Regression, int, dict[str, str]]:
    """Return the regression, the kernel's half width [samples], and the reason for each
    undetermined parameter."""
    if not model.linear:
        raise ValueError(
            f"start: equation-error is for linear models, and {model.name} is none: expected a "
            "start of each free parameter"
        )
    stated = {n: f.start for n, f in free.items() if math.isfinite(f.start)}
    base = {n: float(np.asarray(v)) for n, v in naming.asdict(vehicle).items()} | stated
    # Free parameters get generic numbers, so NaN remains only where a constant is missing.
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
        measured = ", ".join({n: None for f in flights for n in f.outputs})
        raise _no_regression(f"no equation of a state that {measured} show has a free parameter")
    if not names:
        raise _no_regression("all that is free are delays, or time constants of hidden states")
    for n, why in reasons.items():
        _require_value(base, n, why)
    half, records = kernel_width(flights), []
    for flight, shown in zip(flights, structures, strict=True):
        late = {u: {**base, **flight.known}[p] for u, p in delays.items()}
        records.append(record(model, flight, shown, half, late))
    records = tuple(one for one in records if one.segments and one.structure.rows)
    if not records:
        raise _no_regression(
            "no stretch without missing samples is as long as the smoothing needs "
            f"({shortest(half)} samples)"
        )
    return Regression(model, base, names, records), half, reasons


def _no_regression(why: str) -> ValueError:
    return ValueError(
        f"start: equation-error: nothing can be regressed, since {why}: expected a start of each "
        "free parameter"
    )


def _require_value(base: Mapping[str, float], name: str, why: str) -> None:
    if not math.isfinite(base[name]):
        raise ValueError(f"free.{name}.start: missing, expected a value to begin with: {why}")


class _Optimum(NamedTuple):
    values: np.ndarray
    rows: Rows
    weights: Mapping[str, float]


def _keeps_sign(model: Model, name: str, sign: Sign | None, at_hand: float) -> bool:
    """True if a parameter has a known sign to keep."""
    positive = name in model.positive
    known = positive or (math.isfinite(at_hand) and at_hand != 0)
    by_default = positive or of_helicopter(model.Params)
    return known and (sign == "keep" or (sign is None and by_default))


def _optimum(regression: Regression, keep_sign: set[str]) -> _Optimum:
    """Return the weighted least squares; weights are the inverse residual rms of each equation."""
    keep = np.array([n in keep_sign for n in regression.names], bool)
    # The first weights are the inverse sd of the left-hand sides.
    weights = {n: 1.0 / size for n, size in _sizes(regression).items()}
    optimum = _first_search(regression, keep, weights)
    for _ in range(_ROUNDS - 1):
        rows = optimum.rows
        weights = {
            name: w / max(float(np.sqrt(np.mean(rows.r[rows.equation == i] ** 2))), 1e-9)
            for i, (name, w) in enumerate(weights.items())
        }
        again = search(regression, optimum.values, keep, weights)
        if again is None:
            break
        optimum = again
    return optimum


def _first_search(
    regression: Regression, keep: np.ndarray, weights: Mapping[str, float]
) -> _Optimum:
    """Return the best of searches from zero, from the known values, and from one."""
    at_hand = np.array([regression.base[n] for n in regression.names])
    known = np.where(np.isfinite(at_hand) & (at_hand != 0), at_hand, 1.0)
    # Products of parameters may cause two optima, and a parameter may be a divisor.
    starts = [np.where(keep, known, 0.0), known, np.where(keep, known, 1.0)]
    runs = [search(regression, start, keep, weights) for start in starts]
    finite = [run for run in runs if run is not None]
    if not finite:
        raise ValueError(
            "start: equation-error: the equations are not finite at zero, one and the vehicle's "
            f"values of {', '.join(regression.names)}: expected a start of each free parameter"
        )
    return min(finite, key=lambda run: run.rows.cost)


def _sizes(regression: Regression) -> dict[str, float]:
    """Return the standard deviation of each equation's left-hand side."""
    left = {name: [] for name in regression.equations}
    for one in regression.records:
        for k, name in enumerate(one.structure.equations):
            left[name] += [s.left[k] - s.left[k].mean() for s in one.segments]
    return {n: max(float(np.std(np.concatenate(v))), 1e-300) for n, v in left.items()}


def _undetermined(regression: Regression, rows: Rows) -> tuple[str, str] | None:
    """Return a parameter that the regression does not determine and the reason, or None."""
    norms, names = np.linalg.norm(rows.J, axis=0), regression.names
    if not norms.all():
        return names[int(np.argmin(norms))], "no measured state or output moves with it"
    _, sizes, directions = np.linalg.svd(rows.J / norms, full_matrices=False)
    if sizes[-1] > _NULL * sizes[0]:
        return None
    part = np.abs(directions[-1])
    involved = [i for i in np.argsort(-part) if part[i] > 0.1]
    # A parameter with a known value is preferred, because it can keep that value.
    first = ([i for i in involved if math.isfinite(regression.base[names[i]])] or involved)[-1]
    others = ", ".join(names[i] for i in involved if i != first)
    return names[first], f"the equations do not tell it from {others}"


def _value(
    regression: Regression,
    name: str,
    free: Free,
    estimate: float | None,
    reason: str,
) -> StartValue:
    unit = naming.unit(regression.model.Params, name) or "1"
    if estimate is None:
        origin: Origin = "as stated" if math.isfinite(free.start) else "vehicle"
        return StartValue(regression.base[name], unit, origin, reason)
    inside = _inside(free, estimate)
    moved = "" if inside == estimate else f"{estimate:.4g} lies outside its bounds"
    return StartValue(inside, unit, "equation error", moved)


def _inside(free: Free, value: float) -> float:
    """Return the value; if outside its bounds, move it inside by 1 % of their span."""
    low = -math.inf if free.lower is None else free.lower
    high = math.inf if free.upper is None else free.upper
    if low < value < high:
        return value
    span = high - low if math.isfinite(high - low) else max(abs(low if value <= low else high), 1.0)
    return low + 0.01 * span if value <= low else high - 0.01 * span
