"""`heli-jax models`: what a model is, and a configuration that designs a flight for it."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from heli_jax import models, naming, summaries
from heli_jax.analysis.linear import eigenmodes
from heli_jax.cli.terminal import print_text
from heli_jax.dynamics.jacobians import jacobians
from heli_jax.dynamics.model import vehicle_constants
from heli_jax.errors import InputError
from heli_jax.linear_models.read import linear_model
from heli_jax.new_config import tables
from heli_jax.numbers import terse
from heli_jax.report.tables import Table
from heli_jax.run_directory import whole_file
from heli_jax.summaries import Row
from heli_jax.yaml_file import EDIT


def print_models(name: str | None, *, as_json: bool) -> None:
    """Print the list of models, or what one is."""
    if name is None:
        listed = models.listed()
        width = max(map(len, listed))
        lines = [f"{one:{width}}  {words}" for one, words in listed.items()]
        print(json.dumps(listed, indent=1)) if as_json else print_text("\n".join(lines))
        return
    title, tables = described(name)
    if as_json:
        content = {
            words: [dict(zip(t.head, row, strict=True)) for row in t.rows]
            for words, t in tables.items()
        }
        print(json.dumps({"model": title, **content}, indent=1))
        return
    print_text(title)
    for words, t in tables.items():
        print_text(summaries.as_text(words, t.head, t.rows))


def described(text: str) -> tuple[str, dict[str, Table]]:
    """Return name and meaning of a model, and its tables in SI.

    Args:
        text: name of the model as for `models.by_text`.

    Raises:
        InputError: there is no such model, or its file is wrong.
    """
    model, name = models.by_text(text, "models")
    linear = linear_model(name["linear"]) if isinstance(name, dict) else None
    constants = {} if linear is None else linear.vehicle().constants
    meaning = models.listed().get(str(name), "") if linear is None else linear.content.meaning
    records = {"states": model.State, "inputs": model.Inputs, "outputs": model.Outputs}
    head = ("name", "unit", "meaning")
    tables = {title: Table(head, _rows(record)) for title, record in records.items()}
    defaults = vehicle_constants(model)
    sources = {n: c.source for n, c in constants.items()}
    rows = [
        (n, terse(defaults[n], 5), *words, sources.get(n, ""))
        for n, *words in _rows(model.Params)
        if n in defaults
    ]
    head = ("name", "value", "unit", "meaning", "source")
    tables["parameters"] = Table(head, rows)
    if linear is not None:
        modes = [(m, m.eigenvalue.real) for m in eigenmodes(model, linear.vehicle().params)]
        # Time constant of the envelope; it is negative if the mode grows.
        cells = [
            (m.name, *map(terse, (m.frequency, m.damping, -1.0 / real if real else None)))
            for m, real in modes
        ]
        head = ("mode", "frequency [rad/s]", "damping", "time constant [s]")
        tables["modes"] = Table(head, cells)
    return f"{model.name}: {meaning}", tables


def _rows(record: Any) -> list[Row]:
    names = naming.names(record)
    return [(n, naming.unit(record, n) or "", naming.meaning(record, n)) for n in names]


# A configuration with guessed limits.

_NOISE = {"rad/s": 0.01, "rad": 0.005, "m/s": 0.1, "m": 0.05, "m/s^2": 0.1}
"""sd of a small vehicle's sensors by unit, a guess."""
_MOST = {"rad/s": 1.0, "rad": 0.5, "m/s": 5.0}
"""Limits of the motion by unit, a guess."""
_AMPLITUDE = {"1": 0.1, "rad": 0.05}
"""Deflections of inputs by unit, a guess."""
_GUSTS = 0.5
"""sd of the angular acceleration by gusts [rad/s^2], a guess."""
_SECONDS, _RATE = 20, 50


