"""Excitation: the power of a signal that follows others, in bands of a record's lines.

In a narrow band a response is a constant gain. Least squares over the band's lines therefore gives
the power of a signal that follows others. The likelihood ratio is compared with chance (Wilks, for
complex normal errors). The results are

- the part of the outputs that follows the excitation: the logged excitation if inputs are taken by
  instrument, else the inputs;
- the part of a residual in frequency that follows it, which is zero for the right model. The test
  needs no simulation, so it is valid for unstable vehicles. By instrument it is the test of
  overidentification (Sargan, 1958);
- the coherence between inputs.

Sources: Sargan (1958); Goodman (1963) for complex normal errors; Ljung, System Identification
(1999), 16.6, for residuals against inputs; Bendat and Piersol, Random Data (2010), chapter 7, for
partial coherence.
"""

import itertools
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import jax
import numpy as np
import scipy.special
from jaxtyping import Bool, Complex, Float

from heli_jax.flights.flight import Flight
from heli_jax.identification.estimation.frequency_instrument import instruments_of
from heli_jax.identification.estimation.frequency_lines import (
    errors_of_lines,
    lines_of,
    records_of,
)
from heli_jax.identification.problem import Problem
from heli_jax.identification.unknowns.layout import Solution

LEVEL = 0.01
"""Significance level of the test of all outputs together."""
_FIRST, _GROWTH = 12, 1.15
"""Lines of the lowest band, and ratio of the widths of one band and the next."""
_LOW, _HIGH = 0.05, 0.95
"""Shares of an input's power below the edges of its band."""
_LEAST_POWER = 1e-3
"""Least power density that excites, as a share of an input's largest."""
_SEEN = 0.8
"""Least share of an output's samples that are measured; straight lines bridge gaps."""
_ROUNDING = 1e-6
"""Share of the inputs' power below which a combination of them is rounding."""


class Followed(NamedTuple):
    """Part of a signal that follows the excitation."""

    p_value: float
    """Probability that noise follows as much by chance."""
    explained: float
    """Share of an output's power that follows the excitation.

    For a residual: share of that power which the model explains."""
    by_chance: float = 0.0
    """Standard deviation of that share."""


class Pair(NamedTuple):
    """Two inputs that may move together."""

    inputs: tuple[str, str]
    coherence: float
    """Partial coherence, averaged over frequency with the power of both inputs as weight."""


class Excitation(NamedTuple):
    """Inputs of flights, and the outputs that follow them."""

    powers: dict[str, tuple[float, float]]
    """Band [Hz] with 90 % of the power of each input that moves."""
    outputs: dict[str, Followed]
    """Results by output that moves and is mostly measured; empty for short records."""
    pairs: tuple[Pair, ...]
    """Pairs of inputs that move, the most coherent first."""


def excitation_of(problem: Problem) -> Excitation:
    """Return the excitation of the fitted flights."""
    flights, by = problem.training, instruments_of(problem)
    # The lines of a flight at rest would displace those of other flights in a band.
    flown = [f for f in flights if any(np.ptp(u) > 0 for u in f.inputs.values())]
    if not flown:
        return Excitation({}, {}, ())
    names = [n for n in flown[0].inputs if any(np.ptp(f.inputs[n]) > 0 for f in flown)]
    lines = [lines_of(np.stack([f.inputs[n] for n in names], 1)) * f.dt**0.5 for f in flown]
    # Sort the lines of all flights by frequency, as if from one record.
    each = zip(flown, lines, strict=True)
    hz = np.concatenate([np.arange(1, len(v) + 1) / (f.n_samples * f.dt) for f, v in each])
    order = np.argsort(hz, kind="stable")
    hz, X = hz[order], np.concatenate(lines)[order]
    sums = np.cumsum(np.abs(X.T) ** 2, axis=1)
    powers = {
        n: (
            float(hz[np.searchsorted(s, _LOW * s[-1])]),
            float(hz[np.searchsorted(s, _HIGH * s[-1])]),
        )
        for n, s in zip(names, sums, strict=True)
    }
    return Excitation(powers, _outputs(flown, by), _pairs(X, names))


