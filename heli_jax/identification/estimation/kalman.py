"""Kalman filters: one-step predictions of the measurements, and their errors.

Linear models get the exact discrete filter, others the extended one. It linearises the model in
every step and integrates the linear model exactly (Ozaki's local linearisation), so both filters
agree on a linear model. Models without fast modes use explicit steps (`_moments_after`). The
process noise is the exact discrete one. The measurement noise is white and independent between
outputs, which are processed one after another without inverting a matrix. NaN measurements are
skipped.
"""

from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Float

from heli_jax import naming
from heli_jax.dynamics.jacobians import jacobians
from heli_jax.dynamics.model import Model, correlation_of, initial_sd_of, require_continuous
from heli_jax.naming import Scalar
from heli_jax.numerics.matrix_exponential import product, van_loan
from heli_jax.simulation.discretize import process_noise
from heli_jax.simulation.hold import Segment, between_samples, delayed, delays_of, segments
from heli_jax.simulation.options import DEFAULT, SimulationOptions
from heli_jax.simulation.stepping import held_columns

# Params and Inputs are Any, because they are a model's own classes.

type Estimate = tuple[Float[Array, " n"], Float[Array, "n n"]]
"""A state and its covariance."""


class Drive(NamedTuple):
    """A model, its inputs along one record, and the measured outputs."""

    model: Model
    params: Any
    inputs: Any
    """The model's Inputs, arrays (N,)."""
    options: SimulationOptions
    linear: tuple[bool, ...]
    """For each input True if it changes between samples; () if none does."""
    rows: Array
    """Indices of the measured outputs among the model's outputs (p,)."""


class Filter(NamedTuple):
    """Functions of the model at a step of the filter; `samples` is a pytree of arrays (N, ...)."""

    samples: Any
    measure: Callable[[Array, Any], tuple[Array, Array]]
    """(state, sample) -> C (p, n), and the predicted outputs less C x (p,)."""
    move: Callable[[Array, Array, Any], Estimate]
    """(state, its covariance, sample) -> both at the next sample."""


# Mean and covariance of a state between samples by explicit steps, for models without fast modes.
#
# Local linearisation takes a matrix exponential in every step. It is stable for any mode, but keeps
# the equations of the step's start: a second-order error if inputs change. The classical
# Runge-Kutta method integrates the same moments to fourth order at a twentieth of the cost. It
# diverges if a mode is fast relative to the step.


def _moments_after(
    rates: Callable[[Array, Any], Array],
    intensity: Float[Array, " n"],
    moments: Estimate,
    part: Segment,
) -> Estimate:
    """Return the moments after one step: x' = f(x, u), P' = A P + P A' + diag(g^2), A = df/dx at x.

    Args:
        rates: f, a function of a state (n,) and Inputs, per second.
        intensity: g, of the process noise, see `Model.noise_intensity`.
        part: the step, with the inputs at its start and their slopes (None: constant inputs).

    Source: Jategaonkar (2006), chapter 5, for the extended filter's prediction; Runge-Kutta method
    of order 4.
    """
    spread, h = jnp.diag(jnp.square(intensity)), part.length

    def slopes(moments: Estimate, share: float) -> Estimate:
        (x, P), u = moments, part.inputs
        if part.slope is not None:
            u = jax.tree.map(lambda v, slope: v + slope * (share * h), u, part.slope)
        f, along = jax.linearize(lambda x: rates(x, u), x)
        # A P is computed column by column, because A itself is mostly zeros and not needed.
        AP = jax.vmap(along, in_axes=1, out_axes=1)(P)
        return f, AP + AP.T + spread

    def moved(by: Estimate, share: float) -> Estimate:
        return jax.tree.map(lambda v, slope: v + slope * (share * h), moments, by)

    first = slopes(moments, 0.0)
    second = slopes(moved(first, 0.5), 0.5)
    third = slopes(moved(second, 0.5), 0.5)
    fourth = slopes(moved(third, 1.0), 1.0)
    mean = jax.tree.map(
        lambda a, b, c, d: (a + 2.0 * (b + c) + d) / 6.0, first, second, third, fourth
    )
    return moved(mean, 1.0)


# The extended filter: the model is linearised at every estimate (Ozaki's local linearisation).


