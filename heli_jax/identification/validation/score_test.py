r"""Does a residual follow a drive through some filter, beyond what the estimates could take up?

A mode that a model lacks leaves a residual that is a drive through a resonance, in a few lines of
the record's spectrum: shares of the whole residual's power do not show it. So residual and
sensitivities are whitened, and the residual is regressed on sensitivities and on the drive through
each filter of a bank of second order: a score test for a model with such a mode. The states of a
filter at the ends of the record are regressors too.

The covariance of the score is that of random phases at the residual's own power, line by line, so
that no shape of the noise is assumed. The p value of the largest statistic along a bank is Davies'
bound by the variation of its root.

Sources: Ljung (1999), 16.6, for residuals against inputs; Rao (1948) for score tests; White (1980)
for their covariance; Davies (1987) for the largest of many.
"""

import itertools
from collections.abc import Iterator, Sequence
from typing import Literal, NamedTuple

import numpy as np
import scipy.fft
import scipy.linalg
import scipy.special
from jaxtyping import Complex, Float

from heli_jax.identification.estimation.evaluation import directions

ORDER = 10
"""of the autoregression that whitens"""
NARROW = ((0.03, 0.05), (0.1, 0.15), (0.3, 0.4), (1.0, 0.8))
"""damping of the bank's filters, and the logarithm of the frequency from one to the next"""
BROAD = NARROW[2:]
_LINES = 16_000
"""of all records together at most, the lowest of each"""
_LEAST = 20
"""lines of a record below which it is not tested"""
_SAME = 1e-4
"""part of a column beyond which it says something that those before it do not"""
_ROUNDING = 1e-9
"""part of a column below which nothing is left of it"""


class Lines(NamedTuple):
    """One record's whitened signals at its own frequencies."""

    e: Complex[np.ndarray, " K"]
    J: Complex[np.ndarray, "K q"]
    """sensitivities of e"""
    drives: Complex[np.ndarray, "K d"]
    angles: Float[np.ndarray, " K"]
    """of the lines [rad a sample]"""
    size: float
    """of the residual, whitened and before it was scaled to one"""


class Drive(NamedTuple):
    """Known signals that a residual may follow."""

    columns: tuple[int, ...]
    """of `Lines.drives`"""
    kind: Literal["input", "amplitude", "flights", "time"]
    """an input through a mode or a lag; nonlinear functions of the motion; a parameter that differs
    between flights, or changes over the record"""
    of: tuple[str, ...] = ()
    """the input, or the flights"""
    bank: tuple[tuple[float, float], ...] = ()
    """damping of the filters that it is tried through, and the logarithm between their frequencies;
    it is tried without any as well unless it is an input"""
    beside: tuple[int, ...] = ()
    """columns that are regressors through the same filter"""
    unknown: int | None = None
    """that changes"""


class Strongest(NamedTuple):
    """The drive and filter that a residual follows most surely."""

    drive: Drive
    statistic: float
    """score statistic; twice what the log-likelihood gains if the residual is white"""
    p_value: float
    """of the largest statistic of all drives and filters"""
    damping: float
    """of the filter; infinite of none"""
    frequency: float
    """of the filter [rad a sample]"""
    shift: Float[np.ndarray, " q"]
    """by which the unknowns move where the filter is in the model"""
    step: Float[np.ndarray, " q"]
    """of the unknowns to where the whitened residual is least without it"""
    amount: float
    """of the drive that the residual asks for, counted as a step of an unknown is"""


