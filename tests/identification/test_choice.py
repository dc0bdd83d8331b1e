"""Model selection prefers the model that made the record."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

from heli_jax import Flight, Free, Problem, fit, models, naming
from heli_jax.dynamics.disturbance import with_disturbance
from heli_jax.identification.select import Candidate, _test, alternatives, choose
from tests.identification.bench import steps
from tests.identification.test_filter_error import FREE
from tests.identification.test_noise_guesses import W
from tests.identification.test_noise_guesses import problem as swing


@pytest.fixture(scope="module")
def disturbed(bench30):
    """Return a model, a vehicle and a record, without a fit."""
    model = with_disturbance(models.roll_on_stand, "roll")
    signal = steps(np.random.default_rng(0), 50, 0.02, 1e-6)
    flight = Flight(dt=0.02, inputs={"x_roll": signal}, outputs={"roll": signal})
    return model, model.Params(**naming.asdict(bench30)), flight


def test_the_stand_is_asked_for_only_where_it_is_free(disturbed):
    model, start, flight = disturbed
    free = FREE | {"zeta": Free(0.3)}
    problem = Problem(model, start, [flight], free, method="filter-error")
    rivals = alternatives(problem, models.roll_on_stand, ["roll"], without_stand=models.roll)
    assert "kappa" not in rivals.problems["one pole, no stand"].free
    assert ("one pole, no stand", "one pole") in rivals.nested


def test_a_damping_that_is_fixed_is_no_part_of_a_machine_without_stand(disturbed):
    model, start, flight = disturbed
    rolls = {"without_stand": models.roll}
    for zeta, free, nested in (
        (0.2, FREE, False),
        (0.0, FREE, True),
        (0.2, FREE | {"zeta": Free(0.3)}, True),
        (0.2, FREE | {"zeta": Free(0.3, lower=0.1)}, False),
    ):
        vehicle = naming.replace(start, zeta=jnp.asarray(zeta))
        problem = Problem(model, vehicle, [flight], free, method="filter-error")
        pairs = alternatives(problem, models.roll_on_stand, ["roll"], **rolls).nested
        assert (("one pole, no stand", "one pole") in pairs) == nested
        assert ("no disturbance, no stand", "one pole, no stand") in pairs


def test_no_unknown_more_is_no_test():
    one = Candidate("small", "converged", -10.0, 4, 28.0, 30.0, True, {})
    assert _test(one, one._replace(name="large", log_likelihood=-8.0)).degrees == 0
    test = _test(one, one._replace(name="large", log_likelihood=-8.0, unknowns=6))
    # Chi-squared with two degrees of freedom: exp(-ratio / 2).
    assert test.p_value == pytest.approx(np.exp(-2.0), rel=1e-12)


@pytest.mark.slow
def test_a_model_never_ends_below_one_nested_in_it():
    # At a wrong frequency the likelihood has an optimum at every beat.
    wrong = swing(0, 3.0)
    record = wrong.flights[0]
    wrong = replace(wrong, flights=[replace(record, outputs={"x": record.outputs["x"]})])
    both = {"fixed": replace(wrong, free={"b": wrong.free["b"]}), "free": wrong}
    # One start: more would be tried if little is explained.
    alone = fit(both["free"], starts=1)
    found = choose(both, [("fixed", "free")], starts=1)
    small, large = (next(c for c in found.candidates if c.name == n) for n in ("fixed", "free"))
    assert alone.log_likelihood < small.log_likelihood - 100
    assert large.log_likelihood >= small.log_likelihood
    assert large.estimates["w"] == pytest.approx(W, abs=0.01)
    [test] = found.nested
    assert test.ratio >= 0
