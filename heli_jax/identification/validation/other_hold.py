"""What the estimates would be if the inputs moved otherwise between their samples, and which of the
two the record bears out.
"""

from collections.abc import Collection, Mapping
from dataclasses import replace
from typing import NamedTuple

import jax
import numpy as np

from heli_jax import naming
from heli_jax.dynamics.jacobians import jacobians
from heli_jax.flights.flight import Flight
from heli_jax.flights.holds import is_low_passed
from heli_jax.identification.estimation.evaluation import (
    Evaluation,
    directions,
    evaluate,
    pseudoinverse,
)
from heli_jax.identification.identifiability.profile import deviance_of
from heli_jax.identification.problem import Problem
from heli_jax.identification.unknowns.layout import Data, Layout, Solution
from heli_jax.numerics.jumps import split

BEYOND_DOUBT = 20.0
"""gain in twice the log-likelihood from which on the record contradicts the hold"""


class OtherHold(NamedTuple):
    """Effect of the other hold of the inputs."""

    changes: dict[str, tuple[float, float]]
    """by unknown how far it would change [SI], and the same in standard deviations"""
    gain: float
    """of twice the log-likelihood, to first order; 0 unless asked of inputs in doubt"""


def other_hold(
    problem: Problem,
    at: Solution,
    e: Evaluation,
    sd: Mapping[str, float] | None = None,
    *,
    skip: Collection[str] = (),
    in_doubt: bool = False,
) -> OtherHold | None:
    """Return the effect of the other hold of the inputs that move; None if it is not known.

    Args:
        at: the point, with the layout and the numbers that it belongs to.
        sd: by name, SI; what J and the noise let expect unless given.
        in_doubt: only of inputs that their log let be taken as linear, since a command that changes
            at every sample looks the same; and nothing where an input acts on an output directly,
            which would need a program of its own, as long in compiling as that of the fit.
    """
    moving = [moving_inputs(problem, f, in_doubt) for f in problem.training]
    if not any(moving) or not np.all(np.isfinite(e.J)):
        return None
    # Other inputs to the same program in place of another program: compiling costs far more than an
    # evaluation.
    if not feeds_through(problem):
        other = evaluate(at.layout, _averaged(at.layout, at.data, moving), at.noise, at.z)
    elif not in_doubt:
        other = evaluate(_flipped(at.layout, moving), at.data, at.noise, at.z)
    else:
        return None
    if not _is_finite(other):
        return None
    names = at.layout.of_interest
    change = _change(e, other, len(names))
    if sd is None:
        sd = dict(zip(names, _white_sd(e, len(names)).tolist(), strict=True))
    changes = {
        n: (float(c), abs(float(c)) / sd[n])
        for n, c in zip(names, change, strict=True)
        if n not in skip and sd.get(n, 0.0) > 0
    }
    return OtherHold(changes, deviance_of(at, _least(other), _least(e)) if in_doubt else 0.0)


def _least(e: Evaluation) -> float:
    """The smallest sum of squares to first order about a point."""
    r, J = np.asarray(e.r, np.float64), np.asarray(e.J, np.float64)
    taken = directions(J).T @ r
    return float(r @ r - taken @ taken)


def _is_finite(e: Evaluation) -> bool:
    return bool(np.all(np.isfinite(e.J)) and np.all(np.isfinite(e.r)))


def moving_inputs(problem: Problem, flight: Flight, in_doubt: bool) -> set[str]:
    """The inputs whose hold matters.

    Args:
        in_doubt: those alone whose log let a straight line be taken.
    """
    return {
        n
        for n in naming.names(problem.model.Inputs)
        # What stays constant is the same under either hold.
        if np.ptp(flight.inputs[n]) > 0
        and not is_low_passed(flight, n)
        and (not in_doubt or (flight.hold[n] != "zero-order" and n in flight.hold_reason))
    }


def _change(e: Evaluation, other: Evaluation, q: int) -> np.ndarray:
    """By how much the other hold would move the first q unknowns (q,), SI."""
    # One Gauss-Newton step from the same point, with r and r' the residuals with the hold taken and
    # with the other: -J'^+ (r' - r). The difference, not r' itself: so it tells the change at any
    # point, also far from an optimum, as if the record were that of the model there.
    change = pseudoinverse(np.asarray(other.J))[:q] @ (np.asarray(e.r) - np.asarray(other.r))
    # From the optimiser's coordinates to the parameters' units.
    return change * np.asarray(e.slopes)


def _white_sd(e: Evaluation, q: int) -> np.ndarray:
    """Standard deviations (q,) of the first unknowns with white noise, SI."""
    # The rows of a pseudoinverse of whitened residuals are as long as the sds.
    return np.linalg.norm(pseudoinverse(np.asarray(e.J))[:q], axis=1) * np.abs(e.slopes)


def feeds_through(problem: Problem) -> bool:
    """Whether an input acts on an output at once, without the dynamics."""
    # At the start values and zero inputs: a term that vanishes there is taken for none.
    return bool(np.any(np.asarray(jacobians(problem.model, problem.start_params()).D)))


def _averaged(layout: Layout, data: Data, moving: list[set[str]]) -> Data:
    """Inputs that do under the hold taken what the given ones do under the other, but for terms of
    second order in the sample time: the same program serves.

    A linear input is that held at the mean of both ends of its interval; a held one is a linear one
    that is late by half a sample. A mixed one is held where it jumps already.
    """
    # Only where nothing is fed through: at the sample itself the mean of two is another value.
    flights = []
    for i, (flight, names) in enumerate(zip(data.flights, moving, strict=True)):
        inputs = {}
        for n, u in naming.asdict(flight.inputs).items():
            # In NumPy: each operation by itself would be a program to load.
            u = np.asarray(u)
            stairs, moving_part = split(u) if layout.hold(i)[n] == "mixed" else (0.0 * u, u)
            beside = np.concatenate([u[1:], u[-1:]])
            if layout.hold(i)[n] != "zero-order":
                beside = np.concatenate([moving_part[:1], moving_part[:-1]])
            inputs[n] = stairs + 0.5 * (moving_part + beside) if n in names else u
        flights.append(flight._replace(inputs=layout.model.Inputs(**inputs)))
    return data._replace(flights=jax.device_put(tuple(flights)))


def _flipped(layout: Layout, moving: list[set[str]]) -> Layout:
    """The layout with the other hold of the inputs that move, exact and compiled anew."""
    names = naming.names(layout.model.Inputs)
    holds = tuple(
        tuple(_other(h) if n in moves else h for n, h in zip(names, taken, strict=True))
        for taken, moves in zip(layout.holds, moving, strict=True)
    )
    return replace(layout, holds=holds)


def _other(hold: str) -> str:
    return "linear" if hold == "zero-order" else "zero-order"
