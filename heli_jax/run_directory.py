"""Directories and files that appear complete or not at all."""

import contextlib
import itertools
import os
import secrets
import shutil
import tempfile
import warnings
from collections.abc import Iterator
from datetime import datetime
from pathlib import Path

from heli_jax.errors import InputError
from heli_jax.regular_file import obstacle_at

# Paths are added before they are created, so that no interrupt can leave one behind.
_unfinished: set[Path] = set()


def default_directory(config: Path) -> Path:
    """Return runs/NAME-DATE-TIME for a configuration NAME.yaml."""
    return Path("runs") / f"{config.stem}-{datetime.now():%Y%m%d-%H%M%S}"


def free_directory(path: Path) -> Path:
    """Return `path`, or with a warning the first of path-2, path-3, ... that does not exist.

    For functions, since a notebook's cell may run twice. Commands refuse existing paths
    (`require_free`).

    Raises:
        InputError: the parent cannot hold a new directory.
    """
    free = path
    for number in itertools.count(2):
        if not os.path.lexists(free):
            break
        free = path.with_name(f"{path.name}-{number}")
    if free != path:
        warnings.warn(f"{path} exists already: this run goes to {free}", stacklevel=3)
    require_free(free)
    return free


def require_free(path: Path, otherwise: str = "") -> None:
    """Refuse a directory that exists, before any work is done.

    Raises:
        InputError: it exists, or its parent cannot hold it.
    """
    if os.path.lexists(path):  # a dangling link is also refused
        raise InputError(f"--out {path}: exists already, expected a new directory{otherwise}")
    # Find the nearest existing folder; those below it are made later.
    parent = path.absolute().parent
    while not parent.exists():
        parent = parent.parent
    try:
        # Try it, since permissions do not reveal file systems that are read-only or full.
        os.rmdir(tempfile.mkdtemp(prefix=f".{path.name}-", dir=parent))
    except OSError as e:
        raise InputError(f"--out {path}: expected a writable folder, got {parent}") from e


def is_new(path: Path, resume: bool) -> bool:
    """True if the directory of work with `--resume` is still to be made.

    Raises:
        InputError: it exists, and `resume` is False.
    """
    # An empty folder counts as new: a cluster job killed at its start restarts with the same
    # command.
    if resume and path.exists():
        return path.is_dir() and not any(path.iterdir())
    require_free(path, ", or --resume")
    return True


def require_writable(path: Path) -> None:
    """Refuse a directory in which no files can be made, before minutes of work.

    Raises:
        InputError: it is no directory, or is not writable.
    """
    if not path.is_dir() or not os.access(path, os.W_OK | os.X_OK):
        raise InputError(f"--out {path}: expected a writable directory")


@contextlib.contextmanager
def whole(path: Path, *, replaces: bool = False) -> Iterator[Path]:
    """Yield a temporary directory beside `path`, renamed to it at the end, or removed on failure.

    Args:
        replaces: True if it takes the place of an earlier directory of this process.

    Raises:
        InputError: it cannot be written.
    """
    # A rename is atomic only within one file system, so /tmp does not serve.
    temporary = path.absolute().parent / f".{path.name}-{secrets.token_hex(4)}"
    _unfinished.add(temporary)
    try:
        path.absolute().parent.mkdir(parents=True, exist_ok=True)
        temporary.mkdir(mode=0o700)
        yield temporary
        temporary.chmod(0o755)  # so far only its owner had access
        if replaces:
            # From here on an interrupt leaves the new directory, which is complete.
            _unfinished.discard(temporary)
            shutil.rmtree(path, ignore_errors=True)
        # rename replaces an empty directory, and nothing else.
        os.rename(temporary, path)
    except OSError as e:
        raise InputError(f"--out {path}: cannot be written ({e.strerror or e})") from e
    finally:
        # Clean up after failures and interrupts.
        shutil.rmtree(temporary, ignore_errors=True)
        _unfinished.discard(temporary)


def require_place(path: Path, where: str) -> None:
    """Refuse a path that cannot hold a file, before any work is done.

    Raises:
        InputError: the path is a folder, a pipe or a device.
    """
    obstacle = obstacle_at(path)
    if obstacle is not None:
        raise InputError(f"{where}: is {obstacle}, expected a new name or that of a regular file")


@contextlib.contextmanager
def whole_file(path: Path, where: str) -> Iterator[Path]:
    """Yield a temporary path beside `path`, which is renamed to `path` at the end.

    Raises:
        InputError: the place cannot be written to, or is a folder, a pipe or a device.
    """
    require_place(path, where)
    # Keep the suffix, by which writers choose the format.
    temporary = path.with_name(f".{path.stem}.{secrets.token_hex(4)}.part{path.suffix}")
    temporary = temporary.absolute()
    _unfinished.add(temporary)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        # Create the file here, so that an existing pipe or link of that name is not written to.
        os.close(os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
        yield temporary
        temporary.replace(path)
    except OSError as e:
        raise InputError(f"{where}: cannot be written ({e.strerror or e})") from e
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink()
        _unfinished.discard(temporary)


def remove_unfinished() -> None:
    """Remove unfinished files and directories before the process ends without unwinding."""
    for temporary in tuple(_unfinished):
        shutil.rmtree(temporary, ignore_errors=True)
        with contextlib.suppress(OSError):
            temporary.unlink()
