"""Small fits of a short bench record, shared by all tests of the report."""

import pytest

from heli_jax import Free, Problem, fit, models
from heli_jax.finding import note
from heli_jax.flights.flight import Source
from heli_jax.identification.equation_error.rls import baseline
from tests.identification.bench import BENCH, record, vehicle

IXX, IF = Free(0.05, 0.001, 1.0), Free(5e-4, 1e-6, 1e-2)
SCRIPT = "<script>alert(1)</script>"


def _fitted(free, **options):
    source = Source("/logs/<b>bench</b>.csv", "ab" * 32, (note("a.note", "stick: <i>mm</i> to m"),))
    flight = record(BENCH, seed=1, n=1000, dt=0.05, source=source, **options)
    problem = Problem(models.roll_on_stand, vehicle(BENCH), [flight], free)
    result = fit(problem)
    return result, problem, baseline(problem.model, problem.vehicle, flight)


@pytest.fixture(scope="session")
def sound():
    """Return fit, problem and baseline; the data determine both parameters."""
    return _fitted({"Ixx": IXX, "If": IF}, name=SCRIPT)


@pytest.fixture(scope="session")
def not_identifiable():
    """Return the same; the data determine two ratios of three parameters."""
    return _fitted({"Ixx": IXX, "If": IF, "a": Free(5.0, 1.0, 20.0)})
