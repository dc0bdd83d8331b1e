"""Initial values of states that no output shows, against an independent program."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize

from heli_jax import Helicopter, models, naming
from heli_jax.dynamics.check_model import starting_at
from heli_jax.identification.estimation.data import own_start
from tests.dynamics import full_helicopter as oracle

VEHICLE = Helicopter(**oracle.FULL)


def left(state):
    """Return the independent program's largest acceleration there, with the best sticks."""
    sticks = ("x_roll", "x_pitch", "x_yaw", "x_collective")
    size = np.array([1e-4, 1e-4, 1.0, 1.0])

    def accelerations(u):
        inputs = dict(zip(sticks, u * size, strict=True)) | {"x_throttle": 1.0}
        return np.array(list(oracle.rates(oracle.FULL, state, inputs).values()))

    best = scipy.optimize.least_squares(accelerations, [0.1, 0.1, -0.5, 0.5], xtol=1e-15)
    return np.max(np.abs(accelerations(best.x)))


def test_a_whole_helicopter_begins_in_a_steady_flight():
    model = models.helicopter()
    own = {n: float(v) for n, v in naming.asdict(model.initial_state(VEHICLE)).items()}
    assert left(own) > 0.1
    start = own_start(model, VEHICLE)
    assert start["phi"] != 0.0
    assert left(start) < 1e-6


def test_what_cannot_hover_or_is_given_begins_where_the_model_does():
    heavy = dataclasses.replace(VEHICLE, m=jnp.asarray(1e4))
    model = models.helicopter()
    assert own_start(model, heavy) == {
        **dict.fromkeys(own_start(model, heavy), 0.0),
        "Omega": 157.1,
    }
    given = own_start(starting_at(models.roll, {"phi": 0.3}), VEHICLE)
    assert given == {**dict.fromkeys(given, 0.0), "phi": pytest.approx(0.3)}
