r"""Bias of estimates by feedback, if no excitation was logged.

Feedback brings the disturbances of the vehicle into its inputs. The direct response is then biased
by the share $\gamma^2$ of the input that comes from feedback. The record does not show that share,
but bounds it in two ways:

- Feedback of one output at a constant gain adds $|k|^2 S_{ee}$ to $S_{uu}$, at no frequency more
  than the input. The bound uses the largest such gain, averaged over the outputs, since the
  feedback path is unknown. A loop acts at low frequencies, where gusts dominate the residual.
- The loop that stabilises an unstable vehicle has a bandwidth of at least twice its unstable pole.
  Below that frequency the whole input may be feedback.

A parameter's share is the mean over frequency, weighted by the information on the parameter. It
does not prove a loop. Parameters are reported only if inputs follow the response, or if the model
is unstable. Inputs taken by instrument add nothing.

Sources: L. Ljung, System Identification (1999), 13.4, for the direct estimate's bias; Astrom and
Murray, Feedback Systems (2008), 11.4, for the bandwidth that an unstable pole requires.
"""

import functools
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from heli_jax import naming
from heli_jax.identification.estimation.frequency_instrument import (
    PART,
    STRONG,
    inputs_by_instrument,
    instrumented_inputs,
    instruments_of,
)
from heli_jax.identification.estimation.frequency_lines import errors_of_lines, lines_of, records_of
from heli_jax.identification.estimation.frequency_noise import (
    LEAST,
    once_a_length,
    smoothed,
)
from heli_jax.identification.estimation.frequency_response import errors_in_windows
from heli_jax.identification.estimation.levenberg_marquardt import residual_and_jacobian
from heli_jax.identification.problem import Problem
from heli_jax.identification.unknowns.layout import Noise, Solution

MAY_BE = 0.25
"""Share of a parameter's information that may be feedback, above which it is not trusted."""
BESIDE = 0.05
"""The same if other inputs are taken by instrument.

The effect of an input has at least this bias, in a fit that feedback should not affect."""
_REACHES = 2.0
"""Least bandwidth of the stabilising loop over the unstable pole.

With less bandwidth no feedback has margins (Astrom and Murray, 2008, section 11.4)."""
_SEEN = 2.0
"""Output power over the residual's, above which a frequency bounds the feedback gain."""
_PART = 0.05
"""Standard deviation of the Gaussian that smooths the spectra, as a share of the frequency."""


def moved_by_feedback(at: Solution, poles: Sequence[float]) -> dict[str, float]:
    """Return the share of information that may be feedback, 0 to 1, by unknown of interest.

    Empty in the time domain, and if every moving input is taken by instrument.

    Args:
        poles: the result of `unstable_poles`; zero for an estimate by instrument.
    """
    layout = at.layout
    if layout.noise_model != "spectrum":
        return {}
    responses = layout.objective.fits_responses
    parts = _room_of_responses(at) if responses else _room_of_records(at)
    if not parts:
        return {}
    if not responses:
        for i, record in enumerate(records_of(layout)):
            dt = float(at.data.flights[record.flight].dt)
            omega = 2.0 * np.pi * np.arange(1, record.lines + 1) / (record.samples * dt)
            parts[i] = np.where(omega <= _REACHES * poles[record.flight], 1.0, parts[i])
    whole = information(at, [np.ones_like(v) for v in parts])
    of_each = shares(information(at, parts), whole)
    return {n: float(v) for n, v in zip(layout.of_interest, of_each, strict=True)}


