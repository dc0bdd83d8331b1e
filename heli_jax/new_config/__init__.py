"""`heli-jax new LOG`: a configuration that begins with what a log holds, its guesses marked."""

from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from heli_jax import models, naming
from heli_jax.dynamics.model import axes_of
from heli_jax.errors import InputError, nearest
from heli_jax.flights.channel_names import names_a_stick
from heli_jax.flights.preset import fitting_presets, model_inputs, model_outputs
from heli_jax.flights.table import shown, wrong
from heli_jax.linear_models import read as linear_models
from heli_jax.new_config import guess, text
from heli_jax.new_config.guess import Guess
from heli_jax.new_config.logs import Log, read_log
from heli_jax.new_config.places import is_place
from heli_jax.new_config.rate import channels_of_preset, common_rate, rate_of_outputs
from heli_jax.new_config.unread import unread_notes
from heli_jax.numerics.white_noise import wanders, without_noise
from heli_jax.run_directory import require_place, whole_file
from heli_jax.vehicle import read_vehicle
from heli_jax.yaml_file import EDIT, parse_mapping

_AXES = {
    "roll": ("roll-flybarless", ("roll_rate", "roll")),
    "pitch": ("pitch-flybarless", ("pitch_rate", "pitch")),
    "yaw": ("yaw", ("yaw_rate",)),
    "collective": ("heave", ("down_speed",)),
}
"""by stick the linear model of its axis, and what has to be logged for it"""
_UNITS = {"roll": "rad", "pitch": "rad", "down_speed": "m/s"} | dict.fromkeys(
    ("roll_rate", "pitch_rate", "yaw_rate"), "rad/s"
)
_STICKS_TOO = {"roll", "pitch", "yaw"}
"""names of motions that sticks have as well"""
_GRAVITY = ("g", "gravity", "g0")
_FULL_TRAVEL = 1.5
"""of a stick in parts of it, which radios let exceed 1"""


class Written(NamedTuple):
    """The files, the configuration first, and what the user has to know."""

    paths: tuple[Path, ...]
    notes: tuple[str, ...]


def write_config(
    log: str | Path,
    out: Path,
    model: str | None = None,
    vehicle: str | None = None,
    flight: int | None = None,
    time_rate: float | None = None,
) -> Written:
    """Write a configuration, and for models of a machine's geometry a vehicle file to fill in.

    Args:
        log: of any format that is read.
        out: the configuration's place; what stands there is not replaced.
        model: as a configuration names it, a linear one by its file's name too; chosen by what
            moves unless given.
        vehicle: a vehicle file.
        flight: of a log that holds several, from 1.
        time_rate: samples a second [Hz] of a table without times.

    Raises:
        InputError: the log cannot be read, holds nothing of the model, or a file is in the way.
    """
    if out.exists():
        raise InputError(f"{out}: is there already; expected another place, --out FILE")
    require_place(out, str(out))
    read = read_log(Path(log), flight, time_rate)
    chosen = text.Chosen(*_model(model, read, str(log)))
    preset = next(iter(fitting_presets(read.format, tuple(read.series))), None)
    signals = None if preset else _signals(chosen.model, read)
    known = {} if signals is None else signals.known
    paths, constants, place = _vehicle(chosen, out, vehicle, known)
    if paths and signals is not None:
        # The vehicle file has them.
        signals = signals._replace(known={})
    used = _used(preset, chosen.model, read, signals)
    others = () if model is not None else _also(chosen.name)
    content = text.configuration(
        chosen=chosen,
        log=_relative(Path(log), out),
        time=read.time,
        flight=read.flight if read.several else None,
        preset=preset,
        signals=signals,
        vehicle=place,
        free=(free := _free(chosen, constants, paths)),
        held={} if place is not None else _held(chosen, free),
        rate=_rate(read, used, signals),
        others=[f"{name}: {meaning}" for name, meaning in others],
        preset_outputs=tuple(_only_turn(chosen.model).values()),
    )
    for path, words in {out: content, **paths}.items():
        with whole_file(path, str(path)) as temporary:
            temporary.write_text(words, encoding="utf-8")
    todo = sum(words.count(EDIT) for words in (content, *paths.values()))
    notes = [f"wrote {', '.join(map(str, (out, *paths)))}", *read.notes]
    if todo:
        words = "1 number is" if todo == 1 else f"{todo} numbers are"
        notes.append(f"{words} yours to give, where {EDIT} stands")
    lacking = [] if signals is None else [n for n, g in signals.inputs.items() if g is None]
    if signals is not None and not signals.outputs:
        outputs = ", ".join(naming.names(chosen.model.Outputs))
        notes.append(f"found none of {outputs} by its name: say which were logged, and as what")
    if lacking:
        words = f"no channel that may be {' or '.join(lacking)} was found by name or motion"
        notes.append(f"{words}: name the stick's, which no rate or angle is")
    if signals is not None:
        absent = [n for n in naming.names(chosen.model.Outputs) if n not in signals.outputs]
        absent = [n for n in absent if n not in signals.wandering]
        called = {n: _called_output(n) for n in absent} | {n: _called_input(n) for n in lacking}
        notes += unread_notes((*lacking, *absent), called, read.unread)
    if others:
        assert isinstance(chosen.name, dict)
        notes.append(
            f"the model {chosen.name['linear']} is a guess by the stick that moves; a stand or a "
            f"flybar no log tells: --model {' or '.join(name for name, _ in others)}"
        )
    notes.append(f"look over what is marked GUESS; next: heli-jax check {out}")
    return Written((out, *paths), tuple(notes))


