"""The band that each input excites, the outputs that follow it, the inputs that move together."""

import itertools
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
import scipy.special
from jaxtyping import Bool, Complex, Float

from heli_jax.analysis.spectra import partial_coherence, segment_transforms, without
from heli_jax.flights.flight import Flight
from heli_jax.flights.parts import spans


def moving_outputs(flight: Flight) -> tuple[Flight | None, str]:
    """The flight with the outputs that move, or None; what to say of the others.

    Args:
        flight: with at least one measured sample of each output.
    """
    outputs = {n: y for n, y in flight.outputs.items() if np.nanmin(y) < np.nanmax(y)}
    still = ", ".join(n for n in flight.outputs if n not in outputs)
    if not outputs:
        return None, f"none of its outputs ({still}) ever moves"
    said = f"{still} never moves, and is left out in frequency" if still else ""
    return with_outputs(flight, outputs), said


def with_outputs(flight: Flight, names: Collection[str]) -> Flight:
    """The flight with some of its outputs."""
    outputs, sd = (
        {n: v for n, v in of.items() if n in names} for of in (flight.outputs, flight.sd)
    )
    return replace(flight, outputs=outputs, sd=sd)


# Parts of flights in which outputs are seen without a hole, for what needs samples in a row.


_BRIDGED = 5
"""samples in a row at most that a straight line bridges: far fewer than a segment of a spectrum"""
_SHARE = 0.05
"""part of an output's samples that may be bridged; what makes up more is no longer measured"""


class Part(NamedTuple):
    """Samples in a row of one flight, every output seen or bridged in all of them."""

    inputs: dict[str, Float[np.ndarray, " n"]]
    outputs: dict[str, Float[np.ndarray, " n"]]

    @property
    def n_samples(self) -> int:
        """The samples of the part."""
        return next(iter(self.inputs.values())).size


class SeenParts(NamedTuple):
    """What can be looked at of some flights, and what cannot."""

    outputs: tuple[str, ...]
    parts: tuple[Part, ...]
    left_out: tuple[str, ...]
    """outputs that are not in every flight, or lack too many samples"""


def seen_parts(flights: Sequence[Flight]) -> SeenParts:
    """Parts without a hole, few missing samples bridged by straight lines."""
    used: list[str] = []
    left_out: list[str] = []
    filled: list[dict[str, np.ndarray]] = [{} for _ in flights]
    for name in dict.fromkeys(n for f in flights for n in f.outputs):
        if not all(name in f.outputs for f in flights):
            left_out.append(name)
            continue
        made = [_bridged(f.outputs[name]) for f in flights]
        missing = sum(int(np.isnan(f.outputs[name]).sum()) for f in flights)
        line = sum(count for _, count in made)
        total = sum(f.n_samples for f in flights)
        # Within its own span: what is missing before the first and after the last is cut off.
        if line > _SHARE * total or missing > 0.5 * total:
            left_out.append(name)
            continue
        used.append(name)
        for outputs, (y, _) in zip(filled, made, strict=True):
            outputs[name] = y
    parts = tuple(p for f, ys in zip(flights, filled, strict=True) for p in _whole(f, ys))
    return SeenParts(tuple(used), parts, tuple(left_out))


def _bridged(y: Float[np.ndarray, " N"]) -> tuple[Float[np.ndarray, " N"], int]:
    """An output with its short holes bridged, and by how many samples; longer ones stay."""
    seen = np.flatnonzero(np.isfinite(y))
    if seen.size < 2:
        return y, 0
    within = np.arange(y.size)
    # Which pair of seen samples a missing one lies between, and how far these are apart.
    after = np.searchsorted(seen, within)
    inside = (after > 0) & (after < seen.size) & np.isnan(y)
    apart = np.zeros(y.size)
    apart[inside] = seen[after[inside]] - seen[after[inside] - 1] - 1
    short = inside & (apart <= _BRIDGED)
    line = y.copy()
    line[short] = np.interp(within[short], seen, y[seen])
    return line, int(short.sum())


def _whole(flight: Flight, outputs: dict[str, np.ndarray]) -> list[Part]:
    """The runs of samples in which every output has a number."""
    return [
        Part(
            {n: u[first:last] for n, u in flight.inputs.items()},
            {n: y[first:last] for n, y in outputs.items()},
        )
        for first, last in spans([np.zeros(flight.n_samples), *outputs.values()])
    ]


