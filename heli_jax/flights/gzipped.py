"""Texts that were packed by gzip (RFC 1952)."""

import gzip
import io
import zlib
from pathlib import Path

from heli_jax.flights.table import Budget, wrong

ENDING = ".gz"
_BLOCK = 1 << 22
_BEHIND = (b"\n", b",", b";", b"\t")


def is_gzipped(path: Path) -> bool:
    """Whether a file's name says so."""
    return path.suffix.lower() == ENDING


def inner_ending(path: Path) -> str:
    """What a file would end in if it were not packed: `.csv` of `log.csv.gz`, of `log.csv` too."""
    return Path(path.stem if is_gzipped(path) else path.name).suffix.lower()


def unpacked(path: str, data: bytes) -> bytes:
    """The bytes that were packed, of all members that follow each other.

    Args:
        path: for messages.
        data: of the file.

    Raises:
        InputError: it is none of gzip, it is cut off or damaged, or it claims more than a log has.
    """
    text, budget = bytearray(), Budget(path, len(data))
    try:
        with gzip.GzipFile(fileobj=io.BytesIO(data)) as file:
            while piece := file.read(_BLOCK):
                # And its numbers: of two letters, a digit and what is behind it, eight bytes.
                budget.take(len(piece) + 8 * sum(map(piece.count, _BEHIND)))
                text += piece
    except (OSError, EOFError, zlib.error) as e:
        raise wrong(path, f"is no whole file of gzip ({type(e).__name__})") from e
    return bytes(text)
