"""Standard errors and partial F-ratios of a regression whose residuals are autocorrelated.

Smoothed residuals go together over many samples, and so do gusts: ordinary formulas would take
each sample for news. What is summed here over neighbouring instants is the product of regressor
and residual, with Bartlett's weights (W. K. Newey and K. D. West, Econometrica 55, 1987); V. Klein
and E. A. Morelli, Aircraft System Identification (2006), 5.2.3, correct for the same.
"""

import numpy as np
from jaxtyping import Float

from heli_jax.identification.equation_error.regression import Rows

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
