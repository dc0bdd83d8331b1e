"""What fit.json holds of other methods: a start in frequency, and methods side by side."""

from typing import Any

from heli_jax.finding import as_data
from heli_jax.identification.frequency_start import FrequencyErrorStart
from heli_jax.identification.method_comparison import MethodComparison
from heli_jax.identification.problem import Problem
from heli_jax.report.fit_content import parameter


def frequency_start_content(problem: Problem) -> dict[str, Any] | None:
    """What a fit in frequency found to begin with."""
    guess = problem.first_guess
    if not isinstance(guess, FrequencyErrorStart):
        return None
    return {
        "status": guess.status,
        "seconds": guess.seconds,
        "values": {n: v._asdict() for n, v in guess.values.items()},
        "sentences": list(guess.sentences),
        "notes": list(guess.notes),
    }


def methods_content(comparison: MethodComparison | None) -> dict[str, Any] | None:
    """By method its estimates, and how far they are from those of the first."""
    if comparison is None:
        return None
    results = {}
    for r in comparison.results:
        found = {n: comparison.estimate(r, n) for n in comparison.names}
        estimates = {n: e for n, e in found.items() if e is not None}
        results[r.method] = {
            "status": "refused" if r.fit is None else r.fit.status,
            "verdict": r.word,
            "reason": r.reason or None,
            "seconds": r.seconds,
            "parameters": {n: parameter(e) for n, e in estimates.items()},
            "difference_joint_sd": {n: comparison.difference(r, n) for n in estimates},
            "findings": [] if r.fit is None else [as_data(f) for f in r.fit.findings],
        }
    return {"results": results, "sentences": list(comparison.sentences)}
