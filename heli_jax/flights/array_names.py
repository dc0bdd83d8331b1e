"""Names and units of arrays that a file has as texts beside them.

Simulink's structures with time are arrays of structures with `values` and `label`, dSPACE's have
`Data`, `Name` and `Unit`. System identification toolboxes keep `OutputData` beside `OutputName`,
ground stations `ATT` beside `ATT_label`, pandas `block0_values` beside `block0_items`.
"""

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


class NamedColumns:
    """Which columns of which matrices have names and units beside them."""

    def __init__(
        self, arrays: Mapping[str, np.ndarray], texts: Mapping[str, Sequence[str]]
    ) -> None:
        """
        Args:
            arrays: by path.
            texts: lists of texts by path.
        """
        self._names: dict[str, Sequence[str]] = {}
        self._units: dict[str, Sequence[str]] = {}
        for path, array in arrays.items():
            count = _columns(array)
            if not count:
                continue
            beside = {
                p: t for p, t in texts.items() if _group(p) == _group(path) and len(t) == count
            }
            if names := _chosen(path, count, {p: t for p, t in beside.items() if _are_names(p, t)}):
                self._names[path] = names
            if units := _chosen(path, count, {p: t for p, t in beside.items() if _are_units(p, t)}):
                self._units[path] = units

    def name(self, path: str, column: int) -> str | None:
        """What a column is called; None where nothing says so."""
        names = self._names.get(path)
        return f"{path}.{names[column]}" if names else None

    def unit(self, path: str, column: int) -> str:
        """The unit of a column, empty where none stands beside the matrix."""
        units = self._units.get(path)
        return units[column] if units else ""


def _columns(array: np.ndarray) -> int:
    """How many signals an array holds."""
    if array.dtype.kind not in "biuf" or array.ndim > 2 or array.size < 2:
        return 0
    return 1 if array.ndim < 2 else min(array.shape)


def _chosen(path: str, count: int, lists: Mapping[str, Sequence[str]]) -> Sequence[str]:
    """The list that belongs to an array; empty where none does, or several might."""
    shared = {p: _shared(path, p) for p in lists}
    most = max(shared.values(), default=0)
    near = {p: t for p, t in lists.items() if shared[p] == most >= _FEWEST_SHARED}
    # A vector's own name says as much as a single text that happens to stand beside it.
    left = near or ({} if count == 1 else lists)
    different = {tuple(t) for t in left.values()}
    return next(iter(different)) if len(different) == 1 else ()


def _shared(path: str, other: str) -> int:
    """Letters with which two names at one level begin alike."""
    first, second = _leaf(path).casefold(), _leaf(other).casefold()
    count = 0
    for a, b in zip(first, second, strict=False):
        if a != b:
            break
        count += 1
    # The whole name of an array may be a letter: y and y_names.
    return max(count, _FEWEST_SHARED) if count == len(first) else count


def _are_names(path: str, texts: Sequence[str]) -> bool:
    """Whether a list of texts names signals: all differ, and it is called so."""
    if not all(texts) or len(set(texts)) < len(texts):
        return False
    words = set(words_in(_leaf(path)))
    return not words & _UNIT_WORDS and bool(words & _NAMES)


def _are_units(path: str, texts: Sequence[str]) -> bool:
    words = set(words_in(_leaf(path)))
    return bool(words & _UNIT_WORDS) and any(time_unit(t) or units.is_unit(t) for t in texts)


def _leaf(path: str) -> str:
    return re.split(r"[./]", path)[-1]


def _group(path: str) -> str:
    return path[: len(path) - len(_leaf(path))]


def as_lists(texts: Mapping[str, str]) -> dict[str, list[str]]:
    """Texts by path, `names[0]` and so on, as lists; a single one is a list too."""
    lists: dict[str, list[str]] = {}
    for path, text in texts.items():
        match = re.fullmatch(r"(.*)\[\d+\]", path)
        lists.setdefault(match[1] if match else path, []).append(text)
    return lists
