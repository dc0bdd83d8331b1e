"""How large gusts are at the start values: what expected standard deviations go with."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from heli_jax.identification.estimation.evaluation import Evaluation, evaluate
from heli_jax.identification.estimation.noise_search import finer_noise_guess, noise_guess_at
from heli_jax.identification.unknowns.layout import Solution


def likely_gusts(at: Solution, e: Evaluation) -> tuple[Float[Array, " q"], Evaluation]:
    """z with the disturbances of the greatest likelihood, all else as it is, and what that tells.

    A search may begin a decade off; what a fit may be expected to determine goes with the size.

    Args:
        at: the start values.
        e: there.
    """
    layout, data, noise, z = at
    k, places = layout.first_nuisance, [layout.disturbance_at(n) for n in layout.disturbance]
    # Without the initial states and biases of the flights, which nobody states: one that begins in
    # a bank is no gust, and weighed as one it made gusts a tenth of what they were.
    step = np.linalg.lstsq(e.J[:, k:], -e.r)[0] if np.isfinite(e.J).all() else np.zeros(z.size - k)
    settled = jnp.asarray(z).at[k:].add(jnp.asarray(step, z.dtype))
    likely = noise_guess_at(layout, data, noise, settled)
    likely = finer_noise_guess(layout, data, noise, likely)
    z = jnp.asarray(z).at[jnp.asarray(places)].set(likely[jnp.asarray(places)])
    return z, evaluate(layout, data, noise, z)
