"""From the residual's Jacobian to the verdict: relative coordinates, priors, nuisances."""

from typing import NamedTuple

import numpy as np

from heli_jax import naming
from heli_jax.flights.flight import labels
from heli_jax.identification.estimation.evaluation import NULL, Evaluation
from heli_jax.identification.identifiability.analysis import NOTHING_ELSE, Around, analyse
from heli_jax.identification.identifiability.directions import WithoutWeakPriors, projected
from heli_jax.identification.identifiability.verdict import Unknown, Verdict
from heli_jax.identification.problem import MAX_TIME_SHIFT, Problem
from heli_jax.identification.unknowns import transforms
from heli_jax.identification.unknowns.layout import FlightUnknown, Layout, flight_unknowns

_NEAR_ZERO = 1e-2
"""part of a parameter's size below which it takes no part in products of powers"""
_AT_END = 1e-3
"""part of the largest time shift within which one is at the end of its search"""


def unknowns_of(problem: Problem, layout: Layout, e: Evaluation) -> tuple[Unknown, ...]:
    """The parameters of interest for the verdict, with their size and prior in relative
    coordinates.
    """
    dt = problem.training[0].dt
    unknowns = []
    for i, name in enumerate(layout.of_interest):
        value, free = float(e.named[i]), problem.free.get(name)
        if name == "time_shift":
            # A shift is known well where it is known to a sample, whatever its value. The search is
            # through a tanh, which comes near to its end and never to it.
            room = MAX_TIME_SHIFT - abs(value)
            u = Unknown(name, value, False, 1.0, 0.0, is_parameter=False, reference=dt)
            u = u._replace(at_bound=room < _AT_END * MAX_TIME_SHIFT, room=room / dt)
        elif free is None:
            u = Unknown(name, value, True, 1.0, 0.0, is_parameter=False, reference=abs(value))
        else:
            u = _parameter(problem, name, value)
        unknowns.append(u)
    return tuple(unknowns)


def _parameter(problem: Problem, name: str, value: float) -> Unknown:
    """A free parameter of the model."""
    free, late = problem.free[name], name in problem.model.delay_parameters
    low, high = free.lower, free.upper
    # Zero is as good a value as any where the sign may change, and of every delay: one that is
    # searched as a positive number may still be none at all, of which its logarithm says nothing.
    symmetric = late or transforms.changes_sign(free)
    reference, log = abs(value), True
    # Between bounds of both signs neither a logarithm nor the start's size means anything.
    if low is not None and high is not None and low < 0 < high:
        reference, log = 0.5 * (high - low), False
    elif symmetric:
        # A value near zero is known as soon as it is known to be small beside the start; or beside
        # a sample, however small a delay the search began with.
        reference = max(abs(value), transforms.scale(free))
        reference = max(reference, problem.training[0].dt) if late else reference
        log = abs(value) > _NEAR_ZERO * reference
    # What a parameter may plausibly do: by its prior, or half its interval.
    prior, scale = reference / free.prior.sd if free.prior else 0.0, 1.0
    if prior:
        scale = 1.0 / prior
    elif log and low and high:
        # Bounds that nearly meet would make a scale of zero, and a null direction of it.
        scale = max(0.5 * float(np.log(high / low)), 1e-3)
    at_bound = transforms.at_bound(free, value)
    return Unknown(name, value, log, scale, prior, True, reference, symmetric, at_bound=at_bound)


class Rows(NamedTuple):
    """The Jacobian without the priors of the parameters, taken apart."""

    sensitivity: np.ndarray
    """(n, q) of the rows of data, parameters of interest in relative coordinates"""
    nuisances: np.ndarray
    """(n, k) of the same rows, all other unknowns"""
    weak: np.ndarray
    """(w, k) the weak priors' rows, which only nuisances have"""


def relative_rows(
    problem: Problem, layout: Layout, e: Evaluation
) -> tuple[tuple[Unknown, ...], Rows]:
    """The parameters of interest, and the Jacobian's rows of the data in relative coordinates.

    Args:
        layout: what stands where in the Jacobian's columns.
    """
    unknowns = unknowns_of(problem, layout, e)
    # In double precision from here on, whatever the fit ran in: null directions are told by 1e-8.
    J = np.asarray(e.J, dtype=np.float64)
    q, p = len(layout.of_interest), len(layout.free)
    count = layout.size - layout.first_nuisance
    # Last come the weak priors (all that stands in z from `layout.first_nuisance` on), before them
    # the parameters' own; the defects between windows count as data.
    data = J[: J.shape[0] - count - p]
    slopes = np.asarray(e.slopes, dtype=np.float64)
    factor = np.divide(
        [u.reference for u in unknowns], slopes, out=np.zeros_like(slopes), where=slopes != 0
    )
    # A parameter of negative sign falls as its logarithm rises; the size is what counts.
    sensitivity = data[:, :q] * np.abs(factor) * np.sign(slopes) * [u.sign for u in unknowns]
    return unknowns, Rows(sensitivity, data[:, q:], J[J.shape[0] - count :, q:])


