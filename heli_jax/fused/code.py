"""Writer of LLVM assembly: scalars that all vehicles share, and vectors over vehicles.

Numbers are in registers; arrays stay in memory (`Stored`) and are read by element.
"""

import math
import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np


class UnsupportedError(Exception):
    """An operation without a translation; the text names it."""

    place: str | None = None
    """Origin in the source, from `translate.place_of`."""

    def __str__(self) -> str:
        words = super().__str__()
        return words if self.place is None else f"{words} ({self.place})"


@contextmanager
def translating() -> Iterator[None]:
    """Convert any error during translation into UnsupportedError, which leaves the work to XLA.

    XLA gives the same result, so a failure here must not end the run. It raises the model's own
    errors again.

    Raises:
        UnsupportedError: for any other error.
    """
    try:
        yield
    except UnsupportedError:
        raise
    except Exception as e:
        raise UnsupportedError(f"this model, whose translation failed ({in_one_line(e)})") from e


def in_one_line(error: Exception) -> str:
    """Return an error in one line."""
    words = " ".join(str(error).split())
    return f"{type(error).__name__}: {words[:200]}"


@dataclass(frozen=True, slots=True)
class Value:
    """A number in the program."""

    operand: str
    """Register such as %7, or constant."""
    dtype: np.dtype
    shared: bool
    """True if all vehicles share it: a scalar instead of a vector."""


_TYPES = {
    "float64": "double",
    "float32": "float",
    "int64": "i64",
    "int32": "i32",
    "uint64": "i64",
    "uint32": "i32",
    "uint8": "i8",
    "bool": "i1",
}


def type_of(dtype: np.dtype) -> str:
    """Return LLVM's name of a type.

    Raises:
        UnsupportedError: the type is not supported, such as a complex number.
    """
    if str(dtype) not in _TYPES:
        raise UnsupportedError(f"numbers of type {dtype}")
    return _TYPES[str(dtype)]


def constant(value: float | bool | np.generic, dtype: np.dtype) -> Value:
    """Return a number known when the program is written."""
    dtype = np.dtype(dtype)
    if dtype == np.bool_:
        return Value("true" if value else "false", dtype, True)
    if dtype.kind in "iu":
        return Value(str(int(value)), dtype, True)
    type_of(dtype)
    # Hexadecimal digits of a double for both precisions: exact, also for infinity and NaN.
    (bits,) = struct.unpack("<Q", struct.pack("<d", float(np.asarray(value, dtype))))
    return Value(f"0x{bits:016X}", dtype, True)


