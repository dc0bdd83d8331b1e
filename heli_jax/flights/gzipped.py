"""Texts that were packed by gzip (RFC 1952)."""

import gzip
import io
import zlib
from pathlib import Path

from heli_jax.flights.table import wrong
from heli_jax.regular_file import size_words

ENDING = ".gz"
_MOST = 4 * 10**9
"""bytes of an unpacked text, which is held in memory"""
_MOST_SMALL = 250 * 10**6
_DENSEST = 200
"""bytes that one packed byte may stand for, where they are more than `_MOST_SMALL`: numbers of a
log pack by less than ten"""
_BLOCK = 1 << 22


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
    most = min(_MOST, max(_MOST_SMALL, _DENSEST * len(data)))
    pieces, size = [], 0
    try:
        with gzip.GzipFile(fileobj=io.BytesIO(data)) as file:
            while piece := file.read(_BLOCK):
                pieces.append(piece)
                size += len(piece)
                if size > most:
                    problem = f"unpacks to more than {size_words(most)}"
                    of = f"a file of {size_words(len(data))}"
                    raise wrong(path, f"{problem} from {of}, which no log of a flight does")
    except (OSError, EOFError, zlib.error) as e:
        raise wrong(path, f"is no whole file of gzip ({type(e).__name__})") from e
    return b"".join(pieces)
