"""Flights held out: predicted with the estimates, their own initial states and biases adjusted."""

from dataclasses import replace
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from heli_jax.finding import Finding, found
from heli_jax.flights.flight import Flight
from heli_jax.identification.estimation.data import data_of
from heli_jax.identification.estimation.evaluation import Evaluation, evaluate, simulated_outputs
from heli_jax.identification.estimation.in_time import in_time
from heli_jax.identification.estimation.levenberg_marquardt import optimise
from heli_jax.identification.estimation.noise_covariance import first_noise, first_noise_sizes
from heli_jax.identification.methods import objective_of
from heli_jax.identification.problem import Problem
from heli_jax.identification.unknowns.initial_guess import labels, start_vector
from heli_jax.identification.unknowns.layout import Data, Layout, Noise, layout_of

_STEPS = 60
"""of Levenberg-Marquardt at most"""


class Validation(NamedTuple):
    """Flights held out, at the optimum of what is their own."""

    e: Evaluation
    free_run: tuple[dict[str, np.ndarray], ...] | None
    """with windows: by flight and output the simulation (N,) in one piece from the initial state of
    the first window, with the bias; None without windows"""
    notes: tuple[Finding, ...]


def validate(
    problem: Problem, layout: Layout, z: Array, noise: Noise, held: tuple[Flight, ...]
) -> Validation:
    """Predict the flights held out with the estimates; only their initial states (of every window)
    and biases are adjusted, by least squares.

    Nothing is raised where that fails: the notes say so.

    Args:
        z: (q,) the optimum of the fitted flights in `layout`.
    """
    # What is shared stands first in z and in the same order, whichever flights there are.
    other = layout_of(problem, held)
    # What no line of a spectrum knows, the initial states and biases, shows in time alone.
    if other.objective.noise_model == "spectrum":
        other = replace(other, objective=objective_of("output-error"))
    data = data_of(problem, held, other)
    # From any point a linear model's are found in one step, so zero, the middle of their weak
    # priors, will do.
    begin = jnp.zeros(other.size - layout.first_nuisance, z.dtype)
    if not problem.model.linear:
        begin = start_vector(other, data, problem)[layout.first_nuisance :]
    full = jnp.concatenate([z[: layout.first_nuisance], begin])
    their_noise = _noise_of(problem, layout, noise, held)
    converged = True
    if layout.noise_model == "spectrum":
        full = in_time(other, data, their_noise, full)
    elif other.size > layout.first_nuisance:
        adjust = _linear if problem.model.linear else _damped
        full, converged = adjust(other, data, their_noise, full)
    e = evaluate(other, data, their_noise, full)
    # With windows the agreement is that of many short runs. How far the model is good for by itself
    # only a run in one piece shows.
    free_run = None
    if any(count > 1 for count, _ in other.windows):
        one_piece, whole = _in_one_piece(other, full)
        free_run = simulated_outputs(one_piece, data, whole)
    return Validation(e, free_run, tuple(_notes(held, e, converged)))


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


def _linear(layout: Layout, data: Data, noise: Noise, z: Array) -> tuple[Array, bool]:
    """A model that is linear in its states: one least-squares solution."""
    e = evaluate(layout, data, noise, z)
    # Whatever the rest of z, predictions are linear in the initial states, biases and offsets.
    columns, r = np.asarray(e.J)[:, layout.first_nuisance :], np.asarray(e.r)
    if not (np.isfinite(columns).all() and np.isfinite(r).all()):
        return z, False
    step, *_ = np.linalg.lstsq(columns, -r, rcond=1e-10)
    return z.at[layout.first_nuisance :].add(jnp.asarray(step, z.dtype)), True


def _damped(layout: Layout, data: Data, noise: Noise, z: Array) -> tuple[Array, bool]:
    """The fit's own Levenberg-Marquardt, with all that the flights share held."""
    # Plain Gauss-Newton steps from the model's own initial state diverge where the estimates are
    # off: an inertia 10 % wrong gave a yaw VAF of -3.0 for 0.999.
    held = np.arange(layout.size) < layout.first_nuisance
    optimum = optimise(layout, data, noise, z, _STEPS, held=held)
    if not (np.isfinite(optimum.cost) and bool(jnp.all(jnp.isfinite(optimum.z)))):
        return z, False
    return optimum.z, bool(optimum.converged)


def _in_one_piece(layout: Layout, z: Array) -> tuple[Layout, Array]:
    """The same without windows: each flight from the initial state of its first."""
    # Of each flight's entries in z the first window's state stays, and the biases and offsets.
    kept, at, k = [np.arange(layout.first_nuisance)], layout.first_nuisance, len(layout.states)
    for (count, _), outputs in zip(layout.windows, layout.outputs, strict=True):
        constants = layout.constants(outputs)
        kept += [at + np.arange(k), at + count * k + np.arange(constants)]
        at += count * k + constants
    # As long as one window that holds them all.
    windows = tuple((1, count * m) for count, m in layout.windows)
    return replace(layout, windows=windows, continuity=None), z[np.concatenate(kept)]


def _notes(held: tuple[Flight, ...], e: Evaluation, converged: bool) -> list[Finding]:
    astray = [
        label
        for label, simulated in zip(labels(held), e.simulated, strict=True)
        if not all(np.isfinite(v).all() for v in simulated.values())
    ]
    if astray:
        return [found("held-out.not-finite", "note", *astray)]
    return [] if converged else [found("held-out.nuisances-not-found", "note")]
