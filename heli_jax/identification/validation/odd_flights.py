"""Flights whose outputs do not answer their inputs as those of the others do.

One flight of several with a dead column, of another machine, or with rows out of order spoils what
all of them say together, and nothing that is computed of all names it. So the frequency response of
the others is put to each: of a flight of the same machine it foretells what is not noise.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import scipy.special
from jaxtyping import Complex

from heli_jax.analysis.spectra import segment_transforms
from heli_jax.finding import Finding
from heli_jax.flights.flight import Flight
from heli_jax.identification.unknowns.nuisances import labels
from heli_jax.identification.validation.seen_parts import seen_parts
from heli_jax.numbers import percent

_SEGMENTS = 6
"""half-overlapping segments of the shortest flight, at least"""
_SHORTEST, _LONGEST = 64, 4096
"""samples of a segment"""
_COHERENT, _CHANCE = 0.6, 0.01
"""multiple coherence at which an output follows, and the probability of more at any frequency"""
_BINS = 3
"""frequencies at which it does, at least"""
_LEFT = 0.8
"""part of an output's power that the response of the others leaves, from which on it foretells
nothing"""
_TURNED = 0.4
"""part of an output's power that the response of the others leaves at most where its sign is turned
and nothing else is wrong"""
_LOUDER = 4.0
"""times what it leaves of the others: of a flight that is hardly excited it leaves no more"""
_EXCITED = 0.1
"""of an input's power in a flight that it has in the others: what they do not excite they do not
foretell"""


class OddFlight(NamedTuple):
    """A flight that does not answer as the others do."""

    index: int
    label: str
    outputs: tuple[str, ...]
    left: float
    """part of the power of the surest of them that the response of the others leaves"""
    still: tuple[str, ...]
    """inputs that move in other flights and not in this one"""
    turned: tuple[str, ...] = ()
    """those of the outputs that answer as in the others with the other sign"""

    @property
    def finding(self) -> Finding:
        """What was found and what to do, as a doubt."""
        names = " and ".join(self.outputs)
        does = "do" if len(self.outputs) > 1 else "does"
        if self.still:
            why = f"{' and '.join(self.still)} never moves there: is the column dead?"
        elif self.turned == self.outputs:
            stick = " (or, of all that it moves, an input)" if len(self.turned) > 1 else ""
            why = (
                f"with the other sign {'they do' if stick else 'it does'}: {names}{stick} "
                f"{'have' if stick else 'has'} the wrong one there (`invert: true`)."
            )
        else:
            why = (
                "is it of another machine, is a column or a sign wrong, or its clock out of order?"
            )
        words = (
            f"{self.label}: {names} {does} not answer the inputs as in the other flights, whose "
            f"response leaves {percent(self.left, 0)} of the power: {why} Mend this flight or "
            "leave it out."
        )
        criterion = f"part of the power that the response of the others leaves, {_LEFT:g}"
        return Finding(
            "agreement.odd-flight",
            "doubt",
            words,
            self.left,
            criterion,
            (self.label, *self.outputs),
            brief=f"{self.label} does not answer its inputs as the other flights do",
            denies=True,
        )


class _Spectra(NamedTuple):
    inputs: Complex[np.ndarray, "k segments m"]
    outputs: Mapping[str, Complex[np.ndarray, "k segments"]]
    inverse: Complex[np.ndarray, "k m segments"]
    """pseudoinverse of the inputs: two sticks that move as one have no unique gains, but a
    projection"""


def odd_flights(flights: Sequence[Flight]) -> list[OddFlight]:
    """The flights that answer otherwise than most; none where fewer than two can be compared.

    Args:
        flights: that are fitted together. Those of one sample time and with the same known
            parameters are compared.
    """
    names = labels(tuple(flights))
    odd: list[OddFlight] = []
    for alike in _groups(flights):
        odd += _of_group([flights[i] for i in alike], [names[i] for i in alike], alike)
    return odd


def _groups(flights: Sequence[Flight]) -> list[list[int]]:
    """Indices of flights that one response holds for."""
    groups: dict[tuple, list[int]] = {}
    for i, f in enumerate(flights):
        groups.setdefault((round(f.dt, 9), *sorted(f.known.items())), []).append(i)
    return [group for group in groups.values() if len(group) > 1]


def _of_group(flights: list[Flight], names: list[str], indices: list[int]) -> list[OddFlight]:
    moving = [n for n in flights[0].inputs if any(np.ptp(f.inputs[n]) > 0 for f in flights)]
    shortest = min(f.n_samples for f in flights)
    length = min(2 * shortest // (_SEGMENTS + 1), _LONGEST) // 2 * 2
    if not moving or length < _SHORTEST:
        return []
    spectra = [_spectra(f, moving, length) for f in flights]
    leading = [
        i
        for i, s in enumerate(spectra)
        if any(_followed(s, n, len(s.outputs)).any() for n in s.outputs)
    ]
    odd = []
    for i, (flight, own) in enumerate(zip(flights, spectra, strict=True)):
        others = [spectra[j] for j in leading if j != i]
        # Of two that both answer, each in its own way, nobody knows which is the odd one.
        if len(others) < (2 if i in leading else 1):
            continue
        joined: dict[tuple[int, ...], _Spectra] = {}
        left = {n: x for n in own.outputs if (x := _left(own, others, n, joined)) is not None}
        bad = tuple(n for n, x in left.items() if x > _LEFT)
        if bad:
            still = tuple(n for n in moving if not np.ptp(flight.inputs[n]) > 0)
            most = max(left[n] for n in bad)
            over = own._replace(outputs={n: -own.outputs[n] for n in bad})
            after = {n: _left(over, others, n, joined) for n in bad}
            turned = tuple(n for n, x in after.items() if x is not None and x < _TURNED)
            odd.append(OddFlight(indices[i], names[i], bad, most, still, turned))
    return odd


def _spectra(flight: Flight, moving: list[str], length: int) -> _Spectra:
    """Of the flight's parts that are long enough; no outputs where none is."""
    seen = seen_parts([flight])
    parts = [p for p in seen.parts if p.n_samples >= length]
    if not parts or not seen.outputs:
        nothing = np.zeros((1, 0, len(moving)), complex)
        return _Spectra(nothing, {}, np.swapaxes(nothing, 1, 2))
    channels = [
        np.stack([p.inputs[n] for n in moving] + [p.outputs[n] for n in seen.outputs])
        for p in parts
    ]
    made = [segment_transforms(x, flight.dt, length)[1] for x in channels]
    # Without zero frequency, which the straight lines took, and Nyquist's.
    both, m = np.concatenate(made, axis=1)[1:-1], len(moving)
    outputs = {n: both[:, :, m + i] for i, n in enumerate(seen.outputs)}
    return _Spectra(both[:, :, :m], outputs, np.linalg.pinv(both[:, :, :m]))


