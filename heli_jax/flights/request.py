"""What is asked of a log, checked before the log is read."""

import math
from collections.abc import Mapping

from heli_jax import units
from heli_jax.flights.flight import HOLDS, Signal
from heli_jax.flights.table import column, wrong


class Request:
    """The signals, the rate and the window that a user wants from a log.

    Raises:
        InputError: a column has two uses, a unit does not fit, a number makes no sense.
    """

    def __init__(
        self,
        path: str,
        time: str | Signal,
        inputs: Mapping[str, Signal],
        outputs: Mapping[str, Signal],
        rate: float | None,
        window: tuple[float, float] | None,
        known: Mapping[str, float],
    ) -> None:
        self.path, self.rate, self.known = path, rate, known
        self.time = Signal(time, "s", "s") if isinstance(time, str) else time
        self.signals = {(key, "input"): signal for key, signal in inputs.items()}
        self.signals |= {(key, "output"): signal for key, signal in outputs.items()}
        if not self.signals:
            raise wrong(path, "no input or output is asked for, expected at least one")
        self._check_columns()
        self._check_units()
        self._check_noise()
        self._check_holds()
        self._check_numbers(window)

    @property
    def columns(self) -> list[str]:
        """The columns to read, each once, the time first."""
        return list(dict.fromkeys([self.time.name, *(s.name for s in self.signals.values())]))

    def noise(self) -> dict[str, float]:
        """The stated noise of the outputs, in SI."""
        return {
            key: signal.sd * abs(units.factor(signal.unit, signal.si))
            for (key, kind), signal in self.signals.items()
            if kind == "output" and signal.sd is not None
        }

    def _check_columns(self) -> None:
        uses = {self.time.name: ("time", "the time")}
        for (key, kind), signal in self.signals.items():
            use = (kind, f"{kind} {key!r}")
            before = uses.setdefault(signal.name, use)
            if before != use and not before[0] == kind == "input":
                problem = f"serves both as {before[1]} and as {use[1]}, expected one use"
                raise wrong(self.path, problem, column(signal.name))

    def _check_units(self) -> None:
        signals = {f"{kind} {key!r}": s for (key, kind), s in self.signals.items()}
        signals["the time"] = Signal(self.time.name, self.time.unit, "s")
        for use, signal in signals.items():
            try:
                units.factor(signal.unit, signal.si)
            except ValueError as e:
                raise wrong(self.path, f"for {use}: {e}", column(signal.name)) from e

    def _check_noise(self) -> None:
        for (key, kind), signal in self.signals.items():
            sd = signal.sd
            if sd is None:
                continue
            use = f"{kind} {key!r}"
            if kind == "input":
                problem = f"an sd is stated for {use}, expected one for outputs alone"
                raise wrong(self.path, problem, column(signal.name))
            scale = abs(units.factor(signal.unit, signal.si))
            if not (sd > 0 and 0 < sd * scale < math.inf):
                problem = f"the sd of {use} is {sd:g}, expected a positive number"
                raise wrong(self.path, problem, column(signal.name))

    def _check_holds(self) -> None:
        for (key, kind), signal in self.signals.items():
            use = f"{kind} {key!r}"
            if kind == "output" and signal.hold != "auto":
                problem = f"a hold is stated for {use}, expected is one for inputs alone"
                raise wrong(self.path, problem, column(signal.name))
            if signal.hold not in ("auto", *HOLDS):
                known = ", ".join(("auto", *HOLDS))
                problem = f"the hold of {use}: expected one of {known}, got {signal.hold!r:.60}"
                raise wrong(self.path, problem, column(signal.name))

    def _check_numbers(self, window: tuple[float, float] | None) -> None:
        if self.rate is not None and not (self.rate > 0 and math.isfinite(self.rate)):
            raise wrong(self.path, f"rate is {self.rate:g}, expected a positive number in Hz")
        if window is not None:
            wanted = "expected two increasing numbers of seconds"
            if len(window) != 2 or not all(math.isfinite(w) for w in window):
                raise wrong(self.path, f"window is {list(window)}, {wanted}")
            if not window[0] < window[1]:
                raise wrong(self.path, f"window is empty or reversed, {list(window)}, {wanted}")
        for name, value in self.known.items():
            if not math.isfinite(value):
                problem = f"known {name!r} is {value:g}, expected a finite number"
                raise wrong(self.path, problem)
