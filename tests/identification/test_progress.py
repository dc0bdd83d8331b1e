"""A search with progress messages has the same result as one without."""

import numpy as np
import pytest

from heli_jax import Free, Problem, fit, models, stages
from tests.identification.bench import BENCH, record, vehicle


class Steps:
    """Count the messages of the stages on their steps."""

    def __init__(self):
        self.stages = []

    def begin(self, stage):
        self.stages.append(stage)

    def end(self, stage):
        pass


@pytest.fixture(scope="module")
def problem():
    free = {"Ixx": Free(0.06), "If": Free(5e-4), "kappa": Free(2.0)}
    flight = record(BENCH, seed=3, n=400, noise=2e-3)
    return Problem(models.roll_on_stand, vehicle(BENCH), [flight], free)


def test_numbers_are_the_same_to_the_last_bit(problem):
    silent = fit(problem, starts=2)
    heard = Steps()
    with stages.observed_by(heard):
        told = fit(problem, starts=2)
    np.testing.assert_array_equal(np.asarray(told.reached.z), np.asarray(silent.reached.z))
    assert told.starts == silent.starts
    assert told.trace == silent.trace
    assert told.estimates == silent.estimates
    [search] = [s for s in heard.stages if s.words.startswith("fitting")]
    # All steps of all starts and of the noise relaxation, without the first points.
    assert search.done >= sum(row.steps - 1 for row in silent.starts)
    assert search.detail.startswith("cost ")
