"""Keys of a JSON schema, in words."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

# In a mapping the name is the user's: of a signal, a parameter or a state.
_NAME = "NAME"
_MOST_CHOICES = 20


class Key(NamedTuple):
    """One key of a file."""

    path: str
    """Full path: `flights[].signals.inputs.NAME.unit`."""
    kind: str
    """Allowed values, in words."""
    default: str | None
    """Default as in the file; None for a required key."""
    meaning: str
    """Meaning; empty if the name is enough."""


def keys_of(schema: Mapping[str, Any]) -> list[Key]:
    """Return all keys of a schema, sections before their content."""
    return list(_walk(schema, schema, "", ()))


def matching(keys: Sequence[Key], pattern: str) -> list[Key]:
    """Return the keys whose path contains a text, ignoring case; else those whose meaning does."""
    text = pattern.strip().lower()
    by_path = [k for k in keys if text in k.path.lower()]
    # The meaning is searched for readers who do not know the name of a key.
    return by_path or [k for k in keys if text in k.meaning.lower()]


def expected(schema: Mapping[str, Any], place: Sequence[str | int]) -> str:
    """Return the allowed values at a place of a file: `number or list of number`."""
    return _kind(schema, _at(schema, place))


def known_keys(schema: Mapping[str, Any], place: Sequence[str | int]) -> list[str]:
    """Return the keys of the section at a place of a file."""
    options = _resolved(schema, _at(schema, place))
    return [name for option in options for name in option.get("properties", {})]


def _at(schema: Mapping[str, Any], place: Sequence[str | int]) -> Mapping[str, Any]:
    at: Any = schema
    for part in place:
        inner = [
            o.get("items")
            if isinstance(part, int)
            else o.get("properties", {}).get(part, o.get("additionalProperties"))
            for o in _resolved(schema, at)
        ]
        at = next((i for i in inner if isinstance(i, dict)), {})
    return at


def _resolved(schema: Mapping[str, Any], at: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    definitions = schema.get("$defs", {})
    return [definitions.get(o.get("$ref", "").rsplit("/", 1)[-1], o) for o in _options(at)]


def _walk(
    schema: Mapping[str, Any], at: Mapping[str, Any], path: str, above: tuple[str, ...]
) -> Iterator[Key]:
    required = at.get("required", [])
    for name, field in at.get("properties", {}).items():
        place = f"{path}.{name}" if path else name
        default = None if name in required else _written(field.get("default"))
        yield Key(place, _kind(schema, field), default, field.get("description", ""))
        for part, suffix in _within(schema, field):
            # A section may be nested in itself, such as an axis in a list of axes; it is listed
            # once.
            title = part.get("title", "")
            if title not in above:
                yield from _walk(schema, part, place + suffix, (*above, title))


def _within(
    schema: Mapping[str, Any], field: Mapping[str, Any]
) -> Iterator[tuple[Mapping[str, Any], str]]:
    """Yield the sections within a field, and the text between its path and their keys."""
    seen: set[str] = set()
    for option in _options(field):
        if "$ref" in option:
            name = option["$ref"].rsplit("/", 1)[1]
            # A field may take one section or a list of it, with the same keys.
            if name not in seen:
                seen.add(name)
                yield schema["$defs"][name], ""
        elif isinstance(option.get("items"), dict):
            for part, suffix in _within(schema, option["items"]):
                if part.get("title") not in seen:
                    yield part, "[]" + suffix
        elif isinstance(option.get("additionalProperties"), dict):
            for part, suffix in _within(schema, option["additionalProperties"]):
                yield part, f".{_NAME}" + suffix


def _options(field: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    return list(field.get("anyOf", [field]))


def _kind(schema: Mapping[str, Any], field: Mapping[str, Any]) -> str:
    words = (_one_kind(schema, option) for option in _options(field))
    # Null is a valid default, but does not describe the other values.
    return " or ".join(dict.fromkeys(w for w in words if w != "null")) or "null"


def _one_kind(schema: Mapping[str, Any], option: Mapping[str, Any]) -> str:
    if "$ref" in option:
        return "section"
    if "const" in option:
        return str(option["const"])
    if "enum" in option:
        return " | ".join(map(str, option["enum"][:_MOST_CHOICES]))
    match option.get("type"):
        case "array" if "prefixItems" in option:
            return f"[{', '.join(_kind(schema, item) for item in option['prefixItems'])}]"
        case "array":
            return f"list of {_kind(schema, option.get('items', {}))}"
        case "object":
            inner = option.get("additionalProperties")
            return f"{_kind(schema, inner) if isinstance(inner, dict) else 'any'} by name"
        case "boolean":
            return "true | false"
        case "string":
            return "text"
        case "integer" | "number" as kind:
            return kind + _bounds(option)
        case None:
            return "any"
        case kind:
            return str(kind)


def _bounds(option: Mapping[str, Any]) -> str:
    signs = {"exclusiveMinimum": ">", "minimum": ">=", "exclusiveMaximum": "<", "maximum": "<="}
    stated = [f"{sign} {option[key]:g}" for key, sign in signs.items() if key in option]
    return f" {' and '.join(stated)}" if stated else ""


def _written(default: Any) -> str:
    match default:
        case None:
            return "null"
        case bool():
            return str(default).lower()
        case dict() if default:
            return "{" + ", ".join(f"{k}: {_written(v)}" for k, v in default.items()) + "}"
        case list():
            return "[" + ", ".join(map(_written, default)) + "]"
        case float():
            return f"{default:g}"
    return str(default)
