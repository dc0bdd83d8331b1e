"""Translation of a jaxpr into LLVM, line by line.

The model's equations are expressions of numbers. Arrays are records that stay in memory, and
expressions of them are computed only for the elements in use.

Loop carries stay in registers, each as an LLVM phi node.
"""

import functools
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jax.extend import core

from heli_jax.fused.arrays import VIEWS, moved
from heli_jax.fused.code import (
    INDEX,
    Code,
    Operand,
    Stored,
    UnsupportedError,
    Value,
    at_place,
    constant,
    in_one_line,
    scalar,
    shape_of,
)
from heli_jax.fused.operations import OPERATIONS

_NESTED = {
    "jit": "jaxpr",
    "pjit": "jaxpr",
    "closed_call": "call_jaxpr",
    "core_call": "call_jaxpr",
    "eval_jaxpr": "call_jaxpr",
    "custom_jvp_call": "call_jaxpr",
    "custom_vjp_call": "call_jaxpr",
    "remat": "jaxpr",
    "remat2": "jaxpr",
    "checkpoint": "jaxpr",
}


def translate(code: Code, jaxpr: Any, consts: Sequence[Any], operands: Sequence[Operand]) -> list:
    """Write the translation of a jaxpr.

    Returns:
        An operand for each result.

    Raises:
        UnsupportedError: an operation without a translation.
    """
    known: dict[Any, Operand] = dict(zip(jaxpr.invars, operands, strict=True))
    known |= {v: _constant(c) for v, c in zip(jaxpr.constvars, consts, strict=True)}

    def read(atom: Any) -> Operand:
        return _constant(atom.val) if isinstance(atom, core.Literal) else known[atom]

    for equation in jaxpr.eqns:
        inputs = [read(v) for v in equation.invars]
        try:
            outputs = _equation(code, equation, inputs)
        except UnsupportedError as e:
            e.place = e.place or place_of(equation)
            raise
        except Exception as e:
            # Report any error with the line of the model.
            error = UnsupportedError(f"the operation {_named(equation)[0]} here ({in_one_line(e)})")
            error.place = place_of(equation)
            raise error from e
        known |= dict(zip(equation.outvars, outputs, strict=True))
    return [read(v) for v in jaxpr.outvars]


def _constant(value: Any) -> Value:
    """Return a number of the program."""
    value = np.asarray(value)
    if value.shape:
        raise UnsupportedError(f"a constant array of {value.shape}")
    return constant(value, value.dtype)


def _named(equation: Any) -> tuple[str, dict[str, Any]]:
    """Return an operation's name and parameters."""
    name, params = equation.primitive.name, equation.params
    if "_prim" not in params:
        return name, params
    # Such as jnp.searchsorted, whose primitive is shared by many operations.
    of = params["_prim"]
    return type(of).__name__, {**getattr(of, "params", {}), **params}


def _equation(code: Code, equation: Any, inputs: list[Operand]) -> list[Operand]:
    name, params = _named(equation)
    if name in _NESTED:
        inner = params[_NESTED[name]]
        closed = hasattr(inner, "consts")
        return translate(
            code, inner.jaxpr if closed else inner, inner.consts if closed else (), inputs
        )
    if name in ("optimization_barrier", "copy", "stop_gradient"):
        return list(inputs)
    if name == "scan":
        return _scan(code, params, inputs)
    if name == "cond":
        return _branches(code, params, inputs)
    if "callback" in name:
        # Refused even for known operands, since Python would be called in branches not taken.
        raise UnsupportedError(f"the operation {name}")
    if name in OPERATIONS:
        return [_elementwise(code, name, params, inputs, equation.outvars[0].aval.dtype)]
    if name in VIEWS:
        return [moved(code, name, inputs, params)]
    raise UnsupportedError(f"the operation {name}")


def _elementwise(
    code: Code, name: str, params: dict[str, Any], inputs: list[Operand], dtype: np.dtype
) -> Operand:
    """Apply an operation to numbers, or to arrays of one shape and numbers."""
    operation = functools.partial(OPERATIONS[name], code, **params)
    shapes = {v.shape for v in inputs if isinstance(v, Stored)}
    if not shapes:
        return operation(*inputs)
    if len(shapes) > 1:
        raise UnsupportedError(f"{name} of arrays with different shapes")
    return Stored(shapes.pop(), dtype, lambda at: operation(*(at_place(v, at) for v in inputs)))


def _branches(code: Code, params: dict[str, Any], inputs: list[Operand]) -> list[Operand]:
    """Translate cond: compute all branches, and select a result for each vehicle."""
    which, operands, branches = inputs[0], inputs[1:], params["branches"]
    results = [translate(code, b.jaxpr, b.consts, operands) for b in branches]
    return [
        _elementwise(code, "select_n", {}, [which, *case], case[0].dtype)
        for case in zip(*results, strict=True)
    ]


