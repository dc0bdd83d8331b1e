"""The functions of a linear model from the entries of its matrices."""

from collections.abc import Iterable, Mapping
from typing import Annotated, Any, NamedTuple

import jax.numpy as jnp

from heli_jax import naming
from heli_jax.dynamics.model import Model
from heli_jax.linear_models.content import Content, Signal
from heli_jax.linear_models.expression import evaluate
from heli_jax.linear_models.matrices import Entry
from heli_jax.naming import Scalar
from heli_jax.pickled import by_value


def model_of(content: Content, matrices: Mapping[str, tuple[Entry, ...]]) -> Model:
    """The Model of a file; its Params have the file's values as defaults.

    Args:
        content: the file without its matrices.
        matrices: the entries of A, B, C, D and E.
    """
    State = _record("State", content.states)
    Outputs = _record("Outputs", content.outputs)
    # The records are made once and used for both the functions and the Model: two classes of the
    # same fields would be different trees to JAX.
    equations = _Equations(dict(matrices), State, Outputs)
    return Model(
        content.name,
        equations.vector_field,
        equations.output,
        _params(content),
        State,
        _record("Inputs", content.inputs),
        Outputs,
        # By this simulations, sweeps and fits take the exact step unless another is asked for.
        linear=True,
        axes=content.axes,
        delays=content.delays,
        positive=tuple(n for n, q in content.parameters.items() if q.positive),
    )


def _record(title: str, signals: Mapping[str, Signal]) -> type:
    """A class with one scalar a signal, in SI."""
    fields = [(n, Annotated[Scalar, one.si, one.meaning]) for n, one in signals.items()]
    # At run time, since what the states are stands in the file; a type checker cannot know them.
    made: Any = NamedTuple(title, fields)  # type: ignore[misc]
    made.__reduce__ = by_value
    return made


def _params(content: Content) -> type:
    fields = {
        n: (Annotated[Scalar, q.constant.unit, q.meaning], q.constant.value)
        for n, q in content.parameters.items()
    }
    # The values are defaults of the record, so that a script makes the Params of the file by
    # calling it without arguments.
    return naming.extended(_Nothing, "Params", fields)


class _Nothing(NamedTuple):
    """No parameter yet."""


class _Equations:
    """E x' = A x + B u and y = C x + D u, entry by entry.

    Compared by identity: the same file is read once, so that its model is one to `jax.jit`.
    """

    def __init__(self, matrices: dict[str, tuple[Entry, ...]], State: type, Outputs: type) -> None:
        self.matrices, self.State, self.Outputs = matrices, State, Outputs

    def vector_field(self, params: Any, state: Any, inputs: Any) -> Any:
        """The derivatives of the states, per second."""
        # Entry by entry: most of a matrix is zero, and a dense product would compute all of it at
        # every step.
        rates = self.rows(("A", "B"), naming.names(self.State), params, state, inputs)
        # Without E the states' derivatives are the rows themselves, and no system has to be solved
        # at every step.
        if self.matrices["E"]:
            return self.solved(params, rates)
        return self.State(**rates)

    def output(self, params: Any, state: Any, inputs: Any) -> Any:
        """The outputs; one without a row is the state of its name."""
        # An output with a row is what the row says, even where a state has its name.
        stated = {entry.row for name in ("C", "D") for entry in self.matrices[name]}
        names = naming.names(self.Outputs)
        rows = self.rows(("C", "D"), (n for n in names if n in stated), params, state, inputs)
        return self.Outputs(**{n: rows[n] if n in rows else getattr(state, n) for n in names})

    def rows(
        self, matrices: tuple[str, str], names: Iterable[str], params: Any, state: Any, inputs: Any
    ) -> dict[str, Any]:
        """The sums of two matrices' rows, the first times the states, the second times the
        inputs.

        Args:
            matrices: their names, as A and B.
        """
        # Zeros made of a state have its type and its batch axis.
        zero = 0.0 * state[0]
        sums = dict.fromkeys(names, zero)
        for matrix, by in zip(matrices, (state, inputs), strict=True):
            for entry in self.matrices[matrix]:
                # Evaluated at every call, since parameters are what a fit differentiates by.
                term = _value(entry, params) * getattr(by, entry.column)
                sums[entry.row] = sums[entry.row] + term
        return sums

    def solved(self, params: Any, right: dict[str, Any]) -> Any:
        """E^-1 times the right-hand side; E is the unit matrix in the rows that it does not
        name."""
        names = naming.names(self.State)
        # A row that the file names is as written there, without a one on its diagonal that nobody
        # asked for.
        stated = {entry.row for entry in self.matrices["E"]}
        zero = 0.0 * right[names[0]]
        E = {
            (i, j): zero + (1.0 if i == j and i not in stated else 0.0)
            for i in names
            for j in names
        }
        for entry in self.matrices["E"]:
            E[entry.row, entry.column] = zero + _value(entry, params)
        matrix = jnp.stack([jnp.stack([E[i, j] for j in names]) for i in names])
        # Solved anew for each set of parameters: a mass may be free, so the inverse cannot be kept.
        return naming.unravel(
            self.State, jnp.linalg.solve(matrix, jnp.stack([right[n] for n in names]))
        )


def _value(entry: Entry, params: Any) -> Any:
    """An entry [SI]."""
    number = evaluate(entry.node, lambda name: getattr(params, name))
    # Entries with parameters are in SI already: their factor is one, and none is traced for them.
    return number if entry.factor == 1.0 else entry.factor * number
