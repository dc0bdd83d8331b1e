"""Bands of frequencies that a page shows."""

import numpy as np
from jaxtyping import Float

_FEWEST = 12
"""lines of a band at least"""


def band_edges(hz: Float[np.ndarray, " K"]) -> list[tuple[float, float]]:
    """Bands between the lowest and the highest of some frequencies, at 1, 3, 10, 30 ... Hz, each
    with some lines.

    Args:
        hz: the lines.
    """
    low, high = float(np.min(hz)), float(np.max(hz))
    decades = np.arange(np.floor(np.log10(low)), np.ceil(np.log10(high)) + 1.0)
    grid = np.sort(np.concatenate([10.0**decades, 3.0 * 10.0**decades]))
    edges = [low]
    for edge in grid[(grid > low) & (grid < high)]:
        above = np.sum(hz > edge) >= _FEWEST
        if above and np.sum((hz >= edges[-1]) & (hz <= edge)) >= _FEWEST:
            edges.append(float(edge))
    return list(zip(edges, [*edges[1:], high], strict=True))
