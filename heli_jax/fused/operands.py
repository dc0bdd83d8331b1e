"""What a program computes with: small arrays taken apart, long ones left in memory."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from heli_jax.fused.code import Code, UnsupportedError, Value, constant

MOST = 4096
"""Elements of an array that is taken apart; more would take
minutes to compile."""
LONG = 64
"""elements above which an array that repeats one number is not taken apart, and up to which one
may be looked for among all"""
INDEX = np.dtype(np.int32)
"""of indices into arrays, and of passes of a loop"""


class Stored(NamedTuple):
    """An array (N, ...) in memory, or what is computed of such, by the element."""

    shape: tuple[int, ...]
    dtype: np.dtype
    element: Callable[[tuple[Value, ...]], Value]
    """the element at int32 indices, one for each dimension"""


type Elements = np.ndarray[Any, Any]
"""an array of Values, or of dtype other than object: of numbers that are known by now"""
type Operand = Elements | Stored


def elements(code: Code, operand: Operand) -> Elements:
    """An operand as an array of Values."""
    if isinstance(operand, Stored):
        if int(np.prod(operand.shape)) > MOST:
            raise UnsupportedError(f"an array of {operand.shape} as a whole")
        every = np.empty(operand.shape, object)
        for at in np.ndindex(operand.shape):
            every[at] = operand.element(tuple(constant(i, INDEX) for i in at))
        return every
    if operand.dtype == object:
        return operand
    made = np.empty(operand.shape, object)
    for at in np.ndindex(operand.shape):
        value: Any = operand[at]
        made[at] = constant(value, operand.dtype)
    return made


def scalar(code: Code, operand: Operand) -> Value:
    """The Value of an operand that is one number."""
    value: Value = elements(code, operand).item()
    return value


def at_place(code: Code, operand: Operand, at: tuple[Value, ...]) -> Value:
    """One element of an operand at indices that the program computes."""
    if isinstance(operand, Stored):
        return operand.element(at)
    if operand.shape == ():
        return scalar(code, operand)
    if operand.dtype != object:
        return code.load(code.table(operand), flat(code, operand.shape, at), operand.dtype)
    if all(not i.operand.startswith("%") for i in at):
        return operand[tuple(int(i.operand) for i in at)]
    if operand.size > LONG:
        raise UnsupportedError(
            f"an element at a computed place of a computed array {operand.shape}"
        )
    # Every element is at hand in a register: the one that is meant is chosen among all.
    places = list(np.ndindex(operand.shape))
    # Any: of an array's element NumPy's types make an array as well.
    chosen: Any = operand[places[-1]]
    for place in reversed(places[:-1]):
        value: Any = operand[place]
        here = None
        for index, k in zip(at, place, strict=True):
            same = code.compare("icmp eq", index, constant(k, index.dtype))
            here = same if here is None else code.operation("and", here, same)
        assert here is not None
        chosen = code.choose(here, value, chosen)
    return chosen


def flat(code: Code, shape: tuple[int, ...], at: tuple[Value, ...]) -> Value:
    """Where an element of an array that is stored row by row stands, counted from the first."""
    flat = at[0]
    for length, index in zip(shape[1:], at[1:], strict=True):
        flat = code.operation("mul", flat, constant(length, INDEX))
        flat = code.operation("add", flat, index)
    return flat


def dtype_of(operand: Operand) -> np.dtype:
    if isinstance(operand, Stored) or operand.dtype != object:
        return operand.dtype
    return operand.ravel()[0].dtype
