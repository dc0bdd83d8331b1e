"""What windows add to a response at the ends of a record and of its parts, and how it is taken off.

Of an answer y = h * u a window w sees, by Taylor's series of w(t + tau),

    Y_w = H U_w + i H' U_w' + ...,

U_w' being the input in the window's slope and H' the response's derivative by frequency. Of windows
that overlap by two thirds the middle ones cancel each other's second term; those at the ends of a
record, and of each part between missing samples, do not. All of it is known but H', which is as
good as the response itself.

Source: Pintelon and Schoukens (2012), chapter 6, for the errors of windows.
"""

import warnings

import numpy as np
from jaxtyping import Bool, Complex, Float

from heli_jax.analysis.noise_over_lines import RESOLVED

_LINES = 2.5
"""of the window, to either side of a frequency, that the response's derivative is taken from: its
error is then a small part of the response's own"""
_LEAST = 3
"""frequencies to either side that it is taken from at least"""
_ROUNDS = 3
"""the derivative is that of the response with the ends' part in it at first"""
_UNKNOWN = 0.2
"""of what is taken off, what stays in the response's error"""
_ALONE = 1e-3
"""variance of the places that a straight line lies through, in its half-width squared, below which
they have no slope"""


def without_ends(
    omega: Float[np.ndarray, " k"],
    H: Complex[np.ndarray, "k l m"],
    sd: Float[np.ndarray, "k l m"],
    ends: Complex[np.ndarray, "k m m"],
    seconds: float,
) -> tuple[Complex[np.ndarray, "k l m"], Float[np.ndarray, "k l m"]]:
    """What windows add to responses at the ends of records, to first order, and the standard
    deviation of the responses without it.

    Args:
        omega: frequencies [rad/s], rising.
        H: l outputs over m inputs; NaN where they are not known.
        sd: of their real and imaginary parts.
        ends: what of each input in the window's slope counts as each input in the window [1/s].
        seconds: length of a window.
    """
    known = np.isfinite(H) & np.isfinite(sd) & (sd > 0)
    # Where an input has no response of its own it has none to take off.
    ends = np.where(np.isfinite(ends), ends, 0.0)
    added, now = np.zeros_like(H), sd
    size = part = chance = np.zeros(H.shape)
    for _ in range(_ROUNDS):
        rest = np.where(known, H - added, 0.0)
        # What is taken off has errors, and its derivative has them too: where a window ends in the
        # middle of a sweep they would grow by a factor a round.
        slopes, variances = _derivative(omega, rest, known, now, seconds)
        whole = 1j * np.einsum("kij,koj->koi", ends, slopes)
        chance = np.einsum("kij,koj->koi", np.abs(ends) ** 2, variances)
        # Of what is noise as much as not, only as much as makes the error least.
        size = np.abs(whole) ** 2
        part = size / np.maximum(size + 2.0 * chance, np.finfo(float).tiny)
        added, now = part * whole, np.sqrt(sd**2 + part**2 * chance)
    return added, np.sqrt(now**2 + (_UNKNOWN * part) ** 2 * size)


def _derivative(
    omega: Float[np.ndarray, " k"],
    H: Complex[np.ndarray, "k l m"],
    known: Bool[np.ndarray, "k l m"],
    sd: Float[np.ndarray, "k l m"],
    seconds: float,
) -> tuple[Complex[np.ndarray, "k l m"], Float[np.ndarray, "k l m"]]:
    """Of responses by frequency [s], by local straight lines, and the variance of its real and of
    its imaginary part; both zero where too little is known."""
    d = omega[None, :] - omega[:, None]
    least = np.sort(np.abs(d), axis=1)[:, min(2 * _LEAST, omega.size - 1)]
    reach = np.maximum(_LINES * 2.0 * np.pi / seconds, 1.01 * least)[:, None]
    d = d / reach
    near = np.maximum(1.0 - d**2, 0.0) * np.gradient(omega)
    # By the errors too, but not so that one frequency has it all.
    variance = np.where(known, sd, np.nan) ** 2
    with np.errstate(all="ignore"), warnings.catch_warnings():
        # Of a pair that is known nowhere.
        warnings.simplefilter("ignore", RuntimeWarning)
        weights = np.where(known, 1.0 / (variance + np.nanmedian(variance, axis=0)), 0.0)
        flat, values = (v.reshape(omega.size, -1) for v in (weights, weights * H))
        S0, S1, S2 = (near * d**i @ flat for i in range(3))
        T0, T1 = (near * d**i @ values for i in range(2))
        spread = S0 * S2 - S1**2
        enough = known & (spread > _ALONE * S0**2).reshape(H.shape)
        slopes = ((S0 * T1 - S1 * T0) / (spread * reach)).reshape(H.shape)
        # Of independent frequencies within reach, and how far apart they are.
        independent = np.maximum(reach * seconds / (np.pi * RESOLVED), 1.0)
        apart = (spread / S0**2 * reach**2 * independent).reshape(H.shape)
        variances = variance / apart
    return np.where(enough, slopes, 0.0), np.where(enough, variances, 0.0)
