"""Which states of a linear model the measured outputs show, and which equations to regress."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from heli_jax import naming
from heli_jax.dynamics.jacobians import jacobians
from heli_jax.dynamics.model import Model
from heli_jax.identification.equation_error.smoothing import ORDERS

# Params is a class of each model, hence Any.

_DETERMINED = 1e-8
"""part of a unit vector that may lie outside the span of what is measured"""


class Matrices(NamedTuple):
    """[A B; C D] with rows of states then outputs, columns of states then inputs."""

    value: Float[np.ndarray, "r c"]
    slope: Float[np.ndarray, "r c q"]
    """by the parameters"""


@eqx.filter_jit
def _stacked(model: Model, names: tuple[str, ...], base: dict[str, Any], values: Array) -> Any:
    def matrix(values: Array) -> Array:
        params = model.Params(**{**base, **dict(zip(names, values, strict=True))})
        A, B, C, D = jacobians(model, params)
        return jnp.block([[A, B], [C, D]])

    # Forward: a matrix has more entries than a model has parameters.
    return matrix(values), jax.jacfwd(matrix)(values)


def matrices(
    model: Model, base: Mapping[str, float], names: Sequence[str], values: np.ndarray
) -> Matrices:
    """The matrices of a linear model and their derivatives.

    Args:
        model: linear, with n states, m inputs and p outputs.
        base: all parameters by name, SI.
        names: those to differentiate by.
        values: theirs (q,), in place of those in `base`.
    """
    dtype = jnp.result_type(float)
    of_base = {n: jnp.asarray(v, dtype) for n, v in base.items()}
    value, slope = _stacked(model, tuple(names), of_base, jnp.asarray(values, dtype))
    return Matrices(np.asarray(value), np.asarray(slope))


class Structure(NamedTuple):
    """What a flight's measured outputs show of a model's states."""

    states: tuple[str, ...]
    signals: tuple[str, ...]
    """measured outputs, then inputs: the columns of `shown`"""
    shown: dict[int, Float[np.ndarray, "r z"]]
    """by state: the coefficients of each derivative of each signal that make it"""
    hidden: tuple[int, ...]
    """the states that nothing measured shows"""
    equations: tuple[str, ...]
    """the states and outputs of `rows`"""
    rows: tuple[int, ...]
    """of `Matrices` the equations to be regressed: of states, and of outputs that show none"""

    @property
    def n(self) -> int:
        """The number of states."""
        return len(self.states)


def structure(
    model: Model, value: Float[np.ndarray, "r c"], depends: np.ndarray, outputs: Sequence[str]
) -> Structure:
    """What is measured of the states, and which equations there are to regress.

    A state is measured where an output is that state, or where outputs are a linear image of it
    with known coefficients; or where it is the derivative of one, as a rate is of an angle.

    Args:
        model: linear.
        value: `Matrices.value` (r, c); where a free parameter is in an entry, any number.
        depends: whether a free parameter is in an entry (r, c).
        outputs: measured, by name.
    """
    states, inputs = naming.names(model.State), naming.names(model.Inputs)
    n, names = len(states), naming.names(model.Outputs)
    rows = [n + names.index(y) for y in outputs]
    signals = (*outputs, *inputs)
    # y - D u = C x, with coefficients that are known.
    # An output with a free parameter in its row shows no state: what it shows depends on what is to
    # be found. It becomes an equation to be regressed instead.
    known = [i for i, row in enumerate(rows) if not depends[row].any()]
    right = np.zeros((len(known), ORDERS, len(signals)))
    for k, i in enumerate(known):
        right[k, 0, i] = 1.0
        right[k, 0, len(outputs) :] = -value[rows[i], n:]
    left = value[[rows[i] for i in known], :n]
    shown = _solved(left, right)
    shown = _by_derivatives(value, depends, shown, n, len(outputs))
    hidden = tuple(i for i in range(n) if i not in shown)
    used = [i for i in range(n) if i in shown and _matters(value, depends, i, hidden)]
    used += [row for row in rows if depends[row].any()]
    equations = tuple((*states, *names)[i] for i in used)
    return Structure(states, signals, shown, hidden, equations, tuple(used))


def _matters(value: np.ndarray, depends: np.ndarray, row: int, hidden: tuple[int, ...]) -> bool:
    return bool(depends[row].any() or (value[row, list(hidden)] != 0).any())


def _solved(
    left: Float[np.ndarray, "k n"], right: Float[np.ndarray, "k r z"]
) -> dict[int, Float[np.ndarray, "r z"]]:
    """The unknowns that left x = right determines, by index."""
    if not left.size:
        return {}
    inverse = np.linalg.pinv(left, rcond=1e-10)
    spanned = inverse @ left
    # Where a row of A^+ A is that of the identity, this unknown is determined, whatever the others
    # are: a record with few outputs shows some states and not the rest.
    alone = np.abs(spanned - np.eye(left.shape[1])).max(axis=1) < _DETERMINED
    solution = np.tensordot(inverse, right, axes=1)
    return {int(i): solution[i] for i in np.flatnonzero(alone)}


def _by_derivatives(
    value: np.ndarray, depends: np.ndarray, shown: dict[int, np.ndarray], n: int, p: int
) -> dict[int, np.ndarray]:
    """The states that the equations of the shown ones give, where these know all else."""
    rest = [i for i in range(n) if i not in shown]
    rows = [i for i in shown if not depends[i].any() and np.any(value[i, rest] != 0)]
    if not rows:
        return shown
    right = []
    for i in rows:
        # x_i' - A_ik x_k - B_i u = A_ij x_j with the shown k and the others j.
        # One order up, which is the time derivative of what shows the state. The highest order
        # comes round to the front and is dropped: `_solved` has left it empty.
        side = np.roll(shown[i], 1, axis=0)
        side[0, :] = 0.0
        side = side - sum(value[i, k] * shown[k] for k in shown)
        side[0, p:] -= value[i, n:]
        right.append(side)
    # Once only: each derivative more has so much more noise.
    more = _solved(value[np.ix_(rows, rest)], np.stack(right))
    return {**shown, **{rest[j]: columns for j, columns in more.items()}}


def held(model: Model, base: Mapping[str, float], structures: Sequence[Structure]) -> set[str]:
    """The parameters that are time constants (or frequencies) of hidden states.

    They are found by no regression: a parameter in an entry on the diagonal of the hidden states'
    own matrix, or in one that closes a loop with entries that are plain numbers, as a stiffness
    does with the rate that is the angle's derivative.

    Args:
        model: linear.
        base: all parameters by name; one that is not given (NaN) stays so, other values do not
            matter.
        structures: of the flights.
    """
    names = tuple(n for n in naming.names(model.Params) if not np.isnan(base[n]))
    at = matrices(model, base, names, generic(len(names)))
    held_names: set[str] = set()
    for hidden in {s.hidden for s in structures}:
        block = np.ix_(hidden, hidden)
        depends = np.abs(at.slope[block]) > 0
        # An entry with a parameter on such a loop sets an eigenvalue of what nobody measured. With
        # the hidden states integrated at a wrong one, least squares would fit the rest to the wrong
        # signal.
        loop = _closing((at.value[block] != 0) & ~depends.any(axis=-1))
        held_names |= {
            names[j] for j in np.flatnonzero((depends & loop[..., None]).any(axis=(0, 1)))
        }
    return held_names | set(dict(model.delays).values())


def generic(count: int) -> Float[np.ndarray, " q"]:
    """Numbers (count,) at which nothing cancels by chance."""
    return np.random.default_rng(11).uniform(0.5, 1.5, count)


def _closing(plain: np.ndarray) -> np.ndarray:
    """Where an entry (i, j) closes a loop: on the diagonal, or where i drives j by plain ones."""
    n = plain.shape[0]
    # After n rounds every chain of plain entries is in, since one without repetition is no longer.
    drives = np.eye(n, dtype=bool)
    for _ in range(n):
        drives = drives | (plain.T.astype(int) @ drives.astype(int) > 0)
    return drives
