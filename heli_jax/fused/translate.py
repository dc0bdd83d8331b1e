"""Translation of a jaxpr into LLVM, line by line.

Small arrays are split into elements. Long ones, such as the inputs of a record, stay in memory, and
expressions of them are computed only for the elements in use.

Loop carries stay in registers, each as an LLVM phi node.
"""

import functools
import math
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.extend import core

from heli_jax.fused.arrays import MOVED, SHAPED, at_compile_time, moved
from heli_jax.fused.code import (
    INDEX,
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
    in_one_line,
)
from heli_jax.fused.operations import OPERATIONS

_UNROLLED = 16
"""Most passes of a loop that is unrolled because derivatives need the results of each pass."""

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
    known: dict[Any, Operand] = {}
    for variable, value in zip(jaxpr.constvars, consts, strict=True):
        known[variable] = value if isinstance(value, Stored) else np.asarray(value)
    known |= dict(zip(jaxpr.invars, operands, strict=True))

    def read(atom: Any) -> Operand:
        return np.asarray(atom.val) if isinstance(atom, core.Literal) else known[atom]

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


def _named(equation: Any) -> tuple[str, dict[str, Any]]:
    """Return an operation's name and parameters."""
    name, params = equation.primitive.name, equation.params
    if "_prim" not in params:
        return name, params
    # Such as jnp.searchsorted, whose primitive is shared by many operations.
    of = params["_prim"]
    return type(of).__name__, {**getattr(of, "params", {}), **params}


def _made_of(of: Any, equation: Any) -> Any:
    """Return the jaxpr of a composite operation of JAX, such as jnp.ldexp."""
    arguments = [jax.ShapeDtypeStruct(v.aval.shape, v.aval.dtype) for v in equation.invars]

    def expanded(*flat: Any) -> Any:
        return jax.tree.leaves(of.expand(*jax.tree.unflatten(of.in_tree, flat)))

    return jax.make_jaxpr(expanded)(*arguments)


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
    known = not any(isinstance(v, Stored) or v.dtype == object for v in inputs)
    if known and not (name in OPERATIONS and all(v.shape == () for v in inputs)):
        # Any operation; LLVM folds single numbers itself.
        return at_compile_time(equation, inputs)
    if name in OPERATIONS:
        dtype = np.dtype(equation.outvars[0].aval.dtype)
        return [_elementwise(code, name, params, inputs, dtype)]
    if name in MOVED:
        return moved(code, equation, name, inputs)
    if name in SHAPED:
        return [SHAPED[name](code, inputs, params)]
    if hasattr(params.get("_prim"), "expand"):
        made_of = _made_of(params["_prim"], equation)
        return translate(code, made_of.jaxpr, made_of.consts, inputs)
    raise UnsupportedError(f"the operation {name}")


def _elementwise(
    code: Code, name: str, params: dict[str, Any], inputs: list[Operand], dtype: np.dtype
) -> Operand:
    """Apply an operation to arrays of one shape, numbers, and arrays with axes of length 1."""
    operation = functools.partial(OPERATIONS[name], code, **params)
    shape = np.broadcast_shapes(*(v.shape for v in inputs))
    if any(isinstance(v, Stored) for v in inputs):

        def element(at: tuple[Value, ...]) -> Value:
            return operation(*(at_place(code, v, _repeated(v.shape, shape, at)) for v in inputs))

        return Stored(shape, dtype, element)
    if math.prod(shape) > MOST:
        raise UnsupportedError(f"an array of {shape} as a whole")
    return applied(operation, *(elements(v) for v in inputs))


def _repeated(
    own: tuple[int, ...], shape: tuple[int, ...], at: tuple[Value, ...]
) -> tuple[Value, ...]:
    """Return the index into an array for an index of its broadcast shape."""
    if not own:
        return ()
    zero = constant(0, INDEX)
    return tuple(i if n == m else zero for n, m, i in zip(own, shape, at, strict=True))


def _branches(code: Code, params: dict[str, Any], inputs: list[Operand]) -> list[Operand]:
    """Translate cond: compute all branches, and select a result for each vehicle."""
    which, operands, branches = inputs[0], inputs[1:], params["branches"]
    if not isinstance(which, Stored) and which.dtype != object:
        branch = branches[int(np.clip(which, 0, len(branches) - 1))]
        return translate(code, branch.jaxpr, branch.consts, operands)
    results = [translate(code, b.jaxpr, b.consts, operands) for b in branches]
    taken = elements(which)
    return [
        _elementwise(code, "select_n", {}, [taken, *case], dtype_of(case[0]))
        for case in zip(*results, strict=True)
    ]


