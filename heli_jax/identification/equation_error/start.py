"""Start values of a linear model's parameters by equation error.

Each state's derivative is regressed on states and inputs (Klein and Morelli, Aircraft System
Identification, 2006, chapter 5). Gusts, and measurement noise on the regressors, bias the result.
It therefore only starts a fit.

All signals are convolved with a Gaussian, and differentiated by convolution with its derivatives
(modulating functions: M. Shinbrot, NACA TN 3288, 1954). A linear equation x' = A x + B u holds for
the smoothed signals, for any width of the Gaussian.

Hidden states are integrated by their own equations from the measured signals. Their initial values,
and a constant for each equation and flight (trim, bias), are projected out.
"""

import itertools
import math
from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
import scipy.linalg
from jaxtyping import Float

from heli_jax import naming
from heli_jax.dynamics.jacobians import jacobians
from heli_jax.dynamics.model import Model, require_constants
from heli_jax.finding import Finding, found
from heli_jax.flights.flight import Flight
from heli_jax.flights.holds import without_jumps
from heli_jax.identification.problem import Free, Sign
from heli_jax.numerics.white_noise import noise_guess
from heli_jax.vehicle import of_helicopter

_ORDERS = 3
"""A signal, its first and its second derivative."""
_WIDTHS = (1.2, 1.8, 2.4, 3.6, 4.8, 7.2, 9.6, 14.4, 19.2)
"""Candidate standard deviations of the Gaussian [samples]."""
_REACH = 5.0
"""Half width of the Gaussian, over its standard deviation."""
_MOST_LEFT_OUT = 0.05
"""Largest part of a signal's sd that smoothing may remove besides the noise."""
_SHORTEST = 20.0
"""Shortest segment, over the standard deviation of the Gaussian."""
_BRIDGED = 3
"""Longest gap that is interpolated [samples]; longer gaps end a segment."""
_LOST = 2.5
"""Longest gap of a slow sensor that is interpolated [usual steps]: one lost sample, with jitter."""
_SEGMENTS = 20
"""Most segments of a flight (the longest count), because each adds initial values of hidden states.
"""
_DETERMINED = 1e-8
"""Largest residual of a unit vector in the span of the measured outputs."""
_SMALL = 1e-6
"""Relative decrease of the sum of squares, and relative step, that end the search."""
_NOT_FINITE = 1e100
"""Replacement for residuals that are not finite."""
_DEPENDENT = 1e-9
"""Fraction of the largest singular value below which nuisances are dependent."""


def bridged(y: Float[np.ndarray, " N"]) -> Float[np.ndarray, " N"]:
    """Return an output with its short gaps interpolated."""
    seen = np.flatnonzero(np.isfinite(y))
    if not 1 < seen.size < y.size:
        return y
    from scipy.interpolate import PchipInterpolator

    # On a fast grid a slow sensor misses most samples.
    filled = PchipInterpolator(seen, y[seen], extrapolate=False)(np.arange(y.size))
    steps = np.diff(seen)
    long = steps > 1 + max(_BRIDGED, _LOST * float(np.median(steps)))
    filled[seen[0] : seen[-1]][np.repeat(long, steps)] = np.nan
    filled[seen] = y[seen]
    return filled


def smoothed(
    y: Float[np.ndarray, " N"], dt: float, width: float, *, mode: Literal["constant", "nearest"]
) -> Float[np.ndarray, "3 N"]:
    """Return the smoothed signal and its derivatives per second.

    Args:
        y: signal; NaN where it is missing.
        width: standard deviation of the Gaussian [samples].
        mode: `constant` for NaN near the ends, `nearest` for a signal that is constant beyond them.
    """
    from scipy.ndimage import gaussian_filter1d

    orders = range(_ORDERS)
    signals = [
        gaussian_filter1d(y, width, order=r, mode=mode, cval=np.nan, truncate=_REACH)
        for r in orders
    ]
    return np.array(signals) / dt ** np.array(orders)[:, None]


