"""Stepwise selection of terms by partial F-ratios, as SIDPAC's `swr` does.

Source: V. Klein and E. A. Morelli, Aircraft System Identification (2006), 5.4; N. R. Draper and
H. Smith, Applied Regression Analysis. Here the F-ratio allows for autocorrelated residuals
(`errors.partial_f`).
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from heli_jax.identification.equation_error.errors import partial_f
from heli_jax.identification.equation_error.regression import Rows

F_ENTER = 20.0
"""five times the 5 % point of F (Klein and Morelli): terms below it hardly help to predict"""


class Step(NamedTuple):
    """One step of the selection."""

    parameter: str
    entered: bool
    """or it was removed"""
    f_ratio: float
    r_squared: float
    """of all equations together, after the step"""


class Selection(NamedTuple):
    """The terms that are in at the end, and how it came to that."""

    selected: tuple[str, ...]
    steps: tuple[Step, ...]
    f_ratios: dict[str, float]
    """at the end, of every term: to remove it where it is in, to enter it where it is not"""


def select(
    rows: Rows,
    values: np.ndarray,
    names: Sequence[str],
    forced: Sequence[str],
    limits: tuple[float, float],
) -> Selection:
    """Terms in and out, until none is left that asks for the other side.

    Products of parameters are taken as they are linear about the point where all terms are in.

    Args:
        rows: there, weighed.
        values: of the parameters there (q,).
        names: theirs.
        forced: those that stay in.
        limits: F to enter and F to remove; the second is at most the first.
    """
    X, y = -rows.J, rows.r - rows.J @ values
    inside = [names.index(n) for n in forced]
    steps: list[Step] = []

    def ratio(j: int, others: list[int]) -> float:
        return partial_f(X[:, others], y, X[:, j], rows.times)

    # At most each term in and out once and again: rounding must not turn in a circle.
    for _ in range(4 * len(names)):
        outside = [j for j in range(len(names)) if j not in inside]
        entering = {j: ratio(j, inside) for j in outside}
        best = max(entering, key=lambda j: entering[j], default=None)
        if best is None or entering[best] < limits[0]:
            break
        inside.append(best)
        steps.append(Step(names[best], True, entering[best], _explained(X[:, inside], y)))
        _remove(inside, [names.index(n) for n in forced], ratio, limits[1], (names, X, y, steps))
    final = {
        n: ratio(j, [i for i in inside if i != j]) for j, n in enumerate(names) if n not in forced
    }
    return Selection(tuple(n for j, n in enumerate(names) if j in inside), tuple(steps), final)


def _remove(inside: list[int], forced: list[int], ratio, limit: float, told: tuple) -> None:
    """Take out, one after the other, what later terms have made needless."""
    names, X, y, steps = told
    while True:
        ratios = {j: ratio(j, [i for i in inside if i != j]) for j in inside if j not in forced}
        worst = min(ratios, key=lambda j: ratios[j], default=None)
        if worst is None or ratios[worst] >= limit:
            return
        inside.remove(worst)
        steps.append(Step(names[worst], False, ratios[worst], _explained(X[:, inside], y)))


def _explained(X: np.ndarray, y: np.ndarray) -> float:
    if not X.shape[1]:
        return 0.0
    basis, _ = np.linalg.qr(X)
    return float(np.sum((basis.T @ y) ** 2) / np.sum(y**2))
