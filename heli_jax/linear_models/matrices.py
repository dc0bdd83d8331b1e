"""Matrices of a file by entry, with checked names, units and expressions."""

import ast
import math
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np

from heli_jax import units
from heli_jax.errors import InputError, nearest
from heli_jax.linear_models import expression
from heli_jax.linear_models.content import BASE_UNITS, PLAIN, TIME, Content, Signal, as_mapping
from heli_jax.linear_models.expression import Dimension, ExpressionError, Node


class Entry(NamedTuple):
    """A matrix entry: `factor` times an expression, in SI."""

    row: str
    column: str
    node: Node
    factor: float
    place: str
    """Position and text of the entry, for messages."""


class _Unit(NamedTuple):
    """Unit of a row or a column."""

    dimension: Dimension
    scale: float
    """Factor from the file's unit to SI."""
    bare: bool = True
    """True if a number without a parameter is allowed there."""


def matrices_of(mapping: Mapping[str, Any], content: Content) -> dict[str, tuple[Entry, ...]]:
    """Return the entries of A, B, C, D and E.

    Raises:
        InputError: an entry is wrong, or the parameters' values make one infinite.
    """
    matrices = _Matrices(mapping, content).all()
    values = {n: q.constant.value for n, q in content.parameters.items()}
    # The file's own values are checked here. Otherwise the model would fail at its first use, far
    # from the wrong line.
    if problem := impossible_parameters(content, matrices, values):
        raise InputError(problem)
    return matrices


def impossible_parameters(
    content: Content, matrices: Mapping[str, tuple[Entry, ...]], values: Mapping[str, float]
) -> str:
    """Return a sentence on parameters that are impossible; empty if all are possible.

    Parameters marked positive must be so, every entry must be finite, and E must be invertible.

    Args:
        values: values of all parameters, by name [SI].
    """
    # The message is returned, since only the caller knows whether the values are the file's, a
    # vehicle's or a configuration's.
    for name, quantity in content.parameters.items():
        if quantity.positive and not values[name] > 0:
            return f"{name}: expected a value above zero (positive: true), got {values[name]:g}"
    for entry in (one for entries in matrices.values() for one in entries):
        if not math.isfinite(_value(entry, values)):
            return f"{entry.place}: not finite for the values of the parameters"
    return _not_invertible(content, matrices["E"], values)


def _value(entry: Entry, values: Mapping[str, float]) -> float:
    try:
        number = expression.evaluate(entry.node, lambda name: float(values[name]))
    # Python raises where NumPy returns infinity. NaN represents both, and the caller names the
    # entry.
    except (ZeroDivisionError, OverflowError):
        return math.nan
    return entry.factor * float(number)


def _not_invertible(
    content: Content, entries: tuple[Entry, ...], values: Mapping[str, float]
) -> str:
    names = list(content.states)
    # E as in the equations: rows that the file does not name are those of the unit matrix.
    E = np.eye(len(names))
    for row in {entry.row for entry in entries}:
        E[names.index(row)] = 0.0
    for entry in entries:
        E[names.index(entry.row), names.index(entry.column)] = _value(entry, values)
    # Scale rows and columns, so that units do not affect the rank.
    for axis in (1, 0):
        # A zero row stays zero and lowers the rank, without a division by zero.
        E = E / np.maximum(np.max(np.abs(E), axis=axis, keepdims=True), 1e-300)
    singular = np.linalg.matrix_rank(E) < len(names)
    return "E: singular for the values of the parameters" if singular else ""