def _outputs(flights: Sequence[Flight], by: Sequence[str]) -> dict[str, Followed]:
    """Return by output the part that follows the excitation."""
    sums: dict[str, np.ndarray] = {}
    for flight in flights:
        X = _drives(flight, by)
        measured = {n: _bridged(y) for n, y in flight.outputs.items() if _seen(y) >= _SEEN}
        measured = {n: y for n, y in measured.items() if np.ptp(y) > 0}
        if X is None or not measured:
            continue
        # A slow mode ends away from its start, and this jump is in all lines of the spectrum.
        # The test is therefore repeated without the straight line between the ends.
        above = [y - np.linspace(y[0], y[-1], y.size) for y in measured.values()]
        for k, v in enumerate((list(measured.values()), above)):
            y = lines_of(np.stack(v, axis=1))
            bands = _in_bands(y[:, :, None], X)
            whole, followed = (
                np.sum(v[bands.excited, :, 0], axis=0) for v in (bands.whole, bands.followed)
            )
            totals = np.column_stack([bands.test(), followed, whole])
            for name, statistics in zip(measured, totals, strict=True):
                sums.setdefault(name, np.zeros((2, 4)))[k] += statistics
    return {
        # Two tests of one record (Bonferroni).
        name: Followed(
            min(1.0, 2.0 * float(np.min(scipy.special.chdtrc(s[:, 1], s[:, 0])))),
            float(np.max(s[:, 2] / np.maximum(s[:, 3], 1e-300))),
        )
        for name, s in sums.items()
        if np.all(s[:, 1] > 0)
    }


def _drives(
    flight: Flight, by: Sequence[str], part: slice = slice(None)
) -> Complex[np.ndarray, "K m"] | None:
    """Return the transform of the excitation in a part of a flight; None if nothing moves.

    The excitation is the logged one for inputs `by` instrument, else the inputs.
    """
    drives = [flight.instruments[n] if n in by else u for n, u in flight.inputs.items()]
    moving = [v[part] for v in drives if np.ptp(v[part]) > 0]
    return lines_of(np.stack(moving, axis=1)) if moving else None


def _seen(y: Float[np.ndarray, " N"]) -> float:
    return float(np.mean(np.isfinite(y)))


def _bridged(y: Float[np.ndarray, " N"]) -> Float[np.ndarray, " N"]:
    seen = np.flatnonzero(np.isfinite(y))
    return np.interp(np.arange(y.size), seen, y[seen])


def _pairs(X: Complex[np.ndarray, "K m"], moving: Sequence[str]) -> tuple[Pair, ...]:
    """Return the coherence of each two inputs, from the inverse of their spectra in each band."""
    powers, coherences, m = list[np.ndarray](), list[np.ndarray](), len(moving)
    for band in _band_slices(*X.shape):
        S = X[band].T @ np.conj(X[band])
        powers.append(np.real(np.diag(S)))
        size = np.sqrt(np.where(powers[-1] > 0, powers[-1], 1.0))
        P = np.linalg.pinv(S / np.outer(size, size), rcond=_ROUNDING, hermitian=True)
        own = np.real(np.diag(P))
        part = np.abs(P) ** 2 / np.maximum(np.outer(own, own), 1e-300)
        # Subtract the coherence that is expected by chance.
        n = band.stop - band.start - m + 2
        coherences.append(np.clip((n * part - 1.0) / (n - 1), 0.0, 1.0))
    if not powers:
        return ()
    parts = np.stack(powers) / np.maximum(np.sum(powers, axis=0), 1e-300)
    pairs = []
    for a, b in itertools.combinations(range(m), 2):
        # Only frequencies at which both have power can confuse their effects.
        weights = np.minimum(parts[:, a], parts[:, b])
        values = np.stack(coherences)[:, a, b]
        mean = float(weights @ values / max(float(np.sum(weights)), 1e-300))
        pairs.append(Pair((moving[a], moving[b]), mean))
    return tuple(sorted(pairs, key=lambda pair: -pair.coherence))


