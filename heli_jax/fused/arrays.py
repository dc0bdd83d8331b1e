"""Primitives that move, join, look up and sum elements of arrays.

JAX computes an operation that only moves elements now, on the elements' indices, which shows where
each goes. Long arrays stay in memory, and parts of them are views.
"""

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import jax
import numpy as np

from heli_jax.fused.code import (
    INDEX,
    LONG,
    MOST,
    Code,
    Elements,
    Operand,
    Stored,
    UnsupportedError,
    Value,
    applied,
    at_place,
    constant,
    dtype_of,
    elements,
    scalar,
)
from heli_jax.fused.operations import OPERATIONS, converted

MOVED: dict[str, tuple[int, ...] | None] = {
    **dict.fromkeys(("squeeze", "slice", "broadcast_in_dim", "reshape", "transpose", "rev")),
    **dict.fromkeys(("concatenate", "stack", "unstack", "split", "tile", "pad")),
    **dict.fromkeys(("dynamic_slice", "gather"), (0,)),
    "dynamic_update_slice": (0, 1),
    "scatter": (0, 2),
}
"""Operations that move elements, and the operands with these elements; other operands
are indices.
"""


def moved(code: Code, equation: Any, name: str, inputs: list[Operand]) -> list[Operand]:
    """Return the results of an operation that only moves elements."""
    params, shape = equation.params, equation.outvars[0].aval.shape
    places = MOVED[name] or range(len(inputs))
    indices = [v for i, v in enumerate(inputs) if i not in places]
    computed = any(isinstance(v, Stored) or v.dtype == object for v in indices)
    stays = any(isinstance(v, Stored) for v in inputs)
    # A number repeated along a record is the same wherever it is read.
    along = name == "broadcast_in_dim" and math.prod(inputs[0].shape) == 1
    long = math.prod(shape) > (LONG if along else MOST)
    if name in _VIEWS and (stays or long or computed):
        view = _VIEWS[name](code, inputs, params)
        taken_apart = not view.shape or (computed and not isinstance(inputs[0], Stored))
        return [elements(view) if taken_apart else view]
    if computed or params.get("update_jaxpr") is not None:
        raise UnsupportedError(f"the operation {name} at computed places")
    if long:
        raise UnsupportedError(f"an array of {shape} as a whole")
    numbered: list[Any] = list(inputs)
    every = np.concatenate([elements(inputs[i]).ravel() for i in places])
    count = 0
    for i in places:
        size = math.prod(inputs[i].shape)
        numbered[i] = np.arange(count, count + size, dtype=np.int32).reshape(inputs[i].shape)
        count += size
    results = at_compile_time(equation, numbered)
    if any(((n < 0) | (n >= count)).any() for n in results):
        raise UnsupportedError(f"the operation {name} beyond an array")
    return [np.asarray(every[n], object) for n in results]


def at_compile_time(equation: Any, inputs: Sequence[Any]) -> list[Any]:
    """Compute an operation with known operands."""
    with jax.ensure_compile_time_eval():
        results = equation.primitive.bind(*inputs, **equation.params)
    results = results if equation.primitive.multiple_results else [results]
    return [np.asarray(r) for r in results]


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
        return at_place(code, operand, tuple(place))

    return Stored(tuple(shape), np.dtype(dtype_of(operand)), element)


def _squeezed(code: Code, inputs: list[Operand], params: dict[str, Any]) -> Stored:
    shape = inputs[0].shape
    gone = {d % len(shape) for d in params["dimensions"]}
    kept = [d for d in range(len(shape)) if d not in gone]
    axes = [kept.index(d) if d in kept else None for d in range(len(shape))]
    return _view(code, inputs[0], [shape[d] for d in kept], axes)


def _broadcast(code: Code, inputs: list[Operand], params: dict[str, Any]) -> Stored:
    own, places = inputs[0].shape, params["broadcast_dimensions"]
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
        for v, size, length in zip(inputs[1:], sizes, operand.shape, strict=True)
    ]
    return _view(code, operand, sizes, range(len(sizes)), starts)


_VIEWS = {
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


type _Shaped = Callable[[Code, list[Operand], dict[str, Any]], Operand]


def _fold(operation: str, code: Code) -> np.ufunc:
    return np.frompyfunc(partial(OPERATIONS[operation], code), 2, 1)


def _reduction(operation: str) -> _Shaped:
    def made(code: Code, inputs: list[Operand], params: dict[str, Any]) -> Operand:
        source, axes = elements(inputs[0]), tuple(params["axes"])
        kept = [d for d in range(source.ndim) if d not in axes]
        rows = np.transpose(source, (*kept, *axes)).reshape(*(source.shape[d] for d in kept), -1)
        if rows.shape[-1] == 0:
            raise UnsupportedError(f"{operation} of nothing")
        return np.asarray(_fold(operation, code).reduce(rows, axis=-1), object)

    return made


def _product(code: Code, inputs: list[Operand], params: dict[str, Any]) -> Operand:
    """Translate dot_general of small arrays as sums of products."""
    (of_a, of_b), (batch_a, batch_b) = params["dimension_numbers"]
    dtype = params.get("preferred_element_type") or dtype_of(inputs[0])

    def rows(operand: Operand, summed: Sequence[int], batch: Sequence[int]) -> Elements:
        """Reshape (batches, free axes, summed axes) to (batch..., free, summed)."""
        v = applied(partial(converted, code), elements(operand), new_dtype=dtype)
        free = [d for d in range(v.ndim) if d not in (*summed, *batch)]
        shape = [v.shape[d] for d in (*batch, *free)]
        return np.transpose(v, (*batch, *free, *summed)).reshape(*shape, -1)

    a, b, n = rows(inputs[0], of_a, batch_a), rows(inputs[1], of_b, batch_b), len(batch_a)
    if a.shape[-1] == 0:
        raise UnsupportedError("a product of nothing")
    shape = (*a.shape[:-1], *b.shape[n:-1])
    a = a.reshape(*a.shape[:-1], *[1] * (b.ndim - 1 - n), -1)
    b = b.reshape(*b.shape[:n], *[1] * (len(shape) - b.ndim + 1), *b.shape[n:])
    if math.prod(shape) * a.shape[-1] > MOST:
        raise UnsupportedError(f"a product of {inputs[0].shape} and {inputs[1].shape} as a whole")
    products = applied(partial(OPERATIONS["mul"], code), a, b)
    return np.asarray(_fold("add", code).reduce(products, axis=-1), object)


SHAPED: dict[str, _Shaped] = {
    "reduce_sum": _reduction("add"),
    "reduce_max": _reduction("max"),
    "reduce_min": _reduction("min"),
    "reduce_prod": _reduction("mul"),
    "reduce_and": _reduction("and"),
    "reduce_or": _reduction("or"),
    "dot_general": _product,
}
