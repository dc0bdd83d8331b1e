"""Files and page of a designed flight."""

import functools
import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from heli_jax import naming
from heli_jax.flights.write import write_table
from heli_jax.identification.design.accuracy import DETERMINES
from heli_jax.identification.design.autopilots import (
    ardupilot_parameters,
    betaflight_commands,
    transmitter_script,
)
from heli_jax.identification.flight_design import CRITERIA, Rated
from heli_jax.numbers import number
from heli_jax.report import style
from heli_jax.report.charts import Chart, Numbers, Series, panel, samples, time_limits
from heli_jax.report.files import as_json
from heli_jax.report.origin import origin
from heli_jax.report.page import filled, picture
from heli_jax.report.style import label
from heli_jax.report.tables import Table

# `run` is a DesignRun of `heli_jax.design_workflow`, which imports this module.

_FILES = ("design.json", "input.csv")
_GAIN = 1e-3
"""Share of the sd below which an optimum is no better than the library."""
_ROWS = 12
"""Manoeuvres of the library in a table."""


def manoeuvres_table(run: Any, most: int = _ROWS) -> Table:
    """Return the optimum, the user's inputs and the best of the library, a row each."""
    design = run.design
    names = list(dict.fromkeys([*products(run), *design.optimum.sd]))
    rows, played = [], _played(run).values()
    library = [
        r for i, r in enumerate(design.library) if i < most or any(r is chirp for chirp in played)
    ]
    for rated in (design.optimum, *([design.own] if design.own else []), *library):
        tight = min(rated.margins, key=lambda n: rated.margins[n])
        sds = [design.sd_of(rated, n) for n in names]
        cells = [_percent(sd) if sd < DETERMINES else "not determined" for sd in sds]
        if run.wanted:
            needed = design.needed(rated, run.wanted)
            words = f"{needed:.3g} s" if needed > design.duration else "one run"
            cells.append(words if math.isfinite(needed) else "never")
        # Inputs are made smaller to a millionth below a limit.
        margin = rated.margins[tight] if abs(rated.margins[tight]) > 1e-5 else 0.0
        rows.append((rated.words, *cells, f"{_percent(margin)} ({tight})"))
    head = ("input", *(f"sd {n}" for n in names), *(("enough after",) if run.wanted else ()))
    return Table((*head, "least margin"), rows)


def products(run: Any) -> list[str]:
    """Return the criterion and the wanted products, if they are products."""
    asked = [] if run.design.criterion in CRITERIA else [run.design.criterion]
    return [*asked, *run.wanted]


def _percent(share: float) -> str:
    return f"{number(100.0 * share, 2)} %"


def summary(run: Any) -> str:
    """Return what the design gains on the sds of the table, in a sentence."""
    design = run.design

    def size(rated: Rated) -> tuple[str, float]:
        """Return what is compared, and its value."""
        sds = np.array(list(rated.sd.values()))
        if design.criterion == "D":
            return "geometric mean of the sds", float(np.exp(np.mean(np.log(sds))))
        if design.criterion == "A":
            return "rms of the sds", float(np.sqrt(np.mean(sds**2)))
        if design.criterion == "E":
            return "largest sd", float(np.max(sds))
        return f"sd of {design.criterion}", design.sd_of(rated, design.criterion)

    best = min(design.library, key=lambda rated: size(rated)[1])
    (what, after), (_, before) = size(design.optimum), size(best)
    gain = 1.0 - after / before
    if not gain >= _GAIN:
        return f"No input was found with a lower {what} than {best.words}."
    return f"The optimised input lowers the {what} by {_percent(gain)} against {best.words}."


def _played(run: Any) -> dict[str, Rated]:
    """Return the best chirp of each kind that an autopilot plays."""
    found = {}
    for rated in run.design.library:
        if (kind := rated.manoeuvre.kind).endswith("-chirp"):
            found.setdefault(kind, rated)
    return found


def known_differences(run: Any) -> list[str]:
    """Return the differences that the design chose, a sentence for each run that has some."""
    return [
        f"Run {i + 1}: {', '.join(f'{n} = {number(v)}' for n, v in own.items())}"
        for i, own in enumerate(run.design.optimum.known)
        if own
    ]


