r"""Estimates that feedback may have moved, where nobody logged an excitation.

Feedback brings what disturbs the vehicle into its inputs. Directly the response is off by the part
$\gamma^2$ of the input that comes of it, and the record does not tell that part: a model follows
its inputs where it can, and its residual then shows nothing of it. Two things it does tell.

What feedback may have brought in: from one output, at a constant gain, $|k|^2 S_{ee}$ of $S_{uu}$,
which is nowhere more than all of the input; with the largest such gain, as a mean over the outputs,
since nobody knows which is fed back. A loop holds the vehicle at low frequencies, where gusts are
large in it and sweeps move sticks no more than elsewhere.

An unstable vehicle that was held all the same had a loop with a bandwidth of twice its unstable
pole at least: up to there all of the input may have come of it, whatever the residual is.

Each is a mean over the frequencies that tell of a parameter, by what they tell. Neither says that
there is a loop. Parameters are named where inputs were found to follow the response, or where
somebody must have held the vehicle: the model is unstable, and the record does not grow. Inputs
that are taken by instrument bring in nothing.

Sources: L. Ljung, System Identification (1999), 13.4, for the direct estimate's bias; Astrom and
Murray, Feedback Systems (2008), 11.4, for the bandwidth that an unstable pole asks for.
"""

import functools
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

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
    first_model,
    once_a_length,
    smoothed,
)
from heli_jax.identification.estimation.levenberg_marquardt import residual_and_jacobian
from heli_jax.identification.problem import Problem
from heli_jax.identification.unknowns.layout import Noise, Solution
from heli_jax.identification.validation.follows_response import Feedback

MAY_BE = 0.25
"""part of the input that feedback may have brought in, where a parameter that is trusted shows"""
HELD = 0.1
"""part of what tells of a parameter that is trusted from frequencies at which the loop that holds
an unstable vehicle has to act: there all of the input may be that loop's"""
BESIDE = 0.05
"""the same where other inputs are taken by instrument: an input's effect is off by that part of it
at least, in a fit that is taken for one that feedback does no harm to"""
_GROWS = 3.0
"""e-foldings over a record of the model's fastest growing mode, from which on somebody holds it"""
_REACHES = 2.0
"""times an unstable pole, up to which the loop that holds it has to act: with less bandwidth no
feedback has margins (Astrom and Murray, 2008, section 11.4)"""
_SEEN = 2.0
"""times the residual's power, above which an output shows the response: only there is it asked how
large a gain the input leaves room for"""
_PART = 0.05
"""sd of the Gaussian that smooths the spectra, as a part of the frequency"""


class Moved(NamedTuple):
    """Parts of the information on one estimate that feedback may have made."""

    may_be: float
    """part of the input that feedback may have brought in, 0 to 1"""
    held: float = 0.0
    """part of what tells of it that lies where the loop which holds an unstable vehicle acts"""

    @property
    def part(self) -> float:
        """The larger one."""
        return max(self)


def moved_by_feedback(at: Solution, J: Float[np.ndarray, "n q"]) -> dict[str, Moved]:
    """By unknown of interest; empty where the method knows no frequencies, or every input that
    moves is taken by instrument.
    """
    layout, q = at.layout, len(at.layout.of_interest)
    if layout.noise_model != "spectrum":
        return {}
    responses = layout.objective.fits_responses
    room = _room_of_responses(at) if responses else _room_of_records(at)
    if not room:
        return {}
    # Up to where the loop that holds an unstable mode has to reach nothing tells test from
    # correction.
    poles, inside = held_poles(at), [np.zeros_like(v) for v in room]
    for record, v in zip(() if responses else records_of(layout), inside, strict=False):
        dt = float(at.data.flights[record.flight].dt)
        omega = 2.0 * np.pi * np.arange(1, record.lines + 1) / (record.samples * dt)
        v[omega <= _REACHES * poles[record.flight]] = 1.0
    whole = (
        information(at, [np.ones_like(v) for v in room]) if responses else J[:q, :q].T @ J[:q, :q]
    )
    may_be, held = (shares(information(at, w), whole) for w in (room, inside))
    each = zip(layout.of_interest, may_be, held, strict=True)
    return {n: Moved(float(m), float(h)) for n, m, h in each}


