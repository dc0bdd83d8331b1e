"""How sure the numbers at an optimum are: Cramér-Rao's bound, or wider."""

import math
from collections.abc import Callable, Collection
from dataclasses import replace
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
import scipy.special
from jaxtyping import Float

from heli_jax.identification.estimation.evaluation import Evaluation
from heli_jax.identification.identifiability.analysis import Around, with_combinations
from heli_jax.identification.identifiability.equivalents import Valley
from heli_jax.identification.identifiability.profile import (
    AS_SLOPES,
    Limits,
    beyond_slopes,
)
from heli_jax.identification.identifiability.sensitivity import verdict_of
from heli_jax.identification.identifiability.through_inputs import (
    by_disturbance,
    remarks,
    through_inputs,
)
from heli_jax.identification.identifiability.verdict import (
    Z95,
    Combination,
    SecondSolution,
    Verdict,
)
from heli_jax.identification.problem import Problem
from heli_jax.identification.uncertainty.autocorrelated_residuals import (
    Sandwich,
    residual_curvature,
    sandwich,
)
from heli_jax.identification.unknowns.layout import Layout, Solution

_LARGEST = 700.0
"""log of the largest end of an interval: exp overflows at 709"""


class StandardErrors(NamedTuple):
    """How sure the numbers at the optimum are."""

    verdict: Verdict
    wider: Float[np.ndarray, " q"]
    """by how much autocorrelated residuals widen the standard deviations of the unknowns"""
    quantiles: Float[np.ndarray, " q"]
    """standard deviations that a 95 % interval reaches to either side"""
    coloured: bool
    """whether the intervals allow for residuals that are not white"""
    limits: Limits = MappingProxyType({})
    """by parameter the ends of its 95 % interval by the likelihood, in its unit, where the slopes
    have others"""
    by: Evaluation | None = None
    """what the standard deviations go by where it is not the optimum's own Jacobian"""


def standard_errors(
    problem: Problem,
    at: Solution,
    e: Evaluation,
    before: Verdict,
    *,
    white: bool,
    aliased: Collection[str] = (),
    second: tuple[SecondSolution, ...] = (),
    optimum: bool = True,
) -> StandardErrors:
    """As the slopes have them, and where these leave wide intervals as the likelihood has them.

    Args:
        before: the verdict at the first guess, which stands where the optimum has no Jacobian.
        white: whether the residuals are white and independent between outputs; of a method with
            process noise whether the innovations are.
        aliased: the parameters that move a mode which the samples do not tell from its aliases.
        optimum: whether the point is one, about which the likelihood may be asked.
    """
    around = Around(frozenset(aliased), second, Valley(problem, at, e))

    def slopes(e: Evaluation, around: Around) -> StandardErrors:
        return _by_slopes(problem, at, e, before, around, white=white)

    errors = slopes(e, around)
    inputs = through_inputs(at, e) if optimum else None
    if inputs is not None:
        return _with_process_noise(problem, at, e, inputs, errors, around, slopes, white=white)
    if not optimum:
        return errors
    beyond = beyond_slopes(problem, at, e, errors.verdict, errors.wider * errors.quantiles)
    if beyond is not AS_SLOPES:
        errors = slopes(e, around._replace(**beyond._asdict()))._replace(limits=beyond.limits)
    return errors


