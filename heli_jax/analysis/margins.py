"""Gain and phase margins of many linear loops at once, on the host.

The frequencies at which |L| is one, and those at which L is real, are eigenvalues on the imaginary
axis of matrices twice as large as the loop's; Newton's method takes each to its last digits.

Source: Boyd, Balakrishnan and Kabamba (1989) for the Hamiltonian matrix of |L| = 1.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

_Complex = NDArray[np.complex128]

_BYTES = 2**25
"""of the matrices that are worked on together"""
# Of the fastest eigenvalue (or 1/s): what is the same, and what is zero, which rounding spreads.
_SAME = 1e-9
_STILL = 1e-6
_AXIS = 1e-2
"""of its size, how far off the imaginary axis an eigenvalue of a crossing may be by rounding"""
_NEWTON = 8
"""steps from an eigenvalue to the crossing, each at most `_LARGEST` in the frequency's logarithm"""
_LARGEST = 0.3
_OFF = 1e-4
"""of L, how far from the real axis or from size one it may be at a crossing"""
_ROUNDING = 1e-13
"""what rounding leaves of a sum, of the sum of its absolute values"""
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
        # Twice n crossings of each loop at most.
        step = max(1, _BYTES // (32 * max(n, 1) ** 3))
        for start in range(0, elements.size, step):
            i = elements[start : start + step]
            _fill(result, i, _Loop(A, B, C, D).take(i), closed[i])
    return result


def _fill(result: Margins, where: np.ndarray, loop: _Loop, closed: np.ndarray) -> None:
    """Write the margins of a few loops, all finite, into `result` at `where`."""
    before, after = _eigenvalues(loop.A), _eigenvalues(closed)
    speed = np.abs(np.concatenate([before, after], 1))
    size = np.max(speed, axis=1, initial=1.0)
    stable = _stable(before, after, size)
    result.stable[where] = stable
    loop, speed, size = loop.take(stable), speed[stable], size[stable]
    # Gain: at no frequency, at infinite frequency, and wherever L crosses the negative real axis.
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
    """Eigenvalues (m, n); NaN for a matrix that is not finite or whose iteration does not end."""
    # NumPy refuses the whole stack for one matrix.
    try:
        return np.linalg.eigvals(A).astype(np.complex128)
    except np.linalg.LinAlgError:
        if len(A) == 1:
            return np.full(A.shape[:2], np.nan, np.complex128)
        return np.concatenate([_eigenvalues(M[None]) for M in A])


def _of_size_one(loop: _Loop) -> _Complex:
    """Eigenvalues (m, 2 n), on the imaginary axis where |L| = 1: of the Hamiltonian matrix."""
    A, B, C, D = loop
    R = (1.0 - D**2)[:, None, None]
    # |L| = 1 at infinite frequency, beside which a finite one is still a crossing.
    R = np.where(np.abs(R) < _EPS, _EPS, R)
    F = A + D[:, None, None] * B[:, :, None] * C[:, None, :] / R
    up = np.concatenate([F, B[:, :, None] * B[:, None, :] / R], 2)
    low = np.concatenate([-C[:, :, None] * C[:, None, :] / R, -np.swapaxes(F, 1, 2)], 2)
    return _eigenvalues(np.concatenate([up, low], 1))


def _real(loop: _Loop, size: np.ndarray) -> _Complex:
    """Zeros (m, 2 n) of L(s) - L(-s), on the imaginary axis where L is real."""
    A, B, C, _ = loop
    m, n = B.shape
    # c (s - A)^-1 b with A and -A side by side. In w = 1 / (s - s0), which is faster than all that
    # moves, it has a direct term, and the zeros are eigenvalues of a matrix.
    s0 = 3.0 * size[:, None, None]
    resolvent = np.zeros((m, 2 * n, 2 * n))
    resolvent[:, :n, :n] = np.linalg.inv(s0 * np.eye(n) - A)
    resolvent[:, n:, n:] = np.linalg.inv(s0 * np.eye(n) + A)
    b, c = np.concatenate([B, B], 1)[:, :, None], np.concatenate([C, C], 1)[:, None, :]
    before, after = resolvent @ b, c @ resolvent
    w = _eigenvalues(before @ after / (c @ before) - resolvent)
    return s0[:, :, 0] + 1.0 / w


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


def _response(loop: _Loop, omega: np.ndarray) -> tuple[_Complex, _Complex, np.ndarray]:
    """L (m,) at one frequency each [rad/s], its derivative by the frequency's logarithm, and what
    may be rounding in it."""
    s = 1j * omega
    M = s[:, None, None] * np.eye(loop.B.shape[1]) - loop.A
    x = _solve(M, loop.B)
    terms = loop.C * x
    slope = -s * (loop.C * _solve(M, x)).sum(-1)
    noise = np.abs(terms).sum(-1) + np.abs(loop.D)
    return terms.sum(-1) + loop.D, slope, _ROUNDING * noise


def _solve(M: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Solutions (m, n); a singular M, at an undamped pole, is solved right beside it."""
    try:
        return np.linalg.solve(M, b[:, :, None])[:, :, 0]
    except np.linalg.LinAlgError:
        if len(M) > 1:
            return np.concatenate([_solve(M[[k]], b[[k]]) for k in range(len(M))])
        return _solve(M + 1e-9j * np.abs(M).max() * np.eye(M.shape[1]), b)


def _at_rest(loop: _Loop, speed: np.ndarray) -> np.ndarray:
    """L at zero frequency (m,), where it is finite and not zero, otherwise 0.

    From the real parts, even in omega, at four frequencies below all that moves: A itself may be
    singular by what the output does not see.

    Args:
        speed: (m, k) of the eigenvalues [1/s].
    """
    most = np.max(speed, axis=1, initial=0.0)
    moves = speed > _STILL * most[:, None]
    least = np.min(np.where(moves, speed, np.inf), axis=1, initial=np.inf)
    lowest = 15e-3 * np.where(most > 0, least, 1.0)
    at = [_response(loop, k * lowest) for k in (1.0, 2.0, 3.0, 4.0)]
    a, b, c, d = (L.real for L, _, _ in at)
    # Extrapolated to zero by the polynomial in omega^2 through the four points.
    value = (56.0 * a - 28.0 * b + 8.0 * c - d) / 35.0
    first, noise = np.abs(at[0][0]), at[0][2]
    # Where L grows towards lower frequencies there is a pole at zero, and no value.
    finite = first <= 1.5 * np.abs(at[1][0])
    # Less than this beside what L has there already is a zero at the origin.
    known = np.abs(value) > np.maximum(1e-4 * first, noise)
    return np.where(finite & known, value, 0.0)


def _crossings(
    loop: _Loop,
    eigenvalues: _Complex,
    size: np.ndarray,
    step: Callable[[_Complex, _Complex], np.ndarray],
) -> tuple[np.ndarray, _Complex, np.ndarray]:
    """Loops (c,) that may cross near the imaginary eigenvalues (m, 2 n), and L and its rounding
    (c,) there.

    Args:
        step: Newton's, of L and its derivative.
    """
    near = np.abs(eigenvalues.real) <= _AXIS * np.abs(eigenvalues) + _STILL * size[:, None]
    row, i = np.nonzero(near & (eigenvalues.imag > 0))
    x, loop = np.log(eigenvalues.imag[row, i]), loop.take(row)
    for _ in range(_NEWTON):
        by = step(*_response(loop, np.exp(x))[:2])
        x = x - np.where(np.isfinite(by), np.clip(by, -_LARGEST, _LARGEST), 0.0)
    L, _, noise = _response(loop, np.exp(x))
    return row, L, noise
