"""Inputs that were measured with noise: errors in variables.

A rotor's speed or the position of a surface is an input that a sensor measured. The model is driven
by its noise as well, which the machine never felt: estimates are drawn towards less response
(attenuation; Fuller, Measurement Error Models, 1987), with residuals that hardly
show it. A command is another matter: its noise acts. What tells the two apart is the residual: the
noise of a sensor is in it with the response that the model has to it, that of a command is not.
"""

from collections.abc import Mapping

import jax
import numpy as np

from heli_jax import naming
from heli_jax.dynamics.kinematics import is_kinematic
from heli_jax.finding import Finding
from heli_jax.identification.estimation.evaluation import Evaluation, evaluate
from heli_jax.identification.problem import Problem
from heli_jax.identification.unknowns.layout import Data, Solution
from heli_jax.identification.validation.other_hold import pseudoinverse
from heli_jax.numerics.white_noise import white_part

_MATTERS = 0.5
"""sds of an estimate by which the noise has to move it"""
_CLEAR = 4.0
"""sds from zero of the part of the noise that the residual has in it"""
_MOST_OFF = 4.0
"""sds from one of that part"""
_DRAWS = 3
"""of noise, each with either sign, by which the shift is found"""
_WINDOW = 9
"""samples of the parabola that is taken for the motion"""
_FEWEST = 100
"""samples of a flight"""
_MOST = 3
"""parameters that are named"""


def noisy_inputs(
    problem: Problem,
    at: Solution,
    e: Evaluation,
    estimates: Mapping[str, tuple[float, float | None]],
) -> list[Finding]:
    """The inputs whose noise is a sensor's and moves an estimate by half its sd or more.

    Args:
        problem: what was fitted.
        at: where the fit ended.
        e: the evaluation there.
        estimates: value and sd of those of interest, SI.
    """
    layout = at.layout
    if is_kinematic(layout.model) or layout.estimator.noise_spectrum or problem.window is not None:
        return []
    inputs = [_of_input(problem, at, e, estimates, n) for n in naming.names(layout.model.Inputs)]
    return [one for one in inputs if one is not None]


def _of_input(
    problem: Problem,
    at: Solution,
    e: Evaluation,
    estimates: Mapping[str, tuple[float, float | None]],
    name: str,
) -> Finding | None:
    flights = problem.training
    # A command in steps has no noise of a sensor; of short flights little is known.
    if any(f.hold[name] != "linear" or f.n_samples < _FEWEST for f in flights):
        return None
    noise = [white_part(f.inputs[name]) for f in flights]
    if not max(noise) > 1e-4 * max(float(np.std(f.inputs[name])) for f in flights):
        return None
    # By one evaluation; how far it moves the estimates takes several.
    if not _in_residual(at, e, name):
        return None
    moved = _moved(problem, at, e, estimates, name, noise)
    if not any(abs(sds) > _MATTERS for _, sds in moved.values()):
        return None
    size = f"{max(noise):.2g} {naming.unit(at.layout.model.Inputs, name) or ''}".rstrip()
    each = [f"{n} by about {100 * part:+.2g} %" for n, (part, _) in _largest(moved)]
    words = (
        f"{name} was measured with a noise of {size}, which the vehicle did not feel but which "
        f"drives the model: it moves {', '.join(each)}. Use the logged command if there is one, or "
        "a lower rate of the flight."
    )
    values = dict(zip(at.layout.of_interest, np.asarray(e.named).tolist(), strict=True))
    # The noise has moved the estimate: without it the estimate lies on the other side.
    shifts = {n: -part * values[n] for n, (part, _) in moved.items()}
    brief = f"{name} is measured with noise"
    criterion = "sd of the noise, in the unit of the input"
    return Finding(
        "dynamics.noisy-input", "doubt", words, max(noise), criterion, (name,), shifts, brief
    )


