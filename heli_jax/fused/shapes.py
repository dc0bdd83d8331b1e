"""The primitives that change the shape of arrays, or sum over them.

conv_general_dilated, which jnp.convolve and jnp.correlate are made of, is written out in sums.
"""

import itertools
from collections.abc import Callable
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
from heli_jax.fused.lookups import gathered, padded, searched, updated
from heli_jax.fused.operations import OPERATIONS, converted, in_type, within


def _moved(
    operand: Stored, shape: tuple[int, ...], where: Callable[[tuple[Value, ...]], tuple[Value, ...]]
) -> Stored:
    """Another view of what is stored."""
    return Stored(shape, operand.dtype, lambda at: operand.element(where(at)))


def _squeezed(code: Code, inputs: list[Operand], params: dict[str, Any]) -> Operand:
    (operand,) = inputs
    gone = {d % len(operand.shape) for d in params["dimensions"]}
    if not isinstance(operand, Stored):
        return np.squeeze(operand, tuple(gone))
    zero = constant(0, INDEX)
    shape = tuple(n for d, n in enumerate(operand.shape) if d not in gone)

    def where(at: tuple[Value, ...]) -> tuple[Value, ...]:
        rest = iter(at)
        return tuple(zero if d in gone else next(rest) for d in range(len(operand.shape)))

    view = _moved(operand, shape, where)
    return view if shape else _only(view)


def _only(operand: Stored) -> Elements:
    """The one element of a view without dimensions."""
    single = np.empty((), object)
    single[()] = operand.element(())
    return single


def _taken(code: Code, inputs: list[Operand], params: dict[str, Any]) -> Operand:
    """dynamic_slice."""
    operand, starts = inputs[0], [scalar(code, v) for v in inputs[1:]]
    sizes = params["slice_sizes"]
    indices = []
    for start, size, length in zip(starts, sizes, operand.shape, strict=True):
        # Within the array whatever is asked for, as JAX has it; in its own type first, of which
        # the largest numbers, made of what is infinite, are others in a shorter one.
        indices.append(converted(code, within(code, start, length - size), new_dtype=INDEX))
    if isinstance(operand, Stored):
        return _moved(
            operand,
            tuple(sizes),
            lambda at: tuple(code.operation("add", i, a) for i, a in zip(indices, at, strict=True)),
        )
    result = np.empty(sizes, object)
    for at in np.ndindex(*sizes):
        places = [
            code.operation("add", i, constant(a, INDEX)) for i, a in zip(indices, at, strict=True)
        ]
        result[at] = at_place(code, operand, tuple(places))
    return result


def _cut(code: Code, inputs: list[Operand], params: dict[str, Any]) -> Operand:
    """slice, of fixed bounds."""
    (operand,) = inputs
    strides = params["strides"] or (1,) * len(operand.shape)
    bounds = tuple(zip(params["start_indices"], params["limit_indices"], strides, strict=True))
    if not isinstance(operand, Stored):
        return operand[tuple(slice(*b) for b in bounds)]
    shape = tuple(len(range(*b)) for b in bounds)

    def where(at: tuple[Value, ...]) -> tuple[Value, ...]:
        moved = []
        for index, (start, _, stride) in zip(at, bounds, strict=True):
            scaled = code.operation("mul", index, constant(stride, INDEX))
            moved.append(code.operation("add", scaled, constant(start, INDEX)))
        return tuple(moved)

    return _moved(operand, shape, where)


def _broadcast(code: Code, inputs: list[Operand], params: dict[str, Any]) -> Operand:
    operand, shape, places = inputs[0], tuple(params["shape"]), params["broadcast_dimensions"]
    size = int(np.prod(shape))
    # One number along a record is that number wherever it is read.
    along = size > LONG and int(np.prod(operand.shape)) == 1
    if size > MOST or along or isinstance(operand, Stored):
        zero = constant(0, INDEX)

        def element(at: tuple[Value, ...]) -> Value:
            inner = tuple(zero if operand.shape[i] == 1 else at[d] for i, d in enumerate(places))
            return at_place(code, operand, inner)

        return Stored(shape, np.dtype(dtype_of(operand)), element)
    source = operand if operand.dtype == object else elements(code, operand)
    unit = [1] * len(shape)
    for i, d in enumerate(places):
        unit[d] = source.shape[i]
    return np.broadcast_to(source.reshape(unit), shape)


def _reshaped(code: Code, inputs: list[Operand], params: dict[str, Any]) -> Operand:
    return elements(code, inputs[0]).reshape(params["new_sizes"])


def _transposed(code: Code, inputs: list[Operand], params: dict[str, Any]) -> Operand:
    return np.transpose(elements(code, inputs[0]), params["permutation"])


def _joined(code: Code, inputs: list[Operand], params: dict[str, Any]) -> Operand:
    return np.concatenate([elements(code, v) for v in inputs], params["dimension"])


