"""Flights held out: predicted with the estimates, their own initial states and biases adjusted."""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.special
from jaxtyping import Array, Float

from heli_jax.flights.flight import Flight, labels
from heli_jax.identification.estimation.data import data_of, start_vector
from heli_jax.identification.estimation.evaluation import Evaluation, evaluate, simulated_outputs
from heli_jax.identification.estimation.frequency_instrument import instruments_of
from heli_jax.identification.estimation.frequency_lines import errors_of_lines, parts_of
from heli_jax.identification.estimation.levenberg_marquardt import (
    fit_nuisances,
    residual_and_jacobian,
)
from heli_jax.identification.estimation.noise_covariance import first_noise, first_noise_sizes
from heli_jax.identification.estimation.output_error import in_time
from heli_jax.identification.methods import objective_of
from heli_jax.identification.problem import Problem
from heli_jax.identification.unknowns.layout import (
    Layout,
    Noise,
    Solution,
    flight_places,
    layout_of,
)
from heli_jax.identification.validation.excitation import LEVEL, errors_against_excitation


class Validation(NamedTuple):
    """Flights held out, at the optimum of what is their own."""

    e: Evaluation
    free_run: tuple[dict[str, np.ndarray], ...] | None
    """with windows: by flight and output the simulation (N,) in one piece from the initial state of
    the first window, with the bias; None without windows"""


def validate(
    problem: Problem, layout: Layout, z: Array, noise: Noise, held: tuple[Flight, ...]
) -> Validation:
    """Predict the flights held out with the estimates; only their initial states (of every window)
    and biases are adjusted, by least squares.

    Args:
        z: (q,) the optimum of the fitted flights in `layout`.
    """
    # What is shared stands first in z and in the same order, whichever flights there are.
    other = layout_of(problem, held)
    # What no line of a spectrum knows, the initial states and biases, shows in time alone.
    if other.objective.noise_model == "spectrum":
        other = replace(other, objective=objective_of("output-error"))
    data, first = data_of(problem, held, other), layout.first_nuisance
    # From any point a linear model's are found in one step, so zero, the middle of their weak
    # priors, will do.
    begin = jnp.zeros(other.size - first, z.dtype)
    if not problem.model.linear:
        begin = start_vector(other, data, problem)[first:]
    their_noise = _noise_of(problem, layout, noise, held)
    full = jnp.concatenate([z[:first], begin])
    if other.noise_model == "disturbance":
        # Those of a simulation would take gusts for a bias, which the innovations then have.
        full = fit_nuisances(other, data, their_noise, full)
    else:
        full = in_time(other, data, their_noise, full)
    e = evaluate(other, data, their_noise, full)
    # With windows the agreement is that of many short runs. How far the model is good for by itself
    # only a run in one piece shows.
    free_run = None
    if any(count > 1 for count, _ in other.windows):
        one_piece, whole = _in_one_piece(other, full)
        free_run = simulated_outputs(one_piece, data, whole)
    return Validation(e, free_run)


def _noise_of(problem: Problem, layout: Layout, noise: Noise, held: tuple[Flight, ...]) -> Noise:
    """The noise of the flights held out: what was estimated where all flights share it, else a
    guess from their own records."""
    # A spectrum is that of flights with the same outputs, which those held out need not be; in time
    # it is not asked for.
    in_rows = layout.noise_model != "spectrum"
    guess = first_noise(problem, held) if in_rows else first_noise_sizes(problem, held)
    if layout.noise_model != "disturbance":
        return guess
    known = {n: s for flight in noise.sd for n, s in flight.items()}
    # An output that no fitted flight has keeps its guess.
    return guess._replace(
        sd=tuple({n: known.get(n, s) for n, s in flight.items()} for flight in guess.sd)
    )


