"""What JAX traced, line by line into LLVM.

Small arrays are taken apart into their elements; long ones, such as the inputs of a record, stay in
memory, and what is computed of them is computed of the elements that are asked for.
"""

import itertools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.extend import core

from heli_jax.fused.code import Code, UnsupportedError, Value, constant
from heli_jax.fused.operations import OPERATIONS, converted

_MOST = 4096
"""Elements of an array that is taken apart; more would make programs that take minutes to compile."""
_UNROLLED = 16
"""Passes of a loop that are written out where it cannot stay a loop."""


class Stored(NamedTuple):
    """An array (N, ...) in memory, or what is computed of such, by the element."""

    shape: tuple[int, ...]
    dtype: np.dtype
    element: Callable[[tuple[Value, ...]], Value]
    """the element at int32 indices, one for each dimension"""


type Elements = np.ndarray[Any, np.dtype[np.object_]]
"""an array of Values, or of dtype other than object: of numbers that are known by now"""
type Operand = Elements | Stored

_INDEX = np.dtype(np.int32)
_NESTED = {
    "jit": "jaxpr",
    "pjit": "jaxpr",
    "closed_call": "call_jaxpr",
    "core_call": "call_jaxpr",
    "custom_jvp_call": "call_jaxpr",
    "custom_vjp_call": "call_jaxpr",
    "remat": "jaxpr",
    "remat2": "jaxpr",
    "checkpoint": "jaxpr",
}


