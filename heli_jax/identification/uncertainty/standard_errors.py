"""How sure the numbers at an optimum are: Cramér-Rao's bound, or wider."""

import math
from collections.abc import Collection
from dataclasses import replace
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
import scipy.special
from jaxtyping import Float

from heli_jax.identification.estimation.estimator import Evaluation
from heli_jax.identification.identifiability.analysis import Around
from heli_jax.identification.identifiability.equivalents import Valley
from heli_jax.identification.identifiability.profile import (
    AS_SLOPES,
    Limits,
    beyond_slopes,
)
from heli_jax.identification.identifiability.sensitivity import verdict_of
from heli_jax.identification.identifiability.through_inputs import (
    MOSTLY,
    by_inputs_alone,
    deviations_of,
    mostly_by_disturbance,
    not_by_inputs,
    not_counted,
    resting_on_disturbance,
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
        problem: what was fitted.
        at: the optimum.
        e: what it tells.
        before: the verdict at the first guess, which stands where the optimum has no Jacobian.
        white: whether the residuals are white and independent between outputs; of a method with
            process noise whether the innovations are.
        aliased: the parameters that move a mode which the samples do not tell from its aliases.
        second: other values that fit as well.
        optimum: whether the point is one, about which the likelihood may be asked.
    """
    around = Around(frozenset(aliased), second, Valley(problem, at, e))
    inputs = through_inputs(at, e) if optimum else None
    if inputs is not None:
        return _with_process_noise(problem, at, e, inputs, around, white=white)
    errors = _by_slopes(problem, at, e, before, around, white=white)
    if not optimum:
        return errors
    beyond = beyond_slopes(problem, at, e, errors.verdict, errors.wider * errors.quantiles)
    if beyond is AS_SLOPES:
        return errors
    around = around._replace(**beyond._asdict())
    errors = _by_slopes(problem, at, e, before, around, white=white)
    return errors._replace(limits=beyond.limits)


def _with_process_noise(
    problem: Problem,
    at: Solution,
    e: Evaluation,
    inputs: Evaluation,
    around: Around,
    *,
    white: bool,
) -> StandardErrors:
    """Cramér-Rao's bound of a filter's innovations; where these are not white, or the spectrum of a
    disturbance tells more of a parameter than the inputs do, that of the responses in them alone.

    Args:
        problem: what was fitted.
        at: the optimum.
        e: what it tells.
        inputs: what inputs and initial states tell there, of `through_inputs`.
        around: what is known of points other than the optimum.
        white: whether the innovations are white.
    """
    layout = at.layout
    # Neither names combinations, which take time to look for.
    slopes = around._replace(combined=False)
    by_all = verdict_of(problem, layout, e, around=slopes)
    by_inputs = verdict_of(problem, layout, inputs, around=slopes)
    resting, mostly = not_by_inputs(by_all, by_inputs), mostly_by_disturbance(by_all, by_inputs)
    # Of several outputs one that is pushed moves the others, which is an answer to a motion that
    # was measured. Of one the disturbance has its spectrum alone, as far as its model is right:
    # that adds to what the inputs tell, and does not speak in their place.
    spectrum_alone = all(len(outputs) == 1 for outputs in layout.outputs)
    counts = white and not (spectrum_alone and (resting or mostly))
    errors = _by_slopes(problem, at, e, by_all, around, white=white)
    asked = errors.verdict
    if not counts:
        lacking = dict.fromkeys((*asked.undetermined, *by_inputs.undetermined))
        asked = replace(asked, undetermined=tuple(lacking))
    beyond = beyond_slopes(problem, at, e, asked, errors.wider * errors.quantiles)
    if counts:
        if beyond is not AS_SLOPES:
            around = around._replace(**beyond._asdict())
            errors = _by_slopes(problem, at, e, by_all, around, white=True)
        said = [resting_on_disturbance(resting)] if resting else []
        return _saying(said, errors)._replace(limits=beyond.limits)
    # The likelihood has the colour in it: its ends are those of parameters that rest on responses.
    wider = deviations_of(by_inputs) > MOSTLY * deviations_of(by_all)
    limits = {n: v for n, v in beyond.limits.items() if not wider[by_all.names.index(n)]}
    around = around._replace(**beyond._replace(limits=limits)._asdict())
    said = []
    if resting or len(by_inputs.null_directions) > len(by_all.null_directions):
        # The colour has put the optimum where it is along directions that no input shows: slopes
        # there name combinations that do not hold where the machine is.
        around = around._replace(combined=False)
        said = [not_counted(resting or by_inputs.undetermined, white=white)]
    if white and mostly:
        said.append(by_inputs_alone(mostly))
    errors = _by_slopes(problem, at, inputs, by_all, around, white=white)
    return _saying(said, errors)._replace(limits=limits, by=inputs)


def _saying(sentences: list[str], errors: StandardErrors) -> StandardErrors:
    """With further sentences at the end of the verdict."""
    verdict = replace(errors.verdict, sentences=(*errors.verdict.sentences, *sentences))
    return errors._replace(verdict=verdict)


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
    estimated, the sandwich.

    Args:
        problem: what was fitted.
        at: the optimum.
        e: what it tells.
        before: the verdict at the first guess, which stands where the optimum has no Jacobian.
        around: what is known of points other than the optimum.
        white: whether the residuals are white and independent between outputs.
    """
    layout, estimator = at.layout, at.layout.estimator
    usable = bool(np.all(np.isfinite(e.J)) and np.all(np.isfinite(e.r)))
    # The noise is estimated from the same residuals: Student's t, not the normal distribution.
    freedom = max(estimator.numbers(layout, at.data, at.noise) - layout.determined, 1)
    quantile = float(scipy.special.stdtrit(freedom, 0.975))
    quantiles = np.full(layout.size, quantile)
    # Rows that are dependent under white noise too say nothing by the residuals' whiteness.
    white = white and estimator.rows_are_white
    if white or not (usable and estimator.rows_are_samples):
        verdict = verdict_of(problem, layout, e, around=around) if usable else before
        # Weighed by the noise's own spectrum, the bound allows for it as it stands.
        allowed = usable and not white and estimator.noise_spectrum
        return StandardErrors(verdict, np.ones(layout.size), quantiles, allowed)
    errors = sandwich(layout, at.data, e, residual_curvature(layout, at.data, at.noise, at.z))
    # Few independent parts of a spectrum tell a variance poorly; never better than all samples.
    quantiles = np.maximum(errors.quantile(), quantile)
    # The rule of the factor of ten has to see the intervals that are reported.
    reported = _reported(errors, layout, quantiles)
    verdict = verdict_of(problem, layout, e, reported, around)
    verdict = _widened(verdict, errors, _along(verdict, layout, e))
    wide = frozenset(c.name for c in verdict.combinations if not c.is_bounded)
    if wide:
        around = around._replace(open_combinations=wide)
        verdict = verdict_of(problem, layout, e, reported, around)
        verdict = _widened(verdict, errors, _along(verdict, layout, e))
    return StandardErrors(verdict, errors.inflation(), quantiles, True)


def _along(verdict: Verdict, layout: Layout, e: Evaluation) -> np.ndarray:
    """The verdict's combinations, of products the logarithms, as directions (k, q) of the
    unknowns."""
    # d log p / dz: products of powers are sums in logarithms, and z is either the logarithm itself
    # or, with bounds or a free sign, another coordinate.
    along = np.zeros((len(verdict.combinations), layout.size))
    for k, c in enumerate(verdict.combinations):
        for name, power in c.exponents.items():
            i = layout.of_interest.index(name)
            along[k, i] = power * e.slopes[i] / (e.named[i] if c.kind == "product" else 1.0)
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
    combinations = tuple(
        _wider(c, float(w), float(r))
        for c, w, r in zip(verdict.combinations, wider, reach, strict=True)
    )
    return replace(verdict, combinations=combinations)


def _wider(c: Combination, sd: float, reach: float) -> Combination:
    """A combination with its sd and the reach of its interval multiplied."""

    def end(at: float) -> float:
        # The ends of an interval of a product lie at equal factors, not distances.
        if c.kind == "product":
            # In logarithms, as an interval of a product may reach past what a float64 holds.
            if not (at > 0.0 and c.value > 0.0 and math.isfinite(at) and math.isfinite(c.value)):
                return at
            log = math.log(c.value) + reach * (math.log(at) - math.log(c.value))
            return math.exp(log) if log < _LARGEST else math.inf
        return c.value + (at - c.value) * reach

    return c._replace(sd=c.sd * sd, lower95=end(c.lower95), upper95=end(c.upper95))
