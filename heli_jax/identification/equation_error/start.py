"""Start values of a linear model's parameters from the records themselves, without a vehicle.

Equation error: each state's derivative is regressed on states and inputs. Measurement noise on the
regressors and gusts bias it: a start for a fit, never a result.

Hidden states are integrated by their own equations, from what is measured. Their initial values,
and a constant in each equation and flight (trim, bias), are projected out. Levenberg-Marquardt
finds the least squares; where parameters enter linearly its first step is the regression.
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

_APART = 1_000_000
"""instants between segments and flights, longer than any lag"""
_EVALUATIONS = 40
"""of the residuals in one search, at most"""
_SMALL = 1e-6
"""relative fall of the sum of squares, and relative step, at which the search ends"""
_NOT_FINITE = 1e100
"""residuals that stand for those that are not finite"""
_DEPENDENT = 1e-9
"""part of the largest singular value below which nuisances depend on one another"""


class Rows(NamedTuple):
    """Residuals of all flights and equations at one point, weighted."""

    r: Float[np.ndarray, " n"]
    J: Float[np.ndarray, "n q"]
    """derivative of r"""
    times: np.ndarray
    """(n,) which rows belong to one instant: the same whole number; jumps between segments"""
    equation: np.ndarray
    """(n,) which equation, in the order of `Regression.equations`"""

    @property
    def cost(self) -> float:
        """The sum of squares."""
        return float(self.r @ self.r)


class Regression(NamedTuple):
    """A regression of some parameters of a model."""

    model: Model
    base: Mapping[str, float]
    """all parameters by name, SI"""
    names: tuple[str, ...]
    """those that are estimated"""
    records: tuple[Record, ...]

    @property
    def equations(self) -> tuple[str, ...]:
        """The states and outputs whose equations are regressed."""
        return tuple(dict.fromkeys(e for r in self.records for e in r.structure.equations))

    def rows(self, values: Float[np.ndarray, " q"], weights: Mapping[str, float]) -> Rows | None:
        """Return residuals and their derivatives at values (q,), SI; None where they are not
        finite, as at a parameter of zero that something is divided by."""
        parts, begin, order = [], 0, self.equations
        for one in self.records:
            names = one.structure.equations
            weight = np.array([weights[n] for n in names])[:, None, None]
            known = {**self.base, **one.known}
            try:
                with np.errstate(all="ignore"):
                    both = coefficients(self.model, known, self.names, values)
                    x = _of_flight(one, both, weight)
            except (ValueError, np.linalg.LinAlgError):  # an infinite matrix or signal
                return None
            instants = []
            for segment in one.segments:
                instants.append(begin + np.arange(segment.left.shape[1]))
                begin += _APART
            times = np.tile(np.concatenate(instants), len(names))
            equation = np.repeat([order.index(n) for n in names], x.shape[0] // len(names))
            parts.append(Rows(x[:, 0], x[:, 1:], times, equation))
        rows = Rows(*(np.concatenate(column) for column in zip(*parts, strict=True)))
        with np.errstate(all="ignore"):
            return rows if np.isfinite(rows.cost) and np.isfinite(rows.J).all() else None


def _of_flight(
    one: Record, both: Float[np.ndarray, "r c 1+q"], weight: Float[np.ndarray, "e 1 1"]
) -> Float[np.ndarray, "en 1+q"]:
    """Return the weighted residuals of a flight, and their derivatives, equation by equation."""
    pairs = [_residual(segment, one.structure, both) for segment in one.segments]
    residual = np.concatenate([r for r, _ in pairs], axis=1)
    e, n, c = residual.shape
    # Initial values and constants enter linearly: their best values are known at any parameters. J
    # leaves out that the responses to initial values move with the parameters.
    initial = [scipy.linalg.block_diag(*(free[i] for _, free in pairs)) for i in range(e)]
    constants = np.broadcast_to(np.eye(e)[:, None, :], (e, n, e))
    nuisances = weight * np.concatenate([np.array(initial), constants], axis=-1)
    x, away = (weight * residual).reshape(e * n, c), nuisances.reshape(e * n, -1)
    size = np.linalg.norm(away, axis=0)
    away = away[:, size > 0] / size[size > 0]
    # Dependent columns, as a very slow free motion beside the constant, add nothing but rounding.
    return x - away @ np.linalg.lstsq(away, x, rcond=_DEPENDENT)[0]


def _residual(
    segment: Segment, structure: Structure, both: Float[np.ndarray, "r c 1+q"]
) -> tuple[Float[np.ndarray, "e n 1+q"], Float[np.ndarray, "e n h"]]:
    """Residuals with their derivatives, and responses to the initial values of hidden states."""
    n, known = len(structure.states), segment.known
    rows, hidden = list(structure.rows), list(structure.hidden)
    columns = [*structure.shown, *range(n, both.shape[1])]
    residual = -np.einsum("ekc,kN->eNc", both[np.ix_(rows, columns)], known)
    residual[..., 0] += segment.left
    if not hidden:
        return residual, np.zeros((*residual.shape[:2], 0))
    # The hidden states h' = A h + f, which begin at zero, and their free motions.
    A, through = both[np.ix_(hidden, hidden)], both[np.ix_(rows, hidden)]
    phi, first, second = _first_order_hold(A[..., 0], segment.step)
    f = np.einsum("hkc,kN->Nhc", both[np.ix_(hidden, columns)], known)

    def integrated(f: np.ndarray) -> np.ndarray:
        return _recurrence(phi, np.concatenate([0.0 * f[:1], first @ f[:-1] + second @ f[1:]]))

    h = integrated(f[..., :1])
    # A derivative by a parameter has the same dynamics, and is driven by what the parameter moves.
    f[..., 1:] += np.einsum("hjq,Nj->Nhq", A[..., 1:], h[..., 0])
    h = np.concatenate([h, integrated(f[..., 1:])], axis=-1)
    residual -= np.einsum("eh,Nhc->eNc", through[..., 0], h)
    residual[..., 1:] -= np.einsum("ehq,Nh->eNq", through[..., 1:], h[..., 0])
    impulse = np.zeros((known.shape[1], len(hidden), len(hidden)))
    impulse[0] = np.eye(len(hidden))
    return residual, np.einsum("eh,Nhj->eNj", through[..., 0], _recurrence(phi, impulse))


def _first_order_hold(A: Float[np.ndarray, "h h"], step: float) -> tuple[np.ndarray, ...]:
    """Return phi, first and second of x(k+1) = phi x(k) + first f(k) + second f(k+1), for
    x' = A x + f with f straight between samples, by one exponential (Van Loan, 1978)."""
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
    """Return x(0) = f(0), x(k) = phi x(k-1) + f(k), by doubling."""
    x, done = f.copy(), 1
    # After each round x(k) holds what the last `done` samples add: log2(N) steps in place of N.
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
    """Minimise the equation error from values `start` (q,), SI, those with `keep_sign` (q,) in
    their logarithms; None where it is not finite at the start."""
    from scipy.optimize import least_squares

    first = regression.rows(start, weights)
    if first is None:
        return None

    def values(z: np.ndarray) -> np.ndarray:
        # At most a factor of e^50 either way, whatever step is tried.
        return np.where(keep_sign, start * np.exp(np.clip(z, -50.0, 50.0)), z)

    @functools.lru_cache(maxsize=2)
    def at(z: tuple[float, ...]) -> Rows | None:
        return regression.rows(values(np.array(z)), weights)

    def residuals(z: np.ndarray) -> np.ndarray:
        rows = at(tuple(z))
        return np.full(first.r.shape, _NOT_FINITE) if rows is None else rows.r

    def slopes(z: np.ndarray) -> np.ndarray:
        # A logarithm's step is relative: its column is the parameter's times its value.
        return (at(tuple(z)) or first).J * np.where(keep_sign, values(z), 1.0)

    z = np.where(keep_sign, 0.0, start)
    end = least_squares(
        residuals,
        z,
        slopes,  # pyright: ignore[reportArgumentType]
        # MINPACK's takes no fewer residuals than parameters.
        method="lm" if first.r.size >= start.size else "trf",
        x_scale="jac",
        ftol=_SMALL,
        xtol=_SMALL,
        max_nfev=_EVALUATIONS,
    ).x
    return _Optimum(values(end), at(tuple(end)) or first, weights)


