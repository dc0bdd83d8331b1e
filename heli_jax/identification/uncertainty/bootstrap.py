"""Parametric bootstrap."""

from collections.abc import Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from heli_jax import stages
from heli_jax.identification.estimation.frequency_lines import (
    errors_of_lines,
    in_time_of,
    records_of,
)
from heli_jax.identification.estimation.levenberg_marquardt import Optimum, optimise
from heli_jax.identification.estimation.multistart import Search
from heli_jax.identification.estimation.noise_covariance import relax_noise_covariance
from heli_jax.identification.result import Fit
from heli_jax.identification.uncertainty.autocorrelated_residuals import drawn
from heli_jax.identification.unknowns.layout import Data, Solution, unpack, value_of

_STEPS = 200
"""steps of the optimiser in frequency, at most"""
_STEPS_IN_TIME = 60
"""the same in time, from the fit's optimum"""


class Bootstrap(NamedTuple):
    """Estimates from simulated records."""

    values: dict[str, np.ndarray]
    """by free parameter, (runs that converged,)"""
    failures: int
    """runs that did not converge"""
    records: tuple[int, ...] = ()
    """numbers of the records in `values`"""

    def interval(self, name: str) -> tuple[float, float]:
        """Return 2.5 and 97.5 % of the values."""
        low, high = np.percentile(self.values[name], [2.5, 97.5])
        return float(low), float(high)


def bootstrap(fit: Fit, runs: int = 200, *, seed: int = 0) -> Bootstrap:
    """Refit records simulated with the estimates: same inputs and missing samples, new noise.

    Filter error draws a new disturbance. Output error adds white noise, or noise with the
    covariance of autocorrelated residuals over time and between outputs. Frequency error draws
    residuals line by line, and estimates the spectrum again.

    Raises:
        ValueError: no run, a free time shift in a fit in time, a parameter that is not
            identifiable, or a fit of frequency responses.
    """
    if runs < 1:
        raise ValueError(f"bootstrap: expected at least 1 run, got {runs}")
    at = fit.reached
    in_frequency = at.layout.noise_model == "spectrum"
    if at.layout.objective.fits_responses:
        raise ValueError(f"bootstrap: not available with method {fit.method}")
    if at.layout.shift and not in_frequency:
        raise ValueError("bootstrap: not available with a free time shift")
    if fit.not_identifiable:
        raise ValueError(f"bootstrap: the data do not determine {', '.join(fit.not_identifiable)}")
    rng = np.random.default_rng(seed)
    # Priors are measurements: their means are drawn too.
    values = np.array([fit.estimates[n].value for n in at.layout.free])
    prior_sd = np.where(np.isfinite(at.data.prior_sd), at.data.prior_sd, 0.0)
    records = () if in_frequency else _records(fit, at, runs, seed, rng)
    means = values + prior_sd * rng.standard_normal((runs, values.size))
    means = means.astype(at.z.dtype)

    def data(k: int) -> Data:
        flights = tuple(
            f._replace(outputs={n: y[k] for n, y in outputs.items()})
            for f, outputs in zip(at.data.flights, records, strict=True)
        )
        return at.data._replace(flights=flights, prior_mean=means[k])

    if in_frequency:
        z, converged = _fit_by_lines(at, means, rng)
    else:
        optima = []
        for k in range(runs):
            # The outer stage counts records.
            with stages.stage("one record", shown=False):
                optima.append(optimise(at.layout, data(k), at.noise, at.z, _STEPS_IN_TIME))
            stages.advance()
        z, converged = np.stack([o.z for o in optima]), np.array([o.converged for o in optima])
    # Without the nuisances, whose weak priors are not drawn.
    fitted = np.flatnonzero(converged)
    z = jnp.asarray(np.asarray(z)[fitted])
    estimates = {
        n: np.asarray(value_of(at.layout, at.data, i, z[:, i]))
        for i, n in enumerate(at.layout.free)
    }
    return Bootstrap(estimates, runs - fitted.size, tuple(map(int, fitted)))