def write_design(folder: Path, run: Any, config: str) -> None:
    """Write design.json, input.csv, report.html and figures/ of a design."""
    columns = input_columns(run)
    write_table(folder / "input.csv", columns)
    (folder / "design.json").write_text(as_json(_content(run)) + "\n", encoding="utf-8")
    played = autopilot_files(run)
    for name, file in played.items():
        (folder / name).write_text(file.text, encoding="utf-8")
    (folder / "figures").mkdir()
    numbers, pictures = Numbers(), []
    for i in range(len(run.problem.training)):
        draw = functools.partial(_draw, run, i)
        name = f"run-{i + 1}" if len(run.problem.training) > 1 else "run"
        pictures.append(picture(name, draw, numbers, folder=folder / "figures"))
    page = filled(
        "design.html.j2",
        title=run.config.path.stem,
        summary=summary(run),
        doubts=doubts(run),
        table_of=manoeuvres_table(run),
        known=known_differences(run),
        played=signals_played(run),
        pictures=[p for p in pictures if p is not None],
        numbers=numbers.content(),
        origin=origin(config, (*_FILES, *played)),
    )
    (folder / "report.html").write_text(page, encoding="utf-8")


def doubts(run: Any) -> list[str]:
    """Return what limits the trust in a design."""
    design, found = run.design, []
    if not design.converged:
        found.append(
            f"The optimiser stopped after {design.steps} steps before it converged: a larger "
            "design.max_steps may give a better input."
        )
    if lost := design.optimum.undetermined:
        found.append(
            f"The optimised input does not determine {', '.join(lost)}: a prior, another output or "
            "a second run with a known difference is needed."
        )
    limits, kinds = run.settings.inputs.values(), _played(run)
    for key, words in (("ardupilot", "ArduPilot"), ("betaflight", "Betaflight")):
        if any(getattr(limit, key) for limit in limits) and f"{key}-chirp" not in kinds:
            found.append(f"No chirp of {words} fits in the flight: it must last longer.")
    own = [("Your own inputs exceed", design.own)] if design.own else []
    for words, rated in [("The optimised input exceeds", design.optimum), *own]:
        if over := [n for n, m in rated.margins.items() if m < -1e-9]:
            found.append(f"{words} the limits of {', '.join(over)}.")
    drawn = [f for f in run.problem.free.values() if f.prior or None not in (f.lower, f.upper)]
    if run.settings.vehicles > 1 and not drawn:
        found.append(
            f"The {run.settings.vehicles} vehicles are all equal: no free parameter has a prior or "
            "two bounds."
        )
    return found


def input_columns(run: Any) -> dict[str, np.ndarray]:
    """Return time and excitations in the units of `design.inputs`, one run after another."""
    parts: list[dict[str, Any]] = []
    for i, (flight, own) in enumerate(
        zip(run.problem.training, run.design.optimum.inputs, strict=True)
    ):
        part = {"time [s]": np.arange(flight.n_samples) * flight.dt}
        if len(run.problem.training) > 1:
            part = {"run": np.full(flight.n_samples, i + 1)} | part
        for name, limit in run.limits.inputs.items():
            scale = run.settings.inputs[name].amplitude / limit.amplitude
            settings, model = run.settings.inputs[name], run.problem.model
            unit = settings.unit or _unit(model, name, settings.set_point)
            part[f"{name} [{unit}]"] = scale * own[name]
        parts.append(part)
    return {n: np.concatenate([p[n] for p in parts]) for n in parts[0]}


def _unit(model: Any, name: str, set_point: str | None) -> str:
    """Return the SI unit of the excitation of an input, or of a state's set point."""
    of = (model.Inputs, name) if set_point is None else (model.State, set_point)
    return naming.unit(*of) or "1"


class Played(NamedTuple):
    """A file for an autopilot or a transmitter."""

    text: str
    signal: str
    """Manoeuvre that it plays."""


