"""SimulationOptions: as a record or as keywords, with equal results."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from heli_jax import SimulationOptions, accumulate, models, naming, simulate

ROLL = models.roll_on_stand
DT = 0.02
U = ROLL.Inputs(2e-6 * jnp.asarray(np.repeat([1.0, -1.0, 0.5, 0.0], 5)))
FIELDS = {"delay": 0.013, "hold": "linear", "block": 4}


def test_the_record_and_its_fields_as_keywords_are_the_same_and_a_keyword_goes_first(bench30):
    start = naming.replace(ROLL.initial_state(bench30), phi=jnp.asarray(0.1))
    options = SimulationOptions(dt=DT, initial_state=start, **FIELDS)

    @jax.jit
    def rolled(p):
        ways = (
            ((options,), {}),
            ((), {"dt": DT, "initial_state": start, **FIELDS}),
            ((options._replace(delay=0.1),), {"delay": 0.013}),
        )
        return [simulate(ROLL, p, U, *record, **more).outputs.roll for record, more in ways]

    record, keywords, first = rolled(bench30)
    np.testing.assert_array_equal(record, keywords)
    np.testing.assert_array_equal(record, first)
    assert float(record[0]) == 0.1
    assert options.delay == 0.013  # a record is not changed, but copied


def test_an_unknown_field_is_refused_by_name(bench30):
    with pytest.raises(TypeError, match=r"'substep'.*substeps"):
        simulate(ROLL, bench30, U, dt=DT, substep=2)
    with pytest.raises(TypeError, match="dtt"):
        SimulationOptions().changed({"dtt": 0.1})


def test_accumulate_refuses_what_it_has_not(bench30):
    options = SimulationOptions(dt=DT, delay=0.01)
    with pytest.raises(ValueError, match="delay"):
        accumulate(ROLL, bench30, U, lambda v, y, _: v, jnp.zeros(()), options=options)
