"""Bootstrap: records about the estimated vehicle's response are identified again, many times."""

from collections.abc import Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from heli_jax import naming, stages
from heli_jax.flights.flight import Flight
from heli_jax.identification.estimation.frequency_lines import (
    errors_of_lines,
    in_time_of,
    records_of,
)
from heli_jax.identification.estimation.levenberg_marquardt import Optimum, optimise
from heli_jax.identification.estimation.multistart import Search
from heli_jax.identification.estimation.noise_covariance import relax_noise_covariance
from heli_jax.identification.problem import FEWEST_SEEN
from heli_jax.identification.result import Fit
from heli_jax.identification.uncertainty.autocorrelated_residuals import drawn
from heli_jax.identification.unknowns.layout import Data, Layout, Solution, unpack, value_of

_STEPS = 200
"""of the optimiser at most, in frequency"""
_STEPS_IN_TIME = 60
"""the same in time: a run that began near its optimum"""


class Refits(NamedTuple):
    """Estimates of many records."""

    values: dict[str, np.ndarray]
    """by free parameter, (records,); NaN where a record did not converge"""
    converged: np.ndarray
    """(records,); False too where an output has fewer than 8 measured samples"""
    cost: np.ndarray
    """(records,) sum of squares over the number of measured samples, by the noise of the fit: 1
    where a record is as noisy, more where the model explains it less; NaN with too few samples"""


def refit(fit: Fit, records: Sequence[Sequence[Flight] | Flight]) -> Refits:
    """Estimate the parameters of a fit anew from other records.

    Each record has the flights of the fit, of the same length and rate, with inputs and outputs of
    its own; all else is the fit's, and all searches begin at its optimum. No verdict is made of a
    record, and no interval.

    Args:
        fit: with output error or filter error.
        records: each a Flight, or as many as the fit has.

    Raises:
        TypeError: a record that is no flights.
        ValueError: a record is not like that of the fit, with what differs; a method that estimates
            the noise's spectrum.
    """
    at = fit.reached
    if at.layout.noise_model == "spectrum":
        raise ValueError(f"refit: not available with method {fit.method}")
    if not records:
        raise ValueError("refit: expected one record at least, got none")
    flights = [_like(at, r, f"refit, record {k}") for k, r in enumerate(records)]

    def data(record: list[Flight]) -> Data:
        names, dtype = naming.names(at.layout.model.Inputs), at.z.dtype
        numbers = [
            of_fit._replace(
                inputs=at.layout.model.Inputs(**{n: np.asarray(f.inputs[n], dtype) for n in names}),
                outputs={n: np.asarray(f.outputs[n], dtype) for n in of_fit.outputs},
            )
            for of_fit, f in zip(at.data.flights, record, strict=True)
        ]
        return at.data._replace(flights=tuple(numbers))

    optima = _optima(at, map(data, flights))
    seen = [[np.isfinite(y).sum() for f in r for y in f.outputs.values()] for r in flights]
    enough = np.array([min(counts) >= FEWEST_SEEN for counts in seen])
    converged = np.array([o.converged for o in optima]) & enough
    values = _values(at, np.stack([o.z for o in optima]))
    cost = np.where(enough, [o.cost for o in optima], np.nan)
    return Refits({n: np.where(converged, v, np.nan) for n, v in values.items()}, converged, cost)


def _optima(at: Solution, records: Iterable[Data]) -> list[Optimum]:
    """Return the optimum of each record, searched from one optimum."""
    optima = []
    for numbers in records:
        # Steps of its search are none of the stage's, which counts records.
        with stages.stage("one record", shown=False):
            optima.append(optimise(at.layout, numbers, at.noise, at.z, _STEPS_IN_TIME))
        stages.advance()
    return optima


def _values(at: Solution, z: Any) -> dict[str, np.ndarray]:
    """Return by free parameter (records,) at the unknowns (records, q)."""
    z = jnp.asarray(z)
    return {
        n: np.asarray(value_of(at.layout, at.data, i, z[:, i]))
        for i, n in enumerate(at.layout.free)
    }


