"""Frequency responses from averaged spectra with several inputs, with coherence and errors.

Inputs that move together are separated (conditioned responses). An instrument is a logged
excitation outside all feedback; with it the responses are the vehicle's own, even under closed-loop
control.

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
"""Smallest singular value of the inputs' coherence matrix; below it they move as one."""
_ROUNDING = 1e-14
"""Rounding error of a fully explained output [fraction of its density]."""
_STRONG = 0.25
"""Largest mean of c S_vv over an octave at which an instrument is strong enough (F of 7.7)."""
Z95 = 1.959963984540054
"""Half-width of a 95 % interval [sd], for known standard deviations."""


class TooFewAveragesError(ValueError):
    """Too few averages; at least one more than the inputs is needed."""


class Responses(NamedTuple):
    """Responses from m inputs to l outputs at k frequencies."""

    omega: np.ndarray
    """Frequencies (k,) [rad/s]."""
    H: np.ndarray
    """Responses (k, l, m), complex."""
    sd: np.ndarray
    """Standard deviation (k, l, m) of the real and of the imaginary part of H. Over |H| it is the
    relative random error of the gain, and the error of the phase [rad].
    """
    coherence: np.ndarray
    """Partial coherence (k, l, m) of each input, without the parts of other inputs. With
    instruments, it is that of the input's part that follows them.
    """
    multiple: np.ndarray
    """Share (k, l) of an output's power that all inputs explain together."""
    noise: np.ndarray
    """Density (k, l) of the residual, per Hz."""
    averages: float
    """Number of independent averages."""
    ends: np.ndarray | None = None
    """Part (k, m, m) of each input, with the window's derivative, that counts as each input [1/s].
    """


