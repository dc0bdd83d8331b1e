r"""Score test of a residual against drives through a bank of filters.

A missing mode leaves a residual that is a drive through a resonance. It shows in a few lines of the
spectrum, and hardly in the residual's total power. So residual and sensitivities are whitened, and
the residual is regressed on the sensitivities and on the drive through each second-order filter of
a bank. The gain in likelihood is the score test for a model with that mode. The regression includes
the filter's initial and final states.

The largest gain is compared with those of surrogates: the same residual with random phases at each
line. Surrogates keep the spectrum and lose only the correlation with the drives, so that the test
assumes no shape of the noise.

Sources: Ljung (1999), 16.6, for residuals against inputs; Rao (1948) for score tests; Theiler and
others (1992) for surrogates; Gumbel (1958) for the distribution of maxima.
"""

import itertools
from collections.abc import Iterator, Sequence
from typing import Literal, NamedTuple

import numpy as np
import scipy.fft
import scipy.linalg
import scipy.special
from jaxtyping import Complex, Float, Inexact, Int

from heli_jax.identification.estimation.evaluation import directions
from heli_jax.numerics.white_noise import robust_sd

ORDER = 10
"""Order of the autoregression that whitens."""
NARROW = ((0.03, 0.05), (0.1, 0.15), (0.3, 0.4), (1.0, 0.8))
"""Damping of the bank's filters, and step of the logarithm of their frequency."""
BROAD = NARROW[2:]
_SURROGATES = 99
_FEW, _OFTEN = 19, 2
"""First surrogates, and how many of them must reach a gain that is then one of chance."""
_LINES = 16_000
"""Largest number of lines of all records together; the lowest of each are taken."""
_LEAST = 20
"""Fewest lines of a record that is tested."""
_SAME = 1e-4
"""Least share of a column that is independent of the columns before it."""
_AT_LEAST = 14.0
"""Least gain for which a p-value is computed; one filter exceeds it by chance in 1 of 1000."""
_ROUNDING = 1e-9
"""Share of a column below which the rest is rounding."""
_EULER = 0.5772156649015329
_BAND = 0.01
"""Width of a band of lines over its frequency; that of the narrowest filter is 0.06."""
_AT_ONCE = 8
"""Number of residuals that are multiplied with all columns together."""


class Lines(NamedTuple):
    """One record's whitened signals at its own frequencies."""

    e: Complex[np.ndarray, " K"]
    J: Complex[np.ndarray, "K q"]
    """Sensitivities of e."""
    drives: Complex[np.ndarray, "K d"]
    angles: Float[np.ndarray, " K"]
    """Frequencies of the lines [rad/sample]."""
    size: float
    """Rms of the whitened residual before it was scaled to one."""


class Drive(NamedTuple):
    """Known signal that a residual may follow."""

    column: int
    """Column in `Lines.drives`."""
    kind: Literal["input", "amplitude", "flights", "time"]
    """An input through a mode or a lag; a nonlinear function of the motion; a parameter that
    differs between flights, or changes over the record."""
    of: tuple[str, ...] = ()
    """The input, or the flights."""
    bank: tuple[tuple[float, float], ...] = ()
    """Damping of the filters, and step of the logarithm of their frequency.

    Drives other than inputs are also tested without a filter."""
    removed_first: tuple[int, ...] = ()
    """Columns whose response through the same filter is removed first."""
    unknown: int | None = None
    """The unknown that changes."""


class Strongest(NamedTuple):
    """The drive and filter that a residual follows most."""

    drive: Drive
    statistic: float
    """Gain of twice the log-likelihood, by two coefficients."""
    p_value: float
    """Probability of this gain by chance, for the best of all drives and filters."""
    damping: float
    """Damping of the filter; infinite without a filter."""
    frequency: float
    """Frequency of the filter [rad/sample]."""
    shift: Float[np.ndarray, " q"]
    """Change of the unknowns if the model includes the filter."""
    step: Float[np.ndarray, " q"]
    """Step of the unknowns to the smallest whitened residual without the filter."""
    amount: float
    """Estimated coefficient of the drive, in the units of a step of an unknown."""


