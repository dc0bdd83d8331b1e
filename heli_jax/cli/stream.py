"""`heli-jax stream`: what a flight determines so far, while it goes on."""

import contextlib
import os
import select
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
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
from heli_jax.errors import InputError, located, require_known
from heli_jax.flights.flight import Flight, Signal
from heli_jax.flights.grid import Grid as EvenClock
from heli_jax.flights.grid import rounding_of, uniform_grid
from heli_jax.flights.resample import lost_samples
from heli_jax.identification.identifiability.verdict import exponents
from heli_jax.identification.problem import Problem
from heli_jax.numbers import terse
from heli_jax.regular_file import open_regular
from heli_jax.stream import Known, Sample, State, estimate, follow, init
from heli_jax.stream.rows import Row, Sorter
from heli_jax.stream.steps import BLOCK

_PIECE, _TOGETHER = 1 << 18, 64
"""Bytes that are read at once, and samples that one program takes."""
_NETWORKS = ("udp", "udpin", "udpout", "udpbcast", "tcp", "tcpin", "mcast", "ws", "wsserver")
"""Connections of pymavlink that are no file."""
_GAP = 3.5
"""Step from which on a log is split at its gaps [usual steps]."""
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
    port = device.upper().startswith("COM")  # a serial port of Windows
    if device.partition(":")[0] not in _NETWORKS and not port and not Path(device).exists():
        raise InputError(
            f"mavlink:{device}: no such device or file, expected such as udpin:0.0.0.0:14550, "
            "/dev/ttyUSB0 or a .tlog"
        )
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


# From rows to estimates. When a block must be complete, the log is read anew as a fit reads it.


