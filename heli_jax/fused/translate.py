"""Translation of a jaxpr into LLVM, line by line.

Small arrays are taken apart into their elements; long ones, such as the inputs of a record, stay in
memory, and what is computed of them is computed of the elements that are asked for.

What loops carry is kept in registers, one of LLVM's phi nodes each.
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
    said,
)
from heli_jax.fused.operations import OPERATIONS

_UNROLLED = 16
"""Passes of a loop that are written out, since derivatives ask for what each has computed."""

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
    """Write what a jaxpr computes.

    Returns:
        An operand for each result.

    Raises:
        UnsupportedError: an operation that has no translation.
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
            # However unforeseen: said with the line of the model where it lies.
            error = UnsupportedError(f"the operation {_named(equation)[0]} here ({said(e)})")
            error.place = place_of(equation)
            raise error from e
        known |= dict(zip(equation.outvars, outputs, strict=True))
    return [read(v) for v in jaxpr.outvars]


def _named(equation: Any) -> tuple[str, dict[str, Any]]:
    """An operation's name and its parameters."""
    name, params = equation.primitive.name, equation.params
    if "_prim" not in params:
        return name, params
    # Such as jnp.searchsorted, of which the primitive is the same for all.
    of = params["_prim"]
    return type(of).__name__, {**getattr(of, "params", {}), **params}


def _made_of(of: Any, equation: Any) -> Any:
    """The jaxpr of the operations that JAX makes one of its own of, such as jnp.ldexp."""
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
        # Not even where all is known: Python would be called for a branch that nobody takes.
        raise UnsupportedError(f"the operation {name}")
    known = not any(isinstance(v, Stored) or v.dtype == object for v in inputs)
    if known and not (name in OPERATIONS and all(v.shape == () for v in inputs)):
        # Whatever it is; single numbers LLVM folds as well.
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
    """Arrays of one shape, single numbers, and arrays with axes of length 1 that are repeated."""
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
    """Return the place in an array that a broadcast shape's place repeats."""
    if not own:
        return ()
    zero = constant(0, INDEX)
    return tuple(i if n == m else zero for n, m, i in zip(own, shape, at, strict=True))


def _branches(code: Code, params: dict[str, Any], inputs: list[Operand]) -> list[Operand]:
    """cond: each vehicle may take another branch, so all are computed and one result is taken."""
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
    # From JAX 0.12 on it keeps trees in their place.
    consts, carry, _ = params["ft_in"].unpack()
    return len(list(consts)), len(list(carry))


def _row(code: Code, operand: Operand, index: Value) -> Operand:
    """operand[index]"""
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
    """A loop that is passed at least once.

    Args:
        body: of the pass's number (int32) and what is carried, what is carried on.
    """
    starts = [elements(v) for v in carry]
    varies = [_vary(v) for v in starts]
    # What starts the same for all vehicles may not stay so: tried until nothing changes.
    while True:
        mark = code.mark()
        results = _tried(code, passes, starts, varies, body)
        changed = [old | _vary(new) for old, new in zip(varies, results, strict=True)]
        if all(np.array_equal(a, b) for a, b in zip(varies, changed, strict=True)):
            return list(results)
        varies = changed
        code.back_to(mark)


def _vary(values: Elements) -> np.ndarray:
    """Return for each value whether it differs between vehicles."""
    return applied(lambda v: not v.shared, values).astype(bool)


def _tried(
    code: Code,
    passes: int,
    starts: list[Elements],
    varies: list[np.ndarray],
    body: Callable[[Value, list[Operand]], list[Operand]],
) -> list[Elements]:
    """The loop, where what is carried differs between vehicles as `varies` says."""
    before = [
        [code.of(v, not bool(w)) for v, w in zip(s.ravel(), each.ravel(), strict=True)]
        for s, each in zip(starts, varies, strict=True)
    ]
    entry, inside = code.block, code.new_label("loop")
    code.write(f"br label %{inside}")
    code.label(inside)
    # The phi nodes are written when what comes round is known; their place is kept.
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
    # From the innermost call outwards, until somebody's own function is met. What a function of
    # JAX's is made of was traced once for all who call it, and knows no caller.
    for frame in () if trace is None else trace.frames:
        name = frame.file_name
        if name.startswith(_OURS):
            return None if library in (None, "jax", "jaxlib") else f"in {library}"
        if (installed := _INSTALLED.search(name)) is not None:
            library = installed[1]
        elif not name.startswith("<"):
            return f"at {Path(name).name}:{frame.line_num}"
    return None
