"""Users' own objects by import path, as a configuration names them."""

import contextlib
import importlib
import importlib.util
import os
import re
import sys
import traceback
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from heli_jax.errors import InputError
from heli_jax.regular_file import require_regular

_LARGEST = 10**7
"""Largest source of a module [bytes]."""
_looked_in: list[str] = []
"""Folders of configurations that named a module."""
_PATH = re.compile(r"[A-Za-z_][\w.]*:[A-Za-z_]\w*")


def is_path(text: str) -> bool:
    """True if a text has the form of an import path."""
    return _PATH.fullmatch(text) is not None


def by_path(path: str, where: str, folder: str | Path | None = None) -> Any:
    """Return the object at 'package.module:name', or None if the module has no such name.

    Args:
        where: start of error messages, such as the file and the key.

    Raises:
        InputError: the path is malformed, or the module cannot be imported; `where` begins the
            message.
    """
    if not is_path(path):
        raise InputError(f"{where}: got {path!r:.60}, expected package.module:name")
    module_name, attribute = path.split(":")
    # The folder stays in the path for the module's own imports, also later ones.
    if folder is not None:
        search((str(folder),))
    try:
        _check_size(module_name, where)
        module = importlib.import_module(module_name)
    except (ImportError, SyntaxError) as e:
        raise InputError(f"{where}: cannot import {module_name!r} for {path!r} ({e})") from e
    except InputError:
        raise
    # SystemExit too: sys.exit() in a script would end the command without a message.
    except (Exception, SystemExit) as e:  # importing a module can raise anything
        raise InputError(f"{where}: cannot import {module_name!r} for {path!r}: {_words(e)}") from e
    return getattr(module, attribute, None)


def search(folders: Iterable[str]) -> None:
    """Add folders to Python's module search path.

    They come last: a file beside a configuration must not replace an installed package.
    """
    _looked_in.extend(f for f in folders if f not in _looked_in)
    sys.path.extend(f for f in folders if f not in sys.path)


def searched() -> tuple[str, ...]:
    """Return the folders of configurations that named a module."""
    return tuple(_looked_in)


def ignore_folder_style() -> None:
    """Import Matplotlib elsewhere if the working folder has a matplotlibrc, which it would read."""
    if os.path.lexists("matplotlibrc"):
        with contextlib.chdir(os.sep):
            importlib.import_module("matplotlib")


def environment() -> dict[str, str]:
    """Return an environment in which another Python finds the same modules."""
    return {**os.environ, "PYTHONPATH": os.pathsep.join(p for p in sys.path if p)}


def _check_size(module_name: str, where: str) -> None:
    """Refuse a source larger than any program, since Python would read all of it.

    Python itself refuses devices and pipes as modules.
    """
    parts = module_name.split(".")
    for i in range(1, len(parts) + 1):
        name = ".".join(parts[:i])
        if name in sys.modules:
            continue
        spec = importlib.util.find_spec(name)  # imports the parts before it
        # Compiled modules and packages without a file have no Python source.
        if spec is not None and spec.has_location and str(spec.origin).endswith(".py"):
            try:
                require_regular(str(spec.origin), "a module in Python", _LARGEST)
            except InputError as e:
                raise InputError(f"{where}: {e}") from e


def _words(e: BaseException) -> str:
    """Return the error with its file and line."""
    # The last frame is the line in the user's module, or in code that it calls.
    at = traceback.extract_tb(e.__traceback__)
    line = f"{at[-1].filename}, line {at[-1].lineno}: " if at else ""
    words = " ".join(str(e).split())[:200]
    return f"{line}{type(e).__name__}{f': {words}' if words else ''}"