class Follower:
    """Keeps the rows of a table in a log, in order, and estimates from their blocks."""

    def __init__(self, experiment: Experiment, place: str, log: Path, block: float) -> None:
        require_flights(experiment)
        flight, signals = experiment.config.flights[0], first_signals(experiment)
        clock = clock_signal(flight.signals.time)
        if clock is None:
            raise InputError(
                f"{experiment.path}: flights[0].signals.time: missing, expected the column of "
                "times of a table"
            )
        each = (*signals.inputs.values(), *signals.outputs.values())
        self.names = list(dict.fromkeys(s.signal for s in each if s.signal))
        self._has_inputs = any(s.signal for s in signals.inputs.values())
        self.experiment, self.time, self.log, self.block = experiment, clock, log, block
        if not experiment.model.linear:
            raise InputError(
                f"{experiment.path}: model {experiment.model.name} is not linear, expected a "
                "linear one on line"
            )
        # Names and units are checked before the first row.
        with experiment.located("flights[0].signals"):
            units.factor(clock.unit, "s")
            for logged, kind in (
                (signals.inputs, experiment.model.Inputs),
                (signals.outputs, experiment.model.Outputs),
            ):
                known = naming.names(kind)
                require_known(logged, known, f"{experiment.path}: flights[0]", "unknown signal")
                for name, signal in logged.items():
                    if signal.unit is not None:
                        units.factor(signal.unit, naming.unit(kind, name))
        self.sorter = Sorter(place, clock, self.names)
        self.problem: Problem | None = None
        self.state: State | None = None
        self.known: Known | None = None
        self._stamps: list[float] = []
        self.heard = time.monotonic()
        """Time of the last row, on the clock of `time.monotonic` [s]."""
        self._due, self._taken = block, np.nan
        # States are large, so each step writes over the one before.
        self._follow = jax.jit(follow, donate_argnums=0)

    @property
    def rows(self) -> int:
        """Rows that were kept."""
        return len(self._stamps)

    @property
    def lost(self) -> float:
        """Share of rows that are missing between those kept [%]."""
        seconds = np.unique(self._stamps)
        lost = int(lost_samples(seconds).sum()) if seconds.size > 1 else 0
        return 100.0 * lost / max(lost + seconds.size, 1)

    def take(self, data: bytes) -> None:
        """Take further bytes."""
        self._keep(self.sorter.take(data))

    def finish(self) -> None:
        """Take what was held back for later rows."""
        self._keep(self.sorter.finish())

    def _keep(self, rows: list[Row]) -> None:
        if not rows:
            return
        self.log.parent.mkdir(parents=True, exist_ok=True)
        with self.log.open("ab") as file:
            file.write(b"" if self._stamps else self.sorter.head)
            file.writelines(line + b"\n" for _, line in rows)
        self._stamps += [seconds for seconds, _ in rows]
        self.heard = time.monotonic()

    def update(self, *, last: bool = False) -> bool:
        """Estimate anew if a block was completed since; return if so.

        Args:
            last: True if no row follows.
        """
        elapsed = self._stamps[-1] - self._stamps[0] if self._stamps else 0.0
        if not self._stamps or (elapsed < self._due and not last):
            return False
        self._due = elapsed + self.block
        # An error names the kept log, to which its line belongs.
        flights = self._read(last)
        if self.problem is None or self.state is None:
            return False
        self._samples(flights)
        left = self.state.length - int(self.state.within) + self.state.inputs.shape[0]
        self._due = elapsed + left * self.state.dt
        before = 0 if self.known is None else self.known.blocks
        if int(self.state.blocks) == before:
            return False
        self.known = estimate(self.problem, self.state, self.known)
        return True

    def _read(self, last: bool) -> Sequence[Flight]:
        """Return the flights of the log; make the problem once they move."""
        experiment = self.as_fitted()
        config = experiment.config
        whole = config.flights[0].model_copy(update={"window": None})
        experiment = experiment._replace(config=config.model_copy(update={"flights": [whole]}))
        flights = configuration.read_flights(experiment)

        def moves(signals: Iterable[np.ndarray]) -> bool:
            return any(np.unique(v[np.isfinite(v)]).size > 1 for v in signals)

        begun = moves(v for f in flights for v in f.outputs.values())
        if self._has_inputs:
            begun = begun and moves(v for f in flights for v in f.inputs.values())
        # On the ground nothing moves yet.
        if self.problem is None and (last or begun):
            problem = configuration.problem(experiment)
            with located(f"{self.experiment.path}: fit"):
                self.problem = configuration.by_method(experiment, problem, "frequency-error")
                self.state = init(self.problem, block=self.block)
        return flights

    def as_fitted(self) -> Experiment:
        """Return the configuration with what was received as its log."""
        seconds = np.array(self._stamps)
        experiment = with_log(self.experiment, str(self.log))
        flight = experiment.config.flights[0]
        distinct = np.unique(seconds)
        if distinct.size < 2:
            raise InputError(f"{self.sorter.path}: holds {distinct.size} times, expected a flight")
        steps = np.diff(distinct)
        usual = float(np.median(steps))
        clock = uniform_grid(distinct, rounding_of(distinct)) if distinct.size > 2 else None
        even = distinct.size == seconds.size and isinstance(clock, EvenClock)
        if flight.rate is None and not even:
            # The grid stays when a first gap makes the clock uneven.
            step = usual if self.problem is None else self.problem.training[0].dt
            flight = flight.model_copy(update={"rate": 1.0 / step})
        if steps.max() > _GAP * usual:
            flight = flight.model_copy(update={"gaps": "split"})
        config = experiment.config.model_copy(update={"flights": [flight]})
        return experiment._replace(config=config)

    def _samples(self, flights: Sequence[Flight]) -> None:
        """Take the samples after the last one that was taken, a missing one for each gap."""
        assert self.problem is not None
        inputs = naming.names(self.problem.model.Inputs)
        outputs = sorted(self.problem.training[0].outputs)
        for flight in flights:
            seconds = flight.t0 + flight.dt * np.arange(flight.n_samples)
            new = ~(seconds < self._taken + 0.5 * flight.dt)
            if not new.any():
                continue
            missing = np.full(flight.n_samples, np.nan)
            samples = Sample(
                np.stack([flight.inputs[n] for n in inputs], axis=1)[new],
                np.stack([flight.outputs.get(n, missing) for n in outputs], axis=1)[new],
            )
            if seconds[new][0] > self._taken + 1.5 * flight.dt:
                gap = Sample(*(np.full((1, v.shape[1]), np.nan) for v in samples))
                samples = Sample(*map(np.concatenate, zip(gap, samples, strict=True)))
            self._taken = float(seconds[-1])
            at, count = 0, len(samples.inputs)
            while at < count:
                n = _TOGETHER if count - at >= _TOGETHER else 1
                piece = Sample(*(jnp.asarray(v[at : at + n]) for v in samples))
                self.state, _ = self._follow(self.state, piece)
                at += n


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
                f"{terse(100.0 * one.sd / abs(one.value), 3)} %" if one.value else terse(one.sd, 2),
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
    silent = f"last row {time.monotonic() - follower.heard:.0f} s ago"
    if state is None:
        return [f"waiting for the first seconds in which all signals move; {silent}"]
    samples = int(state.samples)
    lines = [
        f"{samples} samples, {samples * state.dt:.1f} s; {int(state.missing)} gaps, "
        f"{sorter.late} too late, {sorter.repeated} repeated, {follower.lost:.2g} % missing; "
        f"{silent}",
        f"{int(state.blocks)} blocks of {state.length * state.dt:.3g} s"
        + ("" if known else "; estimates follow the first one"),
    ]
    if known is not None:
        each = (f"{y} from {u} {terse(c, 2)}" for (u, y), c in known.coherence.items())
        lines.append(f"coherence: {', '.join(each)}")
        lines.append("flown enough: the sd alone; the report at the end tests the model")
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
        try:
            follower.take(data)
        except InputError as e:
            follower.finish()
            if not log.exists():
                raise
            fit = f"heli-jax fit {experiment.path} --set flights.0.log={log.absolute()}"
            kept = f"{log} has the {follower.rows} rows before it: {fit}"
            raise InputError(f"{str(e).rstrip('.')}; {kept}") from e
        due = sys.stdout.isatty() and time.monotonic() - shown > _EVERY
        if follower.update() or due:
            _show(follower, wanted)
            shown = time.monotonic()
    follower.finish()
    if follower.update(last=True):
        _show(follower, wanted)
    if not log.exists():
        raise InputError(f"{place}: no whole rows were received, expected a table with a header")
    return follower.as_fitted()
