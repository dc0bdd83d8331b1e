"""Representations of objects, and their conversion for other libraries."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from heli_jax import Flight, Free, Prior, Problem, fit, load_vehicle, models, simulate
from heli_jax.finding import note
from heli_jax.flights.flight import Source

CONFIGS = Path(__file__).parents[1] / "configs"


@pytest.fixture(scope="module")
def bench():
    return load_vehicle(CONFIGS / "vehicles/bench-30.yaml")


@pytest.fixture(scope="module")
def run(bench):
    stick = np.repeat(np.random.default_rng(0).uniform(-3e-6, 3e-6, 20), 50)
    inputs = models.roll_on_stand.Inputs(x_roll=jnp.asarray(stick))
    return simulate(models.roll_on_stand, bench, inputs, dt=0.02)


@pytest.fixture(scope="module")
def flight(run):
    roll = np.asarray(run.outputs.roll) + 2e-3 * np.random.default_rng(1).standard_normal(1000)
    return Flight(
        0.02,
        {"x_roll": np.asarray(run.inputs.x_roll)},
        {"roll": roll},
        name="first",
        source=Source("log.csv", "0", (note("a.note", "a note"),)),
    )


@pytest.fixture(scope="module")
def problem(bench, flight):
    free = {"Ixx": Free(0.03, 0.001, 1.0), "If": Free(2e-4), "a": Free(5.1, prior=Prior(5.1, 0.3))}
    return Problem(models.roll_on_stand, bench, [flight], free)


@pytest.fixture(scope="module")
def fitted(problem):
    return fit(problem)


def test_objects_say_what_they_hold(bench, flight, problem, fitted):
    for value, words in (
        (bench, ["0.024", "kg m^2"]),
        (flight, ["1000", "50", "roll", "a note"]),
        (problem, ["roll-on-stand", "output-error", "5.1", "0.03"]),
        (fitted, ["converged", "Ixx", "kg m^2"]),
    ):
        for word in (type(value).__name__, *words):
            assert word in repr(value)


def test_estimates_as_a_data_frame(fitted):
    frame = fitted.to_dataframe()
    assert list(frame.columns) == ["value", "sd", "lower95", "upper95", "unit", "prior_share"]
    assert list(frame.index) == ["Ixx", "If", "a"]
    assert frame.loc["Ixx", "value"] == fitted.estimates["Ixx"].value
    assert frame.loc["Ixx", "unit"] == "kg m^2"
    everything = fitted.to_dataframe(nuisance=True)
    assert set(everything.index) == {*fitted.estimates, *fitted.nuisance}
    assert everything["sd"].dtype == float


def test_a_run_as_a_dataset(run):
    data = run.to_xarray()
    assert data["roll"].attrs == {"units": "rad", "role": "output"}
    assert float(data.phi.sel(time=0.02)) == float(run.states.phi[1])
    assert int(data.status) == 0
    many = jax.tree.map(lambda v: jnp.stack([v, v]), run)
    batch = many.to_xarray()
    assert batch.x_roll.dims == ("run_0", "time")
    assert batch.status.shape == (2,)
    with pytest.raises(ValueError, match="same times"):
        many._replace(times=jnp.stack([run.times, 2.0 * run.times])).to_xarray()
