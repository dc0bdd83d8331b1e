"""Lines of a table as they arrive: sorted by time, without repetitions."""

import re
from bisect import bisect_right
from collections.abc import Sequence

import numpy as np

from heli_jax.errors import InputError
from heli_jax.flights.clock import ROWS, clock_scale, columns_of
from heli_jax.flights.flight import Signal
from heli_jax.flights.formats.csv_text import as_text, table_of
from heli_jax.flights.log import column, shown, wrong

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
        self._text, self._lines = b"", 0
        self._held: list[Row] = []

    def take(self, data: bytes) -> list[Row]:
        """Return the rows that no later line can precede.

        Raises:
            InputError: a line or a column is wrong; the rows before it are held.
        """
        self._text += data
        end = self._text.rfind(b"\n") + 1
        if not self.head:
            if self._text.count(b"\n") < _HEAD:
                return []
            text = as_text(self.path, self._text[:end])
            begin = table_of(self.path, text, text).begin
            self.head, self._text = text[:begin], text[begin:] + self._text[end:]
            self._lines = self.head.count(b"\n")
            end = self._text.rfind(b"\n") + 1
        whole, self._text = self._text[:end].replace(b"\r", b""), self._text[end:]
        before, each = self._lines, whole.split(b"\n")[:-1]
        self._lines += len(each)
        numbers = [before + 1 + i for i, line in enumerate(each) if line.strip()]
        if numbers:
            self._hold([line for line in each if line.strip()], numbers)
        return self._out(self._held[-1][0] - WAIT) if self._held else []

    def finish(self) -> list[Row]:
        """Return all other rows."""
        return self._out(np.inf)

    def _hold(self, lines: list[bytes], numbers: list[int]) -> None:
        text = self.head + b"\n".join(lines) + b"\n"
        above = self.head.count(b"\n")
        try:
            table = table_of(self.path, text, text)
            # All columns are read, so that a wrong number ends the stream at once.
            columns = columns_of(table, list(dict.fromkeys((self.time.name, *self.names))))
            seconds = columns[self.time.name] * clock_scale(table, self.time)
            whole = np.isfinite(seconds)
            if seconds.size != len(lines) or not whole.all():
                i = int(np.argmin(whole)) if seconds.size == len(lines) else 0
                found = shown(lines[i].decode(errors="replace"))
                problem = f"got {found}, expected a row with a time and a cell for each column"
                raise wrong(self.path, problem, f"line {above + 1 + i}", column(self.time.name))
        except InputError as e:
            place = re.search(r", line (\d+)", str(e))
            i = int(place[1]) - above - 1 if place else -1
            # The text of these lines begins anew with the head.
            if place is None or not 0 <= i < len(lines):
                raise
            if i:
                self._hold(lines[:i], numbers[:i])
            sentence = str(e)[: place.start(1)] + str(numbers[i]) + str(e)[place.end(1) :]
            raise InputError(sentence) from e
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
