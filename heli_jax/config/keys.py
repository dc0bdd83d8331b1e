"""Keys of a configuration, from the classes that check them: for editors and readers."""

from typing import Any

from heli_jax.config.schema import Config
from heli_jax.schema_keys import Key, keys_of

_URL = "https://json-schema.org/draft/2020-12/schema"


def json_schema() -> dict[str, Any]:
    """Return the JSON schema of a configuration, by which editors complete and check YAML."""
    schema = _plain(Config.model_json_schema())
    return {"$schema": _URL, **schema, "title": "heli_jax configuration"}


def keys() -> list[Key]:
    """Return all keys, sections before their content."""
    return keys_of(json_schema())


def _plain(value: Any) -> Any:
    """Return the schema without NaN defaults, which JSON lacks; each description on one line."""
    if isinstance(value, dict):
        return {k: _plain(v) for k, v in value.items() if not (k == "default" and v != v)}
    if isinstance(value, str):
        return " ".join(value.split())
    return [_plain(v) for v in value] if isinstance(value, list) else value
