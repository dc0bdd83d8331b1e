"""Bootstrap: records about the estimated machine's response are identified again, many times."""

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float

from heli_jax import naming, stages
from heli_jax.flights.flight import Flight
from heli_jax.identification.estimation.frequency_error import ESTIMATOR as FREQUENCY_ERROR
from heli_jax.identification.estimation.frequency_lines import errors_of_lines
from heli_jax.identification.estimation.frequency_records import (
    FlightFacts,
    Record,
    in_time_of,
    parts_of,
    records_of,
    without_parts,
)
from heli_jax.identification.estimation.levenberg_marquardt import Optimum
from heli_jax.identification.estimation.many_runs import optimise_many
from heli_jax.identification.estimation.multistart import Search
from heli_jax.identification.estimation.noise_covariance import relax_noise_covariance
from heli_jax.identification.problem import FEWEST_SEEN
from heli_jax.identification.result import Fit
from heli_jax.identification.uncertainty.autocorrelated_residuals import drawn
from heli_jax.identification.unknowns.layout import Data, Layout, Noise, Solution, unpack, value_of

# Many records fitted as one call: those of a Monte Carlo study, or repeated runs of a bench.


_BATCH = 8


class Refits(NamedTuple):
    """Estimates of many records."""

    values: dict[str, np.ndarray]
    """by free parameter, (records,); NaN where a record did not converge"""
    converged: np.ndarray
    """(records,); False too of a record that `fit` would refuse, since an output of it has fewer
    than 8 measured samples: of nothing measured the start would be the optimum"""
    cost: np.ndarray
    """(records,) sum of squares over the record's number of measured samples, by the noise of the
    fit: 1 where a record is as noisy, more where the model explains it less; NaN of a record with
    too few"""
    note: str = ""
    """why many records were not fitted by programs of machine code, where they were not"""


def refit(fit: Fit, records: Sequence[Sequence[Flight] | Flight]) -> Refits:
    """Estimate the parameters of a fit anew from other records, side by side.

    Each record has the flights of the fit, of the same length and rate, with inputs and outputs of
    its own; model, free parameters, priors, noise levels and the scales of weak priors are those of
    the fit, and all searches begin at its optimum. No verdict is made of a record, and no interval:
    for these it is fitted by itself.

    Args:
        fit: with output error or filter error.
        records: each a Flight, or as many as the fit has.

    Raises:
        TypeError: a record that is no flights.
        ValueError: a record is not like that of the fit, with what differs; a method that estimates
            the noise's spectrum.
    """
    at = fit.reached
    if at.layout.estimator.noise_spectrum:
        raise ValueError(f"refit: not available with method {fit.method}")
    if not records:
        raise ValueError("refit: expected one record at least, got none")
    flights = [_flights(r, f"refit, record {k}") for k, r in enumerate(records)]
    for k, record in enumerate(flights):
        _check(at.data, at.layout.holds, record, f"refit, record {k}", at.layout.model)
    each = tuple(
        (
            jax.tree.map(
                lambda *v: jnp.asarray(np.stack(v), at.z.dtype),
                *(_inputs(at.layout.model, r[i]) for r in flights),
            ),
            {
                n: jnp.asarray(np.stack([np.asarray(r[i].outputs[n]) for r in flights]), at.z.dtype)
                for n in flight.outputs
            },
        )
        for i, flight in enumerate(at.data.flights)
    )

    def data(record: Any) -> Data:
        changed = tuple(
            flight._replace(inputs=inputs, outputs=outputs)
            for flight, (inputs, outputs) in zip(at.data.flights, record, strict=True)
        )
        return at.data._replace(flights=changed)

    starts = jnp.tile(at.z[None, :], (len(flights), 1))
    notes: list[str] = []
    optima = optimise_many(at, data, starts, each, batch=_BATCH, say=notes.append)
    enough = np.array([_enough(record) for record in flights])
    converged = np.asarray(optima.converged) & enough
    z = jnp.asarray(optima.z)
    values = {
        name: np.where(converged, np.asarray(value_of(at.layout, at.data, i, z[:, i])), np.nan)
        for i, name in enumerate(at.layout.free)
    }
    cost = np.where(enough, np.asarray(optima.cost), np.nan)
    return Refits(values, converged, cost, " ".join(notes))


