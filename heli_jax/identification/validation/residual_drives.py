"""What may drive what a model lacks.

The inputs, what is not linear of them and of the response, and what parameters do that change.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float

from heli_jax import naming
from heli_jax.identification.estimation.estimator import Evaluation
from heli_jax.identification.unknowns.layout import Solution
from heli_jax.identification.validation.score_test import Lines

_PLAY = 0.1
"""part of an input's range that a linkage's play is asked for with; other plays answer alike"""


def moving_inputs(at: Solution) -> list[str]:
    """The inputs that move in some flight.

    Args:
        at: where the fit ended.
    """
    flights = [naming.asdict(f.inputs) for f in at.data.flights]
    return [n for n in flights[0] if any(np.ptp(np.asarray(u[n])) > 0 for u in flights)]


def drives(
    at: Solution, e: Evaluation, i: int, name: str, moving: Sequence[str]
) -> Float[np.ndarray, "N d"]:
    """The inputs that move, then what is not linear of these and of `motions`, and what a linkage
    with play keeps of the inputs.

    Args:
        at: where the fit ended.
        e: what that tells.
        i: the flight.
        name: the output.
        moving: of `moving_inputs`.
    """
    inputs = naming.asdict(at.data.flights[i].inputs)
    u = [_normal(np.asarray(inputs[n])) for n in moving]
    y = np.asarray(e.simulated[i][name])
    response = [_normal(v) for v in motions(y)]
    curved = [w for v in (*u, *response) for w in (np.abs(v) * v, v**2)]
    # Friction has a sign and no size.
    curved += [np.sign(v) for v in response[:2]]
    # What play takes off hangs on where the stick came from, not on where it is: no power does.
    return np.stack([*u, *curved, *(v - _behind_play(v) for v in u)], axis=1)


def motions(y: np.ndarray) -> tuple[np.ndarray, ...]:
    """A simulated output (N,), its rate and its integral: a spring that is not linear acts by the
    angle, of which only the rate may be measured."""
    return y, np.gradient(y), np.cumsum(y - y.mean())


def _behind_play(v: np.ndarray) -> np.ndarray:
    """Where a signal (N,) takes what follows it with play."""
    half, at, out = 0.5 * _PLAY * float(np.ptp(v)), 0.0, []
    # A stick that is held for many samples moves at a few of them.
    begins = np.flatnonzero(np.diff(v, prepend=np.nan))
    for x in v[begins].tolist():
        at = min(max(at, x - half), x + half)
        out.append(at)
    return np.repeat(out, np.diff(begins, append=v.size))


def _normal(v: np.ndarray) -> np.ndarray:
    v = v - v.mean()
    size = float(np.std(v))
    return v / size if size > 0 else v


def changing(
    at: Solution, J: Mapping[tuple[int, str], np.ndarray], name: str, flights: Sequence[int]
) -> dict[int, np.ndarray]:
    """By flight (N, 2 k) what a change of each parameter over time does to the residual: a steady
    one over the flights in their order, and one halfway.

    Args:
        at: where the fit ended.
        J: by flight and output (N, q) the derivative of the residual by all unknowns.
        name: the output.
        flights: those that are looked at.
    """
    k, sizes = len(at.layout.of_interest), [J[i, name].shape[0] for i in flights]
    t = np.linspace(-1.0, 1.0, sum(sizes))
    each = zip(flights, np.split(t, np.cumsum(sizes)[:-1]), strict=True)
    return {
        i: np.concatenate([J[i, name][:, :k] * shape[:, None] for shape in (s, np.sign(s))], axis=1)
        for i, s in each
    }


def of_single_flights(lines: Sequence[Lines], k: int) -> list[Lines]:
    """With k further drives a record: what a change of each parameter in that record alone does.

    Args:
        lines: of each record.
        k: how many of the unknowns, the first, are parameters.
    """
    out = []
    for i, record in enumerate(lines):
        more = np.zeros((record.e.size, k * len(lines)), complex)
        more[:, k * i : k * (i + 1)] = record.J[:, :k]
        out.append(record._replace(drives=np.concatenate([record.drives, more], axis=1)))
    return out