def _used(preset: str | None, model: Any, log: Log, signals: text.Signals | None) -> Sequence[str]:
    """The log's channels that the configuration takes."""
    if signals is not None:
        guesses = (*signals.inputs.values(), *signals.outputs.values())
        return [g.channel for g in guesses if g is not None]
    assert preset is not None
    needed = (*naming.names(model.Inputs), *naming.names(model.Outputs))
    return channels_of_preset(preset, tuple(log.series), needed)


def _rate(log: Log, used: Sequence[str], signals: text.Signals | None) -> float | None:
    """The grid's rate [Hz]: of topics with clocks of their own, or of a table whose rows are not
    the outputs' own; None where the rows themselves are the grid."""
    if log.time is None:
        return common_rate(log.series, used)
    assert signals is not None  # presets are of logs with topics
    outputs = [g.channel for g in signals.outputs.values() if g is not None]
    return rate_of_outputs(log.series, outputs)


def _also(name: str | dict[str, str]) -> tuple[tuple[str, str], ...]:
    """Other models of the axis of a linear one, with what each is for."""
    assert isinstance(name, dict)
    return tuple(_file("models.yaml")["also"].get(name["linear"], {}).items())


def _relative(log: Path, out: Path) -> str:
    """The log as a configuration in `out` names it."""
    # Logs beside or below the configuration move with it.
    folder, path = out.absolute().parent.resolve(), log.absolute().resolve()
    return str(path.relative_to(folder) if path.is_relative_to(folder) else path)


def _near(vehicle: Path, out: Path) -> str:
    """The vehicle file as a configuration in `out` names it."""
    # Vehicle files often lie in a folder beside that of the configurations: the two move together.
    folder, path = out.absolute().parent.resolve(), vehicle.absolute().resolve()
    beside = folder.parent != Path(folder.anchor) and path.is_relative_to(folder.parent)
    together = beside or path.is_relative_to(folder)
    return path.relative_to(folder, walk_up=True).as_posix() if together else str(path)