def translate(code: Code, jaxpr: Any, consts: Sequence[Any], operands: Sequence[Operand]) -> list:
    """Write what a jaxpr computes.

    Args:
        code: where it is written.
        jaxpr: as `jax.make_jaxpr` gives it, closed or with its constants.
        consts: of it.
        operands: of its arguments.

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
        outputs = _equation(code, equation, inputs)
        known |= dict(zip(equation.outvars, outputs, strict=True))
    return [read(v) for v in jaxpr.outvars]


def elements(code: Code, operand: Operand) -> Elements:
    """An operand as an array of Values."""
    if isinstance(operand, Stored):
        if int(np.prod(operand.shape)) > _MOST:
            raise UnsupportedError(f"an array of {operand.shape} as a whole")
        every = np.empty(operand.shape, object)
        for at in np.ndindex(operand.shape):
            every[at] = operand.element(tuple(constant(i, _INDEX) for i in at))
        return every
    if operand.dtype == object:
        return operand
    made = np.empty(operand.shape, object)
    for at in np.ndindex(operand.shape):
        made[at] = constant(operand[at], operand.dtype)
    return made


def scalar(code: Code, operand: Operand) -> Value:
    """The Value of an operand that is one number."""
    return elements(code, operand)[()]


def _equation(code: Code, equation: Any, inputs: list[Operand]) -> list[Operand]:
    name, params = equation.primitive.name, equation.params
    if name in _NESTED:
        inner = params[_NESTED[name]]
        closed = hasattr(inner, "consts")
        return translate(
            code, inner.jaxpr if closed else inner, inner.consts if closed else (), inputs
        )
    if name in ("optimization_barrier", "copy", "copy_p", "stop_gradient", "reduce_precision"):
        return list(inputs)
    if name == "scan":
        return _scan(code, params, inputs)
    if name == "while":
        return _while(code, params, inputs)
    if name == "cond":
        return _branches(code, params, inputs)
    known = not any(isinstance(v, Stored) or v.dtype == object for v in inputs)
    if known and not (name in OPERATIONS and all(v.shape == () for v in inputs)):
        # Known now: JAX itself computes it, whatever it is; single numbers LLVM folds as well.
        with jax.ensure_compile_time_eval():
            results = equation.primitive.bind(*inputs, **params)
        results = results if equation.primitive.multiple_results else [results]
        return [np.asarray(r) for r in results]
    if name in OPERATIONS:
        return [_elementwise(code, name, params, inputs)]
    if name in _SHAPED:
        return [_SHAPED[name](code, inputs, params)]
    raise UnsupportedError(f"the operation {name}")


def _elementwise(code: Code, name: str, params: dict[str, Any], inputs: list[Operand]) -> Operand:
    operation = OPERATIONS[name]
    stored = [v for v in inputs if isinstance(v, Stored)]
    if stored:
        shape = next(v.shape for v in stored)

        def element(at: tuple[Value, ...]) -> Value:
            return operation(code, *(_at(code, v, at) for v in inputs), **params)

        dtype = np.dtype(params.get("new_dtype", stored[0].dtype))
        return Stored(shape, dtype, element)
    arrays = [elements(code, v) for v in inputs]
    shape = np.broadcast_shapes(*(a.shape for a in arrays))
    result = np.empty(shape, object)
    for at in np.ndindex(shape):
        result[at] = operation(code, *(a[at] if a.shape else a[()] for a in arrays), **params)
    return result


def _at(code: Code, operand: Operand, at: tuple[Value, ...]) -> Value:
    """One element of an operand at indices that the program computes."""
    if isinstance(operand, Stored):
        return operand.element(at)
    if operand.shape == ():
        return elements(code, operand)[()]
    if operand.dtype != object:
        return code.load(code.table(operand), _flat(code, operand.shape, at), operand.dtype)
    if all(not i.operand.startswith("%") for i in at):
        return operand[tuple(int(i.operand) for i in at)]
    raise UnsupportedError("an element of a computed array at a computed place")


def _flat(code: Code, shape: tuple[int, ...], at: tuple[Value, ...]) -> Value:
    flat = at[0]
    for length, index in zip(shape[1:], at[1:], strict=True):
        flat = code.operation("mul", flat, constant(length, _INDEX))
        flat = code.operation("add", flat, index)
    return flat


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
    zero = constant(0, _INDEX)
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
        start = converted(code, start, new_dtype=_INDEX)
        if not start.shared:
            raise UnsupportedError("an index that is not the same for all vehicles")
        # Within the array whatever is asked for, as JAX has it.
        indices.append(
            OPERATIONS["clamp"](code, constant(0, _INDEX), start, constant(length - size, _INDEX))
        )
    if isinstance(operand, Stored):
        return _moved(
            operand,
            tuple(sizes),
            lambda at: tuple(
                code.operation("add", i, a) for i, a in zip(indices, at, strict=True)
            ),
        )
    result = np.empty(sizes, object)
    for at in np.ndindex(*sizes):
        places = [
            code.operation("add", i, constant(a, _INDEX)) for i, a in zip(indices, at, strict=True)
        ]
        result[at] = _at(code, operand, tuple(places))
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
            scaled = code.operation("mul", index, constant(stride, _INDEX))
            moved.append(code.operation("add", scaled, constant(start, _INDEX)))
        return tuple(moved)

    return _moved(operand, shape, where)


def _broadcast(code: Code, inputs: list[Operand], params: dict[str, Any]) -> Operand:
    operand, shape, places = inputs[0], tuple(params["shape"]), params["broadcast_dimensions"]
    if int(np.prod(shape)) > _MOST or isinstance(operand, Stored):
        zero = constant(0, _INDEX)

        def element(at: tuple[Value, ...]) -> Value:
            inner = tuple(
                zero if operand.shape[i] == 1 else at[d] for i, d in enumerate(places)
            )
            return _at(code, operand, inner)

        return Stored(shape, np.dtype(_dtype(operand)), element)
    source = operand if operand.dtype == object else elements(code, operand)
    unit = [1] * len(shape)
    for i, d in enumerate(places):
        unit[d] = source.shape[i]
    return np.broadcast_to(source.reshape(unit), shape)


def _dtype(operand: Operand) -> np.dtype:
    if isinstance(operand, Stored) or operand.dtype != object:
        return operand.dtype
    return operand.ravel()[0].dtype


def _reshaped(code: Code, inputs: list[Operand], params: dict[str, Any]) -> Operand:
    return elements(code, inputs[0]).reshape(params["new_sizes"])


def _transposed(code: Code, inputs: list[Operand], params: dict[str, Any]) -> Operand:
    return np.transpose(elements(code, inputs[0]), params["permutation"])


def _joined(code: Code, inputs: list[Operand], params: dict[str, Any]) -> Operand:
    return np.concatenate([elements(code, v) for v in inputs], params["dimension"])


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


def _product(code: Code, inputs: list[Operand], params: dict[str, Any]) -> Operand:
    """dot_general, of small arrays: sums of products written out."""
    a, b = (elements(code, v) for v in inputs)
    (of_a, of_b), (batch_a, batch_b) = params["dimension_numbers"]
    if batch_a or batch_b:
        raise UnsupportedError("a product of batches of matrices")
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


_SHAPED: dict[str, Callable[[Code, list[Operand], dict[str, Any]], Operand]] = {
    "squeeze": _squeezed,
    "dynamic_slice": _taken,
    "slice": _cut,
    "broadcast_in_dim": _broadcast,
    "reshape": _reshaped,
    "transpose": _transposed,
    "concatenate": _joined,
    "rev": _reversed,
    "reduce_sum": _reduction("add"),
    "reduce_max": _reduction("max"),
    "reduce_min": _reduction("min"),
    "reduce_prod": _reduction("mul"),
    "reduce_and": _reduction("and"),
    "reduce_or": _reduction("or"),
    "dot_general": _product,
}


def _branches(code: Code, params: dict[str, Any], inputs: list[Operand]) -> list[Operand]:
    """cond: each vehicle may take another branch, so all are computed and one result is taken."""
    which, operands = scalar(code, inputs[0]), inputs[1:]
    results = [
        translate(code, branch.jaxpr, branch.consts, operands) for branch in params["branches"]
    ]
    return [
        _elementwise(code, "select_n", {}, [_filled(which, case[0]), *case])
        for case in zip(*results, strict=True)
    ]


def _filled(which: Value, like: Operand) -> Elements:
    filled = np.empty(like.shape, object)
    for at in np.ndindex(*like.shape):
        filled[at] = which
    return filled


# Loops. What a loop carries is kept in registers, one of LLVM's phi nodes each.


def _scan(code: Code, params: dict[str, Any], inputs: list[Operand]) -> list[Operand]:
    (n_consts, n_carry), length = _counts(params), params["length"]
    body = params["jaxpr"]
    consts, carry = inputs[:n_consts], inputs[n_consts : n_consts + n_carry]
    rows = inputs[n_consts + n_carry :]
    keeps = len(body.jaxpr.outvars) > n_carry
    computed = any(not isinstance(v, Stored) and v.dtype == object for v in rows)
    if length == 0:
        raise UnsupportedError("a loop of no passes")
    if keeps or computed:
        return _written_out(code, params, consts, carry, rows)

    def once(index: Value, carried: list[Operand]) -> list[Operand]:
        if params["reverse"]:
            index = code.operation("sub", constant(length - 1, _INDEX), index)
        return translate(
            code, body.jaxpr, body.consts, [*consts, *carried, *(_row(code, v, index) for v in rows)]
        )

    return loop(code, constant(length, _INDEX), carry, once)


def _counts(params: dict[str, Any]) -> tuple[int, int]:
    """How many of a scan's arguments stay, and how many are carried."""
    if "num_consts" in params:
        return params["num_consts"], params["num_carry"]
    # From JAX 0.12 on it keeps trees in their place.
    consts, carry, _ = params["ft_in"].unpack()
    return len(list(consts)), len(list(carry))


