"""Text of the files that `heli-jax new` writes."""

import json
import math
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

from heli_jax import naming
from heli_jax.config.firmware_filters import logged_filters
from heli_jax.dynamics.model import axes_of, vehicle_constants
from heli_jax.flights.clock import ROWS
from heli_jax.flights.describe import TimeInfo
from heli_jax.flights.preset import Alternative, choose, model_inputs, model_outputs, preset
from heli_jax.new_config.guess import Guess
from heli_jax.new_config.logs import Log
from heli_jax.new_config.rate import two_digits
from heli_jax.yaml_file import EDIT

_MOST_LISTED = 12
_OF_THE_STAND = {"kappa": "0 without a spring", "zeta": "0 without damping"}
"""Constants with a default of zero, which a model of a stand may not assume."""
_GUSTS = (
    "  # filter-error models gusts. Without gusts use output-error and remove the section",
    "  # disturbance.",
)
_NO_AXIS = ("  # output-error, because the model's file names no axis on which gusts act (axes).",)
_PRIOR_OF_A = (
    "    # a: {prior: {mean: 5.5, sd: 0.3}} # without it a is exact: Ixx and If scale with a"
)
_SMOOTH = (
    "  # GUESS: output-error, because the outputs have no sensor noise: the log was smoothed or",
    "  # simulated. filter-error needs unfiltered sensor noise.",
)
# Excludes YAML's short words (on, y, null) and numbers.
_PLAIN = re.compile(r"(?!(?i:on|off|yes|no|y|n|true|false|null)\Z)[A-Za-z][\w./%^-]*")

_ROWS_OF_TOPICS = "# Hz; rows of several topics, the outputs slower"


class Filtered(NamedTuple):
    """Channel of an output, and the settings of its filters in words."""

    signal: Alternative
    settings: str


def filter_settings(log: Log, channel: str) -> str:
    """Return the settings of a channel's constant filters; empty without any."""
    if log.autopilot is None:
        return ""
    logged = logged_filters(log.autopilot.firmware, log.autopilot.parameters, channel)
    return ", ".join(logged.settings) if logged is not None and logged.filters else ""


def filtered_outputs(
    name: str, model: Any, log: Log, requested: Collection[str]
) -> dict[str, Filtered]:
    """Return the filtered outputs among those that a preset supplies.

    Args:
        name: name of the preset.
        requested: outputs to take from the preset; all if empty.
    """
    table, known = preset(name).signals, model_outputs()
    result: dict[str, Filtered] = {}
    for output in requested or naming.names(model.Outputs):
        signals = table.get(known.get(output, ""), ())
        chosen = choose(log.autopilot, signals) if log.autopilot is not None else None
        if chosen is not None and (settings := filter_settings(log, chosen.channel)):
            result[output] = Filtered(chosen, settings)
    return result


def unscaled_inputs(name: str, model: Any, log: Log) -> dict[str, Alternative]:
    """Return the inputs that a preset has in parts of full travel, and the model as an angle.

    Args:
        name: name of the preset.
    """
    table, known, found = preset(name).signals, model_inputs(), dict[str, Alternative]()
    for n in naming.names(model.Inputs):
        if log.autopilot is None or n not in known or naming.unit(model.Inputs, n) in (None, "1"):
            continue
        chosen = choose(log.autopilot, table.get(known[n].command, ()))
        if chosen is not None and chosen.unit == "1":
            # Two inversions cancel.
            found[n] = replace(chosen, invert=chosen.invert != known[n].invert)
    return found


class Chosen(NamedTuple):
    """The model, its name in a configuration, and the reason if it was not stated."""

    model: Any
    name: str | dict[str, str]
    reason: str = ""

    @property
    def linear(self) -> bool:
        """True if the model is linear from a file."""
        return isinstance(self.name, dict)


class Signals(NamedTuple):
    """Channels by the model's inputs and outputs; None if none was found."""

    inputs: Mapping[str, Guess | None]
    outputs: Mapping[str, Guess | None]
    known: Mapping[str, tuple[str, float]]
    """Constants of the flight, each with the channel whose mean it is."""
    rest: Sequence[str]
    excitations: Mapping[str, str] = {}
    """Channel of the autopilot's added excitation, by input."""
    wandering: Mapping[str, Guess] = {}
    """Angles that are left out because of the drift of an integrated rate."""
    smooth: bool = False
    """True if no output has sensor noise."""
    ranges: Mapping[str, tuple[float, float]] = {}
    """Smallest and largest number of each unused channel."""
    filtered: Mapping[str, str] = {}
    """Settings of the autopilot's filters, by channel."""


