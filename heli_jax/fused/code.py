"""LLVM assembly, line by line: scalars that all vehicles share, and vectors over vehicles.

Small arrays are taken apart, long ones left in memory (`Stored`).
"""

import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np


class UnsupportedError(Exception):
    """An operation that has no translation; in words what it is."""

    place: str | None = None
    """where it comes from, as `fused.place` has it"""

    def __str__(self) -> str:
        words = super().__str__()
        return words if self.place is None else f"{words} ({self.place})"


@contextmanager
def translating() -> Iterator[None]:
    """Turn any error while translating into one that leaves the program untranslated.

    XLA computes the same: no failure here may end what somebody asked for. An error of the model's
    own is raised there again.

    Raises:
        UnsupportedError: in place of any other error.
    """
    try:
        yield
    except UnsupportedError:
        raise
    except Exception as e:
        raise UnsupportedError(f"this model, whose translation failed ({said(e)})") from e


def said(error: Exception) -> str:
    """Return an error in one line."""
    words = " ".join(str(error).split())
    return f"{type(error).__name__}: {words[:200]}"


@dataclass(frozen=True, slots=True)
class Value:
    """A number of the program."""

    operand: str
    """a register such as %7, or a constant"""
    dtype: np.dtype
    shared: bool
    """the same for all vehicles: a scalar, no vector"""


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
    """LLVM's name of a type.

    Raises:
        UnsupportedError: it has none here, as a complex number.
    """
    if str(dtype) not in _TYPES:
        raise UnsupportedError(f"numbers of type {dtype}")
    return _TYPES[str(dtype)]


def constant(value: float | bool | np.generic, dtype: np.dtype) -> Value:
    """A number that is known when the program is written."""
    dtype = np.dtype(dtype)
    if dtype == np.bool_:
        return Value("true" if value else "false", dtype, True)
    if dtype.kind in "iu":
        return Value(str(int(value)), dtype, True)
    type_of(dtype)
    # In hexadecimal digits of a double for both precisions: no digit is lost, and what is not
    # finite has them too.
    (bits,) = struct.unpack("<Q", struct.pack("<d", float(np.asarray(value, dtype))))
    return Value(f"0x{bits:016X}", dtype, True)


class Code:
    """Lines of one function, in the order in which they are run.

    Every loop is entered at least once and left at its end alone, so that what was written before
    stands for all that comes after.
    """

    def __init__(self, lanes: int) -> None:
        self.lanes = lanes
        """vehicles in flight at once in one thread: vectors of so many; with one, plain numbers"""
        self.lines: list[str] = []
        self.block = "entry"
        self.declared: dict[str, str] = {}
        self.globals: dict[str, str] = {}
        self._count = 0
        self._spread: dict[tuple[str, str], str] = {}
        self._whole: dict[str, Value] = {}

    def register(self) -> str:
        """A name that is new."""
        self._count += 1
        return f"%v{self._count}"

    def mark(self) -> tuple[int, str, dict[tuple[str, str], str]]:
        """A place to come back to."""
        return len(self.lines), self.block, dict(self._spread)

    def back_to(self, mark: tuple[int, str, dict[tuple[str, str], str]]) -> None:
        """Take back what was written since."""
        del self.lines[mark[0] :]
        self.block, self._spread = mark[1], dict(mark[2])

    def write(self, line: str) -> None:
        """A line as it is."""
        self.lines.append(f"  {line}")

    def pointer(self, table: str, i: int) -> str:
        """The i-th of a table of pointers."""
        place, pointer = self.register(), self.register()
        self.write(f"{place} = getelementptr ptr, ptr {table}, i64 {i}")
        self.write(f"{pointer} = load ptr, ptr {place}")
        return pointer

    def made(self, right: str, dtype: np.dtype, shared: bool) -> Value:
        """The value of an instruction."""
        name = self.register()
        self.write(f"{name} = {right}")
        return Value(name, np.dtype(dtype), shared)

    def new_label(self, kind: str) -> str:
        """The name of a block that is yet to be written."""
        self._count += 1
        return f"{kind}{self._count}"

    def label(self, name: str) -> None:
        """Here begins a block."""
        self.block = name
        self.lines.append(f"{name}:")

    def typed(self, dtype: np.dtype, shared: bool) -> str:
        """The type of a number, or of one a vehicle."""
        return self.vector(type_of(np.dtype(dtype)), shared)

    def vector(self, kind: str, shared: bool = False) -> str:
        """LLVM's type of one number, or of one a vehicle."""
        return kind if shared or self.lanes == 1 else f"<{self.lanes} x {kind}>"

    def of(self, value: Value, shared: bool) -> str:
        """The operand for a shared number or, spread over the vehicles, for one each."""
        if shared or not value.shared or self.lanes == 1:
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
        """An instruction of operands of one type, such as `fadd contract`."""
        shared = all(v.shared for v in values)
        kind = self.typed(values[0].dtype, shared)
        operands = ", ".join(self.of(v, shared) for v in values)
        return self.made(f"{name} {kind} {operands}", values[0].dtype, shared)

    def compare(self, name: str, a: Value, b: Value) -> Value:
        """A truth value, by `fcmp olt` and the like."""
        return replace(self.operation(name, a, b), dtype=np.dtype(bool))

    def intrinsic(self, name: str, *values: Value) -> Value:
        """A function that LLVM knows, such as `sqrt`; of vectors it makes the processor's own, or
        calls the C library's for each vehicle."""
        shared = all(v.shared for v in values)
        kind = self.typed(values[0].dtype, shared)
        suffix = {"double": "f64", "float": "f32"}.get(type_of(values[0].dtype))
        suffix = suffix or type_of(values[0].dtype)
        full = f"@llvm.{name}.{self.many(shared)}{suffix}"
        self.declared[full] = f"declare {kind} {full}({', '.join([kind] * len(values))})"
        operands = ", ".join(f"{kind} {self.of(v, shared)}" for v in values)
        return self.made(f"call {kind} {full}({operands})", values[0].dtype, shared)

    def by_lane(self, function: Callable[..., Value], dtype: np.dtype, *values: Value) -> Value:
        """A function of scalars for each vehicle; once where all values are shared."""
        shared = all(v.shared for v in values)
        if shared or self.lanes == 1:
            return replace(function(*values), shared=shared)
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
        return "" if shared or self.lanes == 1 else f"v{self.lanes}"

    def choose(self, which: Value, yes: Value, no: Value) -> Value:
        """One of two."""
        shared = which.shared and yes.shared and no.shared
        kind = self.typed(yes.dtype, shared)
        # One truth value for whole vectors is a scalar to LLVM too.
        of_which = f"{self.vector('i1', which.shared)} {which.operand}"
        operands = f"{kind} {self.of(yes, shared)}, {kind} {self.of(no, shared)}"
        return self.made(f"select {of_which}, {operands}", yes.dtype, shared)

    def cast(self, name: str, value: Value, dtype: np.dtype) -> Value:
        """Another type, by `sitofp` and the like."""
        source = self.typed(value.dtype, value.shared)
        target = self.typed(dtype, value.shared)
        return self.made(f"{name} {source} {value.operand} to {target}", dtype, value.shared)

    def remember_whole(self, value: Value, integer: Value) -> None:
        """Remember that a floating-point number was made of an integer."""
        self._whole[value.operand] = integer

    def whole(self, value: Value) -> Value | None:
        """The integer that a number was made of, so that its way back costs nothing."""
        return self._whole.get(value.operand)

    def load(self, pointer: str, index: Value, dtype: np.dtype) -> Value:
        """The element of an array that all vehicles share; of each another where the index is."""
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

    def table(self, values: np.ndarray) -> str:
        """A pointer to numbers that are known when the program is written."""
        kind = type_of(values.dtype)
        if kind == "i1":
            kind, values = "i8", values.astype(np.uint8)
        each = ", ".join(f"{kind} {constant(v, values.dtype).operand}" for v in values.ravel())
        text = f"private unnamed_addr constant [{values.size} x {kind}] [{each}]"
        name = next((n for n, t in self.globals.items() if t == text), None)
        if name is None:
            name = f"@table{len(self.globals)}"
            self.globals[name] = text
        return name