def _room_of_records(at: Solution) -> list[Float[np.ndarray, " K"]]:
    """By record and line the part of the inputs that feedback may have brought in; empty if all
    inputs are taken by instrument."""
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
    """The same of fitted responses, by line of their windows."""
    layout, data, noise, z = at
    w, density = noise.whitening.windows, np.asarray(noise.whitening.density)
    direct = np.array([n not in w.instruments for n in w.inputs])
    if not direct.any():
        return []
    # A method of the estimator: its module stands above this one in the order of imports.
    E = np.asarray(layout.objective.errors_in_windows(layout, data, noise, z))
    joint = np.concatenate([np.asarray(w.U), np.asarray(w.Y)], axis=2)
    S, See = (np.einsum("wka,wkb->kab", v, np.conj(v)) / len(v) for v in (joint, E))
    return [_room(np.linalg.inv(np.linalg.cholesky(density)), S, See, direct)]


def shares(
    part: Float[np.ndarray, "q q"], whole: Float[np.ndarray, "q q"]
) -> Float[np.ndarray, " q"]:
    """Return the share that each unknown has of a part of the information, 0 to 1."""
    sd = np.sqrt(np.maximum(np.diagonal(whole), 1e-300))
    # A parameter that is not determined has no standard deviation to be moved by.
    covariance = np.linalg.pinv(whole / np.outer(sd, sd), rcond=1e-12, hermitian=True)
    of_part = np.diagonal(covariance @ (part / np.outer(sd, sd)) @ covariance)
    with np.errstate(all="ignore"):
        return np.clip(np.nan_to_num(of_part / np.diagonal(covariance)), 0.0, 1.0)


def held_poles(at: Solution) -> list[float]:
    """By flight |p| [rad/s] of the model's fastest unstable mode that the record would show, and
    does not: somebody holds it. 0 where there is none."""
    layout, data, *_, z = at
    if layout.noise_model != "spectrum" or layout.objective.fits_responses:
        return [0.0]
    with np.errstate(divide="ignore"):  # what a sample forgets altogether
        modes = np.log(np.linalg.eigvals(first_model(layout, data, z).Ad).astype(complex))
    held = []
    for names, flight in zip(layout.outputs, data.flights, strict=True):
        y = [np.asarray(flight.outputs[n]) for n in names]
        half = len(y[0]) // 2
        grown = max(float(np.nanstd(v[half:]) / max(np.nanstd(v[:half]), 1e-300)) for v in y)
        # Alone it would grow by half of the e-foldings from one half to the other.
        growing = modes[2 * half * np.real(modes) > _GROWS]
        alone = np.max(np.real(growing), initial=0.0)
        stays = alone > 0.0 and np.log(grown) < 0.5 * half * alone
        held.append(float(np.max(np.abs(growing))) / float(flight.dt) if stays else 0.0)
    return held


class Loop(NamedTuple):
    """Who closes a loop, as far as it is known."""

    found: Sequence[Feedback]
    """by flight and input, whether it follows the response"""
    instruments: Sequence[str] = ()
    """the inputs that are taken by instrument"""
    held: bool = False
    """whether somebody must hold the vehicle"""

    @property
    def closed(self) -> bool:
        """True if an input that is taken for given follows the response, or may: where only one
        with an instrument was found to, whoever closes its loop may move the others as well."""
        if self.instruments:
            return bool(self.inputs) and any(one.present for one in self.found)
        return self.held or any(one.present for one in self.found)

    @property
    def inputs(self) -> list[str]:
        """Inputs without an instrument that follow the response; all that move freely if none
        does."""
        direct = [one for one in self.found if one.input not in self.instruments]
        those = [one for one in direct if one.present] or direct
        return list(dict.fromkeys(one.input for one in those))


