"""The one residual: fit, identifiability and uncertainty all differentiate this function.

For flight f and output j the residual is (measured - bias - simulated) / sd (output error), or the
whitened innovation of a Kalman filter (filter error); prior rows (value - mean) / sd follow.
"""

from typing import Any, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from heli_jax import naming
from heli_jax.identification.kalman import Innovations, innovations
from heli_jax.identification.layout import Data, FlightData, Layout, Noise, Unknowns, unpack
from heli_jax.simulation.simulate import Trajectory, simulate

_FLOOR = 1e-3
"""The likelihood's row stays real however far the noise falls; the next round has another level."""


def driven(layout: Layout, data: Data, u: Unknowns, flight: FlightData) -> tuple[Any, Any]:
    """Parameters and inputs of one flight at the unknowns."""
    params = layout.model.Params(**{**data.base, **u.params, **u.noise, **flight.known})
    inputs = naming.asdict(flight.inputs)
    inputs = {n: v * u.gains[n] if n in u.gains else v for n, v in inputs.items()}
    return params, layout.model.Inputs(**inputs)


def predict(layout: Layout, data: Data, u: Unknowns) -> tuple[Trajectory, ...]:
    """The simulated flights (without bias)."""
    out = []
    for flight, state in zip(data.flights, u.states, strict=True):
        params, inputs = driven(layout, data, u, flight)
        out.append(
            simulate(
                layout.model,
                params,
                inputs,
                dt=flight.dt,
                initial_state=state,
                solver=layout.solver,
                substeps=layout.substeps,
                delay=u.shift,
                block=layout.block,
                adjoint=dfx.ForwardMode(),
            )
        )
    return tuple(out)


def filtered(layout: Layout, data: Data, noise: Noise, u: Unknowns) -> tuple[Innovations, ...]:
    """The innovations of every flight."""
    out = []
    for flight, state, bias, sd in zip(data.flights, u.states, u.biases, noise.sd, strict=True):
        params, inputs = driven(layout, data, u, flight)
        out.append(
            innovations(
                layout.model,
                params,
                inputs,
                {n: y - bias[n] for n, y in flight.outputs.items()},
                {n: s * u.scales[n] if n in u.scales else s for n, s in sd.items()},
                dt=flight.dt,
                initial_state=state,
                delay=u.shift,
                substeps=layout.substeps,
            )
        )
    return tuple(out)


def _likelihood_rows(
    layout: Layout, data: Data, noise: Noise, found: tuple[Innovations, ...]
) -> Array:
    r"""Rows whose sum of squares is minus twice the log-likelihood but for a constant; zero where
    nothing is measured.

    $e_k/\sqrt{s_k}$, and with the common scale of all noise concentrated out each times
    $\exp(\tfrac12(\overline{\log s} - level))$; else one row more, whose square is
    $N(1 + \overline{\log s} - level)$.
    """
    whitened, logs, count = [], 0.0, 0.0
    for flight, one, sd in zip(data.flights, found, noise.sd, strict=True):
        for n, y in flight.outputs.items():
            seen = jnp.isfinite(y)
            s = jnp.where(seen, one.variance[n], 1.0)
            whitened.append(jnp.where(seen, one.error[n], 0.0) / jnp.sqrt(s))
            logs += jnp.sum(jnp.where(seen, jnp.log(s / sd[n] ** 2), 0.0))
            count += jnp.sum(seen.astype(y.dtype))
    rows, above = jnp.concatenate(whitened), logs / count - noise.level
    if layout.concentrated:
        return rows * jnp.exp(0.5 * above)
    last = jnp.sqrt(count * jnp.maximum(1.0 + above, _FLOOR))
    return jnp.concatenate([rows, last[None]])


def prior_rows(layout: Layout, data: Data, z: Float[Array, " q"]) -> Float[Array, " r"]:
    """(value - mean) / sd of the parameters' priors; zero where there is none."""
    u = unpack(layout, data, z)
    values = jnp.stack(list(u.params.values()))
    return (values - data.prior_mean) / data.prior_sd


def weak_rows(layout: Layout, z: Float[Array, " q"]) -> Float[Array, " r"]:
    """Weak priors of the initial states and biases: their coordinates are in units of its sd."""
    return z[layout.weak :]


