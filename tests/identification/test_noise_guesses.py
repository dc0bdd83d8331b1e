"""Several outputs: the optimum must not depend on the first guess of their noise.

The records come from SciPy's transfer functions, not from our own simulation.
"""

from typing import Annotated, Any, NamedTuple

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.signal

from heli_jax import Flight, Free, Model, Nuisance, Problem, fit
from tests.identification.bench import steps


class Mode(NamedTuple):
    w: Annotated[Any, "rad/s"]
    b: Annotated[Any, "1/s^2"]


class Motion(NamedTuple):
    x: Annotated[Any, "rad"]
    v: Annotated[Any, "rad/s"]
    lag: Annotated[Any, "rad"]


class Push(NamedTuple):
    u: Annotated[Any, "1"]


class Seen(NamedTuple):
    x: Annotated[Any, "rad"]
    lag: Annotated[Any, "rad"]


def field(q: Any, s: Motion, u: Push) -> Motion:
    # A lightly damped mode, whose likelihood has an optimum at every beat of w, and a lag that
    # depends on w without any.
    return Motion(s.v, q.b * u.u - q.w**2 * s.x - 0.04 * q.w * s.v, u.u - 0.1 * q.w * s.lag)


MODEL = Model(
    "mode and lag", field, lambda q, s, u: Seen(s.x, s.lag), Mode, Motion, Push, Seen,
    linear=True, start=lambda q: Motion(0.0 * q.b, 0.0 * q.b, 0.0 * q.b),
)  # fmt: skip
N, DT, W = 1000, 0.02, 4.0


def problem(seed, start):
    rng = np.random.default_rng(seed)
    u = steps(rng, N, DT, 1.0)

    def response(num, den):
        b, a, _ = scipy.signal.cont2discrete((num, den), DT)
        return scipy.signal.lfilter(np.ravel(b), a, u)

    x = response([1.0], [1.0, 0.04 * W, W**2])
    lag = response([1.0], [1.0, 0.1 * W])
    x = x + 1e-4 * x.std() * rng.standard_normal(N)
    lag = lag + 0.02 * lag.std() * rng.standard_normal(N)
    flight = Flight(dt=DT, inputs={"u": u}, outputs={"x": x, "lag": lag})
    params = Mode(jnp.asarray(W), jnp.asarray(1.0))
    free = {"w": Free(start), "b": Free(0.5)}
    return Problem(MODEL, params, [flight], free, Nuisance(False, False))


def test_a_precise_output_does_not_have_all_the_say():
    found = fit(problem(8, 8.6))
    assert found.status == "converged"
    assert found.estimates["w"].value == pytest.approx(W, rel=1e-3)
    assert found.estimates["b"].value == pytest.approx(1.0, rel=1e-3)
    # From the start alone w ends at 8.4.
    assert [row.reason for row in found.starts if row.chosen] == ["further-starts"]


def test_what_is_explained_is_not_fitted_again():
    found = fit(problem(8, 4.1))
    assert found.estimates["w"].value == pytest.approx(W, rel=1e-3)
    assert [row.reason for row in found.starts] == ["start"]
    assert found.steps <= 30
