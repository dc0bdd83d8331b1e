"""What MATLAB's structures say of their arrays: a name and a unit beside the numbers.

Simulink's structures with time are arrays of structures with `values` and `label`, dSPACE's have
`Data`, `Name` and `Unit`: a path such as `out.signals[0].values` tells nothing, the label does.
"""

import re
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

_LABELS, _UNITS = ("label", "name", "signalname"), ("unit", "units")
_INDEXED = re.compile(r"(.*)\[\d+\]")


class Labelled(NamedTuple):
    """Arrays by their names, and the units that stand beside them."""

    arrays: dict[str, np.ndarray]
    units: dict[str, str]


def labelled(arrays: Mapping[str, np.ndarray], texts: Mapping[str, str]) -> Labelled:
    """Arrays of structures' elements called by their labels, `out.signals.phi`, where all labels
    differ.

    Args:
        arrays: by path.
        texts: by path.
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
    return Labelled(
        {names.get(path, path): values for path, values in arrays.items()},
        {names.get(path, path): unit for path, unit in units.items()},
    )
