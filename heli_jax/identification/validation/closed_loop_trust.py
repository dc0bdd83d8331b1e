r"""Which estimates feedback may have moved, where nobody logged an excitation.

Feedback brings what disturbs the machine into its inputs, so that the response to them is coherent
with the residual, most of all at the frequencies at which the loop holds the machine. Let
$\gamma^2$ be that part of the response's power, beyond chance. Directly the response is off by it
as if errors of the residual's size went with the input: over the $n$ frequencies within which a
spectrum is one average, an estimate moves by about $\sqrt{n \gamma^2}$ of its standard deviations,
$\gamma^2$ being the mean over the frequencies that tell of it, by what they tell.

The residual of a fit shows less than all of it, since the model follows its inputs where it can:
what is said here is at least so.

Source: L. Ljung, System Identification (1999), 13.4, for the direct estimate's bias; Bendat and
Piersol, Random Data (2010), chapter 7, for multiple coherence and what of it is chance.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from heli_jax.identification.estimation.evaluation import evaluate
from heli_jax.identification.estimation.frequency_lines import errors_of_lines
from heli_jax.identification.estimation.frequency_records import records_of
from heli_jax.identification.estimation.frequency_spectrum import LEAST, smoothed
from heli_jax.identification.unknowns.layout import Data, Layout, Noise, Solution
from heli_jax.identification.validation.feedback import Feedback

TRUSTED = 1.4
"""stated standard deviations by which feedback may have moved an estimate that is trusted: its
interval then covers two thirds of the time"""
_PART = 0.05
"""sd of the Gaussian that smooths the spectra, as a part of the frequency"""


def moved_by_feedback(at: Solution, found: Sequence[Feedback]) -> dict[str, float]:
    """By unknown of interest the standard deviations by which feedback may have moved it; empty
    where no loop is closed, the method knows no frequencies, or inputs are taken by instrument.

    Args:
        at: where the fit ended.
        found: whether inputs follow the response.
    """
    layout, data, *_ = at
    if not layout.estimator.by_instrument or data.flights[0].by_instrument is not None:
        return {}
    if not any(one.present for one in found):
        return {}
    shares, chances, n = _coherent_with_residual(at)
    ones = [np.ones(len(v)) for v in shares]
    told, coherent, by_chance = (_information(at, w) for w in (ones, shares, chances))
    sd = np.sqrt(np.diagonal(told))
    # A parameter that is not determined has no standard deviation to be moved by.
    covariance = np.linalg.pinv(told / np.outer(sd, sd), rcond=1e-12, hermitian=True)
    beyond = covariance @ ((coherent - by_chance) / np.outer(sd, sd)) @ covariance
    with np.errstate(all="ignore"):
        part = np.nan_to_num(np.diagonal(beyond) / np.diagonal(covariance))
    moved = np.sqrt(n * np.clip(part, 0.0, 1.0))
    return dict(zip(layout.of_interest, moved.tolist(), strict=True))


def _coherent_with_residual(at: Solution) -> tuple[list[np.ndarray], list[np.ndarray], float]:
    """By record and frequency the part of the model's response that is coherent with the residual,
    what of it is chance, and the lines of all records in one average at the lowest frequencies."""
    layout, data, noise, z = at
    errors = [np.asarray(e) for e in errors_of_lines(layout, data, noise, z)]
    pairs = []
    for W, e, y in zip(noise.whitening, errors, _measured(layout, data), strict=True):
        white = [np.einsum("kij,kj->ki", np.asarray(W), v) for v in (y - e, e)]
        pairs.append(np.concatenate(white, axis=1))
    p, per_line = errors[0].shape[1], 2.0 * np.pi**0.5
    shares, chances = [], []
    for S in smoothed(pairs, _PART):
        crossed = S[:, p:, :p]
        explained = np.einsum(
            "kia,kia->k", np.conj(crossed), np.linalg.solve(S[:, p:, p:], crossed)
        )
        shares.append(np.real(explained / np.einsum("kii->k", S[:, :p, :p])))
        width = np.maximum(LEAST, _PART * np.arange(1, len(S) + 1))
        chances.append(np.minimum(p / (per_line * width * len(errors)), 1.0))
    return shares, chances, per_line * LEAST * len(errors)


def _measured(layout: Layout, data: Data) -> list[np.ndarray]:
    """By record the lines (K, p) of what was measured."""
    made = []
    for record in records_of(layout):
        outputs = data.flights[record.flight].outputs
        names = layout.outputs[record.flight]
        y = np.stack([np.asarray(outputs[n])[record.first : record.last] for n in names], axis=1)
        lines = np.fft.rfft(y - y.mean(axis=0), axis=0) / np.sqrt(len(y))
        made.append(lines[1 : 1 + record.lines])
    return made


def _information(
    at: Solution, weights: Sequence[Float[np.ndarray, " K"]]
) -> Float[np.ndarray, "q q"]:
    """Of the unknowns of interest, each frequency by its weight."""
    layout, data, noise, z = at
    weighed: Noise = noise._replace(
        whitening=tuple(
            np.asarray(W) * np.sqrt(w)[:, None, None]
            for W, w in zip(noise.whitening, weights, strict=True)
        )
    )
    # The program of the fit, with other weights; the priors' rows are no information of these.
    q = len(layout.of_interest)
    J = np.asarray(evaluate(layout, data, weighed, z).J)[:q, :q]
    return J.T @ J


def feedback_trust_notes(moved: dict[str, float]) -> list[str]:
    """Which parameters a fit in closed loop cannot be trusted on, in words; nothing where no loop
    was found.

    Args:
        moved: of `moved_by_feedback`.
    """
    if not moved:
        return []
    doubted = {n: v for n, v in moved.items() if v > TRUSTED}
    if not doubted:
        return [
            "Closed loop without an instrument: what of the response is coherent with the residual "
            f"moves no estimate by {TRUSTED:g} of its standard deviations."
        ]
    words = ", ".join(f"{n} ({v:.1f})" for n, v in doubted.items())
    rest = [n for n in moved if n not in doubted]
    return [
        f"Closed loop without an instrument: this fit cannot be trusted on {', '.join(doubted)}. "
        "At the frequencies that tell of them the response is coherent with the residual, as "
        "feedback makes it, and they may be off by at least so many of their standard deviations: "
        f"{words}. "
        + (f"{', '.join(rest)} are hardly touched. " if rest else "")
        + "Remedy: log the excitation and name it (signals.instruments), or method: filter-error "
        "with a disturbance."
    ]
