"""conv_general_dilated, which jnp.convolve and jnp.correlate are made of: sums written out."""

import itertools
from typing import Any

import numpy as np

from heli_jax.fused.code import Code, UnsupportedError, constant
from heli_jax.fused.operands import MOST, Elements, Operand, elements
from heli_jax.fused.operations import OPERATIONS, in_type


def convolved(code: Code, inputs: list[Operand], params: dict[str, Any]) -> Operand:
    """Of small arrays, with padding, strides and dilations."""
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
    """With the axes where the order says that they stand."""
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
