"""Events that end a run: the ground, the limits of the rotor's speed, or anyone's own."""

from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from heli_jax.dynamics.model import Model
from heli_jax.simulation.hold import at_end

type Event = Callable[[Any, Any, Any], Any]
"""event(params, state, inputs) -> a number, above zero while the run goes on"""

NO_END = (jnp.inf, -1)
_BISECTIONS = 40


def ground(height: Any = 0.0) -> Event:
    """The centre of gravity comes down to `height` [m] above the origin."""
    return lambda params, state, inputs: state.z - height


def rotor_speed(lowest: Any, highest: Any) -> Event:
    """The rotor's speed leaves the range [rad/s]."""
    return lambda params, state, inputs: jnp.minimum(state.Omega - lowest, highest - state.Omega)


def any_over(events: Mapping[str, Event], params: Any, state: Any, inputs: Any) -> Bool[Array, ""]:
    """Whether one of the events has come."""
    return jnp.any(jnp.stack([event(params, state, inputs) <= 0 for event in events.values()]))


def stopped(
    model: Model,
    params: Any,
    events: Mapping[str, Event],
    times: Array,
    states: Any,
    inputs: Any,
    linear: tuple[bool, ...] = (),
) -> tuple[Any, tuple[Array, Array]]:
    """The states (N,) with the moment of the first event in place of all that follow it.

    Within the sample the states are followed by Hermite's cubic, of fourth order in the sample
    time. `linear` says of each input whether it moves there. Returns the states, and the time [s]
    and the index of the event.
    """

    def values(state: Any, u: Any) -> Array:
        return jnp.stack([jnp.asarray(event(params, state, u)) for event in events.values()])

    # Which inputs act at the last sample of an interval is those held since its first.
    over = jnp.any(jax.vmap(values)(states, inputs) <= 0, axis=1)
    n = times.shape[0]
    last = jnp.argmax(over)
    k = jnp.clip(last - 1, 0, n - 2)
    x0, x1, u = _pick(states, k), _pick(states, k + 1), _pick(inputs, k)
    h = times[k + 1] - times[k]
    u1 = at_end(inputs, k, linear)
    f0, f1 = model.vector_field(params, x0, u), model.vector_field(params, x1, u1)

    def acting(s: Array) -> Any:
        return jax.tree.map(lambda a, b: a + s * (b - a), u, u1) if linear else u

    def along(s: Array) -> Any:
        def one(a: Array, b: Array, da: Array, db: Array) -> Array:
            rest = 1.0 - s
            ends = rest**2 * (1.0 + 2.0 * s) * a + s**2 * (3.0 - 2.0 * s) * b
            return ends + h * s * rest * (rest * da - s * db)

        return jax.tree.map(one, x0, x1, f0, f1)

    def halve(_: Any, ends: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = ends
        middle = 0.5 * (low + high)
        after = jnp.any(values(along(middle), acting(middle)) <= 0)
        return jnp.where(after, low, middle), jnp.where(after, middle, high)

    one = jnp.ones((), times.dtype)
    _, s = jax.lax.fori_loop(0, _BISECTIONS, halve, (0.0 * one, one))
    s = jnp.where(over[0], 0.0, s)
    which = jnp.argmin(values(along(s), acting(s)))
    came = jnp.any(over)
    moment = jnp.where(over[0], times[0], times[k] + s * h)
    rest = jnp.where(came, jnp.arange(n) >= last, False)
    frozen = jax.tree.map(lambda v, e: jnp.where(rest, e, v), states, along(s))
    return frozen, (jnp.where(came, moment, jnp.inf), jnp.where(came, which, -1))


def _pick(tree: Any, k: Array) -> Any:
    return jax.tree.map(lambda v: v[k], tree)
