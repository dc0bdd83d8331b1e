"""Gain and phase margins of many linear loops at once, on the host.

The frequencies with |L| = 1, and those with real L, are eigenvalues on the imaginary axis of
matrices twice as large as the loop's. Newton's method refines each to the last digits.

Source: Boyd, Balakrishnan and Kabamba (1989) for the Hamiltonian matrix of |L| = 1.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

_Complex = NDArray[np.complex128]

_BYTES = 2**25
"""Memory of the matrices that are processed together [bytes]."""
# Tolerances for equal and for zero eigenvalues after rounding [fraction of the fastest, or of 1/s].
_SAME = 1e-9
_STILL = 1e-6
_AXIS = 1e-2
"""Largest distance of a crossing's eigenvalue from the imaginary axis, from rounding [relative]."""
_NEWTON = 8
"""Newton steps from an eigenvalue to the crossing, each at most `_LARGEST` in log frequency."""
_LARGEST = 0.3
_OFF = 1e-4
"""Largest distance of L from the real axis or from size one at a crossing [relative]."""
_ROUNDING = 1e-13
"""Rounding error of a sum [fraction of the sum of absolute values]."""
_EPS = float(np.finfo(np.float64).eps)


class Margins(NamedTuple):
    """Stability margins of loops; NaN if a loop is unstable."""

    gain: np.ndarray
    """Smallest gain change (batch,) [dB], up or down and positive, that takes a closed-loop pole to
    the imaginary axis (or through infinity); inf if none does.
    """
    phase: np.ndarray
    """Smallest lag or lead (batch,) [deg], positive, that does so; inf if |L| never crosses 1."""
    stable: np.ndarray
    """True (batch,) if the closed loop is stable."""


class _Loop(NamedTuple):
    """Loop matrices; C and D include the gain."""

    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    D: np.ndarray

    def take(self, which: np.ndarray) -> "_Loop":
        return _Loop(*(M[which] for M in self))


