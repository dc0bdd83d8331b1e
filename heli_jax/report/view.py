"""Page of a simulated manoeuvre with its figures."""

import functools
from collections.abc import Mapping, Sequence
from pathlib import Path

import jax
import numpy as np

from heli_jax.dynamics.model import Model
from heli_jax.report import figures
from heli_jax.report.charts import Numbers
from heli_jax.report.origin import Origin, origin
from heli_jax.report.page import MOST_FLIGHTS, Picture, filled, picture
from heli_jax.simulation.trajectory import Trajectory

_HUGE = 1e9
"""Size that no state of a vehicle reaches and no figure can draw."""


def write_view(
    path: Path,
    runs: Mapping[str, Trajectory],
    model: Model,
    title: str,
    notes: Sequence[str] = (),
    made: Origin | None = None,
) -> None:
    """Write the page of runs of a model by name, with NumPy arrays.

    It loads nothing from outside, and titles and names are escaped.

    Raises:
        OSError: the place is not writable.
    """
    numbers = Numbers()
    shown = [
        (name, _pictures(_finite(run), model, numbers))
        for name, run in list(runs.items())[:MOST_FLIGHTS]
    ]
    # The page states the number of flights not drawn, so that they are not overlooked.
    page = filled(
        "view.html.j2",
        title=title,
        model=model,
        notes=notes,
        runs=shown,
        unshown=max(0, len(runs) - MOST_FLIGHTS),
        origin=made or origin(),
        numbers=numbers.content(),
    )
    path.write_text(page, encoding="utf-8")


def _finite(run: Trajectory) -> Trajectory:
    """Return the run before its first sample that cannot be drawn, with at least two samples."""
    leaves = jax.tree.leaves((run.states, run.outputs))
    good = np.all([np.abs(np.asarray(v)) < _HUGE for v in leaves], axis=0)
    return run if good.all() else run.first(max(2, int(np.argmin(good))))


def _pictures(run: Trajectory, model: Model, numbers: Numbers) -> list[Picture]:
    made = [
        picture(figure.__name__, functools.partial(figure, run, model), numbers)
        for figure in (figures.motion, figures.sticks)
    ]
    return [p for p in made if p is not None]
