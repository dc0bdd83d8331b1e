"""Linear models from files: those that ship, by name, and anyone's own, by path."""

from collections import OrderedDict
from collections.abc import Iterable, Mapping
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import jax.numpy as jnp

from heli_jax import naming
from heli_jax.dynamics.model import Model
from heli_jax.errors import InputError, nearest
from heli_jax.linear_models.content import Content, Signal, content_of
from heli_jax.linear_models.expression import evaluate
from heli_jax.linear_models.matrices import Entry, matrices_of, not_possible
from heli_jax.naming import Scalar
from heli_jax.pickled import by_value
from heli_jax.regular_file import read_regular
from heli_jax.vehicle import Vehicle, vehicle_from_mapping
from heli_jax.yaml_file import parse_mapping

_LARGEST = 1_000_000
"""bytes of a file"""
_ENDINGS = (".yaml", ".yml")
_REMEMBERED = 256
"""files that stay one Model each"""


class LinearModel(NamedTuple):
    """A file of a linear model, read."""

    model: Model
    content: Content
    matrices: dict[str, tuple[Entry, ...]]
    """the entries of A, B, C, D and E"""
    path: str

    def vehicle(self, given: Mapping[str, Any] | None = None, where: str | None = None) -> Vehicle:
        """The file's own values, some of them replaced.

        Args:
            given: what a vehicle file holds: numbers or {value, unit, source} by name; a number
                without a unit is in SI.
            where: what a sentence about it begins with; the file unless given.

        Raises:
            InputError: an unknown name, or a value that cannot be.
        """
        where = self.path if where is None else where
        # The file's values are a vehicle by themselves, and what is given replaces some of them.
        own = {n: q.constant for n, q in self.content.parameters.items()}
        replaced = vehicle_from_mapping(given or {}, where, self.model.Params).constants
        constants = {**own, **replaced}
        values = {n: c.value for n, c in constants.items()}
        # Together and not one by one: whether E has an inverse depends on all of them.
        if problem := not_possible(self.content, self.matrices, values):
            raise InputError(f"{where}: {problem}")
        # Read a second time with all values at hand, so that the Params are made in one place with
        # the units of the record.
        entries = {n: {"value": c.value, "unit": c.unit} for n, c in constants.items()}
        params = vehicle_from_mapping(entries, where, self.model.Params).params
        return Vehicle(params, constants, where)


def shipped() -> tuple[str, ...]:
    """The names of the linear models that ship."""
    folder = resources.files("heli_jax.linear_models").joinpath("files")
    # By the files that are there: a new one ships without a list that has to name it.
    return tuple(sorted(f.name[:-5] for f in folder.iterdir() if f.name.endswith(".yaml")))


def is_shipped(name: str) -> bool:
    """True if a text is the name of a shipped model, and no path."""
    return name in shipped()


def linear_model(file: str | Path, folder: str | Path = ".") -> LinearModel:
    """A linear model from its file: `linear_model("r50-hover")`, `linear_model("mine.yaml")`.

    The same content gives the same Model again, which `jax.jit` then knows.

    Args:
        file: the path of a YAML file (docs/linear-models.md), or the name of a shipped one.

    Raises:
        InputError: there is none, or something in it is wrong.
    """
    text, path = _text(file, Path(folder))
    return _read(text, path)


# By the text and not by the path: a file that was edited is another model, and two copies of one
# are the same to `jax.jit`.
_models: OrderedDict[str, tuple[Model, Content, dict[str, tuple[Entry, ...]]]] = OrderedDict()


def _read(text: str, path: str) -> LinearModel:
    if text not in _models:
        mapping = parse_mapping(text, path)
        try:
            content = content_of(mapping)
            matrices = matrices_of(mapping, content)
        except InputError as e:
            raise InputError(f"{path}: {e}") from e
        _models[text] = (model_of(content, matrices), content, matrices)
        # The oldest goes: a script that writes files in a loop would else keep every model.
        if len(_models) > _REMEMBERED:
            _models.popitem(last=False)
    return LinearModel(*_models[text], path)


def _text(file: str | Path, folder: Path) -> tuple[str, str]:
    """Return the text of a file, and its name in sentences."""
    name = str(file)
    # A shipped name goes before a file of the same name; a file is always meant by one with its
    # ending.
    if is_shipped(name):
        own = resources.files("heli_jax.linear_models").joinpath("files", f"{name}.yaml")
        return own.read_text(encoding="utf-8"), name
    path = folder / name
    # What has no ending of YAML was meant as a name, so the nearest name helps more than the path
    # that was tried.
    if path.suffix not in _ENDINGS and not path.exists():
        raise InputError(f"unknown linear model {name!r:.80}{nearest(name, shipped())}")
    try:
        data = read_regular(path, "a linear model in YAML", _LARGEST)
    except InputError as e:
        if not path.exists() and is_shipped(path.stem):
            raise InputError(f"{e}; did you mean the shipped {path.stem!r}?") from e
        raise
    try:
        # Editors of Windows begin a file with a mark that would belong to the first key.
        return data.decode("utf-8-sig"), str(path)
    except UnicodeDecodeError as e:
        raise InputError(f"{path}: is not text, expected a linear model in YAML") from e


def model_of(content: Content, matrices: Mapping[str, tuple[Entry, ...]]) -> Model:
    """The Model of a file; its Params have the file's values as defaults."""
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
    """Parameters of a model that has none."""


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
