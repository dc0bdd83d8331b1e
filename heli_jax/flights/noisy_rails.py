"""Ends at which a signal was cut off before noise came on top: flat tops that no two samples share.

A peak of a motion is round: seen as far down as its noise reaches, it bends by more than the noise.
What was cut off stays level, at the same level every time. Steps that were commanded do so too; a
signal that moves hardly anywhere else is none of which that could be told.
"""

import numpy as np

PILE = 5.0
"""times as many samples at an extreme as at the values beside it, for a rail. A sine logged in
steps has 3 times as many at its turning points as at the three values before"""
_BINS = 100
"""of a signal's range: the outermost holds a rail with noise on it"""
_NOISY_SHARE = 0.02
"""part of the samples in that bin, for a rail"""
_LEVEL = 3.0
"""times as many samples beside a rail as elsewhere, at most: a motion that comes to rest by itself
slows down before, and is seen there more often"""
_FEWEST_IN_BIN = 3
"""samples of a usual bin, by which a signal passes through all of its range"""
_SMALLEST, _LARGEST = 0.002, 0.08
"""noise over the signal's range between which its tops are looked at: below, the counts of values
tell; above, every motion is hidden in it"""
_REACH = 3.0
"""times the noise to which samples at one level reach"""
_SHORTEST = 8
"""samples of a visit to the end"""
_VISITS, _SAMPLES, _SHARE = 3, 120, 0.02
"""visits, samples in them, and part of all samples in them, at least"""
_LOOKED_AT = 500
"""visits whose levels and bends are looked at, about"""
_BENT = 0.4
"""times the noise by which tops may bend; round ones do by twice the noise"""
_UNEQUAL = 2.5
"""times what noise makes of the levels of single visits"""
_MOVES = 2.0
"""times the noise, by which the signal has to move elsewhere within a window"""
_WINDOW = 16
"""samples at most: between steps that are commanded most windows are level"""
_REST, _MOSTLY = 0.2, 0.7
"""part of all windows that are at neither end, and part of these in which it moves, at least"""


def rail_below_noise(x: np.ndarray) -> float | None:
    """Where the rail at the upper end of a signal begins, that noise was added to; None where
    there is none.

    Args:
        x: samples (N,) in their order, all finite.
    """
    edge = _noisy_edge(x)
    return _level_tops(x) if edge is None else edge


def _noisy_edge(x: np.ndarray) -> float | None:
    """Where the rail at the upper end begins, that has less noise than a hundredth of the range.

    A converter behind what was cut off adds its own noise, and no two samples are equal then.
    """
    top, span = float(x.max()), float(np.ptp(x))
    if not 0 < span < np.inf:
        return None
    below = (top - x) / span
    # Of most signals the outermost bin alone tells, and the others need not be counted.
    if np.count_nonzero(below <= 1.01 / _BINS) < _NOISY_SHARE * x.size:
        return None
    counts = np.histogram(below, bins=_BINS, range=(0.0, 1.0))[0]
    usual = float(np.median(counts[1:-1]))
    beside = float(counts[1:4].mean())
    piled = counts[0] > PILE * max(beside, usual) and counts[0] >= _NOISY_SHARE * x.size
    level = usual >= _FEWEST_IN_BIN and beside <= _LEVEL * usual
    return top - span / _BINS if piled and level else None


