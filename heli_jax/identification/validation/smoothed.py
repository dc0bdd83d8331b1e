"""Outputs that have no noise of a sensor, as a finding."""

from collections.abc import Sequence

import numpy as np

from heli_jax.finding import Finding
from heli_jax.flights.flight import Flight
from heli_jax.identification.estimation.noiseless_outputs import (
    REMEDY,
    noiseless,
    noiseless_words,
)
from heli_jax.numerics.white_noise import noise_guess

_LIMIT = "white part over the output's sd, 1e-4"


def smoothed(flights: Sequence[tuple[str, Flight]], *, process_noise: bool) -> list[Finding]:
    """One sentence for each flight that has outputs without noise.

    Args:
        flights: by what each is called.
        process_noise: whether the method holds predictions against the noise of the outputs.
    """
    findings = []
    for label, flight in flights:
        without = {n: flight.outputs[n] for n in noiseless(flight.outputs)}
        if not without:
            continue
        part = max(noise_guess(y) / float(np.nanstd(y)) for y in without.values())
        words = f"{label}: {noiseless_words(without, flight.dt)}; nothing faster is in it."
        if process_noise:
            words = f"{words} {REMEDY}"
        findings.append(
            Finding("quality.smoothed", "doubt" if process_noise else "note", words, part, _LIMIT)
        )
    return findings