COHERENT = 0.6
"""coherence from which on a response is taken for the input's: Tischler and Remple, Aircraft and
Rotorcraft System Identification (2012)"""
TOGETHER = 0.8
"""coherence of two inputs, the others taken out, from which on they move together: the variance of
what each does is 1 / (1 - 0.8) = 5 times as large as if the other were still"""
_SEGMENTS = 8
"""half-overlapping segments make an average, two more for every further input"""
_SHORTEST, _LONGEST = 64, 4096
"""samples of a segment"""
_MANY, _LONG, _LASTING = 24, 400, 4.0
"""segments that are better, where each still has so many samples or lasts for so many seconds"""
_CHANCE = 0.01
"""probability that any frequency of any input and output without coherence shows more"""
_WIDTH, _BINS = 0.25, 3
"""octaves and frequencies of the spectrum of a band, at least: a single frequency is a line of
vibration, or chance"""
_POWER = (0.05, 0.95)
"""the band of an input holds its power between these parts"""
_LEAST_POWER = 1e-3
"""of an input's largest power at one frequency: below that it does not excite"""
NOTHING_FOLLOWS = "excitation.nothing-follows"
"""code of a record in which no output follows any input"""


class Followed(NamedTuple):
    """Where an output follows an input."""

    output: str
    low: float
    high: float
    """[Hz]"""
    coherence: float
    """the largest there"""


class Pair(NamedTuple):
    """How far two inputs move together."""

    inputs: tuple[str, str]
    coherence: float
    """the other inputs taken out, averaged by the power that both have"""


class Excitation(NamedTuple):
    """What the inputs of some flights excite."""

    powers: dict[str, tuple[float, float]]
    """by input that moves the band [Hz] that holds 90 % of its power"""
    left_out: tuple[str, ...]
    """outputs that were not looked at, for lack of samples"""
    followed: Mapping[str, Followed | None] = MappingProxyType({})
    """by input the widest band in which an output follows it alone, None where there is none; empty
    where records are too short for a coherence"""
    limit: float = COHERENT
    """of that coherence"""
    share: float | None = None
    """largest part of an output's power that follows the inputs, where no output follows them over
    a band; else None"""
    pairs: tuple[Pair, ...] = ()
    """the most alike first"""
    pair_limit: float = TOGETHER


class _Pooled(NamedTuple):
    """Fourier transforms of the segments of all flights."""

    hz: Float[np.ndarray, " k"]
    inputs: Complex[np.ndarray, "k segments m"]
    outputs: Complex[np.ndarray, "k segments p"]