_NO_EFFECT = 1e-6
"""A nuisance whose whole effect is below this part of the noise, such as the memory of a
disturbance that is not there, has no direction to be projected out."""


def _with_weak_priors(rows: Rows, S: np.ndarray, N: np.ndarray) -> np.ndarray:
    """What the data (S by the unknowns, N by the nuisances) say of the unknowns (any, q) where the
    nuisances are free but for their weak priors."""
    sensitivity = np.vstack([S, np.zeros((rows.weak.shape[0], S.shape[1]))])
    nuisances = np.vstack([N, rows.weak])
    # What neither the data nor a prior of its own sees is no unknown.
    shown = np.linalg.norm(nuisances, axis=0) > _NO_EFFECT
    # Each has a prior or an effect, so none depends on the others: no part is to be left out.
    return projected(sensitivity, nuisances[:, shown])


def _without_weak_priors(
    named: tuple[FlightUnknown, ...], S: np.ndarray, N: np.ndarray
) -> WithoutWeakPriors:
    """What is left of that without the weak priors of the last columns of N, which are `named`."""
    seen = np.linalg.norm(N, axis=0) > _NO_EFFECT
    # The weak priors' sds are the units of these columns, so the solution is in sds.
    compensation = np.zeros((N.shape[1], S.shape[1]))
    compensation[seen] = -np.linalg.lstsq(N[:, seen], S, rcond=NULL)[0]
    # Before those named stand the parameters of the disturbance and the noise's factors.
    return WithoutWeakPriors(
        projected(S, N[:, seen], NULL), compensation[N.shape[1] - len(named) :], named
    )


_WITHOUT_ALIASES = "bound it where that mode is slower, or log faster"


def verdict_of(
    problem: Problem,
    layout: Layout,
    e: Evaluation,
    reported: np.ndarray | None = None,
    around: Around = NOTHING_ELSE,
) -> Verdict:
    """What the data determine at one point.

    Args:
        layout: what stands where in the Jacobian's columns.
        reported: covariance (k, k) of the parameters of interest, in the optimiser's coordinates,
            that the reported intervals have where it is not that of white residuals.

    Raises:
        ValueError: the simulation is not finite there.
    """
    if not bool(np.all(np.isfinite(e.J))):
        raise ValueError(
            "the simulation is not finite at the given values: the model is unstable there over "
            "the length of this record; start elsewhere or use a shorter window"
        )
    unknowns, rows = relative_rows(problem, layout, e)
    unknowns = tuple(u._replace(aliased=u.name in around.aliased) for u in unknowns)
    q = len(unknowns)
    # All further work is on the triangle, which holds what the data say in as many rows as columns.
    R = np.linalg.qr(np.hstack([rows.sensitivity, rows.nuisances]), mode="r")
    S, N = R[:, :q], R[:, q:]
    sensitivity = _with_weak_priors(rows, S, N)
    named = flight_unknowns(layout, labels(problem.training))
    if reported is not None:
        to_relative = np.asarray(e.slopes, np.float64) * [u.sign / u.reference for u in unknowns]
        reported = reported * np.outer(to_relative, to_relative)
    # On the stand Ixx, If and a are known up to a factor: moments of inertia and lift scale alike.
    # A second run with a known inertia added sets the scale.
    known = naming.names(problem.model.Params)
    remedies = {n: "add a run with a known inertia" for n in problem.free if f"{n}_added" in known}
    # Initial states of a chance optimum may tell what no input does: at rest they would not.
    kinds = {n.kind for n in named} if around.combined else set()
    # Windows need their initial states.
    kinds -= {"initial_state"} if problem.window is not None else set()
    return analyse(
        sensitivity,
        unknowns,
        without_weak=_without_weak_priors(named, S, N),
        reported=reported,
        around=around,
        remedies=remedies | dict.fromkeys(around.aliased, _WITHOUT_ALIASES),
        switches=kinds,
    )
