"""Gain and phase margins of many linear loops at once, on the host."""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

_Complex = NDArray[np.complex128]

# Elements that are worked on together, and bytes of the matrices that are solved together.
_ELEMENTS = 256
_BYTES = 2**22
# Points of the grid besides those at the eigenvalues, and how far it goes beyond these.
_POINTS = 200
_BEYOND = 1e3
# Where an eigenvalue is looked at, in units of its real part away from its imaginary part.
_SIDES = np.array([0.15, 0.5, 1.0, 2.0, 5.0])
# Of the fastest eigenvalue (or 1/s): what is the same, and what is zero, which rounding spreads.
_SAME = 1e-9
_STILL = 1e-6
# What rounding leaves of a sum, of the sum of its absolute values.
_ROUNDING = 1e-13
# Of the search for a root, at most, and for a minimum that may be below zero.
_STEPS = 100
_DIP_STEPS = 6
_EPS = float(np.finfo(np.float64).eps)


class Margins(NamedTuple):
    """Margins of loops to instability; NaN if a loop is not stable as it is."""

    gain: np.ndarray
    """(batch,) [dB]: the smallest change of the loop's gain, up or down, that takes a pole of the
    closed loop to the imaginary axis (or through infinity), positive; inf where none does"""
    phase: np.ndarray
    """(batch,) [deg]: the smallest lag or lead that does so, positive; inf where |L| never
    crosses 1"""
    stable: np.ndarray
    """(batch,) bool: whether the closed loop is stable"""


class _Loop(NamedTuple):
    """C and D with the gain in them."""

    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    D: np.ndarray

    def take(self, which: np.ndarray) -> "_Loop":
        return _Loop(*(M[which] for M in self))


def margins(
    A: ArrayLike, B: ArrayLike, C: ArrayLike, D: ArrayLike, gain: ArrayLike = 1.0
) -> Margins:
    """Margins of the loops L(s) = gain (C (s - A)^-1 B + D), closed by negative unity feedback.

    An element with a number that is not finite, or with 1 + gain D = 0, has NaN, NaN and
    False; each element's result is its own, whatever stands beside it.

    Stable: all eigenvalues of A - gain B C / (1 + gain D) have negative real parts, apart from
    those that the loop does not move. A position or a heading that the output does not see is an
    eigenvalue of zero whatever the gain, and says nothing about the loop. So an eigenvalue that
    is not negative does not count if A has it too, and as often, to 1e-9 of the fastest (or of
    1/s), and grows no faster than that. Rounding spreads zeros that form a chain, as a speed and
    its position do: those count as zeros within 1e-6 if their mean is zero to 1e-9. An unseen
    chain of three or more, in coordinates that mix its states with others, is not recognised:
    such a loop is not stable here. An unseen mode that grows makes a loop unstable.

    Crossings are looked for on a grid, and followed where L comes near to one between its
    points: 200 from a thousandth of the slowest to a thousand times the fastest eigenvalue of
    the open and the closed loop (slower than 1e-6 of the fastest is zero here), and 6 more
    about each eigenvalue.

    Args:
        A: (batch, n, n) [1/s].
        B: (batch, n).
        C: (batch, n).
        D: (batch,).
        gain: a number or (batch,).

    Raises:
        ValueError: the shapes do not fit together.
    """
    A, B, C, D = (np.asarray(M, np.float64) for M in (A, B, C, D))
    if A.ndim != 3 or A.shape[1] != A.shape[2]:
        raise ValueError(f"A: expected shape (batch, n, n), got {A.shape}")
    batch, n = A.shape[:2]
    for name, M, shape in (("B", B, (batch, n)), ("C", C, (batch, n)), ("D", D, (batch,))):
        if M.shape != shape:
            raise ValueError(f"{name}: expected shape {shape}, got {M.shape}")
    k = np.asarray(gain, np.float64)
    if k.shape not in ((), (batch,)):
        raise ValueError(f"gain: expected a number or shape {(batch,)}, got shape {k.shape}")
    result = Margins(np.full(batch, np.nan), np.full(batch, np.nan), np.zeros(batch, bool))
    with np.errstate(all="ignore"):
        k = np.broadcast_to(k, (batch,))
        C, D = k[:, None] * C, k * D
        closed = A - B[:, :, None] * (C / (1.0 + D)[:, None])[:, None, :]
        # What is not finite, or does not close, is not finite here.
        sound = np.isfinite(closed).all((1, 2)) & np.isfinite(D) & (1.0 + D != 0)
        sound &= np.isfinite(B).all(1) & np.isfinite(C).all(1)
        elements = np.flatnonzero(sound)
        for start in range(0, elements.size, _ELEMENTS):
            i = elements[start : start + _ELEMENTS]
            _fill(result, i, _Loop(A, B, C, D).take(i), closed[i])
    return result


