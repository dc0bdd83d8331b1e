"""Flight: uniformly sampled inputs and outputs, from any log."""

import functools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from heli_jax import units
from heli_jax.finding import Finding
from heli_jax.flights.log import shown
from heli_jax.flights.signal_facts import SignalFacts, facts_of_all
from heli_jax.numbers import number

HOLDS = ("zero-order", "linear", "mixed")
_BY_NAME = {
    **dict.fromkeys(("inputs", "outputs", "instruments"), "arrays by name, as {'p': p}"),
    **dict.fromkeys(("sd", "known"), "numbers by name, as {'p': 0.01}"),
    "hold": f"{' or '.join(HOLDS)} by input, as {{'lat': 'linear'}}",
}
"""Description of the expected values, for messages."""


@dataclass(frozen=True)
class Signal:
    """One signal of a log: (number in the log - `offset`) `scale` in `unit`, inverted or not.

    Attributes:
        name: name of the column in the log; empty for a constant.
        unit: unit, such as `deg`.
        si: SI unit of the model, such as `rad`.
        sd: stated standard deviation of the measurement noise, in `unit`; for outputs only.
        hold: behaviour of an input between samples: "zero-order", "linear", "mixed" (held until it
            jumps, else linear), or "auto" (decided from the log).
        repeats: treatment of an output's repeated values: "missing" (a slow sensor in a fast
            table), "keep", or "auto" (missing if unmistakable).
        scale: `unit` per number in the log.
        offset: offset in the log's own numbers, such as 1500 for a PWM.
        invert: True if the sign is reversed.
        constant: value in `unit` of an input that the log lacks.
        missing: numbers of the log that mean no value. An output is missing there; an input keeps
            its previous value.
        assumed: True if the unit was not stated, so that the file's unit overrides it.
        origin: source of unit, axes and sign, in words, if a preset states them.
        contradicted: unit that the file states, if it differs from `unit`.
    """

    name: str
    unit: str
    si: str
    sd: float | None = None
    hold: str = "auto"
    repeats: str = "auto"
    scale: float = 1.0
    offset: float = 0.0
    invert: bool = False
    constant: float | None = None
    missing: tuple[float, ...] = ()
    assumed: bool = False
    origin: str = ""
    contradicted: str = ""

    def to_si(self, numbers: np.ndarray) -> np.ndarray:
        """Return numbers of the log (N,) in SI.

        Raises:
            ValueError: the unit is unknown or of the wrong kind.
        """
        # Without an offset, the log's numbers stay bit-identical.
        if self.offset:
            numbers = numbers - self.offset
        return numbers * self._factor

    def from_si(self, values: np.ndarray) -> np.ndarray:
        """Return the log's numbers (N,) for values in SI: the inverse of `to_si`."""
        return values / self._factor + self.offset

    @property
    def _factor(self) -> float:
        sign = -1.0 if self.invert else 1.0
        return sign * self.scale * units.factor(self.unit, self.si)


def scale_problem(signal: Signal) -> str:
    """Return why the scale or the offset of a signal is wrong; empty if neither is."""
    # A scale of zero would make the signal constant, and 1e300 would overflow.
    if not 1e-12 <= abs(signal.scale) <= 1e12:
        return f"scale is {signal.scale:g}, expected a number other than 0 from 1e-12 to 1e12"
    if not abs(signal.offset) <= 1e12:
        return f"offset is {signal.offset:g}, expected at most 1e12"
    # Two minus signs are more likely a slip than intended.
    if signal.invert and signal.scale < 0:
        return f"scale is {signal.scale:g} and invert is true, expected one of the two"
    return ""


def in_words(signal: Signal) -> str:
    """Describe a signal in the log: `'RCIN.C1', (number - 1500) x 0.002 in 1, inverted`."""
    if signal.constant is not None:
        words = f"{number(signal.constant, 6)} {_unit(signal)}".rstrip() + ", a constant"
    else:
        steps = f"number - {number(signal.offset, 6)}" if signal.offset else "number"
        if signal.scale != 1.0:
            steps = f"({steps})" if signal.offset else steps
            steps += f" x {number(signal.scale, 6)}"
        words = shown(signal.name) + ("" if steps == "number" else f", {steps}")
        words += f", in {signal.unit}" if _unit(signal) else ""
        words += ", inverted" if signal.invert else ""
    return f"{words}; {signal.origin}" if signal.origin else words


def _unit(signal: Signal) -> str:
    return "" if signal.unit.strip() in ("", "1", "-") else signal.unit


def as_content(signal: Signal) -> dict[str, str | float | bool | None]:
    """Return a signal as plain data, for `fit.json`."""
    if signal.constant is not None:
        return {"constant": signal.constant, "unit": signal.unit, "origin": signal.origin}
    return {
        "signal": signal.name,
        "unit": signal.unit,
        "scale": signal.scale,
        "offset": signal.offset,
        "invert": signal.invert,
        "origin": signal.origin,
    }