def autopilot_files(run: Any) -> dict[str, Played]:
    """Return by name the files of the first run for autopilots and transmitters.

    Autopilots play the best of their own chirps, a transmitter the optimised input.
    """
    settings, flight = run.settings, run.problem.training[0]
    files: dict[str, Played] = {}
    chirps, shares = _played(run), []
    for i, (name, limit) in enumerate(settings.inputs.items()):
        scale = limit.amplitude / run.limits.inputs[name].amplitude
        if limit.full_stick is not None:
            own = run.design.optimum.inputs[0][name]
            shares.append((name, scale * own / limit.full_stick))
        for kind, chirp in chirps.items():
            of = chirp.manoeuvre
            assert of is not None
            duration = of.length(flight.n_samples, len(settings.inputs)) * flight.dt
            band, fade = of.settings["band"], of.settings["fade"]
            # Sampled sines may not reach their amplitude.
            whole = of.samples(flight.n_samples, flight.dt, [np.inf] * len(settings.inputs))[i]
            size = float(np.max(np.abs(chirp.inputs[0][name])) / np.max(np.abs(whole)))
            if kind == "ardupilot-chirp" and limit.ardupilot is not None:
                text = ardupilot_parameters(band, limit.ardupilot, size, duration, fade)
                files[f"ardupilot-{name}.param"] = Played(text, chirp.words)
            if kind == "betaflight-chirp" and limit.betaflight is not None:
                text = betaflight_commands(band, limit.betaflight, size, duration)
                files[f"betaflight-{name}.txt"] = Played(text, chirp.words)
    if shares:
        text = transmitter_script(flight.dt, shares)
        files["input.lua"] = Played(text, run.design.optimum.words)
    return files


def signals_played(run: Any) -> list[str]:
    """Return which signal each file of a design plays, a sentence for each signal."""
    by_signal = {run.design.optimum.words: ["input.csv"]}
    for name, file in autopilot_files(run).items():
        by_signal.setdefault(file.signal, []).append(name)
    return [f"{' and '.join(names)}: {signal}" for signal, names in by_signal.items()]


def _content(run: Any) -> dict[str, Any]:
    design = run.design

    def of(rated: Rated) -> dict[str, Any]:
        content = {
            "input": rated.words,
            "criterion": _finite(rated.value),
            "sd": {n: _finite(v) for n, v in rated.sd.items()},
            "undetermined": list(rated.undetermined),
            "margins": {n: _finite(v) for n, v in rated.margins.items()},
            "known": [dict(own) for own in rated.known],
        }
        if run.wanted:
            content["seconds_needed"] = _finite(design.needed(rated, run.wanted))
        return content

    return {
        "criterion": design.criterion,
        "duration": design.duration,
        "wanted": dict(run.wanted),
        "converged": design.converged,
        "steps": design.steps,
        "optimum": of(design.optimum),
        "own": None if design.own is None else of(design.own),
        "library": [of(rated) for rated in design.library],
    }


def _finite(value: float) -> float | None:
    """Return a number, or None for infinity, which JSON lacks."""
    return value if math.isfinite(value) else None


def _draw(run: Any, i: int) -> Chart:
    """Draw the excitations and the limited motion of a run."""
    flight, model = run.problem.training[i], run.problem.model
    t, motion = np.arange(flight.n_samples) * flight.dt, run.design.optimum.motion[i]
    panels = []
    for name, limit in run.limits.inputs.items():
        own, point = run.design.optimum.inputs[i][name], run.settings.inputs[name].set_point
        unit = _unit(model, name, point)
        panels.append(
            panel(
                label(name, unit),
                [Series("", t, own, style.BLACK, "step", width=0.9)],
                1.0,
                levels=(-limit.amplitude, limit.amplitude),
            )
        )
    records = {n: r for r in (model.Inputs, model.State, model.Outputs) for n in naming.names(r)}
    for name, most in run.limits.motion.items():
        series = [samples("", t, motion[name], style.BLUE, 0.9)]
        ends = (-1.1 * most, 1.1 * most)
        panels.append(
            panel(
                label(name, naming.unit(records[name], name)),
                series,
                1.0,
                limits=ends,
                levels=(-most, most),
            )
        )
    title = f"Optimised input and motion, {flight.name}"
    return Chart(
        title, "time [s]", time_limits(t), tuple(panels), "Lines: the limits.", of=flight.name
    )
