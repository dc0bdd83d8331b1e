"""Hoisting: the parts of a function that depend on parameters alone are computed once, not at every
step."""

# Why not leave it to XLA: `experiments/benchmarks/helicopter.py` runs batches of vehicles, in which
# each quotient of two parameters is an array. XLA moves few such operations out of the loop over
# time, and divisions are the slowest that there are.

from collections.abc import Callable
from typing import Any

import jax
from jax import core
from jax.extend.core import Literal
from jaxtyping import PyTree

_LONG = 64
"""numbers: more are no state's or output's, but a record's"""


def hoisted(
    function: Callable[..., Any], params: PyTree, *others: PyTree
) -> tuple[list[Any], Callable[..., Any]]:
    """A function of params and others in two parts.

    Returns values that depend on params alone, and a function of these and of others that gives
    what `function(params, *others)` does, operation for operation.

    Args:
        params: what stays the same at every step; its leaves may be tracers.
        *others: examples of what changes; their shapes and types count.
    """
    closed, shape = jax.make_jaxpr(function, return_shape=True)(params, *others)
    jaxpr, structure = closed.jaxpr, jax.tree.structure(shape)
    leaves = jax.tree.leaves(params)
    # The variables of params come first among the inputs, so that zip ends where they do.
    known = dict(zip(jaxpr.invars, leaves, strict=False))
    known |= dict(zip(jaxpr.constvars, closed.consts, strict=True))
    later, repeated = [], []
    # An equation of what is known is computed now; what needs the others, or does more than
    # compute, waits.
    for equation in jaxpr.eqns:
        inputs = [v for v in equation.invars if not isinstance(v, Literal)]
        if equation.effects or not all(v in known for v in inputs) or _along(equation):
            later.append(equation)
            continue
        if _repeats(equation):
            repeated.append(equation)
        alone = jaxpr.replace(
            eqns=[equation], constvars=[], invars=inputs, outvars=equation.outvars,
        )  # fmt: skip
        computed = core.eval_jaxpr(alone, (), *(known[v] for v in inputs))
        known |= dict(zip(equation.outvars, computed, strict=True))
    # A matrix that begins with zeros is made of them now; what waits makes them anew, for it can
    # then tell that they are zeros.
    asked = {v for e in later for v in e.invars if not isinstance(v, Literal)}
    asked |= {v for v in jaxpr.outvars if not isinstance(v, Literal)}
    again = [e for e in repeated if e.outvars[0] in asked]
    known = {v: n for v, n in known.items() if all(v is not e.outvars[0] for e in again)}
    later = again + later
    # Of all that was computed only what a later equation or the result asks for is handed on; the
    # dictionary keeps an order that does not change between runs, or nothing would be found in the
    # cache of compiled programs.
    needed = [v for e in later for v in e.invars] + list(jaxpr.outvars)
    kept = list(dict.fromkeys(v for v in needed if not isinstance(v, Literal) and v in known))
    rest = jaxpr.replace(eqns=later, constvars=kept, invars=jaxpr.invars[len(leaves) :])

    def remaining(values: list[Any], *others: PyTree) -> PyTree:
        leaves = core.eval_jaxpr(rest, values, *jax.tree.leaves(others))
        return jax.tree.unflatten(structure, leaves)

    return [known[v] for v in kept], remaining


def _along(equation: Any) -> bool:
    """True if one number is repeated along a record: that costs nothing if it is read, and a
    record's memory if it is kept."""
    return _repeats(equation) and equation.outvars[0].aval.ndim == 1


def _repeats(equation: Any) -> bool:
    """True if an equation makes a long array of one number."""
    return (
        equation.primitive.name == "broadcast_in_dim"
        and equation.invars[0].aval.size == 1
        and equation.outvars[0].aval.size > _LONG
    )
