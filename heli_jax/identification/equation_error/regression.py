"""Equation error: the equations' left-hand sides against their right-hand sides, by least squares.

States that nothing measured shows are integrated by their own equations, from what is measured.
Their initial values, and a constant in each equation and flight (trim, bias), are projected out.
Where parameters multiply each other, or enter otherwise than linearly, Levenberg-Marquardt finds
the least squares; else its first step is the regression.
"""

import functools
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import scipy.linalg
from jaxtyping import Float

from heli_jax.dynamics.model import Model
from heli_jax.identification.equation_error.records import Record, Segment, Structure, coefficients

_APART = 1_000_000
"""instants between segments and flights: longer than any lag over which residuals are correlated"""
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
        """Return residuals and their derivatives; None where they are not finite, as at a parameter
        of zero that something is divided by.

        Args:
            values: of the parameters `names` (q,), SI.
        """
        with np.errstate(all="ignore"):
            try:
                rows = self._rows(values, weights)
            except (ValueError, np.linalg.LinAlgError):  # an infinite matrix or signal
                return None
        return rows if np.isfinite(rows.cost) and np.isfinite(rows.J).all() else None

    def _rows(self, values: np.ndarray, weights: Mapping[str, float]) -> Rows:
        parts, begin, order = [], 0, self.equations
        for one in self.records:
            both = coefficients(self.model, {**self.base, **one.known}, self.names, values)
            names = one.structure.equations
            x = _of_flight(one, both, np.array([weights[n] for n in names])[:, None, None])
            instants = []
            for segment in one.segments:
                instants.append(begin + np.arange(segment.left.shape[1]))
                begin += _APART
            times = np.tile(np.concatenate(instants), len(names))
            equation = np.repeat([order.index(n) for n in names], x.shape[0] // len(names))
            parts.append(Rows(x[:, 0], x[:, 1:], times, equation))
        return Rows(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def _of_flight(
    one: Record, both: Float[np.ndarray, "r c 1+q"], weight: Float[np.ndarray, "e 1 1"]
) -> Float[np.ndarray, "en 1+q"]:
    """The weighted residuals of a flight, and their derivatives, equation by equation."""
    pairs = [_residual(segment, one.structure, both) for segment in one.segments]
    residual = np.concatenate([r for r, _ in pairs], axis=1)
    e, n, c = residual.shape
    # Initial values of each segment and constants enter linearly, so that their best values are
    # known at any parameters. J leaves out that the responses to initial values move with the
    # parameters; a step is taken only where the sum of squares falls.
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
    """x(k+1) = phi x(k) + first f(k) + second f(k+1) for x' = A x + f, f straight between."""
    h = A.shape[0]
    # One exponential of a block matrix gives the transition and both integrals (Van Loan, 1978),
    # without the inverse of A, which an integrator has none of.
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
) -> tuple[np.ndarray, Rows] | None:
    """Levenberg-Marquardt on the equation error; None where that is not finite at the start.

    Args:
        start: values to begin with (q,), SI.
        keep_sign: True where a parameter keeps its start's sign (q,): searched in its logarithm.
    """
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
    return values(end), at(tuple(end)) or first


# Standard errors of a regression whose residuals are autocorrelated.
#
# Smoothed residuals are alike over many samples, and so are gusts: ordinary formulas would take
# each sample for news. The products of regressor and residual are summed over neighbouring instants
# with Bartlett's weights (W. K. Newey and K. D. West, Econometrica 55, 1987); V. Klein and E. A.
# Morelli, Aircraft System Identification (2006), 5.2.3, correct for the same.

_LAGS = 2.0
"""times the root of the number of instants: how far neighbours are allowed for"""


def covariance(rows: Rows) -> Float[np.ndarray, "q q"]:
    """Return the covariance of the estimates (q, q), by the residuals where the search ended."""
    # The sandwich: curvature on both sides, between them the variance of the gradient as the
    # residuals have it. Where these are white it becomes the ordinary formula.
    bread = np.linalg.pinv(rows.J.T @ rows.J, hermitian=True)
    return bread @ _long_run(rows.J * rows.r[:, None], rows.times) @ bread


def _long_run(scores: Float[np.ndarray, "n k"], times: np.ndarray) -> Float[np.ndarray, "k k"]:
    """The variance of the scores' sum: their products over all lags, weighted by Bartlett."""
    instants, number = np.unique(times, return_inverse=True)
    lags = int(_LAGS * instants.size**0.5)
    # Sums over the rows of each instant, with gaps of zeros that no lag reaches across.
    place = np.r_[0, np.cumsum(np.minimum(np.diff(instants), lags + 1))]
    sums = np.zeros((int(place[-1]) + 1, scores.shape[1]))
    np.add.at(sums, place[number], scores)
    total = sums.T @ sums
    for lag in range(1, min(lags, len(sums) - 1) + 1):
        product = sums[lag:].T @ sums[:-lag]
        # Falling weights keep the sum positive semi-definite; cut off at a lag, it could give a
        # negative variance (Newey and West).
        total += (1.0 - lag / (lags + 1.0)) * (product + product.T)
    return total


# Stepwise selection of terms by partial F-ratios, as SIDPAC's `swr` does: V. Klein and E. A.
# Morelli (2006), 5.4; N. R. Draper and H. Smith, Applied Regression Analysis.


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
    """Remove terms and enter them again, until no F-ratio is beyond its limit.

    All terms are in at first, where `swr` begins with none: with half of a response missing, what
    is left over is so autocorrelated that no term by itself would pass.
    Products of parameters are taken as they are linear about the point where all terms are in.

    Args:
        values: of the parameters there (q,).
        forced: those that stay in: of a known sign, they cannot be zero.
        limits: F to enter and F to remove; the second is at most the first.
    """
    # About the point where all terms are in r = y - X v, so X = -J: the nonlinear problem as the
    # linear regression that F-ratios are defined for.
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
    # At most each term out and in a few times: rounding must not turn in a circle.
    for _ in range(4 * len(names)):
        ratios = dict(zip(inside, regressed(inside)[0], strict=True))
        leaving = {j: float(f) for j, f in ratios.items() if names[j] not in forced}
        outside = [j for j in range(len(names)) if j not in inside]
        entering = {j: float(regressed([*inside, j])[0][-1]) for j in outside}
        # Out before in: the limit to remove is at most that to enter, so a term that has just come
        # in is not thrown out by the same number.
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
