r"""What the machine makes of gusts, as windows show it: a shape for the noise of responses.

The noise's spectrum in windows is a mean over few of their lines. Gusts come through the machine's
own modes, which are no wider than that: the mean makes a wide and low hill of a mode, and what the
record tells of the mode is weighed by too much noise beside it and too little at it. So

$$S_0 = \sum_i q_i \int |W|^2 h_i h_i^H + R, \qquad [h_1 \ldots h_n] = C (zI - A_d)^{-1}$$

is found first, as in `frequency_gusts` but through the windows' own transform W, and the mean is
taken of what is left where it is divided by that.

Sources: Blackman and Tukey (1958) for prewhitening.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from heli_jax import naming
from heli_jax.analysis.windowed import Windowed, hann
from heli_jax.dynamics.jacobians import jacobians
from heli_jax.identification.estimation.frequency_gusts import corners_of, powers_of, shapes_of
from heli_jax.identification.estimation.linear_machine import machine_of
from heli_jax.identification.estimation.simulated_flights import driven
from heli_jax.identification.unknowns.layout import Data, Layout, unpack

_APART = 0.04
"""part of the frequency within which lines are taken together"""
_UNSEEN = 1e-20
"""part of the largest power of a state's effect below which outputs do not show one"""
_OFFSETS = np.arange(-1.875, 2.0, 0.25)
"""from a line to the frequencies that a window brings to it, in lines: its main lobe. None of them
is zero, where integrations have no finite response"""


Described = Callable[[np.ndarray, list[int]], np.ndarray | None]
"""of raw spectral matrices (k, q, q) of some outputs, by their place in the windows, what the
machine makes of gusts, and white noise: (k, q, q), or None where that says nothing"""


def gusts_through(layout: Layout, data: Data, z: Float[Array, " q"], w: Windowed) -> Described:
    """The shape that the first flight's machine gives to the noise.

    Args:
        layout: what the unknowns are.
        data: the numbers of the problem.
        z: the unknowns.
        w: the flights in windows.
    """
    Ad, C = (np.asarray(v, float) for v in _matrices(layout, data, z))
    rows = [naming.names(layout.model.Outputs).index(n) for n in w.outputs]
    return described(Ad, C[rows], w)


@eqx.filter_jit
def _matrices(
    layout: Layout, data: Data, z: Float[Array, " q"]
) -> tuple[Float[Array, "n n"], Float[Array, "p n"]]:
    """Ad from sample to sample, and C of all outputs of the model."""
    u = unpack(layout, data, z)
    C = jacobians(layout.model, driven(layout, data, u, 0).params)[2]
    return machine_of(layout, data, u, 0).Ad, jnp.asarray(C)


class _Cells(NamedTuple):
    """Lines that are taken together."""

    first: np.ndarray
    """(c,) index of the first of each"""
    lines: np.ndarray
    """(c,) how many"""
    at: np.ndarray
    """(c,) their mean, in periods of a window"""


def described(Ad: Float[np.ndarray, "n n"], C: Float[np.ndarray, "p n"], w: Windowed) -> Described:
    """The shape that a machine gives to the noise.

    Args:
        Ad: from sample to sample.
        C: of the outputs in windows.
        w: the flights in windows.
    """
    cells = _cells(w.lines)
    # A line on a mode that does not decay has no finite response.
    with np.errstate(all="ignore"):
        ways = ways_of(Ad, C, cells.at, w.length)

    def of(raw: Complex[np.ndarray, "k q q"], outputs: list[int]) -> np.ndarray | None:
        size = np.sqrt(np.mean(np.real(np.einsum("kii->ki", raw)), axis=0))
        if not (np.isfinite(size).all() and (size > 0).all()):
            return None
        scale = size[:, None] * size[None, :]
        seen = ways[:, :, outputs][:, :, :, outputs] / scale
        fine = np.isfinite(seen).all((1, 2, 3))
        if not fine.any():
            return None
        # What rounding leaves of a state that no output shows would pass for a huge gust's way.
        effects = np.max(np.real(np.einsum("cnii->cni", seen[fine])), axis=(0, 2))
        seen = seen * (effects > _UNSEEN * np.max(effects))[:, None, None]
        power = np.add.reduceat(raw / scale, cells.first, axis=0) / cells.lines[:, None, None]
        f = cells.at / w.length
        shapes = shapes_of(f, corners_of(f))
        with np.errstate(all="ignore"):
            q, r = powers_of(seen[fine], shapes[:, fine], power[fine], cells.lines[fine])
            S = np.einsum("nb,bc,cnij->cij", q, shapes[:, fine], seen[fine])
        S = (S + np.diag(r)) * scale
        return _between(S, cells.at[fine], w.lines) if np.isfinite(S).all() else None

    return of


def _cells(lines: np.ndarray) -> _Cells:
    """Each line by itself at first, then those within a part of the frequency."""
    first = [0]
    while (end := np.searchsorted(lines, lines[first[-1]] * (1.0 + _APART), "right")) < lines.size:
        first.append(int(end))
    counts = np.diff(np.append(first, lines.size)).astype(float)
    return _Cells(np.array(first), counts, np.add.reduceat(lines.astype(float), first) / counts)


def ways_of(
    Ad: Float[np.ndarray, "n n"],
    C: Float[np.ndarray, "p n"],
    lines: Float[np.ndarray, " c"],
    length: int,
) -> Complex[np.ndarray, "c n p p"]:
    """By line and state what windows show of the outputs in white gusts of power 1.

    Args:
        Ad: from sample to sample.
        C: of the outputs.
        lines: in periods of a window.
        length: of a window, in samples.
    """
    f = lines[:, None] + _OFFSETS
    z = np.exp(2j * np.pi * f / length)[:, :, None, None]
    H = np.swapaxes(C @ np.linalg.inv(z * np.eye(len(Ad)) - Ad), 2, 3)
    weights = _weights(lines, length)
    return np.einsum("co,conp,conq->cnpq", weights, H, np.conj(H), optimize=True)


def _weights(lines: Float[np.ndarray, " c"], length: int) -> Float[np.ndarray, "c o"]:
    """How much of the power at each offset windows bring to a line."""
    t, window = np.arange(length), hann(length)
    lobe = np.exp(2j * np.pi * np.outer(_OFFSETS, t) / length) @ window
    # What the mean of a window takes off is a part of the first line.
    constant = np.exp(2j * np.pi * np.outer(1.0 + _OFFSETS, t) / length).sum(axis=1)
    mean = np.mean(window * np.exp(-2j * np.pi * t / length))
    seen = np.where(lines[:, None] < 1.5, lobe - mean * constant, lobe)
    return np.abs(seen) ** 2 / np.sum(np.abs(lobe) ** 2)


def _between(
    S: Complex[np.ndarray, "c p p"], at: Float[np.ndarray, " c"], lines: np.ndarray
) -> Complex[np.ndarray, "k p p"]:
    """Straight lines from cell to cell."""
    low = np.clip(np.searchsorted(at, lines, side="right") - 1, 0, max(len(at) - 2, 0))
    high = np.minimum(low + 1, len(at) - 1)
    part = np.clip((lines - at[low]) / np.maximum(at[high] - at[low], 1e-300), 0.0, 1.0)
    return S[low] + part[:, None, None] * (S[high] - S[low])
