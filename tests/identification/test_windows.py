"""Multiple shooting: windows with separate initial states."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from heli_jax import Free, Nuisance, Problem, fit, models
from heli_jax.identification.estimation.data import data_of, start_vector
from heli_jax.identification.estimation.levenberg_marquardt import residual_and_jacobian
from heli_jax.identification.estimation.noise_covariance import first_noise
from heli_jax.identification.unknowns.layout import layout_of
from tests.identification.bench import BENCH, record, vehicle

FREE = {"Ixx": Free(0.03), "If": Free(2e-4)}


def problem(flights=1, **how):
    made = [record(BENCH, seed=3 + i, n=200 + 40 * i) for i in range(flights)]
    return Problem(models.roll_on_stand, vehicle(BENCH), made, FREE, **how)


@pytest.mark.slow
def test_the_jacobian_by_colours_is_the_jacobian():
    one = problem(2, window=1.0, nuisance=Nuisance(bias=False, input_gain=True))
    # Two outputs, not in the order of their names.
    flights = [
        dataclasses.replace(
            f, outputs={"roll_rate": np.gradient(f.outputs["roll"], f.dt), **f.outputs}
        )
        for f in one.flights
    ]
    one = dataclasses.replace(one, flights=flights)
    layout, data = layout_of(one, one.training), data_of(one, one.training)
    assert layout.windows == ((4, 50), (5, 48))
    noise = first_noise(one, one.training)
    rng = np.random.default_rng(0)
    z = start_vector(layout, data, one)
    z = z + jnp.asarray(0.1 * rng.standard_normal(z.shape))
    e = residual_and_jacobian(layout, data, noise, z)
    # By the compiled program; test_offsets compares it with rows_of.
    h = 1e-4 * np.eye(z.size)
    high, low = (
        np.array([residual_and_jacobian(layout, data, noise, z + s * one).r for one in h])
        for s in (1.0, -1.0)
    )
    wanted = (high - low).T / 2e-4
    np.testing.assert_allclose(e.J, wanted, rtol=1e-5, atol=1e-7 * np.abs(wanted).max())
    assert e.r.size == 2 * (200 + 240) + 2 + (layout.size - layout.first_nuisance)


@pytest.mark.slow
def test_windows_that_hang_together_are_one_run():
    plain, chained, apart = (
        fit(problem(**how)) for how in ({}, {"window": 1.0, "continuity": 1e-5}, {"window": 1.0})
    )
    assert plain.status == chained.status == apart.status == "converged"
    for name, one in plain.estimates.items():
        other = chained.estimates[name]
        assert other.value == pytest.approx(one.value, abs=0.02 * one.sd)
        assert other.sd == pytest.approx(one.sd, rel=0.02)
        # Separate states in every window cost information, but no bias.
        loose = apart.estimates[name]
        assert loose.sd > one.sd
        assert abs(loose.value - BENCH[name]) < 4 * loose.sd
    assert apart.signals[0].simulated["roll"].shape == (200,)


def test_a_window_as_long_as_the_flight_is_the_flight():
    one, other = fit(problem()), fit(problem(window=100.0))
    for name, found in one.estimates.items():
        assert other.estimates[name].value == pytest.approx(found.value, rel=1e-9)