def _local(drive: Drive) -> Filter:
    """Return the extended filter: the model is linearised at every estimate (Ozaki, 1985)."""
    model, params, inputs, options, linear, measured = drive
    k = jnp.arange(jax.tree.leaves(inputs)[0].shape[0])
    dtype = jax.tree.leaves(inputs)[0].dtype
    dt = jnp.asarray(options.dt, dtype)
    delays = delays_of(model, params, options.delay, dt)
    # Outputs depend on the inputs that act at the samples.
    acting = inputs if delays is None else delayed(inputs, delays, k, linear)
    # A delayed sample takes effect within an interval; the previous one acts before. The lengths of
    # the parts are equal in all intervals, so they are not part of a sample.
    lengths, held, slopes = zip(*segments(inputs, dt, delays, k, linear), strict=True)

    def rates(x: Array, u: Any) -> Array:
        return naming.ravel(model.vector_field(params, naming.unravel(model.State, x), u), dtype)

    def outputs(x: Array, u: Any) -> Array:
        y = naming.ravel(model.output(params, naming.unravel(model.State, x), u), dtype)
        return y[measured]

    noise = model.noise_intensity
    none = jnp.zeros(len(naming.names(model.State)), dtype)
    intensity = none if noise is None else naming.ravel(noise(params), dtype)

    def along(estimate: Estimate, part: Segment) -> Estimate:
        """Return the estimate after a part of an interval, linearised in each of its substeps."""
        h = part.length / options.substeps

        def step(estimate: Estimate, j: Array) -> tuple[Estimate, None]:
            now = part.inputs
            if part.slope is not None:
                now = jax.tree.map(lambda u, slope: u + slope * (j * h), now, part.slope)
            after = _moments_after if model.explicit else _linearised_after
            return after(rates, intensity, estimate, Segment(h, now, part.slope)), None

        return jax.lax.scan(step, estimate, jnp.arange(options.substeps, dtype=dtype))[0]

    def measure(x: Array, sample: Any) -> tuple[Array, Array]:
        u = sample[1]
        C = jax.jacfwd(outputs)(x, u)
        return C, outputs(x, u) - jnp.sum(C * x[None, :], axis=1)

    def move(x: Array, P: Array, sample: Any) -> Estimate:
        held, _, slopes = sample
        estimate = (x, P)
        for part in zip(lengths, held, slopes, strict=True):
            estimate = along(estimate, Segment(*part))
        return estimate

    return Filter((held, acting, slopes if linear else (None,) * len(held)), measure, move)


def _linearised_after(
    rates: Callable[[Array, Any], Array],
    intensity: Float[Array, " n"],
    moments: Estimate,
    part: Segment,
) -> Estimate:
    """Return the moments after one step of the model linearised at its start.

    The arguments are those of `_moments_after`.
    """
    x, P = moments
    n, A, f = x.shape[0], jax.jacfwd(rates)(x, part.inputs), rates(x, part.inputs)
    if part.slope is not None:
        # Time is an additional state of rate 1 without variance. Its derivatives make the step of a
        # linear model exact.
        _, by_time = jax.jvp(lambda u: rates(x, u), (part.inputs,), (part.slope,))
        A = jnp.pad(A, (0, 1)).at[:n, n].set(by_time)
        f, intensity = jnp.pad(f, (0, 1), constant_values=1.0), jnp.pad(intensity, (0, 1))
    # A and f are evaluated at x, so the shift is the full step of the linearised equation.
    step = van_loan(A, f, intensity, part.length)
    Phi = step.Phi[:n, :n]
    return x + step.shift[:n], product(product(Phi, P), Phi.T) + step.Q[:n, :n]


_ONLY_SIMULATE = (
    "solver", "controller", "adjoint", "max_steps", "key", "block", "feedback", "events",
)  # fmt: skip
"""Options of a simulation that a filter lacks."""


class Innovations(NamedTuple):
    """One-step predictions against measurements, by output.

    Arrays are (N,), NaN without measurement.
    """

    error: dict[str, Float[Array, " N"] | np.ndarray]
    """Measured less predicted from all earlier samples, SI."""
    variance: dict[str, Float[Array, " N"] | np.ndarray]
    """Variance of the error according to the filter."""


def innovations(
    model: Model,
    params: Any,
    inputs: Any,
    measured: Mapping[str, Float[Array, " N"]],
    sd: Mapping[str, Scalar],
    options: SimulationOptions = DEFAULT,
    **keywords: Any,
) -> Innovations:
    """Run the (extended) Kalman filter of a model over one record.

    Args:
        model: model of n states; those in `model.initial_sd` are uncertain at the first sample by
            that standard deviation (and `model.correlation`), the others are exact.
        params: the model's Params, SI.
        inputs: the model's Inputs, arrays (N,).
        measured: outputs (N,), SI; NaN without measurement.
        sd: standard deviation of the white measurement noise, by output, SI.
        options: dt [s], initial_state, delay [s], hold and substeps are used; substeps are
            linearisations of each sample in nonlinear models.
        **keywords: fields that replace those of `options`.

    Raises:
        TypeError: dt is missing, or an option that only `simulate` has.

    Source: Kalman (1960); the covariance's integral in Van Loan (1978); local linearisation by
    Ozaki (1985).
    """
    drive, (x, P), y, R = filter_start(
        model, params, inputs, measured, sd, options.changed(keywords)
    )
    filter_ = filter_of(drive)

    def step(carry: Estimate, sample: tuple[Array, Any]) -> tuple[Any, Any]:
        y, now = sample
        estimate, innovation = corrected(filter_, carry, R, y, now)
        x, P = filter_.move(*estimate, now)
        # Phi P Phi' is symmetric except for rounding, which the corrections would keep.
        return (x, 0.5 * (P + P.T)), innovation

    return by_name(measured, *jax.lax.scan(step, (x, P), (y, filter_.samples))[1])