def _stacked(code: Code, inputs: list[Operand], params: dict[str, Any]) -> Operand:
    return np.stack([elements(code, v) for v in inputs], params["axis"])


def _reversed(code: Code, inputs: list[Operand], params: dict[str, Any]) -> Operand:
    return np.flip(elements(code, inputs[0]), tuple(params["dimensions"]))


def _reduction(operation: str) -> Callable[[Code, list[Operand], dict[str, Any]], Operand]:
    def made(code: Code, inputs: list[Operand], params: dict[str, Any]) -> Operand:
        source = elements(code, inputs[0])
        axes = tuple(params["axes"])
        kept = [d for d in range(source.ndim) if d not in axes]
        moved = np.transpose(source, (*kept, *axes)).reshape(*(source.shape[d] for d in kept), -1)
        if moved.shape[-1] == 0:
            raise UnsupportedError(f"{operation} of nothing")
        result = np.empty(moved.shape[:-1], object)
        for at in np.ndindex(result.shape):
            total = moved[at][0]
            for value in moved[at][1:]:
                total = OPERATIONS[operation](code, total, value)
            result[at] = total
        return result

    return made


def _anywhere(operation: str) -> Callable[[Code, list[Operand], dict[str, Any]], Operand]:
    """Over all axes. Equinox asks so whether any of a batch needs something; here each vehicle asks
    for itself, and gets the same."""

    def made(code: Code, inputs: list[Operand], params: dict[str, Any]) -> Operand:
        axes = tuple(range(len(inputs[0].shape)))
        return _reduction(operation)(code, inputs, {"axes": axes})

    return made


def _running(operation: str) -> Callable[[Code, list[Operand], dict[str, Any]], Operand]:
    """cumsum and the like."""

    def made(code: Code, inputs: list[Operand], params: dict[str, Any]) -> Operand:
        source = np.moveaxis(elements(code, inputs[0]), params["axis"], 0)
        source = source[::-1] if params["reverse"] else source
        result = np.array(source)
        for k in range(1, len(source)):
            for at in np.ndindex(source.shape[1:]):
                result[(k, *at)] = OPERATIONS[operation](
                    code, result[(k - 1, *at)], source[(k, *at)]
                )
        return np.moveaxis(result[::-1] if params["reverse"] else result, 0, params["axis"])

    return made


def _where_extreme(order: str) -> Callable[[Code, list[Operand], dict[str, Any]], Operand]:
    """argmax and argmin: the first of the best, or the first that is not a number."""

    def made(code: Code, inputs: list[Operand], params: dict[str, Any]) -> Operand:
        (axis,), dtype = params["axes"], np.dtype(params["index_dtype"])
        source = np.moveaxis(elements(code, inputs[0]), axis, 0)
        result = np.empty(source.shape[1:], object)
        for at in np.ndindex(result.shape):
            best, place = source[(0, *at)], constant(0, dtype)
            for k in range(1, len(source)):
                value = source[(k, *at)]
                keep = code.operation(
                    "or",
                    OPERATIONS[order](code, best, value),
                    OPERATIONS["ne"](code, best, best),
                )
                place = code.choose(keep, place, constant(k, dtype))
                best = code.choose(keep, best, value)
            result[at] = place
        return result

    return made


def _product(code: Code, inputs: list[Operand], params: dict[str, Any]) -> Operand:
    """dot_general, of small arrays: sums of products written out."""
    dtype = params.get("preferred_element_type")
    a, b = (in_type(code, elements(code, v), dtype) for v in inputs)
    (of_a, of_b), (batch_a, _) = params["dimension_numbers"]
    if batch_a:
        return _products(code, a, b, params)
    free_a = [d for d in range(a.ndim) if d not in of_a]
    free_b = [d for d in range(b.ndim) if d not in of_b]
    shape = (*(a.shape[d] for d in free_a), *(b.shape[d] for d in free_b))
    rows = np.transpose(a, (*free_a, *of_a)).reshape(-1, int(np.prod([a.shape[d] for d in of_a])))
    columns = np.transpose(b, (*free_b, *of_b)).reshape(-1, rows.shape[1])
    result = np.empty((len(rows), len(columns)), object)
    for i, j in itertools.product(range(len(rows)), range(len(columns))):
        total = None
        for x, y in zip(rows[i], columns[j], strict=True):
            term = OPERATIONS["mul"](code, x, y)
            total = term if total is None else OPERATIONS["add"](code, total, term)
        if total is None:
            raise UnsupportedError("a product of nothing")
        result[i, j] = total
    return result.reshape(shape)


