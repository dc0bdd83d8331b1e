"""Filter error on disturbed records, and where there is nothing to filter."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from heli_jax import Flight, Free, Problem, fit, models, simulate
from heli_jax.dynamics.disturbance import with_disturbance
from heli_jax.naming import asdict, replace
from heli_jax.simulation.inputs import random_steps

DT, N = 0.02, 2000
TRUTH = {"kappa": 4.0, "zeta": 0.2, "sigma_w": 1.04, "tau_w": 1.0}
FREE = {"Ixx": Free(0.03), "If": Free(2.5e-4), "kappa": Free(3.0)}


def made(bench30, seed, *, sigma_w=1.04, poles=1):
    model = with_disturbance(models.roll_on_stand, "roll", poles)
    values = {**TRUTH, "sigma_w": sigma_w}
    params = model.Params(**{**asdict(bench30), **{n: jnp.asarray(v) for n, v in values.items()}})
    rng = np.random.default_rng(seed)
    u = 3e-6 * random_steps(N, DT, rng, (0.2, 1.5))
    run = simulate(
        model, params, model.Inputs(x_roll=jnp.asarray(u)), dt=DT, key=jax.random.key(seed)
    )
    y = np.asarray(run.outputs.roll) + 2e-3 * rng.standard_normal(N)
    flight = Flight(dt=DT, inputs={"x_roll": u}, outputs={"roll": y})
    start = replace(params, sigma_w=jnp.asarray(0.0), tau_w=jnp.asarray(0.3))
    return model, params, start, flight


def errors(found, params):
    return {n: (e.value - float(getattr(params, n))) / e.sd for n, e in found.estimates.items()}


def test_a_disturbed_record_gives_parameters_and_noise_within_their_intervals(bench30):
    for seed in range(2):
        model, params, start, flight = made(bench30, seed)
        found = fit(Problem(model, start, [flight], FREE, method="filter-error"))
        assert found.status == "converged"
        assert found.steps <= 40
        assert all(abs(e) < 4 for e in errors(found, params).values())
        assert found.estimates["Ixx"].sd < 0.1 * float(params.Ixx)
        for name in ("sigma_w", "tau_w"):
            one = found.nuisance[name]
            assert abs(np.log(one.value / TRUTH[name])) < 4 * one.sd / one.value
        assert found.noise["flight 1/roll"] == pytest.approx(2e-3, rel=0.1)
        assert found.white


def test_white_noise_alone_ends_as_output_error(bench30):
    model, _, start, flight = made(bench30, 1, sigma_w=1e-9)
    filtered = fit(Problem(model, start, [flight], FREE, method="filter-error"))
    plain = fit(Problem(model, start, [flight], FREE))
    assert filtered.status == plain.status == "converged"
    for name, one in plain.estimates.items():
        assert filtered.estimates[name].sd == pytest.approx(one.sd, rel=0.05)
        assert filtered.estimates[name].value == pytest.approx(one.value, abs=0.1 * one.sd)
    assert filtered.nuisance["sigma_w"].at_bound
    assert any("output error suffices" in note for note in filtered.notes)


def test_tau_w_may_be_fixed(bench30):
    model, params, start, flight = made(bench30, 1)
    start = replace(start, tau_w=jnp.asarray(1.0))
    problem = Problem(model, start, [flight], FREE, method="filter-error", fixed_noise=("tau_w",))
    found = fit(problem)
    assert found.status == "converged"
    assert "tau_w" not in found.nuisance
    assert all(abs(e) < 4 for e in errors(found, params).values())


def test_damping_of_stand_and_flybar_are_named_together(bench30):
    model, _, start, flight = made(bench30, 0)
    found = fit(Problem(model, start, [flight], {**FREE, "zeta": Free(0.3)}, method="filter-error"))
    text = found.verdict.text
    assert all(part in text for part in ("If", "zeta", "fix one of"))


def test_a_model_without_disturbance_is_refused(bench30):
    _, _, _, flight = made(bench30, 0)
    with pytest.raises(ValueError, match="has no disturbance"):
        Problem(models.roll_on_stand, bench30, [flight], FREE, method="filter-error")