def configuration(
    *,
    chosen: Chosen,
    log: str,
    time: TimeInfo | None,
    flight: int | None,
    preset: str | None,
    signals: Signals | None,
    vehicle: str | None,
    free: Mapping[str, float | str | None],
    held: Mapping[str, float],
    rate: float | None = None,
    others: Sequence[str] = (),
    preset_outputs: Sequence[str] = (),
    filtered: Mapping[str, Filtered] = {},
    unscaled: Mapping[str, Alternative] = {},
) -> str:
    """Return the configuration as text.

    Args:
        time: clock of a table; None if topics have separate clocks.
        flight: number of the flight, if there are several.
        signals: channels, without a preset.
        vehicle: path of the vehicle file, if any.
        free: starts by parameter; None for the vehicle's value.
        held: fixed parameters with another vehicle's values.
        rate: grid rate [Hz], if topics have separate clocks or share rows.
        others: other models of the axis.
        preset_outputs: outputs to take from the preset; all if empty.
        filtered: filtered outputs of the preset.
        unscaled: inputs of the preset as from `unscaled_inputs`.
    """
    lines = [
        f"# Made from {_comment(log)}. Check the lines marked GUESS.",
        "# heli-jax keys TEXT explains a key; heli-jax check tests the log before a fit.",
        *_models(chosen.reason, others),
        f"model: {_value(chosen.name)}",
        *([] if vehicle is None else [f"vehicle: {_value(vehicle)}"]),
    ]
    lines += ["flights:", f"  - log: {_value(log)}"]
    if flight is not None:
        lines.append(f"    flight: {flight}")
    lines += _clock(time, rate)
    if time is None and rate is not None:
        lines.append(f"    rate: {rate:g}".ljust(33) + "# Hz; the grid of all signals")
    if preset is not None:
        lines += [
            "    # window: auto               # or [first, last] s: the most informative parts",
            *_preset(chosen.model, preset, preset_outputs, filtered, unscaled),
        ]
    else:
        assert signals is not None
        lines += _flight(chosen, signals, time, log)
    axes = _axes(chosen.model, () if signals is None else signals.outputs)
    smooth = signals is not None and signals.smooth
    if smooth:
        axes = ()
    lines += [
        "fit:",
        *(_SMOOTH if smooth else _GUSTS if axes else _NO_AXIS),
        f"  method: {'filter-error' if axes else 'output-error'}",
        "  free:                          # estimated parameters and start values",
    ]
    lines += [
        f"    {name}: {{}}".ljust(33) + "# begins at the vehicle file's value"
        if start is None
        else f"    {name}: {{start: {_number(start)}}}"
        for name, start in free.items()
    ]
    stays = "# fixed at another vehicle's value; remove the first # to estimate it"
    lines += [f"    # {n}: {{start: {_number(v)}}}".ljust(33) + stays for n, v in held.items()]
    if not chosen.linear and "a" in naming.names(chosen.model.Params) and "a" not in free:
        lines.append(_PRIOR_OF_A)
    lines += [
        "  # nuisance: {time_shift: true} # if the stick was logged late or early",
        *([f"disturbance: {{on: [{', '.join(axes)}]}}"] if axes else []),
        "rls: null",
    ]
    return "\n".join(lines) + "\n"


def vehicle(model: Any, means: Mapping[str, tuple[str, float]]) -> str:
    """Return a vehicle file to fill in."""
    lines = ["# Constants of your vehicle, measured or from drawings, with their source."]
    for name, default in vehicle_constants(model).items():
        unit, meaning = naming.unit(model.Params, name) or "1", naming.meaning(model.Params, name)
        ask = math.isnan(default) or name in _OF_THE_STAND
        value = EDIT if ask else f"{default:g}"
        if name in means:
            channel, mean = means[name]
            value, meaning = f"{mean:.5g}", f"{meaning}; GUESS: mean of {channel}"
        elif name in _OF_THE_STAND:
            meaning = (
                f"{meaning}; {_OF_THE_STAND[name]}; measured, or a start value and free under fit"
            )
        lines.append(f"{name}: {{value: {value}, unit: {_value(unit)}}}   # {_comment(meaning)}")
    return "\n".join(lines) + "\n"


def _axes(model: Any, logged: Collection[str]) -> tuple[str, ...]:
    """Return the axes on which gusts may act: those with a logged output, if outputs are known."""
    axes = axes_of(model)
    # Gusts about an axis without a logged output are not identifiable.
    seen = [a.name for a in axes if not {a.rate, a.angle, a.name}.isdisjoint(logged)]
    return tuple(seen or (a.name for a in axes))


