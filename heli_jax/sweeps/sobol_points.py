"""Points of a scrambled Sobol sequence, from any point on."""

import functools

import numpy as np

_BITS = 30
MOST = 2**_BITS
"""points, after which the sequence would begin again"""
_PLACES = np.arange(_BITS - 1, -1, -1, dtype=np.uint32)
"""of the bits of a number, the highest first"""
# Joe and Kuo (2008), new-joe-kuo-6: by axis from the second on, its primitive polynomial as a
# binary number, and its first direction numbers. SciPy has the same table for 21201 axes.
_TABLE = """
3: 1
7: 1 3
11: 1 3 1
13: 1 1 1
19: 1 1 3 3
25: 1 3 5 13
37: 1 1 5 5 17
41: 1 1 5 5 5
47: 1 1 7 11 19
55: 1 1 5 1 1
59: 1 1 1 3 11
61: 1 3 5 5 31
67: 1 3 3 9 7 49
91: 1 1 1 15 21 21
97: 1 3 1 13 27 49
103: 1 1 1 15 7 5
109: 1 3 1 15 13 25
115: 1 1 5 5 19 61
131: 1 3 7 11 23 15 103
137: 1 3 7 13 13 15 69
143: 1 1 3 13 7 35 63
145: 1 3 5 9 1 25 53
157: 1 3 1 13 9 35 107
167: 1 3 1 5 27 61 31
171: 1 1 5 11 19 41 61
185: 1 3 5 3 3 13 69
191: 1 1 7 13 1 19 1
193: 1 3 7 5 13 19 59
203: 1 1 3 9 25 29 41
211: 1 3 5 13 23 1 55
213: 1 3 7 3 13 59 17
"""
_ROWS = [
    [[int(v) for v in part.split()] for part in row.split(":")] for row in _TABLE.split("\n")[1:-1]
]


def scrambled_sobol(axes: int, seed: int, start: int, stop: int) -> np.ndarray:
    """Points start to stop of `scipy.stats.qmc.Sobol(axes, rng=default_rng(seed))`.

    Args:
        axes: dimensions of the unit cube.
        seed: of the scrambling.
        start, stop: the points, from 0 on, at most `MOST`.

    Returns:
        (stop - start, axes), from 0 to 1.
    """
    if axes > len(_ROWS) + 1:
        return _by_scipy(axes, seed, start, stop)
    shift, directions = _scrambling(axes, seed)
    index = np.arange(start, stop, dtype=np.uint32)
    gray = index ^ (index >> np.uint32(1))
    bits = np.tile(shift, (index.size, 1))
    # Each point by itself, and not from the one before it: a slice begins anywhere.
    for j in range(max(stop - 1, 0).bit_length()):
        odd = (gray >> np.uint32(j)) & np.uint32(1)
        bits ^= odd[:, None] * directions[:, j]
    return bits * 0.5**_BITS


# SciPy's class has all axes and takes three quarters of a second to load, which a sweep of the
# usual few need not wait for.
def _by_scipy(axes: int, seed: int, start: int, stop: int) -> np.ndarray:
    import scipy.stats.qmc

    engine = scipy.stats.qmc.Sobol(axes, rng=np.random.default_rng(seed))
    if start == 0:
        # Its warning of numbers that are no power of two is right for a sequence, not for a slice.
        return np.concatenate([engine.random(1), engine.random(stop)])[:stop]
    engine.fast_forward(start)
    return engine.random(stop - start)


@functools.cache
def _scrambling(axes: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """A digital shift (axes,) and the scrambled direction numbers (axes, bits): Matousek's linear
    scrambling, drawn in SciPy's order from a generator that is a child of the seed's, as there."""
    rng = np.random.default_rng(seed).spawn(1)[0]
    shift = rng.integers(2, size=(axes, _BITS), dtype=np.uint32)
    lower = np.tril(rng.integers(2, size=(axes, _BITS, _BITS), dtype=np.uint32))
    lower[:, range(_BITS), range(_BITS)] = 1
    digits = (_directions(axes)[:, :, None] >> _PLACES) & np.uint32(1)
    mixed = np.einsum("apk,ajk->ajp", lower, digits) & np.uint32(1)
    # The shift's first digit is its lowest: the order of SciPy's draws.
    return _number(shift[:, ::-1]), _number(mixed)


def _number(digits: np.ndarray) -> np.ndarray:
    return np.sum(digits << _PLACES, axis=-1, dtype=np.uint32)


def _directions(axes: int) -> np.ndarray:
    """Direction numbers (axes, bits) by the recurrence of Bratley and Fox (1988)."""
    rows = [[1] * _BITS]
    for (polynomial,), first in _ROWS[: axes - 1]:
        v, degree = list(first), polynomial.bit_length() - 1
        for j in range(degree, _BITS):
            new = v[j - degree]
            for k in range(1, degree + 1):
                if polynomial >> (degree - k) & 1:
                    new ^= v[j - k] << k
            v.append(new)
        rows.append(v)
    return np.array(rows, np.uint32) << _PLACES
