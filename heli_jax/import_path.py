"""Anyone's own objects by import path, as a configuration names them."""

import importlib
import re
import sys
from pathlib import Path
from typing import Any

from heli_jax.errors import InputError

_PATH = re.compile(r"[A-Za-z_][\w.]*:[A-Za-z_]\w*")


def is_path(text: str) -> bool:
    """Whether a text has the form of an import path."""
    return _PATH.fullmatch(text) is not None


def by_path(path: str, where: str, folder: str | Path | None = None) -> Any:
    """The object at 'package.module:name', or None where the module has nothing of that name.

    The module may lie in `folder`, as beside the configuration that names it.

    Raises:
        InputError: it is no such path, or the module cannot be imported; `where` begins the
            sentence.
    """
    if not is_path(path):
        raise InputError(f"{where}: found {path!r:.60}, wanted is package.module:name")
    module_name, attribute = path.split(":")
    if folder is not None and str(folder) not in sys.path:
        sys.path.insert(0, str(folder))
    try:
        module = importlib.import_module(module_name)
    except (ImportError, SyntaxError) as e:
        raise InputError(f"{where}: cannot import {module_name!r} for {path!r} ({e})") from e
    return getattr(module, attribute, None)
