"""What expected standard deviations rest on, in words: on the noise, which may be guessed."""

import math
from collections.abc import Sequence

import numpy as np

from heli_jax import naming
from heli_jax.dynamics.disturbance import disturbances_of
from heli_jax.finding import Finding, note
from heli_jax.identification.methods import estimator_of
from heli_jax.identification.problem import Problem
from heli_jax.identification.unknowns.layout import Solution, unpack
from heli_jax.identification.unknowns.transforms import scale

GUESSED = "guessed: too small where the log was smoothed; state the output's sd"
"""of a noise that nobody stated"""
_TOO_GOOD = 1e-3
"""relative sd below which no parameter of a helicopter is known: models and sensors are worse"""
_WORTH_DOUBT = 0.1
"""relative sd above which nobody takes an expectation for a promise"""


def too_good(
    sds: Sequence[float] | np.ndarray, guessed: bool, *, nothing_follows: bool = False
) -> str:
    """A sentence where expected sds are too small to be true; empty where they are not.

    Args:
        sds: relative.
        guessed: whether noise was guessed.
        nothing_follows: whether no output was found to follow any input.
    """
    if nothing_follows and len(sds) and float(np.min(sds)) < _WORTH_DOUBT:
        return (
            f"An expected sd of {100 * float(np.min(sds)):.2g} % is no promise: it takes for "
            "granted that the outputs answer the inputs as the model has it, and no output "
            "follows any input in this record."
        )
    if not guessed or not len(sds) or float(np.min(sds)) >= _TOO_GOOD:
        return ""
    return (
        f"An expected sd of {100 * float(np.min(sds)):.2g} % is no promise: the noise was guessed "
        "from differences between samples, and is far too small where the log was smoothed or "
        "simulated; state the outputs' sd. Compare such numbers with one another alone."
    )


def starting_at_zero(problem: Problem) -> dict[str, tuple[float, str]]:
    """By free parameter that starts at zero the size [SI] that its expected sd is relative to, and
    its unit: of zero itself nothing is a part.

    Args:
        problem: what is to be fitted.
    """
    return {
        n: (scale(f), naming.unit(problem.model.Params, n) or "1")
        for n, f in problem.free.items()
        if f.start == 0
    }


def unstated_gusts(problem: Problem) -> list[str]:
    """The names of the sizes of disturbances that nobody stated; none without process noise.

    Args:
        problem: with its vehicle, where a size may be stated.
    """
    if not estimator_of(problem.method).process_noise:
        return []
    sizes = [d.sigma for d in disturbances_of(problem.model)]
    return [n for n in sizes if not _is_stated(float(getattr(problem.vehicle, n)))]


def guessed_gusts(problem: Problem, at: Solution) -> list[Finding]:
    """A note where the disturbances' size is what the record says at the start values.

    Args:
        problem: with its vehicle, where a size may be stated.
        at: the start values.
    """
    guessed = unstated_gusts(problem)
    if not guessed:
        return []
    taken = unpack(at.layout, at.data, at.z).noise
    units = {n: naming.unit(problem.model.Params, n) or "" for n in guessed}
    sizes = " and ".join(f"{n} of {float(taken[n]):.2g} {units[n]}".rstrip() for n in guessed)
    words = (
        f"Nobody stated {' and '.join(guessed)}: the expected sds are for {sizes}, the likeliest "
        "at the start values, where whatever these do not explain is taken for gusts. A fit "
        "estimates it; method: output-error shows the other end, no gusts at all."
    )
    return [note("noise.gusts-guessed", words, *guessed)]


def _is_stated(value: float) -> bool:
    return math.isfinite(value) and value > 0.0
