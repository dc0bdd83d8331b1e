r"""Spectra of errors that a slow, hardly damped mode makes: smoothed without its peak.

Gusts that move such a mode (the phugoid of a hover) leave a peak in the errors of a few lines.
Smoothed over more lines than it is wide it is far too low, and lines at which gusts are largest
would count for much more than they tell: estimates of the derivatives that make the mode were then
60 stated standard deviations off. Lines are divided by the peaks of the model's modes before they
are smoothed, and multiplied by them behind (Blackman and Tukey's prewhitening).

Sources: Blackman and Tukey, The Measurement of Power Spectra (1958); Priestley, Spectral Analysis
and Time Series (1981), chapter 7.
"""

from collections.abc import Sequence

import equinox as eqx
import numpy as np
from jaxtyping import Array, Complex, Float

from heli_jax.dynamics.jacobians import jacobians
from heli_jax.identification.estimation.frequency_records import Record, records_of
from heli_jax.identification.estimation.frequency_spectrum import LEAST, PART, smoothed
from heli_jax.identification.estimation.linearised_flights import linear_drive
from heli_jax.identification.estimation.simulated_flights import driven
from heli_jax.identification.unknowns.layout import Data, Layout, unpack


def smoothed_beside_modes(
    layout: Layout, data: Data, z: Float[Array, " q"], errors: Sequence[Complex[np.ndarray, "K p"]]
) -> list[Complex[np.ndarray, "K p p"]]:
    """By record the spectrum of its errors, smoothed over frequency and records.

    Args:
        layout: what the unknowns are.
        data: the numbers of the problem.
        z: the unknowns, of which the modes are those of the model.
        errors: by record at its own frequencies, its ends taken off.
    """
    plain, records = smoothed(errors), records_of(layout)
    matrices = [np.asarray(A) for A in _state_matrices(layout, data, z)]
    if not all(np.isfinite(A).all() for A in matrices):
        return plain
    peaks = [
        peaks_of(np.linalg.eigvals(matrices[r.flight]), r, layout.of_flights[r.flight].dt)
        for r in records
    ]
    if all(np.all(peak == 1.0) for peak in peaks):
        return plain
    flat = smoothed([e / np.sqrt(peak)[:, None] for e, peak in zip(errors, peaks, strict=True)])
    shaped = [S * peak[:, None, None] for S, peak in zip(flat, peaks, strict=True)]
    # An output that hardly shows the mode beside its measurement noise has no such peak.
    better = [a < b for a, b in zip(_misfit(shaped, errors), _misfit(plain, errors), strict=True)]
    if all(better) or not any(better):
        return shaped if all(better) else plain
    scales = [np.where(better, np.sqrt(peak)[:, None], 1.0) for peak in peaks]
    flat = smoothed([e / scale for e, scale in zip(errors, scales, strict=True)])
    pairs = zip(flat, scales, strict=True)
    return [S * scale[:, :, None] * scale[:, None, :] for S, scale in pairs]


def peaks_of(rates: Complex[np.ndarray, " n"], record: Record, dt: float) -> Float[np.ndarray, "K"]:
    """The power of the modes that decay or grow too slowly for the smoothing, beside what modes as
    wide as it would have; 1 far away from them.

    Args:
        rates: eigenvalues [1/s].
        record: with its lines.
        dt: [s].
    """
    spacing = 2.0 * np.pi / (record.samples * dt)
    s = 1j * spacing * np.arange(1, record.lines + 1)
    peak = np.ones(record.lines)
    for rate in rates:
        at = abs(rate.imag)
        width = max(LEAST * spacing, PART * at)
        # One at zero frequency has its peak below the first line.
        if abs(rate.real) >= width or not 0.0 < at < spacing * record.lines:
            continue
        # No peak is narrower than the record resolves.
        own = np.abs(s - rate) ** 2 + (0.5 * spacing) ** 2
        peak = peak * (np.abs(s - (-width + 1j * rate.imag)) ** 2 / own)
    return peak


def _misfit(
    spectra: Sequence[Complex[np.ndarray, "K p p"]], errors: Sequence[Complex[np.ndarray, "K p"]]
) -> Float[np.ndarray, " p"]:
    """By output minus the log-likelihood of its errors by themselves (Whittle, 1953)."""
    total = np.zeros(errors[0].shape[1])
    for S, e in zip(spectra, errors, strict=True):
        power = np.real(np.einsum("kii->ki", S))
        total = total + np.sum(np.log(power) + np.abs(e) ** 2 / power, axis=0)
    return total


@eqx.filter_jit
def _state_matrices(layout: Layout, data: Data, z: Float[Array, " q"]) -> list[Float[Array, "n n"]]:
    u, made = unpack(layout, data, z), []
    for i in range(len(data.flights)):
        condition = layout.of_flights[i].condition
        model, drive, _ = linear_drive(layout, driven(layout, data, u, i), condition)
        made.append(jacobians(model, drive.params)[0])
    return made
