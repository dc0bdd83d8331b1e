"""`heli-jax keys`: what may stand in a configuration, in the terminal and as a JSON schema; what
stands in fit.json."""

import json
import shlex
import shutil
import textwrap
from pathlib import Path

from heli_jax.config.keys import Key, json_schema, keys, matching
from heli_jax.errors import InputError
from heli_jax.run_directory import whole_file

_WIDEST = 100
"""columns of text: longer lines are hard to read"""


def print_keys(pattern: str | None) -> None:
    """The keys of a configuration with what may stand there, its default and its meaning.

    Args:
        pattern: a text in the keys to be shown; all unless given.

    Raises:
        InputError: no key holds it.
    """
    matches = keys() if pattern is None else matching(pattern)
    if not matches:
        from heli_jax.report import document

        hint = f"; fit.json has it: heli-jax keys --fit {shlex.quote(pattern or '')}"
        raise InputError(
            f"keys: expected a text that some key or its meaning holds, got {pattern}"
            f"{hint if document.matching(pattern or '') else ''}"
        )
    width = min(shutil.get_terminal_size().columns, _WIDEST)
    for key in matches:
        print(*_lines(key, width), sep="\n")


def as_json(pattern: str | None) -> str:
    """The keys as a list for other programs.

    Args:
        pattern: as `print_keys`.
    """
    matches = keys() if pattern is None else matching(pattern)
    return json.dumps([key._asdict() for key in matches], indent=1)


def print_fit_keys(pattern: str | None, *, as_json: bool) -> None:
    """The keys of fit.json with what stands there.

    Args:
        pattern: as `print_keys`.
        as_json: as a list for other programs.

    Raises:
        InputError: no key holds it.
    """
    from heli_jax.report import document

    matches = document.fit_keys() if pattern is None else document.matching(pattern)
    if as_json:
        print(json.dumps([key._asdict() for key in matches], indent=1))
        return
    if not matches:
        raise InputError(
            f"keys --fit: expected a text that some key or its meaning holds, got {pattern}"
        )
    width = min(shutil.get_terminal_size().columns, _WIDEST)
    for key in matches:
        print(*_wrapped(f"{key.path}: {key.kind}", key.meaning, width), sep="\n")


def write_schema(path: Path) -> None:
    """The JSON schema in a file, which editors are told of.

    Args:
        path: where; what stands there is replaced.

    Raises:
        InputError: it cannot be written there.
    """
    with whole_file(path, f"--schema {path}") as temporary:
        temporary.write_text(json.dumps(json_schema(), indent=1) + "\n", encoding="utf-8")


def _lines(key: Key, width: int) -> list[str]:
    default = "has to be there" if key.default is None else f"default {key.default}"
    # A default of null says that the key may be left out, and no more.
    default = "optional" if key.default == "null" else default
    return _wrapped(f"{key.path}: {key.kind}; {default}", key.meaning, width)


def _wrapped(head: str, meaning: str, width: int) -> list[str]:
    indent = "    "
    lines = textwrap.wrap(head, width, subsequent_indent=indent, break_on_hyphens=False)
    return lines + textwrap.wrap(
        meaning, width, initial_indent=indent, subsequent_indent=indent, break_on_hyphens=False
    )
