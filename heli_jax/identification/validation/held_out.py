"""Held-out flights: predictions with the estimates, and tests in frequency."""

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
from heli_jax.identification.validation.metrics import Signals, signals_of


def validate(
    problem: Problem, at: Solution, held: tuple[Flight, ...]
) -> tuple[tuple[Signals, ...], tuple[Signals, ...]]:
    """Return the signals of held-out flights predicted with the estimates of a solution.

    Only their initial states (of every window) and biases are fitted. The second result is the
    simulation in one piece from the first window's initial state; it is empty without windows.
    """
    layout, _, noise, z = at
    # Shared unknowns come first in z, in the same order for any flights.
    other = layout_of(problem, held)
    # A spectrum contains no initial states and biases: fit them in time.
    if other.objective.noise_model == "spectrum":
        other = replace(other, objective=objective_of("output-error"))
    data, first = data_of(problem, held, other), layout.first_nuisance
    # For a linear model one step finds them from any point, also from zero.
    begin = jnp.zeros(other.size - first, z.dtype)
    if not problem.model.linear:
        begin = start_vector(other, data, problem)[first:]
    their_noise = _noise_of(problem, layout, noise, held)
    full = jnp.concatenate([z[:first], begin])
    if other.noise_model == "disturbance":
        # Fit by innovations: a simulation would take gusts for a bias.
        full = fit_nuisances(other, data, their_noise, full)
    else:
        full = in_time(other, data, their_noise, full)
    e = evaluate(other, data, their_noise, full)
    # Windows give many short simulations; only a simulation in one piece shows drift.
    free_run: tuple[Signals, ...] = ()
    if any(count > 1 for count, _ in other.windows):
        one_piece, whole = _in_one_piece(other, full)
        free_run = signals_of(held, simulated_outputs(one_piece, data, whole))
    return signals_of(held, e.simulated, e.innovations), free_run


def _noise_of(problem: Problem, layout: Layout, noise: Noise, held: tuple[Flight, ...]) -> Noise:
    """Return the noise of held-out flights: the estimate if flights share it, else a guess.

    The guess is from their own records.
    """
    # A spectrum needs flights with the same outputs, and the fit in time does not need it.
    in_rows = layout.noise_model != "spectrum"
    guess = first_noise(problem, held) if in_rows else first_noise_sizes(problem, held)
    if layout.noise_model != "disturbance":
        return guess
    known = {n: s for flight in noise.sd for n, s in flight.items()}
    # Outputs that no fitted flight has keep their guess.
    return guess._replace(
        sd=tuple({n: known.get(n, s) for n, s in flight.items()} for flight in guess.sd)
    )


def _in_one_piece(layout: Layout, z: Array) -> tuple[Layout, Array]:
    """Return layout and unknowns without windows, with the initial state of the first window."""
    # Each flight keeps the state of its first window, the biases and the offsets.
    kept = [np.arange(layout.first_nuisance)]
    for places in flight_places(layout):
        kept += [places.states[0], places.constants]
    windows = tuple((1, count * m) for count, m in layout.windows)
    return replace(layout, windows=windows, continuity=None), z[np.concatenate(kept)]


# Tests of held-out flights in frequency. They need no simulation, so they are valid for unstable
# models too. Gusts only raise the noise.
#
# Each flight has its own noise spectrum. One Gauss-Newton step leads from the fit's estimates to
# the flight's own; it is compared with the errors of both (Chow's test). Also, the residual must
# not follow the excitation by more than the output does.
#
# Source: Chow (1960).


_ROUNDS = 3
"""Iterations for the spectrum of the flight's noise."""
_NO_EFFECT = 1e-10
"""Eigenvalue over the largest one, below which a direction has no effect."""
_SURE = 0.05
"""Largest standard deviation of an explained share that is reported."""


class Furthest(NamedTuple):
    """The parameter whose estimate from a flight is furthest from that of the fit."""

    parameter: str
    own: float
    """Estimate from the flight alone, after one step [SI]."""
    fitted: float
    sds: float
    """Difference in joint standard deviations."""


class HeldOutFlight(NamedTuple):
    """Test results of a held-out flight."""

    flight: str
    estimates_p_value: float | None
    """Probability that the flight's own estimates differ as much from the fit's by chance.

    None if they cannot be compared."""
    furthest: Furthest | None
    explained: dict[str, float]
    """Share of the power following the excitation that the model explains, by output.

    Below 0 the model is worse than none. Reported if its standard deviation is at most 0.05."""
    worse: tuple[str, ...]
    """Outputs that a model without any response explains better."""

    @property
    def differs(self) -> bool:
        """True if the flight's own estimates differ from the fit's."""
        return self.estimates_p_value is not None and self.estimates_p_value < LEVEL


class HeldOutFrequency(NamedTuple):
    """Held-out flights of a fit in frequency."""

    flights: tuple[HeldOutFlight, ...]
    not_judged: tuple[str, ...]
    """Flights that cannot be compared with the fitted ones."""


def validate_in_frequency(
    problem: Problem, at: Solution, e: Evaluation, held: Sequence[Flight], *, feedback: bool
) -> HeldOutFrequency | None:
    """Test held-out flights of a fit in frequency; None for a fit in time.

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
                one = _tested(problem, at, e, label, part)
        if one is None:
            others.append(label)
        else:
            judged.append(one)
    return HeldOutFrequency(tuple(judged), tuple(others))


def _comparable(problem: Problem, at: Solution, flight: Flight, *, feedback: bool) -> Flight | None:
    """Return the flight with the outputs that can be compared.

    None if there are none, if no instrument moves, or if inputs follow the outputs and no
    instrument is used.
    """
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


def _tested(
    problem: Problem, at: Solution, fitted: Evaluation, label: str, flight: Flight
) -> HeldOutFlight | None:
    """Test one flight; None if its errors have no spectrum."""
    # Use the lines of the full flight, also after a fit of responses.
    problem = replace(problem, method="frequency-error")
    layout = layout_of(problem, (flight,))
    data, noise = data_of(problem, (flight,), layout), first_noise(problem, (flight,))
    first, q = layout.first_nuisance, len(layout.of_interest)
    z = jnp.zeros(layout.size, at.z.dtype).at[:first].set(at.z[:first])
    if not layout.model.linear:
        # The nuisances are part of the point of linearisation.
        z = z.at[first:].set(start_vector(layout, data, problem)[first:])
        z = in_time(layout, data, noise, z)
    for _ in range(_ROUNDS):
        z, noise = layout.objective.relax(layout, data, noise, z)
    if not np.isfinite(float(noise.log_determinant)):
        return None
    there = Solution(layout, data, noise, z)
    made = residual_and_jacobian(*there)
    # One row per parameter and one for the remaining errors; rows of priors are left out.
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
    """Return the p-value of the flight's own estimates against the fit's, and the furthest one.

    None if flight and fit determine no direction in common.

    Args:
        r: errors of the flight over its noise.
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
    # A direction can be compared only if both flight and fit determine it.
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
