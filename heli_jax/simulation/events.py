"""Events that end a run: the ground, the limits of the rotor's speed, or anyone's own."""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, PyTree

from heli_jax.dynamics.model import Model
from heli_jax.naming import Record, Scalar
from heli_jax.simulation.hold import at_end

type Event = Callable[[Any, Any, Any], Any]
"""event(params, state, inputs) -> a number, above zero while the run goes on"""

NO_END = (jnp.inf, -1)
"""time and index of the event of a run that none ended"""
_BISECTIONS = 40
"""of a sample: 1e-12 of it, which is below what Hermite's cubic is worth"""


def ground(height: Scalar = 0.0) -> Event:
    """The centre of gravity comes down to `height` [m] above the origin."""
    return lambda params, state, inputs: state.z - height


def rotor_speed(lowest: Scalar, highest: Scalar) -> Event:
    """The rotor's speed leaves the range [rad/s]."""
    # One number for both ends: it falls to zero where the nearer of the two is reached.
    return lambda params, state, inputs: jnp.minimum(state.Omega - lowest, highest - state.Omega)


def any_over(
    events: Mapping[str, Event], params: Record, state: Record, inputs: Record
) -> Bool[Array, ""]:
    """True if one of the events has occurred."""
    return jnp.any(jnp.stack([event(params, state, inputs) <= 0 for event in events.values()]))


def stopped(
    model: Model,
    params: Record,
    events: Mapping[str, Event],
    times: Array,
    states: Record,
    inputs: Record,
    linear: tuple[bool, ...] = (),
) -> tuple[Any, tuple[Array, Array]]:
    """The states (N,) with the moment of the first event in place of all that follow it.

    Args:
        times: of the samples [s], (N,).
        states: the model's State, arrays (N,), constant from the first sample past an event.
        inputs: the model's Inputs that acted, arrays (N,).
        linear: of each input whether it moves within a sample; () holds all.

    Returns:
        The states, and the time [s] and the index of the event (`NO_END` where there was none).
        Their derivatives, of any order and in both modes, count that the moment moves.
    """

    def values(state: Record, u: Record) -> Array:
        return jnp.stack([jnp.asarray(event(params, state, u)) for event in events.values()])

    # Which inputs act at the last sample of an interval is those held since its first.
    # All runs of a batch take this way, also those without an event: nothing here may branch on it,
    # and the choice is made at the end.
    over = jnp.any(jax.vmap(values)(states, inputs) <= 0, axis=1)
    n = times.shape[0]
    last = jnp.argmax(over)
    k = jnp.clip(last - 1, 0, n - 2)
    x0, x1, u = _pick(states, k), _pick(states, k + 1), _pick(inputs, k)
    h = times[k + 1] - times[k]
    u1 = at_end(inputs, k, linear)
    f0, f1 = model.vector_field(params, x0, u), model.vector_field(params, x1, u1)

    one = jnp.ones((), times.dtype)
    end = _Interval(x0, x1, f0, f1, u, u1, h, bool(linear))

    came = jnp.any(over)
    # A run that begins beyond an event ends where it begins; one without an event has no moment,
    # and a slope of 1 keeps its derivatives finite.
    found = came & ~over[0]

    def left(s: Array) -> Array:
        return jnp.where(found, jnp.min(values(end.state(s), end.inputs(s))), s)

    # Bisection, not Newton: an event is anyone's function, with corners (`rotor_speed` has one).
    def bisected(left: Callable[[Array], Array], start: Array) -> Array:
        def halve(_: Array | int, ends: tuple[Array, Array]) -> tuple[Array, Array]:
            middle = 0.5 * (ends[0] + ends[1])
            after = left(middle) <= 0
            return jnp.where(after, ends[0], middle), jnp.where(after, middle, ends[1])

        _, s = jax.lax.fori_loop(0, _BISECTIONS, halve, (start, one))
        return jnp.where(found, s, start)

    # The derivatives are those of the implicit function: bisection itself has none.
    s = jax.lax.custom_root(left, 0.0 * one, bisected, lambda slope, y: y / slope(one))
    # At that moment the one that has come is the smallest; the others are still above zero.
    which = jnp.argmin(values(end.state(s), end.inputs(s)))
    # argmax of no event is 0, so k and s are numbers of no meaning there: `came` chooses.
    moment = jnp.where(over[0], times[0], times[k] + s * h)
    rest = jnp.where(came, jnp.arange(n) >= last, False)
    frozen = jax.tree.map(lambda v, e: jnp.where(rest, e, v), states, end.state(s))
    return frozen, (jnp.where(came, moment, jnp.inf), jnp.where(came, which, -1))


class _Interval(NamedTuple):
    """A run between two samples, by the fraction s in [0, 1] of the time between them."""

    x0: Record
    x1: Record
    """the states at both ends"""
    f0: Record
    f1: Record
    """their rates"""
    u0: Record
    u1: Record
    """the inputs"""
    h: Array
    """[s]"""
    moving: bool
    """whether inputs move between the samples"""

    def inputs(self, s: Array) -> Record:
        if not self.moving:
            return self.u0
        return jax.tree.map(lambda a, b: a + s * (b - a), self.u0, self.u1)

    # Hermite's cubic by the rates at both ends: of fourth order in the sample time, as RK4 is, and
    # no step of a solver has to be made again.
    def state(self, s: Array) -> Record:
        def cubic(a: Array, b: Array, da: Array, db: Array) -> Array:
            """Between two values with their slopes."""
            rest = 1.0 - s
            ends = rest**2 * (1.0 + 2.0 * s) * a + s**2 * (3.0 - 2.0 * s) * b
            return ends + self.h * s * rest * (rest * da - s * db)

        return jax.tree.map(cubic, self.x0, self.x1, self.f0, self.f1)


def _pick(tree: PyTree, k: Array) -> PyTree:
    return jax.tree.map(lambda v: v[k], tree)
