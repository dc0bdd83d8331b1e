"""Errors that windows make, at the ends of a record and of few averages, and how they go.

Of an answer y = h * u a window w sees, by Taylor's series of w(t + tau),

    Y_w = H U_w + i H' U_w' + ...,

U_w' being the input in the window's slope and H' the response's derivative by frequency. Of windows
that overlap by two thirds the middle ones cancel each other's second term; those at the ends of a
record, and of each part between missing samples, do not. Nor does it cancel where an input has its
power at another frequency and a window's width brings it here, as on the flanks of a single sine
and beyond the last frequency of a sweep. All of it is known but H'.

With e what of the input in the window's slope counts as the input, a measured response is, to
first order, that at omega + i e: at another frequency, or about another time. H' is the slope
of a straight line through responses at such places. Of a single sine they are all one, and H' is
not known: it may then be anything that windows of that length resolve.

Source: Pintelon and Schoukens (2012), chapter 6, for the errors of windows.

Where there are few averages the noise of a response is a mean over frequencies. Of n averages a
variance is known to the n - m degrees of freedom that m inputs leave, of two averages to little
more than its order of magnitude. Weights by such variances trust the frequencies that happened to
look quiet: of windows of half a record 72 % of a delay's 95 % intervals held the truth.

Source: Pintelon and Schoukens (2012), section 9.4, for weights by estimated variances.
"""

import warnings
from typing import NamedTuple

import numpy as np
import scipy.special
from jaxtyping import Complex, Float

Z95 = 1.959963984540054
"""half of a 95 % interval in standard deviations that are known"""
_ENOUGH = 40.0
"""degrees of freedom of a variance from which on weights by it are as good as by the true one"""
RESOLVED = 1.95
"""frequencies closer than this over the window's length are not independent (Hann)"""
_TRIANGLE = 1.5
"""equal terms whose mean is as certain as one in a triangle of half this half-width"""


def independent_shares(omega: Float[np.ndarray, " k"], seconds: float) -> Float[np.ndarray, " k"]:
    """Of each frequency (k,) how much of an independent one it is.

    Args:
        omega: (k,) [rad/s], rising.
    """
    # Half of the way to each neighbour.
    width = np.gradient(omega) if omega.size > 1 else np.ones(1)
    return np.minimum(width * seconds / (2.0 * np.pi * RESOLVED), 1.0)


def averaged(
    noise: Float[np.ndarray, " k"], shares: Float[np.ndarray, " k"], averages: float
) -> tuple[Float[np.ndarray, " k"], float]:
    """A mean over as many independent frequencies as it takes, and its degrees of freedom.

    Args:
        noise: density (k,); NaN where it is not known.
        shares: (k,) how much of an independent frequency each is.
    """
    known = np.isfinite(noise) & (shares > 0)
    each = 2.0 * averages
    # Half-width of the triangle, in independent frequencies.
    reach = _ENOUGH / each / _TRIANGLE
    at = np.cumsum(shares) - 0.5 * shares
    near = np.maximum(1.0 - np.abs(at[:, None] - at[None, :]) / reach, 0.0) * np.where(
        known, shares, 0.0
    )
    with np.errstate(all="ignore"):
        mean = near @ np.where(known, noise, 0.0) / np.sum(near, axis=1)
    total = float(np.sum(shares[known]))
    freedom = each * max(min(_TRIANGLE * reach, total), 1.0)
    return np.where(known, mean, np.nan), freedom


