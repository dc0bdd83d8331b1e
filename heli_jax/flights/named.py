"""Which channels of a log become which columns, as a preset or a configuration names them."""

from collections.abc import Callable, Mapping
from typing import NamedTuple

from heli_jax.finding import Finding, note
from heli_jax.flights.derived import DerivedLog, DerivedTable
from heli_jax.flights.flight import Signal
from heli_jax.flights.preset import choose, meanings, preset, presets
from heli_jax.flights.table import wrong


class Named(NamedTuple):
    """Columns by name, each with the channel that it is in SI."""

    signals: Mapping[str, Signal]
    notes: tuple[Finding, ...] = ()
    """what is not among them"""
    required: bool = True
    """whether a channel without a usable clock is an error; it is left out otherwise"""


type NamedBy = Callable[[DerivedTable | DerivedLog], Named]


def by_preset(name: str) -> NamedBy:
    """All signals of a preset that a log has, under the preset's names.

    Raises:
        ValueError: there is none of this name.
    """
    table = preset(name)

    def named(log: DerivedTable | DerivedLog) -> Named:
        chosen = {signal: choose(log, each) for signal, each in table.signals.items()}
        signals = {
            signal: Signal(
                each.channel,
                each.unit,
                meanings()[signal].unit,
                scale=each.scale,
                offset=each.offset,
                invert=each.invert,
                origin=each.source,
            )
            for signal, each in chosen.items()
            if each is not None
        }
        if not signals:
            fitting = [n for n in presets() if log.format in preset(n).formats and n != name]
            instead = f"preset {' or '.join(fitting)}, or " if fitting else ""
            problem = f"holds no channel of preset {table.name}, expected {instead}--signals"
            raise wrong(log.path, problem)
        lacking = [signal for signal in chosen if signal not in signals]
        words = f"preset {table.title}: the log has no {', '.join(lacking)}"
        notes = (note("channels.lacking", words, *lacking),) if lacking else ()
        return Named(signals, notes, required=False)

    return named