_LAGS = 2.0
"""times the root of the number of instants: how far neighbours are allowed for"""


def covariance(rows: Rows) -> Float[np.ndarray, "q q"]:
    """Return the covariance of the estimates (q, q), by the residuals where the search ended.

    Smoothed residuals and gusts are alike over many samples: the products of regressor and residual
    are summed over neighbouring instants with Bartlett's weights (Newey and West, Econometrica 55,
    1987; Klein and Morelli, Aircraft System Identification, 2006, 5.2.3).
    """
    instants, number = np.unique(rows.times, return_inverse=True)
    lags = int(_LAGS * instants.size**0.5)
    # Sums over the rows of each instant, with gaps of zeros that no lag reaches across.
    place = np.r_[0, np.cumsum(np.minimum(np.diff(instants), lags + 1))]
    sums = np.zeros((int(place[-1]) + 1, rows.J.shape[1]))
    np.add.at(sums, place[number], rows.J * rows.r[:, None])
    total = sums.T @ sums
    for lag in range(1, min(lags, len(sums) - 1) + 1):
        product = sums[lag:].T @ sums[:-lag]
        # Falling weights keep the variance from becoming negative.
        total += (1.0 - lag / (lags + 1.0)) * (product + product.T)
    bread = np.linalg.pinv(rows.J.T @ rows.J, hermitian=True)
    return bread @ total @ bread


