"""The arithmetic that an entry of a matrix may be: `-1/tau_f`, `Bd/tau_f`, `2*(Lb - g)^2`.

    sum     = product { ("+" | "-") product }
    product = signed { ("*" | "/") signed }
    signed  = [ "-" | "+" ] signed | power
    power   = atom [ ("^" | "**") [ "-" | "+" ] digits ]
    atom    = number | name | "(" sum ")"

A grammar of our own, since Python's `eval` would run whatever stands in the file. Precedence is
that of Python: -a^2 is -(a^2). Lengths and depths are bounded, so that no file exhausts the stack.
"""

import re
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

from heli_jax.errors import nearest

LONGEST = 200
"""characters of an expression"""
DEEPEST = 20
"""parentheses and signs within each other"""
HIGHEST = 9
"""the largest power, positive or negative"""

# ASCII alone: \d and \w would take digits and letters of other scripts.
_TOKEN = re.compile(
    r"(?P<number>(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][-+]?[0-9]+)?)"
    r"|(?P<name>[A-Za-z_][A-Za-z0-9_]*)"
    r"|(?P<sign>\*\*|[-+*/^()])"
)


class ExpressionError(ValueError):
    """An expression is wrong; the sentence says at which character, from 1."""


class Number(NamedTuple):
    """A number as it is written."""

    value: float


class Parameter(NamedTuple):
    """A parameter by its name."""

    name: str


class Negative(NamedTuple):
    """-of"""

    of: "Node"


class Power(NamedTuple):
    """of^exponent with a whole exponent."""

    of: "Node"
    exponent: int


class Binary(NamedTuple):
    """left operator right, the operator one of + - * /"""

    operator: str
    left: "Node"
    right: "Node"


type Node = Number | Parameter | Negative | Power | Binary
"""An expression as a tree."""

type Dimension = tuple[int, ...]
"""Exponents of the base units; an angle counts as a plain number."""


def parse(text: str, known: Mapping[str, Any]) -> Node:
    """The tree of an expression.

    Args:
        text: the expression, of at most `LONGEST` characters.

    Raises:
        ExpressionError: it is none, or names a parameter that is not known.
    """
    # Before any token is read: the depth alone would not bound the time that a long sum takes.
    if len(text) > LONGEST:
        raise ExpressionError(f"expected at most {LONGEST} characters, got {len(text)}")
    return _Parser(text, known).whole()


class _Token(NamedTuple):
    kind: str
    """number, name, sign or end"""
    text: str
    at: int
    """character, from 1"""


class _Parser:
    """Recursive descent: one method a rule of the grammar."""

    def __init__(self, text: str, known: Mapping[str, Any]) -> None:
        self.text, self.known, self.depth = text, known, 0
        self.tokens = _tokens(text)
        self.now = next(self.tokens)

    def take(self) -> _Token:
        taken = self.now
        # The end is never consumed, so that every rule can look at the next token without asking
        # whether there is one.
        if taken.kind != "end":
            self.now = next(self.tokens)
        return taken

    def refuse(self, problem: str, token: _Token) -> ExpressionError:
        return ExpressionError(f"{self.text!r:.80}, character {token.at}: {problem}")

    def whole(self) -> Node:
        node = self.sum()
        if self.now.kind != "end":
            raise self.refuse(f"expected an operator or the end, got {self.now.text!r}", self.now)
        return node

    def sum(self) -> Node:
        node = self.product()
        while self.now.text in ("+", "-"):
            operator = self.take().text
            # From the left, as Python has it: a - b - c is (a - b) - c.
            node = Binary(operator, node, self.product())
        return node

    def product(self) -> Node:
        node = self.signed()
        while self.now.text in ("*", "/"):
            operator = self.take().text
            node = Binary(operator, node, self.signed())
        return node

    def signed(self) -> Node:
        if self.now.text not in ("-", "+"):
            return self.power()
        # A chain of signs calls this rule again for each, so it counts as depth like a parenthesis.
        sign = self.take()
        self.deeper(sign)
        of = self.signed()
        self.depth -= 1
        # A plus changes nothing, and needs no node.
        return Negative(of) if sign.text == "-" else of

    def power(self) -> Node:
        base = self.atom()
        if self.now.text not in ("^", "**"):
            return base
        self.take()
        # A whole number of one digit and no expression: a free exponent would give the entry a unit
        # that depends on a value, and a power of a negative number is real for whole ones alone.
        negative = self.now.text in ("-", "+") and self.take().text == "-"
        token = self.take()
        if not token.text.isdigit() or len(token.text) > 1:
            raise self.refuse(
                f"expected a whole power from -{HIGHEST} to {HIGHEST}, got {_shown(token)}", token
            )
        # a^b^c is read from the right by some programs and from the left by others: the file has to
        # say.
        if self.now.text in ("^", "**"):
            raise self.refuse("a power of a power, expected parentheses", self.now)
        return Power(base, -int(token.text) if negative else int(token.text))

    def atom(self) -> Node:
        token = self.take()
        if token.kind == "number":
            value = float(token.text)
            # Digits cannot be wrong, but 1e999 is more than a float64 holds.
            if value == float("inf"):
                raise self.refuse(f"expected a finite number, got {token.text:.20}", token)
            return Number(value)
        if token.kind == "name":
            if token.text not in self.known:
                raise self.refuse(
                    f"unknown parameter {token.text!r:.40}{nearest(token.text, self.known)}", token
                )
            return Parameter(token.text)
        if token.text == "(":
            self.deeper(token)
            node = self.sum()
            if self.take().text != ")":
                raise self.refuse("this parenthesis is never closed", token)
            self.depth -= 1
            return node
        raise self.refuse(
            f"expected a number, a parameter or a parenthesis, got {_shown(token)}", token
        )

    def deeper(self, token: _Token) -> None:
        self.depth += 1
        if self.depth > DEEPEST:
            raise self.refuse(f"more than {DEEPEST} parentheses and signs deep", token)