def filter_start(
    model: Model,
    params: Any,
    inputs: Any,
    measured: Mapping[str, Float[Array, " N"]],
    sd: Mapping[str, Scalar],
    options: SimulationOptions,
) -> tuple[Drive, Estimate, Float[Array, "N p"], Float[Array, " p"]]:
    """Return the drive of a filter, its first estimate, the measurements and their noise variances.

    The arguments are those of `innovations`.
    """
    if options.dt is None:
        raise TypeError("innovations: expected dt, the sample time in seconds, got None")
    for name in _ONLY_SIMULATE:
        if getattr(options, name) is not getattr(DEFAULT, name):
            raise TypeError(f"innovations: expected no {name}, which only simulate has")
    model, inputs, linear = between_samples(model, inputs, inputs, options.hold)
    begin = options.initial_state
    x0 = model.initial_state(params) if begin is None else begin
    dtype = jax.tree.leaves(inputs)[0].dtype
    estimate = naming.ravel(x0, dtype), first_covariance(model, params, dtype)
    require_continuous(model, "a Kalman filter")
    # Unmeasured outputs are dropped, because each output costs a correction per sample.
    rows = jnp.asarray([naming.names(model.Outputs).index(n) for n in measured])
    y = jnp.stack(list(measured.values()), axis=1)
    R = jnp.stack([jnp.asarray(sd[n], dtype) ** 2 for n in measured])
    return Drive(model, params, inputs, options, linear, rows), estimate, y, R


def by_name(names: Iterable[str], errors: Array, variances: Array) -> Innovations:
    """Name the columns of arrays (N, p)."""
    names = list(names)
    return Innovations(
        dict(zip(names, errors.T, strict=True)), dict(zip(names, variances.T, strict=True))
    )


def first_covariance(model: Model, params: Any, dtype: DTypeLike) -> Float[Array, "n n"]:
    """Return the covariance of the state at the first sample (P0)."""
    sds = initial_sd_of(model, params, dtype)
    return correlation_of(model, params, dtype) * sds[:, None] * sds[None, :]


def filter_of(drive: Drive) -> Filter:
    """Return the exact filter of a linear model, else the extended one."""
    model, params, options = drive.model, drive.params, drive.options
    if not model.linear:
        return _local(drive)
    _, _, C, D = jacobians(model, params)
    C, D = C[drive.rows], D[drive.rows]
    Ad, B, U, acting = held_columns(
        model, params, drive.inputs, options.dt, options.delay, drive.linear
    )
    Q = process_noise(model, params, options.dt)

    def move(x: Array, P: Array, now: tuple[Array, Array]) -> Estimate:
        # A sum of products replaces Ad @ x, whose derivative costs ten times as much.
        x = jnp.sum(Ad * x[None, :], axis=1) + now[0]
        return x, product(product(Ad, P), Ad.T) + Q

    # One matrix product gives the effect of the inputs at all samples. C is constant.
    return Filter((U @ B.T, acting @ D.T), lambda x, now: (C, now[1]), move)


def corrected(
    filter_: Filter, estimate: Estimate, R: Array, y: Array, now: Any
) -> tuple[Estimate, tuple[Array, Array]]:
    """Return the estimate after one sample's outputs (p,), and their innovations.

    The outputs are processed one after another. Errors and variances of the innovations are (p,).
    """

    def correct(carry: Estimate, measured: tuple[Array, ...]) -> tuple[Any, Any]:
        (x, P), (c, rest, r, y) = carry, measured
        p = jnp.sum(P * c[None, :], axis=1)
        s = jnp.sum(c * p) + r
        seen = jnp.isfinite(y)
        e = jnp.where(seen, y, 0.0) - rest - jnp.sum(c * x)
        gain = jnp.where(seen, 1.0 / s, 0.0)
        x, P = x + p * (gain * e), P - p[:, None] * (gain * p)[None, :]
        return (x, P), (jnp.where(seen, e, jnp.nan), jnp.where(seen, s, jnp.nan))

    C, rest = filter_.measure(estimate[0], now)
    return jax.lax.scan(correct, estimate, (C, rest, R, y))
