"""All parameters of the whole helicopter from four two-second records."""

import runpy
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from heli_jax import trim
from heli_jax.identification.estimation.kalman import innovations
from heli_jax.identification.validation.metrics import whiteness
from heli_jax.naming import asdict, replace


@pytest.fixture(scope="module")
def heave():
    path = Path(__file__).parents[2] / "experiments" / "heave_separates_a.py"
    return runpy.run_path(str(path))


def errors(heave, result):
    truth = heave["vehicle"]()
    return {
        n: (e.value - float(getattr(truth, n))) / e.sd
        for n, e in result.estimates.items()
        if e.sd is not None
    }


@pytest.mark.slow
def test_nine_parameters_are_recovered_with_throttle(heave):
    result = heave["identify"](heave["records"](0.03, count=4))
    assert result.status == "converged"
    assert set(result.estimates) == set(heave["FREE"])
    off = errors(heave, result)
    assert len(off) == 9
    assert max(abs(e) for e in off.values()) < 4
    a = result.estimates["a"]
    assert a.value == pytest.approx(6.0, rel=0.03)
    assert a.sd < 0.02 * 6.0


@pytest.mark.slow
def test_without_throttle_the_pair_is_named(heave):
    result = heave["identify"](heave["records"](0.002, count=4))
    assert max(abs(e) for e in errors(heave, result).values()) < 4
    assert set(result.verdict.undetermined) == {"Ir", "K_throttle"}
    assert [c.name for c in result.verdict.combinations] == ["Ir * K_throttle"]


@pytest.mark.slow
def test_the_extended_filter_knows_the_machine_in_gusts(heave):
    """At the truth what it has not foreseen is white and as large as it says, and no other lift
    slope makes the record as likely. The experiment has the fit."""
    model, params, flight = heave["DISTURBED"], heave["in_gusts"](), heave["gusty"]()
    start = trim(heave["MODEL"], heave["vehicle"]()).state
    start = model.State(**asdict(start), w1_roll=jnp.zeros(()))
    inputs = model.Inputs(**{n: jnp.asarray(u) for n, u in flight.inputs.items()})
    measured = {n: jnp.asarray(y) for n, y in flight.outputs.items()}

    @jax.jit
    def filtered(a):
        return innovations(
            model, replace(params, a=a), inputs, measured, flight.sd, dt=flight.dt,
            initial_state=start, substeps=1,
        )  # fmt: skip

    def log_likelihood(predictions):
        e, s = (np.stack([np.asarray(v[n]) for n in measured]) for v in predictions)
        return -0.5 * np.sum(e**2 / s + np.log(s))

    truth = filtered(params.a)
    for name, e in truth.error.items():
        size = np.asarray(e / jnp.sqrt(truth.variance[name]))
        assert whiteness(size, len(measured)).white, name
        # Of 100 innovations: 4 standard deviations of a variance estimated from as many.
        assert np.mean(size**2) == pytest.approx(1.0, abs=4 * (2 / size.size) ** 0.5), name
    for factor in (0.95, 1.05):
        assert log_likelihood(truth) > log_likelihood(filtered(factor * params.a)) + 10
