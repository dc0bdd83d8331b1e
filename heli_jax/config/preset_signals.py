"""Signals of a model from a preset: the channel of each input and output in this log."""

from collections.abc import Collection
from typing import Any, NamedTuple

from heli_jax import naming
from heli_jax.config.onboard import OnboardConfig
from heli_jax.config.schema import InputConfig, OutputConfig, SignalsConfig
from heli_jax.dynamics.kinematics import is_kinematic
from heli_jax.dynamics.model import Model
from heli_jax.errors import InputError, require_known
from heli_jax.finding import Finding, note
from heli_jax.flights.derived import CCPM
from heli_jax.flights.log import ChannelLog, Table, shown, wrong
from heli_jax.flights.preset import (
    Alternative,
    ModelSignal,
    Preset,
    choose,
    model_inputs,
    model_outputs,
    preset,
    presets,
)

_STICKS = {"rate_loop": ("lat", "lon", "x_roll", "x_pitch"), "gyro": ("ped", "x_yaw")}
"""Default inputs of a rate loop and a gyro."""
_CCPM = dict(zip(("collective", "cyclic_roll", "cyclic_pitch"), CCPM, strict=True))
_MOST_NAMES = 12
"""Most names of topics in a sentence."""


class Resolved(NamedTuple):
    """Signals of one flight, each with a channel.

    `origins` has the source of unit, axes and sign by role and name, for signals from a preset.
    `notes` list the outputs that were left out.
    """

    inputs: dict[str, InputConfig]
    outputs: dict[str, OutputConfig]
    origins: dict[tuple[str, str], str]
    notes: tuple[Finding, ...]


def resolve(
    model: Model,
    stated: SignalsConfig,
    where: str,
    onboard: OnboardConfig | None = None,
    log: Table | ChannelLog | None = None,
    elsewhere: Collection[str] = (),
) -> Resolved:
    """Return the signals of a configuration, completed by its preset.

    Args:
        stated: the section `signals`.
        where: place of the section, for messages.
        onboard: the section `onboard`, if any.
        log: the log, if it is open.
        elsewhere: signals from further logs.

    Raises:
        InputError: an input that neither the configuration nor the preset supplies, or a missing
            output that was requested; no output at all.
    """
    inputs, outputs = dict(stated.inputs), dict(stated.outputs)
    if stated.preset is None:
        return Resolved(inputs, outputs, {}, ())
    search = _Search(preset(stated.preset), stated, log, where)
    search.require_format()
    origins: dict[tuple[str, str], str] = {}
    pilot = _pilot(onboard)
    for name in naming.names(model.Inputs):
        if name not in inputs and name not in elsewhere:
            chosen = search.input(model, name, name in pilot)
            inputs[name] = InputConfig(**_keys(chosen))
            origins["inputs", name] = search.origin(chosen)
    left: dict[str, str] = {}
    for name in _requested_outputs(model, stated, where):
        if name in outputs or name in elsewhere:
            continue
        chosen, why = search.output(name)
        if chosen is None and stated.preset_outputs is not None:
            raise InputError(f"{where}.preset_outputs: {name}: {why}{search.channels_in_words()}")
        if chosen is None:
            left[name] = f"{name} ({why})"
            continue
        outputs[name] = OutputConfig(**_keys(chosen))
        origins["outputs", name] = search.origin(chosen)
    if not outputs and not elsewhere:
        problem = f"{where}: preset {stated.preset} supplies no output of model {model.name}: "
        raise InputError(problem + ", ".join(left.values()) + search.channels_in_words())
    # In the model's own order, independent of the source.
    inputs = {n: inputs[n] for n in (*naming.names(model.Inputs), *inputs) if n in inputs}
    words = f"outputs that preset {stated.preset} left out: {', '.join(left.values())}"
    notes = (note("channels.lacking", words, *left),) if left else ()
    return Resolved(inputs, outputs, origins, notes)


def _pilot(onboard: OnboardConfig | None) -> set[str]:
    """Return the inputs that are the pilot's sticks: those before a rate loop or a gyro."""
    if onboard is None:
        return set()
    devices = (("rate_loop", onboard.rate_loop), ("gyro", onboard.gyro))
    return {
        stick
        for key, device in devices
        if device is not None
        for stick in (_STICKS[key] if device.on is None else device.on)
    }