def _band_slices(lines: int, m: int) -> Iterator[slice]:
    """Yield bands of lines, each wide enough for m excitations."""
    first, size = 0, float(max(_FIRST, 4 * m))
    while first + int(size) <= lines:
        yield slice(first, first + int(size))
        first, size = first + int(size), size * _GROWTH


def least_rough(flights: Sequence[Flight]) -> tuple[str, float]:
    """Return the smoothest output, and its mean squared step over that of white noise.

    This is von Neumann's ratio. The flights must have at least one output.
    """

    def roughness(y: Float[np.ndarray, " N"]) -> float:
        y = y[np.isfinite(y)]
        spread = float(np.var(y)) if y.size > 2 else 0.0
        return float(np.mean(np.diff(y) ** 2)) / (2.0 * spread) if spread > 0 else 1.0

    each = ((n, roughness(y)) for f in flights for n, y in f.outputs.items())
    return min(each, key=lambda one: one[1])


def residual_against_excitation(problem: Problem, at: Solution) -> dict[str, Followed]:
    """Return by output the part of its residual that follows the excitation.

    Outputs with too few lines are left out.
    """
    errors = jax.device_get(errors_of_lines(*at).errors)
    by = instruments_of(problem) if at.data.flights[0].by_instrument is not None else ()
    return errors_against_excitation(problem.training, at, errors, by)


def errors_against_excitation(
    flights: Sequence[Flight],
    at: Solution,
    errors: Sequence[Complex[np.ndarray, "K p"]],
    by: Sequence[str],
) -> dict[str, Followed]:
    """Return by output the part of errors that follows the excitation.

    Outputs with too few lines are left out.

    Args:
        flights: flights of the layout, fitted or held out.
        at: point at which they are evaluated.
    """
    layout, _, noise, _ = at
    sums: dict[str, np.ndarray] = {}
    sizes: dict[int, np.ndarray] = {}
    for record, e, W in zip(records_of(layout), errors, noise.whitening, strict=True):
        flight, part = flights[record.flight], slice(record.first, record.last)
        names = layout.outputs[record.flight]
        X = _drives(flight, by, part)
        if X is None:
            continue
        y = lines_of(np.stack([flight.outputs[n][part] for n in names], axis=1))
        # Records of one length share their whitening.
        if id(W) not in sizes:
            root = np.linalg.inv(np.asarray(W))
            # The test assumes noise of constant power in each band: divide by the noise's spectrum.
            sizes[id(W)] = np.sqrt(np.sum(np.abs(root) ** 2, axis=2))
        bands = _in_bands(np.stack([e, y], axis=2), X, sizes[id(W)])
        # Scale by the measured output: the response of a wrong model may be larger.
        asked, scale = bands.asked, bands.scale
        powers = np.sum((asked * scale)[:, :, None] * bands.followed, axis=0)
        chance = np.sum(asked * bands.rank * (scale * bands.per_line[:, :, 0]) ** 2, axis=0)
        totals = np.column_stack([bands.test(), powers, chance])
        for name, statistics in zip(names, totals, strict=True):
            sums[name] = sums.get(name, np.zeros(5)) + statistics
    return {
        name: Followed(
            float(scipy.special.chdtrc(freedom, statistic)),
            float(1.0 - left / answer) if answer > 0 else 1.0,
            float(np.sqrt(variance) / answer) if answer > 0 else np.inf,
        )
        for name, (statistic, freedom, left, answer, variance) in sums.items()
        if freedom > 0
    }


