"""The primitives that write into an array: `.at[...].set` and the like, at any places."""

import itertools
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from heli_jax.fused.code import Code, UnsupportedError, Value, constant
from heli_jax.fused.operands import MOST, Elements, Operand, elements, scalar
from heli_jax.fused.operations import OPERATIONS, within

type Combined = Callable[[Code, Value, Value], Value]
"""(code, what stands there, what is written) -> what stands there then"""

COMBINED: dict[str, Combined] = {
    "scatter": lambda code, old, new: new,
    **{
        f"scatter{joint}{name}": OPERATIONS[name]
        for name in ("add", "sub", "mul", "min", "max")
        for joint in "-_"
    },
}
"""by the primitive's name"""


def scattered(
    code: Code, inputs: list[Operand], params: dict[str, Any], combined: Combined
) -> Operand:
    """scatter: windows of an array that are written one after the other, so that what is added
    twice at a place counts twice."""
    result, where, new = (elements(code, v) for v in inputs)
    numbers, mode = params["dimension_numbers"], str(params["mode"])
    if numbers.operand_batching_dims:
        raise UnsupportedError("several arrays that are written at places of each one's own")
    axes, inserted = numbers.scatter_dims_to_operand_dims, set(numbers.inserted_window_dims)
    batch, of_window = where.shape[:-1], set(numbers.update_window_dims)
    of_batch = [d for d in range(new.ndim) if d not in of_window]
    new = np.moveaxis(new, of_batch, range(len(batch)))
    lengths = iter(new.shape[len(batch) :])
    window = [1 if d in inserted else next(lengths) for d in range(result.ndim)]
    for at in np.ndindex(batch):
        starts = dict(zip(axes, where[at], strict=True))
        if "CLIP" in mode:
            starts = {d: within(code, i, result.shape[d] - window[d]) for d, i in starts.items()}
        of_place = np.empty((), object)
        of_place[()] = new[at]
        part = new[at] if isinstance(new[at], np.ndarray) else of_place
        result = _put(code, combined, result, starts, part.reshape(window))
    return result


def updated(code: Code, inputs: list[Operand], params: dict[str, Any]) -> Operand:
    """dynamic_update_slice: a window that lies within the array, whatever is asked for."""
    old, new = elements(code, inputs[0]), elements(code, inputs[1])
    most = (n - m for n, m in zip(old.shape, new.shape, strict=True))
    starts = {
        d: within(code, scalar(code, index), last)
        for d, (index, last) in enumerate(zip(inputs[2:], most, strict=True))
    }
    return _put(code, COMBINED["scatter"], old, starts, new)


def _put(
    code: Code, combined: Combined, old: Elements, starts: dict[int, Value], new: Elements
) -> Elements:
    """With a window written, of as many axes as the array; nowhere if a part of it is beyond."""
    result = np.array(old)
    known = {d: int(v.operand) for d, v in starts.items() if not v.operand.startswith("%")}
    places = [
        _places(n, m, known.get(d, None if d in starts else 0))
        for d, (n, m) in enumerate(zip(old.shape, new.shape, strict=True))
    ]
    if int(np.prod([len(p) for p in places])) > MOST:
        raise UnsupportedError(f"a window of {new.shape} at a computed place of {old.shape}")
    for every in itertools.product(*places):
        at, of_new = tuple(p[0] for p in every), tuple(p[1] for p in every)
        # Any: an element, of which NumPy's types make an array as well.
        before: Any = old[at]
        written: Any = new[of_new]
        value = combined(code, before, written)
        here = None
        for d, index in starts.items():
            if d in known:
                continue
            same = code.compare("icmp eq", index, constant(at[d] - of_new[d], index.dtype))
            here = same if here is None else code.operation("and", here, same)
        # One window at most lies on a place.
        result[at] = value if here is None else code.choose(here, value, result[at])
    return result


def _places(length: int, window: int, start: int | None) -> Sequence[tuple[int, int]]:
    """Along an axis, where a window's elements come to lie, and which: for every start that is
    possible where it is not known."""
    possible = range(length - window + 1)
    starts = possible if start is None else [start] if start in possible else []
    return [(begin + k, k) for begin in starts for k in range(window)]
