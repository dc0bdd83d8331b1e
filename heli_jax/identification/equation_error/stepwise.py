"""Stepwise selection of terms by partial F-ratios, as SIDPAC's `swr` does.

Source: V. Klein and E. A. Morelli, Aircraft System Identification (2006), 5.4; N. R. Draper and
H. Smith, Applied Regression Analysis. Here the F-ratio allows for autocorrelated residuals
(`errors.partial_f`).
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from heli_jax.identification.equation_error.errors import basis_of, partial_f
from heli_jax.identification.equation_error.regression import Rows


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
