"""A first guess of a problem's parameters by frequency error, for a fit in time.

The misfit in time has valleys and plateaus far from its optimum, and an unstable vehicle's
simulation overflows there; the one in frequency simulates nothing.
"""

import dataclasses
import time
from typing import NamedTuple

from heli_jax.finding import Finding, found
from heli_jax.identification.equation_error.start import StartValue, reasons_of
from heli_jax.identification.fit import fit
from heli_jax.identification.problem import Problem
from heli_jax.identification.result import Estimate, Status


class FrequencyErrorStart(NamedTuple):
    """First guesses, and how they were found."""

    values: dict[str, StartValue]
    status: Status
    """of the fit in frequency"""
    seconds: float
    """that it took"""
    notes: tuple[str, ...]
    """of the fit in frequency"""
    selection: None = None
    """no stepwise selection of terms"""

    @property
    def findings(self) -> list[Finding]:
        """The source of one start value."""
        taken = [n for n, v in self.values.items() if v.origin == "frequency error"]
        run = {"status": self.status, "seconds": self.seconds}
        if not taken:
            reasons = list(dict.fromkeys(v.reason for v in self.values.values() if v.reason))
            return [found("start.frequency-error-failed", "note", reasons=reasons, **run)]
        out = [found("start.frequency-error", "note", names=taken, **run)]
        if several := [n for n in taken if self.values[n].sd is None]:
            out.append(found("start.several-solutions", "note", names=several))
        return out + reasons_of(self.values)


def frequency_error_start(problem: Problem, *, max_steps: int = 200) -> FrequencyErrorStart:
    """First guesses of the free parameters, by a fit of the same flights in frequency.

    Gains and time shifts are not among them: a fit in time searches these by itself.

    Args:
        problem: of frequency error, without a disturbance, whose states a spectrum of the noise
            stands for.

    Raises:
        ValueError: frequency error cannot solve it; the sentence says why.
    """
    began = time.perf_counter()
    # Flights held out are predicted by the fit that follows.
    first = fit(dataclasses.replace(problem, flights=problem.training), max_steps=max_steps)
    # Any of several solutions is as good a start as the only one would be.
    of_several = {n for other in first.verdict.second for n in other.changed}
    values = {
        name: _value(
            estimate, first.status, problem.free[name].start, of_several=name in of_several
        )
        for name, estimate in first.estimates.items()
    }
    return FrequencyErrorStart(values, first.status, time.perf_counter() - began, first.notes)


def started(problem: Problem, guess: FrequencyErrorStart) -> Problem:
    """The problem with the guess for its starts."""
    free = {
        n: f._replace(start=guess.values[n].value) if n in guess.values else f
        for n, f in problem.free.items()
    }
    return dataclasses.replace(problem, free=free, first_guess=guess)


def _value(
    estimate: Estimate, status: Status, stated: float, *, of_several: bool = False
) -> StartValue:
    reason = ""
    if status == "not-converged":
        reason = "frequency error did not converge"
    elif estimate.sd is None and not of_several:
        reason = "the spectra do not determine them"
    elif estimate.at_bound:
        reason = "frequency error ended at their bounds"
    if reason:
        return StartValue(stated, None, estimate.unit, "as stated", reason)
    return StartValue(estimate.value, estimate.sd, estimate.unit, "frequency error", "")
