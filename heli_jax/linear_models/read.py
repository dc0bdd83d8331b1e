"""Linear models from files: shipped ones by name, users' own by path."""

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
from heli_jax.linear_models.matrices import Entry, impossible_parameters, matrices_of
from heli_jax.naming import Scalar
from heli_jax.pickled import by_value
from heli_jax.regular_file import read_regular
from heli_jax.vehicle import Vehicle, vehicle_from_mapping
from heli_jax.yaml_file import parse_mapping

_LARGEST = 1_000_000
"""Largest file [bytes]."""
_ENDINGS = (".yaml", ".yml")
_REMEMBERED = 256
"""Number of files whose Models are cached."""


class LinearModel(NamedTuple):
    """A linear model read from a file."""

    model: Model
    content: Content
    matrices: dict[str, tuple[Entry, ...]]
    """Entries of A, B, C, D and E."""
    path: str

    def vehicle(self, given: Mapping[str, Any] | None = None, where: str | None = None) -> Vehicle:
        """Return the file's values, with some replaced.

        Args:
            given: content of a vehicle file: numbers or {value, unit, source} by name; a number
                without a unit is in SI.
            where: start of messages; default: the file.

        Raises:
            InputError: an unknown name or an impossible value.
        """
        where = self.path if where is None else where
        # The file's values form a complete vehicle, and given values replace some.
        own = {n: q.constant for n, q in self.content.parameters.items()}
        replaced = vehicle_from_mapping(given or {}, where, self.model.Params).constants
        constants = {**own, **replaced}
        values = {n: c.value for n, c in constants.items()}
        # Checked together, since all values determine whether E is invertible.
        if problem := impossible_parameters(self.content, self.matrices, values):
            raise InputError(f"{where}: {problem}")
        # Read again with all values, so that Params are made in one place with the record's units.
        entries = {n: {"value": c.value, "unit": c.unit} for n, c in constants.items()}
        params = vehicle_from_mapping(entries, where, self.model.Params).params
        return Vehicle(params, constants, where)


def shipped() -> tuple[str, ...]:
    """Return the names of the shipped linear models."""
    folder = resources.files("heli_jax.linear_models").joinpath("files")
    # Taken from the files, so that a new one needs no entry in a list.
    return tuple(sorted(f.name[:-5] for f in folder.iterdir() if f.name.endswith(".yaml")))


def is_shipped(name: str) -> bool:
    """True if a text is the name of a shipped model, not a path."""
    return name in shipped()


def linear_model(file: str | Path, folder: str | Path = ".") -> LinearModel:
    """Read a linear model from its file: `linear_model("r50-hover")`, `linear_model("mine.yaml")`.

    The same content returns the same Model, which `jax.jit` has already compiled.

    Args:
        file: the path of a YAML file (docs/linear-models.md), or the name of a shipped one.

    Raises:
        InputError: the file does not exist or is wrong.
    """
    text, path = _text(file, Path(folder))
    return _read(text, path)


# Keyed by text, not path: an edited file is another model, and two copies are the same to
# `jax.jit`.
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
        # Remove the oldest, since a script that writes files in a loop would otherwise keep every
        # model.
        if len(_models) > _REMEMBERED:
            _models.popitem(last=False)
    return LinearModel(*_models[text], path)


def _text(file: str | Path, folder: Path) -> tuple[str, str]:
    """Return the text of a file, and its name for messages."""
    name = str(file)
    # A shipped name takes precedence over a file of that name; a file is given with its ending.
    if is_shipped(name):
        own = resources.files("heli_jax.linear_models").joinpath("files", f"{name}.yaml")
        return own.read_text(encoding="utf-8"), name
    path = folder / name
    # Without a YAML ending a name was probably meant, so the nearest name helps more than the path.
    if path.suffix not in _ENDINGS and not path.exists():
        raise InputError(f"unknown linear model {name!r:.80}{nearest(name, shipped())}")
    try:
        data = read_regular(path, "a linear model in YAML", _LARGEST)
    except InputError as e:
        if not path.exists() and is_shipped(path.stem):
            raise InputError(f"{e}; did you mean the shipped {path.stem!r}?") from e
        raise
    try:
        # Windows editors may add a byte-order mark, which would belong to the first key.
        return data.decode("utf-8-sig"), str(path)
    except UnicodeDecodeError as e:
        raise InputError(f"{path}: not a text file, expected a linear model in YAML") from e