def _clock(time: TimeInfo | None, rate: float | None) -> list[str]:
    if time is None:
        return []
    if time.counted is not None and math.isnan(time.counted):
        return []
    lines = [f"    # {time.duration:.4g} s at {time.rate:.4g} Hz"]
    if not time.uniform or time.gaps:
        longest = max((g.length for g in time.gaps), default=0.0)
        gaps = f"{len(time.gaps)} gaps, the longest {longest:.4g} s"
        gaps = f"a gap of {longest:.4g} s" if len(time.gaps) == 1 else gaps
        words = f"{gaps}; fail refuses long ones"
        if time.runs > 1:
            words = f"{time.runs} runs, each with its own time"
        lines += [
            f"    gaps: split                  # {words}",
            f"    rate: {rate or two_digits(time.rate):g}".ljust(33)
            + ("# Hz; the log has no even steps" if rate is None else _ROWS_OF_TOPICS),
        ]
    return lines


def _models(reason: str, others: Sequence[str]) -> list[str]:
    lines = [f"# GUESS: the model {_comment(reason)}."] if reason else []
    if others:
        lines += [
            "# A log does not show how a vehicle is built, and a wrong model gives wrong numbers.",
            "# Other models of these signals (--model NAME):",
            *(f"#   {words}" for words in others),
        ]
    return lines


def _flight(chosen: Chosen, signals: Signals, time: TimeInfo | None, log: str) -> list[str]:
    lines = [
        f"    known: {{{name}: {value:.5g}}}       # GUESS: mean of {_comment(channel)}, in SI"
        for name, (channel, value) in signals.known.items()
    ]
    lines.append("    signals:")
    if time is not None:
        lines.append(_time(time))
    lines.append("      inputs:")
    for name, signal in signals.inputs.items():
        meaning = naming.meaning(chosen.model.Inputs, name)
        lines += _signal(name, signal, meaning)
    lines.append("      outputs:")
    for name, signal in signals.outputs.items():
        settings = "" if signal is None else signals.filtered.get(signal.channel, "")
        lines += _signal(name, signal, naming.meaning(chosen.model.Outputs, name), settings)
    if not signals.outputs and not signals.wandering:
        return [*lines, *_unknown(chosen.model), *_ranges(signals.ranges)]
    lines += _left_out(signals.wandering)
    lines += _missing(chosen, signals)
    lines += _instruments(signals.excitations)
    if signals.rest:
        listed = ", ".join(signals.rest[:_MOST_LISTED])
        more = "" if len(signals.rest) <= _MOST_LISTED else ", ..."
        lines.append(f"      # not used: {_comment(listed)}{more}")
    return lines


def _time(time: TimeInfo) -> str:
    """Return the clock of a table."""
    if time.counted is None:
        unit = "" if time.unit == "s" else f", unit: {time.unit}"
        guessed = "   # GUESS: the unit, by its steps" if time.guessed else ""
        return f"      time: {{signal: {_value(time.column)}{unit}}}{guessed}"
    counter = "" if time.column == ROWS else f"signal: {_value(time.column)}, "
    if math.isnan(time.counted):
        return (
            f"      time: {{{counter}rate: {EDIT}}}   # Hz, samples a second: no column is a time"
        )
    return f"      time: {{{counter}rate: {time.counted:.10g}}}"


def _preset(
    model: Any,
    preset: str,
    outputs: Sequence[str],
    filtered: Mapping[str, Filtered],
    unscaled: Mapping[str, Alternative],
) -> list[str]:
    known = "# heli-jax info shows the channels"
    if not outputs and not filtered and not unscaled:
        return [f"    signals: {{preset: {preset}}}   {known}"]
    lines = [f"    signals:                     {known}", f"      preset: {preset}"]
    if outputs:
        lines += [
            "      # Without the angle: the autopilot integrates it from gyros, its error drifts,",
            "      # and filter-error assumes white noise.",
            f"      preset_outputs: [{', '.join(outputs)}]",
        ]
    if unscaled:
        lines.append("      inputs:")
    for name, signal in unscaled.items():
        unit = naming.unit(model.Inputs, name) or "1"
        signal = replace(signal, unit=unit)
        lines += [
            f"        # {name}: the log has parts of full travel; scale: {unit} at full travel",
            f"        {name}: {{{', '.join(_keys(signal))}, scale: {EDIT}}}",
        ]
    if filtered:
        lines.append("      outputs:                   # with the autopilot's filters in the model")
    for name, (signal, settings) in filtered.items():
        keys = [*_keys(signal), *[f"scale: {signal.scale:g}"] * (signal.scale != 1.0)]
        lines.append(f"        # {name}: {_comment(settings)}")
        lines.append(f"        {name}: {{{', '.join(keys)}, filter: from log}}")
    return lines


