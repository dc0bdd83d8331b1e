"""The unknowns that all flights share, as a vector, and what hangs on them with its derivatives."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from heli_jax.identification.unknowns.layout import Layout, Unknowns


def shared_of(layout: Layout, u: Unknowns) -> Float[Array, " q"]:
    """Parameters, gains and the time shift: all but initial states, biases and offsets.

    Args:
        layout: what the unknowns are.
        u: the unknowns, in the units of the model.
    """
    params, gains = [u.params[n] for n in layout.free], [u.gains[n] for n in layout.gains]
    shift = [] if u.shift is None else [u.shift]
    return jnp.stack([jnp.asarray(v) for v in (*params, *gains, *shift)])


def with_shared(layout: Layout, u: Unknowns, v: Float[Array, " q"]) -> Unknowns:
    """The unknowns with those of a vector in place.

    Args:
        layout: what the unknowns are.
        u: all of them.
        v: as `shared_of` orders them.
    """
    # By the layout's order: JAX sorts the names in every dictionary that it has taken apart.
    values = dict(zip((*layout.free, *layout.gains), v, strict=False))
    return u._replace(
        params={n: values[n] for n in layout.free},
        gains={n: values[n] for n in layout.gains},
        shift=None if u.shift is None else v[-1],
    )


def differentiated[T](make: Callable[[Array], T], v: Float[Array, " q"]) -> tuple[T, T]:
    """Arrays in tuples and their derivatives by v, a last axis; None in place of those that are
    zero.

    Args:
        make: of v.
        v: where.
    """

    moving: list[bool] = []

    # Called beside `make`: which derivatives are zero shows as they are made, and to trace a model
    # once more for it takes as long as to differentiate it.
    @jax.custom_jvp
    def look(*leaves: Array) -> Array:
        return jnp.zeros((), v.dtype)

    def rule(primals: tuple[Array, ...], tangents: tuple[Array, ...]) -> tuple[Array, Array]:
        zero = jax.custom_derivatives.SymbolicZero
        moving[:] = [not isinstance(t, zero) for t in tangents]
        return jnp.zeros((), v.dtype), jnp.zeros((), v.dtype)

    look.defjvp(rule, symbolic_zeros=True)

    def looked_at(v: Array) -> T:
        made = make(v)
        look(*jax.tree.leaves(made))
        return made

    def along(direction: Array) -> tuple[T, T]:
        return jax.jvp(looked_at, (v,), (direction,))

    value, slopes = jax.vmap(along, out_axes=(None, -1))(jnp.eye(v.size, dtype=v.dtype))
    leaves, structure = jax.tree.flatten(slopes)
    kept = [d if moves else None for d, moves in zip(leaves, moving, strict=True)]
    return value, jax.tree.unflatten(structure, kept)