def _followed(s: _Spectra, name: str, asked: int) -> np.ndarray:
    """At which frequencies (k,) one output of so many follows the inputs, more than by chance; at
    none where they are too few to be a band."""
    k, segments, m = s.inputs.shape
    y = s.outputs[name]
    # Half-overlapping Hann windows are worth about 0.9 of their number.
    free = 0.9 * segments - m
    if free < 1.0:
        return np.zeros(k, bool)
    # Of m inputs that explain nothing the multiple coherence is distributed as Beta(m, n - m).
    chance = float(scipy.special.betaincinv(m, free, 1.0 - _CHANCE / (k * asked)))
    power = np.sum(np.abs(y) ** 2, axis=1)
    explained = (s.inputs @ (s.inverse @ y[:, :, None]))[:, :, 0]
    left = np.sum(np.abs(y - explained) ** 2, axis=1)
    good = 1.0 - left / np.maximum(power, 1e-300) >= max(_COHERENT, chance)
    runs = np.convolve(good, np.ones(_BINS), "valid") == _BINS if k >= _BINS else np.zeros(0)
    return good if np.any(runs) else np.zeros(k, bool)


def _together(those: Sequence[_Spectra]) -> _Spectra:
    """Flights as one, with the outputs that all of them have."""
    U = np.concatenate([s.inputs for s in those], axis=1)
    names = [n for n in those[0].outputs if all(n in s.outputs for s in those)]
    Y = {n: np.concatenate([s.outputs[n] for s in those], axis=1) for n in names}
    return _Spectra(U, Y, np.linalg.pinv(U))


def _left(
    own: _Spectra, others: list[_Spectra], name: str, joined: dict[tuple[int, ...], _Spectra]
) -> float | None:
    """Part of the power of an output that the response of other flights leaves; None where that
    cannot be asked, 0 where it leaves no more than of those."""
    those = tuple(i for i, s in enumerate(others) if name in s.outputs)
    if not those:
        return None
    # Outputs that the same flights have are asked of the same inputs.
    if those not in joined:
        joined[those] = _together([others[i] for i in those])
    both = joined[those]
    U, Y, good = both.inputs, both.outputs[name], _followed(both, name, 1)
    if not good.any() or not own.outputs[name].shape[1]:
        return None
    U, Y, u, y = U[good], Y[good], own.inputs[good], own.outputs[name][good]
    powers = [np.mean(np.sum(np.abs(x) ** 2, axis=0), axis=0) for x in (u, U)]
    if np.any(powers[1] < _EXCITED * powers[0]):
        return None
    response = both.inverse[good] @ Y[:, :, None]
    left = np.mean(np.sum(np.abs(y - (u @ response)[:, :, 0]) ** 2, axis=0))
    of_others = np.mean(np.sum(np.abs(Y - (U @ response)[:, :, 0]) ** 2, axis=0))
    power = np.mean(np.sum(np.abs(y) ** 2, axis=0))
    return float(left / power) if left > _LOUDER * of_others and power > 0 else 0.0
