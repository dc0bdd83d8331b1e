"""Which estimates by instrument are not to be trusted: the excitation is weak where they show.

An input follows its excitation only where that has power. Elsewhere the estimate leans on what
chance makes of the coherence of both, and its interval with it: the more so of derivatives of the
speed, which show in a slow mode below the lowest frequency of a sweep.

Sources: Cragg and Donald (1993) for several inputs together: the least of their canonical
correlations with the instruments; Stock and Yogo (2005) for the limit of F.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from heli_jax import naming
from heli_jax.identification.estimation.frequency_instrument import PART, STRONG, strengths
from heli_jax.identification.estimation.frequency_records import records_of
from heli_jax.identification.estimation.frequency_spectrum import LEAST, smoothed
from heli_jax.identification.unknowns.layout import Solution
from heli_jax.identification.validation.closed_loop_trust import information

_MOST = 0.25
"""part of what is known of a parameter that may come of frequencies at which an instrument is
weak"""


def weak_by_instrument(at: Solution) -> tuple[str, ...]:
    """The unknowns of interest of which instruments tell too little; () of a fit without any.

    Args:
        at: where the fit ended.
    """
    layout, data, noise, _ = at
    if not layout.estimator.by_instrument or data.flights[0].by_instrument is None:
        return ()
    followed, F = _followed(at)
    direct = at._replace(noise=noise._replace(by_instrument=np.zeros(())))
    told = information(direct, followed)
    weak = information(direct, [g * (f < STRONG) for g, f in zip(followed, F, strict=True)])
    sd = np.sqrt(np.maximum(np.diagonal(told), 1e-300))
    covariance = np.linalg.pinv(told / np.outer(sd, sd), rcond=1e-12, hermitian=True)
    part = np.diagonal(covariance @ (weak / np.outer(sd, sd)) @ covariance)
    with np.errstate(all="ignore"):
        shares = np.nan_to_num(part / np.diagonal(covariance), nan=1.0)
    of_all = strengths(at)
    return tuple(
        name
        for name, share in zip(layout.of_interest, shares, strict=True)
        if share > _MOST or of_all[name].F < STRONG
    )


def weak_note(names: Sequence[str]) -> list[str]:
    """What a fit says of them.

    Args:
        names: of `weak_by_instrument`.
    """
    if not names:
        return []
    return [
        f"Weak instrument: {', '.join(names)} show at frequencies at which the inputs hardly "
        f"follow the excitation (F below {STRONG:g}, all inputs together). They may be off by "
        "many of their standard deviations and are not to be trusted. Remedy: a sweep that begins "
        "at lower frequencies or is stronger there, or longer records."
    ]


def _followed(at: Solution) -> tuple[list[Float[np.ndarray, " K"]], list[Float[np.ndarray, " K"]]]:
    """By record and line the least canonical correlation of the inputs with their instruments,
    squared, and its F."""
    layout, data, *_ = at
    first = data.flights[0]
    names = [
        n
        for n, u in naming.asdict(first.inputs).items()
        if np.any(np.asarray(u) != np.asarray(getattr(first.by_instrument, n)))
    ]
    lines, records = [], records_of(layout)
    for record in records:
        flight = data.flights[record.flight]
        both = [getattr(v, n) for v in (flight.inputs, flight.by_instrument) for n in names]
        v = np.stack([np.asarray(x)[record.first : record.last] for x in both], axis=1)
        v = np.fft.rfft(v - v.mean(axis=0), axis=0)[1 : 1 + record.lines]
        lines.append(v / np.sqrt(record.samples))
    m, followed, F = len(names), [], []
    for S in smoothed(lines, PART):
        size = np.sqrt(np.real(np.einsum("kii->ki", S[:, :m, :m])))
        size = np.where(size > 0, size, 1.0)
        over = 1.0 / (size[:, :, None] * size[:, None, :])
        whole, part = S[:, :m, :m] * over, S[:, m:, m:] * over
        values = np.linalg.eigvals(np.linalg.solve(whole + 1e-12 * np.eye(m), part))
        least = np.clip(np.min(np.real(values), axis=1), 0.0, 1.0 - 1e-12)
        width = np.maximum(LEAST, PART * np.arange(1, len(S) + 1))
        n = 2.0 * np.pi**0.5 * width * len(records)
        # What chance makes of it is no information.
        followed.append(np.maximum(least - m / n, 1e-6))
        F.append((n / m) * least / (1.0 - least))
    return followed, F