def responses(
    spectra: Spectra,
    inputs: Sequence[int],
    outputs: Sequence[int],
    instruments: Sequence[int] | None = None,
) -> Responses:
    """Return the responses of each output to each input, with the other inputs accounted for.

    A response is NaN if inputs move as one or not at all, or if an instrument explains too little
    of its input (`sd_of_ratio`).

    Args:
        instruments: an excitation of each input, outside all feedback. Without it, inputs must not
            depend on the outputs.

    Raises:
        TooFewAveragesError: there are too few averages for the number of inputs.
        ValueError: the numbers of instruments and inputs differ.
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
    # With y = H u + e and a mean of conj(z) e that tends to zero, S_zy = S_zu H^T.
    P = inverse(S[:, z][:, :, u], np.real(S[:, z, z]), np.real(S[:, u, u]))
    H = np.swapaxes(P @ S[:, z][:, :, y], 1, 2)
    left = _left(S, u, y, H)
    # Covariance of S_zu^-1 S_ze, where S_ze has the covariance S_zz times noise over averages.
    spread = np.real(np.einsum("kjz,kzw,kjw->kj", P, S[:, z][:, :, z], np.conj(P)))
    error = left[:, :, None] * spread[:, None, :]
    power = np.real(S[:, y, y])
    with np.errstate(all="ignore"):
        coherence = np.abs(H) ** 2 / (np.abs(H) ** 2 + error)
        multiple = np.clip(1.0 - left / power, 0.0, 1.0)
    # Each input uses one of the averages for its response.
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
    """Return the inverses of matrices (k, m, m); NaN where one is numerically singular.

    Args:
        rows: densities (k, m) of the signals of the rows.
    """
    with np.errstate(all="ignore"):
        scale = 1.0 / np.sqrt(rows[:, :, None] * columns[:, None, :])
        scaled = M * scale
        sound = np.isfinite(scaled).all((1, 2))
        scaled = np.where(sound[:, None, None], scaled, np.eye(M.shape[1]))
        # Scaled to coherences, so that units do not matter.
        sound &= np.linalg.svd(scaled, compute_uv=False)[:, -1] > _SINGULAR
        inverted = np.linalg.inv(np.where(sound[:, None, None], scaled, np.eye(M.shape[1])))
        return np.where(sound[:, None, None], inverted * np.swapaxes(scale, 1, 2), np.nan)


def _left(S: np.ndarray, u: list[int], y: list[int], H: np.ndarray) -> np.ndarray:
    """Return the density (k, l) of y - H u, bounded below by the rounding error."""
    power = np.real(S[:, y, y])
    crossed = np.real(np.einsum("klm,klm->kl", H, S[:, y][:, :, u]))
    explained = np.real(np.einsum("kla,kab,klb->kl", np.conj(H), S[:, u][:, :, u], H))
    return np.maximum(power - 2.0 * crossed + explained, _ROUNDING * power)


# Intervals of responses by instrument. These are ratios of two uncertain numbers. With w_j the
# combination of the instruments for input j alone, H_j = S_wy / S_wu. A response H' agrees with the
# record in a disc: |H' - H|^2 <= c (S_ee - 2 Re(conj(H' - H) S_ue) + |H' - H|^2 S_vv), c = t^2 S_ww
# / (2 n). Here t is Student's t, and v the part of the input that no instrument explains. If the
# excitation is weak beside v, the disc is larger than the first-order error and off centre. If c
# S_vv reaches 1, it is unbounded: the response is unknown. Sources: Fieller (1954); Anderson and
# Rubin (1949) for instruments.


def sd_of_ratio(
    omega: Float[np.ndarray, " k"],
    S: Complex[np.ndarray, "k c c"],
    signals: tuple[list[int], list[int], list[int]],
    H: Complex[np.ndarray, "k l m"],
    left: Float[np.ndarray, "k l"],
    spread: Float[np.ndarray, "k m"],
    half95: float,
) -> Float[np.ndarray, "k l m"]:
    """Return the sd of real and imaginary part whose 95 % intervals contain Fieller's discs.

    It is NaN where a disc is unbounded.

    Args:
        omega: frequencies [rad/s].
        signals: indices of the inputs, of the outputs and of the instruments.
        half95: half-width of a 95 % interval [sd].
    """
    u, y, z = signals
    zz, zu = S[:, z][:, :, z], S[:, z][:, :, u]
    with np.errstate(all="ignore"):
        explained = np.real(
            np.einsum("kzj,kzj->kj", np.conj(zu), np.linalg.pinv(zz, rcond=1e-12) @ zu)
        )
        own = np.maximum(np.real(S[:, u, u]) - explained, 0.0)
        # Cross-density of y - H u with each input.
        crossed = S[:, u][:, :, y] - np.einsum("kja,kla->kjl", S[:, u][:, :, u], H)
        c = 0.5 * half95**2 * spread
        # Apart from rounding, such an input equals its instrument.
        direct = np.array([a == b for a, b in zip(u, z, strict=True)])
        room = np.where(direct, 1.0, 1.0 - c * own)[:, None, :]
        aside = np.where(direct, 0.0, np.abs(np.swapaxes(crossed, 1, 2)) * c[:, None, :]) / room
        reach = aside + np.sqrt(c[:, None, :] * left[:, :, None] / room + aside**2)
        # A weak instrument may look strong at one frequency by chance, and its response is then
        # wrong too. The octave around it must be strong as well.
        share = explained / np.maximum(explained + own, 1e-300)
        around = np.stack([octave_mean(omega, v) for v in share.T], axis=1)
        # c S_vv again, with the octave's share of the input that the instruments explain.
        likely = 0.5 * Z95**2 * spread
        strong = direct | (likely * explained * (1.0 - around) < _STRONG * around)
        return np.where((room > 0) & strong[:, None, :], reach / half95, np.nan)


# Variances from few averages.
#
# With n averages and m inputs, a variance has n - m degrees of freedom. Weights from such variances
# favour frequencies that look quiet by chance: with windows of half a record, only 72 % of the 95 %
# intervals of a delay contained the true value. The noise is therefore a mean over frequencies.
#
# Source: Pintelon and Schoukens (2012), section 9.4.


_ENOUGH = 40.0
"""Degrees of freedom at which weights from an estimated variance are as good as from the true one.
"""
RESOLVED = 1.95
"""Least distance of independent frequencies [1/window length] (Hann)."""
_TRIANGLE = 1.5
"""Effective number of terms in a triangle-weighted mean [half-widths]."""


def independent_shares(omega: Float[np.ndarray, " k"], seconds: float) -> Float[np.ndarray, " k"]:
    """Return the share of an independent frequency that each frequency (k,) has.

    Args:
        omega: frequencies (k,) [rad/s], rising.
    """
    # Half the distance to each neighbour.
    width = np.gradient(omega) if omega.size > 1 else np.ones(1)
    return np.minimum(width * seconds / (2.0 * np.pi * RESOLVED), 1.0)


def averaged(
    noise: Float[np.ndarray, " k"], shares: Float[np.ndarray, " k"], averages: float
) -> tuple[Float[np.ndarray, " k"], float]:
    """Return the mean over enough independent frequencies, and its degrees of freedom.

    Args:
        noise: density (k,); NaN where unknown.
        shares: share (k,) of an independent frequency that each has.
    """
    known = np.isfinite(noise) & (shares > 0)
    each = 2.0 * averages
    # Half-width of the triangle [independent frequencies].
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
    """Return the half-width of a 95 % interval [sd], from Student's t.

    Args:
        freedom: degrees of freedom of the standard deviations, at least 1; any shape.
    """
    return scipy.special.stdtrit(np.maximum(freedom, 1.0), 0.975)


# Errors that windows add to a response at the ends of a record. For y = h * u, Taylor's series of
# the window w(t + tau) gives Y_w = H U_w + i H' U_w' + ... . U_w' is the input with the window's
# derivative, H' the derivative of H by frequency. In windows that overlap by two thirds the second
# terms cancel, with two exceptions. One is the ends of a record and of each part between missing
# samples. The other is input power that a window's width brings from another frequency (the flanks
# of a sine, frequencies beyond a sweep). Only H' is unknown. Let e be the part of U_w' that counts
# as the input. To first order, a measured response is that at omega + i e. H' is the slope of a
# straight line through responses at such points. For a single sine the points coincide and H' is
# unknown: it may be anything that windows of that length resolve. Source: Pintelon and Schoukens
# (2012), chapter 6.


_LINES = 2.5
"""Half-width around a frequency for the response's derivative [lines of the window]. Its error is
then a small part of the response's own.
"""
_LEAST = 3
"""Least number of frequencies to either side for the derivative."""
_ROUNDS = 3
"""Iterations, since the correction of one input's response depends on the others'."""
_UNKNOWN = 0.2
"""Share of the correction that remains in the response's error."""
_RESOLVES = 1.0
"""Relative change of a response in one line of the window beyond which it is not resolved. It
bounds the derivative where responses do not determine it.
"""
_ALONE = 2e-2
"""Variance of the points of a straight line below which they give no slope [half-width squared]."""