def lines_of(
    e: Float[np.ndarray, " N"],
    J: Float[np.ndarray, "N q"],
    drives: Float[np.ndarray, "N d"],
    holes: Sequence[int] = (),
    most: float = np.inf,
) -> Lines | None:
    """Return the spectra of a record's signals, whitened by the residual's autoregression.

    None if the record is too short or has no residual.

    Args:
        holes: the samples before which others are missing.
        most: bound of the whitened residual [robust sds] (Huber, 1981).
    """
    n = e.size - ORDER
    if (n - 1) // 2 < max(_LEAST, 2 * J.shape[1]) or not np.std(e) > 0:
        return None
    h = whitening(e - e.mean(), holes)
    # One signal per row: NumPy is fast only along the last axis.
    rows = np.concatenate([e[None], J.T, drives.T])
    scales = np.sqrt(np.mean(rows**2, axis=1, keepdims=True))
    rows -= rows.mean(axis=1, keepdims=True)
    # "valid" omits the first samples, for which the filter would need some before the record.
    white = np.stack([np.convolve(c, h, "valid") for c in rows])
    # A jump across missing samples is no response: drop all samples that the filter mixes.
    white[:, across(holes, e.size)[ORDER:]] = 0.0
    if np.isfinite(most):
        most *= robust_sd(white[0][white[0] != 0.0])
        white[0] = np.clip(white[0], -most, most)
    v = np.asarray(scipy.fft.rfft(white))[:, 1 : 1 + (n - 1) // 2] / np.sqrt(n)
    # A bias leaves only rounding here. Set it to zero, so that nothing is regressed on it.
    mean_squares = np.mean(np.real(v) ** 2 + np.imag(v) ** 2, axis=1, keepdims=True)
    v[(np.sqrt(mean_squares) <= _ROUNDING * scales)[:, 0]] = 0.0
    # Scale each record to the same size, since noise differs between records.
    size = float(np.sqrt(mean_squares[0, 0]))
    v /= size
    q = J.shape[1]
    angles = 2.0 * np.pi * np.arange(1, v.shape[1] + 1) / n
    return Lines(v[0], v[1 : 1 + q].T, v[1 + q :].T, angles, size)


def across(holes: Sequence[int], size: int) -> np.ndarray:
    """Return True (size,) for samples at which the `whitening` filter reaches across a hole."""
    after = np.zeros(size, bool)
    for first in holes:
        after[first : first + ORDER] = True
    return after


def whitening(e: np.ndarray, holes: Sequence[int] = ()) -> np.ndarray:
    """Return the whitening filter (ORDER + 1,) by the Yule-Walker equations.

    Args:
        e: the signal (N,), of mean zero.
        holes: the samples before which others are missing.
    """
    # Zeros in a hole keep products of samples across it out of the sums.
    e = np.insert(e, np.repeat(np.asarray(holes, int), ORDER), 0.0)
    c = np.array([float(e[: e.size - k] @ e[k:]) for k in range(ORDER + 1)]) / e.size
    # A little white noise keeps the equations regular if the residual has none.
    c[0] *= 1.0 + 1e-9
    return np.concatenate([[1.0], -scipy.linalg.solve_toeplitz(c[:-1], c[1:])])


def strongest(records: Sequence[Lines], drives: Sequence[Drive]) -> Strongest:
    """Return the drive and filter that one output's residual follows most, with its p-value."""
    records = _lowest(records)
    e, J, X, angles = (
        np.concatenate(each)
        for each in zip(*[(r.e, r.J, r.drives, r.angles) for r in records], strict=True)
    )
    # One column per record for a filter's states at the record's ends.
    ends = np.repeat(np.eye(len(records)), [r.e.size for r in records], axis=0)
    order = np.argsort(angles, kind="stable")
    e, J, X, angles, ends = (v[order] for v in (e, J, X, angles, ends))
    rows, residual = _real(J), _real(e[:, None])
    known = directions(rows, _SAME)
    white = _without(known, residual)
    freedom, squares = white.size - known.shape[1], float(np.sum(white**2))
    trials, known_lines = list(_trials(drives, ends.T, X.T, angles)), _complex(known).T
    gains = [each.gains(known_lines, _complex(white).T)[:, :, 0] for each in trials]
    best = int(np.argmax([np.max(of) for of in gains]))
    one, of = trials[best], gains[best]
    of_filter, at = np.unravel_index(int(np.argmax(of)), of.shape)
    drive, gain = one.drives[at], float(of[of_filter, at] * freedom / squares)
    damping, frequency = one.filters[of_filter].tolist()
    if not gain > _AT_LEAST:
        nothing = np.zeros(J.shape[1])
        return Strongest(drive, gain, 1.0, damping, frequency, nothing, nothing, 0.0)
    # A fixed seed gives the same phases each time.
    turns = 2.0 * np.pi * np.random.default_rng(0).random((e.size, _SURROGATES))

    def largest_gains(turns: Float[np.ndarray, "K r"]) -> Float[np.ndarray, " r"]:
        """Return the largest gain of each surrogate."""
        # Single precision halves the work; the distribution is known to about 10 % anyway.
        turns = turns.astype(np.float32)
        anew = _real(_complex(white).astype(np.complex64) * (np.cos(turns) + 1j * np.sin(turns)))
        anew = _without(known.astype(np.float32), anew)
        anew *= np.sqrt(freedom / np.sum(anew**2, axis=0))
        of_chance = [t.gains(known_lines, _complex(anew).T).max(axis=(0, 1)) for t in trials]
        return np.max(of_chance, axis=0)

    # Most residuals follow nothing, which a few surrogates show (Besag and Clifford, 1991).
    chance = largest_gains(turns[:, :_FEW])
    if np.count_nonzero(chance >= gain) < _OFTEN:
        chance = np.concatenate([chance, largest_gains(turns[:, _FEW:])])
    own = one.removed_first + 2 * at
    through = one.columns[[*range(one.removed_first), own, own + 1]]
    response = _responses(one.filters[[of_filter]], angles)
    steps = _steps(rows, _real((response * through).T), residual)
    p_value = _by_chance(gain, chance)
    return Strongest(drive, gain, p_value, damping, frequency, *steps)


class _Bands(NamedTuple):
    """Narrow bands of sorted lines, in each of which a filter's response is constant."""

    starts: Int[np.ndarray, " B"]
    """First line of each band."""
    angles: Float[np.ndarray, " B"]
    """Mean frequency of each band [rad/sample]."""

    def sums(self, v: Inexact[np.ndarray, "*n K"]) -> Inexact[np.ndarray, "*n B"]:
        """Return the sums over the lines of each band."""
        return np.add.reduceat(v, self.starts, axis=-1)


def _bands(angles: Float[np.ndarray, " K"]) -> _Bands:
    number = np.floor(np.log(angles) / _BAND)
    starts = np.flatnonzero(np.diff(number, prepend=np.nan))
    counts = np.diff(starts, append=angles.size)
    return _Bands(starts, np.add.reduceat(angles, starts) / counts)


class _Trial(NamedTuple):
    """Filters, and the drives that are tested through them after removing the same columns."""

    filters: Float[np.ndarray, "f 2"]
    """Damping and frequency [rad/sample]; infinite damping is no filter."""
    drives: tuple[Drive, ...]
    columns: Complex[np.ndarray, "c2 K"]
    """Columns that are removed first, then the drives; each also one sample later."""
    bands: _Bands

    @property
    def removed_first(self) -> int:
        """Number of columns before those of the drives."""
        return len(self.columns) - 2 * len(self.drives)

    def gains(
        self, known: Complex[np.ndarray, "q K"], residuals: Complex[np.ndarray, "r K"]
    ) -> Float[np.ndarray, "f d r"]:
        """Return the power of each residual that each drive explains beyond the known columns.

        All filters share the products of unfiltered columns, so that no column is filtered.

        Args:
            known: orthonormal columns, to which the residuals are orthogonal.
        """
        response = _responses(self.filters, self.bands.angles)
        power = np.real(response) ** 2 + np.imag(response) ** 2
        d, b, columns = len(self.drives), self.removed_first, self.columns
        pairs = columns[:, None] * np.conj(columns[:b])
        whole = np.tensordot(power, self.bands.sums(np.real(pairs)), (1, 2))
        own = columns[b:].reshape(d, 2, -1)
        pairs = np.real(own[:, :, None] * np.conj(own[:, None]))
        own = np.tensordot(power, self.bands.sums(pairs), (1, 3))
        of_known, answers = (self._products(response, v) for v in (known, residuals))

        left = whole - of_known @ of_known[:, :b].mT
        taken = left[:, b:] @ _inverse(left[:, :b], whole[:, :b])
        answers = answers[:, b:] - taken @ answers[:, :b]
        answers, of_known, left, taken = (
            v.reshape(len(v), d, 2, -1) for v in (answers, of_known[:, b:], left[:, b:], taken)
        )
        over = _inverse(own - of_known @ of_known.mT - taken @ left.mT, own)
        return np.sum(answers * (over @ answers), axis=2)

    def _products(
        self, response: Complex[np.ndarray, "f B"], others: Complex[np.ndarray, "n K"]
    ) -> Float[np.ndarray, "f c2 n"]:
        """Return the products of the filtered columns with other signals."""
        columns = np.conj(self.columns.astype(others.dtype))
        response = _real(response.astype(others.dtype).T).T
        out = np.zeros((len(response), len(columns), len(others)), response.dtype)
        for k in range(0, len(others), _AT_ONCE):
            pairs = self.bands.sums(columns[:, None] * others[k : k + _AT_ONCE])
            pairs = np.concatenate([np.real(pairs), np.imag(pairs)], axis=-1)
            out[:, :, k : k + _AT_ONCE] = np.tensordot(response, pairs, (1, 2))
        return out


def _trials(
    drives: Sequence[Drive],
    ends: Float[np.ndarray, "r K"],
    X: Complex[np.ndarray, "d K"],
    angles: Float[np.ndarray, " K"],
) -> Iterator[_Trial]:
    """Yield the drives, grouped by their filters and by the columns that are removed first.

    The slowest filter has two periods in the longest record.
    """
    # Above, resampled outputs are low-passed and held inputs are not.
    low, high = 2.0 * float(angles[0]), 0.8 * float(angles[-1])
    back, bands = np.exp(-1j * angles), _bands(angles)
    for (bank, plain, removed_first), group in itertools.groupby(
        drives, lambda d: (d.bank, d.kind != "input", d.removed_first)
    ):
        those = tuple(group)
        columns = np.concatenate([ends, X[[*removed_first]], X[[d.column for d in those]]])
        columns = np.stack([columns, columns * back], axis=1).reshape(-1, len(back))
        filters = [(np.inf, 0.0)] if plain else []
        for damping, step in bank:
            w = low
            while w < high:
                filters.append((damping, w))
                # No finer than the lines.
                w *= np.exp(max(step, 0.25 * low / w))
        yield _Trial(np.array(filters), those, columns, bands)


def _responses(
    filters: Float[np.ndarray, "f 2"], angles: Float[np.ndarray, " K"]
) -> Complex[np.ndarray, "f K"]:
    """Return the response of each filter at each frequency [rad/sample]; 1 without a filter."""
    back = np.exp(-1j * angles)
    damping, w = filters.T
    none = ~np.isfinite(damping)
    damping = np.where(none, 1.0, damping)
    size = np.where(none, 0.0, np.exp(-damping * w))
    twice = 2.0 * size * np.cos(w * np.sqrt(np.maximum(1.0 - damping**2, 0.0)))
    return 1.0 / (1.0 - np.outer(twice, back) + np.outer(size**2, back**2))


def _lowest(records: Sequence[Lines]) -> list[Lines]:
    """Return the records without the highest lines beyond the limit on their number."""
    most = _LINES // len(records)
    return [
        Lines(r.e[:most], r.J[:most], r.drives[:most], r.angles[:most], r.size) for r in records
    ]


def pulled_away(records: Sequence[Lines], k: int) -> float:
    """Return the probability that the residual follows the parameters' sensitivities by chance.

    At estimates that agree with the response to the inputs it follows them only by chance.

    Args:
        records: those of one output; their drives are not used.
    """
    e, J = (np.concatenate([record[i] for record in _lowest(records)]) for i in range(2))
    nuisances = directions(_real(J[:, k:]), _SAME) if J.shape[1] > k else np.zeros((2 * e.size, 0))
    whole = _real(J[:, :k])
    own = _without(nuisances, whole)
    shows = np.linalg.norm(own, axis=0) > _SAME * np.linalg.norm(whole, axis=0)
    if not shows.any():
        return 1.0
    basis, white = directions(own[:, shows], _SAME), _without(nuisances, _real(e[:, None]))
    power, whole = np.abs(_complex(white)[:, 0]) ** 2, float(np.sum(white**2))

    def by_phases(columns: np.ndarray) -> float:
        """Return the mean power of residuals with random phases in the columns' span."""
        return 0.5 * float(power @ np.sum(np.abs(_complex(columns)) ** 2, axis=1))

    left = whole - by_phases(nuisances)
    gain, by_chance = float(np.sum((basis.T @ white) ** 2)), by_phases(basis)
    if not (by_chance > 0 and left > 0):
        return 1.0
    # A fit removes the part of a surrogate that the nuisances explain.
    by_chance *= whole / left
    rank = basis.shape[1]
    return float(scipy.special.chdtrc(rank, rank * gain / by_chance))


def step_to_least(records: Sequence[Lines]) -> Float[np.ndarray, " q"]:
    """Return the step of the unknowns to the smallest whitened residual."""
    e = _real(np.concatenate([record.e for record in records])[:, None])
    J = _real(np.concatenate([record.J for record in records]))
    return _steps(J, np.zeros((len(J), 2)), e)[1]


def _inverse(left: np.ndarray, whole: np.ndarray) -> np.ndarray:
    """Return the pseudoinverse of the remaining products (..., n, n) of columns.

    Directions in which almost nothing remains are left out.

    Args:
        left: products of the remaining parts of the columns.
        whole: products of the columns themselves.
    """
    sizes = np.sqrt(np.maximum(np.einsum("...ii->...i", whole), 1e-300))
    values, V = np.linalg.eigh(left / (sizes[..., :, None] * sizes[..., None, :]))
    kept = values > _SAME**2
    over = np.where(kept, 1.0 / np.where(kept, values, 1.0), 0.0)
    V = V / sizes[..., :, None]
    return V @ (over[..., :, None] * V.mT)


def _by_chance(gain: float, others: Float[np.ndarray, " r"]) -> float:
    """Return the probability of a gain this large, from a Gumbel fit to the surrogates' maxima."""
    scale = float(np.std(others)) * np.sqrt(6.0) / np.pi
    if not scale > 0:
        return 1.0
    middle = float(np.mean(others)) - _EULER * scale
    return float(-np.expm1(-np.exp(-(gain - middle) / scale)))


def _steps(
    J: Float[np.ndarray, "K2 q"], more: Float[np.ndarray, "K2 c"], e: Float[np.ndarray, "K2 1"]
) -> tuple[Float[np.ndarray, " q"], Float[np.ndarray, " q"], float]:
    """Return the effect of further columns on the unknowns' step, the step, and a drive's amount.

    The first is the step with the columns less that without; the second is the step without. The
    amount is the sum of the last two coefficients: a drive, and the drive one sample later.
    """
    columns = np.concatenate([J, more], axis=1)
    sizes = np.linalg.norm(columns, axis=0)
    columns = columns / np.where(sizes > 0, sizes, 1.0)
    q = J.shape[1]
    # e falls by J times the step.
    alone = -np.linalg.lstsq(columns[:, :q], e[:, 0], rcond=1e-6)[0]
    removed_first = -np.linalg.lstsq(columns, e[:, 0], rcond=1e-6)[0]
    over = np.where(sizes > 0, sizes, np.inf)
    amount = float(np.sum(removed_first[-2:] / over[-2:]))
    return (removed_first[:q] - alone) / over[:q], alone / over[:q], amount


def _real(v: Complex[np.ndarray, "K c"]) -> Float[np.ndarray, "K2 c"]:
    return np.concatenate([np.real(v), np.imag(v)])


def _complex(v: Float[np.ndarray, "K2 c"]) -> Complex[np.ndarray, "K c"]:
    return v[: len(v) // 2] + 1j * v[len(v) // 2 :]


def _without(basis: np.ndarray, v: np.ndarray) -> np.ndarray:
    # Project twice: one pass leaves rounding of columns that nearly lie in the basis.
    for _ in range(2):
        v = v - basis @ (basis.T @ v)
    return v
