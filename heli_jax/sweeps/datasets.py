"""Datasets of sweeps: as a grid of the axes, and in pieces to limit the memory."""

from collections.abc import Iterator

import numpy as np
import xarray as xr

# 8 MB of float64: large compared with a chunk of the store, small compared with any memory. A chunk
# of the store that two pieces share is read twice.
_ELEMENTS = 1 << 20


def chunks_of(variable: xr.DataArray) -> Iterator[tuple[slice, np.ndarray]]:
    """Yield slices of elements and the variable's values for them (k, ...), in order."""
    # The elements may be stored last; a slice of them is a slice of rows here.
    variable = variable.transpose("element", ...)
    for start in range(0, variable.sizes["element"], _ELEMENTS):
        which = slice(start, min(start + _ELEMENTS, variable.sizes["element"]))
        yield which, variable.isel(element=which).values


def as_grid(dataset: xr.Dataset) -> xr.Dataset:
    """Return a sweep over a full grid, with the axes as dimensions instead of `element`.

    Args:
        dataset: result of `sweep`, or a store opened by xarray; of the design `grid`, or any other
            with each combination once.

    Returns:
        The same results and status over the axes, each in ascending order of its values.

    Raises:
        ValueError: the elements are no grid.
    """
    axes = list(dataset.attrs["axes"])
    labels, places = {}, []
    for axis in axes:
        labels[axis], place = np.unique(dataset[axis].values, return_inverse=True)
        places.append(place.reshape(-1))
    shape = tuple(values.size for values in labels.values())
    size = dataset.sizes["element"]
    # Each cell exactly once.
    cells = np.ravel_multi_index(tuple(places), shape)
    if np.unique(cells).size != size or size != np.prod(shape, dtype=float):
        counts = " x ".join(map(str, shape))
        raise ValueError(
            f"as_grid: expected every combination of the axes' values once ({counts}), got {size} "
            "elements: a sample has no grid"
        )
    ordered = dataset.isel(element=np.argsort(cells))
    variables = {
        name: (
            (*axes, *variable.dims[1:]),
            variable.values.reshape(*shape, *variable.shape[1:]),
            variable.attrs,
        )
        for name, variable in ordered.variables.items()
        if name not in axes and "element" in variable.dims and name != "element"
    }
    kept = {n: c for n, c in dataset.coords.items() if "element" not in c.dims}
    along = {axis: (axis, labels[axis], dataset[axis].attrs) for axis in axes}
    grid = xr.Dataset(variables, {**along, **kept}, dataset.attrs)
    return grid.set_coords("status")