def without_ends(
    omega: Float[np.ndarray, " k"],
    H: Complex[np.ndarray, "k l m"],
    sd: Float[np.ndarray, "k l m"],
    ends: Complex[np.ndarray, "k m m"],
    seconds: float,
) -> tuple[Complex[np.ndarray, "k l m"], Float[np.ndarray, "k l m"]]:
    """Return the errors from windows at the ends of records and on the flanks of held inputs, to
    first order, and the responses' sd.

    Args:
        omega: frequencies [rad/s], rising.
        H: l outputs over m inputs; NaN where unknown.
        ends: part of each input, with the window's derivative, that counts as each input [1/s].
    """
    known = np.isfinite(H) & np.isfinite(sd) & (sd > 0)
    # An input without a response needs no correction.
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
    # The correction has errors, and so has its derivative.
    chance = _summed(np.abs(ends) ** 2, np.stack([line.variance for line in lines], axis=2))
    return added, np.sqrt(sd**2 + chance + (_UNKNOWN * np.abs(added)) ** 2)


def _summed(
    ends: Float[np.ndarray, "k m m"] | Complex[np.ndarray, "k m m"], v: np.ndarray
) -> np.ndarray:
    """Return the contributions (k, l, m) of the inputs' derivatives v (k, l, m) to each input's
    response.
    """
    return v @ np.swapaxes(ends, 1, 2)


class _Line(NamedTuple):
    """Straight lines through l responses to an input around each frequency."""

    near: Complex[np.ndarray, "both k k"]
    """Weights of the points around each frequency, and these times the conjugate distances."""
    flat: Float[np.ndarray, "k l"]
    """Weights from the responses' errors."""
    mean: Complex[np.ndarray, "k l"]
    """Conjugate distance to the centre of the points, times the sum of weights."""
    total: Float[np.ndarray, "k l"]
    """Sum of weights."""
    part: Float[np.ndarray, "k l"]
    """Fraction of the line's slope that is used, over the determinant of the weights; zero if there
    is none.
    """
    variance: Float[np.ndarray, "k l"]
    """Variance of the slope's real and of its imaginary part."""

    def slope(self, H: Complex[np.ndarray, "k l"]) -> Complex[np.ndarray, "k l"]:
        """Return the slope at each frequency [s]; unknown responses must be zero."""
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
        at: points (k,) at which the responses were measured.
        measured: the responses, zero where unknown, and the sd of their real and imaginary parts,
            NaN there.
    """
    H, variance = measured[0], measured[1] ** 2
    known = np.isfinite(variance)
    far = np.sort(np.abs(omega[None, :] - omega[:, None]), axis=1)
    least = far[:, min(2 * _LEAST, omega.size - 1)]
    reach = np.maximum(_LINES * 2.0 * np.pi / seconds, 1.01 * least)[:, None]
    d = (at[None, :] - omega[:, None]) / reach
    width = np.gradient(omega) if omega.size > 1 else np.ones(1)
    near = np.maximum(1.0 - np.abs(d) ** 2, 0.0) * width
    # Number of independent frequencies within reach.
    independent = np.maximum(reach * seconds / (np.pi * RESOLVED), 1.0)
    with np.errstate(all="ignore"), warnings.catch_warnings():
        # A pair may be unknown at all frequencies.
        warnings.simplefilter("ignore", RuntimeWarning)
        # Weighted by the errors too, but limited so that no single frequency dominates.
        flat = np.where(known, 1.0 / (variance + np.nanmedian(variance, axis=0)), 0.0)
        both = np.stack([near, near * np.conj(d)])
        (S0, S1), S2 = both @ flat, (near * np.abs(d) ** 2) @ flat
        S0 = np.real(S0)
        spread = S0 * S2 - np.abs(S1) ** 2
        enough = known & (spread > _ALONE * S0**2)
        chance = variance / (spread / S0**2 * reach**2 * independent)
        alone = _Line(both, flat, S1, S0, np.where(enough, 1.0 / (spread * reach), 0.0), chance)
        before = 0.5 * (_RESOLVES * seconds / (2.0 * np.pi)) ** 2 * np.abs(H) ** 2
        # Mean of the line's slope and the bound from the windows' resolution, weighted by their
        # errors.
        part = np.where(enough, before / (before + chance), 0.0)
        left = np.where(enough, part * chance, np.where(known, before, 0.0))
    return alone._replace(part=part * alone.part, variance=left)