def write_design_config(text: str, out: Path) -> None:
    """Write a configuration with the parameters of a linear model and guessed limits.

    Args:
        text: a linear model as for `models.by_text`.

    Raises:
        InputError: there is no such model, it is not linear from a file, or the file exists.
    """
    model, name = models.by_text(text, "models")
    if not isinstance(name, dict):
        raise InputError(
            f"--config: {model.name} needs a vehicle file; expected a linear model, or "
            "heli-jax new LOG --model NAME"
        )
    if out.exists():
        raise InputError(f"--config {out}: exists, expected a new file")
    params = linear_model(name["linear"]).vehicle().params
    inputs, outputs = ({n: naming.unit(r, n) or "1" for n in naming.names(r)} for r in (
        model.Inputs, model.Outputs))  # fmt: skip
    gains = _gains(model, params) if _unstable(model, params) else {}
    # Parameters that one record of the model determines.
    free = tables.models().get(name["linear"], [n for n in naming.names(model.Params) if n != "g"])
    known = [n for n in naming.names(model.Params) if n not in free]
    lines = [
        f"# Designs a flight for {name['linear']}. Check the lines marked GUESS, then run",
        f"# heli-jax design {out}",
        f"model: {{linear: {name['linear']}}}",
        "fit:",
        # The simulation of an unstable vehicle leaves any record, so it needs the filter.
        *(["  method: filter-error"] if gains else []),
        f"  free:{f'  # known: {", ".join(known)}' if known else ''}",
    ]
    lines += [f"    {n}: {{start: {terse(float(getattr(params, n)), 5)}}}" for n in free]
    if gains and model.axes:
        axis = model.axes[0].name
        gusts = f"{{axis: {axis}, poles: 1, sigma_w: {_GUSTS}, tau_w: 1.0}}"
        lines += [f"disturbance: {gusts}  # GUESS: gusts [rad/s^2] and their time constant [s]"]
    lines += ["simulate:", f"  duration: {_SECONDS}", f"  rate: {_RATE}", "  noise:  # GUESS"]
    lines += [f"    {n}: {{sd: {_NOISE.get(u, EDIT)}}}  # {u}" for n, u in outputs.items()]
    lines += ["design:", "  inputs:  # GUESS"]
    lines += [f"    {n}: {_limit(model, n, u, gains)}" for n, u in inputs.items()]
    limited = {n: u for n, u in outputs.items() if u in _MOST}
    if limited:
        lines += ["  motion:  # GUESS"]
        lines += [f"    {n}: {{most: {_MOST[u]}}}  # {u}" for n, u in limited.items()]
    if gains:
        lines += ["  feedback:  # GUESS: a quadratic regulator; state the gains of your autopilot"]
        lines += [
            f"    {n}: {{{', '.join(f'{s}: {k:.4g}' for s, k in by_state.items())}}}"
            for n, by_state in gains.items()
        ]
    with whole_file(out, f"--config {out}") as temporary:
        temporary.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _unstable(model: Any, params: Any) -> bool:
    return any(m.eigenvalue.real > 1e-6 for m in eigenmodes(model, params))


def _gains(model: Any, params: Any) -> dict[str, dict[str, float]]:
    """Return the gains of a quadratic regulator by input and state; none with delays."""
    from scipy.linalg import solve_continuous_are

    if model.delays:
        return {}
    A, B, _, _ = (np.asarray(m) for m in jacobians(model, params))
    states, inputs = naming.names(model.State), naming.names(model.Inputs)

    def weights(record: type, names: tuple[str, ...], sizes: dict[str, float]) -> np.ndarray:
        known = [sizes.get(naming.unit(record, n) or "1") for n in names]
        return np.diag([0.0 if v is None else v**-2.0 for v in known])

    Q = weights(model.State, states, _MOST) + 1e-9 * np.eye(len(states))
    R = weights(model.Inputs, inputs, _AMPLITUDE) + 1e-9 * np.eye(len(inputs))
    K = np.linalg.solve(R, B.T @ solve_continuous_are(A, B, Q, R))
    return {
        n: {s: float(k) for s, k in zip(states, row, strict=True)}
        for n, row in zip(inputs, K, strict=True)
    }


def _limit(model: Any, name: str, unit: str, gains: dict[str, dict[str, float]]) -> str:
    """Return the limits of an input, and where ArduPilot adds its chirp."""
    axis = next((a for a in model.axes if a.stick == name), None)
    if axis is not None and axis.name not in ("roll", "pitch", "yaw"):
        axis = None
    if axis is not None and gains.get(name, {}).get(axis.rate):
        return f"{{amplitude: 0.3, set_point: {axis.rate}, ardupilot: rate-{axis.name}}}  # rad/s"
    # The command of a model without a rotor may be that of an autopilot's loop.
    rotor = axis is not None and axis.tilt and unit == "1"
    place = f", ardupilot: mixer-{axis.name}" if axis is not None and rotor else ""
    return f"{{amplitude: {_AMPLITUDE.get(unit, EDIT)}{place}}}  # {unit}"
