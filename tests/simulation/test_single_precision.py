"""Runs in float32: the right input sample at any length, and the result's type."""

from typing import Annotated, NamedTuple

import jax.numpy as jnp
import numpy as np
import pytest

from heli_jax import Model, simulate
from heli_jax.naming import Scalar
from heli_jax.simulation.stepping import check_countable


class Params(NamedTuple):
    gain: Annotated[Scalar, "1", "of the input"]


class State(NamedTuple):
    x: Annotated[Scalar, "1", "integral of the input"]


class Inputs(NamedTuple):
    u: Annotated[Scalar, "1/s", "rate"]


INTEGRATOR = Model(
    "integrator", lambda p, s, u: State(x=p.gain * u.u), lambda p, s, u: s, Params, State, Inputs,
    State,
)  # fmt: skip


def run(n, dtype):
    u = np.where(np.arange(n) // 50 % 2, -1.0, 1.0)
    p, inputs = Params(jnp.asarray(1.0, dtype)), Inputs(jnp.asarray(u, dtype))
    return u, simulate(INTEGRATOR, p, inputs, dt=jnp.asarray(1.0, dtype), substeps=1)


def test_every_step_of_a_long_run_has_its_own_sample():
    u, found = run(100_000, jnp.float32)
    assert found.states.x.dtype == jnp.float32
    # A sample too late would be an error of two; a sixth in each stage is rounded.
    wanted = np.concatenate([[0.0], np.cumsum(u)[:-1]])
    np.testing.assert_allclose(found.states.x, wanted, atol=1e-3)


def test_more_samples_than_float32_counts_are_refused():
    check_countable(4_194_304, jnp.float32)
    check_countable(10**9, jnp.float64)
    with pytest.raises(ValueError, match="at most 4194304 samples in float32, got 4194305"):
        check_countable(4_194_305, jnp.float32)
