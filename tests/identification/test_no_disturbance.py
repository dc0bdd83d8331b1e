"""What filter error says where no disturbance is, and where its optimiser would go too far."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

from heli_jax import Free, Problem
from heli_jax.dynamics.disturbance import disturbances_of, with_disturbance
from heli_jax.dynamics.model import Axis
from heli_jax.identification.estimation.data import data_of
from heli_jax.identification.estimation.disturbance_search import (
    at_limit,
    from_other_taus,
)
from heli_jax.identification.estimation.evaluation import deviations
from heli_jax.identification.estimation.levenberg_marquardt import Optimum
from heli_jax.identification.estimation.multistart import Search
from heli_jax.identification.estimation.noise_covariance import (
    RelaxedOptimum,
    first_noise,
    log_likelihood_of,
    relaxed_from,
)
from heli_jax.identification.unknowns.initial_guess import start_vector
from heli_jax.identification.unknowns.layout import layout_of
from tests.identification.test_equation_error import ROLL
from tests.identification.test_equation_error import record as gusty


def test_what_has_no_effect_is_not_known():
    rng = np.random.default_rng(0)
    J = rng.standard_normal((50, 4))
    # The oracle: the inverse of the normal equations.
    np.testing.assert_allclose(deviations(J), np.sqrt(np.diag(np.linalg.inv(J.T @ J))), rtol=1e-12)
    # The third is a copy of the second, the last does nothing: only the first is known.
    J[:, 2] = -3.0 * J[:, 1]
    J[:, 3] = 0.0
    sds = deviations(J)
    both = J[:, :2]
    assert sds[0] == pytest.approx(np.sqrt(np.linalg.inv(both.T @ both)[0, 0]), rel=1e-9)
    assert np.isinf(sds[1:]).all()
    assert np.isinf(deviations(np.full((5, 2), np.nan))).all()


@pytest.mark.slow
def test_a_search_that_ran_to_white_noise_is_begun_again_from_other_correlation_times():
    flight = gusty(n=600, gust=1.0, noise=0.01)
    model = with_disturbance(replace(ROLL, axes=(Axis("roll", rate="p", angle="phi"),)), "roll")
    params = model.Params(Lp=-4.0, Lda=25.0, Lphi=0.0, sigma_w=0.0, tau_w=1.0)
    free = {"Lp": Free(-3.0), "Lda": Free(20.0)}
    one = Problem(model, params, [flight], free, method="filter-error")
    layout, data = layout_of(one, one.training), data_of(one, one.training)
    noise, [d] = first_noise(one, one.training), disturbances_of(model)
    z = start_vector(layout, data, one)
    # An output's measurement noise has gone with it, beside which nothing else has a slope.
    z = z.at[layout.disturbance_at("tau_w")].set(-30.0).at[layout.first_nuisance - 1].set(-20.0)
    astray = RelaxedOptimum(Optimum(z, jnp.asarray(1.0), 1, True), noise, ())
    search = Search(one, layout, data, 200)
    assert at_limit(search, astray, d)
    found = from_other_taus(search, astray, d)
    assert not at_limit(search, found, d)
    # As from the values that the record was made with.
    truth = start_vector(layout, data, one)
    for name, value in (("sigma_w", 1.0), ("tau_w", 0.3)):
        truth = truth.at[layout.disturbance_at(name)].set(np.log(value))
    best = relaxed_from(search, noise, truth)
    reached = log_likelihood_of(search, found)
    assert reached == pytest.approx(log_likelihood_of(search, best), abs=0.5)
    assert reached > log_likelihood_of(search, astray) + 100.0
    # One that did not run to an end is left alone.
    assert from_other_taus(search, found, d) is found