# Any: what a caller gave.
def _flights(record: Any, where: str) -> list[Flight]:
    flights = [record] if isinstance(record, Flight) else record
    if not isinstance(flights, Sequence) or not all(isinstance(f, Flight) for f in flights):
        raise TypeError(f"{where}: expected a Flight or a list of them, got {record!r:.80}")
    return list(flights)


def _enough(record: list[Flight]) -> bool:
    """Whether of every output as many samples are measured as `fit` asks for."""
    # Of the fit's outputs alone there are records, see `_check`.
    return all(
        np.isfinite(y).sum() >= FEWEST_SEEN for flight in record for y in flight.outputs.values()
    )


def _inputs(model: Any, flight: Flight) -> Any:
    return model.Inputs(**{n: np.asarray(flight.inputs[n]) for n in naming.names(model.Inputs)})


def _check(data: Data, holds: Any, record: list[Flight], where: str, model: Any) -> None:
    """Refuse a record that is not like the fit's."""
    if len(record) != len(data.flights):
        raise ValueError(f"{where}: expected {len(data.flights)} flights, got {len(record)}")
    for flight, own, hold in zip(record, data.flights, holds, strict=True):
        names = naming.names(model.Inputs)
        missing = [n for n in names if n not in flight.inputs]
        if missing:
            raise ValueError(f"{where}: expected the input {missing[0]}, got none")
        samples = next(iter(own.outputs.values())).shape[0]
        expected = {
            "samples": (samples, flight.n_samples),
            "dt": (float(own.dt), float(flight.dt)),
            "outputs": (sorted(own.outputs), sorted(flight.outputs)),
            "hold": (list(hold), [flight.hold[n] for n in names]),
            "known": (
                {n: float(v) for n, v in own.known.items()},
                {n: float(v) for n, v in flight.known.items()},
            ),
        }
        for name, (value, got) in expected.items():
            if value != got:
                raise ValueError(f"{where}: expected {name} {value} as the fit has, got {got}")


# Bootstrap of fits in frequency: residuals, drawn line by line, on the estimated response.
#
# Whitened by its spectrum the residual at one frequency is as good as that at any other, with any
# phase. So the model's response and the ends of each record stay, and to every line comes a
# residual that another one had, at the size that the spectrum gives it there. Nothing is simulated
# in time: unstable machines are no exception. The spectrum is estimated anew with each record.
#
# Source: Franke and Härdle (1992), On bootstrapping kernel spectral estimates.


_ROUNDS = 3
"""of residual and spectrum in turn, for an estimate by responses, which has no spectrum of lines"""
_STEPS = 200
"""of the optimiser at most"""


class SpectrumRefits(NamedTuple):
    """Where fits of records that were drawn ended."""

    z: Float[np.ndarray, "runs q"]
    converged: Bool[np.ndarray, " runs"]


def refits(
    at: Solution, means: Float[np.ndarray, "runs p"], rng: np.random.Generator
) -> SpectrumRefits:
    """Fit records again that differ in their noise.

    Args:
        at: where a fit in frequency ended.
        means: of each record the priors' means of the free parameters.
        rng: what is drawn from.

    Raises:
        ValueError: no part of a flight has all outputs.
    """
    z, converged = [], []
    begun = Optimum(
        at.z, jnp.zeros((), at.z.dtype), np.asarray(0), np.asarray(True), np.asarray(np.inf)
    )
    for mean, data in zip(means, _spectrum_records(at, rng), strict=False):
        search = _FromOptimum(at.layout, data._replace(prior_mean=jnp.asarray(mean, at.z.dtype)))
        # Steps of its search are none of the stage's, which counts records.
        with stages.stage("one record", shown=False):
            found = relax_noise_covariance(search, at.noise, begun).best
        z.append(np.asarray(found.z))
        converged.append(bool(found.converged))
        stages.advance()
    return SpectrumRefits(np.array(z), np.array(converged))


