"""Mean and covariance of a state between samples by explicit steps, for models without fast modes.

A local linearisation takes an exponential of a matrix in every step, which holds whatever the
modes are, and its equations stay as they are at the step's begin: an error of the second order
where inputs move. Runge and Kutta's classical method follows the same moments to the fourth order
for a twentieth of the arithmetic; a mode that is fast against the step would make it diverge.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from heli_jax.simulation.hold import Segment

type _Moments = tuple[Float[Array, " n"], Float[Array, "n n"]]
"""a state and its covariance"""


def moments_after(
    rates: Callable[[Array, Any], Array],
    intensity: Float[Array, " n"],
    moments: _Moments,
    part: Segment,
) -> _Moments:
    """The moments after one step: x' = f(x, u), P' = A P + P A' + diag(g^2), A = df/dx at x.

    Args:
        rates: f, of a state (n,) and Inputs, per second.
        intensity: g, of the process noise, see `Model.noise_intensity`.
        moments: at the step's begin.
        part: the step, with the inputs at its begin and their slopes (None: they stay).

    Source: Jategaonkar (2006), chapter 5, of the extended filter's prediction; Runge and Kutta's
    method of order 4.
    """
    spread, h = jnp.diag(jnp.square(intensity)), part.length

    def slopes(moments: _Moments, share: float) -> _Moments:
        (x, P), u = moments, part.inputs
        if part.slope is not None:
            u = jax.tree.map(lambda v, slope: v + slope * (share * h), u, part.slope)
        f, along = jax.linearize(lambda x: rates(x, u), x)
        # A P column by column: a column of P is a direction, and A itself, mostly zeros, is not
        # needed.
        AP = jax.vmap(along, in_axes=1, out_axes=1)(P)
        return f, AP + AP.T + spread

    def moved(by: _Moments, share: float) -> _Moments:
        return jax.tree.map(lambda v, slope: v + slope * (share * h), moments, by)

    first = slopes(moments, 0.0)
    second = slopes(moved(first, 0.5), 0.5)
    third = slopes(moved(second, 0.5), 0.5)
    fourth = slopes(moved(third, 1.0), 1.0)
    mean = jax.tree.map(
        lambda a, b, c, d: (a + 2.0 * (b + c) + d) / 6.0, first, second, third, fourth
    )
    return moved(mean, 1.0)