def _scan(code: Code, params: dict[str, Any], inputs: list[Operand]) -> list[Operand]:
    (n_consts, n_carry), length = _counts(params), params["length"]
    body = params["jaxpr"]
    consts, carry = inputs[:n_consts], inputs[n_consts : n_consts + n_carry]
    rows = inputs[n_consts + n_carry :]
    if len(body.jaxpr.outvars) > n_carry:
        raise UnsupportedError("a loop whose results are all kept")
    if length == 0:
        return list(carry)

    def once(index: Value, carried: list[Value]) -> list[Operand]:
        if params["reverse"]:
            index = code.operation("sub", constant(length - 1, INDEX), index)
        now = [_row(v, index) for v in rows]
        return translate(code, body.jaxpr, body.consts, [*consts, *carried, *now])

    return list(loop(code, length, carry, once))


def _counts(params: dict[str, Any]) -> tuple[int, int]:
    """Return the number of a scan's constants and of its carries."""
    if "num_consts" in params:
        return params["num_consts"], params["num_carry"]
    # JAX 0.12 and later store trees instead.
    consts, carry, _ = params["ft_in"].unpack()
    return len(list(consts)), len(list(carry))


def _row(operand: Operand, index: Value) -> Operand:
    """Return operand[index]."""
    view = Stored(shape_of(operand)[1:], operand.dtype, lambda at: at_place(operand, (index, *at)))
    return view if view.shape else scalar(view)


def loop(
    code: Code,
    passes: int,
    carry: Sequence[Operand],
    body: Callable[[Value, list[Value]], list[Operand]],
) -> list[Value]:
    """Write a loop with at least one pass.

    Args:
        body: function of the pass number (int32) and the carry that returns the next carry.
    """
    starts = [scalar(v) for v in carry]
    shared = [v.shared for v in starts]
    # A carry that starts shared may not stay so; repeat until nothing changes.
    while True:
        mark = code.mark()
        results = _tried(code, passes, starts, shared, body)
        still = [old and new.shared for old, new in zip(shared, results, strict=True)]
        if still == shared:
            return results
        shared = still
        code.back_to(mark)


def _tried(
    code: Code,
    passes: int,
    starts: list[Value],
    shared: list[bool],
    body: Callable[[Value, list[Value]], list[Operand]],
) -> list[Value]:
    """Write the loop; `shared` marks carries that are the same for all vehicles."""
    before = [code.of(v, same) for v, same in zip(starts, shared, strict=True)]
    entry, inside = code.block, code.new_label("loop")
    code.write(f"br label %{inside}")
    code.label(inside)
    # The phi nodes need the values of the next pass, so they are inserted later at this place.
    place = len(code.lines)
    index = Value(code.register(), INDEX, True)
    carried = [
        Value(code.register(), v.dtype, same) for v, same in zip(starts, shared, strict=True)
    ]
    results = [scalar(v) for v in body(index, list(carried))]
    around = [code.of(v, same and v.shared) for v, same in zip(results, shared, strict=True)]
    following = code.operation("add", index, constant(1, INDEX))
    again = code.compare("icmp slt", following, constant(passes, INDEX))
    end = code.block
    after = code.new_label("after")
    phis = [f"{index.operand} = phi i32 [ 0, %{entry} ], [ {following.operand}, %{end} ]"]
    for v, a, b in zip(carried, before, around, strict=True):
        kind = code.typed(v.dtype, v.shared)
        phis.append(f"{v.operand} = phi {kind} [ {a}, %{entry} ], [ {b}, %{end} ]")
    code.lines[place:place] = [f"  {p}" for p in phis]
    code.write(f"br i1 {again.operand}, label %{inside}, label %{after}")
    code.label(after)
    return results


_OURS = str(Path(__file__).parents[1])
_INSTALLED = re.compile(r"(?:site|dist)-packages[/\\]([^/\\.]+)")


def place_of(equation: Any) -> str | None:
    """Return 'at model.py:12' or 'in diffrax'; None if unknown."""
    trace, library = equation.source_info.traceback, None
    # Search from the innermost call outwards for a user's function. JAX traces its own functions
    # once for all callers, so they have no caller.
    for frame in () if trace is None else trace.frames:
        name = frame.file_name
        if name.startswith(_OURS):
            return None if library in (None, "jax", "jaxlib") else f"in {library}"
        if (installed := _INSTALLED.search(name)) is not None:
            library = installed[1]
        elif not name.startswith("<"):
            return f"at {Path(name).name}:{frame.line_num}"
    return None
