"""Runs that a file has as a stack, (segment, sample, channel), as data sets for learning do.

They are put one after another, (segment times sample, channel), with a column that numbers them.
"""

from collections.abc import Mapping

import numpy as np

from heli_jax.finding import LEFT_OUT, Finding, note
from heli_jax.flights.channel_names import words_in
from heli_jax.flights.clock_guess import TIME_NAMES
from heli_jax.flights.table import listed, shown
from heli_jax.flights.time_units import split_unit

NUMBER = "segment"
"""what the column is called that numbers the segments, from 1"""
DEEPEST = 3
"""dimensions of an array that may be a stack"""
_FEWEST = 10
"""samples of a segment, below which matrices of a few numbers are no stack"""


def unstacked(
    arrays: Mapping[str, np.ndarray],
) -> tuple[dict[str, np.ndarray], tuple[Finding, ...]]:
    """Arrays of at most two dimensions, stacks as matrices of a column a channel; and notes."""
    deep = {n: x for n, x in arrays.items() if x.dtype.kind in "biuf" and x.ndim > 2 and x.size}
    cubes = {n: x for n, x in deep.items() if x.ndim == DEEPEST}
    times = {n: x for n, x in arrays.items() if _is_time(n, x)}
    shapes = {x.shape[:2] for x in cubes.values()}
    shape = shapes.pop() if len(shapes) == 1 else None
    # Images and rotation matrices, (sample, row, column), stand beside times or signals of one run.
    alone = (x for n, x in arrays.items() if x.ndim == 1 and n not in times)
    if shape is not None and (
        shape[1] < _FEWEST
        or any(x.shape != shape and x.size != shape[1] for x in times.values())
        or any(x.size == shape[1] for x in alone)
    ):
        shape = None
    made: dict[str, np.ndarray] = {}
    for name, values in arrays.items():
        if shape is None:
            break
        if name in times and values.size == shape[1]:
            made[name] = np.tile(values.ravel(), shape[0])
        elif values.dtype.kind in "biuf" and values.ndim <= DEEPEST and values.shape[:2] == shape:
            made[name] = values.reshape(shape[0] * shape[1], -1)
    notes = []
    if shape is not None and made:
        made = _without_padding(made, {n: x for n, x in made.items() if n in times}, shape)
        rows = next(iter(made.values())).shape[0]
        words = f"{shape[0]} segments of {shape[1]} samples, put one after another"
        padding = shape[0] * shape[1] - rows
        words += f" without {padding} that pad them" if padding else ""
        words = f"stacked arrays, {_listed(made, arrays)}: {words}; {NUMBER!r} numbers them"
        notes.append(note("channels.stacked", words, *made, value=shape[0]))
        if NUMBER in arrays:
            made.pop(NUMBER, None)
    left = [n for n in deep if n not in made]
    if left:
        why = "runs are read of arrays (run, sample, channel), with a time for each sample"
        notes.append(note(LEFT_OUT, f"left out, since {why}: {_listed(left, arrays)}", *left))
    kept = {n: made.get(n, x) for n, x in arrays.items() if n not in left}
    return {**kept, **{n: x for n, x in made.items() if n not in kept}}, tuple(notes)


def _is_time(name: str, values: np.ndarray) -> bool:
    """Whether an array is called a time and holds one for each sample of one or several runs."""
    words = words_in(split_unit(name.replace("/", ".").rpartition(".")[2])[0])
    if not words or not TIME_NAMES & {words[0], words[-1]} or values.dtype.kind not in "biuf":
        return False
    return 1 <= values.ndim <= 2 and max(values.shape) >= _FEWEST


def _without_padding(
    made: Mapping[str, np.ndarray], times: Mapping[str, np.ndarray], shape: tuple[int, int]
) -> dict[str, np.ndarray]:
    """The stacked arrays with a number for each row's segment, without rows that fill up short
    segments."""
    # Behind a segment's last sample there are no values, or no times but zeros.
    values = [x.reshape((*shape, -1)) for n, x in made.items() if n not in times]
    used = [np.any([np.isfinite(x).any(axis=2) for x in values], axis=0)] if values else []
    used += [np.nan_to_num(x.reshape(shape)) != 0 for x in times.values()]
    lengths = np.min([shape[1] - np.argmax(is_used[:, ::-1], axis=1) for is_used in used], axis=0)
    kept = np.ravel(np.arange(shape[1]) < lengths[:, None])
    numbers = np.repeat(np.arange(1.0, shape[0] + 1.0), shape[1])
    own = {NUMBER: numbers} if shape[0] > 1 else {}
    return {name: x[kept] for name, x in {**made, **own}.items()}


def _listed(names: Mapping[str, np.ndarray] | list[str], arrays: Mapping[str, np.ndarray]) -> str:
    return listed(f"{shown(n)} {arrays[n].shape}" for n in names if n in arrays)
