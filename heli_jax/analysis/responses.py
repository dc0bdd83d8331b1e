"""Frequency responses from averaged spectra: several inputs at once, with coherence and errors.

Inputs that move together are separated (conditioned responses), and with an instrument, an
excitation that was logged and that no feedback reaches, the responses are those of the vehicle
where pilot or autopilot close the loop.

Sources: Bendat and Piersol, Random Data (2010), chapters 7 and 9; Wellstead (1981) for responses by
instrument; Tischler and Remple (2012), chapters 7 to 10.
"""

import warnings
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy.special
from jaxtyping import Complex, Float

from heli_jax.analysis.spectra import Spectra, octave_mean

_SINGULAR = 1e-9
"""smallest singular value of the inputs' matrix of coherences, below which they move as one"""
_ROUNDING = 1e-14
"""of an output's density, what rounding leaves where the inputs explain all of it"""
_STRONG = 0.25
"""of c S_vv in the mean over an octave, up to which an instrument is strong enough: F of 7.7"""
Z95 = 1.959963984540054
"""half of a 95 % interval in standard deviations that are known"""


class TooFewAveragesError(ValueError):
    """Too few averages: at least one more than the inputs is needed."""


class Responses(NamedTuple):
    """From m inputs to l outputs at k frequencies."""

    omega: np.ndarray
    """(k,) [rad/s]"""
    H: np.ndarray
    """(k, l, m) complex"""
    sd: np.ndarray
    """(k, l, m) of the real and of the imaginary part of H: over |H| it is the relative random
    error of the gain, and that of the phase [rad]"""
    coherence: np.ndarray
    """(k, l, m) partial coherence of each input, what the others explain taken out; by instrument
    of that part of the input that follows the instruments"""
    multiple: np.ndarray
    """(k, l) of an output's power, the part that all inputs explain together"""
    noise: np.ndarray
    """(k, l) density of what they leave, per Hz"""
    averages: float
    """independent ones"""
    ends: np.ndarray | None = None
    """(k, m, m) what of each input in the window's slope counts as each input [1/s]"""


def responses(
    spectra: Spectra,
    inputs: Sequence[int],
    outputs: Sequence[int],
    instruments: Sequence[int] | None = None,
) -> Responses:
    """Responses of each output to each input, the others taken into account.

    Where inputs move as one (or one does not move) no response is determined: it is NaN there, and
    where an instrument is too weak beside what else moves its input (`fieller`).

    Args:
        instruments: as many excitations, outside of every feedback; without them the inputs are
            taken for ones that do not follow the outputs.

    Raises:
        TooFewAveragesError: for so many inputs.
        ValueError: not as many instruments as inputs.
    """
    u, y = list(inputs), list(outputs)
    z = u if instruments is None else list(instruments)
    m, S, n = len(u), spectra.density, spectra.averages
    if len(z) != m:
        raise ValueError(f"instruments: expected {m}, one for each input, got {len(z)}")
    if n < m + 1:
        many = "1 input" if m == 1 else f"{m} inputs"
        raise TooFewAveragesError(
            f"expected at least {m + 1} independent averages for {many}, got "
            f"{n:.2f}: a longer record, or a shorter window"
        )
    # y = H u + e and a mean of conj(z) e that tends to zero: S_zy = S_zu H^T.
    P = inverse(S[:, z][:, :, u], np.real(S[:, z, z]), np.real(S[:, u, u]))
    H = np.swapaxes(P @ S[:, z][:, :, y], 1, 2)
    left = _left(S, u, y, H)
    # Covariance of S_zu^-1 S_ze, where that of S_ze is S_zz times the noise over the averages.
    spread = np.real(np.einsum("kjz,kzw,kjw->kj", P, S[:, z][:, :, z], np.conj(P)))
    error = left[:, :, None] * spread[:, None, :]
    power = np.real(S[:, y, y])
    with np.errstate(all="ignore"):
        coherence = np.abs(H) ** 2 / (np.abs(H) ** 2 + error)
        multiple = np.clip(1.0 - left / power, 0.0, 1.0)
    # Each input takes one of the averages for its own response.
    sd = np.sqrt(0.5 * error / (n - m))
    if instruments is not None:
        half95 = float(student95(np.asarray(2.0 * (n - m))))
        sd = sd_of_ratio(spectra.omega, S, (u, y, z), H, left, spread / (n - m), half95)
        H = np.where(np.isfinite(sd), H, np.nan)
    noise = left * n / (n - m)
    ends = None
    if spectra.steep is not None:
        Z = spectra.X[:, :, z]
        ends = P @ (np.conj(np.swapaxes(Z, 1, 2)) @ spectra.steep[:, :, u]) / Z.shape[1]
    return Responses(spectra.omega, H, sd, coherence, multiple, noise, n, ends)


