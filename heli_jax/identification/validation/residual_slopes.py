"""What a simulation leaves of each output, which can be asked, and how the unknowns move it."""

import jax.numpy as jnp
import numpy as np

from heli_jax.identification.estimation.estimator import Evaluation
from heli_jax.identification.estimation.evaluation import simulated_outputs
from heli_jax.identification.estimation.measured_signals import signals
from heli_jax.identification.estimation.output_error import ESTIMATOR as OUTPUT_ERROR
from heli_jax.identification.unknowns.layout import Solution
from heli_jax.identification.validation.own_samples import OwnSamples, own_samples

_FLIGHTS = 6
"""that are looked at, the longest"""
_DIVERGED = -10.0
"""VAF of a simulation below which its residual says nothing"""
_ROUNDING = 1e-5
"""part of an output's sd below which its residual is no noise"""
_STEP = 1e-4
"""of an unknown's coordinate, for differences"""


def longest(at: Solution) -> list[int]:
    """The flights that are looked at, of one sample time: filters are of samples.

    Args:
        at: where the fit ended.
    """
    flights = at.data.flights
    sizes = [next(iter(f.outputs.values())).shape[0] for f in flights]
    order = np.argsort(sizes, kind="stable")[::-1].tolist()
    dt = float(flights[order[0]].dt)
    return sorted([i for i in order if np.isclose(float(flights[i].dt), dt)][:_FLIGHTS])


def usable(at: Solution, e: Evaluation, i: int, name: str) -> bool:
    """Whether an output was measured, moves, and is followed by a simulation that stays with it.

    Args:
        at: where the fit ended.
        e: what that tells.
        i: the flight.
        name: the output.
    """
    if name not in at.layout.outputs[i]:
        return False
    own = own_of(at, i, name)
    if own is None:
        return False
    y = np.asarray(at.data.flights[i].outputs[name])[own.rows]
    left = np.asarray(e.raw[i][name])[own.rows]
    if not (np.isfinite(left).all() and np.std(y) > 0):
        return False
    with np.errstate(over="ignore"):
        size = float(np.std(left) / np.std(y))
    return _ROUNDING < size < np.sqrt(1.0 - _DIVERGED)


def own_of(at: Solution, i: int, name: str) -> OwnSamples | None:
    """Where a flight's output was sampled.

    Args:
        at: where the fit ended.
        i: the flight.
        name: the output.
    """
    return own_samples(np.isfinite(np.asarray(at.data.flights[i].outputs[name])))


def of_one_clock(at: Solution, e: Evaluation, name: str) -> list[tuple[int, OwnSamples]]:
    """The flights whose residual of an output can be asked, and where it was sampled in each; of
    one clock, since filters are of samples.

    Args:
        at: where the fit ended.
        e: what that tells.
        name: the output.
    """
    flights = [(i, own_of(at, i, name)) for i in longest(at) if usable(at, e, i, name)]
    samples = [(i, own) for i, own in flights if own is not None]
    return [(i, own) for i, own in samples if own.every == samples[0][1].every]


def sensitivities(at: Solution, e: Evaluation) -> dict[tuple[int, str], np.ndarray]:
    """By flight and output (N, q) the derivative of the residual by all unknowns.

    Args:
        at: where the fit ended.
        e: what that tells.
    """
    layout, data, noise, z = at
    if layout.estimator is OUTPUT_ERROR:
        rows, J = {}, np.asarray(e.J)
        first = 0
        for i, n in signals(layout):
            count = data.flights[i].outputs[n].shape[0]
            rows[i, n] = J[first : first + count] * float(noise.sd[i][n])
            first += count
        return rows
    # By differences of the simulation, whose program is there: a Jacobian would compile another.
    z = np.asarray(z)
    blocks = _blocks(at)
    common = [np.array([k]) for k in range(layout.first_nuisance)]
    longest = max((b.size for b in blocks), default=0)
    # Each flight's own unknowns move at once: none is felt by another flight.
    own = [np.array([b[k] for b in blocks if k < b.size]) for k in range(longest)]
    before = simulated_outputs(layout, data, jnp.asarray(z))
    slopes = {(i, n): np.zeros((before[i][n].size, z.size)) for i, n in signals(layout)}
    step = _STEP if z.dtype == np.float64 else np.sqrt(_STEP)
    for columns in (*common, *own):
        there = z.copy()
        there[columns] += step
        after = simulated_outputs(layout, data, jnp.asarray(there))
        for i, n in signals(layout):
            for k in columns:
                if k < layout.first_nuisance or k in blocks[i]:
                    slopes[i, n][:, k] = (before[i][n] - after[i][n]) / step
    return slopes


def _blocks(at: Solution) -> list[np.ndarray]:
    """By flight where in z its own unknowns stand."""
    layout, first, out = at.layout, at.layout.first_nuisance, []
    for (count, _), outputs in zip(layout.windows, layout.outputs, strict=True):
        size = count * len(layout.states) + layout.constants(outputs)
        out.append(np.arange(first, first + size))
        first += size
    return out
