"""Frequency responses of a linearised model, one frequency at a time."""

from collections.abc import Callable
from typing import Any

import numpy as np

from heli_jax import linearize, naming
from heli_jax.analysis.operating_point import EVERYWHERE, OperatingPoint


def continuous(
    model: Any, params: Any, output: str, input: str, at: OperatingPoint = EVERYWHERE
) -> Callable[[np.ndarray], np.ndarray]:
    """Return H(i omega) from an input to an output, with the input's delay."""
    A, B, C, D = (np.asarray(M) for M in linearize(model, params, at.state, at.inputs).matrices)
    i, j = naming.names(model.Outputs).index(output), naming.names(model.Inputs).index(input)
    delay = dict(model.delays).get(input)
    late = 0.0 if delay is None else float(np.asarray(getattr(params, delay)))

    def response(omega: np.ndarray) -> np.ndarray:
        points = [C[i] @ np.linalg.solve(1j * w * np.eye(len(A)) - A, B[:, j]) for w in omega]
        return (np.array(points) + D[i, j]) * np.exp(-1j * omega * late)

    return response


def polynomials(model: Any, params: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return num and den from the only input to the first output of a linear model (Leverrier)."""
    A, B, C, _ = (np.asarray(M) for M in linearize(model, params).matrices)
    den, v, num = np.poly(A), B[:, 0], []
    for k in range(len(A)):
        num.append(C[0] @ v)
        v = A @ v + den[k + 1] * B[:, 0]
    return np.array(num), den
