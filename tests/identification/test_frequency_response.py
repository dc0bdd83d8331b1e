"""Fits of frequency responses: estimates, an unstable vehicle in a loop, and refusals."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from heli_jax import Flight, Free, Nuisance, Problem, fit, models
from heli_jax import config as configuration
from heli_jax.analysis.spectra import PairOptions, ResponseOptions
from heli_jax.identification.estimation.residual import residual_and_jacobian, rows_of
from heli_jax.identification.search import first_guess
from tests.identification.bench import BENCH, record, vehicle
from tests.test_log_responses import CONFIG
from tests.test_log_responses import record as logged

FREE = {"Ixx": Free(0.035), "If": Free(1.2e-4), "kappa": Free(7.0)}


def with_a_gap(flight: Flight) -> Flight:
    roll = flight.outputs["roll"].copy()
    roll[1100:1103] = np.nan
    return Flight(dt=flight.dt, inputs=flight.inputs, outputs={"roll": roll})


def test_a_flight_with_missing_samples_is_fitted_through_its_windows():
    flight = with_a_gap(record(BENCH, seed=3, n=4000))
    options = ResponseOptions(window=8.0, band=(0.25, 8.0))
    problem = Problem(
        models.roll_on_stand, vehicle(BENCH), [flight], FREE,
        method="frequency-response", frequency=options,
    )  # fmt: skip
    found = fit(problem)
    assert found.status == "converged"
    for name, one in found.estimates.items():
        assert one.lower95 < BENCH[name] < one.upper95
        assert one.sd < 0.01 * BENCH[name]
    # Three of 27 windows contain the gap. White noise in windows that overlap by two thirds and by
    # one third is correlated by 0.471 and 0.0288.
    expected = 24 / (1.0 + 2.0 * (0.47117**2 + 0.02883**2))
    assert dict(found.responses.averages)["roll"] == pytest.approx(expected, rel=1e-4)
    assert found.responses.lower95 < found.responses.chi_squared < found.responses.upper95
    assert found.adequate
    [pair] = found.responses.pairs
    assert pair.J < 100.0
    # The simulation in time has an initial state and a bias.
    assert found.metrics["roll"].vaf > 0.999


@pytest.mark.slow
def test_rows_of_flights_of_several_lengths_and_their_slopes():
    """Test joint evaluation of models that differ only in numbers, each with its slopes."""
    flights = [record(BENCH, seed=3, n=n) for n in (1500, 1300, 1500)]
    problem = Problem(
        models.roll_on_stand, vehicle(BENCH), flights, FREE, Nuisance(bias=False),
        method="frequency-response", frequency=ResponseOptions(window=6.0, band=(0.4, 6.0)),
    )  # fmt: skip
    at = first_guess(problem)
    z = np.array(at.z)
    made = residual_and_jacobian(at.layout, at.data, at.noise, jnp.asarray(z))
    rows = eqx.filter_jit(rows_of)
    for i in range(3):
        step = 1e-5 * np.eye(z.size)[i]
        up, down = (rows(at.layout, at.data, at.noise, jnp.asarray(z + s * step)) for s in (1, -1))
        # Changes of the projection of the ends' effects are orthogonal to the rows (Kaufman).
        slope = float(up @ up - down @ down) / 4e-5
        assert float(made.J[:, i] @ made.r) == pytest.approx(slope, rel=1e-3)
    # Initial states are numbers here.
    assert not np.asarray(made.J)[: -z.size, 3:].any()


FIT = """
  band: [0.5, 8]
  coherence: 0.3
  pairs:
    - {input: lat, output: p, coherence: 0.5}
fit:
  method: METHOD
  free: {Lb: {start: 3000}}
"""


def test_a_configuration_says_which_responses_are_fitted(tmp_path):
    columns = logged(3, feedback=0.4)
    table = np.column_stack([*columns.values()])
    np.savetxt(tmp_path / "log.csv", table, delimiter=",", header=",".join(columns), comments="")
    path = tmp_path / "roll.yaml"
    path.write_text(CONFIG + FIT.replace("METHOD", "frequency-response"))
    problem = configuration.problem(configuration.load(path))
    assert problem.frequency == ResponseOptions(
        (0.5, 8.0), 10.0, None, 0.3, (PairOptions("lat", "p", None, 0.5),)
    )
