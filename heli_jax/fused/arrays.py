"""Primitives that select a part of an array in memory, as views."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from heli_jax.fused.code import (
    INDEX,
    Code,
    Operand,
    Stored,
    Value,
    at_place,
    constant,
    scalar,
    shape_of,
)
from heli_jax.fused.operations import OPERATIONS, converted


def moved(code: Code, name: str, inputs: list[Operand], params: dict[str, Any]) -> Operand:
    """Return the result of an operation of `VIEWS`."""
    view = VIEWS[name](code, inputs, params)
    return view if view.shape else scalar(view)


def _view(
    code: Code,
    operand: Operand,
    shape: Sequence[int],
    axes: Sequence[int | None],
    starts: Sequence[Value] = (),
    strides: Sequence[int] = (),
) -> Stored:
    """Return a part of an array as a view.

    Each axis of the array has the view's axis along it (None: length 1 or fixed), a start and a
    stride.
    """
    zero = constant(0, INDEX)

    def element(at: tuple[Value, ...]) -> Value:
        place = []
        for d, axis in enumerate(axes):
            index = zero if axis is None else at[axis]
            if strides and strides[d] != 1:
                index = code.operation("mul", index, constant(strides[d], INDEX))
            place.append(code.operation("add", index, starts[d]) if starts else index)
        return at_place(operand, tuple(place))

    return Stored(tuple(shape), operand.dtype, element)


def _squeezed(code: Code, inputs: list[Operand], params: dict[str, Any]) -> Stored:
    shape = shape_of(inputs[0])
    gone = {d % len(shape) for d in params["dimensions"]}
    kept = [d for d in range(len(shape)) if d not in gone]
    axes = [kept.index(d) if d in kept else None for d in range(len(shape))]
    return _view(code, inputs[0], [shape[d] for d in kept], axes)


def _broadcast(code: Code, inputs: list[Operand], params: dict[str, Any]) -> Stored:
    own, places = shape_of(inputs[0]), params["broadcast_dimensions"]
    axes = [None if n == 1 else d for n, d in zip(own, places, strict=True)]
    return _view(code, inputs[0], params["shape"], axes)


def _sliced(code: Code, inputs: list[Operand], params: dict[str, Any]) -> Stored:
    first, end = params["start_indices"], params["limit_indices"]
    strides = params["strides"] or (1,) * len(first)
    shape = [len(range(*bounds)) for bounds in zip(first, end, strides, strict=True)]
    starts = [constant(n, INDEX) for n in first]
    return _view(code, inputs[0], shape, range(len(shape)), starts, strides)


def _taken(code: Code, inputs: list[Operand], params: dict[str, Any]) -> Stored:
    """Return a view for dynamic_slice, clipped to the array as in JAX."""
    operand, sizes = inputs[0], params["slice_sizes"]
    starts = [
        _within(code, scalar(v), length - size)
        for v, size, length in zip(inputs[1:], sizes, shape_of(operand), strict=True)
    ]
    return _view(code, operand, sizes, range(len(sizes)), starts)


VIEWS = {
    "squeeze": _squeezed,
    "broadcast_in_dim": _broadcast,
    "slice": _sliced,
    "dynamic_slice": _taken,
}


def _within(code: Code, index: Value, most: int) -> Value:
    """Return an index (int32) clipped to 0 and the maximum."""
    # Clip in its own type first: large numbers, from infinity, would wrap in a shorter type. A
    # short type may not reach the maximum, and then needs no upper clip.
    high = constant(min(most, int(np.iinfo(index.dtype).max)), index.dtype)
    inside = OPERATIONS["clamp"](code, constant(0, index.dtype), index, high)
    return converted(code, inside, new_dtype=INDEX)
