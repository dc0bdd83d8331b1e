"""What a function makes of the parameters alone, computed once instead of at every step."""

# Why not leave it to XLA: `experiments/benchmarks/helicopter.py` runs batches of vehicles, in which
# each quotient of two parameters is an array. XLA moves few such operations out of the loop over
# time, and divisions are the slowest that there are.

from collections.abc import Callable
from typing import Any

import jax
from jax import core
from jax.extend.core import Literal


def hoisted(
    function: Callable[..., Any], params: Any, *others: Any
) -> tuple[list[Any], Callable[..., Any]]:
    """A function of params and others in two parts.

    Returns values that depend on params alone, and a function of these and of others that gives
    what `function(params, *others)` does, operation for operation. `others` are examples: their
    shapes and types count. XLA itself takes little out of a loop, and with a batch of vehicles
    every division of one parameter by another would be made at every step.
    """
    closed, shape = jax.make_jaxpr(function, return_shape=True)(params, *others)
    jaxpr, structure = closed.jaxpr, jax.tree.structure(shape)
    leaves = jax.tree.leaves(params)
    known = dict(zip(jaxpr.invars, leaves, strict=False))
    known |= dict(zip(jaxpr.constvars, closed.consts, strict=True))
    later = []
    # An equation of what is known is computed now; what needs the others, or does more than
    # compute, waits.
    for equation in jaxpr.eqns:
        inputs = [v for v in equation.invars if not isinstance(v, Literal)]
        if equation.effects or not all(v in known for v in inputs):
            later.append(equation)
            continue
        alone = jaxpr.replace(
            eqns=[equation], constvars=[], invars=inputs, outvars=equation.outvars,
        )  # fmt: skip
        computed = core.eval_jaxpr(alone, (), *(known[v] for v in inputs))
        known |= dict(zip(equation.outvars, computed, strict=True))
    needed = [v for e in later for v in e.invars] + list(jaxpr.outvars)
    kept = list(dict.fromkeys(v for v in needed if not isinstance(v, Literal) and v in known))
    rest = jaxpr.replace(eqns=later, constvars=kept, invars=jaxpr.invars[len(leaves) :])

    def remaining(values: list[Any], *others: Any) -> Any:
        leaves = core.eval_jaxpr(rest, values, *jax.tree.leaves(others))
        return jax.tree.unflatten(structure, leaves)

    return [known[v] for v in kept], remaining