def _in_one_piece(layout: Layout, z: Array) -> tuple[Layout, Array]:
    """The same without windows: each flight from the initial state of its first."""
    # Of each flight's entries in z the first window's state stays, and the biases and offsets.
    kept = [np.arange(layout.first_nuisance)]
    for places in flight_places(layout):
        kept += [places.states[0], places.constants]
    # As long as one window that holds them all.
    windows = tuple((1, count * m) for count, m in layout.windows)
    return replace(layout, windows=windows, continuity=None), z[np.concatenate(kept)]


# Flights held out, judged in frequency: nothing is simulated, so that unstable models can be
# judged too, and gusts raise the noise and not the doubt.
#
# Each flight gets a spectrum of its own residual and is asked two questions. Would it, by itself,
# give other estimates? One step of Gauss and Newton from the fit's, in the flight's own noise, is
# compared with the errors of both (Chow's test). And does the model explain what follows the
# excitation, as is asked of the fitted flights?
#
# Source: Chow (1960).


_ROUNDS = 3
"""of the flight's noise"""
_NO_EFFECT = 1e-10
"""part of the largest size below which a direction has no effect"""
_SURE = 0.05
"""sd of the explained share by chance, above which it is not reported"""


class Furthest(NamedTuple):
    """The parameter whose estimate from a flight is the furthest from the fit's."""

    parameter: str
    own: float
    """from the flight by itself, after one step [SI]"""
    fitted: float
    sds: float
    """joint standard deviations between the two"""


class HeldOutFlight(NamedTuple):
    """A flight held out."""

    flight: str
    estimates_p_value: float | None
    """the chance that errors alone make the flight's own estimates as far from the fit's; null
    where the flight says nothing of them"""
    furthest: Furthest | None
    explained: dict[str, float]
    """by output the part that the model explains of the power that follows the excitation; below 0
    it is worse than no model; only where gusts leave at most 0.05 of it to chance"""
    worse: tuple[str, ...]
    """the outputs that a model without any response would explain better"""

    @property
    def differs(self) -> bool:
        """True if the flight gives other estimates."""
        return self.estimates_p_value is not None and self.estimates_p_value < LEVEL


class HeldOutFrequency(NamedTuple):
    """The flights held out of a fit in frequency."""

    flights: tuple[HeldOutFlight, ...]
    not_judged: tuple[str, ...]
    """the flights that cannot be compared with the fitted ones"""


def validate_in_frequency(
    problem: Problem, at: Solution, e: Evaluation, held: Sequence[Flight], *, feedback: bool
) -> HeldOutFrequency | None:
    """Judge the flights held out of a fit in frequency; None of a fit in time.

    Args:
        feedback: True if inputs follow the outputs and no instrument is used.
    """
    if not held or at.layout.noise_model != "spectrum" or not np.isfinite(e.J).all():
        return None
    judged, others = [], []
    for label, flight in zip(labels(tuple(held)), held, strict=True):
        part, one = _comparable(problem, at, flight, feedback=feedback), None
        if part is not None:
            with np.errstate(all="ignore"):
                one = _judged(problem, at, e, label, part)
        if one is None:
            others.append(label)
        else:
            judged.append(one)
    return HeldOutFrequency(tuple(judged), tuple(others))


def _comparable(problem: Problem, at: Solution, flight: Flight, *, feedback: bool) -> Flight | None:
    """The flight with the outputs that can be judged; None if there are none, no instrument moves,
    or inputs follow the outputs and no instrument is used."""
    by = instruments_of(problem)
    if feedback or (by and not any(np.ptp(flight.instruments.get(n, [0.0])) > 0 for n in by)):
        return None
    common = (n for n in flight.outputs if n in at.layout.outputs[0])
    moving = {n for n in common if np.nanmin(flight.outputs[n]) < np.nanmax(flight.outputs[n])}
    outputs, sd = (
        {n: v for n, v in of.items() if n in moving} for of in (flight.outputs, flight.sd)
    )
    part = replace(flight, outputs=outputs, sd=sd) if moving else None
    return part if part is not None and parts_of(part) else None


