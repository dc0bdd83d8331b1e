"""`heli-jax new LOG`: a configuration made from a log, with its guesses marked."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from heli_jax import naming
from heli_jax.errors import InputError
from heli_jax.finding import Finding, note
from heli_jax.flights.preset import fitting_presets
from heli_jax.linear_models import read as linear_models
from heli_jax.new_config import tables, text
from heli_jax.new_config.logs import Log, read_log
from heli_jax.new_config.model_choice import chosen_model, other_models, vehicle_of
from heli_jax.new_config.rate import channels_of_preset, common_rate, rate_of_outputs
from heli_jax.new_config.signals import (
    rate_by_angle,
    signals_of,
)
from heli_jax.new_config.text import filter_settings, filtered_outputs
from heli_jax.run_directory import require_place, whole_file
from heli_jax.vehicle import read_vehicle
from heli_jax.yaml_file import EDIT

_GRAVITY = ("g", "gravity", "g0")


class Written(NamedTuple):
    """Written files, the configuration first, and notes for the user."""

    paths: tuple[Path, ...]
    notes: tuple[Finding, ...]


def write_config(
    log: str | Path,
    out: Path,
    model: str | None = None,
    vehicle: str | None = None,
    flight: int | None = None,
    time_rate: float | None = None,
) -> Written:
    """Write a configuration and, for models of a vehicle's geometry, a vehicle file to fill in.

    Args:
        log: path of the log.
        out: path of the configuration; an existing file is not replaced.
        model: name as in a configuration, or the file name of a linear model; by default chosen
            by the vehicle and the signals that move.
        vehicle: path of an existing vehicle file.
        flight: number of the flight in a log that holds several, from 1.
        time_rate: samples a second [Hz] of a table without times.

    Raises:
        InputError: the log cannot be read, holds nothing of the model, or a file exists already.
    """
    if out.exists():
        raise InputError(f"{out}: is there already; expected another place, --out FILE")
    require_place(out, str(out))
    read = read_log(Path(log), flight, time_rate)
    chosen = text.Chosen(*chosen_model(model, read, str(log), out.absolute().parent))
    preset = next(iter(fitting_presets(read.format, tuple(read.series))), None)
    signals = None if preset else signals_of(chosen.model, read)
    known = {} if signals is None else signals.known
    paths, constants, place = _vehicle(chosen, out, vehicle, known)
    if paths and signals is not None:
        # The vehicle file has these constants.
        signals = signals._replace(known={})
    others = () if model is not None else other_models(chosen.name)
    free = _free(chosen, constants, paths)
    from_preset = tuple(rate_by_angle(chosen.model).values())
    outputs = _outputs(preset, chosen.model, from_preset, read, signals)
    filtered = filtered_outputs(preset, chosen.model, read, from_preset) if preset else {}
    if signals is not None:
        named = {c: filter_settings(read, c) for c in outputs}
        signals = signals._replace(filtered={c: words for c, words in named.items() if words})
    content = text.configuration(
        chosen=chosen,
        log=_near(Path(log), out),
        time=read.time,
        flight=read.flight if read.several else None,
        preset=preset,
        signals=signals,
        vehicle=place,
        free=free,
        held={} if place is not None else _held(chosen, free),
        rate=_rate(read, outputs),
        others=[f"{name}: {meaning}" for name, meaning in others],
        preset_outputs=from_preset,
        filtered=filtered,
        unscaled={} if preset is None else text.unscaled_inputs(preset, chosen.model, read),
    )
    for path, words in {out: content, **paths}.items():
        with whole_file(path, str(path)) as temporary:
            temporary.write_text(words, encoding="utf-8")
    todo = sum(words.count(EDIT) for words in (content, *paths.values()))
    written = f"wrote {', '.join(map(str, (out, *paths)))}"
    notes = [note("configuration.written", written), *read.notes]
    if todo:
        words = f"fill in {todo} value{'s' * (todo > 1)} marked {EDIT}"
        notes.append(note("configuration.numbers-to-give", words, value=todo))
    lacking = [] if signals is None else [n for n, g in signals.inputs.items() if g is None]
    if signals is not None and not signals.outputs:
        outputs = ", ".join(naming.names(chosen.model.Outputs))
        words = f"no column name matches {outputs}: name the columns of the logged outputs"
        notes.append(note("channels.lacking", words, *naming.names(chosen.model.Outputs)))
    if lacking:
        words = (
            f"no channel looks like {' or '.join(lacking)}: name the stick's channel, or replace "
            "{signal: EDIT} by {constant: 0} if the stick was not moved"
        )
        notes.append(note("channels.lacking", words, *lacking))
    kind, shown_by = vehicle_of(read.autopilot)
    if model is not None and kind not in ("", "helicopter"):
        words = f"{shown_by} shows a log of no helicopter ({kind}): check that the model fits it"
        notes.append(note("model.other-vehicle", words))
    if chosen.reason:
        assert isinstance(chosen.name, dict)
        words = f"the model {chosen.name['linear']} is a guess: it {chosen.reason}"
        more = f"; others: --model {' or '.join(name for name, _ in others)}" if others else ""
        notes.append(note("model.guessed", f"{words}{more}"))
    words = f"check the lines marked GUESS, then run heli-jax check {out}"
    notes.append(note("configuration.guessed", words))
    return Written((out, *paths), tuple(notes))


def _outputs(
    preset: str | None,
    model: Any,
    requested: Sequence[str],
    log: Log,
    signals: text.Signals | None,
) -> Sequence[str]:
    """Return the log's channels for the requested outputs, or all outputs, else for the inputs."""
    if signals is not None:
        taken = signals.outputs or signals.inputs
        return [g.channel for g in taken.values() if g is not None]
    assert preset is not None
    known = tuple(log.series)
    found = channels_of_preset(preset, known, requested or naming.names(model.Outputs))
    return found or channels_of_preset(preset, known, naming.names(model.Inputs))


