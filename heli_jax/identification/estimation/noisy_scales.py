r"""Scale errors of what is integrated: the noise in the readings would make them too large.

A reading $z = (1 + \lambda) y + b + n$ drives a model by $(z - b)/(1 + \lambda)$. Its noise stands
in the derivative of the innovations by $\lambda$ as it does in the innovations: outputs regressed
on noisy readings have too small a slope (errors in variables). In the sensor's own units the noise
makes the process noise $n/(1 + \lambda)$, and then the sum of $e^2/s$ has its least mean at the
true $\lambda$, as where the unknown motion is a nuisance of the likelihood (Fuller, 1987, section
2.3). The sum of $\log s$, which a larger $\lambda$ makes smaller, is what attenuates: its
derivative by the scales, at the noise of the last relaxation, is taken off.
"""

from collections.abc import Container
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from heli_jax.identification.estimation.estimator import Evaluation
from heli_jax.identification.unknowns.layout import Layout, Noise, Unknowns


def free_scales(model_scales: tuple[str, ...], free: Container[str]) -> tuple[str, ...]:
    """Those of a model's `input_scales` that are estimated.

    Args:
        model_scales: `Model.input_scales`.
        free: the names that are.
    """
    return tuple(n for n in model_scales if n in free)


def not_attenuating(layout: Layout, noise: Noise, u: Unknowns) -> Array | float:
    """What the sum of log s has of the scale errors, to be taken off.

    Args:
        layout: what the unknowns are.
        noise: with the derivatives of the last relaxation; none yet: zero.
        u: the unknowns, in the units of the model.
    """
    names = free_scales(layout.model.input_scales, u.params)
    if not names or not len(noise.scale_slopes):
        return 0.0
    return jnp.sum(noise.scale_slopes * jnp.stack([u.params[n] for n in names]))


def slopes_at(layout: Layout, noise: Noise, e: Evaluation, last: int) -> Any:
    """The derivatives of the sum of log s by the scale errors (k,), () where there are none.

    Args:
        layout: what the unknowns are.
        noise: that `e` was evaluated with.
        e: anywhere.
        last: which row it is whose square is that sum, but for a constant and what is taken off.
    """
    names = free_scales(layout.model.input_scales, layout.of_interest)
    if not names or not len(noise.scale_slopes):
        return noise.scale_slopes
    at = [layout.of_interest.index(n) for n in names]
    slopes = 2.0 * e.r[last] * e.J[last, at] / e.slopes[at] + noise.scale_slopes
    return np.asarray(slopes, np.asarray(noise.scale_slopes).dtype)


def slopes_changed(before: Noise, after: Noise) -> float:
    """By which part the largest derivative by a scale error changed; 0 without any."""
    if not len(after.scale_slopes):
        return 0.0
    largest = float(np.max(np.abs(after.scale_slopes)))
    change = float(np.max(np.abs(after.scale_slopes - np.asarray(before.scale_slopes))))
    return change / largest if largest > 0 else 0.0
