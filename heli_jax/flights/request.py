"""Request for the signals of a log, checked before the log is read.

A log can take minutes to read; a wrong unit or a reversed window is reported at once.
"""

import copy
import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass, field

from heli_jax import units
from heli_jax.finding import Finding, note
from heli_jax.flights.derived import Swashplate
from heli_jax.flights.flight import HOLDS, Signal, scale_problem
from heli_jax.flights.log import ChannelLog, Table, column, shown, wrong
from heli_jax.flights.marks import REPEATS
from heli_jax.flights.name_units import without_unit

Key = tuple[str, str]
"""The model's name, and `input` or `output`."""
FEWEST = 8
"""Fewest samples in a run."""


@dataclass(frozen=True)
class Also:
    """A further log of the same flight, whose clock may be independent of the first one's.

    Attributes:
        path: path of the log.
        same: signal of the first log, by the model's name, that both hold; empty if both have one
            clock.
        to: column or channel of the same motion in this log, in any unit.
        inputs: signals to take from this log, by the model's names.
        outputs: the same for measured outputs.
        time: column of time stamps of a table.
        number: number of the flight in a file that holds several, from 1.
        reverse: True if `to` has the opposite sign.
        log: the log itself, if it is already open.
    """

    path: str
    same: str = ""
    to: str = ""
    inputs: Mapping[str, Signal] = field(default_factory=dict)
    outputs: Mapping[str, Signal] = field(default_factory=dict)
    time: Signal | None = None
    number: int | None = None
    reverse: bool = False
    log: ChannelLog | Table | None = None


@dataclass(frozen=True)
class ReadOptions:
    """Options of `read_flight`; each field is also its keyword."""

    rate: float | None = None
    """Rate to resample to [Hz]; without it the stamps must be a uniform grid."""
    window: tuple[float, float] | None = None
    """First and last time to use [s], counted from the log's first sample."""
    known: Mapping[str, float] | None = None
    """Parameters that differ in this run, SI."""
    hold_out: bool = False
    """True if the run is for validation only."""
    name: str = ""
    """Name of the run."""
    number: int | None = None
    """Number of the flight in a file that holds several, from 1."""
    also: tuple[Also, ...] = ()
    """Further logs of the same flight, aligned with this one; they need a rate."""
    follows: Mapping[tuple[str, str], bool] = field(default_factory=dict)
    """Pairs (input, output) in which the output follows the input within a sample. The value is
    True if it follows without delay. Such held inputs are low-passed like the output."""
    runs: str = ""
    """Column of a table that numbers its runs."""
    swashplate: Swashplate | None = None
    """Geometry of the channels `ccpm.collective`, `ccpm.roll` and `ccpm.pitch`."""
    split: bool = False
    """True if runs, separated by a time that begins anew, become separate flights."""


def require_rate_and_window(
    path: str, rate: float | None, window: tuple[float, float] | None
) -> None:
    """Refuse an invalid rate or window."""
    # NaN passes no comparison, so each condition states what must hold.
    if rate is not None and not (rate > 0 and math.isfinite(rate)):
        raise wrong(path, f"rate is {rate:g}, expected a positive number in Hz")
    if window is not None and not (
        len(window) == 2 and all(map(math.isfinite, window)) and window[0] < window[1]
    ):
        problem = f"window is {list(window)}, expected two increasing numbers of seconds"
        raise wrong(path, problem)


class Request:
    """Signals, rate and window to read from a log."""

    def __init__(
        self,
        path: str,
        time: str | Signal | None,
        inputs: Mapping[str, Signal],
        outputs: Mapping[str, Signal],
        options: ReadOptions,
    ) -> None:
        self.path, self.options = path, options
        self.known = dict(options.known or {})
        self.time = Signal(time, "s", "s", assumed=True) if isinstance(time, str) else time
        # By name and kind: a model may give an input and an output the same name.
        self.signals = {(key, "input"): signal for key, signal in inputs.items()}
        self.signals |= {(key, "output"): signal for key, signal in outputs.items()}
        if not self.signals:
            raise wrong(path, "no input or output is asked for, expected at least one")
        # Columns first: a column with two uses makes further messages about it doubtful.
        self._check_columns()
        uses = {f"{kind} {key!r}": signal for (key, kind), signal in self.signals.items()}
        if self.time is not None:
            uses = {"the time": Signal(self.time.name, self.time.unit, "s"), **uses}
        for use, signal in uses.items():
            if problem := _problem(use, signal):
                raise wrong(path, problem, column(signal.name))
        require_rate_and_window(path, options.rate, options.window)
        for name, value in self.known.items():
            if not math.isfinite(value):
                raise wrong(path, f"known {name!r} is {value:g}, expected a finite number")

    def of_kind[V](self, kind: str, samples: Mapping[tuple[str, str], V]) -> dict[str, V]:
        """Return the samples of inputs or of outputs by the model's name, in the user's order."""
        return {key: samples[key, each] for key, each in self.signals if each == kind}

    def noise(self) -> dict[str, float]:
        """Return the stated noise of the outputs, in SI."""
        # abs: a unit may flip the sign of a signal, but a standard deviation has none.
        return {
            key: signal.sd * abs(units.factor(signal.unit, signal.si))
            for (key, kind), signal in self.signals.items()
            if kind == "output" and signal.sd is not None
        }

    def _check_columns(self) -> None:
        # Two inputs may share a column. Any other double use is a slip: a column that is input and
        # output at once would be fitted perfectly, without information.
        uses = {} if self.time is None else {self.time.name: ("time", "the time")}
        for (key, kind), signal in self.signals.items():
            use = (kind, f"{kind} {key!r}")
            before = uses.setdefault(signal.name, use)
            if before != use and not before[0] == kind == "input":
                problem = f"is used both as {before[1]} and as {use[1]}, expected one use"
                raise wrong(self.path, problem, column(signal.name))


