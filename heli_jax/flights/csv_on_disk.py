"""Large delimited texts that are left on the disk, for pyarrow to read itself.

Held in memory a log of some GB costs more time than its numbers: every page of it is filled once
more, and is in the caches no longer when it is looked at. So a large file goes through one buffer,
which shows whether it is plain, and what pyarrow cannot tell is asked of plain files alone.
"""

import os
from pathlib import Path
from typing import NamedTuple

from heli_jax.flights.csv_text import OnDisk, first_row, header_line
from heli_jax.regular_file import open_regular

_LARGE = 1 << 25
"""bytes: smaller files are in memory before anybody has waited"""
_BLOCK = 1 << 20


class Beginning(NamedTuple):
    """The first whole lines of a plain file, and where the rest is."""

    data: bytes
    size: int
    """of the file [bytes]"""
    path: Path

    def rows(self, begin: int) -> OnDisk:
        """What follows from a byte on, header and all above it left out."""
        return OnDisk(self.path, begin, self.size, self.data[begin:])


def plain_beginning(path: Path, at_most: int) -> Beginning | None:
    """The beginning of a large file of plain text: below the header ASCII without quotes, in lines
    of usual length. None where it is small or anything else, which has to be looked at as a whole.

    Args:
        path: the file.
        at_most: the largest size that is read [bytes].

    Raises:
        InputError: as `open_regular`.
    """
    with open_regular(path, "a log in CSV", at_most) as file:
        size = os.fstat(file.fileno()).st_size
        if size < _LARGE:
            return None
        first = file.read(_BLOCK)
        first = first[: first.rfind(b"\n") + 1]
        header = header_line(first)
        if header is None or first_row(first, header.after) is None:
            return None
        file.seek(header.after)
        done = header.after
        while block := file.read(_BLOCK):
            done += len(block)
            plain = block.isascii() and b"\x00" not in block and b'"' not in block
            # A line of more than a block has a sentence of its own.
            if not plain or (b"\n" not in block and done < size):
                return None
    # One that grows meanwhile is taken as it is at one instant.
    return Beginning(first, size, path) if done == size and _is_utf8(first) else None


def _is_utf8(data: bytes) -> bool:
    # Names and units above the rows may hold a degree sign, of whatever encoding.
    try:
        data.decode("utf-8")
    except UnicodeDecodeError:
        return False
    return True
