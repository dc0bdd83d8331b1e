"""Responses of several windows together, as CIFER's composite lays them: for looking alone."""

from collections.abc import Sequence

import numpy as np

from heli_jax.analysis.spectral import (
    OVERLAP,
    CrossSpectra,
    combined,
    cross_spectra,
    responses,
    weights_by_output,
)

_LENGTHS = (0.25, 0.5, 1.0, 1.5, 2.0)
"""of the windows of a composite, in that one's length"""


def several_windows(
    records: Sequence[np.ndarray], dt: float, one: CrossSpectra, window: float, m: int
) -> list[CrossSpectra]:
    """Spectra of several windows beside those of one, as far as the records have three of each.

    Args:
        records: signals (c, N) of each part.
        dt: between two samples [s].
        one: those of one window.
        window: its length [s].
        m: how many of the signals are inputs.
    """
    longest = max(r.shape[1] for r in records) * dt
    several: list[CrossSpectra] = []
    for length in _LENGTHS:
        # Three windows are the least that a coherence can be taken from.
        if not 2.0 * length * window <= longest or length * window < 16.0 * dt:
            continue
        own = length == 1.0
        spectra = one if own else cross_spectra(records, dt, one.omega, length * window, OVERLAP)
        if np.min(spectra.averages) >= m + 1:
            several.append(spectra)
    return several


def pictures_of(
    several: list[CrossSpectra],
    omega: np.ndarray,
    which: tuple[list[int], list[int], list[int] | None],
) -> np.ndarray:
    """H (k, l, m) of several windows together; NaN where the record has no two of them.

    Args:
        several: spectra of each.
        omega: (k,) [rad/s]
        which: places of the m inputs, of the l outputs and of the instruments.
    """
    u, outputs, by = which
    made = np.full((omega.size, len(outputs), len(u)), np.nan, complex)
    if len(several) < 2:
        return made
    weights = weights_by_output(several, u, outputs)
    for i, y in enumerate(outputs):
        # Without the other outputs, of which each has its own weights.
        kept = [*dict.fromkeys([*u, *(by or u)]), y]
        place = {signal: j for j, signal in enumerate(kept)}
        own = [s._replace(S=s.S[:, kept][:, :, kept]) for s in several]
        us, zs = [place[k] for k in u], None if by is None else [place[k] for k in by]
        both = combined(own, weights[:, :, i])
        made[:, i] = responses(both, us, [place[y]], zs).H[:, 0]
    return made