def _width(flights: Sequence[Flight]) -> float:
    """Return the standard deviation of the widest Gaussian that removes little but noise
    [samples]."""
    signals = [
        (bridged(y), flight.sd.get(n) or noise_guess(y))
        for flight in flights
        for n, y in flight.outputs.items()
    ]

    def passes(width: float) -> bool:
        for y, sd in signals:
            removed = y - smoothed(y, 1.0, width, mode="constant")[0]
            # A short record needs a narrow kernel.
            if np.isfinite(removed).sum() < _SHORTEST * width:
                return False
            if np.nanstd(removed) > np.hypot(sd, _MOST_LEFT_OUT * float(np.nanstd(y))):
                return False
        return True

    return max([_WIDTHS[0], *itertools.takewhile(passes, _WIDTHS)])


class Segment(NamedTuple):
    """Smoothed segment without gaps, SI."""

    known: Float[np.ndarray, "k n"]
    """Measured states, then inputs."""
    left: Float[np.ndarray, "e n"]
    """Left-hand sides of the equations: derivatives per second, or outputs."""


class Record(NamedTuple):
    """A smoothed flight, its measured states, and the equations to regress."""

    known: Mapping[str, float]
    """Parameters of the flight."""
    equations: tuple[str, ...]
    """States and outputs (e,) on the left-hand sides."""
    rows: list[int]
    """Rows (e,) of `_matrix`."""
    columns: list[int]
    """Columns of `_matrix` that belong to `Segment.known`."""
    hidden: list[int]
    """States that no output determines."""
    segments: tuple[Segment, ...]
    step: float
    """Time between samples [s]."""


def _matrix(model: Model, values: Mapping[str, float]) -> Float[np.ndarray, "r c"]:
    """Return [A B; C D] of a linear model: rows of states then outputs, columns of states then
    inputs."""
    params = model.Params(**{n: np.asarray(v, np.float64) for n, v in values.items()})
    A, B, C, D = map(np.asarray, jacobians(model, params))
    return np.block([[A, B], [C, D]])


def _record(
    model: Model,
    flight: Flight,
    value: Float[np.ndarray, "r c"],
    depends: np.ndarray,
    width: float,
    late: Mapping[str, float],
) -> Record:
    """Return a smoothed flight with its measured states.

    Args:
        value: `_matrix` at generic values of the free parameters.
        depends: (r, c) True for entries that depend on free parameters.
        width: standard deviation of the Gaussian [samples].
        late: delays of inputs [s].
    """
    flight = without_jumps(flight)
    dt, states, outputs = flight.dt, naming.names(model.State), naming.names(model.Outputs)
    n = len(states)
    y = np.array(
        [smoothed(bridged(v), dt, width, mode="constant") for v in flight.outputs.values()]
    )
    inputs = []
    for name in naming.names(model.Inputs):
        # A held input acts half a sample later than a linear one.
        later = late.get(name, 0.0) + (0.5 * dt if flight.hold[name] == "zero-order" else 0.0)
        acting = np.interp(flight.times - later, flight.times, flight.inputs[name])
        inputs.append(smoothed(acting, dt, width, mode="nearest"))
    u = np.array(inputs)
    rows = [n + outputs.index(name) for name in flight.outputs]
    shown = _measured(value, depends, rows, y, u)
    hidden = [i for i in range(n) if i not in shown]
    regressed = [i for i in shown if depends[i].any() or (value[i, hidden] != 0).any()]
    left = [shown[i][1] for i in regressed] + [
        y[k][0] for k, row in enumerate(rows) if depends[row].any()
    ]
    regressed += [row for row in rows if depends[row].any()]
    signals = np.array([x[0] for x in shown.values()] + list(u[:, 0]))
    seen = np.isfinite(signals).all(axis=0) & np.isfinite(y).all(axis=(0, 1))
    parts = np.ma.clump_masked(np.ma.array(seen, mask=seen)) if left else []
    parts = [p for p in parts if p.stop - p.start >= _SHORTEST * width]
    parts = sorted(parts, key=lambda p: p.start - p.stop)[:_SEGMENTS]
    # Adjacent values of the smoothed signal are strongly correlated.
    every = max(1, int(width / _WIDTHS[0]))
    return Record(
        flight.known,
        tuple((*states, *outputs)[i] for i in regressed),
        regressed,
        [*shown, *range(n, value.shape[1])],
        hidden,
        tuple(Segment(signals[:, p][:, ::every], np.array(left)[:, p][:, ::every]) for p in parts),
        dt * every,
    )


