"""What a flight says of the parameters by itself: exponentials in known noise."""

import jax.numpy as jnp
import numpy as np
import pytest

from heli_jax.identification.validation.own_estimates import Fitted, Rows, own_estimates

T = np.linspace(0.0, 4.0, 400)
SD = 0.01
NAMES = ("rate", "gain", "unseen")


def model(z) -> tuple[np.ndarray, np.ndarray]:
    rate, gain = float(z[0]), float(z[1])
    decay = np.exp(-rate * T)
    return gain * decay, np.stack([-T * gain * decay, decay, np.zeros_like(T)], axis=1)


def asked(truth, at, *, noise: float = SD, unseen: float = 1.0):
    """The flight of a machine, against a fit that found other values."""
    y = model(truth)[0] + noise * np.random.default_rng(0).standard_normal(T.size)

    def rows(z, sd=None) -> Rows:
        made, slopes = model(z)
        sd = np.std(y - made) if sd is None else sd
        return Rows((y - made) / sd, -slopes / sd)

    J = model(at)[1] / SD
    fit = Fitted(J.T @ J, np.array([0.01, 0.01, unseen]), NAMES, np.asarray(at, float))
    z = jnp.asarray(at, float)
    return own_estimates(rows, lambda z: rows(z, SD), lambda z: (z, jnp.ones(3)), z, fit)


def test_its_values_are_those_that_it_has_by_itself_and_not_those_of_one_step():
    p, furthest = asked((2.5, 1.0, 0.0), (0.8, 1.0, 0.0))
    assert p < 0.01
    assert furthest.parameter == "rate"
    assert furthest.own == pytest.approx(2.5, abs=0.2)
    assert furthest.fitted == 0.8
    p, _ = asked((0.8, 1.0, 0.0), (0.8, 1.0, 0.0))
    assert p > 0.01


def test_of_rounding_nothing_is_said_and_what_the_fit_does_not_know_is_not_named():
    assert asked((0.8, 1.0, 0.0), (0.8 + 1e-12, 1.0, 0.0), noise=1e-14) == (None, None)
    _, furthest = asked((0.8, 1.2, 0.0), (0.8, 1.0, 0.0), unseen=np.inf)
    assert furthest.parameter == "gain"
