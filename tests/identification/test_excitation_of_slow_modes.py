"""Coherence of an output with the inputs if its ends differ greatly."""

import numpy as np
import pytest
import scipy.signal

from heli_jax import Flight, Free, Problem, linear_model
from heli_jax.identification.validation.excitation import excitation_of


def heave(seed: int, Zcol: float) -> Problem:
    """Return 60 s of a heave mode of 30 s in light gusts, with steps of the collective."""
    rng, dt, n = np.random.default_rng(seed), 0.02, 3000
    col = np.repeat(rng.uniform(-0.1, 0.1, 60), 50)
    gust = scipy.signal.lfilter([0.3 * np.sqrt(2 * dt)], [1, dt - 1], rng.normal(size=n))
    w = np.asarray(scipy.signal.lfilter([0, dt], [1, 0.03 * dt - 1], Zcol * col + gust))
    model = linear_model("heave")
    flight = Flight(dt, {"col": col}, {"w": w + 0.05 * rng.normal(size=n)})
    free = {"Zw": Free(-0.5)}
    return Problem(model.model, model.vehicle().params, [flight], free, method="frequency-error")


@pytest.mark.parametrize("seed", range(2))
def test_an_output_that_the_inputs_carried_away_follows_them(seed: int) -> None:
    # Its leap from end to end hid that: "these data say nothing of the model", Zcol known to 3 %.
    assert excitation_of(heave(seed, -14.0))["w"] < 1e-6


def test_chance_is_no_more_than_it_says() -> None:
    by_chance = [excitation_of(heave(seed, 0.0))["w"] for seed in range(50)]
    assert np.mean(np.array(by_chance) < 0.05) < 0.14