def _keys(signal: Alternative) -> list[str]:
    """Return the keys of a signal without its scale."""
    keys = [f"signal: {_value(signal.channel)}", f"unit: {_value(signal.unit)}"]
    keys += [f"offset: {signal.offset:g}"] * bool(signal.offset)
    return keys + ["invert: true"] * signal.invert


def _left_out(wandering: Mapping[str, Guess]) -> list[str]:
    """Return the angles that are left out, as comments."""
    return [
        line
        for name, signal in wandering.items()
        for line in (
            f"        # GUESS: without {name}, which looks integrated from a gyro: its error",
            "        # drifts, and filter-error assumes white noise.",
            *(f"        # {words.strip()}" for words in _signal(name, signal, "")),
        )
    ]


def _unknown(model: Any) -> list[str]:
    """Return the outputs without a matching name, for the user to name or to remove."""
    lines = ["        # No name matches an output: delete those that were not logged."]
    for name in naming.names(model.Outputs):
        meaning, unit = naming.meaning(model.Outputs, name), naming.unit(model.Outputs, name) or "1"
        lines += [f"        # {name}: {_comment(meaning)}"] if meaning else []
        words = "unit in the log" if unit == "1" else f"such as {unit}"
        lines.append(f"        {name}: {{signal: {EDIT}, unit: {EDIT}}}   # {words}")
    return lines


def _ranges(ranges: Mapping[str, tuple[float, float]]) -> list[str]:
    """Return the ranges of a log's channels, for a choice by numbers."""
    moving = {n: r for n, r in ranges.items() if r[0] < r[1]}
    shown = list(moving.items())[:_MOST_LISTED]
    lines = [f"      #   {_comment(n)}: {low:.4g} to {high:.4g}" for n, (low, high) in shown]
    more = len(moving) - len(shown)
    lines += [f"      #   and {more} more: heli-jax info"] if more > 0 else []
    return ["      # Channels that move:", *lines] if lines else []


def _missing(chosen: Chosen, signals: Signals) -> list[str]:
    """Return the outputs without a matching channel name."""
    units = {
        n: naming.unit(chosen.model.Outputs, n) or "1"
        for n in naming.names(chosen.model.Outputs)
        if n not in signals.outputs and n not in signals.wandering
    }
    if not units:
        return []
    first, unit = next(iter(units.items()))
    listed = ", ".join(f"{n} [{u}]" for n, u in units.items())
    return [
        f"        # No column name matches {listed}. Add what was logged,",
        f"        # as {first}: {{signal: NAME, unit: {_value(unit)}}}",
    ]


def _instruments(excitations: Mapping[str, str]) -> list[str]:
    if not excitations:
        return []
    return [
        "      # Excitation that an autopilot added to the stick. With it,",
        "      # method: frequency-error is unbiased in closed loop (docs/frequency-fits.md).",
        "      # instruments:",
        *(f"      #   {n}: {{signal: {_value(c)}}}   # GUESS" for n, c in excitations.items()),
    ]


def _signal(name: str, guess: Guess | None, meaning: str, settings: str = "") -> list[str]:
    words = [f"        # {name}: {_comment(meaning)}"] if meaning else []
    if settings:
        words.append(f"        # filtered by the autopilot: {_comment(settings)}")
    if guess is None:
        # An unknown input must not become a constant, so the user names its channel.
        stays = "; {constant: 0} if it did not move"
        return [*words, f"        {name}: {{signal: {EDIT}}}   # no channel name matches{stays}"]
    keys = [f"signal: {_value(guess.channel)}", f"unit: {_value(guess.unit)}"]
    if guess.offset:
        keys.append(f"offset: {guess.offset:g}")
    if guess.scale != 1.0:
        keys.append(f"scale: {_number(guess.scale)}")
    if settings:
        keys.append("filter: from log")
    remarks = "; ".join(map(_comment, guess.remarks))
    return [
        *words,
        f"        {name}: {{{', '.join(keys)}}}" + (f"   # {remarks}" if remarks else ""),
    ]


def _number(value: float | str) -> str:
    return value if isinstance(value, str) else f"{value:.6g}"


def _value(value: Any) -> str:
    """Return one value in the form allowed within {...}."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{k}: {_value(v)}" for k, v in value.items()) + "}"
    # Text that YAML might read as something else is quoted as in JSON.
    text = str(value)
    if _PLAIN.fullmatch(text):
        return text
    quoted = json.dumps(text, ensure_ascii=False)
    # YAML accepts such characters only as escapes.
    return "".join(c if c.isprintable() else f"\\U{ord(c):08x}" for c in quoted)


def _comment(text: str) -> str:
    # Names of a log may hold line breaks, which would end the comment.
    return " ".join("".join(c if c.isprintable() else " " for c in text).split())