def student95(freedom: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    """Half of a 95 % interval in standard deviations: Student's t.

    Args:
        freedom: degrees of freedom of the standard deviations, 1 at least; any shape.
    """
    return scipy.special.stdtrit(np.maximum(freedom, 1.0), 0.975)


_LINES = 2.5
"""of the window, around a frequency, that the response's derivative is taken from: its error is
then a small part of the response's own"""
_LEAST = 3
"""frequencies to either side that it is taken from at least"""
_ROUNDS = 3
"""what one input makes of another's response is that response's derivative, and the other way"""
_UNKNOWN = 0.2
"""of what is taken off, what stays in the response's error"""
_RESOLVES = 1.0
"""relative change of a response in a line of the window, beyond which none is resolved: what its
derivative may be where responses do not tell"""
_USUALLY = 2.0
"""times the usual derivative, what one may be that is not known"""
_ALONE = 2e-2
"""variance of the places that a straight line lies through, in its half-width squared, below which
they have no slope"""


def without_ends(
    omega: Float[np.ndarray, " k"],
    H: Complex[np.ndarray, "k l m"],
    sd: Float[np.ndarray, "k l m"],
    ends: Complex[np.ndarray, "k m m"],
    seconds: float,
) -> tuple[Complex[np.ndarray, "k l m"], Float[np.ndarray, "k l m"]]:
    """What windows add to responses at the ends of records and on the flanks of what an input
    holds, to first order, and the standard deviation of the responses without it.

    Args:
        omega: frequencies [rad/s], rising.
        H: l outputs over m inputs; NaN where they are not known.
        ends: what of each input in the window's slope counts as each input in the window [1/s].
    """
    known = np.isfinite(H) & np.isfinite(sd) & (sd > 0)
    # Where an input has no response of its own it has none to take off.
    ends = np.where(np.isfinite(ends), ends, 0.0)
    own = np.einsum("kii->ki", ends)
    others = ends - own[:, :, None] * np.eye(own.shape[1])
    at = omega[:, None] + 1j * own
    measured, errors = np.where(known, H, 0.0), np.where(known, sd, np.nan)
    lines = [
        _line(omega, at[:, j], (measured[:, :, j], errors[:, :, j]), seconds)
        for j in range(own.shape[1])
    ]
    slopes = np.zeros_like(H)
    for _ in range(_ROUNDS if np.any(others) else 1):
        rest = np.where(known, H - 1j * _summed(others, slopes), 0.0)
        slopes = np.stack([line.slope(rest[:, :, j]) for j, line in enumerate(lines)], axis=2)
    added = 1j * _summed(ends, slopes)
    # What is taken off has errors, and its derivative has them too.
    chance = _summed(np.abs(ends) ** 2, np.stack([line.variance for line in lines], axis=2))
    return added, np.sqrt(sd**2 + chance + (_UNKNOWN * np.abs(added)) ** 2)


def _summed(
    ends: Float[np.ndarray, "k m m"] | Complex[np.ndarray, "k m m"], v: np.ndarray
) -> np.ndarray:
    """(k, l, m) what inputs' derivatives v (k, l, m) make of each input's response."""
    return v @ np.swapaxes(ends, 1, 2)


class _Line(NamedTuple):
    """Straight lines through l responses to an input around each frequency."""

    near: Complex[np.ndarray, "both k k"]
    """weights of the places around each, once and times their conjugate distances"""
    flat: Float[np.ndarray, "k l"]
    """weights by the responses' errors"""
    mean: Complex[np.ndarray, "k l"]
    """conjugate distance of the middle of the places, times the sum of weights"""
    total: Float[np.ndarray, "k l"]
    """sum of weights"""
    part: Float[np.ndarray, "k l"]
    """what a slope takes of the line's, over the weights' determinant; zero where there is none"""
    variance: Float[np.ndarray, "k l"]
    """of the slope's real and of its imaginary part"""

    def slope(self, H: Complex[np.ndarray, "k l"]) -> Complex[np.ndarray, "k l"]:
        """By frequency [s], of responses that are zero where they are not known."""
        T0, T1 = self.near @ (self.flat * H)
        return self.part * (self.total * T1 - self.mean * T0)


def _line(
    omega: Float[np.ndarray, " k"],
    at: Complex[np.ndarray, " k"],
    measured: tuple[Complex[np.ndarray, "k l"], Float[np.ndarray, "k l"]],
    seconds: float,
) -> _Line:
    """How derivatives are taken from l responses to one input.

    Args:
        at: (k,) where the responses were measured.
        measured: these, zero where they are not known, and the standard deviations of their real
            and imaginary parts, NaN there.
    """
    H, variance = measured[0], measured[1] ** 2
    known = np.isfinite(variance)
    far = np.sort(np.abs(omega[None, :] - omega[:, None]), axis=1)
    least = far[:, min(2 * _LEAST, omega.size - 1)]
    reach = np.maximum(_LINES * 2.0 * np.pi / seconds, 1.01 * least)[:, None]
    d = (at[None, :] - omega[:, None]) / reach
    width = np.gradient(omega) if omega.size > 1 else np.ones(1)
    near = np.maximum(1.0 - np.abs(d) ** 2, 0.0) * width
    # Of independent frequencies within reach, and how far apart they are.
    independent = np.maximum(reach * seconds / (np.pi * RESOLVED), 1.0)
    with np.errstate(all="ignore"), warnings.catch_warnings():
        # Of a pair that is known nowhere.
        warnings.simplefilter("ignore", RuntimeWarning)
        # By the errors too, but not so that one frequency has it all.
        flat = np.where(known, 1.0 / (variance + np.nanmedian(variance, axis=0)), 0.0)
        both = np.stack([near, near * np.conj(d)])
        (S0, S1), S2 = both @ flat, (near * np.abs(d) ** 2) @ flat
        S0 = np.real(S0)
        spread = S0 * S2 - np.abs(S1) ** 2
        enough = known & (spread > _ALONE * S0**2)
        chance = variance / (spread / S0**2 * reach**2 * independent)
        alone = _Line(both, flat, S1, S0, np.where(enough, 1.0 / (spread * reach), 0.0), chance)
        usual = _usual(omega, np.where(enough, alone.slope(H), np.nan) / H, chance / np.abs(H) ** 2)
        before = np.minimum(usual, 0.5 * (_RESOLVES * seconds / (2.0 * np.pi)) ** 2)
        before = before * np.abs(H) ** 2
        # The mean of what the line says and of what is usual, by their errors.
        part = np.where(enough, before / (before + chance), 0.0)
        left = np.where(enough, part * chance, np.where(known, before, 0.0))
    return alone._replace(part=part * alone.part, variance=left)


def _usual(
    omega: Float[np.ndarray, " k"],
    slopes: Complex[np.ndarray, "k l"],
    variances: Float[np.ndarray, "k l"],
) -> Float[np.ndarray, "k l"]:
    """Mean square of a real or imaginary part of relative derivatives within an octave to either
    side, twice over, for where they are not known; infinite where none is.

    Args:
        omega: (k,) [rad/s]
        slopes: (k, l) over the responses; NaN where they are not known.
        variances: (k, l) of their real and of their imaginary parts.
    """
    near = (np.abs(np.log2(omega[:, None] / omega[None, :])) <= 1.0).astype(float)
    known = np.isfinite(slopes) & np.isfinite(variances)
    typical = np.nanmedian(np.where(known, variances, np.nan), axis=0)
    weights = np.where(known, 1.0 / (variances + typical), 0.0)
    squares = near @ np.where(known, weights * np.abs(slopes) ** 2, 0.0)
    total = near @ weights
    return np.where(total > 0, _USUALLY**2 * 0.5 * squares / total, np.inf)
