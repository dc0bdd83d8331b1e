"""Equation error: the equations' left-hand sides against what they say of them, by least squares.

States that nothing measured shows are integrated by their own equations, from what is measured.
Their initial values, and a constant in each equation and flight (trim, bias), are projected out.
Where parameters multiply each other or enter otherwise than linearly the squares are made small by
Levenberg-Marquardt steps, else one step is the regression.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg
from jaxtyping import Float

from heli_jax.dynamics.model import Model
from heli_jax.identification.equation_error.records import (
    Matrices,
    Record,
    Segment,
    Structure,
    matrices,
)

# Instants are counted in whole numbers over all segments and flights. A gap of this many is longer
# than any lag over which `errors` sums, so nothing is correlated across it.
_APART = 1_000_000
_STEPS = 30
_SMALL = 1e-6
"""relative fall of the sum of squares, and relative step, at which the search ends"""
_LARGEST = 1e9
"""times the left-hand sides' size at which a hidden state has diverged"""


class Rows(NamedTuple):
    """Residuals of all flights and equations at one point, weighed."""

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

    def rows(self, values: Float[np.ndarray, " q"], weights: Mapping[str, float]) -> Rows:
        """Residuals and their derivatives.

        Args:
            values: of the parameters `names` (q,), SI.
            weights: one over the residuals' size, by equation.
        """
        parts, start = [], 0
        for one in self.records:
            at = matrices(self.model, {**self.base, **one.known}, self.names, values)
            part = _of_flight(one, at, weights, self)
            parts.append(part._replace(times=part.times + start))
            # A gap between flights, so that no correlation reaches over it.
            start += int(part.times.max(initial=0)) + _APART
        return Rows(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def _of_flight(
    one: Record, at: Matrices, weights: Mapping[str, float], regression: Regression
) -> Rows:
    structure, q = one.structure, len(regression.names)
    e = len(structure.rows)
    residuals, nuisances, times = [], [], []
    for k, segment in enumerate(one.segments):
        full, initial = _residual(segment, structure, at)
        residuals.append(full)
        nuisances.append(initial)
        times.append(np.arange(full.shape[1]) + k * _APART)
    lengths = [part.shape[1] for part in residuals]
    n = sum(lengths)
    # Residuals and derivatives become columns of one matrix: weighed and projected together, so
    # that J stays the derivative of r.
    scale = np.array([weights[name] for name in structure.equations])[:, None, None]
    together = (scale * np.concatenate(residuals, axis=1)).reshape(e * n, 1 + q)
    beside = scale * _beside(nuisances, lengths, e)
    # Initial values and constants enter linearly, so at any parameters their best values are known:
    # they are taken out by projection and need no start. That the responses to initial values move
    # with the parameters is left out of J. A step is then not quite that of Gauss and Newton, which
    # the search allows for: it takes a step only where the sum of squares falls.
    together = _projected(together, beside.reshape(e * n, -1))
    number = [regression.equations.index(name) for name in structure.equations]
    return Rows(
        together[:, 0],
        together[:, 1:],
        np.tile(np.concatenate(times), e),
        np.repeat(number, n),
    )


def _beside(
    initial: Sequence[Float[np.ndarray, "e n h"]], lengths: Sequence[int], e: int
) -> Float[np.ndarray, "e n b"]:
    """What is estimated beside the parameters: the hidden states' initial values of each segment,
    and a constant in each equation."""
    n, hidden = sum(lengths), initial[0].shape[-1]
    columns = np.zeros((e, n, len(lengths) * hidden + e))
    begin = np.r_[0, np.cumsum(lengths)]
    for k, part in enumerate(initial):
        columns[:, begin[k] : begin[k + 1], k * hidden : (k + 1) * hidden] = part
    for i in range(e):
        columns[i, :, len(lengths) * hidden + i] = 1.0
    return columns


def _projected(
    x: Float[np.ndarray, "n c"], away: Float[np.ndarray, "n b"]
) -> Float[np.ndarray, "n c"]:
    """What of the columns of x the columns of `away` cannot give."""
    size = np.linalg.norm(away, axis=0)
    away = away[:, size > 0] / size[size > 0]
    # With pivoting, columns that others give already, as a very slow free motion beside the
    # constant, come last and are dropped instead of filling the basis with rounding.
    factors: Any = scipy.linalg.qr(away, mode="economic", pivoting=True)
    basis, triangle = factors[:2]
    basis = basis[:, np.abs(np.diag(triangle)) > 1e-9]
    return x - basis @ (basis.T @ x)


def _residual(
    segment: Segment, structure: Structure, at: Matrices
) -> tuple[Float[np.ndarray, "e n c"], Float[np.ndarray, "e n h"]]:
    """Residuals with their derivatives (e, n, 1 + q), and responses to hidden initial values."""
    n = structure.n
    rows, hidden, shown = list(structure.rows), list(structure.hidden), list(structure.shown)
    known = np.concatenate([segment.states, segment.inputs])  # (k + m, N)
    columns = [*shown, *range(n, at.value.shape[1])]
    # [value, slope] side by side: what is done to the one is done to the other.
    both = np.concatenate([at.value[..., None], at.slope], axis=-1)
    # Value and derivatives in one product: the regressors are the same for both.
    predicted = np.einsum("ekc,kN->eNc", both[np.ix_(rows, columns)], known)
    initial = np.zeros((len(rows), known.shape[1], 0))
    if hidden:
        h, free = _hidden(both, known, (hidden, columns), segment.step)
        coefficients = both[np.ix_(rows, hidden)]
        predicted += np.einsum("eh,Nhc->eNc", coefficients[..., 0], h)
        predicted[..., 1:] += np.einsum("ehq,Nh->eNq", coefficients[..., 1:], h[..., 0])
        initial = np.einsum("eh,Nhj->eNj", coefficients[..., 0], free)
    residual = -predicted
    residual[..., 0] += segment.left
    return residual, initial


def _hidden(
    both: np.ndarray, known: np.ndarray, which: tuple[list[int], list[int]], step: float
) -> tuple[Float[np.ndarray, "N h c"], Float[np.ndarray, "N h h"]]:
    """The hidden states with their derivatives (N, h, 1 + q), begun at zero, and their free
    motions from one of them at one (N, h, h)."""
    hidden, columns = which
    dynamics = both[np.ix_(hidden, hidden)]
    phi, first, second = _first_order_hold(dynamics[..., 0], step)
    forcing = np.einsum("hkc,kN->Nhc", both[np.ix_(hidden, columns)], known)

    def integrated(forcing: np.ndarray) -> np.ndarray:
        pushed = np.zeros_like(forcing)
        pushed[1:] = first @ forcing[:-1] + second @ forcing[1:]
        return recurrence(phi, pushed)

    # The states before their derivatives, which are driven by them.
    h = integrated(forcing[..., :1])
    # d/dt of a derivative by a parameter: the same dynamics, driven also by what these change.
    forcing[..., 1:] += np.einsum("hjq,Nj->Nhq", dynamics[..., 1:], h[..., 0])
    free = np.zeros((known.shape[1], len(hidden), len(hidden)))
    free[0] = np.eye(len(hidden))
    return (
        np.concatenate([h, integrated(forcing[..., 1:])], axis=-1),
        recurrence(phi, free),
    )


def _first_order_hold(A: Float[np.ndarray, "h h"], step: float) -> tuple[np.ndarray, ...]:
    """x(k+1) = phi x(k) + first f(k) + second f(k+1) for x' = A x + f, f straight between."""
    h = A.shape[0]
    # One exponential of a block matrix gives the transition and both integrals (Van Loan, 1978),
    # without the inverse of A that closed forms have and an integrator lacks.
    block = np.zeros((3 * h, 3 * h))
    block[:h, :h], block[:h, h : 2 * h] = A * step, np.eye(h) * step
    block[h : 2 * h, 2 * h :] = np.eye(h)
    whole = scipy.linalg.expm(block)
    second = whole[:h, 2 * h :]
    return whole[:h, :h], whole[:h, h : 2 * h] - second, second


def recurrence(
    phi: Float[np.ndarray, "h h"], f: Float[np.ndarray, "N h c"]
) -> Float[np.ndarray, "N h c"]:
    """x(0) = f(0), x(k) = phi x(k-1) + f(k).

    In blocks side by side, since a loop over all samples in Python would take seconds.

    Args:
        phi: transition matrix.
        f: what is added at each sample, for many columns.
    """
    N, h, c = f.shape
    # As many blocks as each is long: about twice the root of N steps in Python in place of N.
    b = max(1, int(np.sqrt(N)))
    blocks = -(-N // b)
    x = np.zeros((blocks * b, h, c))
    x[:N] = f
    x = x.reshape(blocks, b, h, c)
    powers = [phi]
    for k in range(1, b):
        x[:, k] += phi @ x[:, k - 1]
        powers.append(phi @ powers[-1])
    for i in range(1, blocks):
        # The end of the block before is whole by now: its motion goes on through this one.
        x[i] += np.stack(powers) @ x[i - 1, -1]
    return x.reshape(blocks * b, h, c)[:N]


class Optimum(NamedTuple):
    """Where a search ended."""

    values: Float[np.ndarray, " q"]
    rows: Rows
    weights: dict[str, float]


def search(
    regression: Regression,
    start: Float[np.ndarray, " q"],
    keep_sign: np.ndarray,
    weights: Mapping[str, float],
) -> tuple[np.ndarray, Rows] | None:
    """Levenberg-Marquardt on the equation error; None where that is not finite at the start.

    Args:
        regression: what is regressed.
        start: values to begin with (q,), SI.
        keep_sign: whether a parameter keeps its start's sign (q,): searched in its logarithm.
        weights: by equation.
    """
    x, damping = start.copy(), 1e-6
    at = finite(lambda: regression.rows(x, weights))
    if at is None:
        return None
    for _ in range(_STEPS):
        # A logarithm's step is relative: its column is the parameter's times its value.
        size = np.where(keep_sign, x, 1.0)
        step = _damped(at.r, at.J * size, damping)
        with np.errstate(over="ignore"):
            # At most a factor of e^2 a step: far from the optimum the linear step of a logarithm
            # can be hundreds.
            new = np.where(keep_sign, x * np.exp(np.clip(step, -2.0, 2.0)), x + step)
        tried = finite(lambda new=new: regression.rows(new, weights))
        # Put so that a cost that is no number counts as no gain.
        if tried is None or not tried.cost < at.cost:
            damping = 10.0 * damping
            if damping > 1e8:
                break
            continue
        gain = at.cost - tried.cost
        x, at, damping = new, tried, max(0.1 * damping, 1e-12)
        if gain < _SMALL * at.cost:
            break
    return x, at


def finite(make: Callable[[], Rows]) -> Rows | None:
    """The rows; None where they are not finite, as at a parameter of zero that something is
    divided by.

    Args:
        make: gives them.
    """
    with np.errstate(all="ignore"):
        try:
            rows = make()
        except (ValueError, np.linalg.LinAlgError):  # an infinite matrix or signal
            return None
    return rows if np.isfinite(rows.cost) and np.isfinite(rows.J).all() else None


def _damped(r: np.ndarray, J: np.ndarray, damping: float) -> np.ndarray:
    norms = np.linalg.norm(J, axis=0)
    used = norms > 0
    # Columns of one length make the damping relative to each parameter's own curvature, which is
    # Marquardt's, whatever the units are.
    scaled = J[:, used] / norms[used]
    step = np.zeros(J.shape[1])
    normal = scaled.T @ scaled + damping * np.eye(int(used.sum()))
    step[used] = -np.linalg.lstsq(normal, scaled.T @ r, rcond=1e-13)[0] / norms[used]
    return step


# Standard errors and partial F-ratios of a regression whose residuals are autocorrelated.
#
# Smoothed residuals go together over many samples, and so do gusts: ordinary formulas would take
# each sample for news. What is summed here over neighbouring instants is the product of regressor
# and residual, with Bartlett's weights (W. K. Newey and K. D. West, Econometrica 55, 1987); V.
# Klein and E. A. Morelli, Aircraft System Identification (2006), 5.2.3, correct for the same.


_LAGS = 2.0
"""times the root of the number of instants: how far neighbours are allowed for"""


def covariance(rows: Rows) -> Float[np.ndarray, "q q"]:
    """Of the estimates (q, q), by the residuals where the search ended."""
    # The sandwich: curvature on both sides, between them the variance of the gradient as the
    # residuals have it. Where these are white it becomes the ordinary formula.
    bread = np.linalg.pinv(rows.J.T @ rows.J, hermitian=True)
    scores = by_instant(rows.J * rows.r[:, None], rows.times)
    return bread @ _long_run(scores) @ bread


def partial_f(
    basis: Float[np.ndarray, "n k"],
    y: Float[np.ndarray, " n"],
    x: Float[np.ndarray, " n"],
    times: np.ndarray,
) -> float:
    """F-ratio of one more regressor: the square of its estimate over its standard error.

    Args:
        basis: of the regressors that are in (n, k), orthonormal (`basis_of`).
        y: what is regressed (n,).
        x: the one more (n,).
        times: which rows belong to one instant, as `Rows.times`.
    """
    size = np.linalg.norm(x)
    # The estimate of one more regressor beside others is that of what they leave of both signals
    # (Frisch and Waugh, 1933): so each candidate costs one product, not a regression.
    x, y = x - basis @ (basis.T @ x), y - basis @ (basis.T @ y)
    power = float(x @ x)
    # What the others give already has nothing of its own to say.
    if power <= (1e-6 * size) ** 2:
        return 0.0
    left = y - x * (x @ y) / power
    variance = float(_long_run(by_instant((x * left)[:, None], times))[0, 0])
    return float((x @ y) ** 2 / variance) if variance > 0 else float("inf")


def basis_of(X: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "n k"]:
    """An orthonormal basis of the columns of X."""
    return np.linalg.qr(X)[0] if X.shape[1] else X


def by_instant(scores: Float[np.ndarray, "n k"], times: np.ndarray) -> Float[np.ndarray, "T k"]:
    """Sums over the rows of each instant (T, k), with zeros between segments."""
    distinct, number = np.unique(times, return_inverse=True)
    lags = _lags(distinct.size)
    # A gap is as long as no lag reaches: neighbours across it count for nothing.
    place = np.r_[0, np.cumsum(np.minimum(np.diff(distinct), lags + 1))]
    sums = np.zeros((int(place[-1]) + 1, scores.shape[1]))
    np.add.at(sums, place[number], scores)
    return sums


def _long_run(scores: Float[np.ndarray, "T k"]) -> Float[np.ndarray, "k k"]:
    """The variance of the scores' sum: their products over all lags, weighed by Bartlett."""
    lags = _lags(scores.shape[0])
    total = scores.T @ scores
    for lag in range(1, min(lags, scores.shape[0] - 1) + 1):
        product = scores[lag:].T @ scores[:-lag]
        # Falling weights keep the sum positive semi-definite; cut off at a lag, it could give a
        # negative variance (Newey and West).
        total += (1.0 - lag / (lags + 1.0)) * (product + product.T)
    return total


def _lags(instants: int) -> int:
    return int(_LAGS * instants**0.5)


# Stepwise selection of terms by partial F-ratios, as SIDPAC's `swr` does.
#
# Source: V. Klein and E. A. Morelli, Aircraft System Identification (2006), 5.4; N. R. Draper and
# H. Smith, Applied Regression Analysis. Here the F-ratio allows for autocorrelated residuals
# (`errors.partial_f`).


class Step(NamedTuple):
    """One step of the selection. The names of the fields are keys of fit.json."""

    parameter: str
    entered: bool
    """or it was removed"""
    f_ratio: float
    r_squared: float
    """of all equations together, each over its residual, after the step"""


class Selection(NamedTuple):
    """The terms that are in at the end, and how it came to that."""

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
    """Terms out and in again, until none is left that asks for the other side.

    All terms are in at first, where `swr` begins with none: with half of a response missing, what
    is left over is so autocorrelated that no term by itself would pass.
    Products of parameters are taken as they are linear about the point where all terms are in.

    Args:
        rows: there, weighed.
        values: of the parameters there (q,).
        names: theirs.
        forced: those that stay in: of a known sign, they cannot be zero.
        limits: F to enter and F to remove; the second is at most the first.
    """
    terms = _Terms(rows, values, tuple(names), frozenset(forced))
    inside, steps = list(range(len(names))), []
    # At most each term out and in a few times: rounding must not turn in a circle.
    for _ in range(4 * len(names)):
        # Out before in: the limit to remove is at most that to enter, so a term that has just come
        # in is not thrown out by the same number.
        leaving = terms.to_remove(inside)
        worst = min(leaving, key=lambda j: leaving[j], default=None)
        if worst is not None and leaving[worst] < limits[1]:
            inside.remove(worst)
            steps.append(Step(names[worst], False, leaving[worst], terms.explained(inside)))
            continue
        entering = terms.to_enter(inside)
        best = max(entering, key=lambda j: entering[j], default=None)
        if best is None or entering[best] < limits[0]:
            break
        inside.append(best)
        steps.append(Step(names[best], True, entering[best], terms.explained(inside)))
    final = {**terms.to_enter(inside), **terms.to_remove(inside)}
    ratios = {names[j]: final[j] for j in sorted(final)}
    return Selection(tuple(n for j, n in enumerate(names) if j in inside), tuple(steps), ratios)


class _Terms:
    """The regressors, and what is regressed on them."""

    def __init__(
        self, rows: Rows, values: np.ndarray, names: tuple[str, ...], forced: frozenset[str]
    ) -> None:
        # About the point where all terms are in r = y - X v, so X = -J: the nonlinear problem as
        # the linear regression that F-ratios are defined for.
        self.X, self.y = -rows.J, rows.r - rows.J @ values
        self.times, self.names, self.forced = rows.times, names, forced

    def to_enter(self, inside: list[int]) -> dict[int, float]:
        """The F-ratios of what is out, by number."""
        basis = basis_of(self.X[:, inside])
        out = [j for j in range(len(self.names)) if j not in inside]
        return {j: partial_f(basis, self.y, self.X[:, j], self.times) for j in out}

    def to_remove(self, inside: list[int]) -> dict[int, float]:
        """The F-ratios of what is in and may go, by number."""
        ratios = {}
        # Each against all others that are in: what one term explains depends on which ones stand
        # beside it.
        for j in (j for j in inside if self.names[j] not in self.forced):
            basis = basis_of(self.X[:, [i for i in inside if i != j]])
            ratios[j] = partial_f(basis, self.y, self.X[:, j], self.times)
        return ratios

    def explained(self, inside: list[int]) -> float:
        """The part of the sum of squares that what is in explains."""
        basis = basis_of(self.X[:, inside])
        return float(np.sum((basis.T @ self.y) ** 2) / np.sum(self.y**2))
