"""Lines of a table as they arrive: sorted by time, without repetitions."""

import re
from bisect import bisect_right
from collections.abc import Sequence

import numpy as np

from heli_jax.errors import InputError
from heli_jax.flights.clock import ROWS, clock_scale, columns_of
from heli_jax.flights.flight import Signal
from heli_jax.flights.formats.csv_text import CsvTable, as_text, table_of
from heli_jax.flights.log import column, wrong

WAIT = 1.0
"""Time for which later lines may still come before earlier ones [s]."""
_HEAD = 4
"""Fewest lines in which the names of the columns are searched."""

type Row = tuple[float, bytes]
"""Time [s] and text of a line."""


class Sorter:
    """Puts the lines of a table in order.

    A line without its end is not read. Lines more than `WAIT` older than the newest are left out.
    """

    def __init__(self, path: str, time: Signal, names: Sequence[str]) -> None:
        if time.name == ROWS or time.scale != 1.0:
            problem = "its rows have no times, expected signals.time.signal, a column of times"
            raise wrong(path, problem)
        self.path, self.time, self.names = path, time, tuple(names)
        self.head = b""
        """Text above the rows."""
        self.late = self.repeated = 0
        self.done = -np.inf
        """Time of the last row that was given out [s]."""
        self._text = b""
        self._held: list[Row] = []

    def take(self, data: bytes) -> list[Row]:
        """Return the rows that no later line can precede.

        Raises:
            InputError: a line or a column is wrong.
        """
        self._text += data
        end = self._text.rfind(b"\n") + 1
        if not self.head:
            if self._text.count(b"\n") < _HEAD:
                return []
            text = as_text(self.path, self._text[:end])
            begin = self._table(text).begin
            self.head, self._text = text[:begin], text[begin:] + self._text[end:]
            end = self._text.rfind(b"\n") + 1
        whole, self._text = self._text[:end].replace(b"\r", b""), self._text[end:]
        if lines := [line for line in whole.split(b"\n") if line.strip()]:
            self._hold(lines)
        return self._out(self._held[-1][0] - WAIT) if self._held else []

    def finish(self) -> list[Row]:
        """Return all other rows."""
        return self._out(np.inf)

    def _table(self, text: bytes) -> CsvTable:
        try:
            return table_of(self.path, text, text)
        except InputError as e:
            raise self._without_line(e) from e

    def _without_line(self, error: InputError) -> InputError:
        """Return the error without its line, which counts from the last lines received."""
        return InputError(re.sub(r", line \d+", "", str(error)))

    def _hold(self, lines: list[bytes]) -> None:
        table = self._table(self.head + b"\n".join(lines) + b"\n")
        try:
            # All columns are read, so that a wrong number ends the stream at once.
            columns = columns_of(table, list(dict.fromkeys((self.time.name, *self.names))))
        except InputError as e:
            raise self._without_line(e) from e
        seconds = columns[self.time.name] * clock_scale(table, self.time)
        if seconds.size != len(lines) or not np.isfinite(seconds).all():
            problem = "a line has no time or another number of cells, expected whole rows"
            raise wrong(self.path, problem, column(self.time.name))
        rows = list(zip(seconds.tolist(), lines, strict=True))
        timely = [row for row in rows if row[0] > self.done]
        kept = sorted({*self._held, *timely})
        self.late += len(rows) - len(timely)
        self.repeated += len(self._held) + len(timely) - len(kept)
        self._held = kept

    def _out(self, until: float) -> list[Row]:
        """Give out the rows up to a time."""
        n = bisect_right(self._held, until, key=lambda row: row[0])
        out, self._held = self._held[:n], self._held[n:]
        if out:
            self.done = out[-1][0]
        return out
