"""Hoisting: expressions of parameters alone are computed once, not at every step."""

# `experiments/benchmarks/helicopter.py` runs batches of vehicles, where each quotient of two
# parameters is an array. XLA moves few such operations out of the loop over time, and divisions are
# the slowest.

from collections.abc import Callable
from typing import Any

import jax
from jax import core
from jax.extend.core import Literal
from jaxtyping import PyTree

_LONG = 64
"""Size above which an array belongs to a record, not to a state or output."""


def hoisted(
    function: Callable[..., Any], params: PyTree, *others: PyTree
) -> tuple[list[Any], Callable[..., Any]]:
    """Split a function of params and others into two parts.

    Returns values that depend only on params, and a function of these and others. It performs the
    same operations as `function(params, *others)`.

    Args:
        params: constant over the steps; leaves may be tracers.
        *others: examples of changing arguments; only shapes and types matter.
    """
    closed, shape = jax.make_jaxpr(function, return_shape=True)(params, *others)
    jaxpr, structure = closed.jaxpr, jax.tree.structure(shape)
    leaves = jax.tree.leaves(params)
    # The variables of params come first, so zip ends with them.
    known = dict(zip(jaxpr.invars, leaves, strict=False))
    known |= dict(zip(jaxpr.constvars, closed.consts, strict=True))
    later, repeated = [], []
    # Equations of known values are computed now. Operations with other inputs or side effects wait.
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
    # Matrices that start as zeros are made now. The remaining part makes them again, since it can
    # then see that they are zeros.
    used = {v for e in later for v in e.invars if not isinstance(v, Literal)}
    used |= {v for v in jaxpr.outvars if not isinstance(v, Literal)}
    again = [e for e in repeated if e.outvars[0] in used]
    known = {v: n for v, n in known.items() if all(v is not e.outvars[0] for e in again)}
    later = again + later
    # Only values that later equations or the result need are passed on. A dictionary keeps a fixed
    # order, which the compilation cache needs.
    needed = [v for e in later for v in e.invars] + list(jaxpr.outvars)
    kept = list(dict.fromkeys(v for v in needed if not isinstance(v, Literal) and v in known))
    rest = jaxpr.replace(eqns=later, constvars=kept, invars=jaxpr.invars[len(leaves) :])

    def remaining(values: list[Any], *others: PyTree) -> PyTree:
        leaves = core.eval_jaxpr(rest, values, *jax.tree.leaves(others))
        return jax.tree.unflatten(structure, leaves)

    return [known[v] for v in kept], remaining


def _along(equation: Any) -> bool:
    """True if a number is repeated along a record, which is free to read but not to store."""
    return _repeats(equation) and equation.outvars[0].aval.ndim == 1


def _repeats(equation: Any) -> bool:
    """True if an equation makes a long array of one number."""
    return (
        equation.primitive.name == "broadcast_in_dim"
        and equation.invars[0].aval.size == 1
        and equation.outvars[0].aval.size > _LONG
    )
