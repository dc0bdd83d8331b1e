"""The keys of fit.json, from the classes that it is made of: what each holds."""

import types
import typing
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Literal, NamedTuple

from heli_jax.naming import texts
from heli_jax.report.fit_format import TOO, FitFile


class Key(NamedTuple):
    """One key of fit.json."""

    path: str
    """in full: `parameters.NAME.sd`"""
    kind: str
    """what stands there, in words"""
    meaning: str
    """empty where the name says it all"""


def fit_keys() -> list[Key]:
    """All keys, each before what stands in it."""
    return list(_walk(FitFile, ""))


def matching(text: str) -> list[Key]:
    """The keys whose path holds a text, in any case; else those whose meaning does.

    Args:
        text: blanks at its ends are left out.
    """
    words, every = text.strip().lower(), fit_keys()
    by_path = [k for k in every if words in k.path.lower()]
    return by_path or [k for k in every if words in k.meaning.lower()]


def undescribed(content: Any, kind: Any = FitFile, path: str = "") -> list[str]:
    """The keys of a fit.json that no class has, and those of the file that are missing.

    Args:
        content: what stands there.
        kind: what may.
        path: of it.
    """
    found: list[str] = []
    for option in _options(kind):
        if _is_section(option) and isinstance(content, Mapping):
            fields = _fields(option)
            found += [f"{path}.{n}" for n in content if n not in fields]
            if option is FitFile:
                found += [f"no {n}" for n in fields if n not in content]
            known = (n for n in content if n in fields)
            found += [x for n in known for x in undescribed(content[n], fields[n], f"{path}.{n}")]
        elif typing.get_origin(option) in _MAPPINGS and isinstance(content, Mapping):
            inner = typing.get_args(option)[1]
            found += [x for n, v in content.items() for x in undescribed(v, inner, f"{path}.{n}")]
        elif (inner := _item(option)) is not None and isinstance(content, Sequence):
            found += [x for v in content for x in undescribed(v, inner, f"{path}[]")]
    return found


_MAPPINGS, _SEQUENCES = (dict, Mapping), (list, tuple, Sequence)


def _walk(section: Any, path: str) -> Iterator[Key]:
    stated = _stated(section)
    for name, kind in _fields(section).items():
        place = f"{path}.{name}" if path else name
        yield Key(place, _kind(kind), stated.get(name, ""))
        # `verdict_before` has the keys of `verdict`: told once.
        if name not in ("verdict_before", "determined_combinations") or path == "verdict":
            for inner, suffix in _within(kind):
                yield from _walk(inner, place + suffix)


def _within(kind: Any) -> Iterator[tuple[Any, str]]:
    """The sections within a field, and what stands between its path and their keys."""
    for option in _options(kind):
        if _is_section(option):
            yield option, ""
        elif typing.get_origin(option) in _MAPPINGS:
            yield from ((s, f".NAME{rest}") for s, rest in _within(typing.get_args(option)[1]))
        elif (inner := _item(option)) is not None:
            yield from ((s, f"[]{rest}") for s, rest in _within(inner))


def _is_section(kind: Any) -> bool:
    return typing.is_typeddict(kind) or (isinstance(kind, type) and hasattr(kind, "_fields"))


def _fields(section: Any) -> dict[str, Any]:
    own = typing.get_type_hints(section)
    too = typing.get_type_hints(TOO[section]) if section in TOO else {}
    return own | too


def _options(kind: Any) -> tuple[Any, ...]:
    if typing.get_origin(kind) in (typing.Union, types.UnionType):
        return typing.get_args(kind)
    return (kind,)


def _item(kind: Any) -> Any:
    """What a list has in it; None of what is no list."""
    if typing.get_origin(kind) not in _SEQUENCES:
        return None
    return typing.get_args(kind)[0]


def _kind(kind: Any) -> str:
    return " or ".join(dict.fromkeys(_one_kind(option) for option in _options(kind)))


_PLAIN = {bool: "true | false", int: "integer", float: "number", str: "text", type(None): "null"}


def _one_kind(kind: Any) -> str:
    if kind in _PLAIN:
        return _PLAIN[kind]
    if _is_section(kind):
        return "section"
    if typing.get_origin(kind) is Literal:
        return " | ".join(map(str, typing.get_args(kind)))
    if typing.get_origin(kind) in _MAPPINGS:
        return f"{_kind(typing.get_args(kind)[1])} by name"
    items = typing.get_args(kind)
    if typing.get_origin(kind) is tuple and Ellipsis not in items:
        return f"[{', '.join(map(_kind, items))}]"
    if (inner := _item(kind)) is not None:
        return f"list of {_kind(inner)}"
    return "list of numbers"  # an array


def _stated(section: type) -> dict[str, str]:
    return texts(section) | (texts(TOO[section]) if section in TOO else {})