def margins(
    A: ArrayLike, B: ArrayLike, C: ArrayLike, D: ArrayLike, gain: ArrayLike = 1.0
) -> Margins:
    """Return the margins of loops L(s) = gain (C (s - A)^-1 B + D) with negative feedback.

    An element that is not finite, or has 1 + gain D = 0, gives NaN, NaN and False. Elements do not
    affect each other.

    A loop is stable if all eigenvalues of A - gain B C / (1 + gain D) have negative real parts.
    Eigenvalues of A that the loop does not move are ignored unless they grow, such as the zero of
    an unobserved position or heading. An unobserved chain of three or more zeros in mixed
    coordinates is not recognised, and the loop then counts as unstable.

    Args:
        A: (batch, n, n) [1/s].
        B: (batch, n).
        C: (batch, n).
        D: (batch,).
        gain: a number or (batch,).

    Raises:
        ValueError: the shapes do not match.
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
        # Elements that are not finite, or cannot be closed, are not finite here.
        sound = np.isfinite(closed).all((1, 2)) & np.isfinite(D) & (1.0 + D != 0)
        sound &= np.isfinite(B).all(1) & np.isfinite(C).all(1)
        elements = np.flatnonzero(sound)
        # Each loop has at most 2 n crossings.
        step = max(1, _BYTES // (32 * max(n, 1) ** 3))
        for start in range(0, elements.size, step):
            i = elements[start : start + step]
            _fill(result, i, _Loop(A, B, C, D).take(i), closed[i])
    return result


def _fill(result: Margins, where: np.ndarray, loop: _Loop, closed: np.ndarray) -> None:
    """Write the margins of some loops, all finite, into `result` at `where`."""
    before, after = _eigenvalues(loop.A), _eigenvalues(closed)
    speed = np.abs(np.concatenate([before, after], 1))
    size = np.max(speed, axis=1, initial=1.0)
    stable = _stable(before, after, size)
    result.stable[where] = stable
    loop, speed, size = loop.take(stable), speed[stable], size[stable]
    # Gain: at zero and infinite frequency, and where L crosses the negative real axis.
    ends = np.stack([_at_rest(loop, speed), loop.D], 1)
    decibels = np.min(np.where(ends < 0, _decibels(ends), np.inf), axis=1)
    row, L, noise = _crossings(loop, _real(loop, size), size, lambda L, by: L.imag / by.imag)
    real = (L.real < 0) & (np.abs(L.imag) <= _OFF * np.abs(L.real)) & (np.abs(L) > noise)
    np.minimum.at(decibels, row[real], _decibels(L[real]))
    degrees = np.full(decibels.shape, np.inf)
    row, L, noise = _crossings(
        loop, _of_size_one(loop), size, lambda L, by: np.log(np.abs(L)) / (by / L).real
    )
    unity = (np.abs(np.abs(L) - 1.0) <= _OFF) & (noise < 1.0)
    np.minimum.at(degrees, row[unity], np.abs(np.degrees(np.angle(-L[unity]))))
    result.gain[where[stable]] = decibels
    result.phase[where[stable]] = degrees


def _decibels(L: np.ndarray) -> np.ndarray:
    return np.abs(20.0 * np.log10(np.abs(L)))


def _eigenvalues(A: np.ndarray) -> _Complex:
    """Return the eigenvalues (m, n); NaN for a matrix that is not finite or does not converge."""
    # NumPy fails for the whole stack if one matrix fails.
    try:
        return np.linalg.eigvals(A).astype(np.complex128)
    except np.linalg.LinAlgError:
        if len(A) == 1:
            return np.full(A.shape[:2], np.nan, np.complex128)
        return np.concatenate([_eigenvalues(M[None]) for M in A])


def _of_size_one(loop: _Loop) -> _Complex:
    """Return the Hamiltonian's eigenvalues (m, 2 n), on the imaginary axis where |L| = 1."""
    A, B, C, D = loop
    R = (1.0 - D**2)[:, None, None]
    # If |L| = 1 at infinite frequency, finite crossings still exist.
    R = np.where(np.abs(R) < _EPS, _EPS, R)
    F = A + D[:, None, None] * B[:, :, None] * C[:, None, :] / R
    up = np.concatenate([F, B[:, :, None] * B[:, None, :] / R], 2)
    low = np.concatenate([-C[:, :, None] * C[:, None, :] / R, -np.swapaxes(F, 1, 2)], 2)
    return _eigenvalues(np.concatenate([up, low], 1))


def _real(loop: _Loop, size: np.ndarray) -> _Complex:
    """Return the zeros (m, 2 n) of L(s) - L(-s), on the imaginary axis where L is real."""
    A, B, C, _ = loop
    m, n = B.shape
    # c (s - A)^-1 b with A and -A combined. In w = 1 / (s - s0), with s0 faster than all modes, it
    # has a direct term, and the zeros are eigenvalues of a matrix.
    s0 = 3.0 * size[:, None, None]
    resolvent = np.zeros((m, 2 * n, 2 * n))
    resolvent[:, :n, :n] = np.linalg.inv(s0 * np.eye(n) - A)
    resolvent[:, n:, n:] = np.linalg.inv(s0 * np.eye(n) + A)
    b, c = np.concatenate([B, B], 1)[:, :, None], np.concatenate([C, C], 1)[:, None, :]
    before, after = resolvent @ b, c @ resolvent
    w = _eigenvalues(before @ after / (c @ before) - resolvent)
    return s0[:, :, 0] + 1.0 / w


