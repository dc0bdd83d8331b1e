"""Invalid problems: each is refused, with the place at the start of the message."""

import dataclasses

import numpy as np
import pytest

from heli_jax import Flight, Free, Nuisance, Prior, Problem, models
from heli_jax.analysis.spectra import PairOptions, ResponseOptions
from heli_jax.dynamics.disturbance import with_disturbance
from heli_jax.identification.select import choose
from tests.identification.bench import BENCH, record, vehicle

N = 3000
IXX = {"Ixx": Free(0.03)}
THREE = {"Ixx": Free(0.035), "If": Free(1.2e-4), "kappa": Free(7.0)}


@pytest.fixture(scope="module")
def flight():
    return record(BENCH, seed=3, n=N)


def responses(**options):
    return {"method": "frequency-response", "frequency": ResponseOptions(**options)}


def pair(*names):
    return (PairOptions(*names),)


@pytest.mark.parametrize(
    ("place", "how"),
    [
        ("no parameter is free", {"free": {}}),
        ("Ixy", {"free": {"Ixy": Free(1.0)}}),
        ("Ixx.start", {"free": {"Ixx": Free(float("nan"))}}),
        ("Ixx", {"free": {"Ixx": Free(-0.1)}}),
        ("Ixx.start", {"free": {"Ixx": Free(0.1, 0.2, 0.3)}}),
        ("lower", {"free": {"Ixx": Free(0.1, 0.3, 0.2)}}),
        ("prior.sd", {"free": {"Ixx": Free(0.1, prior=Prior(0.1, 0.0))}}),
        ("kappa", {"free": {"kappa": Free(0.0)}}),
        ("kappa.sign", {"free": {"kappa": Free(1.0, sign="plus")}}),
        ("sign", {"free": {"kappa": Free(0.0, sign="keep")}}),
        ("R1", {"free": {"R1": Free(0.3)}}),
        ("expected known or free", {"known": {"Ixx": 0.02}}),
        ("Ixx_added", {"known": {"Ixx_aded": 0.02}}),
        ("Ixx_added", {"known": {"Ixx_added": -1.0}}),
        ("window", {"window": -1.0}),
        ("continuity", {"continuity": 0.1}),
        ("continuity", {"window": 1.0, "continuity": 0.0}),
        ("window", {"window": 0.05}),
        ("window", {"window": 1.0, "nuisance": Nuisance(initial_state=False)}),
        ("method", {"method": "x"}),
        ("disturbance", {"method": "filter-error"}),
        ("input_offset", {"nuisance": Nuisance(input_offset=("dd",))}),
        ("instrument", {"method": "frequency-error", "instrument": ("x_roll",)}),
        ("instrument", {"method": "frequency-error", "instrument": ("lot",)}),
        ("instrument", {"instrument": ("x_roll",)}),
        ("response", responses(coherence=0.99999)),
        (r"pairs\[0\].input", responses(pairs=pair("roll", "roll"))),
        ("line", responses(window=10.0, pairs=pair("x_roll", "roll", (30.0, 40.0)))),
        ("independent", {"free": THREE, **responses(window=10.0, band=(0.4, 0.4001))}),
        ("independent", responses(window=50.0)),
    ],
)
def test_what_cannot_be_posed_is_refused_with_its_place(flight, place, how):
    given = {"free": IXX, **how}
    free, known = given.pop("free"), given.pop("known", {})
    with pytest.raises(ValueError, match=place):
        Problem(
            models.roll_on_stand, vehicle(BENCH), [dataclasses.replace(flight, known=known)], free,
            **given,
        )  # fmt: skip


@pytest.mark.parametrize(
    ("left", "method"), [(slice(None, None, 5), "frequency-error"), (slice(7), "output-error")]
)
def test_outputs_of_too_few_samples_are_refused(flight, left, method):
    roll = np.full(N, np.nan)
    roll[left] = flight.outputs["roll"][left]
    few = dataclasses.replace(flight, outputs={"roll": roll})
    with pytest.raises(ValueError, match="roll"):
        Problem(models.roll_on_stand, vehicle(BENCH), [few], IXX, method=method)


def test_flights_of_other_outputs_cannot_be_fitted_together(flight):
    both = {**flight.outputs, "roll_rate": flight.outputs["roll"]}
    flights = [flight, Flight(flight.dt, flight.inputs, both)]
    with pytest.raises(ValueError, match="roll_rate"):
        Problem(models.roll_on_stand, vehicle(BENCH), flights, IXX, method="frequency-error")


def test_estimates_by_instrument_have_no_likelihood_to_be_chosen_by(flight):
    excitation = np.random.default_rng(0).standard_normal(N)
    instrument = dataclasses.replace(flight, instruments={"x_roll": excitation})
    problem = Problem(
        models.roll_on_stand, vehicle(BENCH), [instrument], IXX,
        method="frequency-error", instrument=("x_roll",),
    )  # fmt: skip
    with pytest.raises(ValueError, match="likelihood"):
        choose({"one": problem})


@pytest.mark.parametrize(
    ("on", "name"), [(("roll", "x"), "x"), (("roll", "roll"), "roll"), ((), "axis")]
)
def test_disturbances_on_what_is_none_are_refused(on, name):
    with pytest.raises(ValueError, match=name):
        with_disturbance(models.roll_on_stand, on)