def _model(name: str | None, log: Log, path: str) -> tuple[Any, str | dict[str, str], bool]:
    """The model, what a configuration calls it, and whether it is linear from a file."""
    if name is None:
        name = _by_what_moves(log, path)
    # Of roll and pitch there are the paper's model and a linear one: the latter by {linear: roll}.
    stated = name.strip().removeprefix("{").removesuffix("}")
    linear = stated.startswith("linear:")
    stated = stated.removeprefix("linear:").strip()
    if (
        not linear
        and not linear_models.is_shipped(stated)
        and not stated.endswith((".yaml", ".yml"))
    ):
        return _by_name(stated), stated, False
    if not linear and stated in ("roll", "pitch"):
        return models.by_name(stated, "--model"), stated, False
    return linear_models.linear_model(stated).model, {"linear": stated}, True


def _by_name(stated: str) -> Any:
    try:
        return models.by_name(stated, "--model")
    except InputError as e:
        if ":" in stated:
            raise
        # The library's own list leaves out what is linear, and files.
        known = tuple(dict.fromkeys((*models.names(), *linear_models.shipped())))
        near = nearest(stated, known)
        meant = near if "did you mean" in near else ""
        raise InputError(
            f"--model: expected one of {', '.join(known)}, a linear model's file (NAME.yaml) or "
            f"package.module:name, got {stated!r}{meant}"
        ) from e


def _by_what_moves(log: Log, path: str) -> str:
    """The linear model of the axis whose stick moves most, of those whose motion is logged."""
    called = _names()
    names = tuple(n for n in log.series if not is_place(n, log.series))
    moving = {}
    for stick, (model, measured) in _AXES.items():
        by_name = guess.by_name(called["inputs"][stick], names, called["commands"][stick])
        by_name = by_name or guess.by_number(called["numbered"][stick], names)
        sticks = _moving(log, [n for n in by_name if not guess.is_excitation(n)])
        outputs = [n for m in measured for n in _outputs(log, called["outputs"][m], _UNITS[m])]
        if sticks and _moving(log, outputs):
            moving[model] = log.series[sticks[0]].values
    if fitting_presets(log.format, names):
        return "roll-flybarless"
    if not moving:
        listed = ", ".join(map(shown, names[:12]))
        problem = "found no stick beside a rate or an angle of its axis by their names, expected"
        raise wrong(path, f"{problem} --model and then the signals by hand; it holds {listed}")
    most = {model: float(np.nanmax(np.abs(values))) for model, values in moving.items()}
    # Parts of full travel are compared as they are; of other numbers nobody knows full travel.
    alike = max(most.values()) <= _FULL_TRAVEL
    size = {m: np.nanstd(values) / (1.0 if alike else most[m]) for m, values in moving.items()}
    return max(size, key=lambda model: size[model])


def _moving(log: Log, names: Sequence[str]) -> list[str]:
    return [n for n in names if np.nanstd(log.series[n].values) > 0]


def _names() -> dict[str, Any]:
    return _file("names.yaml")


def _file(name: str) -> dict[str, Any]:
    file = resources.files(__name__).joinpath(name)
    return parse_mapping(file.read_text(encoding="utf-8"), name)


