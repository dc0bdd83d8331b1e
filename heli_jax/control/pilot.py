r"""Pilot model that holds a helicopter's attitude, so that long manoeuvres do not diverge.

This feedback makes every attitude mode decay at least as fast as `PACE` with the least stick
movement. It is the minimum-energy regulator of the model linearised at its trim, $K = B^T P$ with
$(A+\alpha I)^T P + P(A+\alpha I) = P B B^T P$. It mirrors modes slower than $\alpha$ at $-\alpha$,
here those in which the attitude drifts. Faster modes, such as those of the flybar and the damping,
stay unchanged (Anderson and Moore, Linear Optimal Control, 1971: a prescribed degree of
stability).
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
"""Least decay rate of the attitude [1/s]; a drifting mode decays at twice this rate.

For the X-Cell 60 in hover it gives 3 mm of cyclic stick per radian, and 0.19 of yaw stick per
radian and per rad/s. With random steps of 0.5 mm, 0.1 yaw and 3 % throttle for a minute, roll and
pitch stay within 0.17 rad; without the pilot the helicopter turns over. With the paper's equations,
where 0.01 mm turns it over, they stay within 0.25 rad.
"""


# State and inputs are the user's classes, hence `Any` below.


class Pilot(NamedTuple):
    """Stick deflection from the deviation of each state from trim."""

    gains: dict[str, dict[str, Float[Array, ""]]]
    """Gains by stick and state."""
    trimmed: Any
    """Target state, an instance of the model's State."""

    def __call__(self, state: Any, inputs: Any) -> Any:
        """Return `inputs` plus the pilot's part: a `feedback` for `simulate`."""
        commands = {
            stick: getattr(inputs, stick)
            - sum(k * (getattr(state, n) - getattr(self.trimmed, n)) for n, k in by.items())
            for stick, by in self.gains.items()
        }
        return naming.replace(inputs, **commands)


def attitude_hold(model: Model, params: Any, trimmed: Trim) -> Pilot:
    """Return the pilot that holds attitude and heading of `trimmed`, for concrete parameters.

    Raises:
        ValueError: the sticks do not control the whole attitude.
    """
    axes = axes_of(model)
    sticks = [axis.stick for axis in axes if axis.stick is not None]
    # States of the flybar and the tilt are included. They are fast, but sticks act through them.
    of_attitude = {n for axis in axes for n in (axis.angle, axis.rate, *axis.flybar, *axis.tilt)}
    states = [n for n in naming.names(model.State) if n in of_attitude]

    def rates(x: Array, u: Array) -> Array:
        state = naming.replace(trimmed.state, **dict(zip(states, x, strict=True)))
        inputs = naming.replace(trimmed.inputs, **dict(zip(sticks, u, strict=True)))
        return naming.ravel(model.vector_field(params, state, inputs), only=states)

    x = naming.ravel(trimmed.state, only=states)
    u = naming.ravel(trimmed.inputs, only=sticks)
    A, B = (np.asarray(m) for m in jax.jit(jax.jacfwd(rates, argnums=(0, 1)))(x, u))
    # The regulator would divide by the zero effect of such a stick.
    size = np.linalg.norm(B, axis=0)
    if not np.all(size > 0):
        raise ValueError(f"the sticks of {model.name} do not move all of its attitude")
    # Sticks are scaled to equal effect, since a metre of cyclic and full yaw stick are not
    # comparable.
    K = _least_energy(A, B / size) / size[:, None]
    gains = {
        stick: {name: jnp.asarray(K[i, j]) for j, name in enumerate(states)}
        for i, stick in enumerate(sticks)
    }
    return Pilot(gains, trimmed.state)


def _least_energy(
    A: Float[np.ndarray, "n n"], B: Float[np.ndarray, "n m"]
) -> Float[np.ndarray, "m n"]:
    """Return the gains K of u = -K x that speed up modes slower than `PACE` with the least u.

    Only those modes z = W x matter: P is W^T X^-1 W with X from Lyapunov's equation.
    """
    import scipy.linalg  # simulations without a pilot need not wait for it

    # A decay faster than `PACE` is stability of the shifted system.
    shifted = A + PACE * np.eye(A.shape[0])
    # Schur vectors are orthogonal, while eigenvectors of equal modes nearly coincide.
    schur: Any = scipy.linalg.schur(shifted.T, sort="rhp")  # three with `sort`, which stubs ignore
    T, Z, k = schur
    W, slow = Z[:, :k].T, T[:k, :k].T
    # Without a weight on the states, the inverse of the Riccati solution obeys the linear Lyapunov
    # equation.
    X = scipy.linalg.solve_continuous_lyapunov(slow, W @ B @ B.T @ W.T)
    return B.T @ W.T @ np.linalg.solve(X, W)
