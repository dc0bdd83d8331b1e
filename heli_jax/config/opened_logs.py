"""Logs that a configuration needs opened more than once: for the firmware's settings, which are
part of the model, and for the flights."""

from pathlib import Path

from heli_jax.flights.log import ChannelLog
from heli_jax.flights.open_log import open_log
from heli_jax.flights.table import Table

_MOST = 2 * 10**8
"""bytes of all files that are kept open: a larger one is parsed again, which spares the memory"""

type _Key = tuple[str, int | None, int, int]


class OpenedLogs:
    """Logs of one configuration, each parsed once until the flights are read."""

    def __init__(self) -> None:
        self._logs: dict[_Key, Table | ChannelLog] = {}

    def __reduce__(self) -> tuple:
        # An experiment that goes to another process has its logs read there.
        return OpenedLogs, ()

    def open(self, path: Path, number: int | None) -> Table | ChannelLog:
        """The log, opened now or before.

        Args:
            path: of the file.
            number: which flight of several, from 1.

        Raises:
            InputError: it cannot be read.
        """
        key = _key(path, number)
        if key not in self._logs:
            log = open_log(path, number)
            if log.size + sum(kept.size for kept in self._logs.values()) > _MOST:
                return log
            self._logs[key] = log
        return self._logs[key]

    def get(self, path: Path, number: int | None) -> Table | ChannelLog | None:
        """The log if it is open.

        Args:
            path: of the file.
            number: which flight of several, from 1.
        """
        return self._logs.get(_key(path, number))

    def close(self) -> None:
        """Keep none any longer."""
        self._logs.clear()


def _key(path: Path, number: int | None) -> _Key:
    # With time and size: a log that was written anew is another one.
    try:
        stat = path.stat()
    except OSError:  # the reader says what is wrong with it
        return str(path.absolute()), number, 0, 0
    return str(path.absolute()), number, stat.st_mtime_ns, stat.st_size
