"""Which estimates by instrument are not to be trusted: the excitation is weak where they show.

An input follows its excitation only where that has power. Elsewhere the estimate leans on what
chance makes of the coherence of both, and its interval with it: the more so of derivatives of the
speed, which show in a slow mode below the lowest frequency of a sweep.

Sources: Cragg and Donald (1993) for several inputs together: the least of their canonical
correlations with the instruments; Stock and Yogo (2005) for the limit of F.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from heli_jax import naming
from heli_jax.finding import Finding
from heli_jax.identification.estimation.frequency_instrument import (
    PART,
    STRONG,
    instrumented_inputs,
    instruments_of,
    strengths,
)
from heli_jax.identification.estimation.frequency_records import lines_of, records_of
from heli_jax.identification.estimation.frequency_spectrum import LEAST, smoothed
from heli_jax.identification.problem import Problem
from heli_jax.identification.unknowns.layout import Solution
from heli_jax.identification.validation.closed_loop_trust import (
    information,
    information_by_line,
    mean_share,
)

_MOST = 0.25
"""part of what is known of a parameter that may come of frequencies at which an instrument is
weak"""


def weak_by_instrument(
    problem: Problem, at: Solution, J: Float[np.ndarray, "n q"]
) -> tuple[str, ...]:
    """The unknowns of interest of which instruments tell too little; () of a fit without any.

    Args:
        problem: with flights and instruments.
        at: where the fit ended.
        J: the whitened rows' derivative there.
    """
    layout = at.layout
    if not layout.estimator.by_instrument or not instruments_of(problem):
        return ()
    if layout.estimator.fits_responses:
        shares = _of_responses(problem, at)
        return tuple(n for n, s in zip(layout.of_interest, shares, strict=True) if s > _MOST)
    if at.data.flights[0].by_instrument is None:
        return ()
    shares, of_all = _of_lines(at), strengths(at, J)
    return tuple(
        name
        for name, share in zip(layout.of_interest, shares, strict=True)
        if share > _MOST or of_all[name].F < STRONG
    )


def _of_lines(at: Solution) -> Float[np.ndarray, " q"]:
    """By unknown the part that is known of frequencies at which an instrument is weak."""
    layout, data, noise, _ = at
    records = records_of(layout)
    signals = [
        (naming.asdict(flight.inputs), naming.asdict(flight.by_instrument))
        for flight in (data.flights[r.flight] for r in records)
    ]
    followed, F = _followed(signals, [(r.first, r.last) for r in records])
    direct = at._replace(noise=noise._replace(by_instrument=np.zeros(())))
    weak = [g * (f < STRONG) for g, f in zip(followed, F, strict=True)]
    return mean_share(information(direct, followed))(information(direct, weak))


def _of_responses(problem: Problem, at: Solution) -> Float[np.ndarray, " q"]:
    """The same of fitted responses, by the lines of their windows."""
    flights, by_line = problem.training, information_by_line(at)
    by = instrumented_inputs(problem, flights)
    if by is None:
        return np.zeros(by_line.shape[1])
    signals = [(f.inputs, b) for f, b in zip(flights, by, strict=True)]
    F = _followed(signals, [(0, f.n_samples) for f in flights])[1][0]
    hz = np.arange(1, len(F) + 1) / (flights[0].n_samples * flights[0].dt)
    weak = np.interp(at.noise.whitening.windows.hz, hz, F) < STRONG
    return mean_share(by_line.sum(axis=0))(by_line[weak].sum(axis=0))


def weak_note(names: Sequence[str]) -> list[Finding]:
    """What a fit says of them.

    Args:
        names: of `weak_by_instrument`.
    """
    if not names:
        return []
    words = (
        f"Weak instrument: {', '.join(names)} show at frequencies at which the inputs hardly "
        f"follow the excitation (F below {STRONG:g}, all inputs together). They may be off by "
        "many of their standard deviations. Fly a sweep that begins at lower frequencies or is "
        "stronger there, or longer records."
    )
    brief, names = "weak instrument", tuple(names)
    return [
        Finding(
            "loop.weak-instrument", "doubt", words, None, "", names, brief=brief, distrusts=names
        )
    ]


def _followed(
    signals: Sequence[tuple[Mapping[str, Any], Mapping[str, Any]]],
    spans: Sequence[tuple[int, int]],
) -> tuple[list[Float[np.ndarray, " K"]], list[Float[np.ndarray, " K"]]]:
    """By record and line the least canonical correlation of the inputs with their instruments,
    squared, and its F.

    Args:
        signals: by record its flight's inputs, and what of them follows the instruments (N,).
        spans: first sample of each record, and that behind the last.
    """
    first = signals[0]
    names = [n for n, u in first[0].items() if np.any(np.asarray(u) != np.asarray(first[1][n]))]
    lines = []
    for pair, (begin, end) in zip(signals, spans, strict=True):
        v = np.stack([np.asarray(x[n])[begin:end] for x in pair for n in names], axis=1)
        lines.append(lines_of(v))
    m, followed, F = len(names), [], []
    for S in smoothed(lines, PART):
        size = np.sqrt(np.real(np.einsum("kii->ki", S[:, :m, :m])))
        size = np.where(size > 0, size, 1.0)
        over = 1.0 / (size[:, :, None] * size[:, None, :])
        whole, part = S[:, :m, :m] * over, S[:, m:, m:] * over
        values = np.linalg.eigvals(np.linalg.solve(whole + 1e-12 * np.eye(m), part))
        least = np.clip(np.min(np.real(values), axis=1), 0.0, 1.0 - 1e-12)
        width = np.maximum(LEAST, PART * np.arange(1, len(S) + 1))
        n = 2.0 * np.pi**0.5 * width * len(lines)
        # What chance makes of it is no information.
        followed.append(np.maximum(least - m / n, 1e-6))
        F.append((n / m) * least / (1.0 - least))
    return followed, F