def _stable(before: _Complex, after: _Complex, size: np.ndarray) -> np.ndarray:
    """True if the eigenvalues `after` (m, n) are stable, apart from those also in `before`."""
    n = after.shape[1]
    limit = _SAME * size[:, None]
    # An unmoved eigenvalue is in A at least as often, and grows no faster than 1e-9 of the fastest.
    there = np.abs(after[:, :, None] - before[:, None, :]) <= limit[:, :, None]
    here = np.abs(after[:, :, None] - after[:, None, :]) <= limit[:, :, None]
    unmoved = (there.sum(2) >= here.sum(2)) & (after.real <= limit)
    # Rounding spreads the zeros of a chain, such as a speed and its position. The longest run of
    # slowest eigenvalues counts as zero if all are below 1e-6 and their mean below 1e-9.
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
    # Zero to rounding is not negative: such a loop is marginal.
    negative = after.real < -10.0 * _EPS * size[:, None]
    return np.all(negative | unmoved, axis=1) & np.isfinite(size)


def _response(loop: _Loop, omega: np.ndarray) -> tuple[_Complex, _Complex, np.ndarray]:
    """Return L (m,) at a frequency each [rad/s], derivative by log frequency, rounding error."""
    s = 1j * omega
    M = s[:, None, None] * np.eye(loop.B.shape[1]) - loop.A
    x = _solve(M, loop.B)
    terms = loop.C * x
    slope = -s * (loop.C * _solve(M, x)).sum(-1)
    noise = np.abs(terms).sum(-1) + np.abs(loop.D)
    return terms.sum(-1) + loop.D, slope, _ROUNDING * noise


def _solve(M: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the solutions (m, n); a singular M, at an undamped pole, is slightly shifted."""
    try:
        return np.linalg.solve(M, b[:, :, None])[:, :, 0]
    except np.linalg.LinAlgError:
        if len(M) > 1:
            return np.concatenate([_solve(M[[k]], b[[k]]) for k in range(len(M))])
        return _solve(M + 1e-9j * np.abs(M).max() * np.eye(M.shape[1]), b)


def _at_rest(loop: _Loop, speed: np.ndarray) -> np.ndarray:
    """Return L at zero frequency (m,) if it is finite and not zero, otherwise 0.

    It uses the real parts, even in omega, at four frequencies below all modes. A itself may be
    singular through unobserved states.

    Args:
        speed: absolute eigenvalues (m, k) [1/s].
    """
    most = np.max(speed, axis=1, initial=0.0)
    moves = speed > _STILL * most[:, None]
    least = np.min(np.where(moves, speed, np.inf), axis=1, initial=np.inf)
    lowest = 15e-3 * np.where(most > 0, least, 1.0)
    at = [_response(loop, k * lowest) for k in (1.0, 2.0, 3.0, 4.0)]
    a, b, c, d = (L.real for L, _, _ in at)
    # Extrapolate to zero with the polynomial in omega^2 through the four points.
    value = (56.0 * a - 28.0 * b + 8.0 * c - d) / 35.0
    first, noise = np.abs(at[0][0]), at[0][2]
    # If L grows towards low frequencies, there is a pole at zero and no value.
    finite = first <= 1.5 * np.abs(at[1][0])
    # A much smaller value than at the first frequency indicates a zero at the origin.
    known = np.abs(value) > np.maximum(1e-4 * first, noise)
    return np.where(finite & known, value, 0.0)


def _crossings(
    loop: _Loop,
    eigenvalues: _Complex,
    size: np.ndarray,
    step: Callable[[_Complex, _Complex], np.ndarray],
) -> tuple[np.ndarray, _Complex, np.ndarray]:
    """Return loops (c,) that may cross near imaginary eigenvalues (m, 2 n), L, rounding error.

    Args:
        step: Newton step from L and its derivative.
    """
    near = np.abs(eigenvalues.real) <= _AXIS * np.abs(eigenvalues) + _STILL * size[:, None]
    row, i = np.nonzero(near & (eigenvalues.imag > 0))
    x, loop = np.log(eigenvalues.imag[row, i]), loop.take(row)
    for _ in range(_NEWTON):
        by = step(*_response(loop, np.exp(x))[:2])
        x = x - np.where(np.isfinite(by), np.clip(by, -_LARGEST, _LARGEST), 0.0)
    L, _, noise = _response(loop, np.exp(x))
    return row, L, noise
