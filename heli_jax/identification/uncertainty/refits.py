"""Many records fitted as one call: those of a Monte Carlo study, or repeated runs of a bench."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from heli_jax import naming
from heli_jax.flights.flight import Flight
from heli_jax.identification.estimation.many_runs import optimise_many
from heli_jax.identification.problem import FEWEST_SEEN
from heli_jax.identification.result import Fit
from heli_jax.identification.unknowns.layout import Data, value_of

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