def _rate(log: Log, outputs: Sequence[str]) -> float | None:
    """Return the grid's rate [Hz]; None if the rows themselves are the grid.

    It is needed for topics with separate clocks, and for a table whose rows are not the outputs'
    own.
    """
    # From the outputs only: a slow stick can be held or interpolated on any grid, but a grid at its
    # rate would discard samples of the outputs.
    if log.time is None:
        return common_rate(log.series, outputs)
    return rate_of_outputs(log.series, outputs)


def _near(file: Path, out: Path) -> str:
    """Return the path of a log or a vehicle file as in a configuration at `out`."""
    # Relative if it is below or beside the folder of the configuration, so that both can move
    # together.
    folder, path = out.absolute().parent.resolve(), file.absolute().resolve()
    close = folder.parent != Path(folder.anchor) and path.is_relative_to(folder.parent)
    together = close or path.is_relative_to(folder)
    return path.relative_to(folder, walk_up=True).as_posix() if together else str(path)


def _vehicle(
    chosen: text.Chosen,
    out: Path,
    vehicle: str | None,
    known: Mapping[str, tuple[str, float]],
) -> tuple[dict[Path, str], Mapping[str, float], str | None]:
    """Return further files, the known constants, and the vehicle's path in the configuration."""
    if chosen.linear and vehicle is None:
        return {}, {}, None
    if vehicle is not None:
        read = read_vehicle(vehicle, chosen.model.Params, naming.names(chosen.model.Params))
        values = {n: c.value for n, c in read.constants.items()}
        return {}, values, _near(Path(vehicle), out)
    place = out.with_name(f"{out.stem}-vehicle.yaml")
    if place.exists():
        raise InputError(f"{place}: is there already; expected --vehicle with it, or another --out")
    return {place: text.vehicle(chosen.model, known)}, {}, place.name


def _free(
    chosen: text.Chosen, constants: Mapping[str, float], written: Mapping[Path, str]
) -> dict[str, float | str | None]:
    """Return the free parameters and their starts; None for the value in the new vehicle file."""
    listed = tables.models()
    known = naming.names(chosen.model.Params)
    if not chosen.linear:
        names = [n for n in listed["of the paper"] if n in known] or list(known)
        return {n: None if written else constants.get(n, EDIT) for n in names}
    assert isinstance(chosen.name, dict)
    file = chosen.name["linear"]
    own = linear_models.linear_model(file).vehicle().constants
    values = {n: c.value for n, c in own.items()} | dict(constants)
    # Gravity is known, even if a model's file lists it as free.
    return {n: values.get(n, EDIT) for n in listed.get(file, known) if n not in _GRAVITY}


def _held(chosen: text.Chosen, free: Mapping[str, Any]) -> dict[str, float]:
    """Return a linear model's parameters that keep another vehicle's values.

    Parameters of omitted effects are zero and not included.
    """
    if not chosen.linear:
        return {}
    assert isinstance(chosen.name, dict)
    own = linear_models.linear_model(chosen.name["linear"]).vehicle().constants
    values = {name: constant.value for name, constant in own.items()}
    return {n: v for n, v in values.items() if v and n not in free and n not in _GRAVITY}
