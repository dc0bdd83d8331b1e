"""Long lines with no more points than are seen."""

import itertools

import numpy as np

MOST_POINTS = 800
"""points of a drawn line at most: the lowest and the highest of every 1.5 pixels of a page"""


def thinned(x: np.ndarray, y: np.ndarray, most: int = MOST_POINTS) -> tuple[np.ndarray, np.ndarray]:
    """At most `most` points of a line: the lowest and the highest of each bin.

    No peak is lost, and the first and the last point stay.

    Args:
        x: (N,), ascending.
        y: (N,)
        most: points to keep, 4 at least.
    """
    # Not every k-th sample: that aliases an oscillation and misses spikes.
    n = y.size
    if n <= most:
        return x, y
    bins = (most - 2) // 2  # two points each, and the two ends
    edges = np.linspace(0, n, bins + 1).astype(int)
    # A missing sample is neither the lowest nor the highest.
    down, up = np.where(np.isnan(y), np.inf, y), np.where(np.isnan(y), -np.inf, y)
    low = [a + int(np.argmin(down[a:b])) for a, b in itertools.pairwise(edges)]
    high = [a + int(np.argmax(up[a:b])) for a, b in itertools.pairwise(edges)]
    keep = np.unique(np.concatenate([[0, n - 1], low, high]))
    return x[keep], y[keep]
