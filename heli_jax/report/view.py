"""Page of a simulated manoeuvre: its figures, and the flight in 3D, in one file."""

import functools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from heli_jax.analysis.trim import is_full_nonlinear
from heli_jax.dynamics.model import Model
from heli_jax.report import figures, style
from heli_jax.report.charts import Numbers
from heli_jax.report.origin import Origin, origin
from heli_jax.report.page import MOST_FLIGHTS, Picture, filled, picture
from heli_jax.simulation.trajectory import Trajectory

_HUGE = 1e9
"""Size that no state of a vehicle reaches and no figure can draw."""


# Params is Any because it may be a user's class.


class Shown(NamedTuple):
    """A run in the form stored in the page."""

    name: str
    pictures: list[Picture]
    scene: int | None
    """Number of the 3D scene on the page, for a full helicopter."""
    size: float
    """Magnification of the vehicle in the scene."""


def write_view(
    path: Path,
    runs: Mapping[str, Trajectory],
    model: Model,
    params: Any,
    title: str,
    notes: Sequence[str] = (),
    made: Origin | None = None,
) -> None:
    """Write the page of runs of a model by name, with NumPy arrays.

    It loads nothing from outside, and titles and names are escaped.

    Raises:
        OSError: the place is not writable.
    """
    whole = is_full_nonlinear(model)
    shown, numbers = [], Numbers()
    for name, whole_run in list(runs.items())[:MOST_FLIGHTS]:
        run = _finite(whole_run)
        number, size = None, 1.0
        # One of two samples may still be NaN. Figures skip it, but a 3D scene cannot.
        if whole and _good(run).all():
            number, size = len(numbers.scenes), size_of(run, float(params.R))
            numbers.scenes.append(scene(run, params, numbers, name))
        shown.append(Shown(name, _pictures(run, model, numbers), number, size))
    # The page states the number of flights not drawn, so that they are not overlooked.
    page = filled(
        "view.html.j2",
        title=title,
        model=model,
        notes=notes,
        runs=shown,
        whole=whole,
        unshown=max(0, len(runs) - MOST_FLIGHTS),
        origin=made or origin(),
        numbers=numbers.content(),
    )
    path.write_text(page, encoding="utf-8")


def _good(run: Trajectory) -> np.ndarray:
    """Return a mask of the samples that can be drawn."""
    leaves = jax.tree.leaves((run.states, run.outputs))
    return np.all([np.abs(np.asarray(v)) < _HUGE for v in leaves], axis=0)


def _finite(run: Trajectory) -> Trajectory:
    """Return the run before its first non-finite sample, with at least two samples."""
    good = _good(run)
    return run if good.all() else run.first(max(2, int(np.argmin(good))))


def _pictures(run: Trajectory, model: Model, numbers: Numbers) -> list[Picture]:
    made = [
        picture(figure.__name__, functools.partial(figure, run, model), numbers)
        for figure in (figures.motion, figures.sticks)
    ]
    return [p for p in made if p is not None]


# Path, attitude and shape of a flying vehicle, drawn by `assets/flight.js`. States and parameters
# are Any, because they are user classes.

MOST_MOMENTS = 3000
"""Most moments of a flight; the page interpolates between them."""
_SMALLEST = 0.1
"""Least rotor diameter relative to the length of the path; smaller vehicles are enlarged."""
_AROUND = 16
"""Corners of round shapes."""
_DIGITS = 4
"""Decimals of the shape's coordinates [m]; a tenth of a millimetre is below the screen's
resolution."""

type Points = Float[np.ndarray, "n 3"]


def moments_of(n: int) -> np.ndarray:
    """Return the indices of the samples kept: all of n, or at most `MOST_MOMENTS` evenly spaced."""
    # Rounding keeps the first and the last sample; truncation might not.
    return np.unique(np.round(np.linspace(0, n - 1, min(n, MOST_MOMENTS))).astype(int))


def size_of(run: Trajectory, R: float) -> float:
    """Return the magnification of the drawn vehicle, so that it is visible on a long path."""
    path = _path(run.states)
    # Whole numbers suit the page's text 'drawn 3 times its size'.
    length = float(np.max(np.ptp(path, axis=0)))
    return float(np.ceil(max(1.0, _SMALLEST * length / (2.0 * R))))


def attitude(states: Any) -> Rotation:
    """Return the rotations from body axes (forward, right, down) to x, y and down."""
    angles = [np.asarray(getattr(states, n)) for n in ("psi", "theta", "phi")]
    return Rotation.from_euler("ZYX", np.stack(angles, axis=-1))


def placed(shape: Points, turn: Rotation, at: np.ndarray) -> Points:
    """Return a shape in the figure's axes: forward, left and up.

    Args:
        shape: points in body axes (forward, right, down) [m].
        at: (3,) position of the body's origin in the figure [m].
    """
    # Forward, left and up are right-handed, as viewers expect. With forward, right and up the
    # vehicle would be its mirror image.
    return turn.apply(shape) * np.array([1.0, -1.0, -1.0]) + at


