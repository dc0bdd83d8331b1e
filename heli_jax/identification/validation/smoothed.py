"""Outputs that have no noise of a sensor, as a finding."""

import numpy as np

from heli_jax.identification.estimation.noiseless_outputs import (
    REMEDY,
    noiseless,
    noiseless_words,
)
from heli_jax.identification.methods import estimator_of
from heli_jax.identification.problem import Problem
from heli_jax.identification.unknowns.nuisances import labels
from heli_jax.identification.validation.finding import Finding
from heli_jax.numerics.white_noise import noise_guess

_LIMIT = "white part over the output's sd, 1e-4"


def smoothed(problem: Problem) -> list[Finding]:
    """One sentence for each flight that has outputs without noise.

    Args:
        problem: with its flights.
    """
    found = []
    for label, flight in zip(labels(problem.training), problem.training, strict=True):
        without = {n: flight.outputs[n] for n in noiseless(flight.outputs)}
        if not without:
            continue
        part = max(noise_guess(y) / float(np.nanstd(y)) for y in without.values())
        words = f"{label}: {noiseless_words(without, flight.dt)}; nothing faster is in it."
        severity = "note"
        if estimator_of(problem.method).process_noise:
            severity, words = "doubt", f"{words} {REMEDY}"
        found.append(Finding("smoothed", severity, words, part, _LIMIT))
    return found