def lines_of(
    e: Float[np.ndarray, " N"],
    J: Float[np.ndarray, "N q"],
    drives: Float[np.ndarray, "N d"],
    holes: Sequence[int] = (),
) -> Lines | None:
    """Whiten signals by the residual's autoregression; None if the record is too short, or if the
    residual is zero.

    Args:
        holes: the samples before which others are missing.
    """
    n = e.size - ORDER
    if (n - 1) // 2 < max(_LEAST, 2 * J.shape[1]) or not np.std(e) > 0:
        return None
    h = whitening(e - e.mean(), holes)
    # A signal a row: NumPy is quick along its last axis alone.
    rows = np.concatenate([e[None], J.T, drives.T])
    scales = np.sqrt(np.mean(rows**2, axis=1, keepdims=True))
    rows -= rows.mean(axis=1, keepdims=True)
    # Differences with the filter's own order left out have no samples from before the record.
    white = np.stack([np.convolve(c, h, "valid") for c in rows])
    # Samples within the filter's order after a hole are left out: signals jump there.
    white[:, across(holes, e.size)[ORDER:]] = 0.0
    v = np.asarray(scipy.fft.rfft(white))[:, 1 : 1 + (n - 1) // 2] / np.sqrt(n)
    # Only rounding is left of a bias.
    mean_squares = np.mean(np.real(v) ** 2 + np.imag(v) ** 2, axis=1, keepdims=True)
    v[(np.sqrt(mean_squares) <= _ROUNDING * scales)[:, 0]] = 0.0
    # Scaled: the noise of records differs.
    size = float(np.sqrt(mean_squares[0, 0]))
    v /= size
    q = J.shape[1]
    angles = 2.0 * np.pi * np.arange(1, v.shape[1] + 1) / n
    return Lines(v[0], v[1 : 1 + q].T, v[1 + q :].T, angles, size)


def across(holes: Sequence[int], size: int) -> np.ndarray:
    """True (size,) for the samples within the order of `whitening` after a hole."""
    after = np.zeros(size, bool)
    for first in holes:
        after[first : first + ORDER] = True
    return after


def whitening(e: np.ndarray, holes: Sequence[int] = ()) -> np.ndarray:
    """Return the filter (ORDER + 1,) of an autoregression, by Yule and Walker.

    Args:
        e: the signal (N,), of mean zero.
        holes: the samples before which others are missing.
    """
    # With zeros between no sample is compared with one beyond a hole.
    e = np.insert(e, np.repeat(np.asarray(holes, int), ORDER), 0.0)
    c = np.array([float(e[: e.size - k] @ e[k:]) for k in range(ORDER + 1)]) / e.size
    # A little white noise, so that a residual without any has a filter too.
    c[0] *= 1.0 + 1e-9
    return np.concatenate([[1.0], -scipy.linalg.solve_toeplitz(c[:-1], c[1:])])


def strongest(records: Sequence[Lines], drives: Sequence[Drive]) -> Strongest:
    """Return the drive that the residual of one output follows most surely."""
    records = _lowest(records)
    e, J, X, angles = (
        np.concatenate(each)
        for each in zip(*[(r.e, r.J, r.drives, r.angles) for r in records], strict=True)
    )
    rows, residual = _real(J), _real(e[:, None])
    known = directions(rows, _SAME)
    white = _without(known, residual)[:, 0]
    white *= np.sqrt(white.size / max(white.size - known.shape[1], 1))
    # What the record's ends make of a filter's states has a column for each record.
    ends = np.repeat(np.eye(len(records)), [r.e.size for r in records], axis=1).T.astype(complex)
    # From two periods in the longest record on.
    low = 2.0 * min(float(record.angles[0]) for record in records)
    high = 0.9 * max(float(record.angles[-1]) for record in records)
    back = np.exp(-1j * angles)
    best, paths = (np.inf, 0.0), 0
    chosen: tuple[Drive, float, float, np.ndarray] | None = None
    for (bank, beside, plain), group in itertools.groupby(
        drives, lambda d: (d.bank, d.beside, d.kind != "input")
    ):
        those = tuple(group)
        base = np.concatenate([ends, X[:, beside]], axis=1)
        for damping, frequencies in _paths(bank, plain, low, high):
            through = [_response(damping, w, back) for w in frequencies]
            tested = [_statistics(h, base, X, those, back, known, white) for h in through]
            for k, drive in enumerate(those):
                values, ranks = zip(*(at[k] for at in tested), strict=True)
                at = int(np.argmax(values))
                chance = _davies(np.array(values), max(ranks))
                paths += 1
                if (chance, -values[at]) < best:
                    best = (chance, -values[at])
                    columns = np.concatenate([base, X[:, drive.columns]], axis=1)
                    chosen = drive, damping, frequencies[at], through[at][:, None] * columns
    assert chosen is not None
    drive, damping, frequency, columns = chosen
    columns = np.stack([columns, columns * back[:, None]], axis=2).reshape(len(back), -1)
    steps = _steps(rows, _real(columns), residual)
    # Bonferroni.
    p_value = min(1.0, paths * best[0])
    return Strongest(drive, -best[1], p_value, damping, frequency, *steps)


def _paths(
    bank: Sequence[tuple[float, float]], plain: bool, low: float, high: float
) -> Iterator[tuple[float, list[float]]]:
    """Filters of one damping, by frequency [rad a sample]; infinite damping is no filter."""
    if plain:
        yield np.inf, [0.0]
    for damping, step in bank:
        frequencies, w = [], low
        while w < high:
            frequencies.append(w)
            # No finer than lines lie.
            w *= np.exp(max(step, 0.25 * low / w))
        if frequencies:
            yield damping, frequencies


def _statistics(
    response: Complex[np.ndarray, " K"],
    base: Complex[np.ndarray, "K b"],
    X: Complex[np.ndarray, "K d"],
    drives: Sequence[Drive],
    back: Complex[np.ndarray, " K"],
    known: Float[np.ndarray, "K2 q"],
    white: Float[np.ndarray, " K2"],
) -> list[tuple[float, int]]:
    """Return by drive the score statistic of a residual through one filter, and its degrees of
    freedom.

    Args:
        base: regressors through the same filter.
        known: orthonormal; the residual has nothing of it.
        back: the response of a delay of one sample.
    """
    own = [c for drive in drives for c in drive.columns]
    columns = response[:, None] * np.concatenate([base, X[:, own]], axis=1)
    columns = np.stack([columns, columns * back[:, None]], axis=2).reshape(len(back), -1)
    b, whole = 2 * base.shape[1], _real(columns)
    left = _without(known, whole)
    shows = np.linalg.norm(left[:, :b], axis=0) > _SAME * np.linalg.norm(whole[:, :b], axis=0)
    beside = directions(left[:, :b][:, shows], _SAME)
    left = _without(beside, left[:, b:])
    sizes = np.maximum(np.linalg.norm(whole[:, b:], axis=0), 1e-300)
    left /= sizes
    e, out, first = white - beside @ (beside.T @ white), [], 0
    for drive in drives:
        those = slice(first, first + 2 * len(drive.columns))
        first = those.stop
        out.append(_score_statistic(left[:, those], e))
    return out


def _score_statistic(
    columns: Float[np.ndarray, "K2 c"], e: Float[np.ndarray, " K2"]
) -> tuple[float, int]:
    """Return the score statistic of a residual along columns, and its degrees of freedom.

    Args:
        columns: without the regressors, over their sizes before these were taken off.
    """
    values, V = np.linalg.eigh(columns.T @ columns)
    # Directions in which next to nothing is left say nothing.
    kept = values > _SAME**2
    if not kept.any():
        return 0.0, 1
    basis = columns @ (V[:, kept] / np.sqrt(values[kept]))
    lines, power = _complex(basis), np.abs(_complex(e[:, None])) ** 2
    # Of random phases at the residual's own power.
    covariance = 0.5 * np.real((np.conj(lines) * power).T @ lines)
    score = basis.T @ e
    return float(score @ np.linalg.pinv(covariance, 1e-9, hermitian=True) @ score), score.size


def _davies(values: Float[np.ndarray, " f"], freedom: int) -> float:
    """Return a bound of the probability that chance makes the largest of chi-squared statistics
    along a path of filters."""
    M, s = float(np.max(values)), freedom
    variation = float(np.sum(np.abs(np.diff(np.sqrt(np.maximum(values, 0.0))))))
    density = 0.5 * (s - 1) * np.log(max(M, 1e-300)) - 0.5 * M - 0.5 * s * np.log(2.0)
    density -= scipy.special.gammaln(0.5 * s)
    return float(scipy.special.chdtrc(s, M) + variation * np.exp(density))


def _response(
    damping: float, w: float, back: Complex[np.ndarray, " K"]
) -> Complex[np.ndarray, " K"]:
    """Return the response of a filter at each line; 1 of one of infinite damping.

    Args:
        back: the response of a delay of one sample.
    """
    if not np.isfinite(damping):
        return np.ones_like(back)
    size = np.exp(-damping * w)
    twice = 2.0 * size * np.cos(w * np.sqrt(max(1.0 - damping**2, 0.0)))
    return 1.0 / (1.0 - twice * back + size**2 * back**2)


def _lowest(records: Sequence[Lines]) -> list[Lines]:
    """Return the records without their highest lines, where there are too many."""
    most = _LINES // len(records)
    return [
        Lines(r.e[:most], r.J[:most], r.drives[:most], r.angles[:most], r.size) for r in records
    ]


def pulled_away(records: Sequence[Lines], k: int) -> float:
    """Return the p value of the test that the residual of one output does not follow the
    sensitivities of the first k unknowns, beside those of the others."""
    e, J = (np.concatenate([record[i] for record in _lowest(records)]) for i in range(2))
    nuisances = directions(_real(J[:, k:]), _SAME) if J.shape[1] > k else np.zeros((2 * e.size, 0))
    own, white = _real(J[:, :k]), _without(nuisances, _real(e[:, None]))[:, 0]
    white *= np.sqrt(white.size / max(white.size - nuisances.shape[1], 1))
    columns = _without(nuisances, own) / np.maximum(np.linalg.norm(own, axis=0), 1e-300)
    statistic, freedom = _score_statistic(columns, white)
    return float(scipy.special.chdtrc(freedom, statistic))


def step_to_least(records: Sequence[Lines]) -> Float[np.ndarray, " q"]:
    """Return the step of the unknowns to the least whitened residual."""
    e = _real(np.concatenate([record.e for record in records])[:, None])
    J = _real(np.concatenate([record.J for record in records]))
    return _steps(J, np.zeros((len(J), 2)), e)[1]


def _steps(
    J: Float[np.ndarray, "K2 q"], more: Float[np.ndarray, "K2 c"], e: Float[np.ndarray, "K2 1"]
) -> tuple[Float[np.ndarray, " q"], Float[np.ndarray, " q"], float]:
    """Return the change of the step of the unknowns by further columns, the step without these, and
    the sum of the steps along the last two columns: a drive and the drive one sample later."""
    columns = np.concatenate([J, more], axis=1)
    sizes = np.linalg.norm(columns, axis=0)
    columns = columns / np.where(sizes > 0, sizes, 1.0)
    q = J.shape[1]
    # e falls by J times the step.
    alone = -np.linalg.lstsq(columns[:, :q], e[:, 0], rcond=1e-6)[0]
    beside = -np.linalg.lstsq(columns, e[:, 0], rcond=1e-6)[0]
    over = np.where(sizes > 0, sizes, np.inf)
    amount = float(np.sum(beside[-2:] / over[-2:]))
    return (beside[:q] - alone) / over[:q], alone / over[:q], amount


def _real(v: Complex[np.ndarray, "K c"]) -> Float[np.ndarray, "K2 c"]:
    return np.concatenate([np.real(v), np.imag(v)])


def _complex(v: Float[np.ndarray, "K2 c"]) -> Complex[np.ndarray, "K c"]:
    return v[: len(v) // 2] + 1j * v[len(v) // 2 :]


def _without(basis: np.ndarray, v: np.ndarray) -> np.ndarray:
    # Twice: the first time leaves rounding of columns that nearly lie in the basis.
    for _ in range(2):
        v = v - basis @ (basis.T @ v)
    return v
