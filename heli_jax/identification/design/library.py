"""Manoeuvres of the library of excitations, as candidates for a flight."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from heli_jax.simulation.inputs import Shape, excitation

_STEPS = (0.1, 0.2, 0.5, 1.0)
"""Shortest steps of a candidate [s]."""
_BANDS = ((0.1, 2.0), (0.1, 5.0), (0.1, 10.0))
"""Frequencies of a candidate [Hz]."""
_STEPPED = {
    "doublet": ("doublets of {:g} s", 3),
    "3-2-1-1": ("3-2-1-1 steps of {:g} s", 8),
    "prbs": ("a binary sequence of {:g} s", 5),
}
"""Words, and the number of shortest steps that a manoeuvre takes with its pause."""
_SWEPT = {"chirp": "a chirp", "multisine": "a multisine"}


class Manoeuvre(NamedTuple):
    """A kind of excitation with its settings."""

    words: str
    """Such as `3-2-1-1 steps of 0.5 s`."""
    kind: str
    shape: Shape

    def samples(
        self, n: int, dt: float, rates: Sequence[float] = (np.inf,)
    ) -> Float[np.ndarray, "i n"]:
        """Return the samples of several inputs, with deflections of at most 1.

        Inputs move together if their motions are independent, else one after another.

        Args:
            rates: largest rate of each input [deflection/s].
        """
        number = len(rates)
        together = self.kind in ("multisine", "prbs", "random-steps")
        length, u = (n if together else n // number), np.zeros((number, n))
        for i, rate in enumerate(rates):
            # One generator per input: two binary sequences of one seed would be equal.
            rng = np.random.default_rng(i)
            shape = self.shape._replace(place=(i, number) if together else (0, 1))
            begin = 0 if together else i * length
            u[i, begin : begin + length] = excitation(self.kind, length, dt, rng, shape, rate=rate)
        return u


QUICK = ("doublet", "3-2-1-1", "chirp")
"""Kinds that need no library of signals and no optimisation: for every `check`."""


def manoeuvres(
    inputs: int, duration: float, dt: float, kinds: Sequence[str] | None = None
) -> list[Manoeuvre]:
    """Return the manoeuvres that a flight has time for.

    Args:
        inputs: number of inputs.
        duration: duration of the flight [s].
        kinds: kinds of excitation; None: all.
    """
    found = [
        Manoeuvre(words.format(step), kind, Shape(step=step, pause=step))
        for kind, (words, takes) in _STEPPED.items()
        for step in _STEPS
        if 2.0 * dt <= step and takes * step <= duration / inputs
    ]
    for low, high in _BANDS:
        # The lowest line has a period in the record, and each input a line of its own.
        low = max(low, inputs / duration)
        if 2.0 * low < high <= 0.2 / dt:
            for kind, words in _SWEPT.items():
                words = f"{words} from {low:.2g} to {high:.2g} Hz"
                found.append(Manoeuvre(words, kind, Shape(band=(low, high))))
    found.append(Manoeuvre("random steps of 0.3 to 2 s", "random-steps", Shape()))
    return [one for one in found if kinds is None or one.kind in kinds]
