"""What windows do to a response: they look at a part of a record, and see inputs whose answers lie
outside of it and answers whose inputs do.

Of noise this makes a random error; of a sweep, which visits each frequency once, one that no
average takes away. It is that of a model's response as well, which is known before and behind the
windows.

Source: Pintelon and Schoukens (2012), chapter 6, for the errors of windows.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float

from heli_jax.analysis.spectral import OVERLAP, cross_spectra, responses
from heli_jax.analysis.transfer_fit import Hold, TransferFit

_BLOCK = 4096
"""frequencies at a time, each with its images"""


class Windows(NamedTuple):
    """How responses were taken."""

    records: Sequence[Float[np.ndarray, "c N"]]
    """inputs, instruments and outputs of each part of a flight"""
    inputs: Sequence[int]
    """their places among the signals"""
    instruments: Sequence[int] | None
    """as many; None without"""
    omega: Float[np.ndarray, " k"]
    """[rad/s]"""
    seconds: float
    """length of a window"""


def forgets(fitted: TransferFit, seconds: float) -> bool:
    """Whether a transfer function forgets within a window, so that what it does is known from the
    record: its slowest mode falls to 1/e.

    Args:
        seconds: length of a window.
    """
    poles = fitted.poles
    return bool(np.isfinite(poles).all() and np.all(np.real(poles) * seconds < -1.0))


def window_error(
    fitted: TransferFit, windows: Windows, input: int, hold: Hold
) -> Complex[np.ndarray, " k"] | None:
    """What windows add to the response of a transfer function; None where it does not forget within
    a window, so that what it does is not known from the record.

    Args:
        windows: how the response was taken.
        input: the place of its input among the inputs.
        hold: what that does between samples.
    """
    if not forgets(fitted, windows.seconds):
        return None
    kept = sorted({*windows.inputs, *(windows.instruments or ())})
    place = {i: j for j, i in enumerate(kept)}
    records = [
        np.concatenate([r[kept], _answer(fitted, r[windows.inputs[input]], hold)[None]])
        for r in windows.records
    ]
    spectra = cross_spectra(records, hold.dt, windows.omega, windows.seconds, OVERLAP)
    by = None if windows.instruments is None else [place[i] for i in windows.instruments]
    estimate = responses(spectra, [place[i] for i in windows.inputs], [len(kept)], by)
    return estimate.H[:, 0, input] - fitted.sampled(windows.omega, hold)


def _answer(fitted: TransferFit, u: Float[np.ndarray, " N"], hold: Hold) -> Float[np.ndarray, " N"]:
    """A transfer function's output (N,), from rest at the first value of its input."""
    # Padded, or the end of the record would wrap round onto its beginning.
    size = 2 * u.size
    lines = np.fft.rfft(u - u[0], size)
    omega = 2.0 * np.pi * np.arange(1, lines.size) / (size * hold.dt)
    blocks = (omega[i : i + _BLOCK] for i in range(0, omega.size, _BLOCK))
    H = np.concatenate([fitted.response(np.zeros(1)), *(fitted.sampled(w, hold) for w in blocks)])
    return np.fft.irfft(lines * H, size)[: u.size]
