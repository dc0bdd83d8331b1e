"""Events that end a run: the ground, limits of the rotor speed, or a user's own."""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, PyTree

from heli_jax.dynamics.model import Model
from heli_jax.naming import Record, Scalar
from heli_jax.simulation.hold import at_end

type Event = Callable[[Any, Any, Any], Any]
"""event(params, state, inputs) returns a number above zero while the run continues."""

NO_END = (jnp.inf, -1)
"""Time and index of the event in a run that no event ended."""
_BISECTIONS = 40
"""Number of bisections within a sample. 1e-12 of it is below the error of Hermite's cubic."""


def ground(height: Scalar = 0.0) -> Event:
    """Return the event of the centre of gravity reaching `height` [m] above the origin."""
    return lambda params, state, inputs: state.z - height


def rotor_speed(lowest: Scalar, highest: Scalar) -> Event:
    """Return the event of the rotor speed leaving a range [rad/s]."""
    # One number for both limits, which is zero at the nearer of them.
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
    """Return the states (N,), frozen at the time of the first event.

    Args:
        times: sample times (N,) [s].
        states: the model's State, arrays (N,), constant after the first sample beyond an event.
        inputs: the model's Inputs that acted, arrays (N,).
        linear: True for each input that moves within a sample; () holds all.

    Returns:
        The states, and the time [s] and index of the event (`NO_END` if there was none). Their
            derivatives, of any order and in both modes, include the change of the event's time.
    """

    def values(state: Record, u: Record) -> Array:
        return jnp.stack([jnp.asarray(event(params, state, u)) for event in events.values()])

    # Inputs at the last sample of an interval are those held since its first. All runs of a batch
    # take this path, also those without an event, and the choice is made at the end.
    over = jnp.any(jax.vmap(values)(states, inputs) <= 0, axis=1)
    n = times.shape[0]
    last = jnp.argmax(over)
    k = jnp.clip(last - 1, 0, n - 2)
    x0, x1, u = _pick(states, k), _pick(states, k + 1), _pick(inputs, k)
    if model.sampled is not None:
        # The rates after the sample are those with the new command.
        x0 = model.sampled.update(params, x0, u)
    h = times[k + 1] - times[k]
    u1 = at_end(inputs, k, linear)
    f0, f1 = model.vector_field(params, x0, u), model.vector_field(params, x1, u1)

    one = jnp.ones((), times.dtype)
    end = _Interval(x0, x1, f0, f1, u, u1, h, bool(linear))

    came = jnp.any(over)
    # A run that starts beyond an event ends at its start. A run without an event has no event time,
    # and a slope of 1 keeps its derivatives finite.
    found = came & ~over[0]

    def left(s: Array) -> Array:
        return jnp.where(found, jnp.min(values(end.state(s), end.inputs(s))), s)

    # Bisection instead of Newton, since a user's event may have corners, as `rotor_speed` has.
    def bisected(left: Callable[[Array], Array], start: Array) -> Array:
        def halve(_: Array | int, ends: tuple[Array, Array]) -> tuple[Array, Array]:
            middle = 0.5 * (ends[0] + ends[1])
            after = left(middle) <= 0
            return jnp.where(after, ends[0], middle), jnp.where(after, middle, ends[1])

        _, s = jax.lax.fori_loop(0, _BISECTIONS, halve, (start, one))
        return jnp.where(found, s, start)

    # Derivatives come from the implicit function theorem; bisection has none.
    s = jax.lax.custom_root(left, 0.0 * one, bisected, lambda slope, y: y / slope(one))
    # At that time the event that occurred has the smallest value; the others are above zero.
    which = jnp.argmin(values(end.state(s), end.inputs(s)))
    # Without an event, argmax is 0 and k and s are meaningless; `came` selects the result.
    moment = jnp.where(over[0], times[0], times[k] + s * h)
    rest = jnp.where(came, jnp.arange(n) >= last, False)
    frozen = jax.tree.map(lambda v, e: jnp.where(rest, e, v), states, end.state(s))
    return frozen, (jnp.where(came, moment, jnp.inf), jnp.where(came, which, -1))


class _Interval(NamedTuple):
    """A run between two samples, by the fraction s in [0, 1] of the interval."""

    x0: Record
    x1: Record
    """States at both ends."""
    f0: Record
    f1: Record
    """Rates at both ends."""
    u0: Record
    u1: Record
    """Inputs at both ends."""
    h: Array
    """Length of the interval [s]."""
    moving: bool
    """True if inputs move between the samples."""

    def inputs(self, s: Array) -> Record:
        if not self.moving:
            return self.u0
        return jax.tree.map(lambda a, b: a + s * (b - a), self.u0, self.u1)

    # Hermite's cubic from the rates at both ends is of fourth order in the sample time, as RK4 is.
    # Solver steps need not be repeated.
    def state(self, s: Array) -> Record:
        def cubic(a: Array, b: Array, da: Array, db: Array) -> Array:
            """Interpolate between two values with slopes."""
            rest = 1.0 - s
            ends = rest**2 * (1.0 + 2.0 * s) * a + s**2 * (3.0 - 2.0 * s) * b
            return ends + self.h * s * rest * (rest * da - s * db)

        return jax.tree.map(cubic, self.x0, self.x1, self.f0, self.f1)


def _pick(tree: PyTree, k: Array) -> PyTree:
    return jax.tree.map(lambda v: v[k], tree)