def _shown(token: _Token) -> str:
    return "the end" if token.kind == "end" else repr(token.text[:20])


def _tokens(text: str) -> Iterator[_Token]:
    at = 0
    while at < len(text):
        if text[at] in " \t\n":
            at += 1
            continue
        match = _TOKEN.match(text, at)
        if match is None:
            raise ExpressionError(
                f"{text!r:.80}, character {at + 1}: expected numbers, parameters, + - * / ^ and "
                f"parentheses, got {text[at]!r}"
            )
        yield _Token(str(match.lastgroup), match.group(), at + 1)
        at = match.end()
    # A token of its own for the end, so that a message about it has a place in the text.
    yield _Token("end", "", len(text) + 1)


def evaluate(node: Node, value: Callable[[str], Any]) -> Any:
    """The value of an expression.

    Args:
        value: value(name) of a parameter: a number or a traced scalar.

    Raises:
        ZeroDivisionError, OverflowError: among plain Python numbers; traced scalars become inf.
    """
    match node:
        case Number(number):
            return number
        case Parameter(name):
            return value(name)
        case Negative(of):
            return -evaluate(of, value)
        case Power(of, exponent):
            # The exponent is a plain integer and is never traced: JAX makes products of it, whose
            # derivative is right for a negative value and at zero.
            return evaluate(of, value) ** exponent
        case Binary(operator, left, right):
            a, b = evaluate(left, value), evaluate(right, value)
            if operator == "+":
                return a + b
            if operator == "-":
                return a - b
            # The same code serves plain numbers when a file is checked and traced ones when it is
            # run.
            return a * b if operator == "*" else a / b


def parameters_of(node: Node) -> frozenset[str]:
    """The parameters that an expression names."""
    match node:
        case Number():
            return frozenset()
        case Parameter(name):
            return frozenset([name])
        case Negative(of) | Power(of):
            return parameters_of(of)
        case Binary(_, left, right):
            return parameters_of(left) | parameters_of(right)


def dimension(node: Node, of: Mapping[str, Dimension], plain: Dimension) -> Dimension:
    """The dimension of an expression.

    Raises:
        ExpressionError: it adds what cannot be added.
    """
    match node:
        case Number():
            return plain
        case Parameter(name):
            return of[name]
        case Negative(inner):
            return dimension(inner, of, plain)
        case Power(inner, exponent):
            return tuple(exponent * n for n in dimension(inner, of, plain))
        case Binary(operator, left, right):
            a, b = dimension(left, of, plain), dimension(right, of, plain)
            if operator == "*":
                return tuple(i + j for i, j in zip(a, b, strict=True))
            if operator == "/":
                return tuple(i - j for i, j in zip(a, b, strict=True))
            # A number in a sum is one without a unit: whether 2 in Lb + 2 is per second nobody
            # could tell.
            if a != b:
                raise ExpressionError(
                    f"{operator!r} joins terms of different kinds, expected the same unit on both "
                    "sides (a number with a unit is a parameter)"
                )
            return a
