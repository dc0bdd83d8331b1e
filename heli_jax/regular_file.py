"""Reading what a user names: regular files of a stated size, and nothing that never ends.

A device such as /dev/zero has no end, a named pipe waits for a writer, and a sparse file of 1 TB
takes no room on a disk and all of a machine's memory. So the kind and the size are looked at
before a byte is read, and again on the file that was opened: between the two a name can change.
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
# Opening must not wait for the other end of a pipe, and must not make a terminal this process's.
_FLAGS = (
    os.O_RDONLY
    | getattr(os, "O_NONBLOCK", 0)
    | getattr(os, "O_NOCTTY", 0)
    | getattr(os, "O_CLOEXEC", 0)
    | getattr(os, "O_BINARY", 0)
)
_PIECE = 1 << 20


def size_words(size: int) -> str:
    """A size in bytes in words: `1 MB`, `16 GB`."""
    # Powers of ten, as disks are sold; the limits are stated in them too.
    for unit, scale in (("TB", 10**12), ("GB", 10**9), ("MB", 10**6), ("kB", 10**3)):
        if size >= scale:
            return f"{size / scale:.3g} {unit}"
    return f"{size} bytes"


def require_regular(path: str | Path, what: str, at_most: int) -> int:
    """The size [bytes] of a regular file, which is not opened.

    Args:
        what: what it should be, with its article: `a log in CSV`.
        at_most: the largest size that is read [bytes].

    Raises:
        InputError: there is none, it is no regular file, or it is larger.
    """
    # A ValueError is a path with a null character, which os refuses before the system sees it.
    try:
        return _checked(os.stat(path), path, what, at_most)
    except (OSError, ValueError) as e:
        raise _refusal(e, path, what) from e


@contextlib.contextmanager
def open_regular(path: str | Path, what: str, at_most: int) -> Iterator[BinaryIO]:
    """A regular file opened for reading; arguments and errors as of `require_regular`, and that it
    cannot be opened or read."""
    # Before it is opened: to open some devices has an effect (a tape rewinds, a watchdog starts).
    require_regular(path, what, at_most)
    try:
        descriptor = os.open(path, _FLAGS)
        with os.fdopen(descriptor, "rb") as file:
            _checked(os.fstat(descriptor), path, what, at_most)
            yield file
    except OSError as e:
        raise _refusal(e, path, what) from e


def read_regular(path: str | Path, what: str, at_most: int) -> bytes:
    """All of a regular file; arguments and errors as of `open_regular`."""
    # A file of /proc says that it is empty and gives without end: what is read is counted too.
    pieces, size = [], 0
    with open_regular(path, what, at_most) as file:
        # In one piece where it is as long as it says: joining pieces takes the memory twice.
        stated = os.fstat(file.fileno()).st_size
        while piece := file.read(max(stated - size, 0) + _PIECE):
            size += len(piece)
            if size > at_most:
                raise _too_large(path, what, at_most)
            pieces.append(piece)
    return pieces[0] if len(pieces) == 1 else b"".join(pieces)


def in_the_way(path: str | Path) -> str | None:
    """Return, in words, what prevents a file from being written at a place; None if nothing
    does."""
    try:
        mode = os.stat(path).st_mode
    except (OSError, ValueError):
        return None  # writing there says what is wrong
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
    # An InputError is a ValueError: one that was raised on purpose keeps its words.
    if isinstance(e, InputError):
        return e
    if isinstance(e, FileNotFoundError):
        return InputError(f"{path}: no such file")
    if isinstance(e, OSError):
        # A file of /proc that has nothing to give now would otherwise be waited for.
        waits = e.errno in (errno.EAGAIN, errno.EWOULDBLOCK)
        why = "it gives nothing" if waits else e.strerror or type(e).__name__
        return InputError(f"{path}: cannot be read ({why}), expected {what}")
    return InputError(f"expected the name of a file, got {path!r:.80}")  # one with a null character
