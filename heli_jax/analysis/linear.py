"""What a model is like near a point: named matrices, modes, frequency response."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from heli_jax import naming
from heli_jax.analysis.lti import siso_polynomials
from heli_jax.dynamics.jacobians import StateSpace, jacobians
from heli_jax.dynamics.model import Model


class Linearization(NamedTuple):
    """A, B, C, D about a point, with the names of their rows and columns."""

    matrices: StateSpace
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]


def linearize(model: Model, params: Any, state: Any = None, inputs: Any = None) -> Linearization:
    """The model's matrices at a state and inputs (all zeros unless given)."""
    return Linearization(
        jacobians(model, params, state, inputs),
        naming.names(model.State),
        naming.names(model.Inputs),
        naming.names(model.Outputs),
    )


def modes(model: Model, params: Any, state: Any = None, inputs: Any = None) -> np.ndarray:
    """Eigenvalues of A [1/s], (n,) complex, slowest first. Concrete parameters only."""
    eigenvalues = np.linalg.eigvals(np.asarray(jacobians(model, params, state, inputs).A))
    return eigenvalues[np.argsort(np.abs(eigenvalues))]


def transfer_function(
    model: Model, params: Any, output: str, input: str
) -> tuple[np.ndarray, np.ndarray]:
    """Numerator and denominator in s, highest power first, from the linearisation about zero.

    The denominator has n + 1 numbers and begins with 1; leading zeros of the numerator are cut.

    Raises:
        ValueError: the model has no such output or input.
    """
    lin = linearize(model, params)
    for name, known, what in ((output, lin.outputs, "output"), (input, lin.inputs, "input")):
        if name not in known:
            raise ValueError(f"model {model.name} has no {what} {name!r}; it has {known}")
    A, B, C, D = (np.asarray(M, dtype=np.float64) for M in lin.matrices)
    i, j = lin.outputs.index(output), lin.inputs.index(input)
    return siso_polynomials(A, B[:, j], C[i], float(D[i, j]))


def frequency_response(
    model: Model, params: Any, omega: Float[Array, " k"]
) -> Complex[Array, "k p m"]:
    """H(i omega) = C (i omega - A)^-1 B + D of the linearisation about zero; omega in rad/s."""
    A, B, C, D = jacobians(model, params)
    w = jnp.asarray(omega, A.dtype)
    s = jax.lax.complex(jnp.zeros_like(w), w)
    eye = jnp.eye(A.shape[0], dtype=s.dtype)

    def at(one: Array) -> Array:
        inner = jnp.linalg.solve(one * eye - A.astype(s.dtype), B.astype(s.dtype))
        return C.astype(s.dtype) @ inner + D.astype(s.dtype)

    return jax.vmap(at)(s)
