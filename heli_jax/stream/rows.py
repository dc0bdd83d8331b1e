"""Lines of a table as they arrive: sorted by time, without repetitions, on a uniform grid."""

import re
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from heli_jax import units
from heli_jax.errors import InputError
from heli_jax.flights.clock import ROWS, clock_scale, columns_of
from heli_jax.flights.flight import Flight, Signal
from heli_jax.flights.formats.csv_text import CsvTable, as_text, table_of
from heli_jax.flights.log import column, wrong
from heli_jax.stream.steps import Sample

WAIT = 1.0
"""Time for which later lines may still come before earlier ones [s]."""
_HEAD = 4
"""Fewest lines in which the names of the columns are searched."""


class Rows(NamedTuple):
    """Rows in the order of time."""

    seconds: Float[np.ndarray, " n"]
    values: Float[np.ndarray, "n c"]
    """Numbers of the log, NaN where a cell is empty."""
    lines: list[bytes]

    def part(self, first: int, last: int | None) -> "Rows":
        """Return the rows from one to before another."""
        at = slice(first, last)
        return Rows(self.seconds[at], self.values[at], self.lines[at])


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
        self._text, self._newest = b"", -np.inf
        self._held = Rows(np.zeros(0), np.zeros((0, len(self.names))), [])

    def take(self, data: bytes) -> Rows:
        """Return the rows that no later line can precede.

        Raises:
            InputError: a line or a column is wrong.
        """
        self._text += data
        end = self._text.rfind(b"\n") + 1
        if not self.head:
            if self._text.count(b"\n") < _HEAD:
                return self._out(np.zeros(len(self._held.lines), bool))
            text = as_text(self.path, self._text[:end])
            begin = self._table(text).begin
            self.head, self._text = text[:begin], text[begin:] + self._text[end:]
            end = self._text.rfind(b"\n") + 1
        whole, self._text = self._text[:end].replace(b"\r", b""), self._text[end:]
        if lines := [line for line in whole.split(b"\n") if line.strip()]:
            self._hold(lines)
        return self._out(self._held.seconds <= self._newest - WAIT)

    def finish(self) -> Rows:
        """Return all other rows."""
        return self._out(np.ones(len(self._held.lines), bool))

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
            columns = columns_of(table, list(dict.fromkeys((self.time.name, *self.names))))
        except InputError as e:
            raise self._without_line(e) from e
        seconds = columns[self.time.name] * clock_scale(table, self.time)
        if seconds.size != len(lines) or not np.isfinite(seconds).all():
            problem = "a line has no time or another number of cells, expected whole rows"
            raise wrong(self.path, problem, column(self.time.name))
        old, self._newest = self._held, max(self._newest, float(seconds.max()))
        late = seconds <= self.done
        self.late += int(late.sum())
        seconds = np.concatenate([old.seconds, seconds[~late]])
        values = np.stack([columns[n] for n in self.names], axis=1)[~late]
        texts = [*old.lines, *(line for line, out in zip(lines, late, strict=True) if not out)]
        order = sorted(range(len(texts)), key=lambda i: (seconds[i], texts[i]))
        kept = [i for k, i in enumerate(order) if k == 0 or texts[i] != texts[order[k - 1]]]
        self.repeated += len(order) - len(kept)
        values = np.concatenate([old.values, values])[kept]
        self._held = Rows(seconds[kept], values, [texts[i] for i in kept])

    def _out(self, out: np.ndarray) -> Rows:
        """Give out the first of the rows that are held."""
        n, held = int(out.sum()), self._held
        self._held = held.part(n, None)
        if n:
            self.done = float(held.seconds[n - 1])
        return held.part(0, n)


BRIDGED = 3.5
"""Longest step that is bridged [usual steps]: three lost samples."""
_LONGEST = 10.0
"""Length to which gaps are shortened [usual steps]; they end a block in any case."""


class Clocked(NamedTuple):
    """Samples of one signal, SI."""

    seconds: Float[np.ndarray, " n"]
    values: Float[np.ndarray, " n"]


