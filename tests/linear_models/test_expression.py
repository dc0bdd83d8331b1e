"""The arithmetic of an entry, against Python's own parser and numbers."""

import ast
import operator

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from heli_jax.linear_models import expression
from heli_jax.linear_models.expression import ExpressionError, parse

VALUES = {"g": 9.81, "tau_f": 0.046, "Lb": -166.1, "x1": 2.0}


def ours(text, values=VALUES):
    return expression.evaluate(parse(text, values), values.__getitem__)


OPERATORS = {
    ast.Add: operator.add, ast.Sub: operator.sub, ast.Mult: operator.mul, ast.Div: operator.truediv,
    ast.Pow: operator.pow, ast.USub: operator.neg, ast.UAdd: operator.pos,
}  # fmt: skip


def pythons(text):
    """The value of the tree that Python's parser makes of the same text."""

    def walk(node):
        match node:
            case ast.Constant(value):
                return float(value)
            case ast.Name(name):
                return VALUES[name]
            case ast.UnaryOp(op, of):
                return OPERATORS[type(op)](walk(of))
            case ast.BinOp(left, op, right):
                right = walk(right)
                return OPERATORS[type(op)](walk(left), right)
        raise AssertionError(ast.dump(node))

    return walk(ast.parse(text.strip(), mode="eval").body)


numbers = st.one_of(
    st.integers(0, 99).map(str),
    st.floats(1e-3, 1e3).map(lambda v: f"{v:.3e}"),
    st.sampled_from([".5", "3.", "1E2"]),
)
atoms = st.one_of(numbers, st.sampled_from(sorted(VALUES)))


def larger(inner):
    return st.one_of(
        st.tuples(inner, st.sampled_from(["+", "-", "*", "/", " - ", " * "]), inner).map("".join),
        inner.map(lambda t: f"({t})"),
        inner.map(lambda t: f"-{t}"),
        st.tuples(atoms, st.sampled_from(["**", " ** -"]), st.integers(0, 4).map(str)).map("".join),
    )


@given(st.recursive(atoms, larger, max_leaves=12))
def test_it_computes_what_python_computes(text):
    assume(len(text) <= expression.LONGEST)
    try:
        expected = pythons(text)
    except (ZeroDivisionError, OverflowError) as e:
        with pytest.raises(type(e)):
            ours(text)
        return
    found = ours(text)
    np.testing.assert_allclose(found, expected, rtol=1e-14)
    np.testing.assert_allclose(ours(text.replace("**", "^")), found, rtol=0)


def test_precedence_is_pythons():
    assert ours("-x1^2") == -4.0
    assert ours("2 - 3 - 4") == -5.0
    assert ours("8/2/2") == 2.0
    assert ours("2*-x1^-2") == -0.5
    assert ours("--x1") == 2.0


def test_it_has_derivatives():
    node = parse("-Lb/tau_f^2", VALUES)

    def value(tau):
        return expression.evaluate(node, {"Lb": 3.0, "tau_f": tau}.__getitem__)

    slope = jax.jit(jax.grad(value))(jnp.asarray(0.5))
    np.testing.assert_allclose(slope, 2 * 3.0 / 0.5**3, rtol=1e-14)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("__import__('os')", ["character 1", "unknown parameter '__import__'"]),
        ("g.real", ["character 2", "got '.'"]),
        ("lambda: 1", ["character 7", "got ':'"]),
        ("(" * 10_000, ["at most 200 characters", "got 10000"]),
        ("(" * 100 + "1" + ")" * 99, ["character 21", "more than 20"]),
        ("-" * 150 + "1", ["character 21", "more than 20"]),
        ("٣ + 1", ["character 1", "got '٣'"]),
        ("g²", ["character 2", "got '²'"]),
        ("1e999", ["character 1", "finite"]),
        ("1/tau_ff", ["character 3", "unknown parameter 'tau_ff'", "did you mean 'tau_f'"]),
        ("g^tau_f", ["character 3", "whole power", "got 'tau_f'"]),
        ("g^0.5", ["character 3", "whole power"]),
        ("g^99", ["character 3", "whole power"]),
        ("2^3^2", ["character 4", "expected parentheses"]),
        ("2 g", ["character 3", "expected an operator or the end", "got 'g'"]),
        ("1 +", ["character 4", "got the end"]),
        ("(1 + 2", ["character 1", "never closed"]),
        (")", ["character 1", "got ')'"]),
        ("", ["character 1", "got the end"]),
        ("g\0", ["character 2"]),
        ("1;g", ["character 2", "got ';'"]),
        ("g if g else 1", ["character 3", "got 'if'"]),
        ("1_000", ["character 2", "got '_000'"]),
        ("0x10", ["character 2", "got 'x10'"]),
    ],
)
def test_what_is_none_ends_in_a_sentence_with_its_place(text, words):
    with pytest.raises(ExpressionError) as e:
        parse(text, VALUES)
    said = str(e.value)
    assert "\n" not in said
    assert len(said) < 250
    for word in words:
        assert word in said


@given(st.text(max_size=60))
def test_any_text_is_a_number_or_a_sentence(text):
    try:
        value = ours(text)
    except (ExpressionError, ZeroDivisionError, OverflowError):
        return
    assert isinstance(value, float)


def test_dimensions_are_computed_beside_values():
    of = {"g": (0, 1, -2), "tau_f": (0, 0, 1), "Lb": (0, 0, -2), "x1": (0, 0, 0)}

    def dimension(text):
        return expression.dimension(parse(text, of), of, (0, 0, 0))

    assert dimension("-g*tau_f^2/3") == (0, 1, 0)
    assert dimension("Lb + 1/tau_f**2") == (0, 0, -2)
    assert dimension("x1 - 1") == (0, 0, 0)
    with pytest.raises(ExpressionError, match="'\\+' joins terms of different kinds"):
        dimension("Lb + 1")