class _Matrices:
    """Entries of A, B, C, D and E, with checked units and in SI.

    A row of A and B is a derivative, in the state's unit per second. If E names the row, it is also
    multiplied by the unit of E's diagonal. An entry is in the row's unit over the column's. Without
    a parameter it is a number in the file's units; otherwise its parameters make it SI.
    """

    def __init__(self, given: Mapping[str, Any], content: Content) -> None:
        self.given, self.content = given, content
        self.dimensions = {n: q.dimension for n, q in content.parameters.items()}
        self.columns = {
            n: _Unit(one.dimension, one.scale)
            for n, one in {**content.states, **content.inputs}.items()
        }
        self.outputs = {n: _Unit(o.dimension, o.scale) for n, o in content.outputs.items()}
        # A derivative is per second in any file, so only the state's unit is converted.
        self.rates = {n: _over(self.columns[n], _Unit(TIME, 1.0)) for n in content.states}

    def all(self) -> dict[str, tuple[Entry, ...]]:
        states, inputs, outputs = self.content.states, self.content.inputs, self.content.outputs
        # E first, since its diagonal sets the units of its rows in A and B.
        matrices = {"E": self.masses()}
        for name, rows, columns in (
            ("A", self.rates, states),
            ("B", self.rates, inputs),
            ("C", self.outputs, states),
            ("D", self.outputs, inputs),
        ):
            matrices[name] = self.matrix(name, rows, columns)
        self.check_rows(states, outputs)
        return matrices

    def rows(self, matrix: str, known: Iterable[str], columns: Iterable[str]) -> dict[str, Any]:
        """Return a matrix as written, by row and column.

        Raises:
            InputError: a row or a column has an unknown name.
        """
        by_row = {}
        # Check both names before reading an entry, whose unit depends on its row and column.
        kind = "output" if matrix in ("C", "D") else "state"
        for row, entries in as_mapping(self.given.get(matrix, {}), matrix).items():
            if row not in known:
                raise InputError(f"{matrix}.{row}: no such {kind}{nearest(str(row), known)}")
            for column in as_mapping(entries, f"{matrix}.{row}"):
                if column not in columns:
                    kind = "input" if matrix in ("B", "D") else "state"
                    raise InputError(
                        f"{matrix}.{row}.{column}: no such {kind}{nearest(str(column), columns)}"
                    )
            by_row[row] = entries
        return by_row

    def matrix(
        self, name: str, rows: Mapping[str, _Unit], columns: Iterable[str]
    ) -> tuple[Entry, ...]:
        """Return all entries of a matrix other than E.

        Raises:
            InputError: a name or an entry is wrong.
        """
        return tuple(
            self.entry(f"{name}.{row}.{column}", one, row, column, rows[row])
            for row, row_entries in self.rows(name, rows, columns).items()
            for column, one in row_entries.items()
        )

    def masses(self) -> tuple[Entry, ...]:
        """Return the entries of E, whose diagonal sets the units of its rows."""
        states, entries = self.content.states, []
        for row, row_entries in self.rows("E", states, states).items():
            # The diagonal comes first, since it sets the unit of the whole row: mass times
            # acceleration is a force.
            if row in row_entries:
                node = self.tree(f"E.{row}.{row}", row_entries[row])
                try:
                    mass = expression.dimension(node, self.dimensions, PLAIN)
                except ExpressionError as e:
                    raise InputError(f"E.{row}.{row}: {row_entries[row]!r:.80}: {e}") from e
                rate = self.rates[row].dimension
                total = tuple(i + j for i, j in zip(rate, mass, strict=True))
                # Plain numbers in such a row would mix the file's and the parameter's units. They
                # are refused unless the diagonal is a plain number.
                self.rates[row] = _Unit(total, self.rates[row].scale, total == rate)
            for column, one in row_entries.items():
                place = f"E.{row}.{column}"
                rate = _over(self.columns[column], _Unit(TIME, 1.0))
                entries.append(self.entry(place, one, row, column, self.rates[row], rate))
        return tuple(entries)

    def tree(self, place: str, source: Any) -> Node:
        # Python's true is the number 1, which in a matrix is a mistake.
        if isinstance(source, bool) or not isinstance(source, int | float | str):
            raise InputError(f"{place}: expected a number or an expression, got {source!r:.40}")
        if isinstance(source, str):
            try:
                return expression.parse(source, self.content.parameters)
            except ExpressionError as e:
                raise InputError(f"{place}: {e}") from e
        value = float(source)
        if not math.isfinite(value):
            raise InputError(f"{place}: expected a finite number, got {source!r:.40}")
        return ast.Constant(value)

    def entry(
        self,
        place: str,
        source: Any,
        row: str,
        column: str,
        of: _Unit,
        per: _Unit | None = None,
    ) -> Entry:
        """Return one entry, checked.

        Args:
            source: number or expression from the YAML.
            per: unit of the column; default: that of the state or input.

        Raises:
            InputError: it is no number or expression, or has the wrong dimension.
        """
        node = self.tree(place, source)
        text = f"{place}: {source!r:.80}"
        over = self.columns[column] if per is None else per
        expected = _over(of, over)
        # Only parameters have units to check. Plain numbers, also 2*9.81, are in the file's units.
        if not expression.parameters_of(node):
            if not of.bare:
                raise InputError(
                    f"{text}: a number in a row whose E.{row}.{row} has a unit, expected a "
                    f"parameter in {_unit_text(expected.dimension)}"
                )
            return Entry(row, column, node, expected.scale, text)
        try:
            # Parameters are in SI, so the entry needs no factor if its dimension is right.
            dimension = expression.dimension(node, self.dimensions, PLAIN)
        except ExpressionError as e:
            raise InputError(f"{text}: {e}") from e
        if dimension != expected.dimension:
            raise InputError(
                f"{text}: expected {_unit_text(expected.dimension)} ({_unit_text(of.dimension)} of "
                f"the row over {_unit_text(over.dimension)} of the column), got "
                f"{_unit_text(dimension)}"
            )
        return Entry(row, column, node, 1.0, text)

    def check_rows(self, states: Mapping[str, Any], outputs: Mapping[str, Signal]) -> None:
        """Refuse states without a derivative, and outputs without an equation or a state of their
        name.
        """
        # A state without a row would silently stay constant. An empty row states that on purpose.
        for name in states:
            if name not in self.given["A"] and name not in self.given.get("B", {}):
                raise InputError(
                    f"A.{name}: missing, expected the row of that state's derivative ({{}} where "
                    "it is zero)"
                )
        for name, output in outputs.items():
            if name in self.given.get("C", {}) or name in self.given.get("D", {}):
                continue
            if name not in states:
                raise InputError(
                    f"outputs.{name}: expected a row C.{name}, or the name of a state"
                    f"{nearest(name, states)}"
                )
            # Compare dimensions, since degrees and radians are the same number in SI.
            if states[name].dimension != output.dimension:
                raise InputError(
                    f"outputs.{name}.unit: expected the kind of the state {name}, in "
                    f"{states[name].si}, got {output.si}"
                )


def _over(above: _Unit, below: _Unit) -> _Unit:
    dimension = tuple(i - j for i, j in zip(above.dimension, below.dimension, strict=True))
    return _Unit(dimension, above.scale / below.scale)


def _unit_text(dimension: Dimension) -> str:
    return units.as_text(dict(zip(BASE_UNITS, dimension, strict=True)))
