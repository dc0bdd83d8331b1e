"""Filters and delays between motion and log, according to the flights' outputs."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from heli_jax import naming
from heli_jax.config.firmware_filters import LoggedFilters, logged_filters
from heli_jax.config.onboard import FROM_LOG
from heli_jax.config.schema import FlightConfig, OutputConfig
from heli_jax.dynamics.model import Model
from heli_jax.dynamics.onboard.filters import Filter, cutoff, with_filters
from heli_jax.errors import InputError, located, nearest
from heli_jax.finding import Finding
from heli_jax.flights.flight import Source
from heli_jax.flights.log import ChannelLog, Table, shown
from heli_jax.flights.open_log import open_log

type _Channel = tuple[tuple[Filter, ...], float]


class OpenedLogs:
    """Logs of one configuration, each parsed once until the flights are read.

    They are used for the firmware's settings, which are part of the model, and for the flights.
    """

    def __init__(self) -> None:
        self._logs: dict[tuple[Path, int | None], Table | ChannelLog] = {}

    def __reduce__(self) -> tuple:
        # An experiment sent to another process reads its logs there.
        return OpenedLogs, ()

    def open(self, path: Path, number: int | None) -> Table | ChannelLog:
        """Return the log, opened now or before.

        Args:
            path: path of the log.
            number: number of the flight in a log of several, from 1.

        Raises:
            InputError: it cannot be read.
        """
        if (path, number) not in self._logs:
            self._logs[path, number] = open_log(path, number)
        return self._logs[path, number]

    def get(self, path: Path, number: int | None) -> Table | ChannelLog | None:
        """Return the log if it is open, else None; arguments as in `open`."""
        return self._logs.get((path, number))

    def close(self) -> None:
        """Release all logs."""
        self._logs.clear()


def with_measurement(
    model: Model, flights: Sequence[FlightConfig], path: Path, logs: OpenedLogs
) -> Model:
    """Return the model with the filters and delays that the flights state for their outputs.

    Args:
        model: with the devices of `onboard`.
        flights: sections of the flights.
        path: the configuration file.
        logs: open logs.

    Raises:
        InputError: two flights state different ones, a log lacks the settings, or the model cannot
            have them.
    """
    channels: dict[str, tuple[_Channel, int]] = {}
    for i, flight in enumerate(flights):
        parts = (flight, *flight.also)
        for part, name, output in ((p, n, o) for p in parts for n, o in p.signals.outputs.items()):
            if name not in naming.names(model.Outputs):
                continue  # refused where the log is read, with the known names
            channel = _channel(part, f"flights[{i}].signals.outputs.{name}", output, path, logs)
            first, at = channels.setdefault(name, (channel, i))
            # All flights share one model, so that one compiled program is enough.
            if first != channel:
                raise InputError(
                    f"{path}: flights[{i}].signals.outputs.{name}: its filter and delay "
                    f"({_words(channel)}) differ from those of flights[{at}] ({_words(first)}), "
                    "expected the same in all flights; fit them one by one"
                )
    with located(f"{path}: flights.signals.outputs"):
        return with_filters(
            model,
            {n: filters for n, ((filters, _), _) in channels.items()},
            {n: delay for n, ((_, delay), _) in channels.items()},
        )


def _channel(part: Any, where: str, output: OutputConfig, path: Path, logs: OpenedLogs) -> _Channel:
    """Return the filters and the delay of one output."""
    filters: list[Filter] = []
    for config in output.filter or ():
        if config.kind != FROM_LOG:
            filters.append(config.filter)
            continue
        log = logs.open(path.parent / part.log, part.flight)
        # Checked first, or a misspelt channel would look like one without settings. Derived
        # channels are not in the log.
        derived = "(" in output.signal or output.signal.startswith("ccpm.")
        if not derived and output.signal not in log.names:
            near = nearest(output.signal[:60], {n[:60] for n in log.names})
            raise InputError(
                f"{path}: {where}.signal: {part.log} has no channel {shown(output.signal)}{near}"
            )
        # A table has no settings.
        settings = (log.firmware, log.parameters) if isinstance(log, ChannelLog) else ("", {})
        logged = logged_filters(*settings, output.signal)
        if logged is None:
            raise InputError(
                f"{path}: {where}.filter: {part.log} does not say how {output.signal} was "
                "filtered, expected a filter such as {kind: biquad, hz: 30}"
            )
        filters += logged.filters
    return tuple(filters), output.delay or 0.0


def _words(channel: _Channel) -> str:
    filters, delay = channel
    parts = [filter_words(f) for f in filters] + ([f"{delay:g} s late"] if delay else [])
    return ", ".join(parts) or "none"


def filter_words(filter: Filter) -> str:
    """Return a filter in words, as in a configuration."""
    more = "" if filter.q is None else f", q {filter.q:.3g}"
    if not math.isinf(filter.attenuation):
        more += f", {filter.attenuation:g} dB"
    return f"{filter.kind} {filter.hz:.4g} Hz{more}"


def filter_cautions(
    source: Source | None, outputs: Mapping[str, OutputConfig]
) -> tuple[Finding, ...]:
    """Return cautions on filters that the log states and the configuration does not model."""
    if source is None:
        return ()
    doubts = []
    for name, output in outputs.items():
        logged = logged_filters(source.firmware, source.parameters, output.signal)
        if logged is None:
            continue
        if output.filter is None and logged.filters:
            doubts.append(_not_modelled(name, output, logged))
        if logged.unknown:
            words = (
                f"{name} was also filtered by {', '.join(s.split()[0] for s in logged.unknown)}. "
                "These filters are not modelled, because they change in flight or are of an "
                "unknown kind"
            )
            doubts.append(Finding("filters.unknown-filter", "doubt", words, subjects=(name,)))
    return tuple(doubts)


def _not_modelled(name: str, output: OutputConfig, logged: LoggedFilters) -> Finding:
    filters = logged.filters
    lowpasses = [f for f in filters if f.kind != "notch"]
    what = f"low-passed at {cutoff(lowpasses):.3g} Hz" if lowpasses else "notched"
    late = 1e3 * sum(f.delay for f in filters)
    # The whole line, because the configuration has none for an output from a preset.
    line = [f'signal: "{output.signal}"', *([f"unit: {output.unit}"] if output.unit else [])]
    line += [f"scale: {output.scale:g}"] * (output.scale != 1.0)
    line += [f"offset: {output.offset:g}"] * (output.offset != 0.0)
    line += ["invert: true"] * output.invert
    # The inputs were not filtered; if both were filtered alike, the vehicle would look the same.
    words = (
        f"{name} was {what} by the autopilot ({', '.join(_short(s) for s in logged.settings)}), "
        f"which delays it by about {late:.1f} ms, unlike the inputs. The fit attributes this "
        f"delay to the vehicle; state `{name}: {{{', '.join(line)}, filter: from log}}` under "
        "outputs to model it, or `filter: []` to neglect it"
    )
    return Finding("filters.not-modelled", "doubt", words, 1e-3 * late, "delay [s]", (name,))


def _short(setting: str) -> str:
    return setting if len(setting) <= 48 else f"{setting[:45]}..."
