r"""Corrections of a filter's likelihood where the model integrates a noisy sensor.

Each is a term slope * (g - g0) in minus twice the log-likelihood, by parameter. The slope comes
from the last relaxation, and g is the parameter itself or its logarithm.

Scale errors. A reading $z = (1 + \lambda) y + b + n$ drives a model by $(z - b)/(1 + \lambda)$.
Outputs regressed on noisy readings have too small a slope (errors in variables). The noise adds
process noise $n/(1 + \lambda)$. With it the mean of $e^2/s$ is least at the true $\lambda$, as if
the unknown motion were a nuisance of the likelihood (Fuller, 1987, section 2.3). The attenuation
comes from the sum of $\log s$, which decreases with $\lambda$. Its derivative by the scales is
therefore subtracted.

Process noise of the model's own. Drift due to gyro noise looks like a bias, a scale or an initial
state, so the likelihood makes the noise too small. The restricted likelihood (Patterson and
Thompson, 1971; Harville, 1977) adds $\log\det J'J$, with J the derivatives of the whitened
innovations by the parameters of the mean. Its derivative by the noise's logarithm is added here.
"""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from heli_jax import naming
from heli_jax.dynamics.model import Model
from heli_jax.identification.estimation.evaluation import Evaluation, evaluate
from heli_jax.identification.problem import Problem
from heli_jax.identification.unknowns.layout import Data, Layout, Noise, Unknowns

_STEP = 0.05
"""Step of a noise's logarithm for a finite difference."""


def first_corrections(problem: Problem) -> dict[str, np.ndarray] | tuple[()]:
    """Return the slope (zero) and its g by parameter; () if the model integrates no sensor."""
    scales = [n for n in problem.model.input_scales if n in problem.free]
    names = [*scales, *(_own_noise(problem) if problem.model.input_scales else ())]
    dtype = np.dtype(jnp.result_type(float))
    starts = {n: problem.free[n].start for n in names}
    return {n: np.array([0.0, _g(problem.model, n, v)], dtype) for n, v in starts.items()} or ()


def _g(model: Model, name: str, value: Any) -> Any:
    return value if name in model.input_scales else jnp.log(value)


def _own_noise(problem: Problem) -> tuple[str, ...]:
    """Return the free parameters that the process noise is proportional to."""
    intensity = problem.model.noise_intensity
    if intensity is None:
        return ()
    free = {n: f.start for n, f in problem.free.items() if f.start > 0}
    params = naming.replace(problem.vehicle, **{n: jnp.asarray(v) for n, v in free.items()})

    def size(name: str, factor: float) -> np.ndarray:
        changed = naming.replace(params, **{name: jnp.asarray(free[name] * factor)})
        return np.array(list(map(float, naming.asdict(intensity(changed)).values())))

    return tuple(
        n
        for n in free
        if n not in problem.model.input_scales
        and np.any(size(n, 1.0) > 0)
        and not np.allclose(size(n, 2.0), size(n, 1.0))
    )


def correction(layout: Layout, noise: Noise, u: Unknowns) -> Array | float:
    """Return the term added to minus twice the log-likelihood."""
    if not noise.corrections:
        return 0.0
    return sum(
        slope * (_g(layout.model, n, u.params[n]) - g)
        for n, (slope, g) in noise.corrections.items()
    )


def corrections_at(
    layout: Layout, data: Data, noise: Noise, e: Evaluation, z: Float[Array, " q"], measured: int
) -> dict[str, np.ndarray] | tuple[()]:
    """Return the corrections at an evaluation.

    Args:
        measured: number of innovations; the row after them is that of the variances.
    """
    if not noise.corrections:
        return ()
    corrections = {}
    for name, before in noise.corrections.items():
        i = layout.of_interest.index(name)
        if name in layout.model.input_scales:
            # The square of this row has the derivative of the sum of log s and of the corrections.
            slope = float(before[0]) - 2.0 * e.r[measured] * e.J[measured, i] / e.slopes[i]
        else:
            there = evaluate(layout, data, noise, z.at[i].add(_STEP))
            change = _log_det(layout, noise, there.J, measured)
            change -= _log_det(layout, noise, e.J, measured)
            slope = change / float(np.log(there.named[i] / e.named[i]))
        at = [slope, float(_g(layout.model, name, e.named[i]))]
        corrections[name] = np.asarray(at if np.isfinite(slope) else before, before.dtype)
    return corrections


def _log_det(layout: Layout, noise: Noise, J: np.ndarray, measured: int) -> float:
    """Return log det J'J of the parameters of the mean, up to a constant."""
    own = set(noise.corrections) - set(layout.model.input_scales)
    means = [i for i, n in enumerate(layout.of_interest) if n not in own]
    columns = [*means, *range(layout.first_nuisance, layout.size)]
    # These are the innovations and the priors, without the rows of variances between them.
    rows = np.r_[0:measured, 2 * measured + 1 : J.shape[0]]
    R = np.linalg.qr(np.asarray(J, np.float64)[np.ix_(rows, columns)], mode="r")
    with np.errstate(divide="ignore"):
        return 2.0 * float(np.sum(np.log(np.abs(np.diag(R)))))


def corrections_changed(before: Noise, after: Noise) -> float:
    """Return the largest relative change of a slope."""
    if not after.corrections:
        return 0.0
    slopes = [
        (float(before.corrections[n][0]), float(now[0])) for n, now in after.corrections.items()
    ]
    return max(abs(new - old) / max(abs(new), 1e-300) for old, new in slopes)