def excitation_of(flights: Sequence[Flight]) -> Excitation:
    """What the inputs excite; flights of one sample time are looked at together, since what one of
    them tells apart is told apart.
    """
    dt = flights[0].dt
    alike = [f for f in flights if abs(f.dt / dt - 1.0) < 1e-9]
    moving = [n for n in flights[0].inputs if any(np.ptp(f.inputs[n]) > 0 for f in alike)]
    seen = seen_parts(alike)
    pooled = _pooled(seen, moving, dt) if moving else None
    if pooled is None:
        return Excitation(_powers_alone(alike, moving), seen.left_out)
    powers = np.sum(np.abs(pooled.inputs) ** 2, axis=1).T
    limit = _chance(pooled, COHERENT, len(moving) * len(seen.outputs))
    followed = {n: _widest(pooled, j, seen.outputs, limit) for j, n in enumerate(moving)}
    alone = any(followed.values()) or _follow_together(pooled)
    return Excitation(
        {n: _power_band(pooled.hz, power) for n, power in zip(moving, powers, strict=True)},
        seen.left_out,
        followed,
        limit,
        None if alone else max(_share(pooled, i) for i in range(len(seen.outputs))),
        _pairs(pooled, moving),
        _chance(pooled, TOGETHER, len(moving) * (len(moving) - 1) // 2),
    )


def least_rough(flights: Sequence[Flight]) -> tuple[str, float]:
    """The output that shows most of a motion, and its mean squared step from sample to sample over
    that of white noise.

    Args:
        flights: with one output at least.
    """
    return min(
        ((n, _roughness(y)) for f in flights for n, y in f.outputs.items()), key=lambda one: one[1]
    )


def _roughness(y: Float[np.ndarray, " N"]) -> float:
    """Mean squared step of a signal over that of white noise of its variance (von Neumann)."""
    y = y[np.isfinite(y)]
    spread = float(np.var(y)) if y.size > 2 else 0.0
    return float(np.mean(np.diff(y) ** 2)) / (2.0 * spread) if spread > 0 else 1.0


def _pooled(seen: SeenParts, moving: list[str], dt: float) -> _Pooled | None:
    """None where no output is seen, or the parts are too short for an average."""
    # Where all inputs rest nothing is told of what follows them: such segments would count as
    # averages, and a long flight at rest would set the length of segments for a short sweep.
    parts = [p for p in seen.parts if any(np.ptp(p.inputs[n]) > 0 for n in moving)]
    more, sizes = 2 * (len(moving) - 1), [p.n_samples for p in parts]
    if not seen.outputs or not sizes:
        return None
    # Many segments where they can be long still, since few show little of a disturbed machine; else
    # as few as make an average.
    # By seconds too: at 50 Hz a record shows what the same record shows at 100 Hz.
    least = max(_SHORTEST, min(_LONG, round(_LASTING / dt)))
    length = _length(sizes, _MANY + more, least) or _length(sizes, _SEGMENTS + more, _SHORTEST)
    if length == 0:
        return None
    long = [p for p in parts if p.n_samples >= length]
    channels = [
        np.stack([*(p.inputs[n] for n in moving), *(p.outputs[n] for n in seen.outputs)])
        for p in long
    ]
    transforms = [segment_transforms(of_part, dt, length) for of_part in channels]
    omega, both = transforms[0].omega, np.concatenate([t.X for t in transforms], axis=1)
    # Without zero frequency, which the straight lines took, and Nyquist's.
    inner = slice(1, -1)
    hz, m = omega[inner] / (2.0 * np.pi), len(moving)
    return _Pooled(hz, both[inner, :, :m], both[inner, :, m:])


def _length(sizes: list[int], segments: int, least: int) -> int:
    """The samples of the longest segments of which there are enough; 0 where they are too short."""
    length = min(max(sizes), _LONGEST) // 2 * 2
    while length >= least and sum(_count(n, length) for n in sizes) < segments:
        length = length * 7 // 8 // 2 * 2
    return length if length >= least else 0


def _count(samples: int, length: int) -> int:
    return 0 if samples < length else 1 + (samples - length) // (length - length // 2)


def _chance(pooled: _Pooled, level: float, pairs: int) -> float:
    """The coherence that counts: `level`, or more where few segments show that much by chance in
    any of so many pairs of signals."""
    k, segments, m = pooled.inputs.shape
    # Of n independent segments a coherence of nothing exceeds c with probability (1 - c)^(n - 1);
    # half-overlapping Hann windows are worth about 0.9 n, and each other input takes one.
    free = max(0.9 * segments - m, 1.0)
    return max(level, 1.0 - (_CHANCE / (k * max(pairs, 1))) ** (1.0 / free))


def _share(pooled: _Pooled, i: int) -> float:
    """Of an output's power where inputs have some, the part that follows them, less what chance
    makes of few segments."""
    excited, (_, segments, m) = _excited(pooled), pooled.inputs.shape
    y, u = pooled.outputs[excited, :, i], pooled.inputs[excited]
    left = float(np.sum(np.abs(without(u, y)) ** 2))
    whole, chance = float(np.sum(np.abs(y) ** 2)), min(m / (0.9 * segments), 0.99)
    return max(1.0 - left / max(whole, 1e-300) / (1.0 - chance), 0.0)


def _excited(pooled: _Pooled) -> Bool[np.ndarray, " k"]:
    """The frequencies at which an input has power: beyond, what a filter or a window has left of
    both signals is coherent as well."""
    power = np.sum(np.abs(pooled.inputs) ** 2, axis=1)
    return np.any(power >= _LEAST_POWER * np.max(power, axis=0), axis=1)


def _follow_together(pooled: _Pooled) -> bool:
    """Whether an output follows all inputs taken together over a band, though none alone: where
    several move all the time, each has the others' power against it."""
    k, segments, m = pooled.inputs.shape
    outputs = pooled.outputs.shape[2]
    free = max(0.9 * segments - m, 1.0)
    # Of m inputs that explain nothing the multiple coherence is distributed as Beta(m, n - m).
    chance = float(scipy.special.betaincinv(m, free, 1.0 - _CHANCE / (k * outputs)))
    step = pooled.hz[1] - pooled.hz[0]
    for i in range(outputs):
        y = pooled.outputs[:, :, i]
        left = np.sum(np.abs(without(pooled.inputs, y)) ** 2, axis=1)
        multiple = 1.0 - left / np.maximum(np.sum(np.abs(y) ** 2, axis=1), 1e-300)
        run = longest_band(pooled.hz, (multiple >= max(COHERENT, chance)) & _excited(pooled))
        if run is not None and _is_band(run, step):
            return True
    return False


def _is_band(run: tuple[float, float], step: float) -> bool:
    # Each frequency stands for the step about it.
    wide = np.log2((run[1] + step / 2) / (run[0] - step / 2)) >= _WIDTH
    return bool(wide and run[1] - run[0] >= (_BINS - 1.5) * step)


def _widest(pooled: _Pooled, j: int, outputs: Sequence[str], limit: float) -> Followed | None:
    """The widest band in which an output follows the j-th input; None where it is too narrow."""
    others, u = np.delete(pooled.inputs, j, axis=2), pooled.inputs[:, :, j]
    power = np.sum(np.abs(u) ** 2, axis=1)
    step, best = pooled.hz[1] - pooled.hz[0], None
    for i, output in enumerate(outputs):
        c = np.nan_to_num(partial_coherence(others, u, pooled.outputs[:, :, i]))
        good = (c >= limit) & (power >= _LEAST_POWER * power.max())
        run = longest_band(pooled.hz, good)
        if run is None or not _is_band(run, step):
            continue
        if best is None or run[1] / run[0] > best.high / best.low:
            best = Followed(output, *run, float(np.max(c[good])))
    return best


def _power_band(hz: np.ndarray, power: np.ndarray) -> tuple[float, float]:
    sums = np.cumsum(power) / max(float(np.sum(power)), 1e-300)
    first, last = (int(np.searchsorted(sums, p)) for p in _POWER)
    return float(hz[min(first, hz.size - 1)]), float(hz[min(last, hz.size - 1)])


def longest_band(hz: np.ndarray, good: Bool[np.ndarray, " k"]) -> tuple[float, float] | None:
    """The widest band (in octaves) without a hole; None where nothing is good.

    Args:
        hz: (k,) rising, any unit.
        good: (k,)
    """
    edges = np.diff(np.concatenate([[0], good.astype(int), [0]]))
    begins, ends = np.flatnonzero(edges == 1), np.flatnonzero(edges == -1) - 1
    if not begins.size:
        return None
    widest = int(np.argmax(hz[ends] / hz[begins]))
    return float(hz[begins[widest]]), float(hz[ends[widest]])


def _pairs(pooled: _Pooled, moving: list[str]) -> tuple[Pair, ...]:
    pairs = []
    for a, b in itertools.combinations(range(len(moving)), 2):
        others = np.delete(pooled.inputs, [a, b], axis=2)
        u, v = pooled.inputs[:, :, a], pooled.inputs[:, :, b]
        c = partial_coherence(others, u, v)
        # Where the others explain all of one, what is left is rounding: the pair by itself.
        c = np.where(np.isnan(c), np.nan_to_num(partial_coherence(others[:, :, :0], u, v)), c)
        powers = [np.sum(np.abs(x) ** 2, axis=1) for x in (u, v)]
        # Where both have power: that is where each could be taken for the other.
        weights = np.min([p / max(p.sum(), 1e-300) for p in powers], axis=0)
        # None where one of them moves in parts alone that are shorter than a segment.
        mean = float(np.sum(c * weights) / max(np.sum(weights), 1e-300))
        pairs.append(Pair((moving[a], moving[b]), mean))
    return tuple(sorted(pairs, key=lambda pair: -pair.coherence))


def _powers_alone(flights: list[Flight], moving: list[str]) -> dict[str, tuple[float, float]]:
    """The bands of the inputs' power by the longest flight, where there is no coherence."""
    longest = max(flights, key=lambda f: f.n_samples)
    length = min(longest.n_samples, _LONGEST) // 2 * 2
    powers = {}
    for name in (n for n in moving if np.ptp(longest.inputs[n]) > 0):
        spectra = segment_transforms(longest.inputs[name][None, :], longest.dt, length)
        power = np.sum(np.abs(spectra.X[1:-1, :, 0]) ** 2, axis=1)
        powers[name] = _power_band(spectra.omega[1:-1] / (2.0 * np.pi), power)
    return powers