def _measured(
    value: Float[np.ndarray, "r c"],
    depends: np.ndarray,
    rows: list[int],
    y: Float[np.ndarray, "p 3 N"],
    u: Float[np.ndarray, "m 3 N"],
) -> dict[int, Float[np.ndarray, "_ N"]]:
    """Return each state that outputs determine with known coefficients, and its derivatives.

    The derivative of a measured state, like the rate of an angle, is measured too.

    Args:
        value, depends: as in `_record`.
        rows: rows of `value` that belong to the outputs y.
        u: inputs, with derivatives as y.
    """
    n = value.shape[1] - len(u)
    # y - D u = C x is used if its coefficients are known. Other outputs are regressed.
    known = [k for k, row in enumerate(rows) if not depends[row].any()]
    used = [rows[k] for k in known]
    shown = _solved(value[used, :n], y[known] - np.tensordot(value[used, n:], u, 1))
    # With measured k, x_i' - A_ik x_k - B_i u = A_ij x_j determines further states j.
    rest = [j for j in range(n) if j not in shown]
    equations = [i for i in shown if not depends[i].any() and np.any(value[i, rest] != 0)]
    sides = [
        shown[i][1:]
        - sum(value[i, k] * x[:-1] for k, x in shown.items())
        - np.tensordot(value[i, n:], u[:, :-1], 1)
        for i in equations
    ]
    if sides:
        # This is done only once because each derivative adds noise.
        more = _solved(value[np.ix_(equations, rest)], np.array(sides))
        shown |= {rest[j]: x for j, x in more.items()}
    return shown


def _solved(
    left: Float[np.ndarray, "k n"], right: Float[np.ndarray, "k r N"]
) -> dict[int, Float[np.ndarray, "r N"]]:
    """Return the unknowns determined by left x = right, by index."""
    inverse = np.linalg.pinv(left, rcond=1e-10)
    # An unknown is determined if its row of A^+ A is that of the identity.
    alone = np.abs(inverse @ left - np.eye(left.shape[1])).max(axis=1, initial=0.0) < _DETERMINED
    solution = np.tensordot(inverse, right, axes=1)
    return {int(i): solution[i] for i in np.flatnonzero(alone)}


def _residual(
    record: Record, matrix: Float[np.ndarray, "r c"]
) -> tuple[Float[np.ndarray, "e n"], Float[np.ndarray, "e n h"]]:
    """Return the residuals, and the responses to the initial hidden states of each segment."""
    rows, hidden = record.rows, record.hidden
    known, through = matrix[np.ix_(rows, record.columns)], matrix[np.ix_(rows, hidden)]
    residual = [s.left - known @ s.known for s in record.segments]
    if not np.isfinite(matrix).all():
        hidden = []  # `_projected` refuses the residuals
    if not hidden:
        residual = np.concatenate(residual, axis=1)
        return residual, np.zeros((*residual.shape, 0))
    from scipy.signal import cont2discrete

    # h' = A h + f starts from zero; the free motions are separate.
    # With f linear between samples: h(k+1) = phi h(k) + first f(k) + second f(k+1).
    one = np.eye(len(hidden))
    system = (matrix[np.ix_(hidden, hidden)], one, one, 0.0 * one)
    discrete: Any = cont2discrete(system, record.step, "foh")  # SciPy's type is a union
    phi, B, _, second, _ = discrete
    first = B - phi @ second
    free = []
    for r, segment in zip(residual, record.segments, strict=True):
        f = matrix[np.ix_(hidden, record.columns)] @ segment.known
        pushed = np.concatenate([0.0 * f[:, :1], first @ f[:, :-1] + second @ f[:, 1:]], axis=1)
        r -= through @ _recurrence(phi, pushed.T[:, :, None])[:, :, 0].T
        impulse = np.zeros((f.shape[1], *phi.shape))
        impulse[0] = np.eye(len(phi))
        free.append(np.moveaxis(through @ _recurrence(phi, impulse), 0, 1))
    by_equation = [scipy.linalg.block_diag(*(f[i] for f in free)) for i in range(len(rows))]
    return np.concatenate(residual, axis=1), np.array(by_equation)


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


