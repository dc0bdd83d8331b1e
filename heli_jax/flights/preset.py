"""Presets: which channels of an autopilot's log are which signals, as tables in YAML files.

`presets/signals.yaml` says what the signals mean and which inputs and outputs of models they are;
each other file there is the table of one autopilot.
"""

import functools
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
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
"""samples of a topic, as for a fit: what was published twice is no signal"""
# The first name of each dotted one: that of a topic, which may have instances.
_TOPIC = re.compile(r"(?<![\w.\])])([A-Za-z_]\w*)\.(?=[A-Za-z_])")


@dataclass(frozen=True)
class Alternative:
    """One channel that a signal may be: (number - offset) scale in `unit`, inverted or not.

    Attributes:
        channel: as a configuration names it; a topic without an instance stands for any number.
        unit: of the signal.
        scale: see above.
        offset: in the channel's own unit.
        invert: whether its sign is the other one.
        instance: of its topic, where the log has several.
        stated: whether the log itself has to state the unit.
        source: of unit, axes and sign.
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
    """The table of one autopilot.

    Attributes:
        name: as a configuration has it.
        version: of the table.
        formats: of the logs it is for.
        meaning: which firmware, in words.
        signals: the channels that each may be, the best first.
        missing: why a signal is not there, where there is a reason to tell.
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
    """Meaning of a signal: its SI unit, and axes and sign in words."""

    unit: str
    meaning: str


def _files() -> list[Traversable]:
    folder = resources.files("heli_jax.flights").joinpath("presets")
    return [file for file in folder.iterdir() if file.name.endswith(".yaml")]


@functools.cache
def presets() -> tuple[str, ...]:
    """The names of those that ship."""
    # By the files that are there: a new one ships without a list that has to name it.
    names = [file.name.removesuffix(".yaml") for file in _files()]
    return tuple(sorted(name for name in names if name != _SIGNALS))


@functools.cache
def _content(name: str) -> dict:
    file = next(file for file in _files() if file.name == f"{name}.yaml")
    return parse_mapping(file.read_text(encoding="utf-8"), f"preset {name}")


@functools.cache
def preset(name: str) -> Preset:
    """The preset of that name.

    Raises:
        ValueError: there is none; with the nearest name there is.
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
    """Return the meanings of the signals by name."""
    return {name: Meaning(**m) for name, m in _content(_SIGNALS)["signals"].items()}


@functools.cache
def model_inputs() -> Mapping[str, ModelSignal]:
    """By the name of a model's input which signals it may be."""
    return {name: ModelSignal(**m) for name, m in _content(_SIGNALS)["inputs"].items()}


@functools.cache
def model_outputs() -> Mapping[str, str]:
    """By the name of a model's output which signal it is."""
    return _content(_SIGNALS)["outputs"]


def choose(log: Table | ChannelLog, alternatives: Sequence[Alternative]) -> Alternative | None:
    """The first alternative that a log has, its channel as this log names it; None without one."""
    names = frozenset(log.names)
    topics = {t.name for t in log.topics} if isinstance(log, ChannelLog) else set()
    for alternative in alternatives:
        channel = _with_instances(alternative, topics)
        needed = sources(channel, names)
        if not all(n in names for n in needed):
            continue
        if isinstance(log, ChannelLog) and not _serves(log, needed, alternative):
            continue
        values = {**vars(alternative), "channel": channel}
        return Alternative(**values)
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
    # A count whose unit the header does not make sure would scale a fit by a wrong factor.
    return not alternative.stated or topics[0].units.get(needed[0]) == alternative.unit


def fitting_presets(log_format: str, names: Sequence[str]) -> list[str]:
    """Return the presets for a format of which a log has the roll rate and the roll command."""
    # Instances are told apart by the reader; here any will do.
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


# Which channels of a log become which columns, as a preset or a configuration names them.


class Named(NamedTuple):
    """Columns by name, each with the channel that it is in SI."""

    signals: Mapping[str, Signal]
    notes: tuple[Finding, ...] = ()
    """what is not among them"""
    required: bool = True
    """whether a channel without a usable clock is an error; it is left out otherwise"""


type NamedBy = Callable[[Table | ChannelLog], Named]


def by_preset(name: str) -> NamedBy:
    """All signals of a preset that a log has, under the preset's names.

    Raises:
        ValueError: there is none of this name.
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
        return Named(signals, notes, required=False)

    return named
