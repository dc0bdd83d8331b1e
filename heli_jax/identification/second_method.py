"""A fit of a disturbed record, beside a method that weighs by the noise's spectrum.

In gusts output error is consistent and poorly weighed: it explains slow drift by slow modes, and
intervals that allow for the residuals' colour do so for the optimum that was found, which such
drift may have made. Frequency error, with the noise's spectrum estimated, has no such optimum. An
efficient estimate and an inefficient one of the same parameter differ by less than the inefficient
one's own interval where both are consistent: their difference has the variance of the one less that
of the other (Hausman, 1978). So where they lie further apart the intervals do not hold.

Filter error is the efficient one where the disturbance acts as its model says. Where it does not
(it acts elsewhere, has another spectrum, a vane measures the gust with the motion), frequency
error, which takes its spectrum from the record, stays consistent.

Source: J. A. Hausman, Specification tests in econometrics, Econometrica 46 (1978).
"""

import dataclasses
import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from heli_jax.finding import Finding
from heli_jax.identification.estimation.evaluation import deviations, evaluate
from heli_jax.identification.fit import fit
from heli_jax.identification.identifiability.through_inputs import through_inputs
from heli_jax.identification.methods import METHODS
from heli_jax.identification.problem import Problem
from heli_jax.identification.result import Estimate, Fit, concluded
from heli_jax.identification.validation.borne_out import by_the_inputs

_METHOD, SECOND_METHOD = "frequency-error", "agreement.second-method"
_WELL_EXPLAINED = 0.95
"""VAF of every output from which on a disturbance is too small to make an optimum of its own"""
_APART = 3.3
"""standard deviations that chance takes two estimates apart in one of 1000: of output error, and of
the difference between the consistent estimate and filter error's"""
_DOUBTED = 2.2
"""the same that chance takes them apart in one of 36, from which on a reader should know of it"""
_HAS_A_SAY = 1.02
"""factor between standard deviations by the inputs alone and by all, above which a wrong
disturbance moves estimates by their standard deviation: gusts of two time constants did at 1.025"""
_LEAST = 0.25
"""part of the consistent estimate's variance that its difference from the efficient one has at
least: both variances are estimates, and neither method attains its bound"""
_NORMAL = 1.96
"""standard deviations to the end of a 95 % interval"""
_OF_OUTPUT_ERROR = (
    "That is not within what output error's intervals allow: it takes slow drift for slow modes, "
    "and what the model lacks for parameters. Fit with method: frequency-error, or filter-error "
    "with a disturbance."
)
_OF_FILTER = (
    "That excludes filter error's values: the disturbance acts elsewhere than is stated, has "
    "another spectrum or reaches a sensor, and the parameters make up for it. Fit with method: "
    "frequency-error, or another disturbance (on, poles; fit.compare: true lays them side by side)."
)


def with_second_method(
    problem: Problem,
    first: Fit,
    *,
    undisturbed: Callable[[], Problem] | None = None,
    max_steps: int = 200,
    progress: Callable[[str], None] | None = None,
) -> Fit:
    """The fit, with the parameters on which frequency error does not bear it out.

    Asked of linear models whose inputs do not follow the response: of output error where
    disturbances colour its residuals and take a good part of an output, of filter error where the
    answer to the inputs, by itself, asks for other values, or where the disturbance narrows an
    interval by a fiftieth.

    Args:
        problem: what was fitted.
        first: the fit.
        undisturbed: of filter error, makes the problem by the other method, without a disturbance.
        max_steps: of the other method's optimiser.
        progress: called with a line of text before the work.
    """
    question = _QUESTIONS.get(problem.method)
    filtered = problem.method == "filter-error"
    if question is None or (filtered and undisturbed is None) or _is_doubtful(problem, first):
        return first
    if not question.is_asked(first):
        return first
    if progress is not None:
        progress(f"{question.why}: the same by {METHODS[_METHOD].label}")
    try:
        if filtered and undisturbed is not None:
            other = undisturbed()
        else:
            other = dataclasses.replace(problem, method=_METHOD, window=None, continuity=None)
        other = fit(other, max_steps=max_steps)
    except ValueError:
        # It takes fewer problems than output error does; nothing is said then.
        return first
    if other.status == "not-converged" or other.untrusted:
        return first
    apart = [n for n, a in first.estimates.items() if question.is_apart(a, other.estimates[n])]
    code, why, named = SECOND_METHOD, question.remedy, apart
    if not apart and filtered:
        pairs = ((n, a, other.estimates[n]) for n, a in first.estimates.items())
        code, why = "agreement.second-method-doubt", _OF_DOUBT
        named = [n for n, a, b in pairs if _excluded(a, b, _DOUBTED)]
    if not named:
        return first
    found = _finding(code, first, other, named, why)
    if apart:
        # One estimate of a wrong optimum is as wrong as another.
        every = tuple(n for n, e in first.estimates.items() if e.sd is not None)
        found = found._replace(severity="doubt", distrusts=every)
    return concluded(dataclasses.replace(first, findings=(*first.findings, found)))