def _fill(result: Margins, where: np.ndarray, loop: _Loop, closed: np.ndarray) -> None:
    """Write the margins of a few loops, all finite, into `result` at `where`."""
    before, after = _eigenvalues(loop[0]), _eigenvalues(closed)
    size = np.max(np.abs(np.concatenate([before, after], 1)), axis=1, initial=1.0)
    stable = _stable(before, after, size)
    result.stable[where] = stable
    if not stable.any():
        return
    loop = loop.take(stable)
    omega = _grid(np.concatenate([before, after], 1)[stable])
    L, noise = _response(*loop, omega)
    log_size, sine = _tests(L, noise)
    # Gain: at no frequency, at infinite frequency, and wherever L crosses the negative real axis.
    still = _at_rest(loop, omega[:, 0])
    ends = np.stack([still, loop.D], 1)
    decibels = np.min(np.where(ends < 0, _decibels(ends), np.inf), axis=1)
    row, L, noise = _crossings(loop, omega, sine, L.real < 0, 1)
    # The search for a root ends at a jump of the sine too, as at an undamped pole.
    real = (L.real < 0) & (np.abs(L.imag) <= 1e-4 * np.abs(L.real)) & (np.abs(L) > noise)
    np.minimum.at(decibels, row[real], _decibels(L[real]))
    degrees = np.full(decibels.shape, np.inf)
    row, L, noise = _crossings(loop, omega, log_size, np.ones(omega.shape, bool), 0)
    # A sign may change through infinity too, at a pole on the axis: a crossing is only where L
    # really has size one.
    unity = (np.abs(np.abs(L) - 1.0) <= 1e-4) & (noise < 1.0)
    np.minimum.at(degrees, row[unity], np.abs(np.degrees(np.angle(-L[unity]))))
    result.gain[where[stable]] = decibels
    result.phase[where[stable]] = degrees


def _decibels(L: np.ndarray) -> np.ndarray:
    return np.abs(20.0 * np.log10(np.abs(L)))


def _eigenvalues(A: np.ndarray) -> _Complex:
    """Eigenvalues (m, n); NaN for a matrix where the iteration does not end."""
    # NumPy refuses the whole stack for one matrix: halves until that one stands alone.
    try:
        return np.linalg.eigvals(A).astype(np.complex128)
    except np.linalg.LinAlgError:
        if len(A) == 1:
            return np.full(A.shape[:2], np.nan, np.complex128)
        half = len(A) // 2
        return np.concatenate([_eigenvalues(A[:half]), _eigenvalues(A[half:])])


def _stable(before: _Complex, after: _Complex, size: np.ndarray) -> np.ndarray:
    """True if the eigenvalues `after` (m, n) are stable, apart from those that were there
    `before`."""
    n = after.shape[1]
    limit = _SAME * size[:, None]
    # As many there before as now, and no faster growing than the limit.
    there = np.abs(after[:, :, None] - before[:, None, :]) <= limit[:, :, None]
    here = np.abs(after[:, :, None] - after[:, None, :]) <= limit[:, :, None]
    unmoved = (there.sum(2) >= here.sum(2)) & (after.real <= limit)
    # Chains of zeros: the longest run of the slowest whose mean is zero.
    zero = _STILL * size[:, None]
    order = np.argsort(np.abs(after), axis=1, kind="stable")
    slowest = np.take_along_axis(after, order, 1)
    count = np.arange(1, n + 1)
    run = np.abs(np.cumsum(slowest, 1) / count) <= limit
    run &= (np.abs(slowest) <= zero) & (count <= np.sum(np.abs(before) <= zero, 1)[:, None])
    longest = np.max(np.where(run, count, 0), axis=1, initial=0)
    rank = np.empty_like(order)
    np.put_along_axis(rank, order, np.broadcast_to(np.arange(n), order.shape), 1)
    unmoved |= rank < longest[:, None]
    # Zero to rounding is not negative: such a loop is at the edge.
    negative = after.real < -10.0 * _EPS * size[:, None]
    return np.all(negative | unmoved, axis=1) & np.isfinite(size)