def _row(code: Code, operand: Operand, index: Value) -> Operand:
    """operand[index]"""
    shape = operand.shape[1:]
    view = Stored(shape, _dtype(operand), lambda at: _at(code, operand, (index, *at)))
    return view if int(np.prod(shape)) > _MOST else elements(code, view)


def _written_out(
    code: Code,
    params: dict[str, Any],
    consts: list[Operand],
    carry: list[Operand],
    rows: list[Operand],
) -> list[Operand]:
    length, body = params["length"], params["jaxpr"]
    if length > _UNROLLED:
        raise UnsupportedError(f"a loop of {length} passes whose results are all kept")
    order = range(length - 1, -1, -1) if params["reverse"] else range(length)
    kept: list[list[Elements]] = [[] for _ in body.jaxpr.outvars[len(carry) :]]
    for k in order:
        now = [_row(code, v, constant(k, _INDEX)) for v in rows]
        outputs = translate(code, body.jaxpr, body.consts, [*consts, *carry, *now])
        carry = outputs[: len(carry)]
        for column, value in zip(kept, outputs[len(carry) :], strict=True):
            column.append(elements(code, value))
    if params["reverse"]:
        kept = [column[::-1] for column in kept]
    return [*carry, *(np.stack(column) for column in kept)]


def _while(code: Code, params: dict[str, Any], inputs: list[Operand]) -> list[Operand]:
    """A loop that all vehicles leave at the same pass."""
    n_test, n_body = params["cond_nconsts"], params["body_nconsts"]
    of_test, of_body = inputs[:n_test], inputs[n_test : n_test + n_body]
    carry, body, test = inputs[n_test + n_body :], params["body_jaxpr"], params["cond_jaxpr"]

    def holds(carried: list[Operand]) -> Value:
        (going,) = translate(code, test.jaxpr, test.consts, [*of_test, *carried])
        going = scalar(code, going)
        if not going.shared:
            raise UnsupportedError("a loop that ends at another pass for each vehicle")
        return going

    # Entered at least once, as all loops here: what it then carries is not taken if it should not
    # have been.
    entered = holds(carry)
    results = loop(
        code,
        holds,
        carry,
        lambda _, carried: translate(code, body.jaxpr, body.consts, [*of_body, *carried]),
    )
    return [
        _elementwise(code, "select_n", {}, [_filled(entered, new), old, new])
        for old, new in zip(carry, results, strict=True)
    ]


