r"""The noise's spectrum by what the machine makes of gusts, and a mean over lines of what is left.

Gusts come out of a machine with its integrations and modes in them: outputs that are coherent with
a gain that changes from line to line. A mean over lines makes something else of that, estimates
lose most of what the record tells, and intervals are too narrow. So the spectrum is first described
as

$$S_0 = \sum_i h_i\, q_i\, h_i^H + R, \qquad [h_1 \ldots h_n] = C (zI - A_d)^{-1}$$

with a gust at every state whose spectrum $q_i \ge 0$ falls with frequency somehow, and white noise
of each output in R. The errors, whitened by $S_0$, have a spectrum that is nearly flat, and the
mean over lines is taken of that: it may be wide, and corrects whatever the description lacks.

A spectrum from n averages of p outputs weighs by $n / (n - p)$ too much, and the estimate is by
about the same worse than with the true one: both are allowed for.

Sources: Blackman and Tukey (1958) for prewhitening; Sawada, Kameoka, Araki and Ueda (2013) for the
multiplicative steps to the largest likelihood; Brillinger (1981), chapter 8, for weights that are
estimated.
"""

from collections import Counter
from collections.abc import Callable, Sequence
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Array, Complex, Float

from heli_jax.identification.estimation.frequency_machines import (
    Machine,
    alike,
    first_machine,
    machines_of,
)
from heli_jax.identification.estimation.frequency_spectrum import (
    averages,
    inverse_roots,
    knots_of,
    smoothed,
    summed_powers,
    whitening_of,
)
from heli_jax.identification.unknowns.layout import Data, Layout, unpack

LEAST, PART = 12.0, 0.12
"""sd of the Gaussian that smooths what is left: lines at least, and as a part of the frequency"""
_CELLS = 0.16, 6.0
"""the same of what the description rests on: each line by itself up to the fiftieth, since slow
modes are no wider, and from there on 4 % of the frequency"""
_OCTAVES = 2
"""from one corner of the gusts' spectra to the next"""
_STEPS = 24
"""towards the largest likelihood: what they leave is for the mean over lines"""
_NOTHING = 1e-9
"""of an output's power, below which none of it is noise"""
_UNSEEN = 1e-10
"""part of the largest effect of a state below which outputs do not show one"""


@eqx.filter_jit
def machine_of(layout: Layout, data: Data, z: Float[Array, " q"]) -> Machine:
    """That of the first flight: records of one length share a spectrum.

    Args:
        layout: what the unknowns are.
        data: the numbers of the problem.
        z: the unknowns.
    """
    members = alike(layout, data)[0]
    return first_machine(machines_of(layout, data, unpack(layout, data, z), members).matrices)


def whitening_by(
    machine: Machine, errors: Sequence[Complex[np.ndarray, "K p"]], part: float = 1.0
) -> tuple[Complex[np.ndarray, "K p p"], ...]:
    """By record what makes its errors white; of records of one length the same array.

    Args:
        machine: that gusts come through.
        errors: by record at its own frequencies.
        part: of those, from the lowest, that they are at.
    """
    size = np.sqrt(sum(np.sum(np.abs(e) ** 2, axis=0) for e in errors) / sum(map(len, errors)))
    size = np.where(size > 0, size, 1.0)
    scaled = [e / size for e in errors]
    before = _before(machine, scaled, size, part)
    left = smoothed([np.einsum("kij,kj->ki", before[len(e)], e) for e in scaled], PART, least=LEAST)
    counts = tuple(Counter(len(e) for e in errors).items())
    p, made = errors[0].shape[1], {}
    for e, W in zip(errors, whitening_of(left), strict=True):
        K = len(e)
        if K not in made:
            n = np.maximum(averages(K, counts, PART, LEAST), p + 1.0)
            made[K] = ((n - p) / n)[:, None, None] * (W @ before[K]) / size[None, None, :]
    return tuple(made[len(e)] for e in errors)


class _Cells(NamedTuple):
    """Lines that are taken together, of records of every length."""

    f: Float[np.ndarray, " c"]
    """in cycles a sample"""
    H: Complex[np.ndarray, "c p n"]
    power: Complex[np.ndarray, "c p p"]
    """mean of e e^H"""
    lines: Float[np.ndarray, " c"]