def _grid(eigenvalues: _Complex) -> np.ndarray:
    """Frequencies (m, points) [rad/s] in rising order, denser where eigenvalues are."""
    speed = np.abs(eigenvalues)
    most = np.max(speed, axis=1, initial=0.0)
    moves = speed > _STILL * most[:, None]
    least = np.min(np.where(moves, speed, np.inf), axis=1, initial=np.inf)
    low = np.where(most > 0, least, 1.0) / _BEYOND
    high = np.where(most > 0, most, 1.0) * _BEYOND
    even = low[:, None] * (high / low)[:, None] ** np.linspace(0.0, 1.0, _POINTS)
    # Of a pair one looks to higher frequencies and the other to lower ones.
    # An undamped one has no width of its own.
    width = np.maximum(np.abs(eigenvalues.real), 1e-6 * speed)
    width = np.where(eigenvalues.imag < 0, -width, width)
    sides = np.abs(eigenvalues.imag)[:, :, None] + width[:, :, None] * _SIDES
    points = np.concatenate([even, speed, sides.reshape(len(even), -1)], 1)
    return np.sort(np.clip(points, low[:, None], high[:, None]), axis=1)


def _response(
    A: np.ndarray, B: np.ndarray, C: np.ndarray, D: np.ndarray, omega: np.ndarray
) -> tuple[_Complex, np.ndarray]:
    """L (m, k), complex, at omega (m, k) [rad/s], and what may be rounding in it, (m, k)."""
    m, n = B.shape
    L = np.empty(omega.shape, np.complex128)
    noise = np.empty(omega.shape)
    # A few frequencies at a time: all at once would be hundreds of megabytes.
    step = max(1, _BYTES // (16 * max(m, 1) * max(n, 1) ** 2))
    diagonal = np.arange(n)
    for start in range(0, omega.shape[1], step):
        w = omega[:, start : start + step]
        M = np.empty((*w.shape, n, n), np.complex128)
        M[...] = -A[:, None]
        M[..., diagonal, diagonal] += 1j * w[..., None]
        b = np.broadcast_to(B[:, None, :, None], (*w.shape, n, 1))
        x = _solve(M.reshape(w.size, n, n), b.reshape(w.size, n, 1)).reshape(*w.shape, n)
        terms = C[:, None, :] * x
        L[:, start : start + step] = terms.sum(-1) + D[:, None]
        noise[:, start : start + step] = np.abs(terms).sum(-1) + np.abs(D)[:, None]
    return L, _ROUNDING * noise


def _solve(M: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Solutions (k, n, 1); a singular M, at an undamped pole, is solved right beside it."""
    try:
        return np.linalg.solve(M, b)
    except np.linalg.LinAlgError:
        if len(M) == 1:
            n = M.shape[-1]
            beside = 1e-9 * max(float(np.abs(M).max()), float(np.finfo(np.float64).tiny))
            try:
                return np.linalg.solve(M + 1j * beside * np.eye(n), b)
            except np.linalg.LinAlgError:
                return np.full(b.shape, np.nan, np.complex128)
        half = len(M) // 2
        return np.concatenate([_solve(M[:half], b[:half]), _solve(M[half:], b[half:])])


def _at_rest(loop: _Loop, lowest: np.ndarray) -> np.ndarray:
    """L at zero frequency (m,), where it is finite and not zero, otherwise 0.

    From the real parts, even in omega, at four frequencies below all that moves: A itself may be
    singular by what the output does not see. The slowest pole is 1000 times the lowest frequency.
    """
    L, noise = _response(*loop, 15.0 * lowest[:, None] * np.arange(1.0, 5.0))
    a, b, c, d = L.real.T
    # Extrapolated to zero by the polynomial in omega^2 through the four points.
    value = (56.0 * a - 28.0 * b + 8.0 * c - d) / 35.0
    size = np.abs(L)
    # Where L grows towards lower frequencies there is a pole at zero, and no value.
    finite = size[:, 0] <= 1.5 * size[:, 1]
    # Less than this beside what L has there already is a zero at the origin.
    known = np.abs(value) > np.maximum(1e-4 * size[:, 0], noise[:, 0])
    return np.where(finite & known, value, 0.0)


def _tests(L: _Complex, noise: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """log |L|, and the sine of L's angle; 0 where rounding hides the sign of either."""
    size = np.abs(L)
    log_size = np.log(np.maximum(size, np.finfo(np.float64).tiny))
    hidden = ~np.isfinite(size) | ((size <= noise) & (noise >= 1.0))
    log_size = np.where(hidden, 0.0, log_size)
    seen = np.isfinite(size) & (np.abs(L.imag) > noise)
    return log_size, np.where(seen, L.imag / size, 0.0)


def _crossings(
    loop: _Loop, omega: np.ndarray, f: np.ndarray, among: np.ndarray, which: int
) -> tuple[np.ndarray, _Complex, np.ndarray]:
    """Elements (c,) where test `which` crosses zero, and L and its rounding (c,) there.

    Args:
        f: (m, k) that test at omega.
        among: (m, k) only brackets with one end where this is true.
        which: 0 for log |L|, 1 for the sine of its angle.
    """
    # A zero has the sign of what it follows.
    sign = np.sign(f)
    last = np.maximum.accumulate(np.where(sign != 0, np.arange(f.shape[1]), 0), axis=1)
    sign = np.take_along_axis(sign, last, 1)
    change = (sign[:, :-1] * sign[:, 1:] < 0) & (among[:, :-1] | among[:, 1:])
    row, i = np.nonzero(change)
    # In logarithms a Bode plot is nearly made of straight lines, which roots are found on.
    x = np.log(omega)
    brackets = [(row, x[row, i], x[row, i + 1], f[row, i], f[row, i + 1])]
    brackets += _dips(loop, x, f, among, which)
    row, x1, x2, f1, f2 = (np.concatenate(part) for part in zip(*brackets, strict=True))
    loop = loop.take(row)
    L, noise = _response(*loop, np.exp(_roots(loop, x1, x2, f1, f2, which))[:, None])
    return row, L[:, 0], noise[:, 0]


def _dips(
    loop: _Loop, x: np.ndarray, f: np.ndarray, among: np.ndarray, which: int
) -> list[tuple[np.ndarray, ...]]:
    """Brackets of crossings in pairs between points of the grid: where f just passes zero.

    Each minimum of |f| is followed by parabolas, for a few steps or until f changes sign.
    """
    # Without the points that coincide.
    row, i = np.nonzero(np.diff(x, axis=1, prepend=-np.inf) > 1e-7)
    x, f, among = x[row, i], f[row, i], among[row, i]
    side = np.sign(f)
    g = np.abs(f)
    dip = (row[:-2] == row[2:]) & among[1:-1] & (side[1:-1] != 0)
    dip &= (side[:-2] == side[1:-1]) & (side[2:] == side[1:-1])
    dip &= (g[1:-1] <= g[:-2]) & (g[1:-1] <= g[2:])
    j = np.flatnonzero(dip) + 1
    row, side, part = row[j], side[j], loop.take(row[j])
    # Three points each: x and g, the middle one lowest.
    x3, g3 = x[j[:, None] + np.arange(-1, 2)], g[j[:, None] + np.arange(-1, 2)]
    brackets = []
    for _ in range(_DIP_STEPS):
        if not row.size:
            break
        # The lowest point of the parabola through the three.
        near, far = x3[:, 0] - x3[:, 1], x3[:, 2] - x3[:, 1]
        near_g, far_g = g3[:, 0] - g3[:, 1], g3[:, 2] - g3[:, 1]
        v = (far**2 * near_g - near**2 * far_g) / (2.0 * (far * near_g - near * far_g))
        v = np.where(np.isfinite(v), v, 0.0)
        # Not onto the middle point, and not onto the ends.
        apart = 1e-3 * (far - near)
        v = np.where(np.abs(v) < apart, np.where(far > -near, apart, -apart), v)
        v = x3[:, 1] + np.clip(v, 0.99 * near, 0.99 * far)
        fv = _tests(*_response(*part, np.exp(v)[:, None]))[which][:, 0]
        gv = fv * side
        # All four in order, and the three around the lowest of them.
        x4, g4 = np.concatenate([x3, v[:, None]], 1), np.concatenate([g3, gv[:, None]], 1)
        order = np.argsort(x4, axis=1)
        x4, g4 = np.take_along_axis(x4, order, 1), np.take_along_axis(g4, order, 1)
        lowest = np.clip(np.argmin(g4, axis=1), 1, 2)
        around = lowest[:, None] + np.arange(-1, 2)
        x3, g3 = np.take_along_axis(x4, around, 1), np.take_along_axis(g4, around, 1)
        through = gv < 0
        for k in (0, 1):
            ends = (x3[through, k], x3[through, k + 1])
            values = (g3[through, k] * side[through], g3[through, k + 1] * side[through])
            brackets.append((row[through], *ends, *values))
        # Those that passed zero are brackets now, to either side of the point below.
        on = gv > 0
        row, side, part, x3, g3 = row[on], side[on], part.take(on), x3[on], g3[on]
    return brackets


def _roots(
    loop: _Loop,
    x1: np.ndarray,
    x2: np.ndarray,
    f1: np.ndarray,
    f2: np.ndarray,
    which: int,
) -> np.ndarray:
    """Return the zeros of test `which` between x1 and x2, logarithms of frequencies, all (c,).

    Chandrupatla's method for all at once: inverse quadratic interpolation where it can be
    trusted, bisection otherwise.
    """
    roots = np.where(f1 == 0, x1, x2)
    left, t = np.flatnonzero(f1 * f2 != 0), 0.5
    x1, x2, f1, f2 = x1[left], x2[left], f1[left], f2[left]
    part = loop.take(left)
    for _ in range(_STEPS):
        if not left.size:
            break
        x = x1 + t * (x2 - x1)
        fx = _tests(*_response(*part, np.exp(x)[:, None]))[which][:, 0]
        # x1 is the newest point, x2 the one beyond the root, x3 the one that was given up.
        same = np.sign(fx) == np.sign(f1)
        x3, f3 = np.where(same, x1, x2), np.where(same, f1, f2)
        x2, f2 = np.where(same, x2, x1), np.where(same, f2, f1)
        x1, f1 = x, fx
        roots[left] = np.where(np.abs(f2) < np.abs(f1), x2, x1)
        least = 2.0 * _EPS * np.maximum(np.abs(x1), 1.0) / np.abs(x2 - x1)
        xi, phi = (x1 - x2) / (x3 - x2), (f1 - f2) / (f3 - f2)
        # Chandrupatla (1997): where the inverse parabola is monotone between the points.
        trusted = (phi**2 < xi) & ((1.0 - phi) ** 2 < 1.0 - xi)
        a = f1 / (f2 - f1) * f3 / (f2 - f3)
        b = (x3 - x1) / (x2 - x1) * f1 / (f3 - f1) * f2 / (f3 - f2)
        t = np.where(trusted, a + b, 0.5)
        t = np.clip(t, least, 1.0 - least)
        on = (f1 != 0) & (least < 0.5)
        if not on.all():
            left, t, part = left[on], t[on], part.take(on)
            x1, x2, f1, f2 = x1[on], x2[on], f1[on], f2[on]
    return roots