def loop(
    code: Code,
    until: Value | Callable[[list[Operand]], Value],
    carry: Sequence[Operand],
    body: Callable[[Value, list[Operand]], list[Operand]],
) -> list[Operand]:
    """A loop that is passed at least once.

    Args:
        code: where it is written.
        until: how many passes (int32), or of what is carried whether there is another.
        carry: what is carried, before the first pass.
        body: of the pass's number (int32) and what is carried, what is carried on.
    """
    starts = [elements(code, v) for v in carry]
    varies = [np.vectorize(lambda v: not v.shared, otypes=[bool])(v) for v in starts]
    # What starts the same for all vehicles may not stay so: tried until nothing changes.
    while True:
        mark = _state_of(code)
        results = _tried(code, until, starts, varies, body)
        changed = [
            old | np.vectorize(lambda v: not v.shared, otypes=[bool])(new)
            for old, new in zip(varies, results[1], strict=True)
        ]
        if all(np.array_equal(a, b) for a, b in zip(varies, changed, strict=True)):
            return list(results[0])
        varies = changed
        _restore(code, mark)


def _state_of(code: Code) -> tuple[int, str, dict]:
    return len(code.lines), code.block, dict(code._spread)


def _restore(code: Code, mark: tuple[int, str, dict]) -> None:
    del code.lines[mark[0] :]
    code.block, code._spread = mark[1], dict(mark[2])


def _tried(
    code: Code,
    until: Value | Callable[[list[Operand]], Value],
    starts: list[Elements],
    varies: list[np.ndarray],
    body: Callable[[Value, list[Operand]], list[Operand]],
) -> tuple[list[Elements], list[Elements]]:
    before = [
        [code.of(v, not bool(w)) for v, w in zip(s.ravel(), each.ravel(), strict=True)]
        for s, each in zip(starts, varies, strict=True)
    ]
    entry, inside = code.block, code.begin("loop")
    code.write(f"br label %{inside}")
    code.label(inside)
    # The phi nodes are written when what comes round is known; their place is kept.
    place = len(code.lines)
    index = Value(code.register(), _INDEX, True)
    carried = []
    for s, each in zip(starts, varies, strict=True):
        values = np.empty(s.shape, object)
        for at in np.ndindex(s.shape):
            values[at] = Value(code.register(), s[at].dtype, not bool(each[at]))
        carried.append(values)
    results = [elements(code, v) for v in body(index, list(carried))]
    around = [
        [code.of(v, not bool(w) and v.shared) for v, w in zip(r.ravel(), e.ravel(), strict=True)]
        for r, e in zip(results, varies, strict=True)
    ]
    following = code.operation("add", index, constant(1, _INDEX))
    if isinstance(until, Value):
        again = code.compare("icmp slt", following, until)
    else:
        again = until(list(results))
    end = code.block
    after = code.begin("after")
    phis = [f"{index.operand} = phi i32 [ 0, %{entry} ], [ {following.operand}, %{end} ]"]
    for values, first, then in zip(carried, before, around, strict=True):
        for v, a, b in zip(values.ravel(), first, then, strict=True):
            kind = code.typed(v.dtype, v.shared)
            phis.append(f"{v.operand} = phi {kind} [ {a}, %{entry} ], [ {b}, %{end} ]")
    code.lines[place:place] = [f"  {p}" for p in phis]
    code.write(f"br i1 {again.operand}, label %{inside}, label %{after}")
    code.label(after)
    return results, results