def _with_process_noise(
    problem: Problem,
    at: Solution,
    e: Evaluation,
    inputs: Evaluation,
    errors: StandardErrors,
    around: Around,
    slopes: Callable[[Evaluation, Around], StandardErrors],
    *,
    white: bool,
) -> StandardErrors:
    """Cramér-Rao's bound of a filter's innovations; where these are not white, or the spectrum of a
    disturbance tells more of a parameter than the inputs do, that of the responses in them alone.

    Args:
        inputs: what inputs and initial states tell there, of `through_inputs`.
    """
    # Neither names combinations, which take time to look for.
    by_all, by_inputs = (
        verdict_of(problem, at.layout, told, around=around._replace(combined=False))
        for told in (e, inputs)
    )
    told = by_disturbance(by_all, by_inputs)
    # Of several outputs one that is pushed moves the others, which is an answer to a motion that
    # was measured. Of one the disturbance has its spectrum alone, as far as its model is right:
    # that adds to what the inputs tell, and does not speak in their place.
    spectrum_alone = all(len(outputs) == 1 for outputs in at.layout.outputs)
    counts = white and not (spectrum_alone and (told.resting or told.mostly))
    asked, names = errors.verdict, told.resting
    if not counts:
        lacking = dict.fromkeys((*asked.undetermined, *by_inputs.undetermined))
        asked = replace(asked, undetermined=tuple(lacking))
    beyond = beyond_slopes(problem, at, e, asked, errors.wider * errors.quantiles)
    if not counts:
        # The likelihood has the colour in it: its ends are those of parameters that rest on
        # responses.
        limits = {n: ends for n, ends in beyond.limits.items() if n not in told.wider}
        beyond = beyond._replace(limits=limits)
        if names or len(by_inputs.null_directions) > len(by_all.null_directions):
            # The colour has put the optimum where it is along directions that no input shows:
            # slopes there name combinations that do not hold where the machine is.
            around = around._replace(combined=False)
            names = names or by_inputs.undetermined
    if not (counts and beyond is AS_SLOPES):
        errors = slopes(e if counts else inputs, around._replace(**beyond._asdict()))
    said = (*errors.verdict.sentences, *remarks(told, names, counts=counts, white=white))
    verdict = replace(errors.verdict, sentences=said)
    return errors._replace(verdict=verdict, limits=beyond.limits, by=None if counts else inputs)


def _by_slopes(
    problem: Problem,
    at: Solution,
    e: Evaluation,
    before: Verdict,
    around: Around,
    *,
    white: bool,
) -> StandardErrors:
    """Cramér-Rao's bound, or where the residuals are not white and their autocorrelation can be
    estimated, the sandwich; the arguments are those of `standard_errors`."""
    layout, objective = at.layout, at.layout.objective
    usable = bool(np.all(np.isfinite(e.J)) and np.all(np.isfinite(e.r)))
    # The noise is estimated from the same residuals: Student's t, not the normal distribution.
    freedom = max(objective.numbers(layout, at.data, at.noise) - layout.determined, 1)
    quantile = float(scipy.special.stdtrit(freedom, 0.975))
    quantiles = np.full(layout.size, quantile)
    if white or not (usable and objective.noise_model == "white"):
        verdict = verdict_of(problem, layout, e, around=around) if usable else before
        # Weighed by the noise's own spectrum, the bound allows for it as it stands.
        allowed = usable and not white and objective.noise_model == "spectrum"
        return StandardErrors(verdict, np.ones(layout.size), quantiles, allowed)
    errors = sandwich(layout, at.data, e, residual_curvature(layout, at.data, at.noise, at.z))
    # Few independent parts of a spectrum tell a variance poorly; never better than all samples.
    quantiles = np.maximum(errors.quantile(), quantile)
    # The rule of the factor of ten has to see the intervals that are reported, of which a verdict
    # takes 1.96 standard deviations.
    k = len(layout.of_interest)
    factor = quantiles[:k] / Z95
    reported = errors.covariance(np.eye(layout.size)[:k]) * np.outer(factor, factor)
    verdict = verdict_of(problem, layout, e, reported, around)
    verdict = with_combinations(verdict, lambda c: _widened(c, errors, layout, e))
    return StandardErrors(verdict, errors.inflation(), quantiles, True)


def _widened(c: Combination, errors: Sandwich, layout: Layout, e: Evaluation) -> Combination:
    """The combination with an interval that allows for autocorrelated residuals."""
    # d log p / dz: products of powers are sums in logarithms, and z is either the logarithm itself
    # or, with bounds or a free sign, another coordinate.
    along = np.zeros((1, layout.size))
    for name, weight in c.exponents.items():
        i = layout.of_interest.index(name)
        along[0, i] = weight * e.slopes[i] / (e.named[i] if c.kind == "product" else 1.0)
    wider = float(errors.inflation(along)[0])
    reach = wider * float(errors.quantile(along)[0]) / Z95

    def end(at: float) -> float:
        # The ends of an interval of a product lie at equal factors, not distances.
        if c.kind == "product":
            # In logarithms, as an interval of a product may reach past what a float64 holds.
            if not (at > 0.0 and c.value > 0.0 and math.isfinite(at) and math.isfinite(c.value)):
                return at
            log = math.log(c.value) + reach * (math.log(at) - math.log(c.value))
            return math.exp(log) if log < _LARGEST else math.inf
        return c.value + (at - c.value) * reach

    return c._replace(sd=c.sd * wider, lower95=end(c.lower95), upper95=end(c.upper95))
