"""Directories and files that appear whole or not at all."""

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
from heli_jax.regular_file import in_the_way

# Noted before they are made, so that there is no moment at which an interrupt would leave one.
_unfinished: set[Path] = set()
_finished: list[Path] = []


def default_directory(config: Path) -> Path:
    """runs/NAME-DATE-TIME for a configuration NAME.yaml."""
    return Path("runs") / f"{config.stem}-{datetime.now():%Y%m%d-%H%M%S}"


def free_directory(path: Path) -> Path:
    """`path`, or with a warning the first of path-2, path-3, ... that does not exist.

    For functions: a notebook's cell runs twice. Commands refuse what exists (`require_free`).

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
    if os.path.lexists(path):  # a link to nothing is in the way too
        raise InputError(f"--out {path}: exists already, expected a new directory{otherwise}")
    # The nearest that exists: those between are made when the directory is.
    parent = path.absolute().parent
    while not parent.exists():
        parent = parent.parent
    try:
        # By trying: permissions do not tell of file systems that hold nothing new.
        os.rmdir(tempfile.mkdtemp(prefix=f".{path.name}-", dir=parent))
    except OSError as e:
        raise InputError(
            f"--out {path}: expected a place in a folder that can be written to, got {parent}"
        ) from e


def is_new(path: Path, resume: bool) -> bool:
    """True if work in a directory that `--resume` goes on with begins with making it.

    Raises:
        InputError: it exists, and is not to be gone on with.
    """
    # An empty folder counts as none: a job on a cluster, killed before it began, is started and
    # restarted by the same command.
    if resume and path.exists():
        return path.is_dir() and not any(path.iterdir())
    require_free(path, ", or --resume")
    return True


def require_writable(path: Path) -> None:
    """Refuse a directory in which no files can be made, before minutes of work.

    Raises:
        InputError: it is none, or may not be written to.
    """
    if not path.is_dir() or not os.access(path, os.W_OK | os.X_OK):
        raise InputError(f"--out {path}: expected a directory that can be written to")


@contextlib.contextmanager
def whole(path: Path, *, replaces: bool = False, or_beside: bool = False) -> Iterator[Path]:
    """A temporary directory beside `path`, renamed to it at the end, removed where that fails.

    Args:
        or_beside: whether it becomes `path-2` and so on where another process has made `path`
            meanwhile; `written` says which.

    Raises:
        InputError: it cannot be written.
    """
    # Beside it and not in /tmp: a rename is atomic within one file system only.
    temporary = path.absolute().parent / f".{path.name}-{secrets.token_hex(4)}"
    _unfinished.add(temporary)
    try:
        path.absolute().parent.mkdir(parents=True, exist_ok=True)
        temporary.mkdir(mode=0o700)
        yield temporary
        temporary.chmod(0o755)  # until now for its owner alone
        if replaces:
            _give_way(path)
        _finished.append(_renamed(temporary, path, or_beside))
    except OSError as e:
        raise InputError(f"--out {path}: cannot be written ({e.strerror or e})") from e
    finally:
        # Where it failed, by an interrupt too.
        shutil.rmtree(temporary, ignore_errors=True)
        _unfinished.discard(temporary)


def _renamed(temporary: Path, path: Path, or_beside: bool) -> Path:
    """Give the directory its name, or where another process has made it the next; returns it."""
    beside = (path.with_name(f"{path.name}-{number}") for number in itertools.count(2))
    place = path
    while or_beside and os.path.lexists(place):
        place = next(beside)
    # It takes the place of an empty directory, and of nothing else.
    os.rename(temporary, place)
    return place


def _give_way(path: Path) -> None:
    """Take away a directory of this process."""
    aside = path.absolute().parent / f".{path.name}-{secrets.token_hex(4)}"
    _unfinished.add(aside)
    os.rename(path, aside)
    shutil.rmtree(aside, ignore_errors=True)
    _unfinished.discard(aside)


def require_place(path: Path, where: str) -> None:
    """Refuse a place in which no file can be put, before any work is done.

    Raises:
        InputError: a folder, a pipe or a device stands there.
    """
    obstacle = in_the_way(path)
    if obstacle is not None:
        raise InputError(f"{where}: is {obstacle}, expected a new name or that of a regular file")


@contextlib.contextmanager
def whole_file(path: Path, where: str) -> Iterator[Path]:
    """A place beside `path` to write to, which becomes `path` at the end.

    Raises:
        InputError: the place cannot be written to, or is a folder, a pipe or a device.
    """
    require_place(path, where)
    # With the ending of the file itself, by which writers choose the format.
    temporary = path.with_name(f".{path.stem}.{secrets.token_hex(4)}.part{path.suffix}")
    temporary = temporary.absolute()
    _unfinished.add(temporary)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        # Made here, so that a pipe or a link that has the name already is not written to.
        os.close(os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
        yield temporary
        temporary.replace(path)
        _finished.append(path)
    except OSError as e:
        raise InputError(f"{where}: cannot be written ({e.strerror or e})") from e
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink()
        _unfinished.discard(temporary)


def remove_unfinished() -> None:
    """Remove what is being written, before the process ends without unwinding."""
    for temporary in tuple(_unfinished):
        shutil.rmtree(temporary, ignore_errors=True)
        with contextlib.suppress(OSError):
            temporary.unlink()


def written() -> tuple[Path, ...]:
    """Return the directories that this process has completed."""
    return tuple(_finished)
