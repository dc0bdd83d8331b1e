"""Search for significant disturbances, and for the optimum with or without them."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from heli_jax.dynamics.disturbance import disturbances_of
from heli_jax.dynamics.model import Disturbance
from heli_jax.identification.estimation.evaluation import Evaluation, deviations, evaluate
from heli_jax.identification.estimation.levenberg_marquardt import fit_nuisances
from heli_jax.identification.estimation.multistart import Search
from heli_jax.identification.estimation.noise_covariance import (
    RelaxedOptimum,
    log_likelihood_of,
    relaxed_from,
)
from heli_jax.identification.estimation.starts import noise_guess_at
from heli_jax.identification.unknowns.layout import Noise, Solution, disturbance_limits


def likely_gusts(at: Solution) -> tuple[Float[Array, " q"], Evaluation]:
    """Return z with the most likely disturbances, all else unchanged, and its evaluation.

    The expected accuracy of a fit depends on their size, and a search may start a decade off.
    """
    layout, data, noise, z = at
    places = np.array([layout.disturbance_at(n) for n in layout.disturbance])
    # Nuisances are fitted first. Otherwise an unknown initial bank counts as gust: one case gave
    # gusts a tenth of their true size.
    settled = fit_nuisances(layout, data, noise, z)
    likely = noise_guess_at(layout, data, noise, settled, finer=True)
    z = jnp.asarray(z).at[places].set(likely[places])
    return z, evaluate(layout, data, noise, z)


NO_DISTURBANCE = 2.71
"""Twice the log-likelihood ratio below which a disturbance is not significant at 5 %. At the
boundary sigma_w = 0 half of the chi-squared with one degree of freedom holds (Self and Liang,
1987)."""
_SURE = 0.4
"""sd of log sigma_w below which a disturbance is significant without a separate search."""
_NONE = 30.0
"""Logarithm by which sigma_w lies below the smallest noise if there is no disturbance."""


def significant_disturbances(search: Search, optimum: RelaxedOptimum) -> RelaxedOptimum:
    """Return the optimum with the significant disturbances, the others almost zero.

    If sigma_w goes to zero, tau_w has no effect and the optimiser does not converge. If all sigma_w
    are almost zero, the residuals equal those of output error.

    Args:
        optimum: the optimum with all disturbances.
    """
    layout = search.layout
    absent: list[str] = []
    # Disturbances are removed one after another. If each were left out of the full set, two
    # exchangeable ones would both look superfluous.
    for d in disturbances_of(layout.model):
        # A well-determined disturbance needs no search without it.
        if d.sigma not in layout.sigmas or _is_known(search, optimum, d):
            continue
        without, ratio = _without(search, optimum, d)
        # The condition is negated because a NaN ratio is no evidence of a disturbance.
        if without.best.converged and not ratio > NO_DISTURBANCE:
            optimum = without.after(optimum)
            # Without sigma_w the correlation time has no effect.
            absent += [n for n in (d.sigma, d.tau) if n in layout.disturbance]
    return optimum._replace(absent=tuple(absent))


def with_noise_guess(search: Search, noise: Noise, z: Float[Array, " q"]) -> Float[Array, " q"]:
    """Return z with the disturbances from a coarse search around their start values."""
    layout = search.layout
    for name in layout.disturbance:
        start = np.log(search.problem.noise[name].start)
        z = z.at[layout.disturbance_at(name)].set(jnp.asarray(start, z.dtype))
    return noise_guess_at(layout, search.data, noise, z)


def _is_known(search: Search, optimum: RelaxedOptimum, d: Disturbance) -> bool:
    """True if all parameters of a disturbance are determined, and within what a record can show."""
    layout, z = search.layout, optimum.best.z
    e = evaluate(layout, search.data, optimum.noise, z)
    if not (optimum.best.converged and np.all(np.isfinite(e.J))):
        return False
    sds = deviations(e.J)
    its = [layout.disturbance_at(n) for n in (d.sigma, d.tau) if n in layout.disturbance]
    if not (np.isfinite(sds[its]).all() and sds[layout.disturbance_at(d.sigma)] < _SURE):
        return False
    if d.tau not in layout.disturbance:
        return True
    # `unpack` clips at the limits, so the likelihood is flat there. It is nearly flat below one
    # sample.
    _, high = (float(v) for v in disturbance_limits(layout, search.data)[d.tau])
    low = np.log(min(float(f.dt) for f in search.data.flights))
    return bool(low < float(z[layout.disturbance_at(d.tau)]) < high)


def _without(
    search: Search, optimum: RelaxedOptimum, d: Disturbance
) -> tuple[RelaxedOptimum, float]:
    """Return the optimum without one disturbance, and twice the log-likelihood lost."""
    layout = search.layout
    # A value far below the smallest noise replaces zero, whose logarithm is infinite.
    smallest = min(float(s) for by_name in optimum.noise.sd for s in by_name.values())
    at = layout.disturbance_at(d.sigma)
    # All other parameters are fitted again, because a likelihood ratio compares two optima.
    z = optimum.best.z.at[at].set(np.log(smallest) - _NONE)
    without = relaxed_from(search, optimum.noise, z)
    ratio = 2.0 * (log_likelihood_of(search, optimum) - log_likelihood_of(search, without))
    return without, ratio
