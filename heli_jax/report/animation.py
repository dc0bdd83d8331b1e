"""A flight in 3D: a plotly figure with the path and a machine that flies along it."""

from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from heli_jax.report import style
from heli_jax.simulation.trajectory import Trajectory

MOST_FRAMES = 200
"""moments that are shown at most"""
_PATH_POINTS = 2000
_DIAGONAL = 1.45
"""of the box in plotly's units: from `_VIEWS` all of it is seen, with the titles of its axes, also
where the page is as narrow as a telephone"""
_CENTRE = {"x": 0.0, "y": 0.0, "z": -0.12}
"""of the box as it is looked at: a little low, so that the titles below it are in the picture"""
_SMALLEST = 0.1
"""rotor diameter over the length of the path: a smaller machine is drawn larger"""
_AROUND = 16
"""corners of what is round"""
_DIGITS = 4
"""of a coordinate [m]: a tenth of a millimetre is more than a screen shows"""
_LIGHT = {"ambient": 0.75, "diffuse": 0.5, "specular": 0.1}
_VIEWS = {
    "side": {"x": 0.3, "y": -1.9, "z": 0.5},
    "behind": {"x": -1.9, "y": 0.0, "z": 0.6},
    # Not straight from above: there plotly cannot tell which way is up.
    "above": {"x": -0.01, "y": 0.0, "z": 2.3},
    "three-quarter": {"x": -1.3, "y": -1.3, "z": 0.9},
}

type Points = Float[np.ndarray, "n 3"]

# States and parameters are records of a model, which may be a user's own class: annotated Any.


def frames_of(n: int) -> np.ndarray:
    """Which of n samples are shown: all, or at most `MOST_FRAMES` evenly among them."""
    # Rounded, not truncated: the first and the last sample are among them.
    return np.unique(np.round(np.linspace(0, n - 1, min(n, MOST_FRAMES))).astype(int))


def size_of(run: Trajectory, R: float) -> float:
    """How many times its size the machine is drawn, so that it can be seen on a long path."""
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
        turn: of the body.
        at: (3,) position of the body's origin in the figure [m].
    """
    # Forward, left and up are right-handed, as plotly takes its axes to be; forward, right and up
    # are not, and the machine would be its mirror image.
    return turn.apply(shape) * np.array([1.0, -1.0, -1.0]) + at


def animation(run: Trajectory, params: Any) -> dict[str, Any]:
    """The flight as a plotly figure, in plain data: data, layout and frames.

    `run` is of a whole helicopter with NumPy arrays, `params` its Helicopter.
    """
    # Plain data and not plotly's objects, which check every value of every frame: seconds.
    path, turns = _path(run.states), attitude(run.states)
    R = float(params.R)
    size = size_of(run, R)
    pod, disk, outline = (size * p for p in (_pod(R), _disk(params), _outline(params)))
    shown = frames_of(path.shape[0])

    # The frames hold points alone: colours and faces stay those of the traces that they move.
    def moving(k: int) -> list[dict[str, Any]]:
        flown = path[shown[shown <= k]]
        parts = [placed(p, turns[k], path[k]) for p in (pod, disk, outline)]
        kinds = ("scatter3d", "mesh3d", "mesh3d", "scatter3d")
        return [{"type": kind, **_xyz(p)} for kind, p in zip(kinds, (flown, *parts), strict=True)]

    bounds = _bounds(path, 2.2 * size * R)
    shadow = path.copy()
    shadow[:, 2] = bounds[0, 2] + 0.005 * np.ptp(bounds[:, 2])  # on the floor it would be cut
    still = np.unique(np.linspace(0, path.shape[0] - 1, _PATH_POINTS).astype(int))
    line = {"type": "scatter3d", "mode": "lines", "hoverinfo": "skip", "showlegend": False}
    # Traces 2 to 5 are those that the frames move; shadow and path, 0 and 1, stay.
    first = moving(int(shown[0]))
    data = [
        {**line, **_xyz(shadow[still]), "line": {"color": "#C4C4C4", "width": 3}},
        {**line, **_xyz(path[still]), "line": {"color": style.PALE, "width": 2}},
        {**line, **first[0], "line": {"color": style.BLUE, "width": 5}},
        {**_mesh(first[1], _pod_faces()), "color": style.VERMILLION, "lighting": _LIGHT},
        {**_mesh(first[2], _disk_faces()), "color": style.GREY, "opacity": 0.45},
        {**line, **first[3], "line": {"color": style.BLACK, "width": 4}},
    ]
    times = np.asarray(run.times)[shown]
    frames = [{"name": str(k), "data": moving(int(k)), "traces": [2, 3, 4, 5]} for k in shown]
    names = {f["name"]: f"{t:.2f}" for f, t in zip(frames, times, strict=True)}
    # [ms], so that the flight is played as fast as it was flown.
    pace = 1000.0 * float(times[-1] - times[0]) / max(1, len(times) - 1)
    return {"data": data, "layout": _layout(bounds, names, pace), "frames": frames}


def _path(states: Any) -> Points:
    """The positions in the figure's axes: forward, left and up."""
    x, y, z = (np.asarray(getattr(states, n), np.float64) for n in ("x", "y", "z"))
    return np.stack([x, -y, z], axis=1)