def _before(
    machine: Machine,
    errors: Sequence[Complex[np.ndarray, "K p"]],
    size: Float[np.ndarray, " p"],
    part: float,
) -> dict[int, Complex[np.ndarray, "K p p"]]:
    """By length of the record S0^(-1/2); ones where the machine says nothing of the errors."""
    p = errors[0].shape[1]
    lengths = dict.fromkeys(len(e) for e in errors)
    flat = {K: np.broadcast_to(np.eye(p, dtype=complex), (K, p, p)) for K in lengths}
    with np.errstate(all="ignore"):
        of_length = {K: [e for e in errors if len(e) == K] for K in lengths}
        at = {K: _cells(machine, of_length[K], size, part) for K in lengths}
        cells = _Cells(*(np.concatenate(v) for v in zip(*at.values(), strict=True)))
        corners = corners_of(cells.f)
        # A line on a mode that does not decay has no finite response.
        cells = _Cells(*(v[np.isfinite(cells.H).all((1, 2))] for v in cells))
        if not cells.f.size:
            return flat
        parameters = _described(cells, corners)
    if not all(np.isfinite(v).all() for v in parameters):
        return flat
    q, r = parameters
    made = {}
    for K, of in at.items():
        S0 = _spectrum(np.nan_to_num(of.H), q @ shapes_of(of.f, corners), r)
        root = inverse_roots(S0)
        _, (low, share) = knots_of(K, *_CELLS)
        made[K] = root[low] + share[:, None, None] * (root[low + 1] - root[low])
    return made