def _signals(model: Any, log: Log) -> text.Signals:
    """Channels for inputs and outputs of the model, and which of the log's are left."""
    called, taken = _names(), []
    inputs: dict[str, Guess | None] = {}
    numbered: dict[str, list[str]] = {}
    excitations: dict[str, str] = {}
    sticks = [n for n in log.series if not (guess.is_excitation(n) or is_place(n, log.series))]
    for name in naming.names(model.Inputs):
        own = model_inputs().get(name)
        known = called["rotor_speed"] if name == "Omega" else []
        commands: list[str] = []
        if own is not None and name != "Omega":
            stick = own.command.removeprefix("cyclic_").replace("tail", "yaw")
            known, commands = called["inputs"][stick], called["commands"][stick]
            numbered[name] = guess.by_number(called["numbered"][stick], sticks)
        unit, known = naming.unit(model.Inputs, name) or "1", [_own(name), *known]
        allowed = [n for n in sticks if guess.may_move(n, log.series[n], unit)]
        inputs[name] = _found(log, guess.by_name(known, allowed, commands), unit, taken)
        for channel in _moving(log, guess.excitations(known, tuple(log.series)))[:1]:
            excitations[name] = channel
    taken += excitations.values()
    outputs: dict[str, Guess] = {}
    for name in naming.names(model.Outputs):
        unit = naming.unit(model.Outputs, name) or "1"
        output = _found(log, _outputs(log, _called_output(name), unit), unit, taken)
        if output is not None:
            outputs[name] = output
    # What an output follows is the better reason where one input makes it move.
    if len(inputs) > 1:
        _by_number(model, log, inputs, numbered, taken)
    _by_correlation(model, log, inputs, outputs, taken)
    _by_number(model, log, inputs, numbered, taken)
    speed = guess.by_name(called["rotor_speed"], tuple(log.series))
    known = {}
    if speed and "Omega" in naming.names(model.Params):
        known = {"Omega": (speed[0], guess.rotor_speed(speed[0], log.series[speed[0]]))}
        taken.append(speed[0])
    rest = tuple(n for n in log.series if n not in taken)
    measured = [log.series[g.channel].values for g in outputs.values()]
    smooth = bool(measured) and all(map(without_noise, measured))
    wandering = {} if smooth else _wandering(model, log, outputs)
    outputs = {n: g for n, g in outputs.items() if n not in wandering}
    ranges = {n: (np.nanmin(x := log.series[n].values), np.nanmax(x)) for n in rest}
    return text.Signals(inputs, outputs, known, rest, excitations, wandering, smooth, ranges)


def _only_turn(model: Any) -> dict[str, str]:
    """By angle the rate, of a model whose outputs are one axis's rate and angle alone: there the
    angle says nothing that the rate does not."""
    pairs = {a.angle: a.rate for a in axes_of(model) if a.angle is not None}
    outputs = set(naming.names(model.Outputs))
    return {angle: rate for angle, rate in pairs.items() if {angle, rate} == outputs}


def _wandering(model: Any, log: Log, outputs: Mapping[str, Guess]) -> dict[str, Guess]:
    """Angles beside their rate whose error is that of an integrated rate, as an autopilot's."""
    return {
        angle: outputs[angle]
        for angle, rate in _only_turn(model).items()
        if {angle, rate} <= set(outputs) and wanders(log.series[outputs[angle].channel].values)
    }


def _called_output(name: str) -> list[str]:
    """What people call an output of a model, words by blanks."""
    return [_own(name), *_names()["outputs"].get(model_outputs().get(name, name), [])]


def _called_input(name: str) -> list[str]:
    """What people call an input of a model, words by blanks."""
    own, called = model_inputs().get(name), _names()
    if own is None:
        return [_own(name)]
    if name == "Omega":
        return [_own(name), *called["rotor_speed"]]
    stick = own.command.removeprefix("cyclic_").replace("tail", "yaw")
    return [_own(name), *called["inputs"][stick]]


def _own(name: str) -> str:
    """What the model calls a signal, as words."""
    return " ".join(guess.words_of(name))


def _outputs(log: Log, called: Sequence[str], si: str) -> list[str]:
    """Channels that may be an output, the likeliest first."""
    # Among all names, since what stands beside a name may say what it means.
    spelled = guess.spelled_out(tuple(log.series))
    names = {
        spelled.get(n, n): n
        for n, s in log.series.items()
        if guess.may_be(spelled.get(n, n), s, called, si)
    }
    return [names[n] for n in guess.by_name(called, list(names))]


def _found(log: Log, names: Sequence[str], si: str, taken: list[str]) -> Guess | None:
    candidates = [n for n in names if n not in taken]
    # What never moves is a trim, or a channel that is not connected; better than none.
    candidates = _moving(log, candidates) or candidates
    if not candidates:
        return None
    chosen = guess.of_known_unit(candidates, log.series, si)
    taken.append(chosen)
    scaled = guess.scaled(chosen, log.series[chosen], si, _full_travel(log))
    others = [n for n in candidates if n != chosen]
    if not others:
        return scaled
    remark = f"could be {', '.join(others[:3])} as well"
    return scaled._replace(remarks=(*scaled.remarks, remark))


