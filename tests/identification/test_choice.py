"""The table of models prefers the one that made the record."""

from heli_jax import Problem, models
from heli_jax.identification.choice import alternatives, choose
from tests.identification.test_filter_error import FREE, made

INERTIAS = {name: FREE[name] for name in ("Ixx", "If")}


def test_two_poles_are_seen(bench30):
    model, _, start, flight = made(bench30, 3, poles=2)
    problem = Problem(model, start, [flight], INERTIAS, method="filter-error")
    rivals = alternatives(problem, models.roll_on_stand, "roll")
    assert list(rivals.problems) == ["no disturbance", "one pole", "two poles"]
    found = choose(rivals.problems, rivals.nested)
    assert [c.name for c in found.candidates] == ["two poles", "one pole", "no disturbance"]
    assert found.candidates[0].white
    one, two = (next(c for c in found.candidates if c.name == n) for n in ("one pole", "two poles"))
    assert two.unknowns == one.unknowns
    assert one.aic - two.aic > 10
    assert found.sentences[0] == "AIC and BIC prefer: two poles."
    for test in found.nested:
        assert test.small == "no disturbance"
        assert test.degrees == 2
        assert test.p_value < 1e-6


def test_the_stand_is_asked_for_only_where_it_is_free(bench30):
    model, _, start, flight = made(bench30, 3)
    problem = Problem(model, start, [flight], FREE, method="filter-error")
    rivals = alternatives(problem, models.roll_on_stand, "roll", without_stand=models.roll)
    assert "kappa" not in rivals.problems["one pole, no stand"].free
    assert ("one pole, no stand", "one pole") in rivals.nested