@dataclass(frozen=True)
class Source:
    """Origin of a flight: the file, its hash, and the reader's assumptions and corrections.

    Attributes:
        path: path of the file.
        sha256: SHA-256 of the file.
        notes: the reader's assumptions and actions.
        firmware: firmware of the autopilot that wrote the log.
        parameters: parameters of that autopilot, by name.
        cautions: causes of bias in any fit to the log, repeated by every fit.
        inputs: signals of the log by the model's name of the input.
        outputs: likewise for outputs.
        first_time: zero of the log's windows [s], in the log's own count.
        facts: facts of each signal before resampling, by the model's name and `input` or `output`.
    """

    path: str
    sha256: str
    notes: tuple[Finding, ...] = ()
    firmware: str = ""
    parameters: Mapping[str, str | int | float] = field(default_factory=dict)
    cautions: tuple[Finding, ...] = ()
    inputs: Mapping[str, Signal] = field(default_factory=dict)
    outputs: Mapping[str, Signal] = field(default_factory=dict)
    first_time: float = 0.0
    facts: Mapping[tuple[str, str], SignalFacts] = field(
        default_factory=dict, compare=False, repr=False
    )


@dataclass(frozen=True, eq=False)
class Flight:
    """One run on a uniform time grid, in SI units.

    The arrays are copied and made read-only.

    Attributes:
        dt: time between samples [s].
        inputs: samples (N,) by the model's name.
        outputs: samples (N,) by the model's name; NaN where one is missing.
        t0: time in the log of the first sample [s].
        sd: standard deviation of the measurement noise by output, only if stated.
        known: parameters that differ in this run, SI.
        hold_out: True if the run is for validation only.
        name: name of the run.
        source: origin of the run, if it was read from a log.
        hold: behaviour of each input between samples: "zero-order" (holds until the next sample;
            the default), "linear", or "mixed" (held in intervals that end in a jump, else linear;
            see `heli_jax.numerics.jumps`).
        hold_reason: reason for the hold by input, if it was decided from the log.
        choose_windows: True to fit the run's most informative windows instead.
        instruments: samples (N,) by input of an excitation that was added to it and that no
            feedback reaches, such as the autopilot's chirp, SI.

    Raises:
        ValueError: `dt` is not positive; there is no signal; a signal is not of shape (N,) or not
            finite (outputs may be NaN); `sd` names no output or is not positive; `known` is not
            finite; `hold` names no input or no hold.
    """

    dt: float
    inputs: dict[str, np.ndarray]
    outputs: dict[str, np.ndarray]
    t0: float = 0.0
    sd: dict[str, float] = field(default_factory=dict)
    known: dict[str, float] = field(default_factory=dict)
    hold_out: bool = False
    name: str = ""
    source: Source | None = None
    hold: dict[str, str] = field(default_factory=dict)
    hold_reason: dict[str, str] = field(default_factory=dict)
    choose_windows: bool = False
    instruments: dict[str, np.ndarray] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for kind, expected in _BY_NAME.items():
            value = getattr(self, kind)
            if not isinstance(value, Mapping):
                got = repr(value)[:60] if isinstance(value, str) else type(value).__name__
                raise TypeError(f"{kind}: expected {expected}, got {got}")
        if isinstance(self.dt, str):
            raise TypeError(f"dt is {self.dt!r}, expected a number of seconds")
        if not (math.isfinite(self.dt) and self.dt > 0):
            raise ValueError(f"dt is {self.dt}, expected a positive number of seconds")
        if not math.isfinite(self.t0):
            raise ValueError(f"t0 is {self.t0}, expected a finite number of seconds")
        # By object.__setattr__, because the class is frozen: a fitted flight must not change later.
        for kind in ("inputs", "outputs", "instruments"):
            gaps = kind == "outputs"
            signals = {name: _samples(name, x, gaps) for name, x in getattr(self, kind).items()}
            object.__setattr__(self, kind, signals)
        lengths = {name: x.size for name, x in (*self.inputs.items(), *self.outputs.items())}
        lengths |= {f"instrument of {name}": x.size for name, x in self.instruments.items()}
        if not lengths:
            raise ValueError("a flight needs at least one input or output")
        # One grid for all signals: the time of a sample is its index times dt.
        if len(set(lengths.values())) > 1:
            raise ValueError(f"the signals differ in length: {lengths}")
        object.__setattr__(self, "sd", dict(self.sd))
        object.__setattr__(self, "known", dict(self.known))
        self._check_numbers()
        self._check_holds()

    def _check_numbers(self) -> None:
        for name in self.instruments:
            if name not in self.inputs:
                raise ValueError(f"an instrument of {name!r}, which is no input of this flight")
        for name, sd in self.sd.items():
            if name not in self.outputs:
                raise ValueError(f"sd is stated for {name!r}, which is no output of this flight")
            # Residuals are divided by sd.
            if not (math.isfinite(sd) and sd > 0):
                raise ValueError(f"sd of {name!r} is {sd}, expected a positive number")
        for name, value in self.known.items():
            if not math.isfinite(value):
                raise ValueError(f"known {name!r} is {value}, expected a finite number")

    def _check_holds(self) -> None:
        for name, value in self.hold.items():
            if name not in self.inputs:
                raise ValueError(f"hold is stated for {name!r}, which is no input of this flight")
            if value not in HOLDS:
                raise ValueError(
                    f"hold of {name!r}: expected one of {', '.join(HOLDS)}, got {value!r:.60}"
                )
        # Every input gets an explicit hold, so that no reader of a flight needs the default.
        object.__setattr__(self, "hold", {**dict.fromkeys(self.inputs, HOLDS[0]), **self.hold})
        object.__setattr__(self, "hold_reason", dict(self.hold_reason))

    @property
    def n_samples(self) -> int:
        """N, the number of samples of every signal."""
        return next(iter((*self.inputs.values(), *self.outputs.values()))).size

    @property
    def times(self) -> np.ndarray:
        """Time of each sample from the first one, shape (N,) [s]."""
        return self.dt * np.arange(self.n_samples)

    @property
    def window(self) -> tuple[float, float]:
        """First and last time [s] from the log's beginning, or else the flight's own."""
        start = self.t0 - (self.source.first_time if self.source else self.t0)
        return start, start + self.duration

    @property
    def duration(self) -> float:
        """Time from the first sample to the last [s]."""
        return self.dt * (self.n_samples - 1)

    def logged_step(self, name: str, kind: str) -> float:
        """Return the usual time between a signal's samples as logged [s]; `dt` if unknown."""
        facts = self.source.facts.get((name, kind)) if self.source else None
        return facts.usual if facts is not None and facts.usual > 0 else self.dt

    @functools.cached_property
    def facts(self) -> dict[tuple[str, str], SignalFacts]:
        """Facts of each signal by name and kind, as logged if that is known."""
        known = self.source.facts if self.source else {}
        signals = {(n, "input"): u for n, u in self.inputs.items()}
        signals |= {(n, "output"): y for n, y in self.outputs.items()}
        if signals.keys() <= known.keys():
            return {key: known[key] for key in signals}
        timed = {key: (self.times, x) for key, x in signals.items()}
        outputs = frozenset(key for key in signals if key[1] == "output")
        return {**facts_of_all(timed, outputs), **{k: known[k] for k in signals if k in known}}

    def __repr__(self) -> str:
        from heli_jax.summaries import of_flight

        return of_flight(self)