def _products(code: Code, a: Elements, b: Elements, params: dict[str, Any]) -> Elements:
    """Multiply batches, which come first in the result."""
    (of_a, of_b), (batch_a, batch_b) = params["dimension_numbers"]
    a = np.moveaxis(a, batch_a, range(len(batch_a)))
    b = np.moveaxis(b, batch_b, range(len(batch_b)))

    def within(axes: Any, batch: Any, ndim: int) -> tuple[int, ...]:
        left = [d for d in range(ndim) if d not in batch]
        return tuple(left.index(d) for d in axes)

    numbers = (within(of_a, batch_a, a.ndim), within(of_b, batch_b, b.ndim)), ((), ())
    batches = a.shape[: len(batch_a)]
    each = [
        _product(code, [a[at], b[at]], {"dimension_numbers": numbers}) for at in np.ndindex(batches)
    ]
    assert not any(isinstance(v, Stored) for v in each)
    made = np.empty((len(each), *each[0].shape), object)
    for k, value in enumerate(each):
        made[k] = value
    return made.reshape(*batches, *each[0].shape)


def convolved(code: Code, inputs: list[Operand], params: dict[str, Any]) -> Operand:
    """Convolve small arrays, with padding, strides and dilations."""
    if params["feature_group_count"] != 1 or params["batch_group_count"] != 1:
        raise UnsupportedError("a convolution in groups")
    of_a, of_b, of_result = params["dimension_numbers"]
    dtype = params["preferred_element_type"]
    a, b = (in_type(code, elements(code, v), dtype) for v in inputs)
    # (batch, features, ...), (features of the result, features, ...)
    a, b = np.transpose(a, of_a), np.transpose(b, of_b)
    axes = [
        _terms(n, m, *of_axis)
        for n, m, *of_axis in zip(
            a.shape[2:],
            b.shape[2:],
            params["window_strides"],
            params["padding"],
            params["lhs_dilation"],
            params["rhs_dilation"],
            strict=True,
        )
    ]
    shape = (a.shape[0], b.shape[0], *(len(axis) for axis in axes))
    if np.prod(shape) * np.prod(b.shape[1:]) > MOST:
        raise UnsupportedError(f"a convolution of {a.shape[2:]} with {b.shape[2:]} as a whole")
    result = np.empty(shape, object)
    for i, j, *at in np.ndindex(shape):
        total: Any = constant(0, a.ravel()[0].dtype)
        pairs = itertools.product(*(axis[k] for axis, k in zip(axes, at, strict=True)))
        first = True
        for pair, feature in itertools.product(pairs, range(a.shape[1])):
            x: Any = a[(i, feature, *(p[0] for p in pair))]
            y: Any = b[(j, feature, *(p[1] for p in pair))]
            term = OPERATIONS["mul"](code, x, y)
            total, first = term if first else OPERATIONS["add"](code, total, term), False
        result[(i, j, *at)] = total
    return _back(result, of_result)


def _back(result: Elements, order: tuple[int, ...]) -> Elements:
    """Return the result with its axes in the stated order."""
    return np.transpose(result, np.argsort(order))


def _terms(
    n: int, m: int, stride: int, padding: tuple[int, int], spread_a: int, spread_b: int
) -> list[list[tuple[int, int]]]:
    """Along an axis, for each place of the result the places of both arrays whose products it is
    the sum of; what was padded is zero and has none."""
    whole = spread_a * (n - 1) + 1 + sum(padding) - spread_b * (m - 1)
    terms = []
    for k in range(0, whole, stride):
        at = [(k + spread_b * j - padding[0], j) for j in range(m)]
        terms.append(
            [(i // spread_a, j) for i, j in at if i % spread_a == 0 and 0 <= i // spread_a < n]
        )
    return terms


SHAPED: dict[str, Callable[[Code, list[Operand], dict[str, Any]], Operand]] = {
    "squeeze": _squeezed,
    "dynamic_slice": _taken,
    "slice": _cut,
    "broadcast_in_dim": _broadcast,
    "reshape": _reshaped,
    "transpose": _transposed,
    "concatenate": _joined,
    "stack": _stacked,
    "rev": _reversed,
    "tile": lambda code, inputs, params: np.tile(elements(code, inputs[0]), params["reps"]),
    "reduce_sum": _reduction("add"),
    "reduce_max": _reduction("max"),
    "reduce_min": _reduction("min"),
    "reduce_prod": _reduction("mul"),
    "reduce_and": _reduction("and"),
    "reduce_or": _reduction("or"),
    "reduce_xor": _reduction("xor"),
    "dot_general": _product,
    "dynamic_update_slice": updated,
    "conv_general_dilated": convolved,
    "cumsum": _running("add"),
    "cumprod": _running("mul"),
    "cummax": _running("max"),
    "cummin": _running("min"),
    "argmax": _where_extreme("ge"),
    "argmin": _where_extreme("le"),
    "gather": gathered,
    "SearchSorted": searched,
    "pad": padded,
    "unvmap_any": _anywhere("or"),
    "unvmap_all": _anywhere("and"),
}