def _xyz(points: Points) -> dict[str, list[float | None]]:
    """Columns of a trace; NaN, which breaks a line, as None."""
    columns = np.round(points, _DIGITS).T.tolist()
    # JSON has no NaN; v != v is true of NaN alone.
    return {
        name: [None if v != v else v for v in column]
        for name, column in zip("xyz", columns, strict=True)
    }


def _mesh(points: dict[str, Any], faces: np.ndarray) -> dict[str, Any]:
    i, j, k = faces.T.tolist()
    return {"hoverinfo": "skip", **points, "i": i, "j": j, "k": k}


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


def _pod_faces() -> np.ndarray:
    # Points 0 and 1 are the ends, then ring by ring, as `_pod` lays them; two triangles for each
    # field between two rings.
    faces, here, rings = [], np.arange(_AROUND), 5
    after = (here + 1) % _AROUND
    for ring in range(rings - 1):
        low, high = 2 + ring * _AROUND, 2 + (ring + 1) * _AROUND
        faces.append(np.stack([low + here, low + after, high + here], axis=1))
        faces.append(np.stack([high + here, low + after, high + after], axis=1))
    last = 2 + (rings - 1) * _AROUND
    faces.append(np.stack([0 * here, 2 + here, 2 + after], axis=1))
    faces.append(np.stack([0 * here + 1, last + here, last + after], axis=1))
    return np.concatenate(faces)


def _disk(p: Any) -> Points:
    a, b = _circle(float(p.R))
    rim = np.stack([a, b, np.zeros(_AROUND)], axis=1)
    return np.concatenate([np.zeros((1, 3)), rim]) + _hub(p)


def _disk_faces() -> np.ndarray:
    here = np.arange(_AROUND)
    return np.stack([0 * here, 1 + here, 1 + (here + 1) % _AROUND], axis=1)


def _hub(p: Any) -> np.ndarray:
    # Never within the fuselage, however little a vehicle's file says that it lies above.
    return np.array([-float(p.lr), 0.0, -max(float(p.hr), 0.3 * float(p.R))])


def _outline(p: Any) -> Points:
    """Mast, tail boom with the tail rotor, fin and skids, as lines broken by NaN."""
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
    gap = np.full((1, 3), np.nan)
    return np.concatenate([np.concatenate([np.asarray(part), gap]) for part in parts])


def _bounds(path: Points, margin: float) -> Float[np.ndarray, "2 3"]:
    return np.stack([path.min(axis=0) - margin, path.max(axis=0) + margin])