def _samples(name: str, values: np.ndarray, gaps: bool) -> np.ndarray:
    if np.iscomplexobj(values):
        raise ValueError(f"{name!r} is complex, expected real numbers")
    # A read-only copy: the caller's array may change after the flight has been checked.
    samples = np.array(values, dtype=np.float64)
    if samples.ndim != 1 or samples.size == 0:
        raise ValueError(f"{name!r} has shape {samples.shape}, expected (N,) with N >= 1")
    # NaN in an output is a missing sample; an input acts all the time.
    bad = np.flatnonzero(np.isinf(samples) if gaps else ~np.isfinite(samples))
    if bad.size:
        raise ValueError(f"{name!r} is {samples[bad[0]]} at sample {bad[0]}, expected numbers")
    samples.setflags(write=False)
    return samples


def labels(flights: Sequence[Flight]) -> list[str]:
    """Return a label for each flight; repeated names get a number."""
    names = [f.name or f"flight {i + 1}" for i, f in enumerate(flights)]
    # Two logs may have the same name. Results are kept by label, so one would hide the other.
    before = [names[:i].count(name) for i, name in enumerate(names)]
    return [f"{name} ({k + 1})" if k else name for name, k in zip(names, before, strict=True)]


# Instruments of flights: excitations that were added to inputs and logged.

_SAME = 1e-6
"""Largest share of an input's power outside its instrument, if the two count as one signal."""


def own_instruments(flights: Sequence[Flight], names: Sequence[str]) -> tuple[str, ...]:
    """Return the inputs whose instrument is the input itself in every flight in which it moves.

    Such an instrument is the stick with all feedback in it.
    """
    held = [n for n in names if all(n in f.instruments and n in f.inputs for f in flights)]
    own = []
    for name in held:
        same = []
        for flight in flights:
            u, r = (np.asarray(v[name], float) for v in (flight.inputs, flight.instruments))
            u, r = u - np.mean(u), r - np.mean(r)
            if np.any(u) or np.any(r):
                both = float(u @ r) ** 2
                same.append(both > 0 and 1.0 - both / float(u @ u) / float(r @ r) < _SAME)
        if same and all(same):
            own.append(name)
    return tuple(own)


def own_instrument_note(names: Sequence[str]) -> str:
    """Return the note about instruments that are the input itself."""
    return (
        f"instrument of {', '.join(names)}: it is the input itself, which feedback correlates "
        "with gusts; expected the excitation alone, before pilot or autopilot add to it"
    )
