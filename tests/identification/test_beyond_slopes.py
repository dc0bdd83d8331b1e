"""Likelihood intervals where slopes at a chance optimum overstate the information."""

import numpy as np
import pytest
import scipy.linalg
import scipy.optimize

from heli_jax import Flight, Free, Problem, fit, linear_model

TRUTH = {"Lb": 166.1, "tau_f": 0.04631, "Blat": 0.1398}
DT = 0.02


def simulated(u, Lb, tau_f, Blat, start=(0.0, 0.0)):
    """Return the roll rate [rad/s] of flapping without a flybar, by matrix exponentials."""
    A = np.array([[0.0, Lb, 0.0], [-1.0, -1.0 / tau_f, Blat / tau_f], [0.0, 0.0, 0.0]])
    E = scipy.linalg.expm(A * DT)
    x, p = np.array([*start, 0.0]), np.empty(len(u))
    for k, now in enumerate(u):
        x[2] = now
        p[k] = x[0]
        x = E @ x
    return p


def problem(u, noise, seed):
    p = simulated(u, **TRUTH) + noise * np.random.default_rng(seed).standard_normal(len(u))
    roll = linear_model("roll-flybarless")
    flight = Flight(dt=DT, inputs={"lat": u}, outputs={"p": p})
    free = {"Lb": Free(100.0), "tau_f": Free(0.08), "Blat": Free(0.1)}
    return Problem(roll.model, roll.vehicle().params, [flight], free)


def steps(seconds, seed):
    rng = np.random.default_rng(seed)
    return np.repeat(rng.uniform(-0.1, 0.1, round(seconds / 0.4)), round(0.4 / DT))


def test_one_sine_does_not_determine_three_parameters():
    u = 0.05 * np.sin(1.0 * np.arange(1000) * DT)
    result = fit(problem(u, 0.01, 1))
    assert result.status != "converged"
    assert result.estimates["Lb"].lower95 is None


def test_what_steps_determine_keeps_its_gaussian_intervals():
    result = fit(problem(steps(20.0, 1), 0.01, 1))
    assert result.status == "converged"
    assert (result.verdict.undetermined, result.verdict.roughly) == ((), ())
    assert "uncertainty.profile-interval" not in {f.code for f in result.findings}
    for name, truth in TRUTH.items():
        assert result.estimates[name].lower95 < truth < result.estimates[name].upper95


@pytest.mark.slow
def test_a_wide_interval_ends_where_the_likelihood_of_all_together_has_fallen():
    u = steps(8.0, 4)
    asked = problem(u, 0.12, 4)
    result = fit(asked)
    assert "uncertainty.profile-interval" in {f.code for f in result.findings}
    at = result.estimates["Lb"]
    # The likelihood falls off slowly towards larger values.
    assert at.upper95 - at.value > 1.2 * (at.value - at.lower95)
    p = np.asarray(asked.flights[0].outputs["p"])

    def misfit(Lb):
        def rows(x):
            return (p - x[4] - simulated(u, Lb, np.exp(x[0]), x[1], x[2:4])) / sd

        x0 = [np.log(0.04631 * 166.1 / Lb), 0.1398 * 166.1 / Lb, 0.0, 0.0, 0.0]
        return 2.0 * scipy.optimize.least_squares(rows, x0, x_scale="jac").cost

    sd = result.noise["flight 1/p"]
    best = misfit(at.value)
    # 7.81: the 95 % point of chi-squared for the three joint parameters.
    for end in (at.lower95, at.upper95):
        assert 6.0 < misfit(end) - best < 10.5
