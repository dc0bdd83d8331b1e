"""Output error whose residuals are coloured, beside a method that weighs by the noise's spectrum.

In gusts output error is consistent and poorly weighed: it explains slow drift by slow modes, and
intervals that allow for the residuals' colour do so for the optimum that was found, which such
drift may have made. Frequency error, with the noise's spectrum estimated, has no such optimum. An
efficient estimate and an inefficient one of the same parameter differ by less than the inefficient
one's own interval where both are consistent: their difference has the variance of the one less that
of the other (Hausman, 1978). So where they lie further apart the intervals do not hold.

Source: J. A. Hausman, Specification tests in econometrics, Econometrica 46 (1978).
"""

import dataclasses
from collections.abc import Callable

from heli_jax.identification.fit import fit
from heli_jax.identification.methods import METHODS
from heli_jax.identification.problem import Problem
from heli_jax.identification.result import Estimate, Fit, SecondMethod

_METHOD = "frequency-error"
_WELL_EXPLAINED = 0.95
"""VAF of every output from which on a disturbance is too small to make an optimum of its own"""
_APART = 3.3
"""output error's standard deviations that chance takes an estimate from the other in one of 1000"""


def with_second_method(
    problem: Problem,
    found: Fit,
    *,
    max_steps: int = 200,
    progress: Callable[[str], None] | None = None,
) -> Fit:
    """The fit, with the parameters on which frequency error does not bear it out.

    Asked of output error alone, where disturbances colour its residuals and take a good part of an
    output, of linear models whose inputs do not follow the response.

    Args:
        problem: what was fitted.
        found: the fit.
        max_steps: of the other method's optimiser.
        progress: called with a line of text before the work.
    """
    if not _is_asked(problem, found):
        return found
    if progress is not None:
        progress(f"the residuals are coloured: the same by {METHODS[_METHOD].label}")
    try:
        other = fit(
            dataclasses.replace(problem, method=_METHOD, window=None, continuity=None),
            max_steps=max_steps,
        )
    except ValueError:
        # It takes fewer problems than output error does; nothing is said then.
        return found
    if other.status == "not-converged" or other.untrusted:
        return found
    estimates = {
        n: _interval(other.estimates[n])
        for n, a in found.estimates.items()
        if _apart(a, other.estimates[n])
    }
    second = SecondMethod(METHODS[_METHOD].label, estimates)
    notes = (*found.notes, sentence(second)) if estimates else found.notes
    return dataclasses.replace(found, second_method=second, notes=notes)


def _is_asked(problem: Problem, found: Fit) -> bool:
    if problem.method != "output-error" or found.status == "not-converged" or not found.coloured:
        return False
    # What is wrong with the record, or explains nothing of it, is said by itself.
    if found.untrusted or found.adequacy.by_chance or not problem.model.linear:
        return False
    vafs = [m.vaf for m in found.metrics.values()]
    return bool(vafs) and not min(vafs) >= _WELL_EXPLAINED


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


def sentence(second: SecondMethod) -> str:
    """For the notes of a fit.

    Args:
        second: with a parameter at least that it does not bear out.
    """
    each = ", ".join(
        f"{n} not determined" if v is None else f"{n} {v[0]:.3g} (95 % {v[1]:.3g} to {v[2]:.3g})"
        for n, v in second.estimates.items()
    )
    return (
        f"Weighed by the spectrum of what disturbs the record, by {second.label}: {each}. That is "
        "not within what output error's intervals allow: it takes slow drift for slow modes, and "
        "what the model lacks for parameters. Fit with method: frequency-error, or filter-error "
        "with a disturbance."
    )
