"""Names and units of a record class: what makes a model's parameters, states, inputs and outputs
readable by the configuration, the readers and the report.

A record class is any class built by keyword with one scalar a field: a `NamedTuple`, an
`eqx.Module`. A model's classes have to be known to JAX as pytrees, as these are; a dataclass is
with `jax.tree_util.register_dataclass`. Units and meanings are optional, in the annotation:
`roll: Annotated[Scalar, "rad", "roll angle"]`.
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
"""As Scalar, or whatever else JAX takes for one number: an int, a NumPy scalar."""

# Models are anyone's own, and so are the classes of their parameters, states, inputs and outputs:
# no base class or protocol holds them all, since their field names are what the model says.
# A plain name, not a `type` statement: beartype cannot check `Record | None` of an alias to Any.
Record = Any
"""An instance of a record class: a model's Params, State, Inputs or Outputs."""


@functools.cache
def names(record: type) -> tuple[str, ...]:
    """The field names of a record class, in order."""
    # By the constructor's signature: named tuples, dataclasses, equinox modules and plain classes
    # all have one. A dataclass may have an __init__ of its own, so its fields are asked first.
    fields = getattr(record, "__dataclass_fields__", None)
    return tuple(fields) if fields is not None else tuple(inspect.signature(record).parameters)


@functools.cache
def _notes(record: type) -> Mapping[str, tuple[Any, ...]]:
    # Through typing, which also resolves annotations that are text (from __future__ annotations).
    hints = get_type_hints(record, include_extras=True)
    return {
        name: get_args(hint)[1:] if get_origin(hint) is Annotated else ()
        for name, hint in hints.items()
    }


def unit(record: type, name: str) -> str | None:
    """The SI unit of a field, or None where the class does not say."""
    notes = _notes(record).get(name, ())
    return notes[0] if notes else None


def meaning(record: type, name: str) -> str:
    """Return the meaning of a field in words; empty if the class does not state it."""
    notes = _notes(record).get(name, ())
    return notes[1] if len(notes) > 1 else ""


def texts(record: type) -> dict[str, str]:
    """Return the text below each of a class's own fields in its source, by field."""
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
    """The fields that need not be given, with their values."""
    signature = inspect.signature(record).parameters
    return {n: p.default for n, p in signature.items() if p.default is not inspect.Parameter.empty}


def asdict(record: Record) -> dict[str, Any]:
    """A record's fields by name, not copied."""
    return {name: getattr(record, name) for name in names(type(record))}


def replace(record: Record, **changes: Any) -> Record:
    """A new record of the same class with some fields changed."""
    # Not dataclasses.replace, nor _replace: a model's classes may be either, or neither.
    return type(record)(**{**asdict(record), **changes})


class Varied:
    """A record with some fields that change often: its class, which may convert and check them, is
    asked once."""

    def __init__(self, record: Record, fields: Iterable[str]) -> None:
        """Take the names of these fields."""
        self._record, self._fields, self._dtype = record, tuple(fields), jnp.result_type(float)
        marks = {n: jnp.array(getattr(record, n), self._dtype) for n in self._fields}
        self._leaves, self._structure = jax.tree.flatten(replace(record, **marks))
        at = {n: i for n, mark in marks.items() for i, v in enumerate(self._leaves) if v is mark}
        same = sum(v is own for v, own in zip(self._leaves, jax.tree.leaves(record), strict=True))
        # A class that makes something else of what it is given is asked each time.
        self._at = at if len(at) == len(marks) == len(self._leaves) - same else {}

    # JAX's structure names a class that may have been made on the spot, which pickle cannot find.
    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self._record, self._fields)

    def having(self, values: Mapping[str, Any]) -> Record:
        """The record with these values, which are concrete numbers, of fields that change."""
        numbers = {n: np.asarray(v, self._dtype) for n, v in values.items()}
        if not self._at:
            return replace(self._record, **{n: jnp.asarray(v) for n, v in numbers.items()})
        leaves = list(self._leaves)
        for n, v in numbers.items():
            # Arrays of JAX's, as the class itself would have; by `asarray` each takes ten times.
            leaves[self._at[n]] = jax.device_put(v)
        return jax.tree.unflatten(self._structure, leaves)


def ravel(
    record: Record, dtype: DTypeLike | None = None, only: Sequence[str] | None = None
) -> Float[Array, " n"]:
    """A record as a vector, in the order of its class's fields.

    Args:
        dtype: of the vector; that of the fields unless given.
        only: the fields to take, in this order; all of them unless given.
    """
    taken = names(type(record)) if only is None else only
    return jnp.stack([jnp.asarray(getattr(record, name), dtype) for name in taken])


def unravel(record: type, vector: Float[Array, " n"]) -> Record:
    """The record of a class from a vector in the order of its fields: what `ravel` makes, back.

    Raises:
        ValueError: the vector has more or fewer numbers than the class has fields.
    """
    return record(**dict(zip(names(record), vector, strict=True)))


def fields(record: type) -> dict[str, Any]:
    """The annotations of a record class by name, in order."""
    hints = get_type_hints(record, include_extras=True)
    return {name: hints[name] for name in names(record)}


def extended(record: type, title: str, more: Mapping[str, tuple[Any, Any]]) -> type:
    """A record class with the fields of `record` and `more`.

    Args:
        more: by name, (annotation, default); None for no default.
    """
    # A named tuple, whatever `record` is: it needs no base class, and JAX knows it. Fields without
    # a default have to come first, so the order of `record` is not kept.
    known = fields(record)
    with_default = {**defaults(record), **{n: d for n, (_, d) in more.items() if d is not None}}
    known.update({n: annotation for n, (annotation, _) in more.items()})
    ordered = sorted(known, key=lambda n: n in with_default)
    made: Any = NamedTuple(title, [(n, known[n]) for n in ordered])  # type: ignore[misc]
    # The functional form of NamedTuple takes no defaults: they are set where the other form does.
    made.__new__.__defaults__ = tuple(with_default[n] for n in ordered if n in with_default)
    made._field_defaults = {n: with_default[n] for n in ordered if n in with_default}
    made.__reduce__ = by_value
    return made