def _problem(use: str, signal: Signal) -> str:
    """Return why a signal is wrong for a use such as `input 'u'`; empty if it is not."""
    try:
        scale = abs(units.factor(signal.unit, signal.si))
    except ValueError as e:
        return f"for {use}: {e}"
    if problem := scale_problem(signal):
        return f"{use}: {problem}"
    is_input, is_output = use.startswith("input "), use.startswith("output ")
    # Only outputs have noise in the estimators; an input is used as logged. A repeated input value
    # is real, and its hold applies.
    for what, stated, elsewhere in (
        ("an sd", signal.sd is not None, is_input),
        ("repeats", signal.repeats != "auto", is_input),
        ("a hold", signal.hold != "auto", is_output),
    ):
        if stated and elsewhere:
            others = "outputs" if is_input else "inputs"
            return f"{what} is stated for {use}, expected it for {others} alone"
    # In SI too: 1e-320 deg is positive but zero in rad, and residuals are divided by it.
    if signal.sd is not None and not (signal.sd > 0 and 0 < signal.sd * scale < math.inf):
        return f"the sd of {use} is {signal.sd:g}, expected a positive number"
    for what, got, known in (
        ("hold", signal.hold, ("auto", *HOLDS)),
        ("repeats", signal.repeats, REPEATS),
    ):
        if got not in known:
            return f"{what} of {use}: expected one of {', '.join(known)}, got {got!r:.60}"
    return ""


# The unit that a file states for a signal is used if none is configured, else compared with the
# configured one.


def with_file_units(log: ChannelLog, request: Request) -> Request:
    """Return the request with the file's units if none was stated, or if they contradict."""
    made = copy.copy(request)
    made.signals = {
        key: _with_file_unit(log, signal, key[0]) for key, signal in request.signals.items()
    }
    return made


def _with_file_unit(log: ChannelLog, signal: Signal, name: str) -> Signal:
    stated = log.topic_of(signal.name).units.get(signal.name, "").strip()
    if not stated and (named := without_unit(signal.name)[1]) and signal.scale == 1.0:
        # A name states less than a file: it is no unit to read by, and `lat_A` may be no current.
        fits = units.fits(named, signal.unit) and units.factor(named, signal.unit) != 1.0
        return dataclasses.replace(signal, contradicted=named) if fits else signal
    # A stated scale already includes the unit.
    if signal.scale != 1.0 or (signal.assumed and signal.offset) or stated in ("", "-", "1"):
        return signal
    known = units.is_unit(stated)
    try:
        same = math.isclose(units.factor(stated, signal.si if signal.assumed else signal.unit), 1.0)
    # The file's unit may be unknown here.
    except ValueError as e:
        same = not known
        if signal.assumed and known:
            problem = f"{name} has no stated unit, and the file states another: {e}"
            remedy = "state unit, with scale and offset where numbers have to be converted"
            raise wrong(log.path, f"{problem}; {remedy}", column(signal.name)) from e
    if same:
        return signal
    return dataclasses.replace(signal, **{"unit" if signal.assumed else "contradicted": stated})


def other_units(request: Request) -> list[Finding]:
    """Return notes on units that the file and the configuration state differently."""
    return [
        note(
            "units.contradicted",
            f"{name}: {shown(signal.name)} is taken in {signal.unit or '1'}, as configured;"
            f" the file states {shown(signal.contradicted)}",
            name,
        )
        for (name, _), signal in request.signals.items()
        if signal.contradicted
    ]


def unit_note(name: str, signal: Signal) -> Finding | None:
    """Return a note on a signal that is read in the file's unit; None for others."""
    if not signal.assumed or signal.unit == signal.si:
        return None
    words = f"no unit stated, {shown(signal.name)} taken in {signal.unit}, as the file states"
    return note("units.assumed", f"{name}: {words}", name)
