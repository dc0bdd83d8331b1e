"""All figures of a sweep as files."""

import functools
import itertools
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import matplotlib
import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from heli_jax.report import style
from heli_jax.report.sweeps.columns import Table
from heli_jax.report.sweeps.corner import draw_corner
from heli_jax.report.sweeps.maps import draw_maps
from heli_jax.report.sweeps.slices import draw_slices
from heli_jax.report.sweeps.worst import draw_worst

RESULTS = 6  # results with figures of their own
_DPI = 160  # of what is pixels in an SVG


def write_figures(directory: Path, ds: xr.Dataset, worst: Mapping[str, np.ndarray]) -> list[Path]:
    """Write all figures as PNG and SVG into a directory, which is made; returns the files.

    They are slices-RESULT, maps-RESULT (the first six results), corner and worst; what a file
    should not be called becomes `_`.

    Args:
        directory: where they are written.
        ds: the sweep; read in pieces.
        worst: the worst elements of each result, worst first.
    """
    # One table for all figures: each column is read and sorted once.
    table = Table(ds, worst.values())
    draw: dict[str, Callable[[], Figure | None]] = {}
    for result, stem in stems(table.results[:RESULTS]).items():
        draw[f"slices-{stem}"] = functools.partial(draw_slices, table, result)
        draw[f"maps-{stem}"] = functools.partial(draw_maps, table, result)
    draw["corner"] = functools.partial(draw_corner, table)
    draw["worst"] = functools.partial(draw_worst, table, worst)
    directory.mkdir(parents=True, exist_ok=True)
    written = []
    # One after another: a figure that is written is let go before the next is drawn.
    for name, draw_figure in draw.items():
        path = directory / name
        with matplotlib.rc_context({"savefig.dpi": _DPI}):
            saved = style.save(draw_figure, path)
        if saved is not None:
            written += [path.with_suffix(".png"), path.with_suffix(".svg")]
    return written


def stems(names: Sequence[str]) -> dict[str, str]:
    """A different file name for each name, on file systems that fold case too."""
    stems: dict[str, str] = {}
    taken: set[str] = set()
    for name in names:
        first = re.sub(r"[^\w-]", "_", name)[:50]
        every = itertools.chain([first], (f"{first}-{k}" for k in itertools.count(2)))
        stems[name] = next(stem for stem in every if stem.casefold() not in taken)
        taken.add(stems[name].casefold())
    return stems
