"""A third method is one class and one entry: least squares on differences from sample to sample."""

import jax.numpy as jnp
import numpy as np
import pytest

from heli_jax import Free, Nuisance, Problem, check, fit, models
from heli_jax.identification.estimation.estimator import Estimator, Residuals
from heli_jax.identification.estimation.simulated_flights import predict
from heli_jax.identification.methods import METHODS, Method
from heli_jax.identification.uncertainty.comparison import intervals
from heli_jax.report.drawings import Analysis
from heli_jax.report.html import write_report
from tests.identification.bench import BENCH, record, vehicle


class Differences(Estimator):
    """Differences of the output error from sample to sample: indifferent to a bias that drifts."""

    rows_are_white = False

    def residuals(self, layout, data, noise, u):
        runs, rows = predict(layout, data, u), []
        for i, names in enumerate(layout.outputs):
            for name, simulated in zip(names, runs[i].outputs, strict=True):
                steps = jnp.diff(data.flights[i].outputs[name] - simulated, prepend=jnp.nan)
                steps = jnp.where(jnp.isfinite(steps), steps, 0.0)
                rows.append(steps / (2.0**0.5 * noise.sd[i][name]))
        return Residuals(jnp.concatenate(rows), runs)

    def records(self, reached, u, runs, seed):
        flights = predict(reached.layout, reached.data, u)
        named = zip(reached.layout.outputs, flights, strict=True)
        return [dict(zip(names, run.outputs, strict=True)) for names, run in named]


ESTIMATOR = Differences()


@pytest.fixture
def differences(monkeypatch):
    entry = Method(f"{__name__}:ESTIMATOR", "least squares on differences")
    monkeypatch.setitem(METHODS, "differences", entry)


@pytest.mark.slow
def test_a_method_of_ones_own_goes_all_the_way(differences, tmp_path):
    drift = 0.02 * np.cumsum(np.random.default_rng(0).standard_normal(1500)) / 1500**0.5
    made = record(BENCH, seed=3, n=1500, noise=1e-3)
    flight = type(made)(
        dt=made.dt, inputs=made.inputs, outputs={"roll": made.outputs["roll"] + drift}
    )
    free = {"Ixx": Free(0.03), "If": Free(2e-4)}
    off = Nuisance(bias=False)
    problem = Problem(
        models.roll_on_stand, vehicle(BENCH), [flight], free, off, method="differences"
    )
    assert check(problem).verdict.identifiable
    found = fit(problem)
    assert found.status == "converged"
    assert found.coloured  # differences of white noise are not white
    for name, one in found.estimates.items():
        assert one.lower95 < BENCH[name] < one.upper95
        assert one.sd < 0.1 * BENCH[name]
    assert found.noise["flight 1/roll"] == pytest.approx(1e-3, rel=0.15)
    by = intervals(found, profiles=[], runs=40).by_parameter["Ixx"]
    assert by["bootstrap"][0] < BENCH["Ixx"] < by["bootstrap"][1]
    write_report(tmp_path, Analysis(found, problem), "differences", {})
    assert "least squares on differences" in (tmp_path / "report.html").read_text()
