r"""Does a residual follow a drive through some filter, beyond what the estimates could take up?

A mode that a model lacks leaves a residual that is a drive through a resonance, in a few lines of
the record's spectrum: shares of the whole residual's power do not show it. So residual and
sensitivities are whitened, and the residual is regressed on sensitivities and on the drive through
each filter of a bank of second order: the gain of the likelihood in that direction is the score
test for a model with such a mode. What the record's ends make of the filter's states takes part.

The largest gain of the bank is compared with those of the same residual with phases drawn anew at
each line. That keeps its spectrum, lines and humps of a disturbance too, and destroys nothing but
what goes together with the drives, so that no shape of the noise has to be assumed.

Sources: Ljung (1999), 16.6, for residuals against inputs; Rao (1948) for score tests; Theiler and
others (1992) for surrogates; Gumbel (1958) for the distribution of maxima.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

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
_SURROGATES = 99
_FIRST = 24
"""of them that are asked first"""
_CLEARLY = 0.1
"""chance by these above which no more are asked: it is no news, however well it is known"""
_LINES = 16_000
"""of all records together at most, the lowest of each"""
_LEAST = 20
"""lines of a record below which nothing is asked of it"""
_SAME = 1e-4
"""part of a column beyond which it says something that those before it do not"""
_AT_LEAST = 14.0
"""gain below which no p value is asked for: by one filter alone chance makes it in 1 of 1000"""
_ROUNDING = 1e-9
"""part of a column below which nothing is left of it"""
_AT_ONCE = 16
"""filters that products are made of together"""
_EULER = 0.5772156649015329


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


class Strongest(NamedTuple):
    """The filter and drive that a residual follows most."""

    statistic: float
    """gain of twice the log-likelihood, by two numbers"""
    p_value: float
    """that chance makes as much, by the best of all drives and filters"""
    drive: int
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
    """Whitened by the residual's autoregression; None of records too short or without a residual.

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
    # What jumps because samples are missing is no answer: the filter's order after a hole is as if
    # nothing had been measured.
    white[:, across(holes, e.size)[ORDER:]] = 0.0
    v = np.asarray(scipy.fft.rfft(white))[:, 1 : 1 + (n - 1) // 2] / np.sqrt(n)
    # Of a bias rounding alone is left, which no step of it makes up for.
    mean_squares = np.mean(np.real(v) ** 2 + np.imag(v) ** 2, axis=1, keepdims=True)
    v[(np.sqrt(mean_squares) <= _ROUNDING * scales)[:, 0]] = 0.0
    # Of one size in all records: their noise differs.
    size = float(np.sqrt(mean_squares[0, 0]))
    v /= size
    q = J.shape[1]
    angles = 2.0 * np.pi * np.arange(1, v.shape[1] + 1) / n
    return Lines(v[0], v[1 : 1 + q].T, v[1 + q :].T, angles, size)


def across(holes: Sequence[int], size: int) -> np.ndarray:
    """Of (size,) samples those that the filter of `whitening` makes of samples before a hole."""
    after = np.zeros(size, bool)
    for first in holes:
        after[first : first + ORDER] = True
    return after


def whitening(e: np.ndarray, holes: Sequence[int] = ()) -> np.ndarray:
    """The filter (ORDER + 1,) of an autoregression, by Yule and Walker.

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


class Residual(NamedTuple):
    """The residual of all records together, real parts above imaginary ones."""

    e: Float[np.ndarray, " K2"]
    J: Float[np.ndarray, "K2 q"]
    known: Float[np.ndarray, "K2 r"]
    """orthonormal columns that span those of J"""
    white: Float[np.ndarray, "K2 1"]
    """what these leave of e"""
    angles: Float[np.ndarray, " K"]

    @property
    def freedom(self) -> int:
        """How many numbers the unknowns leave."""
        return self.e.size - self.known.shape[1]


def residual_of(records: Sequence[Lines]) -> Residual:
    """The residual of one output, of which `strongest` asks."""
    e, J, angles = (
        np.concatenate(each)
        for each in zip(*[(r.e, r.J, r.angles) for r in _lowest(records)], strict=True)
    )
    rows, v = _real(J), _real(e[:, None])
    known = directions(rows, _SAME)
    return Residual(v[:, 0], rows, known, _without(known, v), angles)


def strongest(
    records: Sequence[Lines],
    drives: Sequence[int],
    bank: Sequence[tuple[float, float]],
    *,
    beside: Sequence[int] = (),
    plain: bool = False,
    least: float = 0.0,
    residual: Residual | None = None,
) -> Strongest:
    """The strongest answer of the residual to a drive through a filter of a bank.

    Args:
        drives: columns of `Lines.drives` that are asked for.
        bank: damping of the filters and the logarithm between their frequencies.
        beside: columns whose answer through the same filter is taken off first.
        plain: whether the drives are tried without any filter as well.
        least: gain up to which nothing but the gain is asked, as where another answer has as much.
        residual: that of these records, where it is at hand.
    """
    of, records = residual or residual_of(records), _lowest(records)
    freedom, squares = of.freedom, np.sum(of.white**2)
    X = np.concatenate([record.drives for record in records]).T
    filters = _filters(records, bank, plain)
    columns = _Columns(np.concatenate([_ends(records), X[[*beside]]]), X[[*drives]], of.angles)
    asked, answers = _asked(filters, columns, _complex(of.known).T, _complex(of.white).T)
    gains = _gains(asked, answers)
    k = int(np.argmax(gains))
    gain = float(gains.reshape(-1)[k] * freedom / squares)
    drive, one = drives[k % len(drives)], filters[k // len(drives)]
    if not gain > max(_AT_LEAST, least):
        nothing = np.zeros(of.J.shape[1])
        return Strongest(gain, 1.0, drive, *one, nothing, nothing, 0.0)
    # The same phases for the same residual, whoever asks. In single precision, half the work: what
    # chance makes is known to a tenth of itself.
    turns = np.random.default_rng(0).random((len(of.angles), _SURROGATES))
    turns, basis = (2.0 * np.pi * turns).astype(np.float32), of.known.astype(np.float32)

    def of_chance(turns: np.ndarray) -> np.ndarray:
        phases = np.cos(turns) + 1j * np.sin(turns)
        anew = _without(basis, _real(_complex(of.white).astype(phases.dtype) * phases))
        anew *= np.sqrt(freedom / np.sum(anew**2, axis=0))
        return _gains(asked, _answers(filters, columns, _complex(anew).T)).max(axis=(0, 1))

    others = of_chance(turns[:, :_FIRST])
    if _by_chance(gain, others) < _CLEARLY:
        others = np.concatenate([others, of_chance(turns[:, _FIRST:])])
    chance = _by_chance(gain, others)
    ((G, _),) = _responses([one], columns.back)
    found = np.concatenate([columns.beside, columns.drives[[k % len(drives)]]])
    found = np.stack([found, found * columns.back], axis=1).reshape(-1, len(of.angles))
    through = _real(_complex(G.T) * found.T)
    return Strongest(gain, chance, drive, *one, *_steps(of.J, through, of.e[:, None]))


def _lowest(records: Sequence[Lines]) -> list[Lines]:
    """The records without the lines that are too many, of each the highest."""
    most = _LINES // len(records)
    return [
        Lines(r.e[:most], r.J[:most], r.drives[:most], r.angles[:most], r.size) for r in records
    ]


def pulled_away(records: Sequence[Lines], k: int) -> float:
    """The probability that chance makes the residual follow the sensitivities of the parameters as
    it does. At estimates that the answer to the inputs bears out it does so by chance alone.

    Args:
        records: those of one output; of their drives nothing is asked.
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
        """The mean over phases drawn anew of the residual's squares in the columns' span."""
        return 0.5 * float(power @ np.sum(np.abs(_complex(columns)) ** 2, axis=1))

    left = whole - by_phases(nuisances)
    gain, by_chance = float(np.sum((basis.T @ white) ** 2)), by_phases(basis)
    if not (by_chance > 0 and left > 0):
        return 1.0
    # With other phases a part of the residual is the nuisances', which a fit takes up.
    by_chance *= whole / left
    rank = basis.shape[1]
    return float(scipy.special.chdtrc(rank, rank * gain / by_chance))


def step_to_least(records: Sequence[Lines]) -> Float[np.ndarray, " q"]:
    """The step of the unknowns to where the whitened residual is least."""
    e = _real(np.concatenate([record.e for record in records])[:, None])
    J = _real(np.concatenate([record.J for record in records]))
    return _steps(J, np.zeros((len(J), 2)), e)[1]


class _Columns(NamedTuple):
    """Columns that go through the filters, each by itself and one sample later."""

    beside: Complex[np.ndarray, "b K"]
    """those whose answer through the same filter is taken off first"""
    drives: Complex[np.ndarray, "d K"]
    angles: Float[np.ndarray, " K"]

    @property
    def back(self) -> Complex[np.ndarray, " K"]:
        """The response of a delay by one sample."""
        return np.exp(-1j * self.angles)


class _Asked(NamedTuple):
    """Products, by filter, that do not depend on the residual."""

    over: Float[np.ndarray, "F b2 b2"]
    """the inverse of those of the columns beside, without what is known"""
    cross: Float[np.ndarray, "F d b2 2"]
    """of the columns beside with each drive, without what is known"""
    own: Float[np.ndarray, "F d 2 2"]
    """the inverse of each drive's, without what is known and the columns beside"""


def _asked(
    filters: Sequence[tuple[float, float]],
    columns: _Columns,
    known: Complex[np.ndarray, "q K"],
    residual: Complex[np.ndarray, "1 K"],
) -> tuple[_Asked, Float[np.ndarray, "F c 2 1"]]:
    """Precompute the products that do not depend on the residual, and those with this residual.

    By products of columns, since the filters all act on the same ones: a basis for each filter and
    drive would take ten times as long.

    Args:
        filters: dampings and frequencies [rad a sample].
        known: an orthonormal basis of the sensitivities; residuals have nothing of it.
        residual: whose products come second, of the columns beside first, then of each drive.
    """
    taken = np.concatenate([known, residual])
    (b, K), d = columns.beside.shape, len(columns.drives)
    x, back, F = np.concatenate([columns.beside, columns.drives]), columns.back, len(filters)
    once, each, size = _once(x, taken, back), np.conj(x[:b, None]) * x, np.abs(x[b:]) ** 2
    # With itself, with the other one sample later, and with itself so: of two that are both later
    # the product is that of the two.
    rows = (np.real(v).reshape(-1, K) for v in (each, each * back, each * np.conj(back)))
    twice = np.concatenate([*rows, size, size * np.real(back)])
    products = [(G @ once.T, power @ twice.T) for G, power in _responses(filters, back)]
    of_taken, both = (np.concatenate(parts) for parts in zip(*products, strict=True))
    of_taken = of_taken.reshape(F, b + d, 2, -1)
    shifted = both[:, : 3 * b * (b + d)].reshape(F, 3, b, b + d)[:, [[0, 1], [2, 0]]]
    shifted = shifted.transpose(0, 3, 1, 4, 2).reshape(F, 2 * b, b + d, 2)
    own = both[:, 3 * b * (b + d) :].reshape(F, 2, d)[:, [[0, 1], [1, 0]]].transpose(0, 3, 1, 2)
    whole = shifted[:, :, :b].reshape(F, 2 * b, 2 * b)
    by_beside = of_taken[:, :b, :, :-1].reshape(F, 2 * b, -1)
    by_drive = of_taken[:, b:, :, :-1]
    over = _inverse(whole - by_beside @ _turned(by_beside), whole)
    cross = shifted[:, :, b:].transpose(0, 2, 1, 3) - by_beside[:, None] @ _turned(by_drive)
    left = own - by_drive @ _turned(by_drive) - _turned(cross) @ over[:, None] @ cross
    return _Asked(over, cross, _inverse(left, own)), of_taken[..., -1:]


def _once(
    x: Complex[np.ndarray, "c K"],
    taken: Complex[np.ndarray, "t K"],
    back: Complex[np.ndarray, " K"],
) -> Float[np.ndarray, "n K2"]:
    """The products of columns, and of each one sample later, with what is taken of them."""
    both = np.conj(np.stack([x, x * back], axis=1))
    rows = (both[:, :, None] * taken).reshape(-1, len(back))
    return np.concatenate([np.real(rows), np.imag(rows)], axis=1)


def _answers(
    filters: Sequence[tuple[float, float]], columns: _Columns, taken: Complex[np.ndarray, "t K"]
) -> Float[np.ndarray, "F c 2 t"]:
    """As those of `_asked`, of other residuals in their precision."""
    x, back = (
        v.astype(taken.dtype)
        for v in (np.concatenate([columns.beside, columns.drives]), columns.back)
    )
    G = np.concatenate(
        [v.astype(np.real(taken).dtype) for v, _ in _responses(filters, columns.back)]
    )
    # Column by column: there are many residuals.
    each = [(G @ _once(v[None], taken, back).T).reshape(len(G), 2, len(taken)) for v in x]
    return np.stack(each, axis=1)


def _gains(asked: _Asked, answers: Float[np.ndarray, "F c 2 r"]) -> Float[np.ndarray, "F d r"]:
    """Gains: the part of each residual's squares that a drive through a filter explains.

    Args:
        answers: those with the residuals, of the columns beside first, then of each drive.
    """
    b = answers.shape[1] - asked.cross.shape[1]
    right = asked.over @ answers[:, :b].reshape(len(answers), 2 * b, -1)
    left = answers[:, b:] - _turned(asked.cross) @ right[:, None]
    return np.sum(left * (asked.own @ left), axis=2)


def _turned(M: np.ndarray) -> np.ndarray:
    return np.swapaxes(M, -1, -2)


def _inverse(left: np.ndarray, whole: np.ndarray) -> np.ndarray:
    """Inverse of what is left (..., n, n) of the columns' products, without directions in which
    next to nothing is left; whole: products of the columns themselves."""
    sizes = np.sqrt(np.maximum(np.einsum("...ii->...i", whole), 1e-300))
    values, V = np.linalg.eigh(left / (sizes[..., :, None] * sizes[..., None, :]))
    kept = values > _SAME**2
    over = np.where(kept, 1.0 / np.where(kept, values, 1.0), 0.0)
    V = V / sizes[..., :, None]
    return V @ (over[..., :, None] * _turned(V))


def _by_chance(gain: float, others: Float[np.ndarray, " r"]) -> float:
    """That a gain is one of the others, which are maxima of about exponential numbers."""
    scale = float(np.std(others)) * np.sqrt(6.0) / np.pi
    if not scale > 0:
        return 1.0
    middle = float(np.mean(others)) - _EULER * scale
    return float(-np.expm1(-np.exp(-(gain - middle) / scale)))


def _filters(
    records: Sequence[Lines], bank: Sequence[tuple[float, float]], plain: bool
) -> list[tuple[float, float]]:
    """Dampings and frequencies [rad a sample], from two swings over the longest record on."""
    low = 2.0 * min(float(record.angles[0]) for record in records)
    high = 0.9 * max(float(record.angles[-1]) for record in records)
    tried = [(np.inf, 0.0)] if plain else []
    for damping, step in bank:
        w = low
        while w < high:
            tried.append((damping, w))
            # No finer than lines lie.
            w *= np.exp(max(step, 0.25 * low / w))
    return tried


def _responses(
    filters: Sequence[tuple[float, float]], back: Complex[np.ndarray, " K"]
) -> Iterator[tuple[Float[np.ndarray, "F K2"], Float[np.ndarray, "F K"]]]:
    """Frequency responses of the filters at the lines, real and imaginary parts side by side, and
    their squared sizes; of a few filters at a time: fresh memory takes longer than the sums.

    Args:
        filters: dampings and frequencies [rad a sample].
    """
    w, damping = (np.array([one[i] for one in filters]) for i in (1, 0))
    plain = ~np.isfinite(damping)
    damping = np.where(plain, 1.0, damping)
    size = np.where(plain, 0.0, np.exp(-damping * w))
    twice = 2.0 * size * np.cos(w * np.sqrt(np.maximum(1.0 - damping**2, 0.0)))
    over = np.stack([np.ones(len(w)), -twice, size**2], axis=1)
    powers, K = np.stack([np.ones_like(back), back, back**2]), back.size
    powers = np.concatenate([np.real(powers), np.imag(powers)], axis=1)
    for k in range(0, len(w), _AT_ONCE):
        # By real numbers: NumPy divides complex ones slowly.
        G = over[k : k + _AT_ONCE] @ powers
        power = 1.0 / (G[:, :K] ** 2 + G[:, K:] ** 2)
        G[:, :K] *= power
        G[:, K:] *= -power
        yield G, power


def _ends(records: Sequence[Lines]) -> Complex[np.ndarray, "r K"]:
    """By record what the filter's states at its ends are driven by."""
    sizes = [record.e.size for record in records]
    return np.repeat(np.eye(len(sizes)), sizes, axis=1).astype(complex)


def _steps(
    J: Float[np.ndarray, "K2 q"], more: Float[np.ndarray, "K2 c"], e: Float[np.ndarray, "K2 1"]
) -> tuple[Float[np.ndarray, " q"], Float[np.ndarray, " q"], float]:
    """The step of the unknowns beside further columns less that without, that without, and the sum
    of the steps along the last two columns: a drive and the drive one sample later."""
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