def _room_of_records(at: Solution) -> list[Float[np.ndarray, " K"]]:
    """Return by record and line the share of the inputs that may be feedback.

    Empty if all inputs are taken by instrument.
    """
    layout, data, noise, _ = at
    joint, inputs = [], list(naming.asdict(data.flights[0].inputs))
    for record in records_of(layout):
        flight, part = data.flights[record.flight], slice(record.first, record.last)
        outputs = [flight.outputs[n] for n in layout.outputs[record.flight]]
        signals = [*naming.asdict(flight.inputs).values(), *outputs]
        joint.append(lines_of(np.stack([np.asarray(v)[part] for v in signals], axis=1)))
    moving = np.sum([np.sum(np.abs(v[:, : len(inputs)]) ** 2, axis=0) for v in joint], axis=0) > 0
    by = inputs_by_instrument(data) if data.flights[0].by_instrument is not None else ()
    direct = np.array([n not in by for n, moves in zip(inputs, moving, strict=True) if moves])
    if not direct.any():
        return []
    kept = np.r_[moving, np.ones(joint[0].shape[1] - moving.size, bool)]
    W = [np.asarray(w) for w in noise.whitening]
    errors = jax.device_get(errors_of_lines(*at).errors)
    spectra = (W, smoothed([v[:, kept] for v in joint], _PART), smoothed(errors, _PART))
    return list(once_a_length(functools.partial(_room, direct=direct), *spectra))


def _room_of_responses(at: Solution) -> list[Float[np.ndarray, " k"]]:
    """Return this share for fitted responses, by line of their windows."""
    layout, data, noise, z = at
    w, density = noise.whitening.windows, np.asarray(noise.whitening.density)
    direct = np.array([n not in w.instruments for n in w.inputs])
    if not direct.any():
        return []
    E = np.asarray(errors_in_windows(layout, data, noise.whitening, z))
    joint = np.concatenate([np.asarray(w.U), np.asarray(w.Y)], axis=2)
    S, See = (np.einsum("wka,wkb->kab", v, np.conj(v)) / len(v) for v in (joint, E))
    return [_room(np.linalg.inv(np.linalg.cholesky(density)), S, See, direct)]


def shares(
    part: Float[np.ndarray, "q q"], whole: Float[np.ndarray, "q q"]
) -> Float[np.ndarray, " q"]:
    """Return each unknown's share of a part of the information, 0 to 1."""
    sd = np.sqrt(np.maximum(np.diagonal(whole), 1e-300))
    # A parameter that is not identifiable has no standard deviation.
    covariance = np.linalg.pinv(whole / np.outer(sd, sd), rcond=1e-12, hermitian=True)
    of_part = np.diagonal(covariance @ (part / np.outer(sd, sd)) @ covariance)
    with np.errstate(all="ignore"):
        return np.clip(np.nan_to_num(of_part / np.diagonal(covariance)), 0.0, 1.0)


def _room(
    W: np.ndarray, S: np.ndarray, See: np.ndarray, direct: np.ndarray
) -> Float[np.ndarray, " k"]:
    """Return by frequency the share of the input that feedback at a constant gain may add.

    Args:
        W: whitening (k, p, p).
        S: spectra (k, m + p, m + p) of inputs and outputs.
        See: spectra (k, p, p) of the residual.
        direct: (m,) True for inputs that are not taken by instrument.
    """
    m = S.shape[1] - See.shape[1]
    e, u = (np.real(np.einsum("kii->ki", v)) for v in (See, S[:, :m, :m]))
    u = np.where(u > 0, u, 1e-300)
    ratio = e[:, None, :] / u[:, :, None]
    white = np.real(np.einsum("kij,kjl,kil->k", W, S[:, m:, m:], np.conj(W))) / W.shape[1]
    seen = white > _SEEN if np.any(white > _SEEN) else np.ones(len(white), bool)
    # The largest gain at which feedback exceeds the input at no frequency.
    room = np.minimum(ratio / np.max(ratio[seen], axis=0)[None], 1.0).mean(axis=2)
    # Inputs are weighted by their effect: one with little effect moves no estimate.
    H = np.swapaxes(np.linalg.pinv(S[:, :m, :m], rcond=1e-9, hermitian=True) @ S[:, :m, m:], 1, 2)
    effect = np.sum(np.abs(W @ np.conj(H)) ** 2, axis=1) * u
    room, effect = room[:, direct], effect[:, direct]
    return np.sum(room * effect, axis=1) / np.maximum(np.sum(effect, axis=1), 1e-300)