class _Bands(NamedTuple):
    """Powers of signals in bands, by output and signal."""

    lines: Float[np.ndarray, "b 1"]
    rank: Float[np.ndarray, "b p"]
    """Rank of the excitation."""
    whole: Float[np.ndarray, "b p c"]
    parts: Float[np.ndarray, "b p c"]
    """Power that the excitation explains."""
    scale: Float[np.ndarray, "b p"]
    """Mean square of the signals' divisors."""
    excited: Bool[np.ndarray, " b"]
    """True where an excitation has power."""

    @property
    def per_line(self) -> Float[np.ndarray, "b p c"]:
        """Unexplained power per line."""
        return np.maximum(self.whole - self.parts, 0.0) / (self.lines - self.rank)[:, :, None]

    @property
    def followed(self) -> Float[np.ndarray, "b p c"]:
        """Power that follows the excitation, less the power expected by chance."""
        return self.parts - self.rank[:, :, None] * self.per_line

    def test(self) -> Float[np.ndarray, "p 2"]:
        """Return by output the likelihood ratio of its first signal, with its degrees of freedom.

        The ratio compares models with and without the excitation.
        """
        asked, n, m = self.asked, self.lines, self.rank
        share = self.parts[:, :, 0] / np.where(asked, self.whole[:, :, 0], np.inf)
        statistic = np.where(asked, -(2.0 * n - m - 1.0) * np.log1p(-share), 0.0)
        return np.stack(
            [np.sum(statistic, axis=0), np.sum(np.where(asked, 2.0 * m, 0.0), axis=0)], 1
        )

    @property
    def asked(self) -> Bool[np.ndarray, "b p"]:
        """True if the first signal has a part that does not follow the excitation."""
        return (self.rank > 0) & (self.whole[:, :, 0] > self.parts[:, :, 0])


def _in_bands(
    signals: Complex[np.ndarray, "K p c"],
    X: Complex[np.ndarray, "K m"],
    size: Float[np.ndarray, "K s"] | None = None,
) -> _Bands:
    """Regress signals on an excitation in each band.

    Args:
        size: divisors of each output, or (s = 1) of all; 1 by default.
    """
    size = np.ones((len(X), 1)) if size is None else size
    found = list[tuple[_Bands, np.ndarray]]()
    for band in _band_slices(*X.shape):
        over = 1.0 / size[band].T
        # Each output divides the excitation by its own size.
        Q, R = np.linalg.qr(X[None, band] * over[:, :, None])
        along = np.abs(np.einsum("pii->pi", R))
        kept = along > 1e-9 * np.max(along, axis=1, initial=0.0, keepdims=True)
        Q = np.where(kept[:, None, :], Q, 0.0)
        m = np.broadcast_to(np.sum(kept, axis=1), (signals.shape[1],))
        v = np.swapaxes(signals[band], 0, 1) * over[:, :, None]
        whole = np.sum(np.abs(v) ** 2, axis=1)
        parts = np.sum(np.abs(np.conj(np.swapaxes(Q, 1, 2)) @ v) ** 2, axis=1)
        scale = np.broadcast_to(np.mean(size[band] ** 2, axis=0), m.shape)
        density = np.mean(np.abs(X[band]) ** 2, axis=0)
        n = np.array([band.stop - band.start])
        found.append((_Bands(n, m, whole, parts, scale, np.array(False)), density))
    if not found:
        p, c = signals.shape[1:]
        b1, bp, bpc = np.zeros((0, 1)), np.zeros((0, p)), np.zeros((0, p, c))
        return _Bands(b1, bp, bpc, bpc, bp, np.zeros(0, bool))
    bands, densities = zip(*found, strict=True)
    density = np.stack(densities)
    excited = np.any(density >= _LEAST_POWER * np.max(density, axis=0, initial=0.0), axis=1)
    return _Bands(*(np.stack(v) for v in zip(*bands, strict=True)))._replace(excited=excited)