class Regression(NamedTuple):
    """Equations, records and parameters of a regression."""

    model: Model
    base: Mapping[str, float]
    """All parameters by name, SI."""
    names: tuple[str, ...]
    """Estimated parameters (q,)."""
    records: tuple[Record, ...]
    sizes: Mapping[str, float]
    """Standard deviation of the left-hand side by equation."""

    def residuals(self, values: Float[np.ndarray, " q"]) -> dict[str, Float[np.ndarray, " n"]]:
        """Return the residuals over the sd of the left-hand side, by equation; they are huge where
        the model is not finite."""
        parts = {name: [] for name in self.sizes}
        for record in self.records:
            own = {**self.base, **record.known, **dict(zip(self.names, values, strict=True))}
            weights = 1.0 / np.array([[self.sizes[n]] for n in record.equations])
            with np.errstate(all="ignore"):
                r, responses = _residual(record, _matrix(self.model, own))
                left = _projected(weights * r, weights[..., None] * responses)
            for name, r in zip(record.equations, left, strict=True):
                parts[name].append(r)
        return {name: np.concatenate(of) for name, of in parts.items()}


def _projected(
    residual: Float[np.ndarray, "e n"], responses: Float[np.ndarray, "e n h"]
) -> Float[np.ndarray, "e n"]:
    """Return the residuals without initial values and constants."""
    e, n = residual.shape
    constants = np.broadcast_to(np.eye(e)[:, None, :], (e, n, e))
    N = np.concatenate([responses, constants], axis=-1).reshape(e * n, -1)
    size = np.linalg.norm(N, axis=0)
    if not (np.isfinite(residual).all() and np.isfinite(size).all()):
        return np.full((e, n), _NOT_FINITE)
    N, x = N[:, size > 0] / size[size > 0], residual.ravel()
    # The columns of the constant and of a very slow free motion are nearly dependent.
    return (x - N @ np.linalg.lstsq(N, x, rcond=_DEPENDENT)[0]).reshape(e, n)


def _search(
    regression: Regression, free: Mapping[str, Free]
) -> tuple[Float[np.ndarray, " q"], np.ndarray]:
    """Return the best of searches from the known values, from zero, and from one; and (q,) True for
    the parameters with an effect on the residuals.

    Parameters with a sign to keep are searched in their logarithms.
    """
    from scipy.optimize import least_squares

    model, base = regression.model, regression.base
    keep = [_keeps_sign(model, n, free[n].sign, base[n]) for n in regression.names]
    at_hand = np.array([base[n] for n in regression.names])
    known = np.where(np.isfinite(at_hand) & (at_hand != 0), at_hand, 1.0)

    def values(z: np.ndarray) -> np.ndarray:
        return np.where(keep, known * np.exp(np.clip(z, -50.0, 50.0)), z)

    def residuals(z: np.ndarray) -> np.ndarray:
        return np.concatenate([*regression.residuals(values(z)).values()])

    # Products of parameters may cause two optima, and a parameter may be a divisor.
    starts = (known, np.zeros(known.size), np.ones(known.size))
    optima = [
        least_squares(
            residuals,
            np.where(keep, 0.0, start),
            method="lm",
            x_scale="jac",
            ftol=_SMALL,
            xtol=_SMALL,
        )
        for start in starts
    ]
    best = min(optima, key=lambda o: o.cost)
    if best.cost >= _NOT_FINITE:
        raise ValueError(
            "start: equation-error: the equations are not finite at zero, one and the vehicle's "
            f"values of {', '.join(regression.names)}: expected a start of each free parameter"
        )
    return values(best.x), best.jac.any(axis=0)


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
        taken = found("start.equation-error", "note", names=names or ["nothing"], **explained)
        return [taken, *reasons_of(self.values)]


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
    regression, width, reasons = _regression(model, vehicle, flights, free)
    # Of exchangeable parameters all but one stay near the values at which the search begins.
    estimate, effects = _search(regression, free)
    estimates = {}
    for name, value, effect in zip(regression.names, estimate.tolist(), effects, strict=True):
        if effect:
            estimates[name] = value
        else:
            reasons[name] = "it affects no measured state or output"
            _require_value(regression.base, name, reasons[name])
    if not estimates:
        raise _no_regression("the equations determine none of the free parameters")
    residuals = regression.residuals(estimate)
    states = naming.names(model.State)
    return EquationErrorStart(
        {n: _value(regression, n, free[n], estimates.get(n), reasons.get(n, "")) for n in free},
        tuple(Equation(name, 1.0 - float(np.mean(r**2))) for name, r in residuals.items()),
        _REACH * width * flights[0].dt,
        tuple(dict.fromkeys(states[i] for one in regression.records for i in one.hidden)),
    )