def _judged(
    problem: Problem, at: Solution, fitted: Evaluation, label: str, flight: Flight
) -> HeldOutFlight | None:
    """One flight; None if its errors have no spectrum."""
    # At the lines of the whole flight, also after a fit of responses.
    problem = replace(problem, method="frequency-error")
    layout = layout_of(problem, (flight,))
    data, noise = data_of(problem, (flight,), layout), first_noise(problem, (flight,))
    first, q = layout.first_nuisance, len(layout.of_interest)
    z = jnp.zeros(layout.size, at.z.dtype).at[:first].set(at.z[:first])
    if not layout.model.linear:
        # Such a model is linearised where the nuisances put it.
        z = z.at[first:].set(start_vector(layout, data, problem)[first:])
        z = in_time(layout, data, noise, z)
    for _ in range(_ROUNDS):
        z, noise = layout.objective.relax(layout, data, noise, z)
    if not np.isfinite(float(noise.log_variance_ratio)):
        return None
    there = Solution(layout, data, noise, z)
    made = residual_and_jacobian(*there)
    # A row for each parameter and one for the rest of the errors; the priors are no news.
    r, J = np.asarray(made.r)[: q + 1], np.asarray(made.J)[: q + 1, :q]
    by = instruments_of(problem) if data.flights[0].by_instrument is not None else ()
    errors = jax.device_get(errors_of_lines(*there).errors)
    followed = errors_against_excitation((flight,), there, errors, by)
    level = LEVEL / max(len(followed), 1)
    worse = [n for n, f in followed.items() if f.p_value < level and not f.explained >= 0.0]
    known = [n for n, f in followed.items() if f.by_chance < _SURE or n in worse]
    explained = {n: min(followed[n].explained, 1.0) for n in known}
    return HeldOutFlight(label, *_own_estimates(r, J, at, fitted), explained, tuple(worse))


def _own_estimates(
    r: Float[np.ndarray, " r"], J: Float[np.ndarray, "r q"], at: Solution, fitted: Evaluation
) -> tuple[float | None, Furthest | None]:
    """The chance that the flight's own estimates lie as far from the fit's, and the furthest; None
    where the two have no direction in common.

    Args:
        r: the flight's errors, in units of its own noise.
    """
    names, values = at.layout.of_interest, np.asarray(fitted.named)
    of_fit, slopes = np.asarray(fitted.J, float)[:, : len(names)], np.asarray(fitted.slopes)
    own, known = J.T @ J, of_fit.T @ of_fit
    if not (np.isfinite(own).all() and np.isfinite(r).all()):
        return None, None
    sizes = np.sqrt(np.diag(own + known))
    sizes = np.where(sizes > 0, sizes, 1.0)
    b, (own, known) = J.T @ r / sizes, (v / np.outer(sizes, sizes) for v in (own, known))
    sums, vectors = np.linalg.eigh(own + known)
    kept = sums > _NO_EFFECT * sums[-1]
    root = vectors[:, kept] / np.sqrt(sums[kept])
    shares, turned = np.linalg.eigh(root.T @ own @ root)
    # A direction that only one of the two determines cannot be compared.
    both = (shares > _NO_EFFECT) & (shares < 1.0 - _NO_EFFECT)
    if not both.any():
        return None, None
    directions, shares = root @ turned[:, both], shares[both]
    along = directions.T @ b
    p = scipy.special.chdtrc(int(both.sum()), np.sum(along**2 * (1.0 / shares - 1.0)))
    moved = -(directions @ (along / shares)) / sizes * slopes
    sd = np.sqrt(np.sum(directions**2 / (shares * (1.0 - shares)), axis=1)) / sizes
    sds = np.abs(moved) / np.maximum(sd * np.abs(slopes), 1e-300)
    k = int(np.argmax(sds))
    own_value = float(values[k] + moved[k])
    return float(p), Furthest(names[k], own_value, float(values[k]), float(sds[k]))