def _records(
    fit: Fit, at: Solution, runs: int, seed: int, rng: np.random.Generator
) -> tuple[dict[str, np.ndarray], ...]:
    """Return simulated outputs by flight, (runs, N); NaN where the record has it."""
    u = unpack(at.layout, at.data, at.z)
    noise_free = at.layout.objective.records(at, u, runs, seed)
    records = []
    each = zip(at.data.flights, at.noise.sd, noise_free, strict=True)
    for i, (flight, sds, outputs) in enumerate(each):
        if fit.coloured:
            residuals = [fit.signals[i].residual(n) for n in at.layout.outputs[i]]
            coloured = drawn(np.stack(residuals), runs, rng)
        by_output = {}
        for n, y in flight.outputs.items():
            sd = float(sds[n]) * float(u.scales.get(n, 1.0))
            noise = sd * rng.standard_normal((runs, y.shape[0]))
            if fit.coloured:
                noise = coloured[:, at.layout.outputs[i].index(n)]
            record = np.asarray(outputs[n]) + float(u.biases[i][n]) + noise
            record = np.where(np.isnan(np.asarray(y)), np.nan, record)
            by_output[n] = record.astype(at.z.dtype)
        records.append(by_output)
    return tuple(records)


def _fit_by_lines(
    at: Solution, means: Float[np.ndarray, "runs p"], rng: np.random.Generator
) -> tuple[Float[np.ndarray, "runs q"], Bool[np.ndarray, " runs"]]:
    """Fit drawn records one by one, each with its own means of priors and spectrum; return the
    unknowns and convergence."""
    z, converged = [], []
    begun = Optimum(at.z, 0.0, 0, True)
    problem: Any = None  # the search needs none from an optimum
    for mean, data in zip(means, _spectrum_records(at, rng), strict=False):
        search = Search(problem, at.layout, data._replace(prior_mean=mean), _STEPS)
        # The outer stage counts records.
        with stages.stage("one record", shown=False):
            best = relax_noise_covariance(search, at.noise, begun).best
        z.append(np.asarray(best.z))
        converged.append(bool(best.converged))
        stages.advance()
    return np.array(z), np.array(converged)


def _spectrum_records(at: Solution, rng: np.random.Generator) -> Iterator[Data]:
    """Yield the data of the problem with other noise, without end.

    The model's response and the ends of each record stay. Every line gets the whitened residual of
    a random line, with a random phase, scaled by the spectrum (Franke and Härdle, 1992, On
    bootstrapping kernel spectral estimates). Nothing is simulated in time.
    """
    layout, noise = at.layout, at.noise
    errors = jax.device_get(errors_of_lines(layout, at.data, noise, at.z).errors)
    records = records_of(layout)
    # The residual lacks what the unknowns fit of the noise.
    rows = sum(2 * e.size for e in errors)
    freedom = (rows / max(rows - len(layout.of_interest), 1)) ** 0.5
    # Flights with the same outputs share one pool.
    white: dict[tuple[str, ...], list[np.ndarray]] = {}
    for record, e, W in zip(records, errors, noise.whitening, strict=True):
        whitened = (np.asarray(W) @ e[:, :, None])[:, :, 0]
        white.setdefault(layout.outputs[record.flight], []).append(whitened)
    pools = {names: np.concatenate(parts) for names, parts in white.items()}
    measured = [{n: np.asarray(y) for n, y in f.outputs.items()} for f in at.data.flights]
    while True:
        outputs = [{n: y.copy() for n, y in by_name.items()} for by_name in measured]
        for record, e, W in zip(records, errors, noise.whitening, strict=True):
            names = layout.outputs[record.flight]
            pool, K = pools[names], len(e)
            turned = np.exp(2j * np.pi * rng.random(K))[:, None]
            drawn_anew = pool[rng.integers(len(pool), size=K)] * turned
            other = np.linalg.solve(np.asarray(W), drawn_anew[:, :, None])[:, :, 0]
            columns = in_time_of(freedom * other - e, record.samples).T
            for name, column in zip(names, columns, strict=True):
                outputs[record.flight][name][record.first : record.last] += column
        yield at.data._replace(
            flights=tuple(
                f._replace(outputs={n: jnp.asarray(y, at.z.dtype) for n, y in by_name.items()})
                for f, by_name in zip(at.data.flights, outputs, strict=True)
            )
        )
