"""Loops: what they carry is kept in registers, one of LLVM's phi nodes each."""

from collections.abc import Callable, Sequence

import numpy as np

from heli_jax.fused.code import Code, Value, constant
from heli_jax.fused.operands import INDEX, Elements, Operand, elements


def loop(
    code: Code,
    until: Value | Callable[[list[Operand]], Value],
    carry: Sequence[Operand],
    body: Callable[[Value, list[Operand]], list[Operand]],
) -> list[Operand]:
    """A loop that is passed at least once.

    Args:
        until: how many passes (int32), or of what is carried whether there is another.
        carry: what is carried, before the first pass.
        body: of the pass's number (int32) and what is carried, what is carried on.
    """
    starts = [elements(code, v) for v in carry]
    varies = [_vary(v) for v in starts]
    # What starts the same for all vehicles may not stay so: tried until nothing changes.
    while True:
        mark = code.mark()
        results = _tried(code, until, starts, varies, body)
        changed = [old | _vary(new) for old, new in zip(varies, results[1], strict=True)]
        if all(np.array_equal(a, b) for a, b in zip(varies, changed, strict=True)):
            return list(results[0])
        varies = changed
        code.back_to(mark)


def _vary(values: Elements) -> np.ndarray:
    """Of each whether vehicles have numbers of their own."""
    return np.vectorize(lambda v: not v.shared, otypes=[bool])(values)


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
    entry, inside = code.block, code.new_label("loop")
    code.write(f"br label %{inside}")
    code.label(inside)
    # The phi nodes are written when what comes round is known; their place is kept.
    place = len(code.lines)
    index = Value(code.register(), INDEX, True)
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
    following = code.operation("add", index, constant(1, INDEX))
    if isinstance(until, Value):
        again = code.compare("icmp slt", following, until)
    else:
        again = until(list(results))
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
    return results, results
