"""What an input does between two samples: it stays (zero-order), or follows a straight line.

A stick that is commanded in steps stays; one that was sampled while it moved does not. To hold such
an input delays it by half a sample on average.
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from heli_jax import naming
from heli_jax.dynamics.model import Model
from heli_jax.errors import InputError, nearest

HOLDS = ("zero-order", "linear")
"""The names of what an input may do between samples."""

type Hold = str | Mapping[str, str] | None
"""one name for all inputs, or names by input"""


def linear_inputs(model: Model, flight: Any, hold: Hold) -> tuple[bool, ...]:
    """Of each of the model's inputs whether it is linear between samples; () where none is.

    Args:
        flight: a Flight, whose own `hold` counts for what `hold` does not name, or Inputs.
        hold: as `simulate` takes it.

    Raises:
        ValueError: an unknown name of an input or of a hold.
    """
    names = naming.names(model.Inputs)
    own = getattr(flight, "hold", None)
    by_name = {n: own.get(n, "zero-order") for n in names} if isinstance(own, dict) else {}
    if isinstance(hold, str):
        by_name = dict.fromkeys(names, hold)
    elif hold is not None:
        for name in hold:
            if name not in names:
                raise ValueError(f"hold: {model.name} has no input {name!r}{nearest(name, names)}")
        by_name |= hold
    for value in by_name.values():
        check_hold(value)
    linear = tuple(by_name.get(n) == "linear" for n in names)
    return linear if any(linear) else ()


def check_hold(value: Any, where: str = "hold") -> None:
    """Refuse what is no hold.

    Raises:
        ValueError: naming the holds there are.
    """
    if value not in HOLDS:
        raise ValueError(f"{where}: expected one of {', '.join(HOLDS)}, got {value!r:.60}")


def at(inputs: Any, k: Any) -> Any:
    """The inputs of sample k; before the first the first, after the last the last."""
    return jax.tree.map(lambda u: u[jnp.clip(k, 0, u.shape[0] - 1)], inputs)


def at_end(inputs: Any, k: Any, linear: tuple[bool, ...]) -> Any:
    """The inputs at the end of the interval from sample k on, before any of them jumps."""
    held = at(inputs, k)
    return _chosen(linear, at(inputs, k + 1), held) if linear else held


class Segment(NamedTuple):
    """A part of a sample interval in which every input stays or follows one straight line."""

    length: Any
    """[s]"""
    inputs: Any
    """at its begin"""
    slope: Any
    """of the inputs, per second; zero where they stay"""


def segments(
    inputs: Any, dt: Any, delay: tuple[Any, Any] | None, k: Any, linear: tuple[bool, ...]
) -> list[Segment]:
    """The parts of the interval from sample k (an integer or a whole array of them) to the next.

    Args:
        inputs: arrays (N,).
        dt: [s].
        delay: None, or the whole samples and the rest in [0, 1) by which the inputs are late: the
            interval then has two parts, before and after the sample that falls into it.
        linear: of each input whether it moves between samples.
    """
    if delay is None:
        now = at(inputs, k)
        return [Segment(dt, now, _slope(linear, now, at(inputs, k + 1), dt))]
    whole, rest = delay
    before, now, after = (at(inputs, k - whole + i) for i in (-1, 0, 1))
    begin = _by_hold(linear, lambda a, b: rest * a + (1.0 - rest) * b, before, now)
    return [
        Segment(rest * dt, begin, _slope(linear, before, now, dt)),
        Segment((1.0 - rest) * dt, now, _slope(linear, now, after, dt)),
    ]


def _slope(linear: tuple[bool, ...], first: Any, second: Any, dt: Any) -> Any:
    slopes = _by_hold(linear, lambda a, b: (b - a) / dt, first, second)
    held = jax.tree.map(jnp.zeros_like, first)
    return _chosen(linear, slopes, held)


def delayed(inputs: Any, whole: Any, rest: Any, n: int, linear: tuple[bool, ...]) -> Any:
    """The inputs that act at the n samples when they are late by `whole` + `rest` samples."""
    k = jnp.arange(n) - whole
    held = at(inputs, k - (rest > 0).astype(int))
    if not linear:
        return held
    before, now = at(inputs, k - 1), at(inputs, k)
    between = jax.tree.map(lambda a, b: rest * a + (1.0 - rest) * b, before, now)
    return _chosen(linear, between, held)


def _by_hold(linear: tuple[bool, ...], moving: Callable[..., Any], first: Any, second: Any) -> Any:
    """moving(first, second) for the inputs that are linear, the first for the others."""
    return _chosen(linear, jax.tree.map(moving, first, second), first)


def _chosen(linear: tuple[bool, ...], moving: Any, held: Any) -> Any:
    leaves = zip(linear, jax.tree.leaves(moving), jax.tree.leaves(held), strict=True)
    return jax.tree.unflatten(jax.tree.structure(held), [a if is_ else b for is_, a, b in leaves])


def refuse_delays(model: Model) -> None:
    """Refuse a model whose inputs act late: nothing here delays one input by itself.

    Raises:
        InputError: the model has `delays`.
    """
    if model.delays:
        late = ", ".join(f"{name} by {parameter}" for name, parameter in model.delays)
        raise InputError(
            f"model {model.name} delays {late}, which no simulation does yet; expected a model "
            "without delays"
        )
