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

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy.linalg
import scipy.special
from jaxtyping import Complex, Float

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
        e: measured less simulated.
        J: its derivatives by the unknowns.
        drives: what may drive what the model lacks.
        holes: the samples before which others are missing.
    """
    n = e.size - ORDER
    if (n - 1) // 2 < max(_LEAST, 2 * J.shape[1]) or not np.std(e) > 0:
        return None
    h = whitening(e - e.mean(), holes)
    columns = np.concatenate([e[:, None], J, drives], axis=1)
    scales = np.sqrt(np.mean(columns**2, axis=0))
    columns = columns - columns.mean(axis=0)
    # Differences with the filter's own order left out have no samples from before the record.
    white = np.stack([np.convolve(c, h)[ORDER : e.size] for c in columns.T], axis=1)
    # What jumps because samples are missing is no answer: the filter's order after a hole is as if
    # nothing had been measured.
    white[across(holes, e.size)[ORDER:]] = 0.0
    v = np.fft.rfft(white, axis=0)[1 : 1 + (n - 1) // 2] / np.sqrt(n)
    # Of a bias rounding alone is left, which no step of it makes up for.
    v = np.where(np.sqrt(np.mean(np.abs(v) ** 2, axis=0)) > _ROUNDING * scales, v, 0.0)
    # Of one size in all records: their noise differs.
    size = float(np.sqrt(np.mean(np.abs(v[:, 0]) ** 2)))
    v = v / size
    q = J.shape[1]
    angles = 2.0 * np.pi * np.arange(1, len(v) + 1) / n
    return Lines(v[:, 0], v[:, 1 : 1 + q], v[:, 1 + q :], angles, size)


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
    """The residual of one output, of which `strongest` asks.

    Args:
        records: those of the output.
    """
    e, J, angles = (
        np.concatenate(each)
        for each in zip(*[(r.e, r.J, r.angles) for r in _lowest(records)], strict=True)
    )
    rows, v = _real(J), _real(e[:, None])
    known = _span(rows)
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
        records: those of one output.
        drives: columns of `Lines.drives` that are asked for.
        bank: damping of the filters and the logarithm between their frequencies.
        beside: columns whose answer through the same filter is taken off first.
        plain: whether the drives are tried without any filter as well.
        least: gain up to which nothing but the gain is asked, as where another answer has as much.
        residual: that of these records, where it is at hand.
    """
    of, records = residual or residual_of(records), _lowest(records)
    white, freedom = of.white, of.freedom
    X = np.concatenate([record.drives for record in records])
    filters = _filters(records, bank, plain)
    back = np.exp(-1j * of.angles)
    asked, answers = _asked(
        *_responses(filters, back),
        _complex(of.known),
        _complex(white),
        np.concatenate([*_ends(records, back), *(_pair(X[:, i], back) for i in beside)], axis=1),
        [_pair(X[:, i], back) for i in drives],
    )
    gains = _gains(asked, answers)
    k = int(np.argmax(gains))
    gain = float(gains.reshape(-1)[k] * freedom / np.sum(white**2))
    drive, one = drives[k % len(drives)], filters[k // len(drives)]
    if not gain > max(_AT_LEAST, least):
        nothing = np.zeros(of.J.shape[1])
        return Strongest(gain, 1.0, drive, *one, nothing, nothing, 0.0)
    # The same phases for the same residual, whoever asks. In single precision, half the work: what
    # chance makes is known to a tenth of itself.
    turns = np.random.default_rng(0).random((len(X), _SURROGATES))
    turns, basis = (2.0 * np.pi * turns).astype(np.float32), of.known.astype(np.float32)

    def of_chance(turns: np.ndarray) -> np.ndarray:
        phases = np.cos(turns) + 1j * np.sin(turns)
        anew = _without(basis, _real(_complex(white).astype(phases.dtype) * phases))
        anew *= np.sqrt(freedom / np.sum(anew**2, axis=0))
        # Column by column: there are many residuals.
        tried = _complex(anew)
        answers = [_products(asked.filters, c, tried) for c in (asked.beside, *asked.drives)]
        return _gains(asked, answers).max(axis=(0, 1))

    others = of_chance(turns[:, :_FIRST])
    if _by_chance(gain, others) < _CLEARLY:
        others = np.concatenate([others, of_chance(turns[:, _FIRST:])])
    chance = _by_chance(gain, others)
    G = _complex(asked.filters[k // len(drives), :, None])
    columns = _real(G * np.concatenate([asked.beside, asked.drives[k % len(drives)]], axis=1))
    return Strongest(gain, chance, drive, *one, *_steps(of.J, columns, of.e[:, None]))


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
        k: how many of the unknowns, the first, are parameters.
    """
    e, J = (np.concatenate([record[i] for record in _lowest(records)]) for i in range(2))
    nuisances = _span(_real(J[:, k:])) if J.shape[1] > k else np.zeros((2 * e.size, 0))
    whole = _real(J[:, :k])
    own = _without(nuisances, whole)
    shows = np.linalg.norm(own, axis=0) > _SAME * np.linalg.norm(whole, axis=0)
    if not shows.any():
        return 1.0
    basis, white = _span(own[:, shows]), _without(nuisances, _real(e[:, None]))
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
    """The step of the unknowns to where the whitened residual is least.

    Args:
        records: of all outputs.
    """
    e = _real(np.concatenate([record.e for record in records])[:, None])
    J = _real(np.concatenate([record.J for record in records]))
    return _steps(J, np.zeros((len(J), 2)), e)[1]


class _Asked(NamedTuple):
    """Products, by filter, that do not depend on the residual; columns stand before the filter."""

    filters: Float[np.ndarray, "F K2"]
    """real and imaginary parts side by side"""
    beside: Complex[np.ndarray, "K b"]
    over: Float[np.ndarray, "F b b"]
    """the inverse of their products, without what is known"""
    drives: list[Complex[np.ndarray, "K 2"]]
    cross: list[Float[np.ndarray, "F b 2"]]
    """products of the columns beside with each drive, without what is known"""
    own: list[Float[np.ndarray, "F 2 2"]]
    """the inverse of each drive's products, without what is known and the columns beside"""


def _asked(
    G: Float[np.ndarray, "F K2"],
    power: Float[np.ndarray, "F K"],
    known: Complex[np.ndarray, "K q"],
    residual: Complex[np.ndarray, "K 1"],
    beside: Complex[np.ndarray, "K b"],
    drives: list[Complex[np.ndarray, "K 2"]],
) -> tuple[_Asked, list[Float[np.ndarray, "F c 1"]]]:
    """Precompute the products that do not depend on the residual, and those with this residual.

    By products of columns, since the filters all act on the same ones: a basis for each filter and
    drive would take ten times as long. All in one product each, which reads the filters once.

    Args:
        G: responses of the filters by line, real and imaginary parts side by side.
        power: their squared sizes.
        known: an orthonormal basis of the sensitivities; residuals have nothing of it.
        residual: whose products come second, of the columns beside first, then of each drive.
        beside: columns whose answer through the same filter is taken off first.
        drives: each with itself one sample later.
    """
    b, groups = beside.shape[1], [beside, *drives]
    ends = np.cumsum([c.shape[1] for c in groups])[:-1]
    with_known = _products(
        G, np.concatenate(groups, axis=1), np.concatenate([known, residual], axis=1)
    )
    of_known = np.split(with_known[:, :, :-1], ends, axis=1)
    # Products of two columns that are filtered both.
    pairs = [(beside, beside), *((np.concatenate([beside, d], axis=1), d) for d in drives)]
    each = [np.real(_pairs(u, v)) for u, v in pairs]
    parts = np.split(power @ np.concatenate(each).T, np.cumsum([len(u) for u in each])[:-1], axis=1)
    whole, *of_drives = (
        part.reshape(len(G), -1, v.shape[1]) for part, (_, v) in zip(parts, pairs, strict=True)
    )
    over = _inverse(whole - of_known[0] @ _turned(of_known[0]), whole)
    cross, own = [], []
    for of_drive, products in zip(of_known[1:], of_drives, strict=True):
        cross.append(products[:, :b] - of_known[0] @ _turned(of_drive))
        whole = products[:, b:]
        left = whole - of_drive @ _turned(of_drive) - _turned(cross[-1]) @ over @ cross[-1]
        own.append(_inverse(left, whole))
    answers = np.split(with_known[:, :, -1:], ends, axis=1)
    return _Asked(G, beside, over, drives, cross, own), answers


def _products(
    G: Float[np.ndarray, "F K2"], a: Complex[np.ndarray, "K a"], b: Complex[np.ndarray, "K b"]
) -> Float[np.ndarray, "F a b"]:
    """Real parts of the products of filtered columns a with columns b, in the precision of b."""
    G, each = G.astype(np.real(b).dtype, copy=False), _pairs(a.astype(b.dtype, copy=False), b)
    each = np.concatenate([np.real(each), np.imag(each)], axis=1)
    return (G @ each.T).reshape(len(G), a.shape[1], b.shape[1])


def _pairs(
    a: Complex[np.ndarray, "K a"], b: Complex[np.ndarray, "K b"]
) -> Complex[np.ndarray, "ab K"]:
    """The product at each line of each column of a, conjugate, with each of b."""
    # Lines last: NumPy is quick along its last axis alone.
    a, b = np.ascontiguousarray(a.T), np.ascontiguousarray(b.T)
    return (np.conj(a)[:, None] * b).reshape(-1, a.shape[1])


def _gains(
    asked: _Asked, answers: Sequence[Float[np.ndarray, "F c r"]]
) -> Float[np.ndarray, "F d r"]:
    """Gains: the part of each residual's squares that a drive through a filter explains.

    Args:
        asked: the products of the columns.
        answers: those with the residuals, of the columns beside first, then of each drive.
    """
    right, out = asked.over @ answers[0], []
    for b, cross, own in zip(answers[1:], asked.cross, asked.own, strict=True):
        b = b - _turned(cross) @ right
        out.append(np.sum(b * (own @ b), axis=1))
    return np.stack(out, axis=1)


def _turned(M: np.ndarray) -> np.ndarray:
    return np.swapaxes(M, 1, 2)


def _inverse(left: np.ndarray, whole: np.ndarray) -> np.ndarray:
    """Of what is left (F, n, n) of the columns' products, without directions of which next to
    nothing is; whole: of the columns themselves."""
    sizes = np.sqrt(np.maximum(np.einsum("fii->fi", whole), 1e-300))
    values, V = np.linalg.eigh(left / (sizes[:, :, None] * sizes[:, None, :]))
    kept = values > _SAME**2
    over = np.where(kept, 1.0 / np.where(kept, values, 1.0), 0.0)
    V = V / sizes[:, :, None]
    return V @ (over[:, :, None] * _turned(V))


def _pair(x: np.ndarray, back: np.ndarray) -> Complex[np.ndarray, "K 2"]:
    return np.stack([x, x * back], axis=1)


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
) -> tuple[Float[np.ndarray, "F K2"], Float[np.ndarray, "F K"]]:
    """Frequency responses of the filters at the lines, real and imaginary parts side by side, and
    their squared sizes.

    Args:
        filters: dampings and frequencies [rad a sample].
        back: of a delay by one sample.
    """
    w, damping = (np.array([one[i] for one in filters]) for i in (1, 0))
    plain = ~np.isfinite(damping)
    damping = np.where(plain, 1.0, damping)
    size = np.where(plain, 0.0, np.exp(-damping * w))
    twice = 2.0 * size * np.cos(w * np.sqrt(np.maximum(1.0 - damping**2, 0.0)))
    over = np.stack([np.ones(len(w)), -twice, size**2], axis=1)
    powers = np.stack([np.ones_like(back), back, back**2])
    # By real numbers: NumPy divides complex ones slowly.
    real, imaginary = over @ np.real(powers), over @ np.imag(powers)
    power = 1.0 / (real**2 + imaginary**2)
    return np.concatenate([real * power, -imaginary * power], axis=1), power


def _ends(records: Sequence[Lines], back: np.ndarray) -> list[Complex[np.ndarray, "K 2"]]:
    """By record what the filter's states at its ends are driven by."""
    columns, first = [], 0
    for record in records:
        here = np.zeros(back.size)
        here[first : first + record.e.size] = 1.0
        columns.append(_pair(here, back))
        first += record.e.size
    return columns


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


def _span(columns: np.ndarray) -> np.ndarray:
    """An orthonormal basis of the columns."""
    sizes = np.linalg.norm(columns, axis=0)
    # Of its triangle, whose singular values are the same.
    Q, R = np.linalg.qr(columns[:, sizes > 0] / sizes[sizes > 0])
    U, values, _ = np.linalg.svd(R)
    return Q @ U[:, : values.size][:, values > _SAME]
