"""`heli-jax stream`: what a flight determines so far, while it goes on."""

import contextlib
import os
import select
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import jax
import jax.numpy as jnp
import numpy as np

from heli_jax import config as configuration
from heli_jax import naming, units
from heli_jax.cli.terminal import print_table, print_text
from heli_jax.cli.wanted import Wanted
from heli_jax.config import Experiment
from heli_jax.config.logs import clock_signal, first_signals, require_flights, with_log
from heli_jax.errors import InputError, located
from heli_jax.flights.flight import Signal
from heli_jax.flights.grid import Grid as EvenClock
from heli_jax.flights.grid import rounding_of, uniform_grid
from heli_jax.identification.identifiability.verdict import exponents
from heli_jax.identification.problem import Problem
from heli_jax.numbers import terse
from heli_jax.regular_file import open_regular
from heli_jax.stream import Known, Sample, State, estimate, follow, init
from heli_jax.stream.rows import BRIDGED, Grid, Rows, Sorter
from heli_jax.stream.steps import BLOCK

_PIECE, _TOGETHER = 1 << 18, 64
"""Bytes that are read at once, and samples that one program takes."""
_PAUSE, _EVERY = 0.1, 0.5
"""Pause before more is read, and time between two screens [s]."""


@contextlib.contextmanager
def ending_block() -> Iterator[Callable[[], bool]]:
    """Let an interrupt end the block alone; yield a function that returns if there was one."""
    seen: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield lambda: False
        return
    before = signal.signal(signal.SIGINT, lambda number, _: seen.append(number))
    # `heli_jax.__main__` must not hear of it.
    pipe = signal.set_wakeup_fd(-1)
    try:
        yield lambda: bool(seen)
    finally:
        signal.signal(signal.SIGINT, before)
        signal.set_wakeup_fd(pipe, warn_on_full_buffer=False)


def require_free(experiment: Experiment, wanted: Mapping[str, Wanted]) -> None:
    """Refuse wanted sds of what is not estimated."""
    fit = experiment.config.fit
    free = [] if fit is None else [*fit.free, *["time_shift"] * fit.nuisance.time_shift]
    with located("--for"):
        for name in wanted:
            exponents(name, free)


# Sources of bytes: a growing file, standard input, or messages as rows of a table.


def received(
    place: str, until_end: bool, stopped: Callable[[], bool], time: Signal, names: Sequence[str]
) -> Iterator[bytes]:
    """Yield what arrives from a file, `-`, or `mavlink:DEVICE`; b"" while nothing does.

    Args:
        until_end: True if a file ends the stream with its present end.
        stopped: true once the stream shall end.
        time: clock of the table.
        names: columns of the table.
    """
    if place.startswith("mavlink:"):
        yield from _messages(place.removeprefix("mavlink:"), until_end, stopped, time, names)
    elif place == "-":
        yield from _bytes(sys.stdin.buffer, True, stopped)
    else:
        with open_regular(place, "a log", sys.maxsize) as file:
            yield from _bytes(file, until_end, stopped)


def _bytes(file: BinaryIO, until_end: bool, stopped: Callable[[], bool]) -> Iterator[bytes]:
    is_stream = not file.seekable()
    while not stopped():
        # A pipe blocks, and an interrupt must be seen.
        if is_stream and not select.select([file], [], [], _PAUSE)[0]:
            yield b""
            continue
        data = os.read(file.fileno(), _PIECE)
        if not data and until_end:
            return
        if not data:
            time.sleep(_PAUSE)
        yield data


def _messages(
    device: str, until_end: bool, stopped: Callable[[], bool], time: Signal, names: Sequence[str]
) -> Iterator[bytes]:
    """Yield MAVLink messages as rows of a table with columns such as `ATTITUDE.roll`."""
    try:
        from pymavlink import mavutil
    except ImportError as e:
        raise InputError(
            "mavlink: pymavlink is not installed, expected the extra logs: pip install "
            "'heli_jax[logs]'"
        ) from e
    try:
        link: Any = mavutil.mavlink_connection(device)
    except Exception as e:  # of serial ports, sockets and files
        raise InputError(f"mavlink:{device}: cannot be opened ({e})") from e
    kinds = sorted({n.partition(".")[0] for n in names})
    scale = units.factor(time.unit, "s")
    with contextlib.closing(link):
        yield (",".join([time.name, *names]) + "\n").encode()
        while not stopped():
            message = link.recv_match(type=kinds, blocking=not until_end, timeout=_PAUSE)
            if message is None:
                if until_end:
                    return
                yield b""
                continue
            stamp = getattr(message, "time_boot_ms", None)
            seconds = (
                1e-3 * stamp if stamp is not None else 1e-6 * getattr(message, "time_usec", np.nan)
            )
            if not np.isfinite(seconds):
                raise InputError(f"mavlink:{device}: {message.get_type()} has no time")
            cells = []
            for n in names:
                kind, _, field = n.partition(".")
                value = getattr(message, field, None) if kind == message.get_type() else None
                cells.append("" if value is None else repr(float(value)))
            yield (",".join([repr(seconds / scale), *cells]) + "\n").encode()