def _layout(bounds: np.ndarray, names: dict[str, str], pace: float) -> dict[str, Any]:
    """`names` are the frames' with their times as text, `pace` the time between two [ms]."""
    # One scale for all three axes: attitude angles are to be seen as they are.
    spans = bounds[1] - bounds[0]
    # By the diagonal: it stays as long whichever way the box is turned, so that nothing is cut.
    ratio = spans / np.linalg.norm(spans) * _DIAGONAL
    y = _ticks(-bounds[1, 1], -bounds[0, 1])
    # The figure's axis points left: its labels say y to the right.
    mirrored = {"tickvals": (-y).tolist(), "ticktext": [f"{v:g}" for v in y]}
    scene: dict[str, Any] = {
        "aspectmode": "manual",
        "aspectratio": dict(zip("xyz", np.round(ratio, 5).tolist(), strict=True)),
        "camera": {"eye": _VIEWS["three-quarter"], "center": _CENTRE},
        "dragmode": "orbit",
        # A constant: what the reader has turned stays so while frames are played.
        "uirevision": "kept",
    }
    titles = {"x": "forward [m]", "y": "right [m]", "z": "height [m]"}
    for i, (name, title) in enumerate(titles.items()):
        scene[f"{name}axis"] = {
            "title": {"text": title},
            "range": bounds[:, i].tolist(),
            "backgroundcolor": "#F6F6F6",
            "showbackground": True,
            "gridcolor": "#DDDDDD",
            "zeroline": False,
            **(mirrored if name == "y" else {"nticks": 7}),
        }
    return {
        # No height: it is that of the page's style, which knows how wide the screen is.
        "margin": {"l": 0, "r": 0, "t": 40, "b": 125},
        "modebar": {"orientation": "v", "remove": ["pan3d", "zoom3d", "orbitRotation"]},
        "font": {"family": "DejaVu Sans, Arial, sans-serif", "size": 12},
        "scene": scene,
        "uirevision": "kept",
        **_controls(names, pace),
    }


def _camera(eye: dict[str, float]) -> dict[str, Any]:
    return {"scene.camera": {"eye": eye, "center": _CENTRE}}


def _controls(names: dict[str, str], pace: float) -> dict[str, Any]:
    """Buttons that play and turn, and a slider over the frames."""
    # Without transitions: a frame is a moment of the run, and nothing was computed between two.
    at_once = {"mode": "immediate", "transition": {"duration": 0}}
    # redraw: meshes do not move without.
    play = {**at_once, "frame": {"duration": pace, "redraw": True}, "fromcurrent": True}
    jump = {**at_once, "frame": {"duration": 0, "redraw": True}}
    steps = [
        {"label": text, "method": "animate", "args": [[name], jump]} for name, text in names.items()
    ]
    buttons = [
        {"label": "play", "method": "animate", "args": [None, play]},
        {"label": "pause", "method": "animate", "args": [[None], jump]},
    ]
    views = [
        {"label": name, "method": "relayout", "args": [_camera(eye)]}
        for name, eye in _VIEWS.items()
    ]
    # Both rows of buttons lie outside the scene: over it they would take the mouse from it. One
    # below the other with the slider, since beside it they overlap on a narrow screen.
    row = {"type": "buttons", "direction": "right", "yanchor": "top", "showactive": False}
    return {
        "updatemenus": [
            {**row, "buttons": buttons, "x": 0.0, "xanchor": "left", "y": 0.0, "pad": {"t": 78}},
            {**row, "buttons": views, "x": 0.0, "xanchor": "left", "y": 1.0, "yanchor": "bottom"},
        ],
        "sliders": [
            {
                "steps": steps, "x": 0.0, "len": 1.0, "y": 0.0, "pad": {"t": 5, "l": 8, "r": 24},
                "font": {"size": 10}, "currentvalue": {"prefix": "time ", "suffix": " s"},
            }
        ],
    }  # fmt: skip


def _ticks(low: float, high: float) -> np.ndarray:
    """About five round numbers between two."""
    # 1, 2 or 5 times a power of ten, at most eight of them; + 0.0 turns -0 into 0.
    step = 10.0 ** np.floor(np.log10((high - low) / 5.0))
    step *= next(f for f in (1.0, 2.0, 5.0, 10.0) if (high - low) / (f * step) <= 7.0)
    return step * np.arange(np.ceil(low / step), np.floor(high / step) + 1.0) + 0.0
