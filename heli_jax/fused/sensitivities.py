"""A run that carries its derivatives, and sums products of its rows and columns."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

# `Any` below: trees of arrays, for which JAX exports no type.


class Sensitive(NamedTuple):
    """The function to differentiate."""

    run: Callable[[Any], Any]
    """run(unknowns (q,)) returns a run with one step a sample, as `simulation.accumulate.Steps`."""
    steps: int
    throughout: Sequence[int]
    """Indices of unknowns that act at every sample."""
    at_first: Sequence[int]
    """Indices of unknowns that act only on the first carry, which costs less."""
    value: Callable[[Any], Any]
    """value(carry) returns the values at the sample before the carry."""
    end: Callable[[Any, Any], Any]
    """end(unknowns, last carry) returns the values at the last sample."""
    rows: Callable[[Any, Sequence[Any]], Sequence[Sequence[Any]]]
    """rows(values, derivatives by unknown in the order above) returns for every row the numbers
    whose products are summed.
    """


class Products:
    """Carry and results with derivatives, in the form of `fused.traced.Making`.

    The result has the sums of v[i] v[j], i >= j, over all samples and rows, as a triangle row by
    row. v are the numbers of a row.
    """

    def __init__(self, of: Sensitive, unknowns: Any) -> None:
        """Take the unknowns (q,) of an element."""
        self._of, self._z = of, unknowns

    @property
    def carry(self) -> Any:
        """Return the carry, its derivatives, and the sums."""
        of = self._of
        first, push = jax.linearize(lambda z: of.run(z).carry, self._z)
        tangents = [push(self._unit(j)) for j in (*of.throughout, *of.at_first)]
        shapes = jax.eval_shape(
            lambda c, t: of.rows(of.value(c), [of.value(v) for v in t]), first, tangents
        )
        m = len(shapes[0])
        return first, tangents, jnp.zeros((m * (m + 1) // 2,), self._z.dtype)

    @property
    def steps(self) -> int:
        """Number of steps, one less than samples."""
        return self._of.steps

    def step(self, carry: Any, k: Any, /) -> Any:
        """Return the carry one sample after the k-th."""
        of, (now, tangents, sums) = self._of, carry
        after, moved = self._pushed(lambda z, c: of.run(z).step(c, k), now, tangents)
        return after, moved, self._with(sums, of.value(after), [of.value(v) for v in moved])

    def last(self, carry: Any, /) -> Any:
        """Return the sums with those of the last sample."""
        now, tangents, sums = carry
        return self._with(sums, *self._pushed(self._of.end, now, tangents))

    def _pushed(
        self, function: Callable[[Any, Any], Any], now: Any, tangents: list[Any]
    ) -> tuple[Any, list[Any]]:
        """Return a function of unknowns and carry, and its derivatives."""
        of = self._of
        result, of_both = jax.linearize(function, self._z, now)
        _, of_carry = jax.linearize(lambda c: function(self._z, c), now)
        n = len(of.throughout)
        moved = [
            of_both(self._unit(j), t) for j, t in zip(of.throughout, tangents[:n], strict=True)
        ]
        return result, [*moved, *(of_carry(t) for t in tangents[n:])]

    def _with(self, sums: Any, value: Any, derivatives: list[Any]) -> Any:
        added = [
            sum((v[i] * v[j] for v in rows[1:]), rows[0][i] * rows[0][j])
            for rows in [self._of.rows(value, derivatives)]
            for i in range(len(rows[0]))
            for j in range(i + 1)
        ]
        return sums + jnp.stack(added)

    def _unit(self, j: int) -> np.ndarray:
        unit = np.zeros(self._z.shape, self._z.dtype)
        unit[j] = 1.0
        return unit


def full(triangle: np.ndarray) -> np.ndarray:
    """Return symmetric matrices (k, m, m) from their triangles (m (m + 1) / 2, k), row by row."""
    count = triangle.shape[0]
    m = int((np.sqrt(8.0 * count + 1.0) - 1.0) / 2.0)
    rows, columns = np.tril_indices(m)
    matrices = np.empty((triangle.shape[1], m, m), triangle.dtype)
    matrices[:, rows, columns] = triangle.T
    matrices[:, columns, rows] = triangle.T
    return matrices
