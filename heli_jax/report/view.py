"""A simulated manoeuvre as a page: its figures, and the flight in 3D, in one file."""

import base64
import functools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import markupsafe
import numpy as np
from matplotlib.figure import Figure

from heli_jax.analysis.trim import is_full_nonlinear
from heli_jax.dynamics.model import Model
from heli_jax.report import manoeuvre, style
from heli_jax.report.animation import animation, size_of
from heli_jax.report.drawings import MOST_FLIGHTS
from heli_jax.report.figures import Panels
from heli_jax.report.html import Picture
from heli_jax.report.page import filled
from heli_jax.simulation.trajectory import Trajectory

_HUGE = 1e9
"""what no state of a machine reaches, and no figure can draw"""
# Unless told otherwise plotly offers a button that uploads the data.
_SETTINGS = {
    "displaylogo": False,
    "responsive": True,
    "showSendToCloud": False,
    "plotlyServerURL": "",
}


# Parameters of a model are a class of the user's own: they are annotated Any.


class Shown(NamedTuple):
    """A run as the page holds it."""

    name: str
    pictures: list[Picture]
    flight: markupsafe.Markup | None
    """the flight in 3D, of a whole helicopter"""
    size: float
    """how many times its size the machine is drawn there"""


def write_view(
    path: Path,
    runs: Mapping[str, Trajectory],
    model: Model,
    params: Any,
    title: str,
    notes: Sequence[str] = (),
) -> None:
    """Write the page of some runs of a model, with NumPy arrays, by their names.

    It refers to nothing outside itself, and titles and names are escaped.

    Args:
        path: of the page.
        runs: by their names; the first `MOST_FLIGHTS` are drawn.
        model: what was simulated.
        params: its parameters.
        title: of the page.
        notes: sentences that stand before the figures.

    Raises:
        OSError: the place cannot be written to.
    """
    whole = is_full_nonlinear(model)
    shown = []
    for name, whole_run in list(runs.items())[:MOST_FLIGHTS]:
        run = _finite(whole_run)
        flight, size = None, 1.0
        # Of two samples one may still not be finite: figures leave it out, a 3D scene cannot.
        if whole and _good(run).all():
            # plotly's program is 4 MB: the first figure brings it for all.
            first = all(other.flight is None for other in shown)
            flight = _flight(run, params, len(shown) + 1, first)
            size = size_of(run, float(params.R))
        shown.append(Shown(name, _pictures(run, model), flight, size))
    # Flights that are not drawn are counted on the page, so that nobody takes those shown for all.
    page = filled(
        "view.html.j2",
        title=title,
        model=model,
        notes=notes,
        runs=shown,
        whole=whole,
        unshown=max(0, len(runs) - MOST_FLIGHTS),
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


def _pictures(run: Trajectory, model: Model) -> list[Picture]:
    pictures = []
    for function in (manoeuvre.motion, manoeuvre.sticks):
        saved = style.svg(functools.partial(_figure, function, run, model))
        if saved is not None:
            title, svg = saved
            data = base64.b64encode(svg).decode("ascii")
            pictures.append(Picture(function.__name__, title, data))
    return pictures


def _figure(
    function: Callable[[Trajectory, Model], Panels], run: Trajectory, model: Model
) -> Figure | None:
    figure = function(run, model)[0].figure
    return figure if isinstance(figure, Figure) else None


def _flight(run: Trajectory, params: Any, number: int, first: bool) -> markupsafe.Markup:
    """The 3D figure; the first one brings plotly's own program with it."""
    import plotly.io  # not at the start: only this page needs it, and it takes its time

    text = plotly.io.to_html(
        animation(run, params),
        config=_SETTINGS,
        include_plotlyjs=first,
        full_html=False,
        # Several flights on a page would else all begin at once.
        auto_play=False,
        # Its checks take seconds; a test holds that the figure is one of plotly's.
        validate=False,
        # plotly's own ids are random; the same run shall give the same page.
        div_id=f"flight{number}",
    )
    return markupsafe.Markup(text)
