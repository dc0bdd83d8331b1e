"""Frequency responses of records: several inputs at once, with coherence and random errors.

Segments of a record in Hann windows are transformed to the frequencies asked for (a chirp-z
transform: any band, any resolution), and their cross-spectra averaged over segments and flights.
Inputs that move together are told apart (conditioned responses), and with an instrument, an
excitation that was logged and that no feedback reaches, the responses are those of the machine
where pilot or autopilot close the loop.

Sources: Bendat and Piersol, Random Data (2010), chapters 7 and 9; Welch (1967); Rabiner, Schafer
and Rader (1969) for the chirp-z transform; Wellstead (1981) for responses by instrument; Tischler
and Remple (2012), chapters 7 to 10.

Responses by instrument are ratios of two numbers with errors of their own. With w_j the combination
of the instruments that goes with input j alone, H_j = S_wy over S_wu, and a response H' agrees with
the record where |S_we| of y - H' u is within its interval,

    |H' - H|^2 <= c (S_ee - 2 Re(conj(H' - H) S_ue) + |H' - H|^2 S_vv),  c = t^2 S_ww / (2 n),

t being Student's (1.96 of many averages) and v what of the input no instrument explains. That is a
disc. Where the excitation is weak beside v it is larger than the first-order error and lies to one
side, and where c S_vv reaches 1 it has no end: nothing is known of the response.

Source: Fieller (1954); Anderson and Rubin (1949) for instruments.

The report's spectra and coherences (`spectra`, `partial_coherence`) are Welch's.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float

from heli_jax.analysis.response_curves import octave_mean
from heli_jax.analysis.window_errors import Z95, student95

# numpy's FFT alone: scipy.signal has csd and welch, but one function of it imports all of it, which
# takes a second of every report, and the partial coherence needs the segments, not their averages.


_NO_POWER = 1e-20
"""of a signal's power: less is what rounding leaves where others explain all of it"""
OWN = 10.0
"""times what the window's sidelobes bring, from which on a spectrum is the signal's own"""


class Spectra(NamedTuple):
    """One-sided spectral densities of two signals, each (k,)."""

    omega: np.ndarray
    """[rad/s]"""
    uu: np.ndarray
    yy: np.ndarray
    uy: np.ndarray
    """complex: conj(U) Y, so that uy / uu estimates the response from u to y"""


def spectra(
    u: Float[np.ndarray, " N"], y: Float[np.ndarray, " N"], dt: float, length: int
) -> Spectra:
    """Averages over half-overlapping segments, each less its straight line, in a Hann window.

    Args:
        dt: time between samples [s].
        length: samples of a segment, at most N.

    Source: Welch (1967), IEEE Trans. Audio and Electroacoustics 15(2).
    """
    omega, transforms = segment_transforms(np.stack([u, y]), dt, length)
    U, Y = np.moveaxis(transforms, -1, 0)
    # A density over frequency in Hz; the window takes some of the power away.
    density = np.full(omega.size, 2.0 * dt / np.sum(np.hanning(length) ** 2))
    # Zero frequency and Nyquist's, which an odd length has not, have no twin of negative frequency.
    density[0] /= 2.0
    if length % 2 == 0:
        density[-1] /= 2.0
    uu, yy, uy = (np.mean(np.conj(a) * b, axis=1) for a, b in ((U, U), (Y, Y), (U, Y)))
    return Spectra(omega, density * uu.real, density * yy.real, density * uy)


def segment_transforms(
    signals: Float[np.ndarray, "channels N"], dt: float, length: int
) -> tuple[Float[np.ndarray, " k"], Complex[np.ndarray, "k segments channels"]]:
    """Fourier transforms of half-overlapping segments, each less its straight line, in a Hann
    window, at k = length // 2 + 1 frequencies [rad/s] from zero on.

    Args:
        signals: (channels, N), sampled together.
        dt: time between samples [s].
        length: samples of a segment, at most N.
    """
    # The next segment begins where the second half of this one does.
    step = length - length // 2
    segments = 1 + (signals.shape[1] - length) // step
    at = np.arange(segments)[:, None] * step + np.arange(length)
    # numpy's window is symmetric, SciPy's by default periodic; responses and coherences share it.
    windowed = _detrended(signals[:, at]) * np.hanning(length)
    omega = 2.0 * np.pi * np.fft.rfftfreq(length, dt)
    return omega, np.moveaxis(np.fft.rfft(windowed, axis=-1), -1, 0).swapaxes(1, 2)


