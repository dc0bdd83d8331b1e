"""Bootstrap: records about the estimated machine's response are identified again, many times."""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from heli_jax.identification.estimation.many_runs import optimise_many
from heli_jax.identification.result import Fit
from heli_jax.identification.uncertainty.autocorrelated_residuals import drawn
from heli_jax.identification.uncertainty.spectrum_bootstrap import refits
from heli_jax.identification.unknowns.layout import Data, Solution, unpack, value_of

_BATCH = 8
"""records refitted together: more wait for the slowest of them, and take its memory"""


class Bootstrap(NamedTuple):
    """Estimates from simulated records."""

    values: dict[str, np.ndarray]
    """by free parameter, (runs that converged,)"""
    failures: int
    """runs that did not converge"""
    records: tuple[int, ...] = ()
    """the numbers of the records that these are of"""
    note: str = ""
    """why many records were not fitted by programs of machine code, where they were not"""

    def interval(self, name: str) -> tuple[float, float]:
        """2.5 and 97.5 % of the values."""
        low, high = np.percentile(self.values[name], [2.5, 97.5])
        return float(low), float(high)


def bootstrap(fit: Fit, runs: int = 200, *, seed: int = 0) -> Bootstrap:
    """Refit records simulated with the estimates: same inputs, same missing samples, new noise.

    Filter error draws the disturbance anew. Output error adds white noise, or where its residuals
    are autocorrelated, noise with their covariance over time and between outputs. The methods in
    frequency draw from the whitened residual's lines (`spectrum_bootstrap`).

    Args:
        fit: with the estimates, and the optimum that all refits begin from.
        runs: how many records.
        seed: of noise and disturbance.

    Raises:
        ValueError: no run; the time shift is free in a fit in time, or the data do not determine
            every parameter.
    """
    if runs < 1:
        raise ValueError(f"bootstrap: expected at least 1 run, got {runs}")
    at = fit.reached
    in_frequency = at.layout.estimator.noise_spectrum
    if at.layout.shift and not in_frequency:
        raise ValueError("bootstrap: not available with a free time shift")
    if fit.not_identifiable:
        raise ValueError(f"bootstrap: the data do not determine {', '.join(fit.not_identifiable)}")
    rng = np.random.default_rng(seed)
    notes: list[str] = []
    if in_frequency:
        optima = refits(at, _prior_means(fit, at, runs, rng), rng)
    else:
        outputs = _records(fit, at, runs, seed, rng)
        # Every refit from the optimum, which is where the record was simulated.
        starts = jnp.tile(at.z[None, :], (runs, 1))
        each = (outputs, jnp.asarray(_prior_means(fit, at, runs, rng), at.z.dtype))
        optima = optimise_many(at, _data_of(at), starts, each, batch=_BATCH, say=notes.append)
    converged = np.asarray(optima.converged)
    # No nuisances: weak priors hold them, which are not drawn anew, so that they would scatter less
    # than they are uncertain.
    estimates = {
        name: np.asarray(value_of(at.layout, at.data, i, jnp.asarray(optima.z[converged, i])))
        for i, name in enumerate(at.layout.free)
    }
    fitted = tuple(int(i) for i in np.flatnonzero(converged))
    return Bootstrap(estimates, runs - len(fitted), fitted, " ".join(notes))


def _prior_means(fit: Fit, at: Solution, runs: int, rng: np.random.Generator) -> np.ndarray:
    """(runs, p) means of priors, drawn anew as well: they are measurements too, of another kind."""
    values = np.array([fit.estimates[n].value for n in at.layout.free])
    prior_sd = np.where(np.isfinite(at.data.prior_sd), at.data.prior_sd, 0.0)
    return values + prior_sd * rng.standard_normal((runs, values.size))


def _data_of(at: Solution) -> Callable[[tuple[tuple[dict[str, Array], ...], Array]], Data]:
    """The numbers of the problem with a record and the means of priors that were drawn for it."""

    def data(record: tuple[tuple[dict[str, Array], ...], Array]) -> Data:
        flights = tuple(
            flight._replace(outputs=outputs)
            for flight, outputs in zip(at.data.flights, record[0], strict=True)
        )
        return at.data._replace(flights=flights, prior_mean=record[1])

    return data


def _records(
    fit: Fit, at: Solution, runs: int, seed: int, rng: np.random.Generator
) -> tuple[dict[str, Array], ...]:
    """By flight and output (runs, N); NaN where the record has it."""
    u = unpack(at.layout, at.data, at.z)
    noise_free = at.layout.estimator.records(at, u, runs, seed)
    records = []
    each = zip(at.data.flights, at.noise.sd, noise_free, strict=True)
    for i, (flight, sds, outputs) in enumerate(each):
        if fit.coloured:
            residuals = [fit.signals[i].residual(n) for n in at.layout.outputs[i]]
            # All outputs at once: their noises are correlated.
            coloured = drawn(np.stack(residuals), runs, rng)
        by_output = {}
        for n, y in flight.outputs.items():
            sd = float(sds[n]) * float(u.scales.get(n, 1.0))
            noise = sd * rng.standard_normal((runs, y.shape[0]))
            if fit.coloured:
                noise = coloured[:, at.layout.outputs[i].index(n)]
            record = np.asarray(outputs[n]) + float(u.biases[i][n]) + noise
            # The same gaps: they are part of what the data can tell.
            record = np.where(np.isnan(np.asarray(y)), np.nan, record)
            by_output[n] = jnp.asarray(record, at.z.dtype)
        records.append(by_output)
    return tuple(records)
