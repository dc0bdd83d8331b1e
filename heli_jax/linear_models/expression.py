"""Arithmetic expressions for matrix entries: `-1/tau_f`, `Bd/tau_f`, `2*(Lb - g)^2`.

Python's parser builds the tree without evaluating it. Sums, products, quotients, signs, integer
powers of one digit (`^` or `**`), numbers and parameters are allowed; all else is refused.
"""

import ast
import math
import operator
import re
import warnings
from collections.abc import Callable, Mapping
from typing import Any

from heli_jax.errors import nearest

LONGEST = 200
"""Longest expression [characters]."""

# ASCII only, since Python allows names and numbers of other scripts.
_STRAY = re.compile(r"[^-+*/^()A-Za-z0-9_. \t\n]")
_NUMBER = re.compile(r"(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][-+]?[0-9]+)?")
_OPERATORS: dict[type, Callable[[Any, Any], Any]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
}

type Node = ast.expr
"""An expression as a tree."""

type Dimension = tuple[int, ...]
"""Exponents of the base units; an angle counts as a plain number."""


class ExpressionError(ValueError):
    """Error in an expression; the message gives the character's position, from 1."""


def parse(text: str, known: Mapping[str, Any]) -> Node:
    """Return the tree of an expression.

    Args:
        text: the expression, of at most `LONGEST` characters.

    Raises:
        ExpressionError: it is malformed, or names an unknown parameter.
    """
    if len(text) > LONGEST:
        raise ExpressionError(f"expected at most {LONGEST} characters, got {len(text)}")
    # In Python `^` is another operator with another precedence.
    begin = len(text) - len(text.lstrip())
    source = re.sub(r"\s", " ", text[begin:]).replace("^", "**")
    places = [i for i, c in enumerate(text) if i >= begin for _ in range(2 if c == "^" else 1)]

    def wrong(place: int, problem: str) -> ExpressionError:
        return ExpressionError(f"{text!r:.80}, character {place + 1}: {problem}")

    if stray := _STRAY.search(text):
        problem = f"expected numbers, parameters, + - * / ^ and parentheses, got {stray[0]!r}"
        raise wrong(stray.start(), problem)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            tree = ast.parse(source, mode="eval").body
    except SyntaxError as e:
        at = (e.offset or len(source) + 1) - 1
        raise wrong(places[at] if at < len(places) else len(text), e.msg) from e

    def check(node: ast.AST) -> None:
        assert isinstance(node, ast.expr)
        own = source[node.col_offset : node.end_col_offset]
        at = places[node.col_offset]
        match node:
            case ast.Constant(value) if _NUMBER.fullmatch(own):
                if math.isinf(float(value)):  # pyright: ignore[reportArgumentType]
                    raise wrong(at, f"expected a finite number, got {own:.20}")
            case ast.Name(name):
                if name not in known:
                    raise wrong(at, f"unknown parameter {name!r:.40}{nearest(name, known)}")
            case ast.UnaryOp(ast.USub() | ast.UAdd(), of):
                check(of)
            case ast.BinOp(left, ast.Pow(), right):
                check(left)
                # A variable exponent would give the entry a unit that depends on a value.
                if _exponent(right) is None:
                    place = places[right.col_offset]
                    raise wrong(place, f"expected a whole power from -9 to 9, got {own:.20}")
            case ast.BinOp(left, op, right) if type(op) in _OPERATORS:
                check(left)
                check(right)
            case _:
                raise wrong(at, f"expected numbers, parameters, + - * / ^, got {own!r:.40}")

    check(tree)
    return tree


def _exponent(node: Node) -> int | None:
    """Return an integer of one digit, with or without a sign; None for anything else."""
    match node:
        case ast.Constant(value) if type(value) is int and value <= 9:
            return value
        case ast.UnaryOp(sign, ast.Constant(value)) if type(value) is int and value <= 9:
            return -value if isinstance(sign, ast.USub) else value
    return None


def evaluate(node: Node, value: Callable[[str], Any]) -> Any:
    """Return the value of an expression.

    Args:
        value: function that returns a parameter by name: a number or a traced scalar.

    Raises:
        ZeroDivisionError, OverflowError: among plain Python numbers; traced scalars become inf.
    """
    match node:
        case ast.Constant(number):
            return float(number)  # pyright: ignore[reportArgumentType]
        case ast.Name(name):
            return value(name)
        case ast.UnaryOp(sign, of):
            return -evaluate(of, value) if isinstance(sign, ast.USub) else evaluate(of, value)
        case ast.BinOp(of, ast.Pow(), exponent):
            # For an integer power JAX uses products, which have correct derivatives at zero and
            # below.
            return evaluate(of, value) ** _exponent(exponent)
        case ast.BinOp(left, op, right):
            return _OPERATORS[type(op)](evaluate(left, value), evaluate(right, value))


def parameters_of(node: Node) -> frozenset[str]:
    """Return the names of the parameters in an expression."""
    return frozenset(one.id for one in ast.walk(node) if isinstance(one, ast.Name))


def dimension(node: Node, of: Mapping[str, Dimension], plain: Dimension) -> Dimension:
    """Return the dimension of an expression.

    Raises:
        ExpressionError: it adds terms of different dimensions.
    """
    match node:
        case ast.Name(name):
            return of[name]
        case ast.UnaryOp(_, inner):
            return dimension(inner, of, plain)
        case ast.BinOp(inner, ast.Pow(), exponent):
            power = _exponent(exponent)
            assert power is not None
            return tuple(power * n for n in dimension(inner, of, plain))
        case ast.BinOp(left, op, right):
            a, b = dimension(left, of, plain), dimension(right, of, plain)
            if isinstance(op, ast.Mult | ast.Div):
                combine = operator.add if isinstance(op, ast.Mult) else operator.sub
                return tuple(map(combine, a, b))
            # A number in a sum has no unit: the 2 in Lb + 2 could not be given one.
            if a != b:
                sign = "+" if isinstance(op, ast.Add) else "-"
                raise ExpressionError(
                    f"{sign!r} combines terms of different units, expected the same unit on both "
                    "sides (a number with a unit must be a parameter)"
                )
            return a
    return plain