def information(
    at: Solution, weights: Sequence[Float[np.ndarray, " K"]]
) -> Float[np.ndarray, "q q"]:
    """Return the information on the unknowns of interest, with a weight for each frequency.

    Weights are by record, or one array for the lines of fitted responses.
    """
    layout, data, noise, z = at
    q = len(layout.of_interest)
    if not any(np.any(w) for w in weights):
        return np.zeros((q, q))
    if layout.objective.fits_responses:
        k, r = np.asarray(noise.whitening.whitening).shape[:2]
        # Real parts, then imaginary ones.
        J = np.asarray(residual_and_jacobian(layout, data, noise, z).J)
        J = J[: 2 * k * r, :q].reshape(2, k, r, q)
        return np.einsum("k,ckra,ckrb->ab", weights[0], J, J)
    weighed: Noise = noise._replace(
        whitening=tuple(
            np.asarray(W) * np.sqrt(w)[:, None, None]
            for W, w in zip(noise.whitening, weights, strict=True)
        )
    )
    # Reuse the fit's compiled function with other weights; leave out the rows of priors.
    J = np.asarray(residual_and_jacobian(layout, data, weighed, z).J)[:q, :q]
    return J.T @ J


# Estimates by instrument with weak excitation at their frequencies.
#
# An input follows its excitation only at frequencies where that has power. Elsewhere estimate and
# interval depend on chance coherence. Speed derivatives are affected most, since their slow mode
# lies below the lowest frequency of a sweep.
#
# Sources: Cragg and Donald (1993) for the least canonical correlation of several inputs with their
# instruments; Stock and Yogo (2005) for the limit of F.


_WEAK = 0.25
"""Share of a parameter's information with a weak instrument, above which it is not trusted."""


def weak_by_instrument(problem: Problem, at: Solution) -> tuple[str, ...]:
    """Return the unknowns of interest with too little information by instrument."""
    layout, data, noise, _ = at
    if layout.noise_model != "spectrum" or not instruments_of(problem):
        return ()
    if layout.objective.fits_responses:
        flights = problem.training
        by = instrumented_inputs(problem, flights)
        if by is None:
            return ()
        signals = [(f.inputs, b) for f, b in zip(flights, by, strict=True)]
        F = _followed(signals, [(0, f.n_samples) for f in flights])[1][0]
        hz = np.arange(1, len(F) + 1) / (flights[0].n_samples * flights[0].dt)
        F = [np.interp(noise.whitening.windows.hz, hz, F)]
        direct, followed = at, [np.ones_like(f) for f in F]
    elif data.flights[0].by_instrument is None:
        return ()
    else:
        records = records_of(layout)
        signals = [
            (naming.asdict(flight.inputs), naming.asdict(flight.by_instrument))
            for flight in (data.flights[r.flight] for r in records)
        ]
        followed, F = _followed(signals, [(r.first, r.last) for r in records])
        flights = tuple(f._replace(by_instrument=None) for f in data.flights)
        direct = at._replace(data=data._replace(flights=flights))
    weak = [g * (f < STRONG) for g, f in zip(followed, F, strict=True)]
    part, whole = information(direct, weak), information(direct, followed)
    each = zip(layout.of_interest, shares(part, whole), strict=True)
    return tuple(n for n, share in each if share > _WEAK)


def _followed(
    signals: Sequence[tuple[Mapping[str, Any], Mapping[str, Any]]],
    spans: Sequence[tuple[int, int]],
) -> tuple[list[Float[np.ndarray, " K"]], list[Float[np.ndarray, " K"]]]:
    """Return the least squared canonical correlation of inputs and instruments, and its F.

    Both are by record and line.

    Args:
        signals: by record the inputs (N,) of its flight, and their parts that follow instruments.
        spans: by record its first sample, and the one after its last.
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
        # Chance correlation is no information.
        followed.append(np.maximum(least - m / n, 1e-6))
        F.append((n / m) * least / (1.0 - least))
    return followed, F