def _cells(
    machine: Machine,
    errors: Sequence[Complex[np.ndarray, "K p"]],
    size: Float[np.ndarray, " p"],
    part: float,
) -> _Cells:
    """A cell around each knot of records of one length."""
    K = len(errors[0])
    at, _ = knots_of(K, *_CELLS)
    edges = np.concatenate([[0], (at[1:] + at[:-1] + 1) // 2])
    power = summed_powers(np.stack(errors)) / len(errors)
    count = np.diff(np.append(edges, K)).astype(float)
    power = np.add.reduceat(power, edges, axis=0) / count[:, None, None]
    f = part * (at + 1) / (2 * K + 1)
    Ad, C = np.asarray(machine.Ad, float), np.asarray(machine.C, float)
    n = len(Ad)
    z = np.exp(2j * np.pi * f)[:, None, None]
    H = (C / size[:, None]) @ np.linalg.inv(z * np.eye(n) - Ad)
    # What rounding leaves of a state that no output shows would pass for the way of a huge gust,
    # and the spectrum would jump with the last digit of the parameters.
    effects = np.max(np.where(np.isfinite(H), np.abs(H), 0.0), axis=(0, 1))
    seen = effects > _UNSEEN * np.max(effects)
    return _Cells(f, np.where(seen, H, 0.0), power, count * len(errors))


def corners_of(f: Float[np.ndarray, " c"]) -> Float[np.ndarray, " b"]:
    """Of first-order lags, from half of the rate down to the lowest of some frequencies.

    Args:
        f: in cycles a sample.
    """
    first, last = float(np.min(f)), 0.5
    return last * 0.5 ** np.arange(1.0, np.log2(last / first), _OCTAVES)


def shapes_of(
    f: Float[np.ndarray, " c"], corners: Float[np.ndarray, " b"]
) -> Float[np.ndarray, "b1 c"]:
    """Spectra that a gust's is a sum of: a white one and first-order lags.

    Args:
        f: in cycles a sample.
        corners: of the lags.
    """
    return np.concatenate([np.ones((1, f.size)), 1.0 / (1.0 + (f / corners[:, None]) ** 2)])


def _spectrum(
    H: Complex[np.ndarray, "c p n"], Q: Float[np.ndarray, "n c"], r: Float[np.ndarray, " p"]
) -> Complex[np.ndarray, "c p p"]:
    return (H * Q.T[:, None, :]) @ np.conj(np.swapaxes(H, 1, 2)) + np.diag(r)


def _described(
    cells: _Cells, corners: Float[np.ndarray, " b"]
) -> tuple[Float[np.ndarray, "n b1"], Float[np.ndarray, " p"]]:
    """Powers of the gusts, by state and shape, and of the outputs' own noise."""
    h = np.swapaxes(cells.H, 1, 2)
    ways = h[:, :, :, None] * np.conj(h[:, :, None, :])
    return powers_of(ways, shapes_of(cells.f, corners), cells.power, cells.lines)


def powers_of(
    ways: Complex[np.ndarray, "c n p p"],
    shapes: Float[np.ndarray, "b1 c"],
    power: Complex[np.ndarray, "c p p"],
    lines: Float[np.ndarray, " c"],
) -> tuple[Float[np.ndarray, "n b1"], Float[np.ndarray, " p"]]:
    """Powers of gusts, by state and shape, and of the outputs' own white noise, that are the most
    likely for complex normal errors.

    Args:
        ways: by cell and state what a gust of power 1 at the state makes of the outputs.
        shapes: spectra that a gust's is a sum of; the first is white.
        power: by cell the mean of e e^H.
        lines: in each cell.
    """
    own, gains = (np.real(np.einsum("...ii->...i", v)) for v in (power, ways))
    gains = np.swapaxes(gains, 1, 2)
    # To begin with as much as the output that shows least of a state leaves room for.
    room = np.median(np.min(own[:, :, None] / np.maximum(gains, 1e-300), axis=1), axis=0)
    room = np.where(np.max(gains, axis=(0, 1)) > 0, room, 0.0)
    c, n, p, _ = ways.shape
    # An output's own noise comes by a way that leads to it alone, and is white: the first shape.
    powers = np.zeros((len(shapes), n + p))
    powers[:, :n], least = room / len(shapes), np.zeros_like(powers)
    powers[0, n:], least[0, n:] = np.maximum(0.3 * np.median(own, axis=0), _NOTHING), _NOTHING
    alone = np.eye(p)[:, :, None] * np.eye(p)[:, None, :]
    ways = np.concatenate([ways, np.broadcast_to(alone, (c, p, p, p))], axis=1)
    by_shape, told = shapes * lines, (_told_by_one if p == 1 else _told_by_several)(ways, power)
    # With a quarter of them a peak of gusts stayed at the flybar's mode where there were none, and
    # a third more in the interval of If.
    for _ in range(_STEPS):
        # Without the root that would make sure that each step gains: half as many are enough.
        of_ways = (by_shape @ told(shapes.T @ powers)).reshape(-1, 2, n + p)
        shown, due = of_ways[:, 0], of_ways[:, 1]
        powers = np.maximum(powers * (shown / np.where(due > 0, due, 1.0)), least)
    return powers[:, :n].T, powers[0, n:]


_Told = Callable[[Float[np.ndarray, "c m"]], Float[np.ndarray, "c 2m"]]
"""by cell and way what of it the errors show, and what they should, of the ways' powers"""


def _told_by_several(
    ways: Complex[np.ndarray, "c m p p"], power: Complex[np.ndarray, "c p p"]
) -> _Told:
    # By cell and way its numbers in a row: sums over ways, and what of a matrix comes by each, are
    # then products of real matrices.
    c, m, p, _ = ways.shape
    ways = np.ascontiguousarray(ways.reshape(c, m, -1), complex).view(float)
    by_way, matrices = np.swapaxes(ways, 1, 2).copy(), np.empty((c, 2, p, p), complex)

    def told(powers: Float[np.ndarray, "c m"]) -> Float[np.ndarray, "c 2m"]:
        inverse = np.linalg.inv((powers[:, None, :] @ ways).view(complex).reshape(c, p, p))
        matrices[:, 0], matrices[:, 1] = inverse @ power @ inverse, inverse
        return (matrices.view(float).reshape(c, 2, -1) @ by_way).reshape(c, -1)

    return told


def _told_by_one(
    ways: Complex[np.ndarray, "c m 1 1"], power: Complex[np.ndarray, "c 1 1"]
) -> _Told:
    # Of one output they are numbers, and real ones.
    ways, power = np.real(ways[:, :, 0, 0]), np.real(power[:, :, 0])

    def told(powers: Float[np.ndarray, "c m"]) -> Float[np.ndarray, "c 2m"]:
        over = 1.0 / np.sum(powers * ways, axis=1, keepdims=True)
        of_ways = ways * over
        return np.concatenate([of_ways * (power * over), of_ways], axis=1)

    return told
