"""SimulationOptions: one record or its fields as keywords, which are the same."""

import jax.numpy as jnp
import numpy as np
import pytest

from heli_jax import SimulationOptions, accumulate, models, naming, simulate

ROLL = models.roll_on_stand
DT = 0.02
U = ROLL.Inputs(2e-6 * jnp.asarray(np.repeat([1.0, -1.0, 0.5, 0.0], 5)))


def rolled(bench30, *options, **keywords):
    return np.asarray(simulate(ROLL, bench30, U, *options, **keywords).outputs.roll)


@pytest.mark.parametrize(
    "fields",
    [{}, {"solver": "rk4", "substeps": 2}, {"delay": 0.013}, {"hold": "linear"}, {"block": 4}],
    ids=str,
)
def test_the_record_and_its_fields_as_keywords_are_the_same(bench30, fields):
    by_record = rolled(bench30, SimulationOptions(dt=DT, **fields))
    np.testing.assert_array_equal(by_record, rolled(bench30, dt=DT, **fields))
    assert fields == {} or np.any(by_record != 0.0)


def test_a_keyword_goes_before_the_record(bench30):
    options = SimulationOptions(dt=DT, delay=0.05, solver="rk4")
    at_once = rolled(bench30, dt=DT, delay=0.0, solver="rk4")
    np.testing.assert_array_equal(rolled(bench30, options, delay=0.0), at_once)
    assert np.any(rolled(bench30, options) != at_once)
    assert options.delay == 0.05  # a record is not changed, but copied


def test_the_state_of_the_record_is_where_a_run_begins(bench30):
    start = naming.replace(ROLL.initial_state(bench30), phi=jnp.asarray(0.1))
    run = simulate(ROLL, bench30, U, SimulationOptions(dt=DT, initial_state=start))
    assert float(run.states.phi[0]) == 0.1


def test_an_unknown_field_is_refused_by_name(bench30):
    with pytest.raises(TypeError, match=r"got 'substep'.*substeps"):
        simulate(ROLL, bench30, U, dt=DT, substep=2)
    with pytest.raises(TypeError, match="expected a field of SimulationOptions, got 'dtt'"):
        SimulationOptions().changed({"dtt": 0.1})


def test_accumulate_takes_the_record_and_refuses_what_it_has_not(bench30):
    def sums(value, outputs, _):
        return value + outputs.roll

    def total(options):
        return accumulate(ROLL, bench30, U, sums, jnp.zeros(()), options=options)[0]

    options = SimulationOptions(dt=DT, block=4)
    np.testing.assert_allclose(total(options), rolled(bench30, dt=DT).sum(), rtol=1e-10)
    with pytest.raises(ValueError, match="accumulate: expected no delay"):
        total(options._replace(delay=0.01))