def _simulation_rows(data: Data, noise: Noise, raw: Any) -> Array:
    return jnp.concatenate(
        [
            jnp.where(jnp.isfinite(y), by_name[n], 0.0) / sd[n]
            for flight, by_name, sd in zip(data.flights, raw, noise.sd, strict=True)
            for n, y in flight.outputs.items()
        ]
    )


def _rows(layout: Layout, data: Data, noise: Noise, z: Array, errors: Any) -> Array:
    """All rows from the innovations, or from measured - bias - simulated."""
    if layout.filtered:
        rows = _likelihood_rows(layout, data, noise, errors)
    else:
        rows = _simulation_rows(data, noise, errors)
    return jnp.concatenate([rows, prior_rows(layout, data, z), weak_rows(layout, z)])


def rows_of(layout: Layout, data: Data, noise: Noise, z: Float[Array, " q"]) -> Array:
    """The rows whose squares are summed, without their derivative."""
    u = unpack(layout, data, z)
    if layout.filtered:
        return _rows(layout, data, noise, z, filtered(layout, data, noise, u))
    return _rows(layout, data, noise, z, _raw(data, u, predict(layout, data, u)))


def _raw(data: Data, u: Unknowns, runs: tuple[Trajectory, ...]) -> tuple[dict[str, Any], ...]:
    return tuple(
        {n: y - bias[n] - getattr(run.outputs, n) for n, y in flight.outputs.items()}
        for flight, run, bias in zip(data.flights, runs, u.biases, strict=True)
    )


def _simulated(u: Unknowns, runs: tuple[Trajectory, ...]) -> tuple[dict[str, Any], ...]:
    return tuple(
        {n: bias[n] + getattr(run.outputs, n) for n in bias}
        for run, bias in zip(runs, u.biases, strict=True)
    )


class Evaluation(NamedTuple):
    """Everything that one differentiated run tells."""

    simulated: tuple[dict[str, Any], ...]
    """with the bias, SI, by flight and output"""
    raw: tuple[dict[str, Any], ...]
    """measured - simulated, SI, by flight and output; NaN where nothing is measured"""
    state_rms: tuple[dict[str, Any], ...]
    """root mean square of each simulated state, by flight"""
    innovations: tuple[Innovations, ...]
    """by flight; none with output error"""
    r: Any
    """(n,) whitened residuals with prior rows"""
    J: Any
    """(n, q) derivative of r by z"""
    named: Any
    """values of the named unknowns"""
    slopes: Any
    """their derivatives by their own coordinates"""


@eqx.filter_jit
def evaluate(layout: Layout, data: Data, noise: Noise, z: Float[Array, " q"]) -> Evaluation:
    """Residuals, their Jacobian in forward mode, and the named unknowns, in one pass.

    The residual: measured - bias - simulated over sd for all flights and outputs (output error),
    or the whitened innovations (filter error), then the priors' rows (value - mean) / sd, then
    the weak priors' rows.
    """

    def rows(z: Array) -> tuple[Array, Any]:
        u = unpack(layout, data, z)
        runs, found = None, ()
        if layout.filtered:
            found = filtered(layout, data, noise, u)
        else:
            runs = predict(layout, data, u)
        r = _rows(layout, data, noise, z, found if runs is None else _raw(data, u, runs))
        return r, (r, runs, found)

    def named(z: Array) -> Array:
        u = unpack(layout, data, z)
        shift = () if u.shift is None else (u.shift,)
        return jnp.stack([*u.params.values(), *u.gains.values(), *shift])

    J, (r, runs, found) = jax.jacfwd(rows, has_aux=True)(z)
    slopes = jnp.diagonal(jax.jacfwd(named)(z))
    u = unpack(layout, data, z)
    runs = predict(layout, data, u) if runs is None else runs
    return Evaluation(
        _simulated(u, runs),
        _raw(data, u, runs),
        tuple(_rms(run.states) for run in runs),
        found,
        r,
        J,
        named(z),
        slopes,
    )


def _rms(states: Any) -> dict[str, Any]:
    return {n: jnp.sqrt(jnp.mean(jnp.square(v))) for n, v in naming.asdict(states).items()}
