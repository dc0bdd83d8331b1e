"""All parameters of the whole helicopter from six two-second records."""

import runpy
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from heli_jax import Flight, Free, Nuisance, Problem, fit, models, simulate, trim
from heli_jax.dynamics.disturbance import with_disturbance
from heli_jax.naming import asdict


@pytest.fixture(scope="module")
def heave():
    path = Path(__file__).parents[2] / "experiments" / "heave_separates_a.py"
    return runpy.run_path(str(path))


def errors(heave, found):
    truth = heave["vehicle"]()
    return {
        n: (e.value - float(getattr(truth, n))) / e.sd
        for n, e in found.estimates.items()
        if e.sd is not None
    }


def test_nine_parameters_are_recovered_with_throttle(heave):
    found = heave["identify"](heave["records"](0.03))
    assert found.status == "converged"
    assert set(found.estimates) == set(heave["FREE"])
    off = errors(heave, found)
    assert len(off) == 9
    assert max(abs(e) for e in off.values()) < 4
    a = found.estimates["a"]
    assert a.value == pytest.approx(6.0, rel=0.03)
    assert a.sd < 0.02 * 6.0


def test_without_throttle_the_pair_is_named(heave):
    found = heave["identify"](heave["records"](0.002))
    assert max(abs(e) for e in errors(heave, found).values()) < 4
    pairs = {frozenset((p.first, p.second)) for p in found.verdict.pairs}
    assert "Ir * K_throttle is determined far better" in found.verdict.text or (
        frozenset(("Ir", "K_throttle")) in pairs
    )


def test_filter_error_in_gusts(heave):
    """Rolling gusts of 0.5 rad/s^2 in one record: the extended filter with all sticks moving."""
    vehicle, noise, n = heave["vehicle"](), heave["NOISE"], 100
    still = models.helicopter("consistent")
    model = with_disturbance(still, "roll")
    gusts = {"sigma_w": jnp.asarray(0.5), "tau_w": jnp.asarray(0.5)}
    params = model.Params(**{**asdict(vehicle), **gusts})
    [flight] = heave["records"](0.03, count=1)
    start = model.State(**{**asdict(trim(still, vehicle).state), "w1_roll": jnp.asarray(0.3)})
    inputs = model.Inputs(**{k: jnp.asarray(u) for k, u in flight.inputs.items()})
    run = simulate(model, params, inputs, dt=flight.dt, initial_state=start, key=jax.random.key(1))
    rng = np.random.default_rng(1)
    outputs = {
        k: np.asarray(getattr(run.outputs, k)) + sd * rng.standard_normal(n)
        for k, sd in noise.items()
    }
    record = Flight(dt=flight.dt, inputs=flight.inputs, outputs=outputs, sd=noise)
    free = {k: Free(1.1 * float(getattr(vehicle, k))) for k in ("a", "Ixx", "If", "Ir", "K_theta0")}
    found = fit(
        Problem(
            model, params, [record], free, Nuisance(bias=False), method="filter-error", substeps=1
        )
    )
    assert found.status == "converged"
    assert found.white
    off = errors(heave, found)
    assert len(off) == 5
    assert max(abs(e) for e in off.values()) < 4
    assert found.estimates["a"].sd < 0.02 * 6.0
    for name, truth in gusts.items():
        one = found.nuisance[name]
        assert abs(np.log(one.value / float(truth))) < 4 * one.sd / one.value
