"""A directory that appears whole or not at all."""

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path

from heli_jax.errors import InputError


def default_directory(config: Path) -> Path:
    """runs/NAME-DATE-TIME for a configuration NAME.yaml."""
    return Path("runs") / f"{config.stem}-{datetime.now():%Y%m%d-%H%M%S}"


def require_free(path: Path) -> None:
    """Refuse a directory that exists, before any work is done.

    Raises:
        InputError: it exists, or its parent cannot hold it.
    """
    if path.exists():
        raise InputError(f"--out {path}: exists already, wanted is a new directory")
    parent = path.absolute().parent
    while not parent.exists():
        parent = parent.parent
    if not parent.is_dir() or not os.access(parent, os.W_OK):
        raise InputError(f"--out {path}: {parent} is no folder that can be written to")


@contextmanager
def whole(path: Path) -> Iterator[Path]:
    """A temporary directory beside `path`, renamed to it at the end, removed where that fails."""
    path.absolute().parent.mkdir(parents=True, exist_ok=True)
    temporary = Path(tempfile.mkdtemp(prefix=f".{path.name}-", dir=path.absolute().parent))
    try:
        yield temporary
        temporary.chmod(0o755)
        os.rename(temporary, path)
    except BaseException:
        shutil.rmtree(temporary, ignore_errors=True)
        raise
