"""Operations on parameters alone move out of the loop; nothing else changes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from heli_jax import models, naming
from heli_jax.dynamics.model import zeros
from heli_jax.numerics.hoist import hoisted


def operations(function, *arguments):
    """Return the number of each operation in a function, including nested ones."""
    found = {}

    def count(jaxpr):
        for e in jaxpr.eqns:
            found[e.primitive.name] = found.get(e.primitive.name, 0) + 1
            for inner in jax.tree.leaves(e.params, is_leaf=lambda v: hasattr(v, "eqns")):
                if hasattr(getattr(inner, "jaxpr", inner), "eqns"):
                    count(getattr(inner, "jaxpr", inner))

    count(jax.make_jaxpr(function)(*arguments).jaxpr)
    return found


@pytest.mark.parametrize("name", ["roll-on-stand", "helicopter", "helicopter-paper"])
def test_the_equations_stay_as_they_are(vehicles_folder, name):
    from heli_jax import load_vehicle

    file = "bench-30.yaml" if name.startswith("roll") else "x-cell-60.yaml"
    model, params = models.by_name(name), load_vehicle(vehicles_folder / file)
    rng = np.random.default_rng(3)

    def drawn(record):
        return record(**{n: jnp.asarray(0.1 * rng.standard_normal()) for n in naming.names(record)})

    x, u = drawn(model.State), drawn(model.Inputs)
    if "Omega" in naming.names(model.State):
        x = naming.replace(x, Omega=params.Omega)
    values, field = hoisted(model.vector_field, params, zeros(model.State), zeros(model.Inputs))
    for a, b in zip(
        jax.tree.leaves(model.vector_field(params, x, u)), jax.tree.leaves(field(values, x, u)),
        strict=True,
    ):  # fmt: skip
        assert a == b
    before = sum(operations(model.vector_field, params, x, u).values())
    assert sum(operations(field, values, x, u).values()) < before


def test_no_division_by_a_parameter_is_left(bench30):
    model = models.roll_on_stand
    x, u = zeros(model.State), zeros(model.Inputs)
    values, field = hoisted(model.vector_field, bench30, x, u)
    assert operations(model.vector_field, bench30, x, u)["div"] > 3
    assert "div" not in operations(field, values, x, u)


def test_literals_constants_and_outputs_of_parameters_alone():
    table = jnp.arange(3.0)

    def function(p, x):
        a = p["a"]
        return {"alone": a * 2.0, "same": x, "number": 1.0, "both": jnp.sum(table * a) * x}

    p = {"a": jnp.asarray(3.0)}
    values, rest = hoisted(function, p, jnp.asarray(0.0))
    found = rest(values, jnp.asarray(2.0))
    assert found == {"alone": 6.0, "same": 2.0, "number": 1.0, "both": 18.0}
    slope = jax.grad(lambda a: rest(hoisted(function, {"a": a}, 0.0)[0], jnp.asarray(2.0))["both"])
    assert slope(jnp.asarray(3.0)) == 6.0


def test_a_large_matrix_of_parameters_is_made_once():
    def function(p, u, x):
        late = jnp.full((9, 9), 2.0) * x
        return jnp.zeros((9, 9)).at[:2, :2].set(p) @ jnp.ones(9), late, u + jnp.full(100, p[0, 0])

    p, u = jnp.arange(4.0).reshape(2, 2), jnp.arange(100.0)
    values, rest = hoisted(function, p, u, jnp.asarray(0.0))
    left = str(jax.make_jaxpr(rest)(values, u, jnp.asarray(0.0)))
    # Arrays that repeat one number are not stored, only the number.
    assert "scatter" not in left
    assert "dot_general" not in left
    assert sorted(np.shape(v) for v in values) == [(), (9,)]
    for got, expected in zip(rest(values, u, 3.0), function(p, u, 3.0), strict=True):
        np.testing.assert_array_equal(got, expected)