def model_of(content: Content, matrices: Mapping[str, tuple[Entry, ...]]) -> Model:
    """Return the Model of a file; its Params have the file's values as defaults."""
    State = _record("State", content.states)
    Outputs = _record("Outputs", content.outputs)
    # Functions and Model share the record classes, since JAX treats two equal classes as different
    # trees.
    equations = _Equations(dict(matrices), State, Outputs)
    return Model(
        content.name,
        equations.vector_field,
        equations.output,
        _params(content),
        State,
        _record("Inputs", content.inputs),
        Outputs,
        # Simulations, sweeps and fits then use the exact step by default.
        linear=True,
        axes=content.axes,
        delays=content.delays,
        positive=tuple(n for n, q in content.parameters.items() if q.positive),
    )


def _record(title: str, signals: Mapping[str, Signal]) -> type:
    """Return a class with one scalar per signal, in SI."""
    fields = [(n, Annotated[Scalar, one.si, one.meaning]) for n, one in signals.items()]
    # Made at run time, since the file defines the states; type checkers cannot know them.
    made: Any = NamedTuple(title, fields)  # type: ignore[misc]
    made.__reduce__ = by_value
    return made


def _params(content: Content) -> type:
    fields = {
        n: (Annotated[Scalar, q.constant.unit, q.meaning], q.constant.value)
        for n, q in content.parameters.items()
    }
    # The values are defaults, so that `Params()` gives those of the file.
    return naming.extended(_Nothing, "Params", fields)


class _Nothing(NamedTuple):
    """Parameters of a model without any."""


class _Equations:
    """E x' = A x + B u and y = C x + D u, entry by entry.

    Instances compare by identity. A file is read once, so `jax.jit` sees one model.
    """

    def __init__(self, matrices: dict[str, tuple[Entry, ...]], State: type, Outputs: type) -> None:
        self.matrices, self.State, self.Outputs = matrices, State, Outputs

    def vector_field(self, params: Any, state: Any, inputs: Any) -> Any:
        """Return the derivatives of the states, per second."""
        # By entry, since a dense product would also compute the zeros of a matrix at every step.
        rates = self.rows(("A", "B"), naming.names(self.State), params, state, inputs)
        # Without E the rows are the derivatives, and no system is solved.
        if self.matrices["E"]:
            return self.solved(params, rates)
        return self.State(**rates)

    def output(self, params: Any, state: Any, inputs: Any) -> Any:
        """Return the outputs; one without a row is the state of its name."""
        # A row takes precedence over a state of the same name.
        stated = {entry.row for name in ("C", "D") for entry in self.matrices[name]}
        names = naming.names(self.Outputs)
        rows = self.rows(("C", "D"), (n for n in names if n in stated), params, state, inputs)
        return self.Outputs(**{n: rows[n] if n in rows else getattr(state, n) for n in names})

    def rows(
        self, matrices: tuple[str, str], names: Iterable[str], params: Any, state: Any, inputs: Any
    ) -> dict[str, Any]:
        """Return the rows of two matrices' products with states and inputs, summed."""
        # Zeros computed from a state have its type and batch axis.
        zero = 0.0 * state[0]
        sums = dict.fromkeys(names, zero)
        for matrix, by in zip(matrices, (state, inputs), strict=True):
            for entry in self.matrices[matrix]:
                # Evaluated at every call, since a fit differentiates by the parameters.
                term = _value(entry, params) * getattr(by, entry.column)
                sums[entry.row] = sums[entry.row] + term
        return sums

    def solved(self, params: Any, right: dict[str, Any]) -> Any:
        """Return E^-1 times the right-hand side; rows that E does not name are those of the unit
        matrix.
        """
        names = naming.names(self.State)
        # A row in the file is taken as written, without an implied one on its diagonal.
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
        # Solved in every call, since a mass may be a free parameter.
        return naming.unravel(
            self.State, jnp.linalg.solve(matrix, jnp.stack([right[n] for n in names]))
        )


def _value(entry: Entry, params: Any) -> Any:
    """Return the value of an entry [SI]."""
    number = evaluate(entry.node, lambda name: getattr(params, name))
    # Entries with parameters are in SI, so their factor of one is not traced.
    return number if entry.factor == 1.0 else entry.factor * number