def _moved(
    problem: Problem,
    at: Solution,
    e: Evaluation,
    estimates: Mapping[str, tuple[float, float | None]],
    name: str,
    noise: list[float],
) -> dict[str, tuple[float, float]]:
    """By parameter how far noise of these sds, one of each flight, moves its estimate."""
    # As much noise again moves the estimates as much again (Cook and Stefanski, 1994). With either
    # sign of each draw what is of first order in it, which has no mean, goes out.
    rng = np.random.default_rng(29)
    q = len(at.layout.of_interest)
    change = np.zeros(q)
    for _ in range(_DRAWS):
        draw = [
            sd * rng.standard_normal(f.n_samples)
            for sd, f in zip(noise, problem.training, strict=True)
        ]
        for sign in (1.0, -1.0):
            other = evaluate(
                at.layout, _added(at.data, name, [sign * n for n in draw]), at.noise, at.z
            )
            if not (np.isfinite(other.r).all() and np.isfinite(other.J).all()):
                return {}
            step = pseudoinverse(np.asarray(other.J))[:q] @ (np.asarray(e.r) - np.asarray(other.r))
            change += step / (2 * _DRAWS)
    moved = {}
    for k, parameter in enumerate(at.layout.of_interest):
        value, by = float(np.asarray(e.named)[k]), float(change[k] * np.asarray(e.slopes)[k])
        sd = estimates.get(parameter, (value, None))[1]
        if parameter in at.layout.free and value and sd:
            moved[parameter] = (by / value, by / sd)
    return moved


def _in_residual(at: Solution, e: Evaluation, name: str) -> bool:
    """Whether the residual has the response to the input's fast part in it, once."""
    fast = [-_fast(np.asarray(getattr(f.inputs, name))) for f in at.data.flights]
    smooth = evaluate(at.layout, _added(at.data, name, fast), at.noise, at.z)
    d = np.asarray(smooth.r) - np.asarray(e.r)
    if not np.isfinite(d).all():
        return False
    Q, _ = np.linalg.qr(np.asarray(e.J) / np.maximum(np.linalg.norm(e.J, axis=0), 1e-300))
    d = d - Q @ (Q.T @ d)
    power = float(d @ d)
    if not power > 0:
        return False
    r = np.asarray(e.r)
    part = -float(d @ r) / power
    # Rows that are not white tell less than as many that are: by the products themselves.
    sd = float(np.linalg.norm(d * (r + part * d))) / power
    return part > _CLEAR * sd and abs(part - 1.0) < max(_MOST_OFF * sd, 0.3)


def _largest(moved: Mapping[str, tuple[float, float]]) -> list[tuple[str, tuple[float, float]]]:
    return sorted(moved.items(), key=lambda item: -abs(item[1][1]))[:_MOST]


def _fast(u: np.ndarray) -> np.ndarray:
    """What of an input (N,) is faster than a parabola over a few samples follows."""
    # As scipy.signal.savgol_filter has it, of which one function imports a second of others.
    powers = np.vander(np.arange(_WINDOW) - _WINDOW // 2, 3).astype(float)
    fitted, half = powers @ np.linalg.pinv(powers), _WINDOW // 2
    smooth = np.convolve(u, fitted[half][::-1], mode="valid")
    first, last = fitted[:half] @ u[:_WINDOW], fitted[half + 1 :] @ u[-_WINDOW:]
    return u - np.concatenate([first, smooth, last])


def _added(data: Data, name: str, more: list[np.ndarray]) -> Data:
    """With this added to an input, one array of each flight."""
    flights = []
    for flight, add in zip(data.flights, more, strict=True):
        inputs = naming.asdict(flight.inputs)
        inputs[name] = np.asarray(inputs[name]) + np.asarray(add, np.asarray(inputs[name]).dtype)
        flights.append(flight._replace(inputs=type(flight.inputs)(**inputs)))
    return data._replace(flights=jax.device_put(tuple(flights)))
