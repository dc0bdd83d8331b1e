"""Bootstrap of fits in frequency: residuals, drawn line by line, on the estimated response.

Whitened by its spectrum the residual at one frequency is as good as that at any other, with any
phase. So the model's response and the ends of each record stay, and to every line comes a residual
that another one had, at the size that the spectrum gives it there. Nothing is simulated in time:
unstable machines are no exception. The spectrum is estimated anew with each record.

Source: Franke and Härdle (1992), On bootstrapping kernel spectral estimates.
"""

import dataclasses
from collections.abc import Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Complex, Float

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
from heli_jax.identification.estimation.multistart import Search
from heli_jax.identification.estimation.noise_covariance import relax_noise_covariance
from heli_jax.identification.unknowns.layout import Data, Layout, Noise, Solution

_ROUNDS = 3
"""of residual and spectrum in turn, for an estimate by responses, which has no spectrum of lines"""
_STEPS = 200
"""of the optimiser at most"""


class Refits(NamedTuple):
    """Where fits of records that were drawn ended."""

    z: Float[np.ndarray, "runs q"]
    converged: Bool[np.ndarray, " runs"]


def refits(at: Solution, means: Float[np.ndarray, "runs p"], rng: np.random.Generator) -> Refits:
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
    for mean, data in zip(means, _records(at, rng), strict=False):
        search = _FromOptimum(at.layout, data._replace(prior_mean=jnp.asarray(mean, at.z.dtype)))
        # Steps of its search are none of the stage's, which counts records.
        with stages.stage("one record", shown=False):
            found = relax_noise_covariance(search, at.noise, begun).best
        z.append(np.asarray(found.z))
        converged.append(bool(found.converged))
        stages.advance()
    return Refits(np.array(z), np.array(converged))


class _FromOptimum(Search):
    """The optimiser in the coordinates in which a fit ended, over other numbers."""

    def __init__(self, layout: Layout, data: Data) -> None:
        self.problem: Any = None
        self.layout = self.bounded = layout
        self.data, self.max_steps = data, _STEPS


def _records(at: Solution, rng: np.random.Generator) -> Iterator[Data]:
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
