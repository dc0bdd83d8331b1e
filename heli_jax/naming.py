"""Names and units of record classes: a model's parameters, states, inputs and outputs.

The configuration, the readers and the report use them. A record class is any class built by keyword
with one scalar a field: a `NamedTuple`, an `eqx.Module`. A model's classes must be pytrees, as
these are; for a dataclass call `jax.tree_util.register_dataclass`. Units and meanings are optional,
in the annotation: `roll: Annotated[Scalar, "rad", "roll angle"]`.
"""

import ast
import functools
import inspect
import itertools
from collections.abc import Iterable, Mapping, Sequence
from typing import Annotated, Any, NamedTuple, get_args, get_origin, get_type_hints

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Float, Real

from heli_jax.pickled import by_value

type Scalar = Float[Array, ""] | float
"""One number: a traced or concrete array of shape (), or a Python float."""

type Number = Real[Array, ""] | Real[np.ndarray, ""] | np.number | int | float
"""A Scalar, or any other number that JAX accepts: an int, a NumPy scalar."""

# Users define their own models and record classes. No base class or protocol fits all, since the
# model chooses the field names. `Any` is assigned without a `type` statement, since beartype cannot
# check `Record | None` of an alias to Any.
Record = Any
"""An instance of a record class: a model's Params, State, Inputs or Outputs."""


@functools.cache
def names(record: type) -> tuple[str, ...]:
    """Return the field names of a record class, in order."""
    # The constructor's signature serves named tuples, dataclasses, equinox modules and plain
    # classes. A dataclass may define its own __init__, so its fields come first.
    fields = getattr(record, "__dataclass_fields__", None)
    return tuple(fields) if fields is not None else tuple(inspect.signature(record).parameters)


@functools.cache
def _notes(record: type) -> Mapping[str, tuple[Any, ...]]:
    # get_type_hints also resolves text annotations (from __future__ annotations).
    hints = get_type_hints(record, include_extras=True)
    return {
        name: get_args(hint)[1:] if get_origin(hint) is Annotated else ()
        for name, hint in hints.items()
    }


def unit(record: type, name: str) -> str | None:
    """Return the SI unit of a field; None if the class does not state one."""
    notes = _notes(record).get(name, ())
    return notes[0] if notes else None


def meaning(record: type, name: str) -> str:
    """Return the meaning of a field in words; empty if the class does not state it."""
    notes = _notes(record).get(name, ())
    return notes[1] if len(notes) > 1 else ""


def texts(record: type) -> dict[str, str]:
    """Return the documentation string below each of a class's own fields, by field."""
    body = ast.parse(inspect.cleandoc("\n" + inspect.getsource(record))).body[0]
    assert isinstance(body, ast.ClassDef)
    stated = {}
    for field, below in itertools.pairwise(body.body):
        is_text = isinstance(below, ast.Expr) and isinstance(below.value, ast.Constant)
        if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name) and is_text:
            words = below.value.value  # pyright: ignore[reportAttributeAccessIssue]
            stated[field.target.id] = " ".join(str(words).split())
    return stated


def defaults(record: type) -> dict[str, Any]:
    """Return the fields with a default, with their values."""
    signature = inspect.signature(record).parameters
    return {n: p.default for n, p in signature.items() if p.default is not inspect.Parameter.empty}


def asdict(record: Record) -> dict[str, Any]:
    """Return a record's fields by name, not copied."""
    return {name: getattr(record, name) for name in names(type(record))}


def replace(record: Record, **changes: Any) -> Record:
    """Return a new record of the same class with some fields changed."""
    # dataclasses.replace and _replace do not work for every class of a model.
    return type(record)(**{**asdict(record), **changes})


class Varied:
    """A record with fields that change often.

    Its class, which may convert and check the fields, is called only once.
    """

    def __init__(self, record: Record, fields: Iterable[str]) -> None:
        """Take the names of the changing fields."""
        self._record, self._fields, self._dtype = record, tuple(fields), jnp.result_type(float)
        marks = {n: jnp.array(getattr(record, n), self._dtype) for n in self._fields}
        self._leaves, self._structure = jax.tree.flatten(replace(record, **marks))
        at = {n: i for n, mark in marks.items() for i, v in enumerate(self._leaves) if v is mark}
        same = sum(v is own for v, own in zip(self._leaves, jax.tree.leaves(record), strict=True))
        # Otherwise the class converts its arguments and is called each time.
        self._at = at if len(at) == len(marks) == len(self._leaves) - same else {}

    # JAX's structure refers to a class that may be made at run time, which pickle cannot find.
    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self._record, self._fields)

    def having(self, values: Mapping[str, Any]) -> Record:
        """Return the record with these values (concrete numbers) in the changing fields."""
        numbers = {n: np.asarray(v, self._dtype) for n, v in values.items()}
        if not self._at:
            return replace(self._record, **{n: jnp.asarray(v) for n, v in numbers.items()})
        leaves = list(self._leaves)
        for n, v in numbers.items():
            # JAX arrays, as from the class itself. `asarray` takes ten times as long.
            leaves[self._at[n]] = jax.device_put(v)
        return jax.tree.unflatten(self._structure, leaves)


def ravel(
    record: Record, dtype: DTypeLike | None = None, only: Sequence[str] | None = None
) -> Float[Array, " n"]:
    """Return a record as a vector, in the order of its class's fields.

    Args:
        dtype: type of the vector; default: that of the fields.
        only: fields to take, in this order; default: all.
    """
    taken = names(type(record)) if only is None else only
    return jnp.stack([jnp.asarray(getattr(record, name), dtype) for name in taken])


def unravel(record: type, vector: Float[Array, " n"]) -> Record:
    """Return a record from a vector in the order of its class's fields; the inverse of `ravel`.

    Raises:
        ValueError: the numbers of elements and fields differ.
    """
    return record(**dict(zip(names(record), vector, strict=True)))


def fields(record: type) -> dict[str, Any]:
    """Return the annotations of a record class by name, in order."""
    hints = get_type_hints(record, include_extras=True)
    return {name: hints[name] for name in names(record)}


def extended(record: type, title: str, more: Mapping[str, tuple[Any, Any]]) -> type:
    """Return a record class with the fields of `record` and `more`.

    Args:
        more: (annotation, default) by name; a default of None means no default.
    """
    # A named tuple needs no base class, and JAX knows it. Fields without a default must come first,
    # so the order of `record` may change.
    known = fields(record)
    with_default = {**defaults(record), **{n: d for n, (_, d) in more.items() if d is not None}}
    known.update({n: annotation for n, (annotation, _) in more.items()})
    ordered = sorted(known, key=lambda n: n in with_default)
    made: Any = NamedTuple(title, [(n, known[n]) for n in ordered])  # type: ignore[misc]
    # The functional form of NamedTuple takes no defaults, so they are set here.
    made.__new__.__defaults__ = tuple(with_default[n] for n in ordered if n in with_default)
    made._field_defaults = {n: with_default[n] for n in ordered if n in with_default}
    made.__reduce__ = by_value
    return made
