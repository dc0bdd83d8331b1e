"""Records fitted anew from the optimum of a fit, against fits of their own and SciPy's."""

import dataclasses

import numpy as np
import pytest
import scipy.optimize

from heli_jax import Free, Nuisance, Prior, Problem, fit, models
from heli_jax.identification.uncertainty.bootstrap import bootstrap, refit
from heli_jax.identification.uncertainty.comparison import intervals
from tests.identification.bench import BENCH, record, response, vehicle

FREE = {"Ixx": Free(0.03), "If": Free(2e-4), "a": Free(5.0, prior=Prior(5.5, 0.5))}
NONE = Nuisance(False, False)


def problem(flights, free=FREE, **how):
    return Problem(models.roll_on_stand, vehicle(BENCH), flights, free, **how)


@pytest.fixture(scope="module")
def fitted():
    return fit(problem([record(BENCH, seed=3, n=150)]))


def test_records_fitted_together_are_as_each_by_itself(fitted):
    records = [record(BENCH, seed=k, n=150) for k in range(5, 8)]
    found = refit(fitted, [*records, *records, *[[r] for r in records * 6]])
    assert found.converged.all()
    for k, flight in enumerate(records):
        alone = fit(problem([flight]))
        for name, e in alone.estimates.items():
            # Noise levels and weak priors are those of the first record.
            assert abs(found.values[name][k] - e.value) < 0.1 * e.sd
            np.testing.assert_allclose(found.values[name][k::3], found.values[name][k], rtol=1e-6)


@pytest.mark.slow
def test_many_records_are_fitted_as_scipy_fits_them():
    free = {"Ixx": Free(0.03), "If": Free(2e-4)}
    flights = [record(BENCH, seed=k, n=150) for k in range(24)]
    found = refit(fit(problem(flights[:1], free, nuisance=NONE)), flights)
    assert found.converged.all()
    for k, flight in enumerate(flights[:6]):
        u, y = flight.inputs["x_roll"], flight.outputs["roll"]
        alone = scipy.optimize.least_squares(
            lambda v, u=u, y=y: response(BENCH | {"Ixx": v[0], "If": v[1]}, u, 0.02, True) - y,
            [0.024, 1.7e-4], x_scale=[1e-3, 1e-5], xtol=1e-14, ftol=1e-14, gtol=1e-14,
        )  # fmt: skip
        sd = np.sqrt(np.diag(np.linalg.inv(alone.jac.T @ alone.jac)) * 2.0 * alone.cost / 148)
        for name, value, spread in zip(free, alone.x, sd, strict=True):
            assert abs(found.values[name][k] - value) < 1e-2 * spread


def test_records_unlike_the_fits_are_refused(fitted):
    good = record(BENCH, seed=5, n=150)
    cases = (
        record(BENCH, seed=5, n=140),
        record(BENCH, seed=5, n=150, dt=0.01),
        record(BENCH, seed=5, n=150, known={"kappa": 5.0}),
        [good, good],
    )
    for flight in cases:
        with pytest.raises(ValueError, match=r"^refit, record 1: "):
            refit(fitted, [good, flight])
    with pytest.raises(ValueError, match="one record"):
        refit(fitted, [])
    with pytest.raises(TypeError, match=r"^refit, record 0: "):
        refit(fitted, [None])


def test_nothing_is_computed_where_the_data_leave_a_parameter_open(fitted):
    open_ = {n: e._replace(sd=None) if n == "If" else e for n, e in fitted.estimates.items()}
    poor = dataclasses.replace(fitted, estimates=open_, status="not-identifiable")
    found = intervals(poor, profiles=["Ixx"], runs=5)
    assert found.profiles == {}
    assert found.bootstrap is None
    with pytest.raises(ValueError, match="If"):
        bootstrap(poor, 5)
