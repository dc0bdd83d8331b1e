"""What a traced function closes over, as bytes: equal content, equal bytes, in any process.

What is not known to be complete is refused: a function of somebody else's module may hang on
anything.
"""

import dataclasses
import functools
import importlib
import types
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np

_PACKAGE = __name__.partition(".")[0]
_FOLDER = str(Path(__file__).parents[1])
_LIBRARIES = (
    *("builtins", "collections", "functools", "math", "operator", "typing"),
    *("numpy", "jax", "jaxlib", "equinox", "diffrax", "lineax", "optimistix"),
)
"""whose objects are known by their name, since the versions are known"""


class Unknown(Exception):
    """Something whose content cannot be told."""


def content(arguments: Any) -> bytes:
    """Arguments as bytes: arrays by type and shape alone, all else by what it is.

    Args:
        arguments: as `equinox.filter_jit` takes them: arrays are traced, the rest is static.

    Raises:
        Unknown: something in it is neither plain data, nor of this package or a library.
    """
    writer = _Writer()
    writer.write(arguments, traced=True)
    return b"\n".join(writer.parts)


class _Writer:
    """Gathers the parts, depth first."""

    def __init__(self) -> None:
        self.parts: list[bytes] = []
        self._seen: dict[int, int] = {}
        # What has been seen is held, so that no other object gets its address.
        self._held: list[Any] = []

    def say(self, *words: object) -> None:
        self.parts.append(" ".join(map(str, words)).encode())

    def write(self, thing: Any, *, traced: bool) -> None:
        """`traced`: an array here is an argument of the traced function, and no constant of it."""
        if thing is None or isinstance(thing, bool | int | float | complex | str | bytes):
            if type(thing).__module__ != "builtins":
                raise Unknown(type(thing))
            self.say(type(thing).__name__, repr(thing))
        elif isinstance(thing, np.ndarray | np.generic | jax.Array):
            self._array(thing, traced=traced)
        elif id(thing) in self._seen:
            self.say("again", self._seen[id(thing)])
        else:
            self._seen[id(thing)] = len(self._seen)
            self._held.append(thing)
            self._compound(thing, traced=traced)

    def _array(self, thing: Any, *, traced: bool) -> None:
        if traced:
            self.say("traced", thing.dtype, thing.shape)
        else:
            values = np.asarray(thing)
            if values.dtype.hasobject:
                raise Unknown("an array of objects")
            self.say("array", values.dtype, values.shape)
            self.parts.append(values.tobytes())

    def _compound(self, thing: Any, *, traced: bool) -> None:
        if isinstance(thing, tuple | list | dict | frozenset | set):
            self._container(thing, traced=traced)
        elif isinstance(thing, type):
            self._class(thing)
        elif isinstance(thing, types.MethodType):
            self.say("method", thing.__func__.__qualname__)
            self.write(thing.__self__, traced=False)
            self.write(thing.__func__, traced=False)
        elif isinstance(thing, functools.partial):
            self.say("partial")
            self.write((thing.func, thing.args, thing.keywords), traced=False)
        elif _by_name(thing):
            self.say("named", thing.__module__, thing.__qualname__)
        elif isinstance(thing, types.FunctionType):
            self._function(thing)
        elif isinstance(getattr(thing, "__wrapped__", None), types.FunctionType):
            # As functools.cache makes it, which changes nothing of what the function is.
            if type(thing) is not type(_a_cached_function):
                raise Unknown(type(thing))
            self._function(thing.__wrapped__)
        else:
            self._object(thing, traced=traced)

    def _container(self, thing: Any, *, traced: bool) -> None:
        if isinstance(thing, frozenset | set):
            # Their order is by hashes, which differ from process to process.
            if not all(isinstance(v, str | int) for v in thing):
                raise Unknown("a set of objects")
            thing = sorted(thing, key=repr)
        named = isinstance(thing, tuple) and hasattr(thing, "_fields")
        if not named and type(thing) not in (tuple, list, dict):
            raise Unknown(type(thing))
        self.say(type(thing).__name__, len(thing))
        if named:
            self.write(type(thing), traced=False)
        if isinstance(thing, dict):
            for key in thing:
                self.write(key, traced=False)
            thing = thing.values()
        for value in thing:
            self.write(value, traced=traced)

    def _class(self, thing: type) -> None:
        if _by_name(thing):
            self.say("class", thing.__module__, thing.__qualname__)
            return
        # A record made at run time (`naming.extended`) is its fields.
        if thing.__bases__ != (tuple,) or not hasattr(thing, "_fields"):
            raise Unknown(thing)
        trusted = (*_LIBRARIES, _PACKAGE, None, f"namedtuple_{thing.__name__}")
        for name, value in vars(thing).items():
            code = getattr(value, "__func__", value)
            if isinstance(value, property) or (
                isinstance(code, types.FunctionType) and _top(code.__module__) not in trusted
            ):
                raise Unknown(f"{thing}.{name}")
        self.say("record", thing.__name__, *thing._fields)  # pyright: ignore
        self.write(thing._field_defaults, traced=False)  # pyright: ignore

    def _function(self, thing: types.FunctionType) -> None:
        code = thing.__code__
        if _top(thing.__module__) != _PACKAGE or not code.co_filename.startswith(_FOLDER):
            raise Unknown(thing)
        # The package's files are a part of the key: name and line say which code it is.
        self.say("function", thing.__module__, thing.__qualname__, code.co_firstlineno)
        cells = tuple(c.cell_contents for c in thing.__closure__ or ())
        self.write((thing.__defaults__, thing.__kwdefaults__, cells), traced=False)

    def _object(self, thing: Any, *, traced: bool) -> None:
        made = type(thing)
        if _top(made.__module__) != _PACKAGE or not _by_name(made):
            raise Unknown(made)
        if not hasattr(thing, "__dict__"):
            raise Unknown(made)
        self.say("object", made.__module__, made.__qualname__)
        static = _static(thing)
        # Without what `functools.cached_property` has put there, which comes of the rest.
        for name, value in sorted(vars(thing).items()):
            if not isinstance(getattr(made, name, None), functools.cached_property):
                self.say("field", name)
                self.write(value, traced=traced and name not in static)


@functools.cache
def _a_cached_function() -> None: ...


def _top(module: str | None) -> str | None:
    return module.partition(".")[0] if module else None


def _static(thing: Any) -> frozenset[str]:
    """Fields of which JAX traces nothing: of an object that is no pytree, all."""
    if not isinstance(thing, eqx.Module):
        return frozenset(vars(thing))
    fields = dataclasses.fields(thing)  # pyright: ignore
    return frozenset(f.name for f in fields if f.metadata.get("static", False))


def _by_name(thing: Any) -> bool:
    """Whether a module of the package or a library has it under its own name."""
    module, name = getattr(thing, "__module__", None), getattr(thing, "__qualname__", None)
    if not isinstance(module, str) or not isinstance(name, str):
        return False
    if _top(module) not in (*_LIBRARIES, _PACKAGE):
        return False
    return named(module, name) is thing


def named(module: str, name: str) -> Any:
    """What a module has under a qualified name; None where it has nothing."""
    try:
        value: Any = importlib.import_module(module)
        for part in name.split("."):
            value = getattr(value, part)
    except (ImportError, AttributeError):
        return None
    return value
