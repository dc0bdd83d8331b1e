"""Modes and frequency response against SciPy and python-control."""

import control
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from heli_jax import Helicopter, Model, models
from heli_jax.analysis.linear import frequency_response, modes, transfer_function
from tests.dynamics.paper import BENCH, matrices, scattered

OMEGA = np.geomspace(0.1, 500.0, 30)


@pytest.fixture(scope="module")
def response():
    return jax.jit(lambda p: frequency_response(models.roll_on_stand, p, jnp.asarray(OMEGA)))


@pytest.mark.parametrize("seed", range(4))
def test_frequency_response(response, seed):
    v = scattered(seed)
    A, B = matrices(v, True)
    found = np.asarray(response(Helicopter(**v)))
    assert found.shape == (30, 2, 1)
    system = control.ss(A, B, np.eye(4)[:2], np.zeros((2, 1)))
    wanted = np.moveaxis(system(1j * OMEGA, squeeze=False), 2, 0)
    np.testing.assert_allclose(found, wanted, rtol=1e-9, atol=0)
    # The second output is the rate of the first.
    np.testing.assert_allclose(found[:, 1, 0], 1j * OMEGA * found[:, 0, 0], rtol=1e-8)


@pytest.mark.parametrize("stand", [False, True])
def test_modes_are_sorted_eigenvalues(bench30, stand):
    model = models.roll_on_stand if stand else models.roll
    A, _ = matrices(BENCH, stand)
    wanted = np.linalg.eigvals(A)
    found = modes(model, bench30)
    assert np.all(np.diff(np.abs(found)) >= -1e-9)
    np.testing.assert_allclose(np.sort_complex(found), np.sort_complex(wanted), atol=1e-8)


@pytest.mark.parametrize("size", [1e-14, 1e-7, 1e7])
def test_transfer_function_is_linear_in_the_input(bench30, size):
    """The unit of the stick is the user's: a weak input has a small numerator, not another one."""
    scaled = Model(
        "scaled",
        lambda p, s, u: models.roll.vector_field(p, s, models.roll.Inputs(size * u.x_roll)),
        *(models.roll.output, Helicopter, models.roll.State, models.roll.Inputs),
        models.roll.Outputs,
        linear=True,
    )
    wanted, _ = transfer_function(models.roll, bench30, "roll", "x_roll")
    found, _ = transfer_function(scaled, bench30, "roll", "x_roll")
    np.testing.assert_allclose(found, size * wanted, rtol=1e-6)
