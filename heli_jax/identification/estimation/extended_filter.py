"""The extended filter: a model linearised anew at every estimate (Ozaki's local linearisation)."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from heli_jax import naming
from heli_jax.identification.estimation.filter_step import Drive, Estimate, Filter
from heli_jax.identification.estimation.moments import moments_after
from heli_jax.numerics.matrix_exponential import product, van_loan
from heli_jax.simulation.hold import Segment, delayed, delays_of, segments

# Inputs are a model's own class: they are annotated Any.


class _Equations(NamedTuple):
    """A model's equations over vectors, to be linearised anew at every estimate."""

    rates: Callable[[Array, Any], Array]
    """(state (n,), Inputs) -> (n,), per second"""
    outputs: Callable[[Array, Any], Array]
    """(state (n,), Inputs) -> what is measured (p,)"""
    intensity: Float[Array, " n"]
    """of the process noise, see `Model.noise_intensity`"""
    explicit: bool
    """see `Model.explicit`"""


def _equations(drive: Drive) -> _Equations:
    model, params = drive.model, drive.params
    dtype = jax.tree.leaves(drive.inputs)[0].dtype
    intensity = (
        jnp.zeros(len(naming.names(model.State)), dtype)
        if model.noise_intensity is None
        else naming.ravel(model.noise_intensity(params), dtype)
    )

    def rates(x: Array, u: Any) -> Array:
        return naming.ravel(model.vector_field(params, naming.unravel(model.State, x), u), dtype)

    def outputs(x: Array, u: Any) -> Array:
        y = naming.ravel(model.output(params, naming.unravel(model.State, x), u), dtype)
        return y[drive.rows]

    return _Equations(rates, outputs, intensity, model.explicit)


class _Intervals(NamedTuple):
    """The sample intervals, in parts within which every input stays or follows a straight line."""

    lengths: tuple[Any, ...]
    """of each part [s]; the same in all intervals, so no part of a sample"""
    inputs: tuple[Any, ...]
    """at the begin of each part, the model's Inputs with arrays (N,)"""
    slopes: tuple[Any, ...] | None
    """of the inputs in each part, per second; None where all of them stay"""
    acting: Any
    """the Inputs (N,) at the samples themselves, when what is measured is measured"""


def _intervals(drive: Drive) -> _Intervals:
    inputs, linear = drive.inputs, drive.linear
    # The linear filter has its drive from `held_columns`; here steps need the inputs themselves.
    first = jax.tree.leaves(inputs)[0]
    k, dt = jnp.arange(first.shape[0]), jnp.asarray(drive.options.dt, first.dtype)
    delays = delays_of(drive.model, drive.params, drive.options.delay, dt)
    acting = inputs if delays is None else delayed(inputs, delays, k, linear)
    # A late sample arrives within an interval: before it the one before it still acts.
    lengths, held, slopes = zip(*segments(inputs, dt, delays, k, linear), strict=True)
    return _Intervals(lengths, held, slopes if linear else None, acting)


def local_filter(drive: Drive) -> Filter:
    """The extended filter: the model linearised at every estimate (Ozaki, 1985)."""
    equations, intervals = _equations(drive), _intervals(drive)

    def measure(x: Array, sample: Any) -> tuple[Array, Array]:
        # With the inputs that act at the sample, which no part of an interval begins with when they
        # are late.
        u = sample[1]
        C = jax.jacfwd(equations.outputs)(x, u)
        return C, equations.outputs(x, u) - jnp.sum(C * x[None, :], axis=1)

    def move(x: Array, P: Array, sample: Any) -> Estimate:
        """The state and its covariance a sample on, along the linearised model.

        Args:
            x: (n,), corrected.
            P: (n, n).
            sample: inputs and slopes of each part of the interval.
        """
        held, _, slopes = sample
        estimate = (x, P)
        slopes = (None,) * len(held) if slopes is None else slopes
        for part in zip(intervals.lengths, held, slopes, strict=True):
            estimate = _along(equations, estimate, Segment(*part), drive.options.substeps)
        return estimate

    samples = (intervals.inputs, intervals.acting, intervals.slopes)
    return Filter(samples, measure, move)


def _along(equations: _Equations, estimate: Estimate, part: Segment, substeps: int) -> Estimate:
    """The estimate after a part of an interval, linearised anew in each of its substeps."""
    # With no slope nothing in the loop depends on time, and it needs no counter.
    h = part.length / substeps
    if part.slope is None:
        return jax.lax.scan(
            lambda estimate, _: (_held_step(equations, estimate, h, part.inputs), None),
            estimate,
            None,
            length=substeps,
        )[0]

    def step(estimate: Estimate, j: Array) -> tuple[Estimate, None]:
        now = jax.tree.map(lambda u, slope: u + slope * (j * h), part.inputs, part.slope)
        return _ramped_step(equations, estimate, part._replace(length=h, inputs=now)), None

    return jax.lax.scan(step, estimate, jnp.arange(substeps, dtype=estimate[0].dtype))[0]


def _held_step(equations: _Equations, estimate: Estimate, h: Array, u: Any) -> Estimate:
    (x, P), rates = estimate, equations.rates
    if equations.explicit:
        return moments_after(rates, equations.intensity, estimate, Segment(h, u, None))
    # With J and f at x itself: shift is the whole step of the linearised equation from there.
    step = van_loan(jax.jacfwd(rates)(x, u), rates(x, u), equations.intensity, h)
    return x + step.shift, product(product(step.Phi, P), step.Phi.T) + step.Q


def _ramped_step(equations: _Equations, estimate: Estimate, part: Segment) -> Estimate:
    """`_held_step` where the inputs move."""
    (x, P), rates = estimate, equations.rates
    if equations.explicit:
        return moments_after(rates, equations.intensity, estimate, part)
    n, dtype = x.shape[0], x.dtype
    # Time is a state more, whose rate is 1: the column of derivatives by time then makes the step
    # of a linear model exact (local linearisation of an equation that depends on time).
    _, by_time = jax.jvp(lambda u: rates(x, u), (part.inputs,), (part.slope,))
    unit, zero = jnp.ones(1, dtype), jnp.zeros(1, dtype)
    A = jnp.zeros((n + 1, n + 1), dtype).at[:n, :n].set(jax.jacfwd(rates)(x, part.inputs))
    step = van_loan(
        A.at[:n, n].set(by_time),
        jnp.concatenate([rates(x, part.inputs), unit]),
        # Time itself is certain: no noise acts on it.
        jnp.concatenate([equations.intensity, zero]),
        part.length,
    )
    Phi = step.Phi[:n, :n]
    return x + step.shift[:n], product(product(Phi, P), Phi.T) + step.Q[:n, :n]
