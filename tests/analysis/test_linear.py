"""Modes against NumPy."""

import numpy as np
import pytest

from heli_jax import models
from heli_jax.analysis.linear import modes
from tests.dynamics.paper import BENCH, matrices


@pytest.mark.parametrize("stand", [False, True])
def test_modes_are_sorted_eigenvalues(bench30, stand):
    model = models.roll_on_stand if stand else models.roll
    A, _ = matrices(BENCH, stand)
    wanted = np.linalg.eigvals(A)
    found = modes(model, bench30)
    assert np.all(np.diff(np.abs(found)) >= -1e-9)
    np.testing.assert_allclose(np.sort_complex(found), np.sort_complex(wanted), atol=1e-8)