class _FromOptimum(Search):
    """The optimiser in the coordinates in which a fit ended, over other numbers."""

    def __init__(self, layout: Layout, data: Data) -> None:
        self.problem: Any = None
        self.layout = self.bounded = layout
        self.data, self.max_steps = data, _STEPS


def _spectrum_records(at: Solution, rng: np.random.Generator) -> Iterator[Data]:
    """The numbers of the problem, again and again with other noise."""
    layout, noise = _in_lines(at)
    errors = jax.device_get(errors_of_lines(layout, at.data, noise, at.z).errors)
    records = records_of(layout)
    # What the unknowns fit of the noise is missing in the residual.
    rows = sum(2 * e.size for e in errors)
    freedom = (rows / max(rows - len(layout.of_interest), 1)) ** 0.5
    white = [
        (np.asarray(W) @ e[:, :, None])[:, :, 0]
        for W, e in zip(noise.whitening, errors, strict=True)
    ]
    # Flights of the same outputs share what is drawn from.
    pools = {
        names: np.concatenate(
            [w for w, r in zip(white, records, strict=True) if layout.outputs[r.flight] == names]
        )
        for names in {layout.outputs[r.flight] for r in records}
    }
    measured = [{n: np.asarray(y) for n, y in f.outputs.items()} for f in at.data.flights]
    while True:
        outputs = [{n: y.copy() for n, y in by_name.items()} for by_name in measured]
        for record, e, W in zip(records, errors, noise.whitening, strict=True):
            names = layout.outputs[record.flight]
            other = freedom * _drawn(pools[names], np.asarray(W), rng) - e
            _add(outputs[record.flight], names, record, other)
        yield at.data._replace(
            flights=tuple(
                f._replace(outputs={n: jnp.asarray(y, at.z.dtype) for n, y in by_name.items()})
                for f, by_name in zip(at.data.flights, outputs, strict=True)
            )
        )


def _drawn(
    pool: Complex[np.ndarray, "n p"], W: Complex[np.ndarray, "K p p"], rng: np.random.Generator
) -> Complex[np.ndarray, "K p"]:
    """Residuals of other lines at the size of each."""
    K = len(W)
    turned = np.exp(2j * np.pi * rng.random(K))[:, None]
    white = pool[rng.integers(len(pool), size=K)] * turned
    return np.linalg.solve(W, white[:, :, None])[:, :, 0]


def _add(
    outputs: dict[str, Float[np.ndarray, " N"]],
    names: tuple[str, ...],
    record: Record,
    lines: Complex[np.ndarray, "K p"],
) -> None:
    """What is at the lines to the samples of a record."""
    for name, column in zip(names, in_time_of(lines, record.samples).T, strict=True):
        outputs[name][record.first : record.last] += column


def _in_lines(at: Solution) -> tuple[Layout, Noise]:
    """Layout and noise by which the residual stands at the lines of whole records."""
    layout, data = at.layout, at.data
    if layout.estimator is FREQUENCY_ERROR:
        return layout, at.noise
    flights = [
        Flight(
            dt=float(f.dt),
            inputs={n: np.asarray(v) for n, v in naming.asdict(f.inputs).items()},
            outputs={n: np.asarray(y) for n, y in f.outputs.items()},
            name=f"flight {i}",
        )
        for i, f in enumerate(data.flights, 1)
    ]
    if (why := without_parts(flights)) is not None:
        raise ValueError(f"bootstrap: {why}")
    facts = tuple(FlightFacts(parts_of(f), f.dt) for f in flights)
    layout = dataclasses.replace(layout, estimator=FREQUENCY_ERROR, of_flights=facts)
    noise, z = FREQUENCY_ERROR.prepared(at.noise, flights), at.z
    for _ in range(_ROUNDS):
        _, noise = FREQUENCY_ERROR.relax(layout, data, None, noise, z)
    return layout, noise


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
