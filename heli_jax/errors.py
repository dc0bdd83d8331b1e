"""The one error that a user's files and configurations can raise."""

import contextlib
import difflib
from collections.abc import Iterable, Iterator
from typing import Any

_END = 1000
"""letters at the beginning and the end of a message that stay, as long as paths may be"""


def shortened(text: str) -> str:
    """A message without the middle of a long one, which is a value that it names."""
    left = len(text) - 2 * _END
    return text if left <= 0 else f"{text[:_END]} [{left} letters] {text[-_END:]}"


class InputError(ValueError):
    """A file or a configuration is wrong.

    Its text is one whole sentence that names the file, the place, what was expected and what was
    got. The command line prints it and ends with exit code 2. `within` is the same without the
    file, for who has named it already.
    """

    def __init__(self, text: str, within: str = "") -> None:
        super().__init__(shortened(text))
        self.within = shortened(within or text)


@contextlib.contextmanager
def located(where: str) -> Iterator[None]:
    """Make an `InputError` that begins with a place of a ValueError that knows none."""
    try:
        yield
    except InputError:
        raise  # it names its file already
    except ValueError as e:
        raise InputError(f"{where}: {e}") from e


class VehicleError(ValueError):
    """A vehicle lacks a constant that its model reads, or has one that cannot be.

    Its argument is the sentence without its place: a configuration knows the vehicle's file.
    """

    @property
    def problem(self) -> str:
        """Description of the error."""
        return self.args[0]

    def __str__(self) -> str:
        return f"vehicle: {self.problem}"


def nearest(name: str, known: Iterable[str], otherwise: str | None = None) -> str:
    """`"; did you mean 'x'?"` for the known name closest to `name`; where none is close
    `otherwise`, or the first of what is known."""
    # 0.5 in place of difflib's 0.6: names of constants are short, and one wrong letter of two is
    # half.
    known = sorted(known)
    # A name that is wrong in its case alone is meant: 'MA' is as near to 'Mq' as to 'Ma' otherwise.
    alike = [k for k in known if k.lower() == name.lower()]
    close = alike or difflib.get_close_matches(name, known, n=1, cutoff=0.5)
    if not close:
        # Case counts above: only if nothing is near is 'HELICOPTER' compared without it.
        lower = {k.lower(): k for k in known}
        close = [lower[c] for c in difflib.get_close_matches(name.lower(), lower, n=1, cutoff=0.5)]
    if close:
        return f"; did you mean {close[0]!r}?"
    if otherwise is not None:
        return otherwise
    # A model has up to sixty parameters: a sentence of all is read by nobody.
    shown = ", ".join(known[:12]) + (", ..." if len(known) > 12 else "")
    return f"; known are {shown}" if known else ""


def require_known(names: Iterable[Any], known: Iterable[str], where: str, what: str) -> None:
    """Refuse names of a file that are none of those known: `fit.yaml: fit.free: model roll has no
    parameter 'Ixy'; did you mean 'Ixx'?`.

    Raises:
        InputError: one of them is.
    """
    known = list(known)
    for name in names:
        if name not in known:
            raise InputError(f"{where}: {what} {name!r:.60}{nearest(str(name), known)}")


def require_kind(argument: str, value: Any, kinds: type | tuple[type, ...], expected: str) -> None:
    """Refuse an argument of another kind than it has to be.

    Raises:
        TypeError: naming the argument, what was expected and what was found.
    """
    if not isinstance(value, kinds):
        raise TypeError(f"{argument}: expected {expected}, got {type(value).__name__}")
