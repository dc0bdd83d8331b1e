"""A simulated manoeuvre as a page: its figures, and the flight in 3D, in one file."""

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
"""what no state of a vehicle reaches, and no figure can draw"""


# Parameters of a model are a class of the user's own: they are annotated Any.


class Shown(NamedTuple):
    """A run as the page holds it."""

    name: str
    pictures: list[Picture]
    scene: int | None
    """the flight in 3D, of a whole helicopter: its number among the page's scenes"""
    size: float
    """how many times its size the vehicle is drawn there"""


def write_view(
    path: Path,
    runs: Mapping[str, Trajectory],
    model: Model,
    params: Any,
    title: str,
    notes: Sequence[str] = (),
    made: Origin | None = None,
) -> None:
    """Write the page of some runs of a model, with NumPy arrays, by their names.

    It loads nothing from outside itself, and titles and names are escaped.

    Raises:
        OSError: the place cannot be written to.
    """
    whole = is_full_nonlinear(model)
    shown, numbers = [], Numbers()
    for name, whole_run in list(runs.items())[:MOST_FLIGHTS]:
        run = _finite(whole_run)
        number, size = None, 1.0
        # Of two samples one may still not be finite: figures leave it out, a 3D scene cannot.
        if whole and _good(run).all():
            number, size = len(numbers.scenes), size_of(run, float(params.R))
            numbers.scenes.append(scene(run, params, numbers, name))
        shown.append(Shown(name, _pictures(run, model, numbers), number, size))
    # Flights that are not drawn are counted on the page, so that nobody takes those shown for all.
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
    """The run up to where it ceases to be finite; two samples at least."""
    good = _good(run)
    return run if good.all() else run.first(max(2, int(np.argmin(good))))


def _pictures(run: Trajectory, model: Model, numbers: Numbers) -> list[Picture]:
    made = [
        picture(figure.__name__, functools.partial(figure, run, model), numbers)
        for figure in (figures.motion, figures.sticks)
    ]
    return [p for p in made if p is not None]


# The path, the attitude, and the shape of a vehicle that flies along it: `assets/flight.js` draws
# them. States and parameters are records of a model, a class of the user's own: annotated Any.

MOST_MOMENTS = 3000
"""of a flight, between which the page interpolates"""
_SMALLEST = 0.1
"""rotor diameter over the length of the path: a smaller vehicle is drawn larger"""
_AROUND = 16
"""corners of what is round"""
_DIGITS = 4
"""of a coordinate of the shape [m]: a tenth of a millimetre is more than a screen shows"""

type Points = Float[np.ndarray, "n 3"]


def moments_of(n: int) -> np.ndarray:
    """Return the indices of the samples kept: all of n, or at most `MOST_MOMENTS` evenly spaced."""
    # Rounded, not truncated: the first and the last sample are among them.
    return np.unique(np.round(np.linspace(0, n - 1, min(n, MOST_MOMENTS))).astype(int))


def size_of(run: Trajectory, R: float) -> float:
    """Return the magnification of the drawn vehicle, so that it is visible on a long path."""
    path = _path(run.states)
    # Whole numbers: the page says 'drawn 3 times its size'.
    length = float(np.max(np.ptp(path, axis=0)))
    return float(np.ceil(max(1.0, _SMALLEST * length / (2.0 * R))))


def attitude(states: Any) -> Rotation:
    """The turns from body axes (forward, right, down) to x, y and down."""
    angles = [np.asarray(getattr(states, n)) for n in ("psi", "theta", "phi")]
    return Rotation.from_euler("ZYX", np.stack(angles, axis=-1))


def placed(shape: Points, turn: Rotation, at: np.ndarray) -> Points:
    """A shape in body axes (forward, right, down) in the figure: forward, left and up.

    Args:
        shape: points [m].
        at: (3,) position of the body's origin in the figure [m].
    """
    # Forward, left and up are right-handed, as a viewer takes axes to be; forward, right and up
    # are not, and the vehicle would be its mirror image.
    return turn.apply(shape) * np.array([1.0, -1.0, -1.0]) + at


def scene(run: Trajectory, params: Any, numbers: Numbers, name: str = "") -> dict[str, Any]:
    """The flight as plain data; its arrays go to the page's numbers."""
    path, size, R = _path(run.states), size_of(run, float(params.R)), float(params.R)
    kept, pod = moments_of(path.shape[0]), _pod(R)
    fan = [[0, 1 + i, 1 + (i + 1) % _AROUND] for i in range(_AROUND)]
    bounds = np.stack([path.min(axis=0) - 2.2 * size * R, path.max(axis=0) + 2.2 * size * R])
    # Quaternions and not angles: between two headings of 359 and 1 degree lie two degrees.
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
    """(n, 4), each of the two signs of a turn that is nearer to the one before."""
    along = np.sum(quaternions[1:] * quaternions[:-1], axis=1)
    signs = np.concatenate([[1.0], np.cumprod(np.where(along < 0.0, -1.0, 1.0))])
    return quaternions * signs[:, None]


def _path(states: Any) -> Points:
    """The positions in the figure's axes: forward, left and up."""
    x, y, z = (np.asarray(getattr(states, n), np.float64) for n in ("x", "y", "z"))
    return np.stack([x, -y, z], axis=1)


def _rounded(points: Points) -> list[list[float]]:
    return np.round(points, _DIGITS).tolist()


def _circle(radius: float) -> tuple[np.ndarray, np.ndarray]:
    angle = 2.0 * np.pi * np.arange(_AROUND) / _AROUND
    return radius * np.cos(angle), radius * np.sin(angle)


def _pod(R: float) -> Points:
    """The fuselage: an ellipsoid of rings between two ends, nose first."""
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
    # Never within the fuselage, however little a vehicle's file says that it lies above.
    return np.array([-float(p.lr), 0.0, -max(float(p.hr), 0.3 * float(p.R))])


def _outlines(p: Any) -> list[Points]:
    """Mast, tail boom with fin, tail rotor, rotor's rim, skids and their legs, each a line."""
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
    """About five round numbers between two."""
    # 1, 2 or 5 times a power of ten, at most eight of them; + 0.0 turns -0 into 0.
    step = 10.0 ** np.floor(np.log10((high - low) / 5.0))
    step *= next(f for f in (1.0, 2.0, 5.0, 10.0) if (high - low) / (f * step) <= 7.0)
    return step * np.arange(np.ceil(low / step), np.floor(high / step) + 1.0) + 0.0
