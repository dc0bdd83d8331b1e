"""`equinox.filter_jit` for functions called hundreds of times a second."""

import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax


def jitted[**P, R](function: Callable[P, R]) -> Callable[P, R]:
    """Compile a function of arrays and static arguments that returns arrays, as
    `equinox.filter_jit`.

    A call is a tenth of a millisecond faster, as long as a small program itself runs.

    Args:
        function: takes arrays and hashable arguments in any containers that JAX knows, and returns
            arrays in such.
    """

    of_any: Callable[..., R] = function

    def of_leaves(static: tuple[Any, tuple[Any, ...]], arrays: list[Any]) -> R:
        structure, fixed = static
        traced = iter(arrays)
        leaves = [next(traced) if v is None else v[1] for v in fixed]
        args, kwargs = jax.tree.unflatten(structure, leaves)
        return of_any(*args, **kwargs)

    # JAX names programs after functions.
    of_leaves.__name__, of_leaves.__qualname__ = function.__name__, function.__qualname__
    program = jax.jit(of_leaves, static_argnums=0)

    @functools.wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        leaves, structure = jax.tree.flatten((args, kwargs))
        # The key includes the type, since 1, 1.0 and True are equal but traced differently.
        fixed = tuple([None if eqx.is_array(v) else (type(v), v) for v in leaves])
        arrays = [v for v, static in zip(leaves, fixed, strict=True) if static is None]
        return program((structure, fixed), arrays)

    return call
