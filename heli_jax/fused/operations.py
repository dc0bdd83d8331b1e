"""JAX primitives in LLVM, for one number per vehicle."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from heli_jax.fused.code import Code, UnsupportedError, Value, constant, type_of

# A product and a sum may be fused, as XLA and C compilers do. No other optimisation may change
# digits or lose NaN.
_F = "contract"

type Operation = Callable[..., Value]
"""Function of code, values and the primitive's parameters that returns a value."""


def _arithmetic(of_floats: str, of_integers: str) -> Operation:
    def made(code: Code, *values: Value, **_: Any) -> Value:
        kind = values[0].dtype.kind
        if kind == "b":
            raise UnsupportedError(f"{of_integers} of truth values")
        return code.operation(f"{of_floats} {_F}" if kind == "f" else of_integers, *values)

    return made


def _quotient(code: Code, a: Value, b: Value, **_: Any) -> Value:
    if a.dtype.kind != "f":
        raise UnsupportedError("a quotient of integers")
    return code.operation(f"fdiv {_F}", a, b)


def _remainder(code: Code, a: Value, b: Value, **_: Any) -> Value:
    """Return the remainder with the sign of the dividend."""
    if a.dtype.kind != "f":
        raise UnsupportedError("a remainder of integers")
    return code.operation("frem", a, b)


def _extreme(of_floats: str, signed: str, unsigned: str) -> Operation:
    # `maximum` propagates NaN as JAX does; `maxnum` would lose it.
    def made(code: Code, a: Value, b: Value, **_: Any) -> Value:
        names = {"f": of_floats, "i": signed, "u": unsigned}
        if a.dtype.kind == "b":
            return code.operation("or" if signed == "smax" else "and", a, b)
        return code.intrinsic(names[a.dtype.kind], a, b)

    return made


def _comparison(of_floats: str, signed: str, unsigned: str) -> Operation:
    def made(code: Code, a: Value, b: Value, **_: Any) -> Value:
        if a.dtype.kind == "f":
            return code.compare(f"fcmp {of_floats}", a, b)
        return code.compare(f"icmp {signed if a.dtype.kind == 'i' else unsigned}", a, b)

    return made


def _function(name: str) -> Operation:
    def made(code: Code, *values: Value, **_: Any) -> Value:
        if values[0].dtype.kind != "f":
            raise UnsupportedError(f"{name} of integers")
        return code.intrinsic(name, *values)

    return made


def _one_minus_square(code: Code, a: Value, **_: Any) -> Value:
    one = constant(1, a.dtype)
    return code.operation("fmul", code.operation("fadd", one, a), code.operation("fsub", one, a))


def _absolute(code: Code, a: Value, **_: Any) -> Value:
    if a.dtype.kind == "f":
        return code.intrinsic("fabs", a)
    if a.dtype.kind == "u":
        return a
    zero = constant(0, a.dtype)
    return code.choose(code.compare("icmp slt", a, zero), code.operation("sub", zero, a), a)


def _negative(code: Code, a: Value, **_: Any) -> Value:
    if a.dtype.kind == "f":
        return code.operation("fneg", a)
    return code.operation("sub", constant(0, a.dtype), a)


def _rounded(code: Code, a: Value, *, rounding_method: Any, **_: Any) -> Value:
    if code.whole(a) is not None:
        return a
    nearest_even = int(rounding_method) == 1
    return code.intrinsic("roundeven" if nearest_even else "round", a)


def _power(code: Code, a: Value, *, y: int, **_: Any) -> Value:
    if y == 0:
        return constant(1, a.dtype)
    result, square, left = None, a, abs(y)
    while left:
        if left & 1:
            result = square if result is None else OPERATIONS["mul"](code, result, square)
        left >>= 1
        if left:
            square = OPERATIONS["mul"](code, square, square)
    assert result is not None
    return result if y > 0 else OPERATIONS["div"](code, constant(1, a.dtype), result)


def _square(code: Code, a: Value, **_: Any) -> Value:
    return OPERATIONS["mul"](code, a, a)


def _inverse_root(code: Code, a: Value, **_: Any) -> Value:
    return code.operation(f"fdiv {_F}", constant(1, a.dtype), code.intrinsic("sqrt", a))


def _sign(code: Code, a: Value, **_: Any) -> Value:
    zero, one = constant(0, a.dtype), constant(1, a.dtype)
    if a.dtype.kind == "u":
        return code.choose(code.compare("icmp eq", a, zero), zero, one)
    if a.dtype.kind != "f":
        positive = code.choose(code.compare("icmp sgt", a, zero), one, zero)
        return code.choose(code.compare("icmp slt", a, zero), constant(-1, a.dtype), positive)
    # Zero and NaN are their own sign.
    unit = code.intrinsic("copysign", one, a)
    nonzero = code.compare("fcmp one", a, zero)
    return code.choose(nonzero, unit, a)