def _scan(code: Code, params: dict[str, Any], inputs: list[Operand]) -> list[Operand]:
    (n_consts, n_carry), length = _counts(params), params["length"]
    body = params["jaxpr"]
    consts, carry = inputs[:n_consts], inputs[n_consts : n_consts + n_carry]
    rows = inputs[n_consts + n_carry :]
    if len(body.jaxpr.outvars) > n_carry:
        return _written_out(code, params, consts, carry, rows)
    if length == 0:
        return list(carry)

    def once(index: Value, carried: list[Operand]) -> list[Operand]:
        if params["reverse"]:
            index = code.operation("sub", constant(length - 1, INDEX), index)
        now = [_row(code, v, index) for v in rows]
        return translate(code, body.jaxpr, body.consts, [*consts, *carried, *now])

    return loop(code, length, carry, once)


def _counts(params: dict[str, Any]) -> tuple[int, int]:
    """Return the number of a scan's constants and of its carries."""
    if "num_consts" in params:
        return params["num_consts"], params["num_carry"]
    # JAX 0.12 and later store trees instead.
    consts, carry, _ = params["ft_in"].unpack()
    return len(list(consts)), len(list(carry))


def _row(code: Code, operand: Operand, index: Value) -> Operand:
    """Return operand[index]."""
    shape = operand.shape[1:]
    view = Stored(shape, dtype_of(operand), lambda at: at_place(code, operand, (index, *at)))
    return view if int(np.prod(shape)) > MOST else elements(view)


def _written_out(
    code: Code,
    params: dict[str, Any],
    consts: list[Operand],
    carry: list[Operand],
    rows: list[Operand],
) -> list[Operand]:
    length, body = params["length"], params["jaxpr"]
    if not 0 < length <= _UNROLLED:
        raise UnsupportedError(f"a loop of {length} passes whose results are all kept")
    order = range(length - 1, -1, -1) if params["reverse"] else range(length)
    kept: list[list[Elements]] = [[] for _ in body.jaxpr.outvars[len(carry) :]]
    for k in order:
        now = [_row(code, v, constant(k, INDEX)) for v in rows]
        outputs = translate(code, body.jaxpr, body.consts, [*consts, *carry, *now])
        carry = outputs[: len(carry)]
        for column, value in zip(kept, outputs[len(carry) :], strict=True):
            column.append(elements(value))
    if params["reverse"]:
        kept = [column[::-1] for column in kept]
    return [*carry, *(np.stack(column) for column in kept)]


def loop(
    code: Code,
    passes: int,
    carry: Sequence[Operand],
    body: Callable[[Value, list[Operand]], list[Operand]],
) -> list[Operand]:
    """Write a loop with at least one pass.

    Args:
        body: function of the pass number (int32) and the carry that returns the next carry.
    """
    starts = [elements(v) for v in carry]
    varies = [_vary(v) for v in starts]
    # A carry that starts shared may not stay so; repeat until nothing changes.
    while True:
        mark = code.mark()
        results = _tried(code, passes, starts, varies, body)
        changed = [old | _vary(new) for old, new in zip(varies, results, strict=True)]
        if all(np.array_equal(a, b) for a, b in zip(varies, changed, strict=True)):
            return list(results)
        varies = changed
        code.back_to(mark)


def _vary(values: Elements) -> np.ndarray:
    """Return a mask of values that differ between vehicles."""
    return applied(lambda v: not v.shared, values).astype(bool)


def _tried(
    code: Code,
    passes: int,
    starts: list[Elements],
    varies: list[np.ndarray],
    body: Callable[[Value, list[Operand]], list[Operand]],
) -> list[Elements]:
    """Write the loop; `varies` marks carries that differ between vehicles."""
    before = [
        [code.of(v, not bool(w)) for v, w in zip(s.ravel(), each.ravel(), strict=True)]
        for s, each in zip(starts, varies, strict=True)
    ]
    entry, inside = code.block, code.new_label("loop")
    code.write(f"br label %{inside}")
    code.label(inside)
    # The phi nodes need the values of the next pass, so they are inserted later at this place.
    place = len(code.lines)
    index = Value(code.register(), INDEX, True)
    carried = []
    for s, each in zip(starts, varies, strict=True):
        carried.append(applied(lambda v, w: Value(code.register(), v.dtype, not w), s, each))
    results = [elements(v) for v in body(index, list(carried))]
    around = [
        [code.of(v, not bool(w) and v.shared) for v, w in zip(r.ravel(), e.ravel(), strict=True)]
        for r, e in zip(results, varies, strict=True)
    ]
    following = code.operation("add", index, constant(1, INDEX))
    again = code.compare("icmp slt", following, constant(passes, INDEX))
    end = code.block
    after = code.new_label("after")
    phis = [f"{index.operand} = phi i32 [ 0, %{entry} ], [ {following.operand}, %{end} ]"]
    for values, first, then in zip(carried, before, around, strict=True):
        for v, a, b in zip(values.ravel(), first, then, strict=True):
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
