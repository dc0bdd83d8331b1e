"""Clocks that were set, lost samples, or went on at another rate."""

import numpy as np
import pytest

from heli_jax.flights.clock_steps import step_notes
from heli_jax.flights.resample import new_clock


def test_a_step_of_the_clock_is_told_with_its_time():
    t = 0.01 * np.arange(6000)
    t[3000:] += 0.1
    (note,) = step_notes(t, 100.0, 0.25)
    assert (note.code, note.value) == ("clock.long-steps", pytest.approx(0.11))
    assert note in new_clock(t, 100.0).notes


@pytest.mark.parametrize(("first", "second"), [(0.01, 0.02), (0.02, 0.01)])
def test_a_second_rate(first, second):
    rng = np.random.default_rng(0)
    steps = np.r_[np.full(3000, first), np.full(2000, second)]
    t = np.cumsum(steps * (1 + 0.1 * rng.uniform(-1, 1, steps.size)))
    (note,) = step_notes(t, 100.0, 0.25)
    assert (note.code, note.value) == ("clock.other-rate", pytest.approx(t[2999], abs=0.03))
    # Where the slower part has a sample for each instant no other rate is asked for.
    assert len(step_notes(t, 45.0, 0.25)[0].sentence) < len(note.sentence)


def test_nothing_is_said_of_an_ordinary_clock():
    rng = np.random.default_rng(1)
    for _ in range(50):
        t = 0.01 * np.arange(4000) + 0.002 * rng.uniform(-1, 1, 4000)
        assert step_notes(t, 50.0, 0.25) == ()
        # Many samples lost here and there: the shares of missing samples say so.
        kept = t[rng.uniform(size=t.size) > 0.4]
        assert step_notes(kept, 50.0, 0.25) == ()
