"""How sure the numbers at an optimum are: Cramér-Rao's bound, or wider."""

from collections.abc import Collection
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import scipy.special
from jaxtyping import Float

from heli_jax.identification.estimation.evaluation import Evaluation
from heli_jax.identification.identifiability.sensitivity import verdict_of
from heli_jax.identification.identifiability.verdict import Z95, Verdict
from heli_jax.identification.problem import Problem
from heli_jax.identification.uncertainty.autocorrelated_residuals import (
    Sandwich,
    residual_curvature,
    sandwich,
)
from heli_jax.identification.unknowns.layout import Layout, Solution


class StandardErrors(NamedTuple):
    """How sure the numbers at the optimum are."""

    verdict: Verdict
    wider: Float[np.ndarray, " q"]
    """by how much autocorrelated residuals widen the standard deviations of the unknowns"""
    quantiles: Float[np.ndarray, " q"]
    """standard deviations that a 95 % interval reaches to either side"""
    coloured: bool
    """whether the intervals allow for residuals that are not white"""


def standard_errors(
    problem: Problem,
    at: Solution,
    e: Evaluation,
    before: Verdict,
    *,
    white: bool,
    aliased: Collection[str] = (),
) -> StandardErrors:
    """Cramér-Rao's bound, or where the residuals are not white and their autocorrelation can be
    estimated, the sandwich.

    Args:
        problem: what was fitted.
        at: the optimum.
        e: what it tells.
        before: the verdict at the first guess, which stands where the optimum has no Jacobian.
        white: whether the residuals are white and independent between outputs.
        aliased: the parameters that move a mode which the samples do not tell from its aliases.
    """
    layout, estimator = at.layout, at.layout.estimator
    usable = bool(np.all(np.isfinite(e.J)) and np.all(np.isfinite(e.r)))
    verdict = verdict_of(problem, layout, e, aliased=aliased) if usable else before
    # The noise is estimated from the same residuals: Student's t, not the normal distribution.
    freedom = max(estimator.numbers(layout, at.data, at.noise) - layout.determined, 1)
    quantile = float(scipy.special.stdtrit(freedom, 0.975))
    quantiles = np.full(layout.size, quantile)
    # Rows that are dependent under white noise too say nothing by the residuals' whiteness.
    white = white and estimator.rows_are_white
    if white or not (usable and estimator.rows_are_samples):
        # Weighed by the noise's own spectrum, the bound allows for it as it stands.
        allowed = usable and not white and estimator.noise_spectrum
        return StandardErrors(verdict, np.ones(layout.size), quantiles, allowed)
    errors = sandwich(layout, at.data, e, residual_curvature(layout, at.data, at.noise, at.z))
    # Few independent parts of a spectrum tell a variance poorly; never better than all samples.
    quantiles = np.maximum(errors.quantile(), quantile)
    # The rule of the factor of ten has to see the intervals that are reported.
    verdict = verdict_of(problem, layout, e, _reported(errors, layout, quantiles), aliased)
    verdict = _widened(verdict, errors, _along(verdict, layout, e))
    return StandardErrors(verdict, errors.inflation(), quantiles, True)


def _along(verdict: Verdict, layout: Layout, e: Evaluation) -> np.ndarray:
    """The logarithms of the verdict's combinations as directions (k, q) of the unknowns."""
    # d log p / dz: combinations are products of powers, sums in logarithms, and z is either the
    # logarithm itself or, with bounds or a free sign, another coordinate.
    slopes = np.asarray(e.slopes) / np.asarray(e.named)
    along = np.zeros((len(verdict.combinations), layout.size))
    for k, c in enumerate(verdict.combinations):
        for name, power in c.exponents.items():
            i = layout.of_interest.index(name)
            along[k, i] = power * slopes[i]
    return along


def _reported(
    errors: Sandwich, layout: Layout, quantiles: Float[np.ndarray, " q"]
) -> Float[np.ndarray, "k k"]:
    """Covariance of the unknowns of interest with autocorrelated residuals, as wide as the
    intervals that are reported."""
    of_interest = np.eye(layout.size)[: len(layout.of_interest)]
    # Whoever reads it takes 1.96 standard deviations for an interval.
    factor = quantiles[: len(layout.of_interest)] / Z95
    return errors.covariance(of_interest) * np.outer(factor, factor)


def _widened(verdict: Verdict, errors: Sandwich, along: np.ndarray) -> Verdict:
    """The verdict with intervals of its combinations, directions (k, q), that allow for
    autocorrelated residuals."""
    if not verdict.combinations:
        return verdict
    wider = errors.inflation(along)
    reach = wider * errors.quantile(along) / Z95
    # In logarithms: the ends of an interval of a product lie at equal factors, not distances.
    combinations = tuple(
        c._replace(
            sd=float(c.sd * w),
            lower95=float(c.value * (c.lower95 / c.value) ** r),
            upper95=float(c.value * (c.upper95 / c.value) ** r),
        )
        for c, w, r in zip(verdict.combinations, wider, reach, strict=True)
    )
    return replace(verdict, combinations=combinations)