class Step(NamedTuple):
    """One step of the selection. The names of the fields are keys of fit.json."""

    parameter: str
    entered: bool
    """or it was removed"""
    f_ratio: float
    r_squared: float
    """of all equations together, each over its residual, after the step"""


class Selection(NamedTuple):
    """The terms that are in at the end, and the steps to there."""

    selected: tuple[str, ...]
    steps: tuple[Step, ...]
    f_ratios: dict[str, float]
    """at the end, of every term: to remove it where it is in, to enter it where it is not"""


def select(
    rows: Rows,
    values: Float[np.ndarray, " q"],
    names: Sequence[str],
    forced: Sequence[str],
    limits: tuple[float, float],
) -> Selection:
    """Remove terms and enter them again, until no partial F-ratio is beyond its limit, as SIDPAC's
    `swr` does (Klein and Morelli, 2006, 5.4; Draper and Smith, Applied Regression Analysis).

    All terms are in at first, where `swr` begins with none: with half of a response missing, what
    is left over is so autocorrelated that no term by itself would pass.

    Args:
        values: of the parameters where all terms are in (q,).
        forced: those that stay in: they cannot be zero.
        limits: F to enter and F to remove; the second is at most the first.
    """
    # Linear about the point where all terms are in: r = y - X v, so X = -J.
    X, y = -rows.J, rows.r - rows.J @ values

    def regressed(terms: list[int]) -> tuple[np.ndarray, float]:
        """F-ratio of each term beside the others, and R2."""
        theta = np.linalg.lstsq(X[:, terms], y)[0]
        left = y - X[:, terms] @ theta
        variances = np.diag(covariance(rows._replace(r=left, J=X[:, terms])))
        with np.errstate(divide="ignore"):
            return theta**2 / variances, 1.0 - float(left @ left / (y @ y))

    inside, steps = list(range(len(names))), []
    leaving, entering = {}, {}
    # Not for ever: rounding must not turn in a circle.
    for _ in range(4 * len(names)):
        ratios = dict(zip(inside, regressed(inside)[0], strict=True))
        leaving = {j: float(f) for j, f in ratios.items() if names[j] not in forced}
        outside = [j for j in range(len(names)) if j not in inside]
        entering = {j: float(regressed([*inside, j])[0][-1]) for j in outside}
        worst = min(leaving, key=leaving.__getitem__, default=None)
        best = max(entering, key=entering.__getitem__, default=None)
        if worst is not None and leaving[worst] < limits[1]:
            inside.remove(worst)
            steps.append(Step(names[worst], False, leaving[worst], regressed(inside)[1]))
        elif best is not None and entering[best] >= limits[0]:
            inside.append(best)
            steps.append(Step(names[best], True, entering[best], regressed(inside)[1]))
        else:
            break
    final = {**entering, **leaving}
    selected = tuple(n for j, n in enumerate(names) if j in inside)
    return Selection(selected, tuple(steps), {names[j]: final[j] for j in sorted(final)})


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
    """The start of one parameter. The names of the fields are keys of fit.json."""

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
        """The origin of each value."""
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
    # One at a time: of two exchangeable parameters the other is determined once one is held.
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
        # Without those that are out the values of correlated regressors move.
        out = dict.fromkeys(set(regression.names) - set(selection.selected), 0.0)
        regression = regression._replace(names=selection.selected, base={**regression.base, **out})
        optimum = _optimum(regression, keep) if selection.selected else optimum
    structures, rows = [one.structure for one in regression.records], optimum.rows
    equations = []
    for i, (name, size) in enumerate(_sizes(regression).items()):
        left = float(np.mean((rows.r[rows.equation == i] / optimum.weights[name]) ** 2))
        equations.append(Equation(name, 1.0 - left / size**2))
    sd = np.sqrt(np.maximum(np.diag(covariance(rows)), 0.0))
    estimates = dict(zip(regression.names, zip(optimum.values, sd, strict=False), strict=False))
    return EquationErrorStart(
        {n: _value(regression, n, free[n], estimates.get(n), reasons.get(n)) for n in free},
        tuple(equations),
        half * flights[0].dt,
        tuple(dict.fromkeys(s.states[i] for s in structures for i in s.hidden)),
        selection,
    )


