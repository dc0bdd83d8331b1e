"""The primitives that look something up: tables, and what is next in order.

Those that write into an array, as `.at[...].set` does, stand below.
"""

import itertools
from collections.abc import Callable, Sequence
from typing import Any

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
    at_place,
    constant,
    dtype_of,
    elements,
    scalar,
)
from heli_jax.fused.operations import OPERATIONS, converted, within

_SORTED = 16
"""elements that are sorted at most: more than a hundred exchanges"""


def gathered(code: Code, inputs: list[Operand], params: dict[str, Any]) -> Operand:
    """gather, of one element along each axis that is indexed: `table[i, j]` with arrays i, j."""
    table, where = inputs[0], elements(code, inputs[1])
    numbers, sizes = params["dimension_numbers"], params["slice_sizes"]
    axes = tuple(numbers.start_index_map)
    if set(axes) != set(numbers.collapsed_slice_dims) or numbers.operand_batching_dims:
        raise UnsupportedError("windows of an array at computed places")
    mode = str(params["mode"])
    fills = "FILL" in mode
    rest = [d for d in range(len(table.shape)) if d not in axes]
    batch = where.shape[:-1]
    shape = [0] * (len(batch) + len(rest))
    of_rest = dict(zip(numbers.offset_dims, rest, strict=True))
    places = [d for d in range(len(shape)) if d not in of_rest]
    for d, k in of_rest.items():
        shape[d] = sizes[k]
    for d, n in zip(places, batch, strict=True):
        shape[d] = n
    result = np.empty(shape, object)
    for at in np.ndindex(*shape):
        indices = where[tuple(at[d] for d in places)]
        full: list[Any] = [None] * len(table.shape)
        inside = None
        for axis, index in zip(axes, indices, strict=True):
            place = within(code, index, table.shape[axis] - 1)
            same = code.compare("icmp eq", place, index)
            inside = same if inside is None else code.operation("and", inside, same)
            full[axis] = converted(code, place, new_dtype=INDEX)
        for d, k in of_rest.items():
            full[k] = constant(at[d], INDEX)
        value = at_place(code, table, tuple(full))
        if fills and inside is not None:
            value = code.choose(inside, value, _filling(dtype_of(table), params["fill_value"]))
        result[at] = value
    return result


def _filling(dtype: np.dtype, value: Any) -> Value:
    """Return the value of an element beyond the array, as JAX has it."""
    if value is not None:
        return constant(value, dtype)
    if dtype.kind == "f":
        return constant(np.nan, dtype)
    if dtype.kind == "b":
        return constant(True, dtype)
    limits = np.iinfo(dtype)
    return constant(limits.min if dtype.kind == "i" else limits.max, dtype)


def searched(code: Code, inputs: list[Operand], params: dict[str, Any]) -> Operand:
    """searchsorted, in a table of one axis: how many of its numbers come before each of others."""
    table, asked = inputs[0], elements(code, inputs[1])
    if len(table.shape) != 1 or params["batch_dims"]:
        raise UnsupportedError("several tables that are searched at once")
    result = np.empty(asked.shape, object)
    for at in np.ndindex(*asked.shape):
        # Any: of an array's element NumPy's types make an array as well.
        value: Any = asked[at]
        result[at] = _place(code, table, value, params["side"])
    return result


def _place(code: Code, table: Operand, value: Value, side: str) -> Value:
    (n,), order = table.shape, "gt" if side == "right" else "ge"

    def before(element: Value) -> Value:
        # What is not a number comes behind all others.
        return OPERATIONS["not"](code, OPERATIONS[order](code, element, value))

    if n <= LONG:
        total = constant(0, INDEX)
        for element in elements(code, table):
            one = converted(code, before(element), new_dtype=INDEX)
            total = code.operation("add", total, one)
        return total
    if not isinstance(table, Stored) and table.dtype == object:
        raise UnsupportedError(f"a search in a computed array of {n}")
    # By halves: between `low` and `high` lies the place.
    low, high = constant(0, INDEX), constant(n, INDEX)
    for _ in range(n.bit_length()):
        middle = code.operation("lshr", code.operation("add", low, high), constant(1, INDEX))
        inside = code.intrinsic("smin", middle, constant(n - 1, INDEX))
        open_ = code.compare("icmp slt", low, high)
        further = code.operation("and", open_, before(at_place(code, table, (inside,))))
        nearer = code.operation("and", open_, OPERATIONS["not"](code, further))
        above = code.operation("add", middle, constant(1, INDEX))
        low, high = code.choose(further, above, low), code.choose(nearer, middle, high)
    return low


def padded(code: Code, inputs: list[Operand], params: dict[str, Any]) -> Operand:
    """pad, with one number all around, and between elements."""
    source, value = elements(code, inputs[0]), scalar(code, inputs[1])
    config = params["padding_config"]
    spread = [
        n + max(n - 1, 0) * inner for n, (_, _, inner) in zip(source.shape, config, strict=True)
    ]
    wide = np.empty(
        [n + max(a, 0) + max(b, 0) for n, (a, b, _) in zip(spread, config, strict=True)], object
    )
    for at in np.ndindex(*wide.shape):
        wide[at] = value
    inside = tuple(
        slice(max(a, 0), max(a, 0) + n, inner + 1)
        for n, (a, _, inner) in zip(spread, config, strict=True)
    )
    wide[inside] = source
    cut = tuple(
        slice(max(-a, 0), n - max(-b, 0)) for n, (a, b, _) in zip(wide.shape, config, strict=True)
    )
    return wide[cut]


def in_order(code: Code, inputs: list[Operand], params: dict[str, Any]) -> list[Operand]:
    """sort: neighbours are exchanged until the first array is in order, the others with it."""
    if params["num_keys"] != 1:
        raise UnsupportedError("a sorting by several numbers")
    axis = params["dimension"]
    arrays = [np.array(np.moveaxis(elements(code, v), axis, -1)) for v in inputs]
    *before, n = arrays[0].shape
    if n > _SORTED:
        raise UnsupportedError(f"the sorting of {n} numbers")
    for at in np.ndindex(*before):
        for turn in range(n):
            for k in range(turn % 2, n - 1, 2):
                here, there = (*at, k), (*at, k + 1)
                swap = _behind(code, arrays[0][here], arrays[0][there])
                for array in arrays:
                    a, b = array[here], array[there]
                    array[here] = code.choose(swap, b, a)
                    array[there] = code.choose(swap, a, b)
    return [np.moveaxis(array, -1, axis) for array in arrays]


def _behind(code: Code, a: Value, b: Value) -> Value:
    """True if a number sorts behind another; NaN sorts last."""
    greater = OPERATIONS["gt"](code, a, b)
    if a.dtype.kind != "f":
        return greater
    nothing = code.operation("and", OPERATIONS["ne"](code, a, a), OPERATIONS["eq"](code, b, b))
    return code.operation("or", greater, nothing)


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
    """Write a window of as many axes as the array; nothing is written if a part of it is beyond."""
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