# From rows to samples.


class Follower:
    """Follows the rows of a table: sorts them, keeps them in a log, and takes their samples."""

    def __init__(self, experiment: Experiment, place: str, log: Path, block: float) -> None:
        require_flights(experiment)
        flight, signals = experiment.config.flights[0], first_signals(experiment)
        clock = clock_signal(flight.signals.time)
        if clock is None:
            raise InputError(
                f"{experiment.path}: flights[0].signals.time: missing, expected the column of "
                "times of a table"
            )
        inputs = [s.signal for s in signals.inputs.values() if s.constant is None and s.signal]
        outputs = [s.signal for s in signals.outputs.values() if s.signal]
        self.names = list(dict.fromkeys([*inputs, *outputs]))
        self._inputs = len({*inputs})
        self.experiment, self.time, self.log, self.block = experiment, clock, log, block
        self.sorter = Sorter(place, clock, self.names)
        self.problem: Problem | None = None
        self.state: State | None = None
        self.known: Known | None = None
        self._first, self._stamps = Rows(np.zeros(0), np.zeros((0, len(self.names))), []), []
        self._length, self._grid = block, None
        # States are large, so each step writes over the one before.
        self._follow = jax.jit(follow, donate_argnums=0)

    def take(self, data: bytes) -> None:
        """Take further bytes."""
        self._rows(self.sorter.take(data))

    def finish(self) -> None:
        """Take what was held back for later rows."""
        self._rows(self.sorter.take(b""))
        self._rows(self.sorter.finish(), last=True)

    def _rows(self, rows: Rows, *, last: bool = False) -> None:
        if rows.lines:
            self.log.parent.mkdir(parents=True, exist_ok=True)
            with self.log.open("ab") as file:
                head = b"" if self._stamps else self.sorter.head
                file.write(head + b"\n".join(rows.lines) + b"\n")
            self._stamps.append(rows.seconds)
        if self._grid is None:
            old = self._first
            self._first = Rows(
                np.concatenate([old.seconds, rows.seconds]),
                np.concatenate([old.values, rows.values]),
                old.lines + rows.lines,
            )
            if not self._begin(last):
                return
            assert self._grid is not None
            rows, self._first = self._first, self._first._replace(lines=[])
        self._samples(self._grid.take(rows, last=last))

    def _begin(self, last: bool) -> bool:
        """Make the problem of the first rows once they are long enough; return if it is made."""
        seconds = self._first.seconds
        if not seconds.size or not (last or seconds[-1] - seconds[0] >= self._length):
            return False
        n = int(np.searchsorted(seconds, seconds[0] + self._length, side="right"))
        first = self._first.part(0, n)
        moves = [np.unique(v[np.isfinite(v)]).size > 1 for v in first.values.T]
        begun = any(moves[self._inputs :]) and any([not self._inputs, *moves[: self._inputs]])
        if not last and not begun:
            # On the ground nothing moves yet.
            self._length += self.block
            return False
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "first.csv"
            path.write_bytes(self.sorter.head + b"\n".join(first.lines) + b"\n")
            experiment, even = self.as_fitted(path, seconds[:n])
            try:
                problem = configuration.problem(experiment)
            except InputError as e:
                raise InputError(str(e).replace(str(path), self.sorter.path)) from e
        with located(f"{self.experiment.path}: fit"):
            problem = configuration.by_method(experiment, problem, "frequency-error")
            self.state = init(problem, block=self.block)
        self.problem = problem
        self._grid = Grid(problem.training[0], self.names, first, even=even)
        return True

    def as_fitted(self, path: Path, seconds: np.ndarray | None = None) -> tuple[Experiment, bool]:
        """Return the configuration with a log in place of its own, and if its clock is even.

        Args:
            path: the log.
            seconds: its times (N,) [s]; default: those of all rows.
        """
        seconds = np.concatenate(self._stamps) if seconds is None else seconds
        experiment = with_log(self.experiment, str(path))
        flight = experiment.config.flights[0]
        distinct = np.unique(seconds)
        if distinct.size < 2:
            raise InputError(f"{self.sorter.path}: holds {distinct.size} times, expected a flight")
        steps = np.diff(distinct)
        usual = float(np.median(steps))
        clock = uniform_grid(distinct, rounding_of(distinct)) if distinct.size > 2 else None
        even = flight.rate is None and distinct.size == seconds.size
        if even and not isinstance(clock, EvenClock):
            near = np.abs(steps / usual - np.round(steps / usual)).max() < 0.1
            flight = flight.model_copy(update={"rate": 1.0 / usual})
            even = bool(near)
        if steps.max() > BRIDGED * usual:
            flight = flight.model_copy(update={"gaps": "split"})
        config = experiment.config.model_copy(update={"flights": [flight]})
        return experiment._replace(config=config), even

    def _samples(self, samples: Sample) -> None:
        assert self.state is not None
        at, count = 0, len(samples.inputs)
        while at < count:
            n = _TOGETHER if count - at >= _TOGETHER else 1
            piece = Sample(*(jnp.asarray(v[at : at + n]) for v in samples))
            self.state, _ = self._follow(self.state, piece)
            at += n

    def update(self) -> bool:
        """Estimate anew if a block was completed since; return if so."""
        if self.state is None or self.problem is None:
            return False
        before = 0 if self.known is None else self.known.blocks
        if int(self.state.blocks) == before:
            return False
        self.known = estimate(self.problem, self.state, self.known)
        return True


