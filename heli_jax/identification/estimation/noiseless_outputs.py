"""Outputs that have no noise of a sensor: they were low-passed before they were logged."""

from collections.abc import Mapping

import numpy as np

from heli_jax.numerics.white_noise import highest_frequency, without_noise

REMEDY = (
    "Filter error holds its predictions against white noise, of which there is none, and the noise "
    "that it estimates runs to zero: use output-error, whose intervals allow for autocorrelated "
    "residuals."
)


def noiseless(outputs: Mapping[str, np.ndarray]) -> list[str]:
    """Which outputs (N,) have no noise of a sensor; NaN is missing."""
    return [n for n, y in outputs.items() if without_noise(y)]


def noiseless_words(outputs: Mapping[str, np.ndarray], dt: float) -> str:
    """What outputs without noise are, and how fast what is in them.

    Args:
        outputs: those without noise, one at least (N,).
        dt: from sample to sample [s].
    """
    names = list(outputs)
    listed = ", ".join(names[:-1]) + " and " + names[-1] if len(names) > 1 else names[0]
    verb, it = ("have", "they were") if len(names) > 1 else ("has", "it was")
    highest = [f for y in outputs.values() if (f := highest_frequency(y, dt)) is not None]
    band = f" (99.9 % of the power lies below {max(highest):.2g} Hz)" if highest else ""
    return (
        f"{listed} {verb} no noise of a sensor: {it} low-passed before the log{band}, or simulated"
    )
