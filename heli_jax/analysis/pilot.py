r"""A pilot who holds a helicopter's attitude, so that long manoeuvres do not diverge.

Of all feedbacks that make every mode of the attitude decay at least as fast as `PACE`, this is the
one that moves the sticks least: the minimum-energy regulator of the model linearised at its trim,
$K = B^T P$ with $(A+\alpha I)^T P + P(A+\alpha I) = P B B^T P$. It mirrors the modes that are
slower than $\alpha$ at $-\alpha$, here those in which the attitude itself drifts, and leaves the
faster ones, so the flybar's and the damping's, where they are
(Anderson and Moore, Linear Optimal Control, 1971: a prescribed degree of stability).
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from heli_jax import naming
from heli_jax.analysis.trim import Trim
from heli_jax.dynamics.model import Model, axes_of

PACE = 1.0
"""how fast the attitude comes back at least [1/s]; what would drift comes back at twice that.

The X-Cell 60 in hover then has 3 mm of cyclic stick for a radian, and 0.19 of yaw stick for a
radian and for a rad/s. A minute of random steps of 0.5 mm, 0.1 yaw and 3 % throttle, in which it
turns over without the pilot, stays within 0.17 rad of roll and pitch; with the paper's equations,
where 0.01 mm does the same, within 0.25."""


# State and inputs are classes of the user's: `Any` below.


class Pilot(NamedTuple):
    """Stick deflection by the distance of each state from trim."""

    gains: dict[str, dict[str, Float[Array, ""]]]
    """by stick and state"""
    trimmed: Any
    """the model's State to return to"""

    def __call__(self, state: Any, inputs: Any) -> Any:
        """`inputs` with the pilot's part added: a `feedback` for `simulate`."""
        commands = {
            stick: getattr(inputs, stick)
            - sum(k * (getattr(state, n) - getattr(self.trimmed, n)) for n, k in by.items())
            for stick, by in self.gains.items()
        }
        return naming.replace(inputs, **commands)


def attitude_hold(model: Model, params: Any, trimmed: Trim, pace: float = PACE) -> Pilot:
    """The pilot who holds the attitude of `trimmed`, heading included; concrete parameters only.

    Args:
        pace: every mode of the attitude decays at least as fast [1/s].

    Raises:
        ValueError: the sticks do not move all of the attitude.
    """
    axes = axes_of(model)
    sticks = [axis.stick for axis in axes if axis.stick is not None]
    # The states of the bar and the tilt belong to it: they are fast beside the attitude, but what a
    # stick does goes through them.
    of_attitude = {n for axis in axes for n in (axis.angle, axis.rate, *axis.flybar, *axis.tilt)}
    states = [n for n in naming.names(model.State) if n in of_attitude]

    def rates(x: Array, u: Array) -> Array:
        state = naming.replace(trimmed.state, **dict(zip(states, x, strict=True)))
        inputs = naming.replace(trimmed.inputs, **dict(zip(sticks, u, strict=True)))
        return naming.ravel(model.vector_field(params, state, inputs), only=states)

    x = naming.ravel(trimmed.state, only=states)
    u = naming.ravel(trimmed.inputs, only=sticks)
    A, B = (np.asarray(m) for m in jax.jit(jax.jacfwd(rates, argnums=(0, 1)))(x, u))
    # A stick that moves nothing has no gain: the regulator would divide by it.
    size = np.linalg.norm(B, axis=0)
    if not np.all(size > 0):
        raise ValueError(f"the sticks of {model.name} do not move all of its attitude")
    # Sticks of equal effect: a metre of cyclic and a full yaw stick cannot be compared.
    K = _least_energy(A, B / size, pace) / size[:, None]
    gains = {
        stick: {name: jnp.asarray(K[i, j]) for j, name in enumerate(states)}
        for i, stick in enumerate(sticks)
    }
    return Pilot(gains, trimmed.state)


def _least_energy(
    A: Float[np.ndarray, "n n"], B: Float[np.ndarray, "n m"], pace: float
) -> Float[np.ndarray, "m n"]:
    """The gains K of u = -K x that move what is slower than `pace` with the least u.

    Only those modes z = W x matter: P is W^T X^-1 W with X from Lyapunov's equation.
    """
    import scipy.linalg  # here: a simulation without a pilot need not wait for it

    # Decay faster than `pace` is stability of what is shifted by it.
    shifted = A + pace * np.eye(A.shape[0])
    # By Schur vectors, which are orthogonal: eigenvectors of equal modes nearly coincide.
    schur: Any = scipy.linalg.schur(shifted.T, sort="rhp")  # three with `sort`, which stubs ignore
    T, Z, k = schur
    W, slow = Z[:, :k].T, T[:k, :k].T
    # Linear in place of a Riccati equation: without a weight on the states the inverse of its
    # solution obeys Lyapunov's equation.
    X = scipy.linalg.solve_continuous_lyapunov(slow, W @ B @ B.T @ W.T)
    return B.T @ W.T @ np.linalg.solve(X, W)
