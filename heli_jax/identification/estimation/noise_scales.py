"""Noise in what a model integrates: the scales and process noises that are its own parameters."""

from collections.abc import Container
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from heli_jax import naming
from heli_jax.identification.estimation.evaluation import Evaluation, evaluate
from heli_jax.identification.problem import Problem
from heli_jax.identification.unknowns.layout import Data, Layout, Noise, Unknowns

# Scale errors of what is integrated: the noise in the readings would make them too large.
#
# A reading $z = (1 + \lambda) y + b + n$ drives a model by $(z - b)/(1 + \lambda)$. Its noise
# stands in the derivative of the innovations by $\lambda$ as it does in the innovations: outputs
# regressed on noisy readings have too small a slope (errors in variables). In the sensor's own
# units the noise makes the process noise $n/(1 + \lambda)$, and then the sum of $e^2/s$ has its
# least mean at the true $\lambda$, as where the unknown motion is a nuisance of the likelihood
# (Fuller, 1987, section 2.3). The sum of $\log s$, which a larger $\lambda$ makes smaller, is what
# attenuates: its derivative by the scales, at the noise of the last relaxation, is taken off.


def free_scales(model_scales: tuple[str, ...], free: Container[str]) -> tuple[str, ...]:
    """Return those of a model's `input_scales` that are estimated."""
    return tuple(n for n in model_scales if n in free)


def not_attenuating(layout: Layout, noise: Noise, u: Unknowns) -> Array | float:
    """Return what of the sum of log s comes by the scale errors, which is taken off."""
    names = free_scales(layout.model.input_scales, u.params)
    if not names or not len(noise.scale_slopes):
        return 0.0
    return jnp.sum(noise.scale_slopes * jnp.stack([u.params[n] for n in names]))


def slopes_at(layout: Layout, noise: Noise, e: Evaluation, last: int) -> Any:
    """The derivatives of the sum of log s by the scale errors (k,), () where there are none. The
    square of row `last` is that sum, but for a constant and what is taken off."""
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


_STEP = 0.05
"""of a noise's logarithm, for a difference"""
_TOLD = 0.1
"""part of a derivative by which another changes nothing: the noise moves by a twentieth of that"""


# How large a model's own process noise is, by the restricted likelihood.
#
# What drifts by the noise of a gyro looks like a bias, a scale or an initial state. The likelihood
# knows the errors only with these taken out, and makes the noise too small by what they took: as
# the variance of n numbers about their mean has n - 1 below it, but where noise of one second in
# thirty is all that shows, by a sixth and not by a thousandth. So does every interval of a bias.
# The restricted likelihood (Patterson and Thompson, 1971; Harville, 1977) is that of what no
# parameter of the mean can take up,
#
# $$-2 \log L_R = -2 \log L + \log\det J'J,$$
#
# with J the derivatives of the whitened innovations by these parameters. The derivative of the
# determinant by the noise's logarithm, at the noise of the last relaxation, is added to the
# likelihood: where both stay, $L_R$ is largest.


def with_own_noise(problem: Problem, noise: Noise) -> Noise:
    """The noise with no derivative yet by each parameter of the model's own process noise that is
    unknown: of models whose inputs are sensors, all of whose noise is such."""
    names = _own(problem) if problem.model.input_scales else ()
    if not names:
        return noise
    dtype = noise.log_variance_ratio.dtype
    return noise._replace(
        own={n: np.asarray([0.0, np.log(problem.free[n].start)], dtype) for n in names}
    )


def _own(problem: Problem) -> tuple[str, ...]:
    """The free parameters that the process noise grows with."""
    intensity, start = problem.model.noise_intensity, problem.vehicle
    if intensity is None:
        return ()
    free = {n: f.start for n, f in problem.free.items() if f.start > 0}
    params = naming.replace(start, **{n: jnp.asarray(v) for n, v in free.items()})

    def size(name: str, factor: float) -> np.ndarray:
        changed = naming.replace(params, **{name: jnp.asarray(free[name] * factor)})
        return np.array(list(map(float, naming.asdict(intensity(changed)).values())))

    # In proportion, on those axes that it is the noise of.
    return tuple(
        n
        for n in free
        if n not in problem.model.input_scales
        and np.any(size(n, 1.0) > 0)
        and not np.allclose(size(n, 2.0), size(n, 1.0))
    )


def taken_up(noise: Noise, u: Unknowns) -> Array | float:
    """Return the term log det J'J of minus twice the restricted log-likelihood, to first order."""
    if not noise.own:
        return 0.0
    return sum(at[0] * (jnp.log(u.params[n]) - at[1]) for n, at in noise.own.items())


def own_at(
    layout: Layout, data: Data, noise: Noise, e: Evaluation, z: Float[Array, " q"], measured: int
) -> dict[str, np.ndarray] | tuple[()]:
    """By parameter of the own process noise the derivative of log det J'J by its logarithm, and
    that logarithm; () where there is none."""
    if not noise.own:
        return noise.own
    here, slopes = _log_det(layout, noise, e.J, measured), {}
    for name, before in noise.own.items():
        i = layout.of_interest.index(name)
        # Of a parameter that keeps its sign the coordinate is about its logarithm.
        there = evaluate(layout, data, noise, z.at[i].add(_STEP))
        apart = float(np.log(there.named[i] / e.named[i]))
        slope = (_log_det(layout, noise, there.J, measured) - here) / apart
        at = [slope, np.log(e.named[i])] if np.isfinite(slope) else before
        slopes[name] = np.asarray(at, before.dtype)
    return slopes


def _log_det(layout: Layout, noise: Noise, J: np.ndarray, measured: int) -> float:
    """log det J'J of the parameters of the mean, but for a constant."""
    means = [i for i, n in enumerate(layout.of_interest) if n not in noise.own]
    columns = [*means, *range(layout.first_nuisance, layout.size)]
    # Behind the innovations stand what the variances tell, and the priors.
    rows = np.r_[0:measured, 2 * measured + 1 : J.shape[0]]
    R = np.linalg.qr(np.asarray(J, np.float64)[np.ix_(rows, columns)], mode="r")
    with np.errstate(divide="ignore"):
        return 2.0 * float(np.sum(np.log(np.abs(np.diag(R)))))


def own_changed(before: Noise, after: Noise) -> bool:
    """True if the derivatives changed by as much as moves the noise."""
    if not after.own:
        return False
    old, new = (np.array([float(at[0]) for at in n.own.values()]) for n in (before, after))
    return bool(np.max(np.abs(new - old)) > _TOLD * np.max(np.abs(new)))