def _like(at: Solution, record: Any, where: str) -> list[Flight]:
    """Return the flights of a record, which have to be like the fit's."""
    flights = [record] if isinstance(record, Flight) else record
    if not isinstance(flights, Sequence) or not all(isinstance(f, Flight) for f in flights):
        raise TypeError(f"{where}: expected a Flight or a list of them, got {record!r:.80}")
    if len(flights) != len(at.data.flights):
        raise ValueError(f"{where}: expected {len(at.data.flights)} flights, got {len(flights)}")
    names = naming.names(at.layout.model.Inputs)
    for flight, own, hold in zip(flights, at.data.flights, at.layout.holds, strict=True):
        expected = {
            "samples": (next(iter(own.outputs.values())).shape[0], flight.n_samples),
            "dt": (float(own.dt), float(flight.dt)),
            "inputs": (list(names), [n for n in names if n in flight.inputs]),
            "outputs": (sorted(own.outputs), sorted(flight.outputs)),
            "hold": (list(hold), [flight.hold.get(n) for n in names]),
            "known": tuple({n: float(v) for n, v in f.known.items()} for f in (own, flight)),
        }
        for name, (value, got) in expected.items():
            if value != got:
                raise ValueError(f"{where}: expected {name} {value} as the fit has, got {got}")
    return list(flights)


class Bootstrap(NamedTuple):
    """Estimates from simulated records."""

    values: dict[str, np.ndarray]
    """by free parameter, (runs that converged,)"""
    failures: int
    """runs that did not converge"""
    records: tuple[int, ...] = ()
    """the numbers of the records that these are of"""

    def interval(self, name: str) -> tuple[float, float]:
        """Return 2.5 and 97.5 % of the values."""
        low, high = np.percentile(self.values[name], [2.5, 97.5])
        return float(low), float(high)


def bootstrap(fit: Fit, runs: int = 200, *, seed: int = 0) -> Bootstrap:
    """Refit records simulated with the estimates: same inputs, same missing samples, new noise.

    Filter error draws the disturbance anew. Output error adds white noise, or where its residuals
    are autocorrelated, noise with their covariance over time and between outputs. Frequency error
    draws residuals line by line, and estimates the spectrum anew.

    Raises:
        ValueError: no run; the time shift is free in a fit in time, the data do not determine every
            parameter, or responses are fitted, which have no residual at lines.
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
    # Priors are measurements too, of another kind: their means are drawn anew as well.
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
        optima = _optima(at, map(data, range(runs)))
        z, converged = np.stack([o.z for o in optima]), np.array([o.converged for o in optima])
    # No nuisances: weak priors hold them, which are not drawn anew.
    fitted = np.flatnonzero(converged)
    estimates = _values(at, z[fitted])
    return Bootstrap(estimates, runs - fitted.size, tuple(map(int, fitted)))


def _records(
    fit: Fit, at: Solution, runs: int, seed: int, rng: np.random.Generator
) -> tuple[dict[str, np.ndarray], ...]:
    """Draw by flight and output (runs, N); NaN where the record has it."""
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
    at: Solution, means: Float[Array, "runs p"], rng: np.random.Generator
) -> tuple[Float[np.ndarray, "runs q"], Bool[np.ndarray, " runs"]]:
    """Fit drawn records one by one, each with its means of the priors and its own spectrum; return
    the unknowns, and whether they converged."""
    z, converged = [], []
    begun = Optimum(at.z, 0.0, 0, True)
    for mean, data in zip(means, _spectrum_records(at, rng), strict=False):
        search = _FromOptimum(at.layout, data._replace(prior_mean=mean))
        # Steps of its search are none of the stage's, which counts records.
        with stages.stage("one record", shown=False):
            best = relax_noise_covariance(search, at.noise, begun).best
        z.append(np.asarray(best.z))
        converged.append(bool(best.converged))
        stages.advance()
    return np.array(z), np.array(converged)


class _FromOptimum(Search):
    """The optimiser in the coordinates in which a fit ended, over other numbers."""

    def __init__(self, layout: Layout, data: Data) -> None:
        self.problem: Any = None
        self.layout = layout
        self.data, self.max_steps = data, _STEPS


def _spectrum_records(at: Solution, rng: np.random.Generator) -> Iterator[Data]:
    """Yield the numbers of the problem, again and again with other noise.

    The model's response and the ends of each record stay, and every line gets a whitened residual
    that another one had, with any phase, at the size that the spectrum gives it there (Franke and
    Härdle, 1992, On bootstrapping kernel spectral estimates). Nothing is simulated in time.
    """
    layout, noise = at.layout, at.noise
    errors = jax.device_get(errors_of_lines(layout, at.data, noise, at.z).errors)
    records = records_of(layout)
    # What the unknowns fit of the noise is missing in the residual.
    rows = sum(2 * e.size for e in errors)
    freedom = (rows / max(rows - len(layout.of_interest), 1)) ** 0.5
    # Flights of the same outputs share what is drawn from.
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
