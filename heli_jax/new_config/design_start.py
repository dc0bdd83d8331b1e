"""`heli-jax models NAME --config FILE`: a configuration that designs a flight for a model."""

from pathlib import Path
from typing import Any

import numpy as np

from heli_jax import models, naming
from heli_jax.analysis.linear import eigenmodes
from heli_jax.dynamics.jacobians import jacobians
from heli_jax.errors import InputError
from heli_jax.linear_models.read import linear_model
from heli_jax.numbers import terse
from heli_jax.run_directory import whole_file
from heli_jax.yaml_file import EDIT

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
    lines = [
        f"# Designs a flight for {name['linear']}. Check the lines marked GUESS, then run",
        f"# heli-jax design {out}",
        f"model: {{linear: {name['linear']}}}",
        "fit:",
        # The simulation of an unstable vehicle leaves any record, so it needs the filter.
        *(["  method: filter-error"] if gains else []),
        "  free:  # delete what is known",
    ]
    values = naming.asdict(params)
    lines += [f"    {n}: {{start: {terse(float(v), 5)}}}" for n, v in values.items() if n != "g"]
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
    place = f", ardupilot: mixer-{axis.name}" if axis is not None and unit == "1" else ""
    return f"{{amplitude: {_AMPLITUDE.get(unit, EDIT)}{place}}}  # {unit}"
