"""The table of models prefers the one that made the record."""

from typing import Annotated, Any, NamedTuple

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.signal

from heli_jax import Flight, Free, Model, Nuisance, Problem, fit, models, naming
from heli_jax.dynamics.disturbance import with_disturbance
from heli_jax.identification.model_selection import Candidate, _test, alternatives, choose
from tests.identification.bench import steps
from tests.identification.test_filter_error import FREE


@pytest.fixture(scope="module")
def disturbed(bench30):
    """A model, a vehicle and some record, which is not fitted."""
    model = with_disturbance(models.roll_on_stand, "roll")
    signal = steps(np.random.default_rng(0), 50, 0.02, 1e-6)
    flight = Flight(dt=0.02, inputs={"x_roll": signal}, outputs={"roll": signal})
    return model, model.Params(**naming.asdict(bench30)), flight


def test_the_stand_is_asked_for_only_where_it_is_free(disturbed):
    model, start, flight = disturbed
    free = FREE | {"zeta": Free(0.3)}
    problem = Problem(model, start, [flight], free, method="filter-error")
    rivals = alternatives(problem, models.roll_on_stand, "roll", without_stand=models.roll)
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
        pairs = alternatives(problem, models.roll_on_stand, "roll", **rolls).nested
        assert (("one pole, no stand", "one pole") in pairs) == nested
        assert ("no disturbance, no stand", "one pole, no stand") in pairs


def test_no_unknown_more_is_no_test():
    one = Candidate("small", "converged", -10.0, 4, 28.0, 30.0, True, {})
    assert _test(one, one._replace(name="large", log_likelihood=-8.0)).degrees == 0
    test = _test(one, one._replace(name="large", log_likelihood=-8.0, unknowns=6))
    # Chi-squared with two degrees of freedom: exp(-ratio / 2).
    assert test.p_value == pytest.approx(np.exp(-2.0), rel=1e-12)


class Oscillator(NamedTuple):
    w: Annotated[Any, "rad/s"]
    b: Annotated[Any, "1/s^2"]


class Motion(NamedTuple):
    x: Annotated[Any, "rad"]
    v: Annotated[Any, "rad/s"]


class Push(NamedTuple):
    u: Annotated[Any, "1"]


class Angle(NamedTuple):
    x: Annotated[Any, "rad"]


@pytest.mark.slow
def test_a_model_never_ends_below_one_nested_in_it():
    # Undamped, and with a wrong frequency: the likelihood has an optimum at every beat.
    model = Model(
        "oscillator",
        lambda q, s, u: Motion(s.v, q.b * u.u - q.w**2 * s.x),
        lambda q, s, u: Angle(s.x),
        Oscillator,
        Motion,
        Push,
        Angle,
        linear=True,
        start=lambda q: Motion(0.0 * q.b, 0.0 * q.b),
    )
    n, dt = 1500, 0.02
    rng = np.random.default_rng(0)
    u = steps(rng, n, dt, 1.0)
    system = scipy.signal.cont2discrete(([1.0], [1.0, 0.0, 4.0]), dt)
    y = scipy.signal.lfilter(np.ravel(system[0]), system[1], u) + 0.01 * rng.standard_normal(n)
    flight = Flight(dt=dt, inputs={"u": u}, outputs={"x": y})

    def problem(free):
        params = Oscillator(jnp.asarray(2.0), jnp.asarray(1.0))
        return Problem(model, params, [flight], free, Nuisance(False, False))

    both = {
        "fixed": problem({"b": Free(0.5)}),
        "free": problem({"b": Free(0.5), "w": Free(3.0)}),
    }
    # From one start: where little is explained others would be gone to.
    alone = fit(both["free"], starts=1)
    found = choose(both, [("fixed", "free")], starts=1)
    small, large = (next(c for c in found.candidates if c.name == n) for n in ("fixed", "free"))
    assert alone.log_likelihood < small.log_likelihood - 100
    assert large.log_likelihood >= small.log_likelihood
    assert large.estimates["w"] == pytest.approx(2.0, abs=0.01)
    [test] = found.nested
    assert test.ratio >= 0
    assert "free first ended below fixed, which is nested in it" in " ".join(found.sentences)
