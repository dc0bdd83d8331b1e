"""Names and units of arrays that a file has as texts beside them.

Simulink's structures with time are arrays of structures with `values` and `label`, dSPACE's have
`Data`, `Name` and `Unit`. System identification toolboxes keep `OutputData` beside `OutputName`,
ground stations `ATT` beside `ATT_label`, pandas `block0_values` beside `block0_items`.
"""

import itertools
import re
from collections.abc import Mapping, Sequence

import numpy as np

from heli_jax import units
from heli_jax.flights.channel_names import words_in
from heli_jax.flights.time_units import time_unit

_LABELS, _UNITS = ("label", "name", "signalname"), ("unit", "units")
_INDEXED = re.compile(r"(.*)\[\d+\]")


def labelled(
    arrays: Mapping[str, np.ndarray], texts: Mapping[str, str]
) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """Arrays of structures' elements called by their labels, `out.signals.phi`, where all labels
    differ, and the units that stand beside them.
    """
    beside: dict[str, dict[str, str]] = {}
    for path, text in texts.items():
        element, _, field = path.rpartition(".")
        beside.setdefault(element, {})[field.casefold()] = text
    # Of an element with several arrays of samples label and unit may be those of any.
    samples: dict[str, list[str]] = {}
    for path, values in arrays.items():
        if values.size > 1:
            samples.setdefault(path.rpartition(".")[0], []).append(path)
    names: dict[str, str] = {}
    units: dict[str, str] = {}
    for element, (path, *others) in samples.items():
        said = beside.get(element, {})
        if others or not said:
            continue
        if unit := next((said[u] for u in _UNITS if u in said), ""):
            units[path] = unit
        label = next((said[n] for n in _LABELS if n in said), "")
        if label and (match := _INDEXED.fullmatch(element)):
            names[path] = f"{match[1]}.{label}"
    taken = [*names.values(), *(path for path in arrays if path not in names)]
    names = {path: name for path, name in names.items() if taken.count(name) == 1}
    return (
        {names.get(path, path): values for path, values in arrays.items()},
        {names.get(path, path): unit for path, unit in units.items()},
    )


_NAMES = {
    *("name", "names", "label", "labels", "columns", "column", "channel", "channels", "items"),
    *("header", "headers", "fields", "signals", "variables", "varnames", "legend", "colheaders"),
    *("ch", "component", "components", "axis", "state", "states", "output", "outputs", "input"),
    *("inputs", "sensor", "sensors", "var", "vars", "param", "params", "parameters"),
}
_UNIT_WORDS = {"unit", "units"}
_FEWEST_SHARED = 3
"""letters by which a matrix and a list of names belong together: OutputData, OutputName"""


def named_columns(
    path: str, array: np.ndarray, texts: Mapping[str, Sequence[str]]
) -> tuple[Sequence[str], Sequence[str]]:
    """The names and the units of a matrix's columns, each empty where nothing says so.

    Args:
        array: the matrix, or a vector.
        texts: lists of texts by path, as many as columns in the one that names them.
    """
    if array.dtype.kind not in "biuf" or array.ndim > 2 or array.size < 2:
        return (), ()
    count, group = 1 if array.ndim < 2 else min(array.shape), path[: -len(_leaf(path))]
    names, units_of = {}, {}
    for other, each in texts.items():
        if other[: -len(_leaf(other))] != group or len(each) != count:
            continue
        words = set(words_in(_leaf(other)))
        if words & _UNIT_WORDS:
            if any(time_unit(t) or units.is_unit(t) for t in each):
                units_of[other] = each
        elif words & _NAMES and all(each) and len(set(each)) == count:
            names[other] = each
    return _chosen(path, count, names), _chosen(path, count, units_of)


def _chosen(path: str, count: int, lists: Mapping[str, Sequence[str]]) -> Sequence[str]:
    """The list that belongs to an array: the one called most alike; empty where several might."""
    own = _leaf(path).casefold()
    shared = {p: _alike(own, _leaf(p).casefold()) for p in lists}
    # The whole name of an array may be a letter: y and y_names.
    shared = {p: max(n, _FEWEST_SHARED) if n == len(own) else n for p, n in shared.items()}
    most = max(shared.values(), default=0)
    near = [t for p, t in lists.items() if shared[p] == most >= _FEWEST_SHARED]
    # A vector's own name says as much as a single text that happens to stand beside it.
    different = {tuple(t) for t in near or (() if count == 1 else lists.values())}
    return different.pop() if len(different) == 1 else ()


def _alike(one: str, other: str) -> int:
    """Letters with which two names begin alike."""
    pairs = zip(one, other, strict=False)
    return sum(1 for _ in itertools.takewhile(lambda pair: pair[0] == pair[1], pairs))


def _leaf(path: str) -> str:
    return re.split(r"[./]", path)[-1]


def as_lists(texts: Mapping[str, str]) -> dict[str, list[str]]:
    """Texts by path, `names[0]` and so on, as lists; a single one is a list too."""
    lists: dict[str, list[str]] = {}
    for path, text in texts.items():
        match = re.fullmatch(r"(.*)\[\d+\]", path)
        lists.setdefault(match[1] if match else path, []).append(text)
    return lists