MOST = 4096
"""Elements of an array that is taken apart; more would take minutes to compile."""
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


def elements(operand: Operand) -> Elements:
    """An operand as an array of Values."""
    if isinstance(operand, Stored):
        if int(np.prod(operand.shape)) > MOST:
            raise UnsupportedError(f"an array of {operand.shape} as a whole")
        every = np.empty(operand.shape, object)
        for at in np.ndindex(operand.shape):
            every[at] = operand.element(tuple(constant(i, INDEX) for i in at))
        return every
    return operand if operand.dtype == object else applied(constant, operand, dtype=operand.dtype)


def applied(function: Callable[..., Any], *arrays: Elements, **others: Any) -> Elements:
    """A function of Values, element by element of arrays that NumPy broadcasts."""
    mapped = np.frompyfunc(lambda *v: function(*v, **others), len(arrays), 1)
    return np.asarray(mapped(*arrays), object)


def scalar(operand: Operand) -> Value:
    """The Value of an operand that is one number."""
    return elements(operand).item()


def dtype_of(operand: Operand) -> np.dtype:
    """The type of an operand's numbers."""
    if isinstance(operand, Stored) or operand.dtype != object:
        return operand.dtype
    return operand.ravel()[0].dtype


def at_place(code: Code, operand: Operand, at: tuple[Value, ...]) -> Value:
    """One element of an operand at indices that the program computes."""
    if isinstance(operand, Stored):
        return operand.element(at)
    if operand.shape == ():
        return scalar(operand)
    if operand.dtype != object:
        return code.load(code.table(operand), flat(code, operand.shape, at), operand.dtype)
    if all(not i.operand.startswith("%") for i in at):
        return operand[tuple(int(i.operand) for i in at)]
    if operand.size > LONG:
        raise UnsupportedError(
            f"an element at a computed place of a computed array {operand.shape}"
        )
    # Every element is at hand in a register: the one that is meant is chosen among all.
    place, chosen = flat(code, operand.shape, at), operand.ravel()[-1]
    for k in range(operand.size - 2, -1, -1):
        here = code.compare("icmp eq", place, constant(k, place.dtype))
        chosen = code.choose(here, operand.ravel()[k], chosen)
    return chosen


def flat(code: Code, shape: tuple[int, ...], at: tuple[Value, ...]) -> Value:
    """Return the position of an element in an array that is stored row by row."""
    flat = at[0]
    for length, index in zip(shape[1:], at[1:], strict=True):
        flat = code.operation("mul", flat, constant(length, INDEX))
        flat = code.operation("add", flat, index)
    return flat