# The screen.


def rows_of(follower: Follower, wanted: Mapping[str, Wanted]) -> list[tuple[str, ...]]:
    """Return the table of what is known: name, estimate, 95 % interval, sd, wanted, enough."""
    known, problem = follower.known, follower.problem
    if known is None or problem is None:
        return []
    each = known.estimates | known.combinations()
    for name in wanted:
        if (one := known.of(name)) is not None:
            each[name] = one
    rows = []
    for name, one in each.items():
        want, enough = wanted.get(name), ""
        unit = naming.unit(problem.model.Params, name) if name in problem.free else None
        if want is not None:
            enough = "yes" if want.reached(one.value, one.sd) else "no"
        stated = "" if want is None else terse(want.sd * (100.0 if want.relative else 1.0), 3)
        rows.append(
            (
                name,
                terse(one.value, 4),
                f"{terse(one.lower95, 4)} to {terse(one.upper95, 4)}",
                f"{terse(100.0 * one.sd / abs(one.value), 2)} %" if one.value else terse(one.sd, 2),
                unit or "",
                stated + (" %" if want is not None and want.relative else ""),
                enough,
            )
        )
    return rows


HEAD = ("parameter", "estimate", "95 % interval", "sd", "unit", "wanted", "flown enough")


def lines_of(follower: Follower) -> list[str]:
    """Return sentences on what was received, and on coherence."""
    state, known, sorter = follower.state, follower.known, follower.sorter
    if state is None:
        return ["waiting for the first seconds in which all signals move"]
    samples = int(state.samples)
    lines = [
        f"{samples} samples, {samples * state.dt:.1f} s; {int(state.missing)} missing, "
        f"{sorter.late} too late, {sorter.repeated} repeated; {int(state.blocks)} blocks of "
        f"{state.length * state.dt:.3g} s"
    ]
    if known is not None:
        each = (f"{y} from {u} {terse(c, 2)}" for (u, y), c in known.coherence.items())
        lines.append(f"coherence: {', '.join(each)}")
    return lines


def _show(follower: Follower, wanted: Mapping[str, Wanted]) -> None:
    """Print what is known, on a terminal in place of what was printed before."""
    if sys.stdout.isatty():
        sys.stdout.write("\x1b[H\x1b[J")
    print_table(HEAD, rows_of(follower, wanted))
    for line in lines_of(follower):
        print_text(line)
    sys.stdout.flush()


def run_stream(
    experiment: Experiment,
    place: str | None,
    wanted: Mapping[str, Wanted],
    log: Path,
    *,
    until_end: bool,
    block: float | None,
    stopped: Callable[[], bool],
) -> Experiment:
    """Follow a stream to its end, and return the configuration with what was received as its log.

    Args:
        place: see `received`; default: the configuration's first log.
        log: where the rows are kept, in order.
        block: length of a block [s].
        stopped: true once the stream shall end.

    Raises:
        InputError: a row or the configuration is wrong, or nothing was received.
    """
    require_flights(experiment)
    require_free(experiment, wanted)
    if place is None:
        place = str(experiment.path.parent / experiment.config.flights[0].log)
    follower = Follower(experiment, place, log, block or BLOCK)
    shown = 0.0
    arrives = received(place, until_end, stopped, follower.time, follower.names)
    for data in arrives:
        follower.take(data)
        due = sys.stdout.isatty() and time.monotonic() - shown > _EVERY
        if follower.update() or due:
            _show(follower, wanted)
            shown = time.monotonic()
    follower.finish()
    if follower.update():
        _show(follower, wanted)
    if not log.exists():
        raise InputError(f"{place}: no whole rows were received, expected a table with a header")
    return follower.as_fitted(log)[0]