def _level_tops(x: np.ndarray) -> float | None:
    """Where tops begin that are level but for noise of more than a hundredth of the range."""
    span = float(np.ptp(x))
    if x.size < 4 * _SAMPLES or not 0 < span < np.inf:
        return None
    sd = _noise(x)
    if not _SMALLEST * span < sd < _LARGEST * span:
        return None
    level = _level(x, sd)
    edge = level - _REACH * sd
    visits = _visits(x >= edge)
    inside = sum(end - begin for begin, end in visits)
    if len(visits) < _VISITS or inside < max(_SAMPLES, _SHARE * x.size):
        return None
    flat = (
        _bend(x, visits[:: len(visits) // _LOOKED_AT + 1]) > -_BENT * sd
        and _scatter(x, visits) < _UNEQUAL * sd
    )
    return edge if flat and _moves_elsewhere(x, visits, edge, sd) else None


def _noise(x: np.ndarray) -> float:
    """Standard deviation of white noise on a slow motion, by third differences."""
    third = np.diff(x, 3)
    # 20: the sum of the squares of 1, 3, 3, 1; 0.6745: the median of a normal's magnitude.
    return float(np.median(np.abs(third))) / (0.6745 * 20**0.5)


def _level(x: np.ndarray, sd: float) -> float:
    """The value near the upper end about which most samples are."""
    top = float(x.max())
    counts, edges = np.histogram(x, bins=40, range=(top - 8.0 * sd, top))
    # Over two sd: the counts of narrower bins are chance.
    k = int(np.argmax(np.convolve(counts, np.ones(10), mode="valid")))
    middle = float(edges[k + 5])
    near = x[np.abs(x - middle) <= 1.5 * sd]
    return float(np.median(near)) if near.size else middle


def _visits(at: np.ndarray) -> list[tuple[int, int]]:
    """Begin and end of the runs in which all samples are there, less two at either end, where the
    signal comes and goes."""
    edges = np.flatnonzero(np.diff(np.r_[0, at.astype(int), 0]))
    runs = zip(edges[::2] + 2, edges[1::2] - 2, strict=True)
    return [(int(b), int(e)) for b, e in runs if e - b >= _SHORTEST]


def _bend(x: np.ndarray, visits: list[tuple[int, int]]) -> float:
    """The second Legendre coefficient of the visits, each weighed by its samples."""
    begins, ends = np.array(visits).T
    sizes = ends - begins
    firsts = np.cumsum(sizes) - sizes
    # All samples of all visits in a row, each at its place from -1 to 1.
    within = np.arange(sizes.sum()) - np.repeat(firsts, sizes)
    s = 2.0 * within / np.repeat(sizes - 1, sizes) - 1.0
    parabola = s**2 - np.repeat(np.add.reduceat(s**2, firsts) / sizes, sizes)
    # About its middle a visit's parabola goes with no slope: one product in place of a fit.
    of_x = np.add.reduceat(x[within + np.repeat(begins, sizes)] * parabola, firsts)
    bends = of_x / np.add.reduceat(parabola**2, firsts) * 2.0 / 3.0
    return float(np.sum(bends * sizes) / np.sum(sizes))


def _scatter(x: np.ndarray, visits: list[tuple[int, int]]) -> float:
    """Standard deviation of a sample by the spread of the visits' means."""
    means = np.array([x[begin:end].mean() for begin, end in visits])
    sizes = np.array([end - begin for begin, end in visits])
    about = float(np.sum(means * sizes) / sizes.sum())
    return float(np.sqrt(np.sum(sizes * (means - about) ** 2) / (sizes.size - 1)))


def _moves_elsewhere(x: np.ndarray, visits: list[tuple[int, int]], edge: float, sd: float) -> bool:
    """Whether the signal moves outside of its visits, within windows no longer than these, and not
    in jumps."""
    length = min(int(np.median([end - begin for begin, end in visits])), _WINDOW)
    count = x.size // length
    windows = x[: count * length].reshape(count, length)
    # At the other end it may be cut off too.
    other = -_level(-x, sd) + _REACH * sd
    rest = windows[(windows < edge).all(axis=1) & (windows > other).any(axis=1)]
    if len(rest) < _REST * count:
        return False
    jumps = np.abs(np.diff(rest, axis=1)).max(axis=1) - _REACH * sd > 0.5 * np.ptp(rest, axis=1)
    return float(np.mean((rest.std(axis=1) > _MOVES * sd) & ~jumps)) >= _MOSTLY
