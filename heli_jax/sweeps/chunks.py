"""Variables of a sweep read piece by piece, so that one of any size takes little memory."""

from collections.abc import Iterator

import numpy as np
import xarray as xr

# 8 MB of float64: large beside a chunk of the store, small beside the memory of any machine. A
# chunk of the store that two pieces share is read twice.
_ELEMENTS = 1 << 20


def chunks_of(variable: xr.DataArray) -> Iterator[tuple[slice, np.ndarray]]:
    """Which elements, and what the variable has for them, (k, ...); all of them in turn."""
    # Others may have stored the elements last; a slice of them is a slice of rows here.
    variable = variable.transpose("element", ...)
    for start in range(0, variable.sizes["element"], _ELEMENTS):
        which = slice(start, min(start + _ELEMENTS, variable.sizes["element"]))
        yield which, variable.isel(element=which).values
