"""Conversion between discrete and continuous transfer functions: c2d and d2c, with their limits."""

from typing import Literal

import numpy as np
import scipy.linalg
from numpy.typing import ArrayLike

Polynomials = tuple[np.ndarray, np.ndarray]


def c2d(num: ArrayLike, den: ArrayLike, dt: float) -> Polynomials:
    """Return the zero-order-hold equivalent of H(s) = num/den for steps of `dt` [s].

    Both results have the length of `den`, and the denominator begins with 1.

    Args:
        num: numerator of H(s), highest power first.
        den: denominator of H(s), highest power first.
        dt: time between samples [s].

    Raises:
        ValueError: not a proper transfer function, or `dt` is not positive.
    """
    A, B, C, D = _state_space(num, den, dt)
    n = A.shape[0]
    M = np.zeros((n + 1, n + 1))
    M[:n, :n], M[:n, n:] = A, B
    # The exponential of [[A, B], [0, 0]] contains the integral of the held input, also for singular
    # A.
    E = scipy.linalg.expm(M * dt)
    return _polynomials(E[:n, :n], E[:n, n:], C, D)


def d2c(
    num: ArrayLike, den: ArrayLike, dt: float, method: Literal["zoh", "real-log"] = "zoh"
) -> Polynomials:
    """Return a continuous H(s) for the discrete Hd(z) = num/den with steps of `dt` [s].

    "zoh" inverts the zero-order hold and raises if no inverse of the same order exists. "real-log"
    takes the real part of the matrix logarithm of [[Ad, Bd], [0, 1]], which gives Kim & Tilbury's
    eq. 35 from eq. 34. If "zoh" raises, its result differs from Hd.

    Args:
        num: numerator of Hd(z), highest power first.
        den: denominator, likewise.
        dt: time between samples [s].

    Raises:
        ValueError: unknown method, not a proper transfer function, a pole at z = 0, or, with "zoh",
            a pole on the negative real axis.
    """
    if method not in ("zoh", "real-log"):
        raise ValueError(f"method: expected 'zoh' or 'real-log', got {method!r}")
    A, B, C, D = _state_space(num, den, dt)
    n = A.shape[0]
    poles = np.asarray(np.linalg.eigvals(A), dtype=np.complex128)
    size = max(1.0, float(np.max(np.abs(poles), initial=0.0)))
    # A pole at zero is a whole sample of delay, which a system of finite order in s cannot have.
    if np.any(np.abs(poles) < 1e-12 * size):
        raise ValueError("the discrete system has a pole at z = 0: its logarithm does not exist")
    # Rounding may move a real pole slightly off the axis.
    negative = poles[(poles.real < 0) & (np.abs(poles.imag) < 1e-9 * size)].real
    if method == "zoh" and negative.size:
        named = ", ".join(f"{p:.3f}" for p in sorted(negative))
        raise ValueError(
            "the zero-order hold has no inverse: the discrete system has a real pole at z = "
            f"{named}, which no sampled continuous system of order {n} has; method='real-log' "
            "gives a real approximation, which is another system"
        )
    M = np.eye(n + 1)
    M[:n, :n], M[:n, n:] = A, B
    # [[Ad, Bd], [0, 1]] is the exponential of [[A, B], [0, 0]] dt. logm warns for negative
    # eigenvalues, which were handled above.
    L = np.asarray(scipy.linalg.logm(M.astype(complex))).real / dt
    if not np.isfinite(L).all():
        raise ValueError("the matrix logarithm of the discrete system does not exist")
    return _polynomials(L[:n, :n], L[:n, n:], C, D)


def _state_space(num: ArrayLike, den: ArrayLike, dt: float) -> tuple[np.ndarray, ...]:
    b: np.ndarray = np.atleast_1d(np.asarray(num, float))
    a: np.ndarray = np.atleast_1d(np.asarray(den, float))
    if not (np.isfinite(dt) and dt > 0):
        raise ValueError(f"dt must be above zero, a sample time in seconds, got {dt}")
    if b.ndim != 1 or a.ndim != 1 or not (np.isfinite(b).all() and np.isfinite(a).all()):
        raise ValueError("num and den must be lists of finite numbers")
    b, a = np.trim_zeros(b, "f"), np.trim_zeros(a, "f")
    if a.size < 2:
        raise ValueError("den must have a power of one at least")
    if b.size > a.size:
        raise ValueError("num is of higher order than den: not a proper transfer function")
    # A leading 1 in the denominator fixes the common factor of both polynomials.
    b, a = b / a[0], a / a[0]
    padded = np.concatenate([np.zeros(a.size - b.size), b])
    n = a.size - 1
    # Controllable canonical form.
    A = np.eye(n, k=-1)
    A[0] = -a[1:]
    B = np.eye(n, 1)
    C = (padded[1:] - padded[0] * a[1:])[None, :]
    return A, B, C, padded[:1, None]


def _polynomials(A: np.ndarray, B: np.ndarray, C: np.ndarray, D: np.ndarray) -> Polynomials:
    den = np.real(np.poly(A))
    # det(s - A + bc) - det(s - A) would have small coefficients as differences of large ones.
    num = D[0, 0] * den + _numerator(A, B[:, 0], C[0])
    return num, den


def _numerator(A: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    """Return num of c (s - A)^-1 b by Leverrier's recursion, without cancellation."""
    n = A.shape[0]
    den = np.real(np.poly(A))
    num = np.zeros(n + 1)
    # The coefficient of s^(n-1-k) is c (A^k + den_1 A^(k-1) + ... + den_k) b.
    v = b.astype(float)
    for k in range(n):
        num[k + 1] = c @ v
        v = A @ v + den[k + 1] * b
    return num
