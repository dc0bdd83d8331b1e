"""Errors of responses by instrument, which are ratios of two numbers with errors of their own.

With w_j the combination of the instruments that goes with input j alone, H_j = S_wy over S_wu, and
a response H' agrees with the record where |S_we| of y - H' u is within its interval,

    |H' - H|^2 <= c (S_ee - 2 Re(conj(H' - H) S_ue) + |H' - H|^2 S_vv),  c = t^2 S_ww / (2 n),

t being Student's (1.96 of many averages) and v what of the input no instrument explains. That is a
disc. Where the excitation is weak beside v it is larger than the first-order error and lies to one
side, and where c S_vv reaches 1 it has no end: nothing is known of the response.

Source: Fieller (1954); Anderson and Rubin (1949) for instruments.
"""

import numpy as np
from jaxtyping import Complex, Float

from heli_jax.analysis.noise_over_lines import Z95
from heli_jax.analysis.response_curves import octave_mean

_STRONG = 0.25
"""of c S_vv in the mean over an octave, up to which an instrument is strong enough: F of 7.7"""


def sd_of_ratio(
    omega: Float[np.ndarray, " k"],
    S: Complex[np.ndarray, "k c c"],
    signals: tuple[list[int], list[int], list[int]],
    H: Complex[np.ndarray, "k l m"],
    left: Float[np.ndarray, "k l"],
    spread: Float[np.ndarray, "k m"],
    half95: Float[np.ndarray, "k 1"],
) -> Float[np.ndarray, "k l m"]:
    """Standard deviations of real and imaginary part whose 95 % intervals hold Fieller's discs;
    NaN where these have no end.

    Args:
        omega: frequencies [rad/s].
        signals: places of the inputs, of the outputs and of the instruments.
        left: density of what they leave.
        spread: density of w_j over the averages.
        half95: half of a 95 % interval in standard deviations.
    """
    u, y, z = signals
    zz, zu = S[:, z][:, :, z], S[:, z][:, :, u]
    with np.errstate(all="ignore"):
        explained = np.real(
            np.einsum("kzj,kzj->kj", np.conj(zu), np.linalg.pinv(zz, rcond=1e-12) @ zu)
        )
        own = np.maximum(np.real(S[:, u, u]) - explained, 0.0)
        # Of y - H u with each input.
        crossed = S[:, u][:, :, y] - np.einsum("kja,kla->kjl", S[:, u][:, :, u], H)
        c = 0.5 * half95**2 * spread
        # An input that is its own instrument has nothing of its own, but for rounding.
        direct = np.array([a == b for a, b in zip(u, z, strict=True)])
        room = np.where(direct, 1.0, 1.0 - c * own)[:, None, :]
        aside = np.where(direct, 0.0, np.abs(np.swapaxes(crossed, 1, 2)) * c[:, None, :]) / room
        reach = aside + np.sqrt(c[:, None, :] * left[:, :, None] / room + aside**2)
        # Among weak ones a single frequency is strong by chance, and has the wrong response by the
        # same chance: the octave around it has to be strong as well.
        share = explained / np.maximum(explained + own, 1e-300)
        around = np.stack([octave_mean(omega, v) for v in share.T], axis=1)
        # c S_vv again, with the octave's share of the input that instruments explain.
        likely = 0.5 * Z95**2 * spread
        strong = direct | (likely * explained * (1.0 - around) < _STRONG * around)
        return np.where((room > 0) & strong[:, None, :], reach / half95[:, None], np.nan)
