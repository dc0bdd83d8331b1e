"""A simulated manoeuvre as a page: its figures, and the flight in 3D, in one file."""

import functools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from matplotlib.figure import Figure

from heli_jax.analysis.trim import is_full_nonlinear
from heli_jax.dynamics.model import Model
from heli_jax.report import manoeuvre
from heli_jax.report.animation import scene, size_of
from heli_jax.report.drawings import MOST_FLIGHTS
from heli_jax.report.embedded import Numbers
from heli_jax.report.figures import Panels
from heli_jax.report.origin import Origin, origin
from heli_jax.report.page import filled
from heli_jax.report.pictures import Picture, picture
from heli_jax.simulation.trajectory import Trajectory

_HUGE = 1e9
"""what no state of a machine reaches, and no figure can draw"""


# Parameters of a model are a class of the user's own: they are annotated Any.


class Shown(NamedTuple):
    """A run as the page holds it."""

    name: str
    pictures: list[Picture]
    scene: int | None
    """the flight in 3D, of a whole helicopter: its number among the page's scenes"""
    size: float
    """how many times its size the machine is drawn there"""


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

    Args:
        path: of the page.
        runs: by their names; the first `MOST_FLIGHTS` are drawn.
        model: what was simulated.
        params: its parameters.
        title: of the page.
        notes: sentences that stand before the figures.
        made: command, configuration and files beside the page; the command alone unless given.

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
    """Which samples can be drawn."""
    leaves = jax.tree.leaves((run.states, run.outputs))
    return np.all([np.abs(np.asarray(v)) < _HUGE for v in leaves], axis=0)


def _finite(run: Trajectory) -> Trajectory:
    """The run up to where it ceases to be finite; two samples at least."""
    good = _good(run)
    return run if good.all() else run.first(max(2, int(np.argmin(good))))


def _pictures(run: Trajectory, model: Model, numbers: Numbers) -> list[Picture]:
    made = [
        picture(function.__name__, functools.partial(_figure, function, run, model), numbers)
        for function in (manoeuvre.motion, manoeuvre.sticks)
    ]
    return [p for p in made if p is not None]


def _figure(
    function: Callable[[Trajectory, Model], Panels], run: Trajectory, model: Model
) -> Figure | None:
    figure = function(run, model)[0].figure
    return figure if isinstance(figure, Figure) else None
