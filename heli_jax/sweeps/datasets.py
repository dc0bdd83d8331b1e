"""Datasets of sweeps: as a grid of the axes, and piece by piece so that any size takes little
memory."""

from collections.abc import Iterator

import numpy as np
import xarray as xr

# 8 MB of float64: large beside a chunk of the store, small beside the memory of any machine. A
# chunk of the store that two pieces share is read twice.
_ELEMENTS = 1 << 20


def chunks_of(variable: xr.DataArray) -> Iterator[tuple[slice, np.ndarray]]:
    """Yield elements and the variable's values for them (k, ...), all in turn."""
    # Others may have stored the elements last; a slice of them is a slice of rows here.
    variable = variable.transpose("element", ...)
    for start in range(0, variable.sizes["element"], _ELEMENTS):
        which = slice(start, min(start + _ELEMENTS, variable.sizes["element"]))
        yield which, variable.isel(element=which).values


def as_grid(dataset: xr.Dataset) -> xr.Dataset:
    """A sweep of every combination of its axes' values, with the axes in place of `element`.

    Args:
        dataset: of `sweep`, or of a store that xarray has opened; of the design `grid`, or of any
            other that has each combination once.

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
    # Each cell once: as many as there are, and none twice.
    cells = np.ravel_multi_index(tuple(places), shape)
    if np.unique(cells).size != size or size != np.prod(shape, dtype=float):
        counts = " x ".join(map(str, shape))
        raise ValueError(
            f"as_grid: expected every combination of the axes' values once ({counts}), got {size} "
            "elements: of a sample there is no grid"
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
