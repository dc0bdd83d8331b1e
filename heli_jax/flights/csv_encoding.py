"""Text of other encodings as UTF-8, which all that reads logs goes on with."""

import codecs

from heli_jax.flights.table import wrong

_FOREIGN = 0.1
"""part of the bytes that are none of ASCII, from which on they are no text of a log"""


def as_utf8(path: str, data: bytes) -> bytes:
    """The bytes of a file in UTF-8.

    Spreadsheets save "Unicode text" as UTF-16 with a mark, and older programs write one byte a
    letter, of which the degree sign in a header is the commonest.

    Raises:
        InputError: it begins with the mark of UTF-16 and is none.
    """
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        try:
            return data.decode("utf-16").encode()
        except UnicodeDecodeError as e:
            problem = f"begins as text in UTF-16, and is none ({e.reason})"
            raise wrong(path, f"{problem}, expected whole text") from e
    if data.isascii() or b"\x00" in data or _is_utf8(data):
        return data
    foreign = len(data) - len(data.decode("ascii", "ignore"))
    if foreign > _FOREIGN * len(data):
        return data
    try:
        return data.decode("cp1252").encode()
    # `check_text` says where.
    except UnicodeDecodeError:
        return data


def _is_utf8(data: bytes) -> bool:
    decoder = codecs.getincrementaldecoder("utf-8")()
    block = 1 << 20
    try:
        # A block at a time: the text of all is not needed, and takes up to four times the bytes.
        for at in range(0, len(data), block):
            decoder.decode(data[at : at + block], final=at + block >= len(data))
    except UnicodeDecodeError:
        return False
    return True
