"""Presets: tables in YAML files that map an autopilot's channels to signals.

`presets/signals.yaml` defines the signals and the models' inputs and outputs that they are. Each
other file there is the table of one autopilot.
"""

import functools
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib import resources
from importlib.resources.abc import Traversable
from typing import NamedTuple

from heli_jax.errors import nearest
from heli_jax.finding import Finding, note
from heli_jax.flights.derived import sources
from heli_jax.flights.flight import Signal
from heli_jax.flights.log import ChannelLog, Table, wrong
from heli_jax.yaml_file import parse_mapping

_SIGNALS = "signals"
_FEWEST = 8
"""Fewest samples of a topic, as for a fit; a topic published twice is no signal."""
# First part of a dotted name: a topic, which may have instances.
_TOPIC = re.compile(r"(?<![\w.\])])([A-Za-z_]\w*)\.(?=[A-Za-z_])")


@dataclass(frozen=True)
class Alternative:
    """One channel that a signal may be: (number - offset) scale in `unit`, inverted or not.

    Attributes:
        channel: name as in a configuration; a topic without an instance matches any instance.
        unit: unit of the signal.
        scale: factor in the formula above.
        offset: offset in the channel's own unit.
        invert: True if the sign is reversed.
        instance: instance of its topic, if the log has several.
        stated: True if the log itself must state the unit.
        source: source of unit, axes and sign.
    """

    channel: str
    unit: str
    scale: float = 1.0
    offset: float = 0.0
    invert: bool = False
    instance: int = 0
    stated: bool = False
    source: str = ""


@dataclass(frozen=True)
class Preset:
    """Table of one autopilot.

    Attributes:
        name: name as in a configuration.
        version: version of the table.
        formats: log formats it applies to.
        meaning: the firmware, in words.
        signals: channels that each signal may be, the best first.
        missing: reason why a signal is absent, if there is one.
    """

    name: str
    version: int
    formats: tuple[str, ...]
    meaning: str
    signals: Mapping[str, tuple[Alternative, ...]]
    missing: Mapping[str, str] = field(default_factory=dict)

    @property
    def title(self) -> str:
        """Name and version."""
        return f"{self.name} (version {self.version})"


@dataclass(frozen=True)
class ModelSignal:
    """Source of a model's input: the autopilot's command, or the pilot's stick."""

    command: str
    stick: str
    invert: bool = False


@dataclass(frozen=True)
class Meaning:
    """Definition of a signal: its SI unit, and its axes and sign in words."""

    unit: str
    meaning: str


def _files() -> list[Traversable]:
    folder = resources.files("heli_jax.flights").joinpath("presets")
    return [file for file in folder.iterdir() if file.name.endswith(".yaml")]


@functools.cache
def presets() -> tuple[str, ...]:
    """Return the names of the presets in the package."""
    # From the files, so that a new preset needs no entry in a list.
    names = [file.name.removesuffix(".yaml") for file in _files()]
    return tuple(sorted(name for name in names if name != _SIGNALS))


@functools.cache
def _content(name: str) -> dict:
    file = next(file for file in _files() if file.name == f"{name}.yaml")
    return parse_mapping(file.read_text(encoding="utf-8"), f"preset {name}")


@functools.cache
def preset(name: str) -> Preset:
    """Return the preset of that name.

    Raises:
        ValueError: there is none; names the nearest.
    """
    if name not in presets():
        raise ValueError(f"no preset {name!r:.60}{nearest(name, presets())}")
    content = _content(name)
    titles = content["sources"]
    signals = {
        signal: tuple(Alternative(**{**a, "source": titles[a["source"]]}) for a in alternatives)
        for signal, alternatives in content["signals"].items()
    }
    return Preset(
        name,
        content["version"],
        tuple(content["formats"]),
        content["meaning"],
        signals,
        content.get("missing", {}),
    )


@functools.cache
def meanings() -> Mapping[str, Meaning]:
    """Return the definitions of the signals by name."""
    return {name: Meaning(**m) for name, m in _content(_SIGNALS)["signals"].items()}


@functools.cache
def model_inputs() -> Mapping[str, ModelSignal]:
    """Return the signals that a model's input may be, by the input's name."""
    return {name: ModelSignal(**m) for name, m in _content(_SIGNALS)["inputs"].items()}


@functools.cache
def model_outputs() -> Mapping[str, str]:
    """Return the signal that a model's output is, by the output's name."""
    return _content(_SIGNALS)["outputs"]


def choose(log: Table | ChannelLog, alternatives: Sequence[Alternative]) -> Alternative | None:
    """Return the first alternative in a log, with the channel's name in this log; else None."""
    names = frozenset(log.names)
    topics = {t.name for t in log.topics} if isinstance(log, ChannelLog) else set()
    for alternative in alternatives:
        channel = _with_instances(alternative, topics)
        needed = sources(channel, names)
        if not all(n in names for n in needed):
            continue
        if isinstance(log, ChannelLog) and not _serves(log, needed, alternative):
            continue
        return replace(alternative, channel=channel)
    return None


def _with_instances(alternative: Alternative, topics: set[str]) -> str:
    def numbered(match: re.Match[str]) -> str:
        several = f"{match[1]}[{alternative.instance}]"
        return f"{several}." if match[1] not in topics and several in topics else match[0]

    return _TOPIC.sub(numbered, alternative.channel)


def _serves(log: ChannelLog, needed: Sequence[str], alternative: Alternative) -> bool:
    topics = [ChannelLog.topic_of(log, name) for name in needed]
    if any(t.times.size < _FEWEST or not t.clock for t in topics):
        return False
    # A count whose unit the header does not state could scale a fit by a wrong factor.
    return not alternative.stated or topics[0].units.get(needed[0]) == alternative.unit


def fitting_presets(log_format: str, names: Sequence[str]) -> list[str]:
    """Return the presets for a format whose roll rate and roll command are in the log."""
    # The reader separates instances; here any instance counts.
    bare = {*names, *(re.sub(r"^(\w+)\[\d+\]\.", r"\1.", name) for name in names)}
    return [
        name
        for name in presets()
        if log_format in preset(name).formats
        and all(
            any(set(sources(a.channel, bare)) <= bare for a in preset(name).signals[signal])
            for signal in ("roll_rate", "cyclic_roll")
        )
    ]


# Assignment of channels to columns by a preset.


class Named(NamedTuple):
    """Columns by name, each with its channel, in SI."""

    signals: Mapping[str, Signal]
    notes: tuple[Finding, ...] = ()
    """Notes on the columns that are absent."""


type NamedBy = Callable[[Table | ChannelLog], Named]


def by_preset(name: str) -> NamedBy:
    """Return a function that finds all signals of a preset in a log, under the preset's names.

    Raises:
        ValueError: there is no preset of this name.
    """
    table = preset(name)

    def named(log: Table | ChannelLog) -> Named:
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
        return Named(signals, notes)

    return named
