"""Results of a grid as a grid."""

import numpy as np
import pytest

from heli_jax import models, sweep
from heli_jax.sweeps import Reduce, as_grid, grid

REDUCE = {"rms": Reduce("rms", "roll"), "mode": Reduce("modes")}


def test_a_grid_has_its_axes_as_dimensions(bench30, record):
    axes = {"Ixx": [0.05, 0.02, 0.03], "gain.x_roll": [1.0, 2.0]}
    run = sweep(models.roll_on_stand, bench30, record, grid(axes), REDUCE)
    cells = as_grid(run)
    assert cells["rms"].dims == ("Ixx", "gain.x_roll")
    assert cells["Ixx"].values.tolist() == [0.02, 0.03, 0.05]
    assert cells["mode_real"].dims == ("Ixx", "gain.x_roll", "mode")
    for k in range(6):
        one = run.isel(element=k)
        at = {n: float(one[n]) for n in axes}
        assert float(cells["rms"].sel(at)) == float(one["rms"])
        np.testing.assert_array_equal(cells["mode_imag"].sel(at), one["mode_imag"])
        assert int(cells["status"].sel(at)) == 0
    with pytest.raises(ValueError, match="a sample has no grid"):
        as_grid(run.isel(element=[0, 1, 2, 3, 4]))
