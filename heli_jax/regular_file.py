"""Reading of user files: regular files of limited size only.

A device such as /dev/zero has no end, and a named pipe waits for a writer. A sparse file of 1 TB
takes no disk space but all memory. Kind and size are therefore checked before opening, and again on
the open file, since the name may then refer to another file.
"""

import contextlib
import errno
import os
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from heli_jax.errors import InputError

_KINDS = (
    (stat.S_ISDIR, "a folder"),
    (stat.S_ISFIFO, "a pipe"),
    (stat.S_ISSOCK, "a socket"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
)
# Opening must not wait for the other end of a pipe, nor make a terminal this process's own.
_FLAGS = (
    os.O_RDONLY
    | getattr(os, "O_NONBLOCK", 0)
    | getattr(os, "O_NOCTTY", 0)
    | getattr(os, "O_CLOEXEC", 0)
    | getattr(os, "O_BINARY", 0)
)
_PIECE = 1 << 20


def size_words(size: int) -> str:
    """Return a size in bytes as text: `1 MB`, `16 GB`."""
    # Powers of ten, as for disks and the stated limits.
    for unit, scale in (("TB", 10**12), ("GB", 10**9), ("MB", 10**6), ("kB", 10**3)):
        if size >= scale:
            return f"{size / scale:.3g} {unit}"
    return f"{size} bytes"


def require_regular(path: str | Path, what: str, at_most: int) -> int:
    """Return the size of a regular file [bytes] without opening it.

    Args:
        what: expected content, with its article: `a log in CSV`.
        at_most: the largest allowed size [bytes].

    Raises:
        InputError: the file does not exist, is no regular file, or is too large.
    """
    # os raises ValueError for a path with a null character.
    try:
        return _checked(os.stat(path), path, what, at_most)
    except (OSError, ValueError) as e:
        raise _refusal(e, path, what) from e


@contextlib.contextmanager
def open_regular(path: str | Path, what: str, at_most: int) -> Iterator[BinaryIO]:
    """Open a regular file for reading; arguments and errors as for `require_regular`.

    It also raises InputError if the file cannot be opened or read.
    """
    # Check before opening, which has an effect on some devices (a tape rewinds, a watchdog starts).
    require_regular(path, what, at_most)
    try:
        descriptor = os.open(path, _FLAGS)
        with os.fdopen(descriptor, "rb") as file:
            _checked(os.fstat(descriptor), path, what, at_most)
            yield file
    except OSError as e:
        raise _refusal(e, path, what) from e


def read_regular(path: str | Path, what: str, at_most: int) -> bytes:
    """Return the whole content of a regular file; arguments and errors as for `open_regular`."""
    # A file of /proc reports size zero but has content, so the bytes read are counted too.
    pieces, size = [], 0
    with open_regular(path, what, at_most) as file:
        # Read the stated size in one piece, since joining pieces doubles the memory.
        stated = os.fstat(file.fileno()).st_size
        while piece := file.read(max(stated - size, 0) + _PIECE):
            size += len(piece)
            if size > at_most:
                raise _too_large(path, what, at_most)
            pieces.append(piece)
    return pieces[0] if len(pieces) == 1 else b"".join(pieces)


def obstacle_at(path: str | Path) -> str | None:
    """Return the reason why a file cannot be written at a path, in words; None if it can."""
    try:
        mode = os.stat(path).st_mode
    except (OSError, ValueError):
        return None  # the attempt to write gives the error
    return None if stat.S_ISREG(mode) else kind_of(mode)


def kind_of(mode: int) -> str:
    """Return the kind of a file that is not regular, in words, from its `st_mode`."""
    return next((words for is_it, words in _KINDS if is_it(mode)), "no regular file")


def _checked(status: os.stat_result, path: str | Path, what: str, at_most: int) -> int:
    if not stat.S_ISREG(status.st_mode):
        raise InputError(f"{path}: expected {what}, got {kind_of(status.st_mode)}")
    if status.st_size > at_most:
        raise _too_large(path, what, at_most, status.st_size)
    return status.st_size


def _too_large(path: str | Path, what: str, at_most: int, size: int | None = None) -> InputError:
    got = "more" if size is None else size_words(size)
    return InputError(f"{path}: expected {what} of at most {size_words(at_most)}, got {got}")


def _refusal(e: OSError | ValueError, path: str | Path, what: str) -> InputError:
    # InputError is a ValueError, so a deliberate one passes unchanged.
    if isinstance(e, InputError):
        return e
    if isinstance(e, FileNotFoundError):
        return InputError(f"{path}: no such file")
    if isinstance(e, OSError):
        # A file of /proc without data would otherwise block.
        waits = e.errno in (errno.EAGAIN, errno.EWOULDBLOCK)
        why = "it gives nothing" if waits else e.strerror or type(e).__name__
        return InputError(f"{path}: cannot be read ({why}), expected {what}")
    return InputError(f"expected the name of a file, got {path!r:.80}")  # one with a null character