def _finding(code: str, first: Fit, other: Fit, names: list[str], why: str) -> Finding:
    """A note of what the other method has instead, in parameters that it does not bear out."""
    label, words = METHODS[_METHOD].label, []
    for n in names:
        v = _interval(other.estimates[n])
        words.append(
            f"{n} not determined"
            if v is None
            else f"{n} {v[0]:.3g} (95 % {v[1]:.3g} to {v[2]:.3g})"
        )
    sentence = (
        f"Weighed by the spectrum of what disturbs the record, by {label}: {', '.join(words)}. "
        f"{why}"
    )
    knows = "any gusts" if first.method == "filter-error" else "gusts"
    brief = f"{label}, which allows for {knows}, has other values of {', '.join(names)}"
    return Finding(code, "note", sentence, subjects=tuple(names), brief=brief)


def _is_doubtful(problem: Problem, first: Fit) -> bool:
    """Whether what is wrong with the record, or explains nothing of it, is said by itself, or the
    model is none that the other method takes as it is."""
    if first.status == "not-converged" or not problem.model.linear:
        return True
    return bool(first.untrusted) or first.adequacy.by_chance


def _is_disturbed(first: Fit) -> bool:
    """Whether disturbances colour output error's residuals and take a good part of an output."""
    vafs = [m.vaf for m in first.metrics.values()]
    return first.coloured and bool(vafs) and not min(vafs) >= _WELL_EXPLAINED


def _may_be_misled(first: Fit) -> bool:
    """Whether filter error's estimates are others than the inputs ask for, or the disturbance has
    a say in one of them: a wrong one then misleads."""
    if first.adequacy.ahead or any(f.present for f in first.feedback):
        return False
    at = first.reached
    e = evaluate(*at)
    inputs = through_inputs(at, e)
    k = len(at.layout.free)
    if inputs is not None and np.any(deviations(inputs.J)[:k] > _HAS_A_SAY * deviations(e.J)[:k]):
        return True
    return not by_the_inputs(at, e)


def _interval(b: Estimate) -> tuple[float, float, float] | None:
    """An estimate and the ends of its interval; None where it is not determined."""
    if b.sd is None or b.lower95 is None or b.upper95 is None:
        return None
    return b.value, b.lower95, b.upper95


def _apart(a: Estimate, b: Estimate) -> bool:
    """Whether output error's estimate of a parameter is one that the other method's excludes."""
    if not a.sd:
        return False
    interval = _interval(b)
    if interval is None:
        # What the efficient one does not determine the other has by an optimum of chance.
        return True
    value, low, high = interval
    return abs(value - a.value) > _APART * a.sd and not low <= a.value <= high


def _excluded(a: Estimate, b: Estimate, apart: float = _APART) -> bool:
    """Whether filter error's estimate is one that the other's excludes, by so many standard
    deviations of their difference: that has the variance of the other less that of filter error."""
    interval, filtered = _interval(b), _interval(a)
    # What it does not determine itself it has nothing against.
    if not a.sd or not b.sd or interval is None or filtered is None:
        return False
    value, low, high = interval
    if filtered[1] <= value <= filtered[2]:
        return False
    sd = (value - low if a.value < value else high - value) / _NORMAL
    return abs(a.value - value) > apart * sd * math.sqrt(max(_LEAST, 1.0 - (a.sd / b.sd) ** 2))


_OF_DOUBT = (
    "Filter error's value lies further from that than the two methods should: its interval holds "
    "if the disturbance is as it is stated (one correlation time, where it acts), the other one in "
    "any case."
)


class _Question(NamedTuple):
    """What is asked of a fit by one method."""

    is_asked: Callable[[Fit], bool]
    why: str
    """it is, in words"""
    is_apart: Callable[[Estimate, Estimate], bool]
    """of its estimate, and of the other method's"""
    remedy: str


_QUESTIONS = {
    "output-error": _Question(
        _is_disturbed, "the residuals are coloured", _apart, _OF_OUTPUT_ERROR
    ),
    "filter-error": _Question(
        _may_be_misled, "the disturbance may have misled it", _excluded, _OF_FILTER
    ),
}
