"""Anyone's own objects by import path, as a configuration names them."""

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
"""bytes of a module's source"""
_looked_in: list[str] = []
"""folders of configurations that named a module"""
_PATH = re.compile(r"[A-Za-z_][\w.]*:[A-Za-z_]\w*")


def is_path(text: str) -> bool:
    """True if a text has the form of an import path."""
    return _PATH.fullmatch(text) is not None


def by_path(path: str, where: str, folder: str | Path | None = None) -> Any:
    """The object at 'package.module:name', or None where the module has nothing of that name.

    Args:
        where: what errors begin with, such as the file and the key.

    Raises:
        InputError: it is no such path, or the module cannot be imported, whatever goes wrong in
            it; `where` begins the sentence.
    """
    if not is_path(path):
        raise InputError(f"{where}: got {path!r:.60}, expected package.module:name")
    module_name, attribute = path.split(":")
    # Left there: the module's own imports, also later ones, find its folder.
    if folder is not None:
        search((str(folder),))
    try:
        _check_size(module_name, where)
        module = importlib.import_module(module_name)
    except (ImportError, SyntaxError) as e:
        raise InputError(f"{where}: cannot import {module_name!r} for {path!r} ({e})") from e
    except InputError:
        raise
    # SystemExit too: a script that ends in sys.exit() would end the command without a word.
    except (Exception, SystemExit) as e:  # whatever the module does while it is imported
        raise InputError(f"{where}: cannot import {module_name!r} for {path!r}: {_words(e)}") from e
    return getattr(module, attribute, None)


def search(folders: Iterable[str]) -> None:
    """Look for modules in these folders as well, from now on.

    They come last in the path: a file beside a configuration must not stand for an installed
    package.
    """
    _looked_in.extend(f for f in folders if f not in _looked_in)
    sys.path.extend(f for f in folders if f not in sys.path)


def searched() -> tuple[str, ...]:
    """Folders in which modules of configurations were looked for; none where none was named."""
    return tuple(_looked_in)


def pass_over_style_of_folder() -> None:
    """Import Matplotlib now where the working folder holds a file that it would read as its
    settings, whatever is in it."""
    if os.path.lexists("matplotlibrc"):
        with contextlib.chdir(os.sep):
            importlib.import_module("matplotlib")


def environment() -> dict[str, str]:
    """The environment in which another Python finds the modules that this one does."""
    return {**os.environ, "PYTHONPATH": os.pathsep.join(p for p in sys.path if p)}


def _check_size(module_name: str, where: str) -> None:
    """Refuse a source larger than any program: Python would read it as a whole.

    Devices and pipes are no modules to Python, which looks at the kind of file itself.
    """
    parts = module_name.split(".")
    for i in range(1, len(parts) + 1):
        name = ".".join(parts[:i])
        if name in sys.modules:
            continue
        spec = importlib.util.find_spec(name)  # of a part: it imports those before it
        # Compiled modules and packages without a file have no source that Python would read.
        if spec is not None and spec.has_location and str(spec.origin).endswith(".py"):
            try:
                require_regular(str(spec.origin), "a module in Python", _LARGEST)
            except InputError as e:
                raise InputError(f"{where}: {e}") from e


def _words(e: BaseException) -> str:
    """Return the error, with the line and file where it arose."""
    # The last frame: the line in the user's module, or in what it called with wrong arguments.
    at = traceback.extract_tb(e.__traceback__)
    line = f"{at[-1].filename}, line {at[-1].lineno}: " if at else ""
    said = " ".join(str(e).split())[:200]
    return f"{line}{type(e).__name__}{f': {said}' if said else ''}"