class Grid:
    """Puts sorted rows on a flight's uniform grid: inputs as they act, outputs by straight lines.

    Steps of up to `BRIDGED` usual ones are bridged. Longer gaps are missing samples.
    """

    def __init__(self, flight: Flight, names: Sequence[str], first: Rows, *, even: bool) -> None:
        """Begin at the first row.

        Args:
            flight: flight of the first rows, with its signals as read.
            names: columns of the rows.
            first: these rows.
            even: True if the rows themselves are the grid, however their stamps are rounded.
        """
        assert flight.source is not None
        self.dt, self.even = flight.dt, even
        outputs = {n: flight.source.outputs[n] for n in sorted(flight.outputs)}
        self.inputs, self.outputs = dict(flight.source.inputs), outputs
        self.constant = {
            n: float(flight.inputs[n][0]) for n, s in self.inputs.items() if s.constant is not None
        }
        self._hold = flight.hold
        self._columns = {n: i for i, n in enumerate(names)}
        # The first row is at the first instant.
        self._begin = float(first.seconds[0])
        self._at = self._begin - (flight.dt if even else 0.0)
        self._index, self._cut, self._next = -1, 0.0, 0
        self._tails: dict[tuple[str, str], Clocked] = {}
        self._usual = {}
        for key, signal in self._logged():
            seen = first.seconds[np.isfinite(first.values[:, self._columns[signal.name]])]
            step = float(np.median(np.diff(seen))) if seen.size > 1 else self.dt
            self._usual[key] = max(step, self.dt)
            self._tails[key] = Clocked(np.zeros(0), np.zeros(0))

    def _logged(self) -> list[tuple[tuple[str, str], Signal]]:
        signals: list[tuple[tuple[str, str], Signal]] = []
        for kind, by_name in (("input", self.inputs), ("output", self.outputs)):
            signals += [((n, kind), s) for n, s in by_name.items() if s.constant is None]
        return signals

    def take(self, rows: Rows, *, last: bool = False) -> Sample:
        """Return the samples (n, ...) of the grid that no later row can change.

        Args:
            last: True if no row follows.
        """
        seconds, rows = self._elapsed(rows)
        for key, signal in self._logged():
            numbers = rows.values[:, self._columns[signal.name]]
            seen = np.isfinite(numbers) & ~np.isin(numbers, signal.missing)
            values, old = signal.to_si(numbers[seen]), self._tails[key]
            if (turn := units.turn(signal.si)) is not None and values.size:
                values = np.unwrap(np.r_[old.values[-1:], values], 0.75 * turn, period=turn)
                values = values[min(old.values.size, 1) :]
            self._tails[key] = Clocked(np.r_[old.seconds, seconds[seen]], np.r_[old.values, values])
        ends = [t.seconds[-1] if t.seconds.size else 0.0 for t in self._tails.values()]
        known = min(ends) if last else max(ends) - BRIDGED * max(self._usual.values())
        stop = int(np.floor(known / self.dt + 1e-6)) + 1
        times = self.dt * np.arange(self._next, max(stop, self._next))
        made = {key: self._sampled(key, times) for key in self._tails}
        made |= {(n, "input"): np.full(times.size, v) for n, v in self.constant.items()}
        self._next += times.size
        for key, (t, v) in self._tails.items():
            # The sample before the next instant is still needed.
            first = max(int(np.searchsorted(t, self.dt * self._next)) - 2, 0)
            self._tails[key] = Clocked(t[first:], v[first:])
        return Sample(
            np.stack([made[n, "input"] for n in self.inputs], axis=1),
            np.stack([made[n, "output"] for n in self.outputs], axis=1),
        )

    def _elapsed(self, rows: Rows) -> tuple[np.ndarray, Rows]:
        """Return the times of rows from the first, without long gaps, and these rows.

        On an even clock the times are multiples of dt, and a row at the time of the one before is
        left out.
        """
        steps = np.diff(np.r_[self._at, rows.seconds])
        self._at = float(rows.seconds[-1]) if steps.size else self._at
        kept = np.minimum(steps, _LONGEST * max(self._usual.values()))
        if self.even:
            whole = np.round(kept / self.dt).astype(int)
            index = self._index + np.cumsum(whole)
            new = whole > 0
            seconds = self.dt * index[new]
            self._index = int(index[-1]) if index.size else self._index
            rows = Rows(rows.seconds[new], rows.values[new], [])
        else:
            cut = self._cut + np.cumsum(steps - kept)
            self._cut = float(cut[-1]) if cut.size else self._cut
            seconds = rows.seconds - self._begin - cut
        return seconds, rows

    def _sampled(self, key: tuple[str, str], times: np.ndarray) -> np.ndarray:
        t, v = self._tails[key]
        if not t.size:
            return np.full(times.size, np.nan)
        near = 1e-6 * self.dt
        before = np.searchsorted(t, times + near, side="right") - 1
        after = np.minimum(before + 1, t.size - 1)
        exact = (before >= 0) & (np.abs(t[np.maximum(before, 0)] - times) <= near)
        inside = (before >= 0) & (before + 1 < t.size)
        short = t[after] - t[np.maximum(before, 0)] <= BRIDGED * self._usual[key]
        held = key[1] == "input" and self._hold[key[0]] == "zero-order"
        between = v[np.maximum(before, 0)] if held else np.interp(times, t, v)
        made = np.where(exact, v[np.maximum(before, 0)], between)
        return np.where(exact | (inside & short), made, np.nan)