def untrusted(moved: Mapping[str, Moved], loop: Loop) -> tuple[str, ...]:
    """The parameters that a fit cannot be trusted on: nothing where no loop is closed."""
    if not loop.closed:
        return ()
    most = BESIDE if loop.instruments else MAY_BE
    # Beside inputs by instrument somebody logged what excites the slow mode.
    beyond = 1.0 if loop.instruments else HELD
    return tuple(n for n, m in moved.items() if m.may_be > most or m.held > beyond)


def _room(
    W: np.ndarray, S: np.ndarray, See: np.ndarray, direct: np.ndarray
) -> Float[np.ndarray, " k"]:
    """By frequency the part of the input that a constant gain may have brought in, from the
    whitening, the spectra of inputs and outputs together, those of the residual, and by input True
    if it is taken for given (`direct`)."""
    m = S.shape[1] - See.shape[1]
    e, u = (np.real(np.einsum("kii->ki", v)) for v in (See, S[:, :m, :m]))
    u = np.where(u > 0, u, 1e-300)
    ratio = e[:, None, :] / u[:, :, None]
    white = np.real(np.einsum("kij,kjl,kil->k", W, S[:, m:, m:], np.conj(W))) / W.shape[1]
    seen = white > _SEEN if np.any(white > _SEEN) else np.ones(len(white), bool)
    # The largest gain that leaves the input no less than it has, at any frequency.
    room = np.minimum(ratio / np.max(ratio[seen], axis=0)[None], 1.0).mean(axis=2)
    # Each input by what it does: one that hardly acts moves no estimate.
    H = np.swapaxes(np.linalg.pinv(S[:, :m, :m], rcond=1e-9, hermitian=True) @ S[:, :m, m:], 1, 2)
    effect = np.sum(np.abs(W @ np.conj(H)) ** 2, axis=1) * u
    room, effect = room[:, direct], effect[:, direct]
    return np.sum(room * effect, axis=1) / np.maximum(np.sum(effect, axis=1), 1e-300)


def information(
    at: Solution, weights: Sequence[Float[np.ndarray, " K"]]
) -> Float[np.ndarray, "q q"]:
    """Information on the unknowns of interest, each frequency by its weight; weights by record, or
    those of the windows of fitted responses."""
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
    # The program of the fit, with other weights; the priors' rows are no information of these.
    J = np.asarray(residual_and_jacobian(layout, data, weighed, z).J)[:q, :q]
    return J.T @ J


# Which estimates by instrument are not to be trusted: the excitation is weak where they show.
#
# An input follows its excitation only where that has power. Elsewhere the estimate leans on what
# chance makes of the coherence of both, and its interval with it: the more so of derivatives of the
# speed, which show in a slow mode below the lowest frequency of a sweep.
#
# Sources: Cragg and Donald (1993) for several inputs together: the least of their canonical
# correlations with the instruments; Stock and Yogo (2005) for the limit of F.


_MOST = 0.25
"""part of what is known of a parameter that may come of frequencies at which an instrument is
weak"""


def weak_by_instrument(problem: Problem, at: Solution) -> tuple[str, ...]:
    """The unknowns of interest of which instruments tell too little; () of a fit without any."""
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
        direct = at._replace(noise=noise._replace(by_instrument=np.zeros(())))
    weak = [g * (f < STRONG) for g, f in zip(followed, F, strict=True)]
    part, whole = information(direct, weak), information(direct, followed)
    each = zip(layout.of_interest, shares(part, whole), strict=True)
    return tuple(n for n, share in each if share > _MOST)


def _followed(
    signals: Sequence[tuple[Mapping[str, Any], Mapping[str, Any]]],
    spans: Sequence[tuple[int, int]],
) -> tuple[list[Float[np.ndarray, " K"]], list[Float[np.ndarray, " K"]]]:
    """By record and line the least canonical correlation of the inputs with their instruments,
    squared, and its F; by record are given its flight's inputs with what of them follows the
    instruments (N,), and its first sample with that behind its last."""
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