def _full_travel(log: Log) -> float | None:
    return guess.full_travel({n: s for n, s in log.series.items() if names_a_stick(n)})


def _by_number(
    model: Any,
    log: Log,
    inputs: dict[str, Guess | None],
    numbered: Mapping[str, list[str]],
    taken: list[str],
) -> None:
    """Inputs whose channels have numbers for names, in the usual order."""
    for name, input in inputs.items():
        si = naming.unit(model.Inputs, name) or "1"
        names = [n for n in numbered.get(name, ()) if guess.may_move(n, log.series[n], si)]
        made = None if input is not None else _found(log, names, si, taken)
        if made is not None:
            why = "GUESS: by its number, in the order roll, pitch, throttle, yaw"
            inputs[name] = made._replace(remarks=(why, *made.remarks))


def _by_correlation(
    model: Any,
    log: Log,
    inputs: dict[str, Guess | None],
    outputs: Mapping[str, Guess | None],
    taken: list[str],
) -> None:
    """Inputs whose names tell nothing, by what an output follows."""
    known = [g.channel for g in outputs.values() if g is not None]
    # What is named as a motion moves with the stick, and more like the output than the stick does.
    motions = {c for names in _names()["outputs"].values() for c in names} - _STICKS_TOO
    moving = guess.by_name(sorted(motions), tuple(log.series))
    measured = {n for n in moving if not names_a_stick(n)}
    for name, input in inputs.items():
        if input is not None or not known:
            continue
        si = naming.unit(model.Inputs, name) or "1"
        left = {
            n: s
            for n, s in log.series.items()
            if n not in {*taken, *measured}
            and guess.may_move(n, s, si)
            and not (guess.is_excitation(n) or is_place(n, log.series))
            and np.nanstd(s.values) > 0
        }
        best = guess.by_motion(log.series[known[-1]], left)
        if best is None:
            continue
        channel, related = best
        made = guess.scaled(channel, log.series[channel], si, _full_travel(log))
        why = f"GUESS: no name says so; {known[-1]} follows it with a correlation of {related:.2f}"
        inputs[name] = made._replace(remarks=(why, *made.remarks))
        taken.append(channel)


def _vehicle(
    chosen: text.Chosen,
    out: Path,
    vehicle: str | None,
    known: Mapping[str, tuple[str, float]],
) -> tuple[dict[Path, str], Mapping[str, float], str | None]:
    """Further files, the constants that are known, and the vehicle's place in the configuration."""
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
    """What is free and where it begins; None at the value of the vehicle file that is written."""
    listed = _file("models.yaml")
    known = naming.names(chosen.model.Params)
    if not chosen.linear:
        names = [n for n in listed["of the paper"] if n in known] or list(known)
        return {n: None if written else constants.get(n, EDIT) for n in names}
    assert isinstance(chosen.name, dict)
    file = chosen.name["linear"]
    own = linear_models.linear_model(file).vehicle().constants
    values = {n: c.value for n, c in own.items()} | dict(constants)
    # Gravity is known, whatever a model's file calls free.
    return {n: values.get(n, EDIT) for n in listed.get(file, known) if n not in _GRAVITY}


def _held(chosen: text.Chosen, free: Mapping[str, Any]) -> dict[str, float]:
    """The parameters of a linear model that stay at another machine's values, but for those of what
    is left out, which are zero."""
    if not chosen.linear:
        return {}
    assert isinstance(chosen.name, dict)
    own = linear_models.linear_model(chosen.name["linear"]).vehicle().constants
    values = {name: constant.value for name, constant in own.items()}
    return {n: v for n, v in values.items() if v and n not in free and n not in _GRAVITY}
