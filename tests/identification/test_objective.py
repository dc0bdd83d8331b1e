"""A fifth method needs one class and one entry: Huber's loss, robust against outliers."""

import math

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize

from heli_jax import Free, Nuisance, Problem, check, fit, models
from heli_jax.identification.estimation.objective import errors_of
from heli_jax.identification.estimation.output_error import OutputError
from heli_jax.identification.methods import METHODS, Method
from heli_jax.identification.uncertainty.comparison import intervals
from heli_jax.report.fit_page import Analysis, write_report
from tests.identification.bench import BENCH, record, response, vehicle

BEND = 1.345
"""Bend of the loss [sd], above which it is linear: 95 % efficient without outliers."""


class Huber(OutputError):
    """Output error by Huber's loss (1964): rho(e) = e^2 / 2 up to the bend, linear beyond."""

    def residuals(self, layout, data, noise, u):
        """Return sign(e) sqrt(2 rho(e)), whose squares the optimiser sums."""
        plain = super().residuals(layout, data, noise, u)
        size = jnp.maximum(jnp.abs(plain.rows), BEND)
        beyond = jnp.sign(plain.rows) * jnp.sqrt(BEND * (2.0 * size - BEND))
        wild = self.tags(layout, data, plain.rows.size).residual & (size > BEND)
        return plain._replace(rows=jnp.where(wild, beyond, plain.rows))

    def scale(self, errors):
        """Return the median of the errors' sizes, which outliers do not affect."""
        return float(np.median(np.abs(errors)) / 0.6745)

    def log_likelihood(self, layout, data, noise, e):
        """Return the log-likelihood of the density exp(-rho(v / s)) / (c s)."""
        normal = math.sqrt(2.0 * math.pi) * math.erf(BEND / math.sqrt(2.0))
        c, total = normal + 2.0 * math.exp(-(BEND**2) / 2.0) / BEND, 0.0
        for v in errors_of(layout, e):
            s = self.scale(v)
            size = np.abs(v / s)
            rho = np.where(size < BEND, size**2 / 2.0, BEND * size - BEND**2 / 2.0)
            total -= float(np.sum(rho)) + v.size * math.log(c * s)
        return total


OBJECTIVE = Huber()


@pytest.fixture
def huber(monkeypatch):
    monkeypatch.setitem(METHODS, "huber", Method(f"{__name__}:OBJECTIVE", "Huber's loss"))


def spiked(seed):
    made, rng = record(BENCH, seed=seed, n=1500, noise=1e-3), np.random.default_rng(seed)
    roll = made.outputs["roll"].copy()
    wild = rng.choice(roll.size, 30, replace=False)
    roll[wild] += rng.choice([-1.0, 1.0], 30) * rng.uniform(0.05, 0.2, 30)
    return type(made)(dt=made.dt, inputs=made.inputs, outputs={"roll": roll})


@pytest.mark.slow
def test_a_method_of_ones_own_goes_all_the_way(huber, tmp_path):
    flight = spiked(3)
    problem = Problem(
        models.roll_on_stand,
        vehicle(BENCH),
        [flight],
        {"Ixx": Free(0.03), "If": Free(2e-4)},
        Nuisance(initial_state=False, bias=False),
        method="huber",
    )
    assert check(problem).verdict.identifiable
    found = fit(problem)
    assert found.status == "converged"
    y, u = flight.outputs["roll"], next(iter(flight.inputs.values()))

    def errors(logs):
        changed = dict(zip(("Ixx", "If"), np.exp(logs), strict=True))
        return y - response({**BENCH, **changed}, u, flight.dt, stand=True)

    noise = found.noise["flight 1/roll"]
    theirs = scipy.optimize.least_squares(
        errors, np.log([0.03, 2e-4]), loss="huber", f_scale=BEND * noise, x_scale="jac", ftol=1e-12
    )
    for name, log in zip(("Ixx", "If"), theirs.x, strict=True):
        one = found.estimates[name]
        assert abs(one.value - np.exp(log)) < 0.05 * one.sd
        assert one.lower95 < BENCH[name] < one.upper95
        assert one.sd < 0.1 * BENCH[name]
    assert noise == pytest.approx(1e-3, rel=0.1)
    by = intervals(found, profiles=[], runs=40).by_parameter["Ixx"]
    assert by["bootstrap"][0] < BENCH["Ixx"] < by["bootstrap"][1]
    write_report(tmp_path, Analysis(found, problem), "Huber", {})
    assert "Huber" in (tmp_path / "report.html").read_text()
