"""What filter error says where no disturbance is, and where its optimiser would go too far."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

from heli_jax import Free, Problem, fit, models
from heli_jax.dynamics.disturbance import disturbances_of, with_disturbance
from heli_jax.dynamics.model import Axis
from heli_jax.identification.estimation.data import data_of
from heli_jax.identification.estimation.disturbance_search import (
    at_limit,
    disturbance_or_none,
    from_other_taus,
)
from heli_jax.identification.estimation.evaluation import deviations, evaluate
from heli_jax.identification.estimation.levenberg_marquardt import Optimum
from heli_jax.identification.estimation.multistart import Search
from heli_jax.identification.estimation.noise_covariance import (
    RelaxedOptimum,
    first_noise,
    log_likelihood_of,
    relaxed_from,
)
from heli_jax.identification.uncertainty.estimates import extreme_noise_notes
from heli_jax.identification.unknowns.initial_guess import start_vector
from heli_jax.identification.unknowns.layout import layout_of, unpack
from heli_jax.naming import asdict
from tests.identification.bench import BENCH, record, vehicle
from tests.identification.test_equation_error import ROLL
from tests.identification.test_equation_error import record as gusty
from tests.identification.test_filter_error import made

MODEL = with_disturbance(models.roll_on_stand, "roll")
FREE = {"Ixx": Free(0.048), "If": Free(6.8e-5)}


def problem(seed, n=1000):
    values = {"sigma_w": jnp.asarray(0.0), "tau_w": jnp.asarray(1.0)}
    params = MODEL.Params(**{**asdict(vehicle(BENCH)), **values})
    return Problem(MODEL, params, [record(BENCH, seed=seed, n=n)], FREE, method="filter-error")


# Of seeds 0 to 59 number 23 ended with sigma_w = 9e-105 +- 4e-119, tau_w = 3e197 s.
@pytest.mark.parametrize("seed", [22, 23])
@pytest.mark.slow
def test_white_noise_has_no_disturbance(seed):
    found = fit(problem(seed))
    assert found.status == "converged"
    sigma_w, tau_w = found.nuisance["sigma_w"], found.nuisance["tau_w"]
    assert sigma_w.value == 0.0
    assert sigma_w.sd is None
    assert tau_w.sd is None
    assert 0.99 * 0.02 / 100 < tau_w.value < 1.01 * 1000 * 20.0
    assert "noise.no-disturbance" in {f.code for f in found.findings}
    for name, true in (("Ixx", 0.024), ("If", 0.00017)):
        one = found.estimates[name]
        assert abs(one.value - true) < 4 * one.sd


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
def test_a_disturbance_has_ends():
    one = problem(1, 200)
    layout, data = layout_of(one, one.training), data_of(one, one.training)
    z = start_vector(layout, data, one)
    at = layout.disturbance_at("tau_w")
    for far, tau_w in ((-900.0, 0.02 / 100), (900.0, 1e3 * 4.0)):
        out = z.at[at].set(far).at[layout.disturbance_at("sigma_w")].set(0.0)
        assert float(unpack(layout, data, out).noise["tau_w"]) == pytest.approx(tau_w, rel=1e-9)
        J = evaluate(layout, data, first_noise(one, one.training), out).J
        assert np.isinf(deviations(J)[at])
        [said] = extreme_noise_notes(layout, data, out)
        assert (said.code, said.subjects) == ("noise.disturbance-open", ("tau_w",))
    assert extreme_noise_notes(layout, data, z.at[at - 1].set(0.0)) == []


@pytest.mark.slow
def test_a_search_that_went_astray_begins_anew_from_the_nested_model(bench30):
    # The optimiser's word is 'converged', at a point below the model without disturbance.
    model, _, start, flight = made(bench30, 1)
    free = {"Ixx": Free(0.03), "If": Free(2.5e-4)}
    one = Problem(model, start, [flight], free, method="filter-error")
    layout, data = layout_of(one, one.training), data_of(one, one.training)
    noise = first_noise(one, one.training)
    z = start_vector(layout, data, one)
    z = z.at[0].add(2.0).at[layout.disturbance_at("sigma_w")].set(-25.0)
    z = z.at[layout.disturbance_at("tau_w")].set(-7.0)
    found = RelaxedOptimum(Optimum(z, jnp.asarray(1.0), 1, True), noise, ())
    search = Search(one, layout, data, 200)
    settled = disturbance_or_none(search, found)
    e = evaluate(layout, data, settled.noise, settled.best.z)
    best = fit(one)
    reached = layout.estimator.log_likelihood(layout, data, settled.noise, e)
    assert reached == pytest.approx(best.log_likelihood, abs=2.0)
    assert "search.begun-anew" in {f.code for f in settled.notes}


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
