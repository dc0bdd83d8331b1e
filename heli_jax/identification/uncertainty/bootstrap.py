"""Parametric bootstrap: the machine found is simulated and identified again, many times."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from heli_jax import naming
from heli_jax.dynamics.model import correlation_of, initial_sd_of
from heli_jax.identification.estimation.levenberg_marquardt import optimise_many
from heli_jax.identification.estimation.residual import driven, predict
from heli_jax.identification.result import Fit
from heli_jax.identification.uncertainty.autocorrelated_residuals import drawn
from heli_jax.identification.unknowns.layout import Data, Reached, unpack, value_of
from heli_jax.simulation.simulate import simulate

_BATCH = 8


class Bootstrap(NamedTuple):
    """Estimates of made records."""

    values: dict[str, np.ndarray]
    """by free parameter, (runs that converged,)"""
    failures: int

    def interval(self, name: str) -> tuple[float, float]:
        """2.5 and 97.5 % of the values."""
        low, high = np.percentile(self.values[name], [2.5, 97.5])
        return float(low), float(high)


def bootstrap(fit: Fit, runs: int = 200, *, seed: int = 0) -> Bootstrap:
    """Refit `runs` records made with the estimates: same inputs, same missing samples, new noise.

    Filter error draws the disturbance anew. Output error adds white noise, or where its residuals
    are autocorrelated, noise with their covariance over time and between outputs. Means of priors
    are drawn anew too.

    Raises:
        ValueError: the time shift is free, or the data do not determine every parameter.
    """
    at = fit.reached
    if at.layout.shift:
        raise ValueError("bootstrap: not available with a free time shift")
    if fit.lost:
        raise ValueError(f"bootstrap: the data do not determine {', '.join(fit.lost)}")
    rng = np.random.default_rng(seed)
    outputs = _records(fit, at, runs, seed, rng)
    values = np.array([fit.estimates[n].value for n in at.layout.free])
    spread = np.where(np.isfinite(at.data.prior_sd), at.data.prior_sd, 0.0)
    means = values + spread * rng.standard_normal((runs, values.size))

    def data(each: tuple[Any, Array]) -> Data:
        flights = tuple(
            flight._replace(outputs=one)
            for flight, one in zip(at.data.flights, each[0], strict=True)
        )
        return at.data._replace(flights=flights, prior_mean=each[1])

    starts = jnp.tile(at.z[None, :], (runs, 1))
    each = (outputs, jnp.asarray(means, at.z.dtype))
    ends = optimise_many(at, data, starts, each, batch=_BATCH)
    fine = np.asarray(ends.converged)
    found = {
        name: np.asarray(value_of(at.layout, at.data, i, jnp.asarray(ends.z[fine, i])))
        for i, name in enumerate(at.layout.free)
    }
    return Bootstrap(found, int(runs - fine.sum()))


def _records(
    fit: Fit, at: Reached, runs: int, seed: int, rng: np.random.Generator
) -> tuple[dict[str, Array], ...]:
    """By flight and output (runs, N); NaN where the record has it."""
    u = unpack(at.layout, at.data, at.z)
    clean = None if at.layout.filtered else predict(at.layout, at.data, u)
    records = []
    for i, (flight, sds) in enumerate(zip(at.data.flights, at.noise.sd, strict=True)):
        if clean is None:
            keys = jax.random.split(jax.random.fold_in(jax.random.key(seed), i), runs)
            moved = _disturbed(at, u, i, keys)
        else:
            moved = dict(zip(at.layout.outputs[i], clean[i].outputs, strict=True))
        if fit.coloured:
            residuals = [fit.signals[i].residual(n) for n in at.layout.outputs[i]]
            coloured = drawn(np.stack(residuals), runs, rng)
        one = {}
        for n, y in flight.outputs.items():
            sd = float(sds[n]) * float(u.scales.get(n, 1.0))
            noise = sd * rng.standard_normal((runs, y.shape[0]))
            if fit.coloured:
                noise = coloured[:, at.layout.outputs[i].index(n)]
            made = np.asarray(moved[n]) + float(u.biases[i][n]) + noise
            one[n] = jnp.asarray(np.where(np.isnan(np.asarray(y)), np.nan, made), at.z.dtype)
        records.append(one)
    return tuple(records)


def _disturbed(at: Reached, u: Any, i: int, keys: Array) -> dict[str, Array]:
    """By name the outputs (runs, N) with a disturbance drawn for each key."""
    flight, layout = at.data.flights[i], at.layout
    params, inputs = driven(layout, at.data, u, i)
    start = u.states[i] if u.states[i] is not None else layout.model.initial_state(params)
    names, random = naming.names(layout.model.State), layout.model.random_states
    sds = initial_sd_of(layout.model, params, at.z.dtype)
    # Factored without the sds, which may be zero.
    correlation = correlation_of(layout.model, params, at.z.dtype)
    factor = sds[:, None] * jnp.linalg.cholesky(correlation)

    @jax.jit
    def run(key: Array) -> Any:
        first, second = jax.random.split(key)
        drawn = jnp.sum(factor * jax.random.normal(first, (1, len(names)), at.z.dtype), axis=1)
        values = {n: getattr(start, n) + drawn[names.index(n)] for n in random}
        begin = naming.replace(start, **values)
        return simulate(
            layout.model,
            params,
            inputs,
            dt=flight.dt,
            initial_state=begin,
            solver=layout.solver,
            substeps=layout.substeps,
            key=second,
            hold=layout.hold(i),
        ).outputs

    return naming.asdict(jax.lax.map(run, keys, batch_size=_BATCH))