def _finite(code: Code, a: Value, **_: Any) -> Value:
    return code.compare("fcmp olt", code.intrinsic("fabs", a), constant(np.inf, a.dtype))


def _logic(name: str) -> Operation:
    return lambda code, *values, **_: code.operation(name, *values)


def _not(code: Code, a: Value, **_: Any) -> Value:
    ones = constant(True, a.dtype) if a.dtype.kind == "b" else constant(-1, a.dtype)
    return code.operation("xor", a, ones)


def _selected(code: Code, which: Value, *cases: Value, **_: Any) -> Value:
    if which.dtype.kind == "b":
        no, yes = cases
        return code.choose(which, yes, no)
    chosen = cases[-1]
    for i in range(len(cases) - 2, -1, -1):
        here = code.compare("icmp sle", which, constant(i, which.dtype))
        chosen = code.choose(here, cases[i], chosen)
    return chosen


def _clamped(code: Code, low: Value, a: Value, high: Value, **_: Any) -> Value:
    return OPERATIONS["min"](code, OPERATIONS["max"](code, low, a), high)


def converted(code: Code, a: Value, *, new_dtype: Any, **_: Any) -> Value:
    """Convert a number to another type."""
    target = np.dtype(new_dtype)
    if target == a.dtype:
        return a
    source, to = a.dtype.kind, target.kind
    if to == "b":
        zero = constant(0, a.dtype)
        return code.compare("fcmp une" if source == "f" else "icmp ne", a, zero)
    if source == "f" and to == "f":
        wider = target.itemsize > a.dtype.itemsize
        return code.cast("fpext" if wider else "fptrunc", a, target)
    integer = code.whole(a)
    if integer is not None and to == "i" and target.itemsize >= integer.dtype.itemsize:
        return converted(code, integer, new_dtype=target)
    if source == "f":
        raise UnsupportedError("a real number as an integer")
    if to == "f":
        made = code.cast("sitofp" if source == "i" else "uitofp", a, target)
        if source == "i" and a.shared:
            # The simulation uses the sample number as a time and rounds it back to an index.
            code.store_integer(made, a)
        return made
    if source == "b":
        return code.cast("zext", a, target)
    if type_of(a.dtype) == type_of(target):
        return replace(a, dtype=target)
    if target.itemsize < a.dtype.itemsize:
        return code.cast("trunc", a, target)
    return code.cast("sext" if source == "i" else "zext", a, target)


def _logistic(code: Code, a: Value, **_: Any) -> Value:
    one = constant(1, a.dtype)
    e = code.intrinsic("exp", code.operation("fneg", a))
    return code.operation(f"fdiv {_F}", one, code.operation("fadd", one, e))


def _power_of(code: Code, a: Value, b: Value, **_: Any) -> Value:
    if b.dtype.kind != "f":
        b = converted(code, b, new_dtype=a.dtype)
    return code.intrinsic("pow", a, b)


_INTRINSICS = (
    *("sqrt", "floor", "ceil", "exp", "exp2", "log", "log2", "sin", "cos", "tan", "asin", "acos"),
    *("atan", "atan2", "sinh", "cosh", "tanh"),
)
OPERATIONS: dict[str, Operation] = {
    **{name: _function(name) for name in _INTRINSICS},
    "add": _arithmetic("fadd", "add"),
    "add_any": _arithmetic("fadd", "add"),
    "sub": _arithmetic("fsub", "sub"),
    "mul": _arithmetic("fmul", "mul"),
    "div": _quotient,
    "rem": _remainder,
    "neg": _negative,
    "abs": _absolute,
    "max": _extreme("maximum", "smax", "umax"),
    "min": _extreme("minimum", "smin", "umin"),
    "clamp": _clamped,
    "rsqrt": _inverse_root,
    "square": _square,
    "one_minus_square": _one_minus_square,
    "integer_pow": _power,
    "pow": _power_of,
    "round": _rounded,
    "sign": _sign,
    "is_finite": _finite,
    "logistic": _logistic,
    "lt": _comparison("olt", "slt", "ult"),
    "le": _comparison("ole", "sle", "ule"),
    "gt": _comparison("ogt", "sgt", "ugt"),
    "ge": _comparison("oge", "sge", "uge"),
    "eq": _comparison("oeq", "eq", "eq"),
    "ne": _comparison("une", "ne", "ne"),
    "and": _logic("and"),
    "or": _logic("or"),
    "xor": _logic("xor"),
    "not": _not,
    "select_n": _selected,
    "convert_element_type": converted,
}
"""Operations by name of the primitive, applied by element to numbers of equal shape."""