def scene(run: Trajectory, params: Any, numbers: Numbers, name: str = "") -> dict[str, Any]:
    """Return the flight as plain data; its arrays are stored in the page's numbers."""
    path, size, R = _path(run.states), size_of(run, float(params.R)), float(params.R)
    kept, pod = moments_of(path.shape[0]), _pod(R)
    fan = [[0, 1 + i, 1 + (i + 1) % _AROUND] for i in range(_AROUND)]
    bounds = np.stack([path.min(axis=0) - 2.2 * size * R, path.max(axis=0) + 2.2 * size * R])
    # Quaternions interpolate correctly: headings of 359 and 1 degree differ by two degrees.
    turns = _continuous(attitude(run.states).as_quat()[kept])
    return {
        "name": name,
        "times": numbers.array(np.asarray(run.times)[kept], exact=True),
        "path": [numbers.array(v) for v in path[kept].T],
        "turns": [numbers.array(v) for v in turns.T],
        "bounds": bounds.tolist(),
        "ticks": [_ticks(low, high).tolist() for low, high in bounds.T],
        "parts": [
            {"faces": ConvexHull(pod).simplices.tolist(), "points": _rounded(size * pod),
             "color": style.VERMILLION, "alpha": 1.0},
            {"faces": fan, "points": _rounded(size * _disk(params)),
             "color": style.GREY, "alpha": 0.4},
        ],
        "outlines": [_rounded(size * line) for line in _outlines(params)],
    }  # fmt: skip


def _continuous(quaternions: np.ndarray) -> np.ndarray:
    """Return quaternions (n, 4) with the signs that are nearest to the previous ones."""
    along = np.sum(quaternions[1:] * quaternions[:-1], axis=1)
    signs = np.concatenate([[1.0], np.cumprod(np.where(along < 0.0, -1.0, 1.0))])
    return quaternions * signs[:, None]


def _path(states: Any) -> Points:
    """Return the positions in the figure's axes: forward, left and up."""
    x, y, z = (np.asarray(getattr(states, n), np.float64) for n in ("x", "y", "z"))
    return np.stack([x, -y, z], axis=1)


def _rounded(points: Points) -> list[list[float]]:
    return np.round(points, _DIGITS).tolist()


def _circle(radius: float) -> tuple[np.ndarray, np.ndarray]:
    angle = 2.0 * np.pi * np.arange(_AROUND) / _AROUND
    return radius * np.cos(angle), radius * np.sin(angle)


def _pod(R: float) -> Points:
    """Return the fuselage: an ellipsoid of rings between two ends, nose first."""
    a, b = _circle(1.0)
    rings = [
        np.stack([np.full(_AROUND, np.cos(s)), a * np.sin(s), b * np.sin(s)], axis=1)
        for s in np.linspace(0.0, np.pi, 7)[1:-1]
    ]
    ends = np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]])
    return np.concatenate([ends, *rings]) * R * np.array([0.62, 0.2, 0.24])


def _disk(p: Any) -> Points:
    a, b = _circle(float(p.R))
    rim = np.stack([a, b, np.zeros(_AROUND)], axis=1)
    return np.concatenate([np.zeros((1, 3)), rim]) + _hub(p)


def _hub(p: Any) -> np.ndarray:
    # The rotor is never drawn within the fuselage, however low the vehicle's file places it.
    return np.array([-float(p.lr), 0.0, -max(float(p.hr), 0.3 * float(p.R))])


def _outlines(p: Any) -> list[Points]:
    """Return mast, tail boom, fin, tail rotor, rotor rim, skids and their legs as lines."""
    R, tail, hub = float(p.R), float(p.L_T), _hub(p)
    a, b = _circle(float(p.R_T))
    wheel = np.stack([a - tail, np.zeros(_AROUND), b], axis=1)
    low, wide = 0.42 * R, 0.25 * R
    skids = [[[0.5 * R, s * wide, low], [-0.4 * R, s * wide, low]] for s in (-1.0, 1.0)]
    legs = [[[x * R, -wide, low], [x * R, 0.0, 0.15 * R], [x * R, wide, low]] for x in (0.25, -0.2)]
    rim = _disk(p)[1:]
    parts = [
        [[hub[0], 0.0, 0.0], hub],
        [[0.0, 0.0, 0.0], [-tail, 0.0, 0.0], [-tail - 0.1 * R, 0.0, -0.25 * R]],
        np.concatenate([wheel, wheel[:1]]),
        np.concatenate([rim, rim[:1]]),
        *skids,
        *legs,
    ]
    return [np.asarray(part, float) for part in parts]


def _ticks(low: float, high: float) -> np.ndarray:
    """Return about five round numbers between two."""
    # Steps are 1, 2 or 5 times a power of ten, for at most eight numbers; + 0.0 turns -0 into 0.
    step = 10.0 ** np.floor(np.log10((high - low) / 5.0))
    step *= next(f for f in (1.0, 2.0, 5.0, 10.0) if (high - low) / (f * step) <= 7.0)
    return step * np.arange(np.ceil(low / step), np.floor(high / step) + 1.0) + 0.0
