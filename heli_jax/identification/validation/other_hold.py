"""What the estimates would be if the inputs moved otherwise between their samples."""

from collections.abc import Collection, Mapping
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from heli_jax import naming
from heli_jax.dynamics.jacobians import jacobians
from heli_jax.flights.flight import Flight
from heli_jax.identification.estimation.evaluation import Evaluation, evaluate
from heli_jax.identification.problem import Problem
from heli_jax.identification.unknowns.layout import Data, Layout, Noise

_NULL = 1e-8
"""Directions of the scaled Jacobian below this part of the largest stay where they are."""
_MOST = 3
"""parameters that are named"""


def other_hold(
    problem: Problem,
    layout: Layout,
    data: Data,
    noise: Noise,
    z: Any,
    e: Evaluation,
    sd: Mapping[str, float] | None = None,
    *,
    skip: Collection[str] = (),
    in_doubt: bool = False,
) -> list[str]:
    """A sentence where the other hold of the inputs that move would change an estimate by more
    than its standard deviation; nothing where it would not.

    One Gauss-Newton step from the same point, with r and r' the residuals with the hold taken and
    with the other: -J'^+ (r' - r). So it tells the change at any point, as if the record were that
    of the model there.

    Args:
        e: the evaluation at z with the holds taken.
        sd: by name, SI; what J and the noise let expect unless given.
        skip: unknowns that the data do not determine.
        in_doubt: only of inputs that their log let be taken as linear, since a command that changes
            at every sample looks the same; and nothing where an input acts on an output directly,
            which would need a program of its own, as long in compiling as that of the fit.
    """
    moving = [
        {
            n
            for n in naming.names(problem.model.Inputs)
            if np.ptp(f.inputs[n]) > 0
            and (not in_doubt or (f.hold[n] == "linear" and n in f.hold_reason))
        }
        for f in problem.training
    ]
    if not any(moving) or not np.all(np.isfinite(e.J)):
        return []
    if not _feeds_through(problem):
        other = evaluate(layout, _averaged(layout, data, moving), noise, z)
    elif not in_doubt:
        other = evaluate(_flipped(layout, moving), data, noise, z)
    else:
        return []
    if not (np.all(np.isfinite(other.J)) and np.all(np.isfinite(other.r))):
        return []
    q = len(layout.of_interest)
    change = _pseudoinverse(np.asarray(other.J))[:q] @ (np.asarray(e.r) - np.asarray(other.r))
    change = change * np.asarray(e.slopes)
    if sd is None:
        rows = _pseudoinverse(np.asarray(e.J))[:q]
        expected = np.linalg.norm(rows, axis=1) * np.abs(e.slopes)
        sd = dict(zip(layout.of_interest, expected.tolist(), strict=True))
    sizes = {
        n: (float(c), abs(float(c)) / sd[n])
        for n, c in zip(layout.of_interest, change, strict=True)
        if n not in skip and sd.get(n, 0.0) > 0
    }
    return _sentence(problem.training, moving, layout, e, sizes)


def _feeds_through(problem: Problem) -> bool:
    """Whether an input acts on an output at once, without the dynamics."""
    return bool(np.any(np.asarray(jacobians(problem.model, problem.start_params()).D)))


def _averaged(layout: Layout, data: Data, moving: list[set[str]]) -> Data:
    """Inputs that do under the hold taken what the given ones do under the other, but for terms of
    second order in the sample time: the same program serves.

    A linear input is that held at the mean of both ends of its interval; a held one is a linear one
    that is late by half a sample.
    """
    flights = []
    for i, (flight, names) in enumerate(zip(data.flights, moving, strict=True)):
        inputs = {}
        for n, u in naming.asdict(flight.inputs).items():
            beside = jnp.concatenate([u[1:], u[-1:]])
            if layout.hold(i)[n] == "linear":
                beside = jnp.concatenate([u[:1], u[:-1]])
            inputs[n] = 0.5 * (u + beside) if n in names else u
        flights.append(flight._replace(inputs=layout.model.Inputs(**inputs)))
    return data._replace(flights=jax.device_put(tuple(flights)))


def _flipped(layout: Layout, moving: list[set[str]]) -> Layout:
    names = naming.names(layout.model.Inputs)
    holds = tuple(
        tuple(_other(h) if n in moves else h for n, h in zip(names, taken, strict=True))
        for taken, moves in zip(layout.holds, moving, strict=True)
    )
    return replace(layout, holds=holds)


def _other(hold: str) -> str:
    return "zero-order" if hold == "linear" else "linear"


def _pseudoinverse(J: np.ndarray) -> np.ndarray:
    """(q, n), with columns brought to one size first."""
    norms = np.linalg.norm(J, axis=0)
    norms = np.where(norms > 0, norms, 1.0)
    return np.linalg.pinv(J / norms[None, :], rcond=_NULL) / norms[:, None]


def _sentence(
    flights: tuple[Flight, ...],
    moving: list[set[str]],
    layout: Layout,
    e: Evaluation,
    sizes: dict[str, tuple[float, float]],
) -> list[str]:
    large = sorted((n for n, (_, sds) in sizes.items() if sds > 1.0), key=lambda n: -sizes[n][1])
    if not large:
        return []
    taken = dict.fromkeys(
        f"{n} is taken as {f.hold[n]}"
        + (f" (it {f.hold_reason[n]})" if n in f.hold_reason else " (as stated)")
        for f, names in zip(flights, moving, strict=True)
        for n in f.inputs
        if n in names
    )
    values = dict(zip(layout.of_interest, np.asarray(e.named).tolist(), strict=True))
    said = [_changed(n, values[n], *sizes[n]) for n in large[:_MOST]]
    return [
        f"Between samples {', '.join(taken)}: with the other hold {', '.join(said)}. An input that "
        "was commanded in steps has hold: zero-order, one that was sampled while it moved has "
        "hold: linear."
    ]


def _changed(name: str, value: float, change: float, sds: float) -> str:
    if name == "time_shift":
        share = f"{1e3 * change:+.2g} ms"
    else:
        share = f"{100 * change / value:+.2g} %" if value else f"{change:+.2g}"
    return f"{name} would be about {share} off ({sds:.2g} sd)"
