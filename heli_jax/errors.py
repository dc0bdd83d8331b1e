"""Errors that users' files and configurations can raise."""

import contextlib
import difflib
from collections.abc import Iterable, Iterator
from typing import Any

_END = 1000
"""Length kept at the start and end of a message [characters]; paths may be that long."""


def shortened(text: str) -> str:
    """Return a message, with its middle cut out if it is too long."""
    left = len(text) - 2 * _END
    return text if left <= 0 else f"{text[:_END]} [{left} letters] {text[-_END:]}"


class InputError(ValueError):
    """A file or a configuration is wrong.

    The text is one sentence with the file, the place, what was expected and what was found. The
    command line prints it and ends with exit code 2. `within` is the text without the file, for
    callers that name the file themselves.
    """

    def __init__(self, text: str, within: str = "") -> None:
        super().__init__(shortened(text))
        self.within = shortened(within or text)


@contextlib.contextmanager
def located(where: str) -> Iterator[None]:
    """Convert a ValueError into an `InputError` that begins with a place; an InputError passes."""
    try:
        yield
    except InputError:
        raise  # names its file already
    except ValueError as e:
        raise InputError(f"{where}: {e}") from e


class VehicleError(ValueError):
    """A vehicle lacks a constant that its model reads, or has an impossible one.

    Its argument is the sentence without the place, which a configuration adds.
    """

    @property
    def problem(self) -> str:
        """Description of the error."""
        return self.args[0]

    def __str__(self) -> str:
        return f"vehicle: {self.problem}"


def nearest(name: str, known: Iterable[str], otherwise: str | None = None) -> str:
    """Return `"; did you mean 'x'?"` for the known name closest to `name`.

    If none is close, return `otherwise`, or the first known names.
    """
    # The cutoff is 0.5 instead of difflib's 0.6: constants have short names, where one letter may
    # be half.
    known = sorted(known)
    # A difference in case alone is a match. Otherwise 'MA' is as near to 'Mq' as to 'Ma'.
    alike = [k for k in known if k.lower() == name.lower()]
    close = alike or difflib.get_close_matches(name, known, n=1, cutoff=0.5)
    if not close:
        # Case counts above. It is ignored only if nothing is near, as for 'HELICOPTER'.
        lower = {k.lower(): k for k in known}
        close = [lower[c] for c in difflib.get_close_matches(name.lower(), lower, n=1, cutoff=0.5)]
    if close:
        return f"; did you mean {close[0]!r}?"
    if otherwise is not None:
        return otherwise
    # A model may have sixty parameters, too many for a sentence.
    shown = ", ".join(known[:12]) + (", ..." if len(known) > 12 else "")
    return f"; known are {shown}" if known else ""


def require_known(names: Iterable[Any], known: Iterable[str], where: str, what: str) -> None:
    """Raise if a file has unknown names, with the nearest known name in the message.

    Raises:
        InputError: a name is unknown.
    """
    known = list(known)
    for name in names:
        if name not in known:
            raise InputError(f"{where}: {what} {name!r:.60}{nearest(str(name), known)}")


def require_kind(argument: str, value: Any, kinds: type | tuple[type, ...], expected: str) -> None:
    """Refuse an argument of the wrong type.

    Raises:
        TypeError: the argument has another type; the message names what was expected and found.
    """
    if not isinstance(value, kinds):
        raise TypeError(f"{argument}: expected {expected}, got {type(value).__name__}")
