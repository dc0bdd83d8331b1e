"""Frequency responses of a linearised model, frequency by frequency."""

from collections.abc import Callable
from typing import Any

import numpy as np

from heli_jax import naming
from heli_jax.analysis.linear import linearize
from heli_jax.analysis.operating_point import EVERYWHERE, OperatingPoint


def continuous(
    model: Any, params: Any, output: str, input: str, at: OperatingPoint = EVERYWHERE
) -> Callable[[np.ndarray], np.ndarray]:
    """H(i omega) from an input to an output, with the input's delay."""
    A, B, C, D = (np.asarray(M) for M in linearize(model, params, at.state, at.inputs).matrices)
    i, j = naming.names(model.Outputs).index(output), naming.names(model.Inputs).index(input)
    delay = dict(model.delays).get(input)
    late = 0.0 if delay is None else float(np.asarray(getattr(params, delay)))

    def response(omega: np.ndarray) -> np.ndarray:
        points = [C[i] @ np.linalg.solve(1j * w * np.eye(len(A)) - A, B[:, j]) for w in omega]
        return (np.array(points) + D[i, j]) * np.exp(-1j * omega * late)

    return response