def inverse(M: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Return the inverse of matrices (k, m, m); NaN where one is singular but for rounding.

    Args:
        rows: densities (k, m) of the signals of the rows.
    """
    with np.errstate(all="ignore"):
        scale = 1.0 / np.sqrt(rows[:, :, None] * columns[:, None, :])
        scaled = M * scale
        sound = np.isfinite(scaled).all((1, 2))
        scaled = np.where(sound[:, None, None], scaled, np.eye(M.shape[1]))
        # In coherences, so that units do not count.
        sound &= np.linalg.svd(scaled, compute_uv=False)[:, -1] > _SINGULAR
        inverted = np.linalg.inv(np.where(sound[:, None, None], scaled, np.eye(M.shape[1])))
        return np.where(sound[:, None, None], inverted * np.swapaxes(scale, 1, 2), np.nan)


def _left(S: np.ndarray, u: list[int], y: list[int], H: np.ndarray) -> np.ndarray:
    """Density (k, l) of y - H u, not below what rounding leaves."""
    power = np.real(S[:, y, y])
    crossed = np.real(np.einsum("klm,klm->kl", H, S[:, y][:, :, u]))
    explained = np.real(np.einsum("kla,kab,klb->kl", np.conj(H), S[:, u][:, :, u], H))
    return np.maximum(power - 2.0 * crossed + explained, _ROUNDING * power)


# Intervals of responses by instrument.
#
# These are ratios of two numbers with errors. With w_j the combination of the instruments that goes
# with input j alone, H_j = S_wy / S_wu, and a response H' agrees with the record in the disc
#
#     |H' - H|^2 <= c (S_ee - 2 Re(conj(H' - H) S_ue) + |H' - H|^2 S_vv),  c = t^2 S_ww / (2 n),
#
# with Student's t and v what of the input no instrument explains. Where the excitation is weak
# beside v, the disc is larger than the first-order error and lies to one side. Where c S_vv reaches
# 1 it has no end: nothing is known of the response.
#
# Sources: Fieller (1954); Anderson and Rubin (1949) for instruments.


def sd_of_ratio(
    omega: Float[np.ndarray, " k"],
    S: Complex[np.ndarray, "k c c"],
    signals: tuple[list[int], list[int], list[int]],
    H: Complex[np.ndarray, "k l m"],
    left: Float[np.ndarray, "k l"],
    spread: Float[np.ndarray, "k m"],
    half95: float,
) -> Float[np.ndarray, "k l m"]:
    """Standard deviations of real and imaginary part whose 95 % intervals hold Fieller's discs;
    NaN where these are unbounded.

    Args:
        omega: frequencies [rad/s].
        signals: places of the inputs, of the outputs and of the instruments.
        half95: half of a 95 % interval in standard deviations.
    """
    u, y, z = signals
    zz, zu = S[:, z][:, :, z], S[:, z][:, :, u]
    with np.errstate(all="ignore"):
        explained = np.real(
            np.einsum("kzj,kzj->kj", np.conj(zu), np.linalg.pinv(zz, rcond=1e-12) @ zu)
        )
        own = np.maximum(np.real(S[:, u, u]) - explained, 0.0)
        # Of y - H u with each input.
        crossed = S[:, u][:, :, y] - np.einsum("kja,kla->kjl", S[:, u][:, :, u], H)
        c = 0.5 * half95**2 * spread
        # An input that is its own instrument has nothing of its own, but for rounding.
        direct = np.array([a == b for a, b in zip(u, z, strict=True)])
        room = np.where(direct, 1.0, 1.0 - c * own)[:, None, :]
        aside = np.where(direct, 0.0, np.abs(np.swapaxes(crossed, 1, 2)) * c[:, None, :]) / room
        reach = aside + np.sqrt(c[:, None, :] * left[:, :, None] / room + aside**2)
        # Among weak ones a single frequency is strong by chance, and has the wrong response by the
        # same chance: the octave around it has to be strong as well.
        share = explained / np.maximum(explained + own, 1e-300)
        around = np.stack([octave_mean(omega, v) for v in share.T], axis=1)
        # c S_vv again, with the octave's share of the input that instruments explain.
        likely = 0.5 * Z95**2 * spread
        strong = direct | (likely * explained * (1.0 - around) < _STRONG * around)
        return np.where((room > 0) & strong[:, None, :], reach / half95, np.nan)


# Variances from few averages.
#
# Of n averages a variance is known to the n - m degrees of freedom that m inputs leave. Weights by
# such variances trust the frequencies that happened to look quiet: of windows of half a record 72 %
# of a delay's 95 % intervals held the truth. So the noise is a mean over frequencies.
#
# Source: Pintelon and Schoukens (2012), section 9.4.


_ENOUGH = 40.0
"""degrees of freedom of a variance from which on weights by it are as good as by the true one"""
RESOLVED = 1.95
"""frequencies closer than this over the window's length are not independent (Hann)"""
_TRIANGLE = 1.5
"""equal terms whose mean is as certain as one in a triangle of half this half-width"""


def independent_shares(omega: Float[np.ndarray, " k"], seconds: float) -> Float[np.ndarray, " k"]:
    """Return the share of an independent frequency that each frequency (k,) has.

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


# What windows add to a response at the ends of a record.
#
# Of a response y = h * u a window w shows, by Taylor's series of w(t + tau),
#
#     Y_w = H U_w + i H' U_w' + ...,
#
# U_w' being the input in the window's slope and H' the derivative of H by frequency. Windows that
# overlap by two thirds cancel each other's second term, but not at the ends of a record and of each
# part between missing samples, nor where a window's width brings the input's power from another
# frequency (the flanks of a sine, frequencies beyond a sweep). All of it is known but H'.
#
# With e the part of the input in the window's slope that counts as the input, a measured response
# is, to first order, that at omega + i e. H' is the slope of a straight line through responses at
# such places. For a single sine they coincide, and H' is unknown: it may then be anything that
# windows of that length resolve.
#
# Source: Pintelon and Schoukens (2012), chapter 6.


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
    """Subtract, to first order, the errors that windows add at the ends of records and on the
    flanks of held inputs; return the responses and their standard deviation.

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
    """Set up the derivatives of l responses to one input.

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
        before = 0.5 * (_RESOLVES * seconds / (2.0 * np.pi)) ** 2 * np.abs(H) ** 2
        # The mean of what the line says and of what windows resolve, by their errors.
        part = np.where(enough, before / (before + chance), 0.0)
        left = np.where(enough, part * chance, np.where(known, before, 0.0))
    return alone._replace(part=part * alone.part, variance=left)
