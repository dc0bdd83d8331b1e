"""Where MATLAB 7.3 keeps the elements of cells and of arrays of structures: in a group `#refs#`, by
names that mean nothing, each referred to from its place."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from heli_jax.flights.hdf5_texts import content

_MOST, _LONGEST = 1000, 1000
"""elements of an array, and letters of a text, that are looked at"""
_KEPT = "#refs#"
_DEEPEST = 10
"""references within references, that are followed"""


class References:
    """The paths of referred elements, as in older versions of MATLAB: `signals[0].values`."""

    def __init__(self) -> None:
        self._paths: dict[str, str] = {}
        self._letters: dict[str, str] = {}

    # Any: h5py's classes cannot be named where it is not installed.
    def add(self, path: str, item: Any) -> None:
        """A data set of references.

        Args:
            path: of it, dotted.
            item: a data set of h5py.
        """
        if item.dtype.kind != "O" or not 0 < (item.size or 0) <= _MOST:
            return
        parent, _, field = path.rpartition(".")
        for i, reference in enumerate(np.ravel(content(item))):
            if not reference or isinstance(reference, bytes | str):
                continue
            target = item.file[reference].name.strip("/").replace("/", ".")
            # A cell has elements by itself, of structures each field has all elements'.
            is_cell = "MATLAB_class" in item.attrs or not parent
            self._paths.setdefault(target, f"{path}[{i}]" if is_cell else f"{parent}[{i}].{field}")

    def add_letters(self, path: str, item: Any) -> None:
        """A data set of letters, which may be the label of an array.

        Args:
            path: of it, dotted.
            item: a data set of h5py.
        """
        if 0 < (item.size or 0) <= _LONGEST:
            self._letters[path] = "".join(map(chr, np.ravel(content(item))))

    def path(self, name: str) -> str:
        """Where an array belongs; its own name where nothing refers to it."""
        for _ in range(_DEEPEST):
            if not name.startswith(_KEPT):
                break
            parts = name.split(".")
            known = (k for k in range(len(parts), 1, -1) if ".".join(parts[:k]) in self._paths)
            if (k := next(known, None)) is None:
                break
            name = ".".join([self._paths[".".join(parts[:k])], *parts[k:]])
        return name

    @property
    def texts(self) -> Mapping[str, str]:
        """Texts by the paths where they belong."""
        return {self.path(name): text for name, text in self._letters.items()}