def _regression(
    model: Model, vehicle: Any, flights: Sequence[Flight], free: Mapping[str, Free]
) -> tuple[Regression, int, dict[str, str]]:
    """Return the flights smoothed, the kernel's half width [samples], and by parameter that no
    regression finds the reason."""
    if not model.linear:
        raise ValueError(
            f"start: equation-error is for linear models, and {model.name} is none: expected a "
            "start of each free parameter"
        )
    stated = {n: f.start for n, f in free.items() if math.isfinite(f.start)}
    base = {n: float(np.asarray(v)) for n, v in naming.asdict(vehicle).items()} | stated
    # With generic numbers of what is free, NaN is left only where a constant is missing.
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
    weights: Mapping[str, float]


def _keeps_sign(model: Model, name: str, sign: Sign | None, at_hand: float) -> bool:
    """True if a parameter has a known sign to keep."""
    positive = name in model.positive
    known = positive or (math.isfinite(at_hand) and at_hand != 0)
    by_default = positive or of_helicopter(model.Params)
    return known and (sign == "keep" or (sign is None and by_default))


def _optimum(regression: Regression, keep_sign: set[str]) -> _Optimum:
    """Regress with the equations weighted by their own residuals."""
    keep = np.array([n in keep_sign for n in regression.names], bool)
    # Equations differ in unit and noise, and share parameters. The first weights are the sizes of
    # their left-hand sides.
    weights = {n: 1.0 / size for n, size in _sizes(regression).items()}
    optimum = _first_search(regression, keep, weights)
    for _ in range(_ROUNDS - 1):
        rows = optimum.rows
        weights = {
            # The floor keeps an equation that is met exactly from drowning all others.
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
    """Return the best of searches from several values."""
    at_hand = np.array([regression.base[n] for n in regression.names])
    known = np.isfinite(at_hand) & (at_hand != 0)
    # From nothing, and from the values at hand: products of parameters may have two optima.
    starts = [np.where(keep, np.where(known, at_hand, 1.0), 0.0)]
    if known.any():
        starts.append(np.where(known, at_hand, starts[0]))
    runs = [search(regression, x, keep, weights) for x in starts]
    if None in runs:
        # Something is divided by one of them: any size and either sign are tried.
        tries = [np.where(keep, np.where(known, at_hand, abs(x)), x) for x in _TRIED]
        runs += [search(regression, x, keep, weights) for x in tries]
    finite = [run for run in runs if run is not None]
    if not finite:
        raise ValueError(
            "start: equation-error: the equations are not finite at any value tried of "
            f"{', '.join(regression.names)} (zero, the vehicle's, {_TRIED[0]:g} and others): "
            "expected a start of each free parameter"
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
    """Return a parameter that the regression does not determine, and why."""
    norms, names = np.linalg.norm(rows.J, axis=0), regression.names
    if not norms.all():
        return names[int(np.argmin(norms))], "no measured state or output moves with it"
    # Columns of one length: units must not decide which direction counts as small.
    _, sizes, directions = np.linalg.svd(rows.J / norms, full_matrices=False)
    if sizes[-1] > _NULL * sizes[0]:
        return None
    part = np.abs(directions[-1])
    involved = [i for i in np.argsort(-part) if part[i] > 0.1]
    # One with a value at hand can stay where it is.
    first = ([i for i in involved if math.isfinite(regression.base[names[i]])] or involved)[-1]
    others = ", ".join(names[i] for i in involved if i != first)
    return names[first], f"the equations do not tell it from {others}"


def _forced(regression: Regression, keep_sign: set[str], optimum: _Optimum) -> list[str]:
    """Return the parameters that cannot be zero: something is divided by them, or they keep their
    sign."""
    without = optimum.values * ~np.eye(len(optimum.values), dtype=bool)
    return [
        name
        for name, values in zip(regression.names, without, strict=True)
        if name in keep_sign or regression.rows(values, optimum.weights) is None
    ]


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
    """Return the value, or where it lies outside the bounds the nearest one a little inside."""
    low = -math.inf if free.lower is None else free.lower
    high = math.inf if free.upper is None else free.upper
    # Strictly inside: a bound lies at infinity in the coordinates of a bounded parameter.
    if low < value < high:
        return value
    span = high - low if math.isfinite(high - low) else max(abs(low if value <= low else high), 1.0)
    return low + 0.01 * span if value <= low else high - 0.01 * span