def _requested_outputs(model: Model, stated: SignalsConfig, where: str) -> tuple[str, ...]:
    known = naming.names(model.Outputs)
    place, words = f"{where}.preset_outputs", f"model {model.name} has no output"
    require_known(stated.preset_outputs or (), known, place, words)
    return known if stated.preset_outputs is None else tuple(stated.preset_outputs)


def _keys(chosen: Alternative) -> dict[str, Any]:
    """Return the equivalent keys of a configuration; Any: text, numbers and a boolean."""
    return {
        "signal": chosen.channel,
        "unit": chosen.unit,
        "scale": chosen.scale,
        "offset": chosen.offset,
        "invert": chosen.invert,
    }


class _Search(NamedTuple):
    """Search of a preset's signals in one log."""

    table: Preset
    stated: SignalsConfig
    log: Table | ChannelLog | None
    where: str

    def require_format(self) -> None:
        """Refuse a preset for another format, unless the log has one of its channels."""
        log, table = self.log, self.table
        if log is None or log.format in table.formats:
            return
        # A table may have the names of the channels, as `heli-jax convert` writes them.
        if any(choose(log, alternatives) for alternatives in table.signals.values()):
            return
        others = [name for name in presets() if log.format in preset(name).formats]
        instead = f"preset {' or '.join(others)}, or " if others else ""
        kind = " and ".join(table.formats)
        problem = f"preset {table.name} is for logs of {kind}, and this {log.format} log has none"
        expected = f"of its channels, expected {instead}inputs and outputs by name"
        raise InputError(f"{self.where}.preset: {log.path}: {problem} {expected}")

    def input(self, model: Model, name: str, pilot: bool) -> Alternative:
        known = model_inputs().get(name)
        # The kinematic model has measured outputs as inputs.
        if is_kinematic(model) and (sensor := model_outputs().get(name)) is not None:
            known = ModelSignal(sensor, sensor)
        if known is None:
            problem = f"no preset knows the input {name!r} of model {model.name}"
            raise InputError(f"{self.where}.inputs: {problem}, expected it by name")
        chosen, why = self._signal(known.stick if pilot else known.command)
        if chosen is None:
            problem = f"{name}: {why}, expected it by name"
            raise InputError(f"{self.where}.inputs: {problem}{self.channels_in_words()}")
        if chosen.unit == "1" and naming.unit(model.Inputs, name) not in (None, "1"):
            problem = f"{name}: the preset has parts of full travel, and the model another unit"
            raise InputError(f"{self.where}.inputs: {problem}, expected it by name with a scale")
        # Two inversions cancel.
        return Alternative(**{**vars(chosen), "invert": chosen.invert != known.invert})

    def output(self, name: str) -> tuple[Alternative | None, str]:
        signal = model_outputs().get(name)
        return (None, "no preset knows it") if signal is None else self._signal(signal)

    def _signal(self, signal: str) -> tuple[Alternative | None, str]:
        """Return the channel of a signal, or why there is none."""
        table = self.table
        alternatives = table.signals.get(signal, ())
        if self.stated.ccpm is not None and signal in _CCPM:
            origin = "unmixed from the servos by signals.ccpm"
            return Alternative(_CCPM[signal], "1", source=origin), ""
        if not alternatives:
            reason = table.missing.get(signal)
            return None, f"preset {table.name} has no {signal}" + (f": {reason}" if reason else "")
        if self.log is None:
            return alternatives[0], ""
        tried = ", ".join(dict.fromkeys(a.channel for a in alternatives))
        return choose(self.log, alternatives), f"the log has no {signal} in {tried}"

    def origin(self, chosen: Alternative) -> str:
        """Return the source of unit, axes and sign."""
        return f"by preset {self.table.title}: {chosen.source}"

    def channels_in_words(self) -> str:
        """Return the channels in the log, as the end of a sentence."""
        if self.log is None:
            return ""
        names = list(self.log.names)
        if isinstance(self.log, ChannelLog):
            # Topics without instance numbers.
            names = list(dict.fromkeys(t.name.split("[")[0] for t in self.log.topics))
        more = f" and {len(names) - _MOST_NAMES} more" if len(names) > _MOST_NAMES else ""
        listed = ", ".join(shown(name)[1:-1] for name in names[:_MOST_NAMES])
        # `wrong` removes control characters: names come from the file.
        return str(wrong(f"; {self.log.path} holds", f"{listed}{more}"))
