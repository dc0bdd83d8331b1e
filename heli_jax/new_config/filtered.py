"""Outputs that an autopilot filtered before it logged them, as far as its settings say."""

from collections.abc import Collection
from typing import Any, NamedTuple

from heli_jax import naming
from heli_jax.config.firmware_filters import logged_filters
from heli_jax.flights.preset import Alternative, choose, model_outputs, preset
from heli_jax.new_config.logs import Log


class Filtered(NamedTuple):
    """The channel of an output, and the settings of its filters in words."""

    signal: Alternative
    settings: str


def filter_settings(log: Log, channel: str) -> str:
    """The settings of constant filters that a channel went through, empty without one."""
    if log.autopilot is None:
        return ""
    logged = logged_filters(log.autopilot.firmware, log.autopilot.parameters, channel)
    return ", ".join(logged.settings) if logged is not None and logged.filters else ""


def filtered_outputs(
    name: str, model: Any, log: Log, asked: Collection[str]
) -> dict[str, Filtered]:
    """The filtered ones of the outputs that a preset supplies.

    Args:
        name: of the preset.
        model: whose outputs they are.
        log: of the autopilot.
        asked: the outputs to take from the preset; all unless given.
    """
    table, known = preset(name).signals, model_outputs()
    result: dict[str, Filtered] = {}
    for output in asked or naming.names(model.Outputs):
        signals = table.get(known.get(output, ""), ())
        chosen = choose(log.autopilot, signals) if log.autopilot is not None else None
        if chosen is not None and (settings := filter_settings(log, chosen.channel)):
            result[output] = Filtered(chosen, settings)
    return result