class Code:
    """Lines of one function, in order of execution.

    Every loop runs at least once and ends only at its end, so earlier values are defined in all
    later lines.
    """

    def __init__(self, lanes: int) -> None:
        self.lanes = lanes
        """Vehicles per vector in one thread."""
        self.lines: list[str] = []
        self.block = "entry"
        self.declared: dict[str, str] = {}
        self._count = 0
        self._spread: dict[tuple[str, str], str] = {}
        self._whole: dict[str, Value] = {}

    def register(self) -> str:
        """Return a new register name."""
        self._count += 1
        return f"%v{self._count}"

    def mark(self) -> tuple[int, str, dict[tuple[str, str], str]]:
        """Return the current position, for `back_to`."""
        return len(self.lines), self.block, dict(self._spread)

    def back_to(self, mark: tuple[int, str, dict[tuple[str, str], str]]) -> None:
        """Remove all lines written since a mark."""
        del self.lines[mark[0] :]
        self.block, self._spread = mark[1], dict(mark[2])

    def write(self, line: str) -> None:
        """Append a line."""
        self.lines.append(f"  {line}")

    def pointer(self, table: str, i: int) -> str:
        """Return the i-th pointer of a table."""
        place, pointer = self.register(), self.register()
        self.write(f"{place} = getelementptr ptr, ptr {table}, i64 {i}")
        self.write(f"{pointer} = load ptr, ptr {place}")
        return pointer

    def made(self, right: str, dtype: np.dtype, shared: bool) -> Value:
        """Return the value of an instruction."""
        name = self.register()
        self.write(f"{name} = {right}")
        return Value(name, np.dtype(dtype), shared)

    def new_label(self, kind: str) -> str:
        """Return the name of a block to be written later."""
        self._count += 1
        return f"{kind}{self._count}"

    def label(self, name: str) -> None:
        """Begin a block."""
        self.block = name
        self.lines.append(f"{name}:")

    def typed(self, dtype: np.dtype, shared: bool) -> str:
        """Return the type of a shared number, or of one per vehicle."""
        return self.vector(type_of(np.dtype(dtype)), shared)

    def vector(self, kind: str, shared: bool = False) -> str:
        """Return LLVM's type of a shared number, or of one per vehicle."""
        return kind if shared else f"<{self.lanes} x {kind}>"

    def of(self, value: Value, shared: bool) -> str:
        """Return the operand as a shared number, or spread over the vehicles."""
        if shared or not value.shared:
            return value.operand
        kind = type_of(value.dtype)
        if not value.operand.startswith("%"):
            return f"splat ({kind} {value.operand})"
        key = (value.operand, kind)
        if key not in self._spread:
            vector = f"<{self.lanes} x {kind}>"
            first = self.register()
            self.write(f"{first} = insertelement {vector} poison, {kind} {value.operand}, i64 0")
            name = self.register()
            mask = f"<{self.lanes} x i32> zeroinitializer"
            self.write(f"{name} = shufflevector {vector} {first}, {vector} poison, {mask}")
            self._spread[key] = name
        return self._spread[key]

    def operation(self, name: str, *values: Value) -> Value:
        """Write an instruction with operands of one type, such as `fadd contract`."""
        shared = all(v.shared for v in values)
        kind = self.typed(values[0].dtype, shared)
        operands = ", ".join(self.of(v, shared) for v in values)
        return self.made(f"{name} {kind} {operands}", values[0].dtype, shared)

    def compare(self, name: str, a: Value, b: Value) -> Value:
        """Write a comparison, such as `fcmp olt`."""
        return replace(self.operation(name, a, b), dtype=np.dtype(bool))

    def intrinsic(self, name: str, *values: Value) -> Value:
        """Write a call of an LLVM intrinsic, such as `sqrt`.

        For vectors it becomes the processor's instruction, or a call of the C library for each
        vehicle.
        """
        shared = all(v.shared for v in values)
        kind = self.typed(values[0].dtype, shared)
        suffix = {"double": "f64", "float": "f32"}.get(type_of(values[0].dtype))
        suffix = suffix or type_of(values[0].dtype)
        full = f"@llvm.{name}.{self.many(shared)}{suffix}"
        self.declared[full] = f"declare {kind} {full}({', '.join([kind] * len(values))})"
        operands = ", ".join(f"{kind} {self.of(v, shared)}" for v in values)
        return self.made(f"call {kind} {full}({operands})", values[0].dtype, shared)

    def by_lane(self, function: Callable[..., Value], dtype: np.dtype, *values: Value) -> Value:
        """Apply a scalar function for each vehicle; once if all values are shared."""
        shared = all(v.shared for v in values)
        if shared:
            return function(*values)
        joined = Value("poison", dtype, False)
        vector = self.typed(dtype, False)
        for lane in range(self.lanes):
            scalars = [
                v
                if v.shared
                else self.made(
                    f"extractelement {self.typed(v.dtype, False)} {v.operand}, i64 {lane}",
                    v.dtype,
                    True,
                )
                for v in values
            ]
            result = function(*scalars).operand
            right = (
                f"insertelement {vector} {joined.operand}, {type_of(dtype)} {result}, i64 {lane}"
            )
            joined = self.made(right, dtype, False)
        return joined

    def many(self, shared: bool) -> str:
        """Return the prefix of a type in an intrinsic's name."""
        return "" if shared else f"v{self.lanes}"

    def choose(self, which: Value, yes: Value, no: Value) -> Value:
        """Write a selection between two values."""
        shared = which.shared and yes.shared and no.shared
        kind = self.typed(yes.dtype, shared)
        # A shared condition is a scalar in LLVM, even for vectors.
        of_which = f"{self.vector('i1', which.shared)} {which.operand}"
        operands = f"{kind} {self.of(yes, shared)}, {kind} {self.of(no, shared)}"
        return self.made(f"select {of_which}, {operands}", yes.dtype, shared)

    def cast(self, name: str, value: Value, dtype: np.dtype) -> Value:
        """Write a conversion to another type, such as `sitofp`."""
        source = self.typed(value.dtype, value.shared)
        target = self.typed(dtype, value.shared)
        return self.made(f"{name} {source} {value.operand} to {target}", dtype, value.shared)

    def store_integer(self, value: Value, integer: Value) -> None:
        """Store the integer from which a floating-point number was converted."""
        self._whole[value.operand] = integer

    def whole(self, value: Value) -> Value | None:
        """Return the integer from which a number was converted, so that converting back is free."""
        return self._whole.get(value.operand)

    def load(self, pointer: str, index: Value, dtype: np.dtype) -> Value:
        """Load an element of an array that all vehicles share; the index may differ between
        vehicles.
        """
        dtype, kind = np.dtype(dtype), type_of(np.dtype(dtype))
        stored = "i8" if kind == "i1" else kind

        def element(index: Value) -> Value:
            at = self.register()
            place = f"{type_of(index.dtype)} {index.operand}"
            self.write(f"{at} = getelementptr {stored}, ptr {pointer}, {place}")
            value = self.made(f"load {stored}, ptr {at}", dtype, True)
            return (
                value if kind != "i1" else self.made(f"trunc i8 {value.operand} to i1", dtype, True)
            )

        return self.by_lane(element, dtype, index)


INDEX = np.dtype(np.int32)
"""Type of indices into arrays, and of loop counters."""


class Stored(NamedTuple):
    """An array (N, ...) in memory, or an expression of such, computed by element."""

    shape: tuple[int, ...]
    dtype: np.dtype
    element: Callable[[tuple[Value, ...]], Value]
    """Function of int32 indices, one for each dimension, that returns the element."""


type Operand = Value | Stored


def scalar(operand: Operand) -> Value:
    """Return an operand as one number.

    Raises:
        UnsupportedError: it is an array.
    """
    if isinstance(operand, Value):
        return operand
    if math.prod(operand.shape) != 1:
        raise UnsupportedError(f"an array of {operand.shape} as a whole")
    return operand.element((constant(0, INDEX),) * len(operand.shape))


def shape_of(operand: Operand) -> tuple[int, ...]:
    """Return the shape of an operand; () for a number."""
    return () if isinstance(operand, Value) else operand.shape


def at_place(operand: Operand, at: tuple[Value, ...]) -> Value:
    """Return an element of an operand; a number is the same everywhere."""
    return operand if isinstance(operand, Value) else operand.element(at)


def flat(code: Code, shape: tuple[int, ...], at: tuple[Value, ...]) -> Value:
    """Return the position of an element in a row-major array."""
    flat = at[0]
    for length, index in zip(shape[1:], at[1:], strict=True):
        flat = code.operation("mul", flat, constant(length, INDEX))
        flat = code.operation("add", flat, index)
    return flat
