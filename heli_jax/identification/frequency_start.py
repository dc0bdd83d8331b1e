"""Start values for a fit in time from a fit by frequency error.

Far from its optimum the cost in time has local minima and plateaus, and simulations of an unstable
vehicle overflow. The cost in frequency needs no simulation.
"""

import dataclasses
import time
from typing import NamedTuple

from heli_jax.finding import Finding, found
from heli_jax.identification.equation_error.start import StartValue, reasons_of
from heli_jax.identification.fit import fit
from heli_jax.identification.problem import Problem
from heli_jax.identification.result import Status


class FrequencyErrorStart(NamedTuple):
    """Start values, and the fit they come from."""

    values: dict[str, StartValue]
    status: Status
    """Status of the fit in frequency."""
    seconds: float
    """Processing time [s]."""
    notes: tuple[str, ...]
    """Notes of the fit in frequency."""

    @property
    def findings(self) -> list[Finding]:
        """Notes on the start values."""
        taken = [n for n, v in self.values.items() if v.origin == "frequency error"]
        run = {"status": self.status, "seconds": self.seconds}
        if not taken:
            reasons = list(dict.fromkeys(v.reason for v in self.values.values() if v.reason))
            return [found("start.frequency-error-failed", "note", reasons=reasons, **run)]
        out = [found("start.frequency-error", "note", names=taken, **run)]
        return out + reasons_of(self.values)


def frequency_error_start(problem: Problem, *, max_steps: int = 200) -> FrequencyErrorStart:
    """Return start values of the free parameters from a fit of the same flights in frequency.

    Args:
        problem: a problem for frequency error, without a disturbance.

    Raises:
        ValueError: frequency error cannot solve it, with the reason.
    """
    began = time.perf_counter()
    first = fit(dataclasses.replace(problem, flights=problem.training), max_steps=max_steps)
    # If there are several solutions, each is a good start.
    of_several = {n for other in first.verdict.second for n in other.changed}
    values = {}
    for name, e in first.estimates.items():
        if first.status == "not-converged":
            reason = "frequency error did not converge"
        elif e.sd is None and name not in of_several:
            reason = "the spectra do not determine them"
        else:
            reason = "frequency error ended at their bounds" if e.at_bound else ""
        values[name] = StartValue(e.value, e.unit, "frequency error", "")
        if reason:
            stated = problem.free[name].start
            values[name] = StartValue(stated, e.unit, "as stated", reason)
    return FrequencyErrorStart(values, first.status, time.perf_counter() - began, first.notes)


def started(problem: Problem, guess: FrequencyErrorStart) -> Problem:
    """Return the problem with the guess as its start values."""
    free = dict(problem.free)
    free |= {n: free[n]._replace(start=v.value) for n, v in guess.values.items() if n in free}
    return dataclasses.replace(problem, free=free, first_guess=guess)