def _regression(
    model: Model, vehicle: Any, flights: Sequence[Flight], free: Mapping[str, Free]
) -> tuple[Regression, float, dict[str, str]]:
    """Return the regression, the Gaussian's standard deviation [samples], and the reason for each
    undetermined parameter."""
    if not model.linear:
        raise ValueError(
            f"start: equation-error is for linear models, and {model.name} is none: expected a "
            "start of each free parameter"
        )
    stated = {n: f.start for n, f in free.items() if math.isfinite(f.start)}
    base = {n: float(np.asarray(v)) for n, v in naming.asdict(vehicle).items()} | stated
    # At random values no terms cancel.
    generic = dict(zip(free, np.random.default_rng(11).uniform(0.5, 1.5, len(free)), strict=True))
    delays, width, records = dict(model.delays), _width(flights), []
    reasons = {n: "a regression cannot estimate a delay" for n in free if n in delays.values()}
    for flight in flights:
        some = {**base, **generic, **flight.known}
        require_constants(model, model.Params(**some))
        value = _matrix(model, some)
        depends = {n: _matrix(model, {**some, n: 2.0 * generic[n]}) != value for n in free}
        late = {u: {**base, **flight.known}[p] for u, p in delays.items()}
        changes = np.any([*depends.values()], axis=0)
        one = _record(model, flight, value, changes, width, late)
        records.append(one)
        for n, entries in depends.items():
            if entries[one.hidden, one.hidden].any():
                reasons[n] = "it is a time constant of states that are not measured"
    names = tuple(n for n in free if n not in reasons)
    if not any(one.rows for one in records):
        measured = ", ".join({n: None for f in flights for n in f.outputs})
        raise _no_regression(f"no equation of a state that {measured} measure has a free parameter")
    if not names:
        raise _no_regression("only delays, or time constants of hidden states, are free")
    for n, why in reasons.items():
        _require_value(base, n, why)
    records = tuple(one for one in records if one.segments and one.rows)
    if not records:
        raise _no_regression(
            "no part without missing samples is long enough for the smoothing "
            f"({math.ceil((_SHORTEST + 2.0 * _REACH) * width)} samples)"
        )
    left: dict[str, list[np.ndarray]] = {}
    for one in records:
        for k, name in enumerate(one.equations):
            left.setdefault(name, []).extend(s.left[k] - s.left[k].mean() for s in one.segments)
    sizes = {n: max(float(np.std(np.concatenate(v))), 1e-300) for n, v in left.items()}
    return Regression(model, base, names, records, sizes), width, reasons


def _no_regression(why: str) -> ValueError:
    return ValueError(
        f"start: equation-error: no regression is possible, because {why}: expected a start of "
        "each free parameter"
    )


def _require_value(base: Mapping[str, float], name: str, why: str) -> None:
    if not math.isfinite(base[name]):
        raise ValueError(f"free.{name}.start: missing, expected a value to begin with: {why}")


def _keeps_sign(model: Model, name: str, sign: Sign | None, at_hand: float) -> bool:
    """True if a parameter has a known sign to keep."""
    positive = name in model.positive
    known = positive or (math.isfinite(at_hand) and at_hand != 0)
    by_default = positive or of_helicopter(model.Params)
    return known and (sign == "keep" or (sign is None and by_default))


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
    low = -math.inf if free.lower is None else free.lower
    high = math.inf if free.upper is None else free.upper
    if low < estimate < high:
        return StartValue(estimate, unit, "equation error", "")
    # A value outside its bounds is moved inside, by 1 % of their span.
    bound, inwards = (low, 1.0) if estimate <= low else (high, -1.0)
    span = high - low if math.isfinite(high - low) else max(abs(bound), 1.0)
    moved = f"{estimate:.4g} lies outside its bounds"
    return StartValue(bound + 0.01 * inwards * span, unit, "equation error", moved)
