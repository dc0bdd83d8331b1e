"""Results of a sweep as a grid of its axes."""

import math

import numpy as np
import xarray as xr


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
    axes, size = list(dataset.attrs["axes"]), dataset.sizes["element"]
    values = [dataset[axis].values for axis in axes]
    counts = [np.unique(v).size for v in values]
    # Each cell exactly once.
    if len(set(zip(*values, strict=True))) != size or math.prod(counts) != size:
        words = " x ".join(map(str, counts))
        raise ValueError(
            f"as_grid: expected every combination of the axes' values once ({words}), got {size} "
            "elements: a sample has no grid"
        )
    if len(axes) == 1:
        return dataset.swap_dims(element=axes[0]).sortby(axes)
    return dataset.set_index(element=axes).unstack("element").transpose(*axes, ...)
