"""The simplest vehicle, p' = Lp p + Ld d: as a model, and its response by SciPy."""

from typing import Annotated, NamedTuple

import numpy as np
import scipy.signal

from heli_jax import Model
from heli_jax.naming import Scalar


class Params(NamedTuple):
    Lp: Annotated[Scalar, "1/s", "damping"]
    Ld: Annotated[Scalar, "1/s^2", "effectiveness"]


class Rate(NamedTuple):
    p: Annotated[Scalar, "rad/s", "rate"]


class Inputs(NamedTuple):
    d: Annotated[Scalar, "1", "stick"]


LAG = Model(
    "lag",
    lambda q, x, u: Rate(p=q.Lp * x.p + q.Ld * u.d),
    lambda q, x, u: Rate(p=x.p),
    Params, Rate, Inputs, Rate, linear=True,
)  # fmt: skip


def response(Lp: float, Ld: float, d: np.ndarray, dt: float) -> np.ndarray:
    """Return p (N,) from rest, with a held input."""
    b, a, _ = scipy.signal.cont2discrete(([Ld], [1.0, -Lp]), dt)
    return np.asarray(scipy.signal.lfilter(np.ravel(b), a, d))
