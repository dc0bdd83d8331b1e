"""Safe YAML reader: plain data, unique keys, and numbers as in YAML 1.2."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from heli_jax.errors import InputError
from heli_jax.regular_file import read_regular

# A configuration has about a hundred keys in five levels. A larger file is a mistake or an attack:
# nested aliases of twelve lines can fill any memory.
_LIMIT_BYTES = 1_000_000
_LIMIT_NODES = 100_000
_LIMIT_DEPTH = 40
EDIT = "EDIT"
"""Placeholder in a generated file for a number that only the user knows. Files that contain it are
refused.
"""
_LONGEST_KEY = 200
"""Longest key that a message can name [characters]."""


# libyaml if available, since the Python parser takes seconds for a large mapping.
_Base: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


class _Loader(_Base):
    """SafeLoader without YAML 1.1's traps: `1e-4` is a number; `on`, `yes` and dates are text."""


# YAML 1.1, which PyYAML follows, reads 1e-4 as text (1.0e-4 is a number), `on` and `no` as booleans
# and 1:30 as ninety. Only its rules for null and << stay; the core schema of YAML 1.2 replaces the
# others.
_Loader.yaml_implicit_resolvers = {
    first: [(tag, rx) for tag, rx in resolvers if tag.rsplit(":", 1)[-1] in ("null", "merge")]
    for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
}
_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:bool", re.compile(r"^(?:true|True|TRUE|false|False|FALSE)$"), list("tTfF")
)
_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:int", re.compile(r"^[-+]?(?:0|[1-9][0-9]{0,17})$"), list("-+0123456789")
)
_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    # Includes integers of more than 18 digits and with leading zeros, which the rule above
    # excludes.
    re.compile(
        r"^(?:[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?"
        r"|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN))$"
    ),
    list("-+0123456789."),
)


def read_mapping(path: str | Path) -> dict[str, Any]:
    """Return the mapping in a YAML file.

    Raises:
        InputError: the file is missing, above 1 MB, not a YAML mapping, has a duplicate key, or is
            too large or too deeply nested (aliases expanded).
    """
    data = read_regular(path, "a YAML file (a configuration or a vehicle)", _LIMIT_BYTES)
    try:
        text = data.decode("utf-8-sig")  # Windows editors may add a byte-order mark
    except UnicodeDecodeError as e:
        raise InputError(f"{path}: not a text file, expected a YAML file") from e
    return parse_mapping(text, str(path))


_KINDS: dict[type, str] = {str: "text", list: "a list", int: "a number", float: "a number"}


def parse_mapping(text: str, where: str) -> dict[str, Any]:
    """Parse a text as `read_mapping` does; `where` replaces the file's name."""
    value = parse_value(text, where)
    if not isinstance(value, dict):
        kind = "nothing" if value is None else _KINDS.get(type(value), "something else")
        # The first row of a log is words, which YAML reads as one text.
        log = "; `heli-jax new LOG` makes a configuration for a log" if "," in text[:200] else ""
        raise InputError(f"{where}: expected keys with values, got {kind}{log}")
    return value


def as_yaml(content: Mapping[str, Any]) -> str:
    """Return plain data as YAML, in its own order."""
    return yaml.safe_dump(dict(content), sort_keys=False, allow_unicode=True)


def parse_value(text: str, where: str) -> Any:
    """Return one value, parsed as after a key, for `--set key=value`."""
    loader = None
    try:
        # Check before the parser, which recurses in C. Many brackets overflow its stack, which no
        # exception handler can catch.
        if _deepest(text) > _LIMIT_DEPTH:
            raise InputError(
                f"{where}: expected at most {_LIMIT_DEPTH} levels, got data nested deeper"
            )
        loader = _Loader(text)
        node = loader.get_single_node()
        if node is None:
            return None
        # Nodes still have line numbers, duplicate keys and unexpanded aliases; values do not.
        _inspect(node, where, 0, set(), [0])
        return loader.construct_document(node)
    except yaml.MarkedYAMLError as e:
        mark = e.problem_mark or e.context_mark
        line = f", line {mark.line + 1}" if mark else ""
        problem = " ".join(str(e.problem or e.context or "broken").split())
        raise InputError(f"{where}{line}: {problem}; expected plain YAML") from e
    # Constructors raise many exception types for a tag with a wrong value (!!int x, !!timestamp
    # 2024-13-45).
    except (
        yaml.YAMLError,
        ValueError,
        LookupError,
        AttributeError,
        TypeError,
        RecursionError,
        OverflowError,
    ) as e:
        if isinstance(e, InputError):
            raise
        text = " ".join(str(e).split())[:120]
        raise InputError(f"{where}: broken YAML ({text})") from e
    finally:
        if loader is not None:
            loader.dispose()


def _deepest(text: str) -> int:
    """Return an upper bound of the nesting, before the recursive parser starts."""
    depth = most = 0
    for character in text:
        if character in "[{":
            depth += 1
            most = max(most, depth)
        elif character in "]}":
            depth -= 1
    # Indents and dashes nest in block style; each width of indent is at most one level.
    indents = {len(line) - len(line.lstrip(" ")) for line in text.splitlines() if line.strip()}
    dashes = max((len(m.group()) // 2 for m in re.finditer(r"(?:- )+", text)), default=0)
    return max(most, len(indents), dashes)


def _inspect(node: Any, where: str, depth: int, above: set[int], count: list[int]) -> None:
    """Refuse duplicate keys, cycles, and aliases that grow too large when expanded."""
    count[0] += 1
    if count[0] > _LIMIT_NODES or depth > _LIMIT_DEPTH or id(node) in above:
        line = node.start_mark.line + 1
        raise InputError(
            f"{where}, line {line}: expected at most {_LIMIT_NODES} values in {_LIMIT_DEPTH} "
            "levels and no alias within itself, got more"
        )
    # Each branch has its own set: an alias within itself is a cycle, but one beside itself is not.
    above = above | {id(node)}
    if isinstance(node, yaml.MappingNode):
        seen = set()
        for key, value in node.value:
            line = key.start_mark.line + 1
            if not isinstance(key, yaml.ScalarNode):
                raise InputError(
                    f"{where}, line {line}: expected a name as key, got a list or a mapping"
                )
            if len(key.value) > _LONGEST_KEY:
                raise InputError(
                    f"{where}, line {line}: expected a key of at most {_LONGEST_KEY} characters, "
                    f"got {len(key.value)}"
                )
            # YAML silently takes the last of two equal keys, but the first may be the intended one.
            if key.value in seen and key.value != "<<":
                raise InputError(
                    f"{where}, line {line}: expected each key once, got {key.value!r} twice"
                )
            seen.add(key.value)
            _inspect(value, where, depth + 1, above, count)
    elif isinstance(node, yaml.SequenceNode):
        for value in node.value:
            _inspect(value, where, depth + 1, above, count)