def _detrended(segments: Float[np.ndarray, "... n"]) -> Float[np.ndarray, "... n"]:
    """Segments less the straight line that fits each best: a drift would leak into the lowest
    frequencies."""
    # Symmetric about zero, so that slope and mean are found apart from each other.
    t = np.linspace(-1.0, 1.0, segments.shape[-1])
    slopes = (segments @ t / (t @ t))[..., None]
    return segments - segments.mean(axis=-1, keepdims=True) - slopes * t


def partial_coherence(others: np.ndarray, u: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Coherence (k,) of u and y where what the other inputs explain of both is taken out.

    NaN where nothing is left of either. All are Fourier transforms of segments at k frequencies.

    Args:
        others: (k, segments, inputs); with no inputs the result is the ordinary coherence.
        u: (k, segments)
        y: (k, segments)

    Source: Bendat and Piersol, Random Data (2010), chapter 7.
    """
    # A coherence with the other inputs left in would count theirs as noise, and as u's own where
    # the pilot moves two sticks together.
    # A coherence has no size, and the squares of a simulation that diverged have none in numbers.
    u, y = u / size_of(u), y / size_of(y)
    left_u, left_y = without(others, u), without(others, y)
    uu, yy = np.sum(np.abs(left_u) ** 2, axis=1), np.sum(np.abs(left_y) ** 2, axis=1)
    uy = np.abs(np.sum(np.conj(left_u) * left_y, axis=1)) ** 2
    enough = uu > _NO_POWER * np.sum(np.abs(u) ** 2, axis=1)
    enough &= yy > _NO_POWER * np.sum(np.abs(y) ** 2, axis=1)
    return np.where(enough, uy / np.where(enough, uu * yy, 1.0), np.nan)


def size_of(x: np.ndarray) -> float:
    """The largest number, by which what hangs on no unit may be divided; 1 where there is none."""
    size = float(np.max(np.abs(x), initial=0.0))
    return size if size > 0 and np.isfinite(size) else 1.0


def without(others: np.ndarray, x: np.ndarray) -> np.ndarray:
    """x (k, segments) less its projection on the others (k, segments, inputs)."""
    if not others.shape[2]:
        return x
    # The pseudoinverse: two sticks that move as one have no unique gains, but a projection.
    gains = np.linalg.pinv(others) @ x[:, :, None]
    return x - (others @ gains)[:, :, 0]


def leakage(S: np.ndarray) -> np.ndarray:
    """What the Hann window's sidelobes bring to each frequency from all others, (k,).

    Args:
        S: spectral density (k,) of segments in a Hann window.

    Source: Harris (1978), Proceedings of the IEEE 66(1): the window's transform m lines away is at
    most 1/(pi m (m^2 - 1)) of its height.
    """
    m = np.arange(S.size, dtype=float)
    sidelobes = np.zeros(S.size)
    # Up to two lines away is the main lobe: there a signal is itself.
    far = m > 2
    # Its square, and of that the mean of a squared sine: where between two lines a frequency lies
    # is as good as random.
    sidelobes[far] = 0.5 / (np.pi * m[far] * (m[far] ** 2 - 1.0)) ** 2
    both = np.concatenate([sidelobes[:0:-1], sidelobes])
    return np.convolve(S, both)[S.size - 1 : 2 * S.size - 1]


_SINGULAR = 1e-9
"""smallest singular value of the inputs' matrix of coherences, below which they move as one"""
_FINE = 64
"""samples whose turns are sines, each times those of every so many"""
OVERLAP = 2.0 / 3.0
"""of a Hann window with the next, for responses. The squares of such windows add up to the same at
all times: no sample counts for more than another but at the ends of a record, and what they cut off
of answers that end outside of them, in proportion to the square's slope, cancels; of windows that
overlap by half it does not"""
_ROUNDING = 1e-14
"""of an output's density, what rounding leaves where the inputs explain all of it"""


class TooFewAveragesError(ValueError):
    """Of fewer averages than one more than the inputs no response is known."""


class CrossSpectra(NamedTuple):
    """Spectral densities of several signals with one another."""

    omega: np.ndarray
    """(k,) [rad/s]"""
    S: np.ndarray
    """(k, c, c) one-sided densities per Hz: S[:, a, b] is the mean of conj(X_a) X_b"""
    averages: float | np.ndarray
    """independent averages that each is made of, a number or (k,): overlapping segments count for
    less than one"""
    seconds: float
    """length of a segment"""
    slopes: np.ndarray | None = None
    """(k, c, m) those of the signals with the first m of them in the window's slope [1/s]"""


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
    averages: np.ndarray
    """(k,) independent ones"""
    ends: np.ndarray | None = None
    """(k, m, m) what of each input in the window's slope counts as each input [1/s]"""


def cross_spectra(
    records: Sequence[Float[np.ndarray, "c N"]],
    dt: float,
    omega: Float[np.ndarray, " k"],
    seconds: float,
    overlap: float = 0.5,
    sloped: int = 0,
) -> CrossSpectra:
    """Averages over Hann windows of all records, each segment less its mean.

    Args:
        records: the same c signals in each, (c, N) with any N; no sample missing.
        dt: between two samples [s].
        omega: (k,) [rad/s], above zero and below the Nyquist frequency.
        seconds: length of a segment; records that are shorter are left out.
        overlap: of one segment with the next, from 0 to below 1.
        sloped: how many of the first signals are taken in the window's slope, too.

    Raises:
        ValueError: no record has a segment, a sample is missing, or a frequency is out of range.
    """
    length = round(seconds / dt)
    step = max(round(length * (1.0 - overlap)), 1)
    _require(records, dt, omega, length)
    window = 0.5 - 0.5 * np.cos(2.0 * np.pi * np.arange(length) / length)
    counts = [max(1 + (r.shape[1] - length) // step, 0) for r in records]
    total, averages = np.zeros(1), 0.0
    for record, count in zip(records, counts, strict=True):
        if count:
            mean = _products(np.asarray(record, np.float64), window, dt, omega, step, sloped)
            total, averages = (
                total + count * mean,
                averages + _independent(window, step, count),
            )
    # One-sided: each frequency stands for its negative twin as well.
    density = 2.0 * dt / np.sum(window**2)
    S = density / sum(counts) * total
    c = records[0].shape[0]
    slopes = S[:, :, c:] if sloped else None
    return CrossSpectra(np.asarray(omega), S[:, :, :c], averages, length * dt, slopes)


def _require(records: Sequence[np.ndarray], dt: float, omega: np.ndarray, length: int) -> None:
    longest = max((r.shape[1] for r in records), default=0)
    if length < 8 or longest < length:
        raise ValueError(
            f"seconds: expected a segment of 8 samples at least and no longer than the longest "
            f"record, {longest * dt:.6g} s; got {length * dt:.6g} s"
        )
    if not all(np.isfinite(r).all() for r in records):
        raise ValueError("records: expected no missing sample; cut them where one is missing")
    if not (np.all(omega > 0) and np.all(omega < np.pi / dt)):
        raise ValueError(
            f"omega: expected frequencies between 0 and the Nyquist frequency, "
            f"{np.pi / dt:.6g} rad/s; got {np.min(omega):.6g} to {np.max(omega):.6g} rad/s"
        )


# In NumPy: there is a program to compile for each length of the windows, and it is called once.
def _products(
    record: Float[np.ndarray, "c N"],
    window: Float[np.ndarray, " n"],
    dt: float,
    omega: Float[np.ndarray, " k"],
    step: int,
    sloped: int,
) -> Complex[np.ndarray, "k c both"]:
    """Mean over the segments of conj(X_a) X_b, then of the first signals in the window's slope."""
    c, n = record.shape[0], window.shape[0]
    count = 1 + (record.shape[1] - n) // step
    # The bulk of the mean here, what is left of it in each segment below: it costs no pass there.
    record = record - record.mean(axis=1, keepdims=True)
    segments = np.lib.stride_tricks.sliding_window_view(record, n, axis=1)[:, ::step]
    even, odd, means = (part.reshape(c * count, -1) for part in _folded(segments))
    # Products of matrices: for the few hundred frequencies of a band faster than fast Fourier
    # transforms of twice the length, and they may lie anywhere.
    late = np.arange((n + 1) // 2, n)
    cosines, sines = _turns(late.size, omega * dt, (n + 1) // 2 - 0.5 * n)
    ones = _folded(np.ones(n))[0]
    w = window[late, None]
    C = w * cosines
    X = (even @ C - means * (ones @ C) - 1j * (odd @ (w * sines))).reshape(c, count, -1)
    both, rows = [X], sloped * count
    if sloped:
        # Of the window itself, a cosine, per second.
        v = (np.pi / (n * dt) * np.sin(2.0 * np.pi * late / n))[:, None]
        S = v * sines
        steep = odd[:rows] @ (v * cosines) - 1j * (even[:rows] @ S - means[:rows] * (ones @ S))
        both.append(steep.reshape(sloped, count, -1))
    Y = np.concatenate(both, axis=0)
    return np.conj(X).transpose(2, 0, 1) @ Y.transpose(2, 1, 0) / count


def _folded(
    segments: Float[np.ndarray, "... n"],
) -> tuple[
    Float[np.ndarray, "... half"], Float[np.ndarray, "... half"], Float[np.ndarray, "... 1"]
]:
    """Even and odd part of segments about their middle, twice each, and their means.

    A window is even about its middle and its slope odd, so that cosines go with one part and sines
    with the other: half of the products. Of the first sample neither makes anything.
    """
    n = segments.shape[-1]
    late, early = segments[..., (n + 1) // 2 :], segments[..., n // 2 : 0 : -1]
    even, odd = late + early, late - early
    if n % 2 == 0:
        # The middle itself, once.
        even[..., 0] *= 0.5
    return even, odd, ((even.sum(axis=-1) + segments[..., 0]) / n)[..., None]


def _turns(
    count: int, angle: Float[np.ndarray, " k"], first: float
) -> tuple[Float[np.ndarray, "m k"], Float[np.ndarray, "m k"]]:
    """Cosines and sines of m angle, m from the first on in steps of one, by products of few: so
    many would take as long as the transform."""
    coarse = np.outer(first + _FINE * np.arange(-(-count // _FINE)), angle)[:, None]
    fine = np.outer(np.arange(_FINE), angle)[None]
    (c, s), (C, S) = ((np.cos(v), np.sin(v)) for v in (fine, coarse))
    k = angle.shape[0]
    turns = C * c - S * s, S * c + C * s
    return turns[0].reshape(-1, k)[:count], turns[1].reshape(-1, k)[:count]


def _independent(window: np.ndarray, step: int, count: int) -> float:
    """Independent averages of overlapping segments (Welch 1967, for a flat spectrum)."""
    # Of white noise the transforms of two segments correlate as the windows overlap, and their
    # squares, which spectra are made of, as the square of that.
    n, power, total = window.size, float(np.sum(window**2)), 1.0
    for j in range(1, min(count, -(-n // step))):
        shared = float(np.sum(window[: n - j * step] * window[j * step :])) / power
        total += 2.0 * (1.0 - j / count) * shared**2
    return count / total


def responses(
    spectra: CrossSpectra,
    inputs: Sequence[int],
    outputs: Sequence[int],
    instruments: Sequence[int] | None = None,
) -> Responses:
    """Responses of each output to each input, the others taken into account.

    Where inputs move as one (or one does not move) no response is determined: it is NaN there, and
    where an instrument is too weak beside what else moves its input (`fieller`).

    Args:
        inputs: the m inputs, by their place among the signals.
        instruments: as many excitations, outside of every feedback; without them the inputs are
            taken for ones that do not follow the outputs.

    Raises:
        TooFewAveragesError: for so many inputs.
        ValueError: not as many instruments as inputs.
    """
    u, y = list(inputs), list(outputs)
    z = u if instruments is None else list(instruments)
    m, S, n = len(u), spectra.S, np.broadcast_to(spectra.averages, spectra.omega.shape)[:, None]
    if len(z) != m:
        raise ValueError(f"instruments: expected {m}, one for each input, got {len(z)}")
    if np.min(n) < m + 1:
        many = "1 input" if m == 1 else f"{m} inputs"
        raise TooFewAveragesError(
            f"expected at least {m + 1} independent averages for {many}, got "
            f"{np.min(n):.2f}: a longer record, or a shorter window"
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
    sd = np.sqrt(0.5 * error / (n - m)[:, :, None])
    if instruments is not None:
        half95 = student95(2.0 * (n - m))
        sd = sd_of_ratio(spectra.omega, S, (u, y, z), H, left, spread / (n - m), half95)
        H = np.where(np.isfinite(sd), H, np.nan)
    noise = left * n / (n - m)
    ends = None if spectra.slopes is None else P @ spectra.slopes[:, z][:, :, u]
    return Responses(spectra.omega, H, sd, coherence, multiple, noise, n[:, 0], ends)


def inverse(M: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Of matrices (k, m, m); NaN where one is singular but for rounding.

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


def weights_by_output(
    several: Sequence[CrossSpectra], inputs: Sequence[int], outputs: Sequence[int]
) -> Float[np.ndarray, "w k l"]:
    """What each length of segments counts for in one picture of several, output by output: long
    ones for low frequencies, short ones for high, each by the fourth power of its random error.

    Args:
        several: of the same signals and frequencies, of segments of different length.
        inputs: those whose responses decide, by their place among the signals.

    Raises:
        ValueError: the frequencies differ.

    Source: Tischler and Remple (2012), chapter 10, without its last search.
    """
    omega = several[0].omega
    if any(s.omega.shape != omega.shape or np.any(s.omega != omega) for s in several):
        raise ValueError("several: expected the same frequencies in all")
    estimates = [responses(s, inputs, outputs) for s in several]
    with np.errstate(all="ignore"):
        each = np.abs(np.stack([e.H / e.sd for e in estimates])) ** 2
    seen = np.isfinite(each)
    count = np.maximum(np.sum(seen, axis=3), 1)
    information = np.sum(np.where(seen, each, 0.0), axis=3) / count
    # Two periods within a segment are the least that a window resolves.
    seconds = np.array([s.seconds for s in several])[:, None, None]
    resolved = omega[:, None] >= 4.0 * np.pi / seconds * (1.0 - 1e-9)
    return np.where(resolved, information, 1e-12 / seconds) ** 2


def combined(several: Sequence[CrossSpectra], weights: Float[np.ndarray, "w k"]) -> CrossSpectra:
    """One picture of several lengths of segments, their mean. It is for looking: no intervals are
    to be taken from it, since the lengths share the record.
    """
    omega, total = several[0].omega, np.sum(weights, axis=0)
    # Inputs that move as one have no response that could decide.
    weights = np.where(total > 0, weights / np.where(total > 0, total, 1.0), 1.0 / len(several))
    S = np.einsum("wk,wkab->kab", weights, np.stack([s.S for s in several]))
    n = np.stack([np.broadcast_to(s.averages, omega.shape) for s in several])
    return CrossSpectra(omega, S, np.sum(weights * n, axis=0), max(s.seconds for s in several))


_STRONG = 0.25
"""of c S_vv in the mean over an octave, up to which an instrument is strong enough: F of 7.7"""


def sd_of_ratio(
    omega: Float[np.ndarray, " k"],
    S: Complex[np.ndarray, "k c c"],
    signals: tuple[list[int], list[int], list[int]],
    H: Complex[np.ndarray, "k l m"],
    left: Float[np.ndarray, "k l"],
    spread: Float[np.ndarray, "k m"],
    half95: Float[np.ndarray, "k 1"],
) -> Float[np.ndarray, "k l m"]:
    """Standard deviations of real and imaginary part whose 95 % intervals hold Fieller's discs;
    NaN where these have no end.

    Args:
        omega: frequencies [rad/s].
        signals: places of the inputs, of the outputs and of the instruments.
        left: density of what they leave.
        spread: density of w_j over the averages.
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
        return np.where((room > 0) & strong[:, None, :], reach / half95[:, None], np.nan)
