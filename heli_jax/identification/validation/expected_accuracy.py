"""What expected standard deviations rest on, in words: on the noise, which may be guessed."""

from collections.abc import Sequence

import numpy as np

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
