"""What the past of a record does not foretell of it: the residuals of ARX models.

The order is the one that BIC takes; where samples are missing, no row is used in which one stands.
"""

import numpy as np
import scipy.linalg
from jaxtyping import Float

_ORDERS = (2, 4, 8, 16)
"""of the ARX models, of which BIC takes one"""
_PER_UNKNOWN = 8
"""samples for each coefficient of a model, at least"""
_FEW = 32
"""columns of past samples that are kept as a matrix"""
_RIDGE = 1e-12
"""added to the mean squares of past samples, which are of the size of one"""


def arx_residuals(
    y: Float[np.ndarray, "N p"], past: "Float[np.ndarray, 'N z'] | Past"
) -> Float[np.ndarray, "N p"] | None:
    """What past samples do not foretell of y (N, p), NaN where one of them is missing; None where
    the record is too short."""
    past = past if isinstance(past, Past) else Past(past)
    rows, order = past.rows_of(y)
    if not order:
        return None
    seen = y[_ORDERS[-1] :][rows]
    at = np.zeros((len(rows), y.shape[1]))
    at[rows] = seen - np.mean(seen, axis=0)
    m, p = seen.shape
    # One factor serves all orders: the columns of a lower order come first. Of the products, not of
    # the samples, which takes twenty times as long; the ridge is what rounding leaves of products.
    products = past.products(rows, order)
    factor = np.linalg.cholesky(products + _RIDGE * m * np.eye(len(products)))
    along = scipy.linalg.solve_triangular(factor, past.along(at, order), lower=True)
    unexplained = np.sum(at**2, axis=0) - np.cumsum(along**2, axis=0)
    sizes = [n * past.z.shape[1] + 1 for n in _ORDERS if n <= order]
    # What rounding leaves of a signal that its past foretells exactly may be below zero.
    criteria = [
        m * np.sum(np.log(np.maximum(unexplained[k - 1], 0.0) / m + 1e-300)) + p * k * np.log(m)
        for k in sizes
    ]
    k = sizes[int(np.argmin(criteria))]
    left = np.full(y.shape, np.nan)
    coefficients = scipy.linalg.solve_triangular(factor[:k, :k], along[:k], lower=True, trans=1)
    left[_ORDERS[-1] :][rows] = (at - past.foretold(coefficients))[rows]
    return left


class Past:
    """A constant and past samples, by lag, as what is foretold is foretold by them: their products
    without the matrix of them all, which has a column for each signal and lag."""

    def __init__(self, signals: Float[np.ndarray, "N z"]) -> None:
        """Of signals of any unit, NaN where one is missing."""
        self.complete = bool(np.isfinite(signals).all())
        std, mean = (np.std, np.mean) if self.complete else (np.nanstd, np.nanmean)
        scale = std(signals, axis=0)
        z = (signals - mean(signals, axis=0)) / np.where(scale > 0, scale, 1.0)
        self.missing = None if self.complete else ~np.isfinite(z).all(axis=1)
        # Where one is missing, no row in which it stands is used.
        self.z = z if self.missing is None else np.where(self.missing[:, None], 0.0, z)
        self._whole: np.ndarray | None = None
        # Of few signals the columns fit into the cache, and one product is quicker than many.
        few = self.z.shape[1] * _ORDERS[-1] <= _FEW
        self._matrix = (
            self._columns(np.arange(len(self.z) - _ORDERS[-1]), _ORDERS[-1]) if few else None
        )

    def rows_of(self, y: Float[np.ndarray, "N p"]) -> tuple[np.ndarray, int]:
        """The rows (N - longest,) at which y and its past were measured, and the highest order that
        so many carry; 0 where they carry none."""
        seen = np.isfinite(y[_ORDERS[-1] :]).all(axis=1)
        for order in reversed(_ORDERS):
            rows = seen
            if self.missing is not None:
                rows = seen & ~np.any(
                    [self._lag(self.missing, k + 1) for k in range(order)], axis=0
                )
            if rows.sum() >= _PER_UNKNOWN * (order * self.z.shape[1] + 1):
                return rows, order
        return np.zeros(0, bool), 0

    def products(self, rows: np.ndarray, order: int) -> Float[np.ndarray, "k k"]:
        """Of all columns with each other, over the rows."""
        if self._whole is None:
            self._whole = self._of_all_rows()
        k = order * self.z.shape[1] + 1
        whole = self._whole[:k, :k]
        at = np.flatnonzero(~rows)
        if 2 * at.size <= len(rows):
            x = self._columns(at, order)
            return whole - x.T @ x
        x = self._columns(np.flatnonzero(rows), order)
        return x.T @ x

    def along(self, v: Float[np.ndarray, "m p"], order: int) -> Float[np.ndarray, "k p"]:
        """Of all columns with v, which is zero where a row is not used."""
        if self._matrix is not None:
            return self._matrix[:, : order * self.z.shape[1] + 1].T @ v
        lags = (self._lag(self.z, k + 1).T @ v for k in range(order))
        return np.concatenate([v.sum(axis=0)[None], *lags])

    def foretold(self, coefficients: Float[np.ndarray, "k p"]) -> Float[np.ndarray, "m p"]:
        """The sum of so many columns."""
        if self._matrix is not None:
            return self._matrix[:, : len(coefficients)] @ coefficients
        z, made = self.z.shape[1], np.tile(coefficients[0], (len(self.z) - _ORDERS[-1], 1))
        for k in range((len(coefficients) - 1) // z):
            made += self._lag(self.z, k + 1) @ coefficients[1 + k * z : 1 + (k + 1) * z]
        return made

    def _lag(self, v: np.ndarray, lag: int) -> np.ndarray:
        return v[_ORDERS[-1] - lag : len(v) - lag]

    def _columns(self, at: np.ndarray, order: int) -> Float[np.ndarray, "r k"]:
        """Some rows of the matrix."""
        lags = [self.z[at + _ORDERS[-1] - k - 1] for k in range(order)]
        return np.concatenate([np.ones((at.size, 1)), *lags], axis=1)

    def _of_all_rows(self) -> Float[np.ndarray, "k k"]:
        if self._matrix is not None:
            return self._matrix.T @ self._matrix
        # One lag more of both moves the sum by a row at either end: with the products of the first
        # lag with all others all are known.
        x, first, (N, z) = self.z, _ORDERS[-1], self.z.shape
        made = np.zeros((first, z, first, z))
        for k in range(first):
            made[0, :, k] = self._lag(x, 1).T @ self._lag(x, k + 1)
        enter, leave = x[first - 2 :: -1], x[N - 2 : N - first - 1 : -1]
        for k in range(first - 1):
            made[k + 1, :, 0] = made[0, :, k + 1].T
            ends = [v[k][:, None, None] * v[None, : first - 1] for v in (enter, leave)]
            made[k + 1, :, 1:] = made[k, :, :-1] + ends[0] - ends[1]
        sums = np.stack([self._lag(x, k + 1).sum(axis=0) for k in range(first)]).reshape(-1)
        products = made.reshape(first * z, first * z)
        whole = np.concatenate([sums[:, None], products], axis=1)
        return np.concatenate([np.append(float(N - first), sums)[None], whole])
