"""Linear models from files: those that ship, by name, and anyone's own, by path."""

from collections import OrderedDict
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

from heli_jax.dynamics.model import Model
from heli_jax.errors import InputError, nearest
from heli_jax.linear_models.content import Content, content_of
from heli_jax.linear_models.equations import model_of
from heli_jax.linear_models.matrices import Entry, matrices_of, not_possible
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
    """Whether a text is a shipped model's name, rather than a path."""
    return name in shipped()


def linear_model(file: str | Path, folder: str | Path = ".") -> LinearModel:
    """A linear model from its file: `linear_model("r50-hover")`, `linear_model("mine.yaml")`.

    The same content gives the same Model again, which `jax.jit` then knows.

    Args:
        file: the path of a YAML file (docs/linear-models.md), or the name of a shipped one.
        folder: where a relative path begins.

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
    """What a file holds, and its name in sentences."""
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
