"""Where a prior makes a fit well-posed, the data alone determine ratios: value, sd, interval."""

import numpy as np
import pytest

from heli_jax import Free, Prior, Problem, fit, models
from tests.identification.bench import BENCH, record, vehicle

FREE = {"Ixx": Free(0.05), "If": Free(5e-4), "a": Free(4.0, prior=Prior(5.1, 0.3))}


@pytest.fixture(scope="module")
def resting():
    flight = record(BENCH, seed=11, n=1000)
    return fit(Problem(models.roll_on_stand, vehicle(BENCH), [flight], FREE)), flight


def test_ratios_that_the_data_alone_determine_have_their_own_intervals(resting):
    found, flight = resting
    assert found.status == "converged"
    assert set(found.verdict.resting) == {"Ixx", "If", "a"}
    ratios = {c.name: c for c in found.verdict.combinations}
    assert set(ratios) == {"a/Ixx", "a/If"}
    # The oracle: with a known there is no prior, and Ixx and If are as sure as the ratios.
    free = {n: FREE[n] for n in ("Ixx", "If")}
    known = fit(Problem(models.roll_on_stand, vehicle(BENCH), [flight], free))
    for name in free:
        ratio, one = ratios[f"a/{name}"], known.estimates[name]
        assert ratio.value == pytest.approx(BENCH["a"] / one.value, rel=1e-4)
        assert ratio.sd / ratio.value == pytest.approx(one.sd / one.value, rel=0.05)
        assert ratio.lower95 < BENCH["a"] / BENCH[name] < ratio.upper95
        # Far better known than either of its parts, which rest on the prior.
        assert ratio.sd / ratio.value < 0.1 * found.estimates[name].sd / found.estimates[name].value


def test_they_widen_with_autocorrelated_residuals(resting):
    _, flight = resting
    white = np.random.default_rng(3).standard_normal(flight.n_samples)
    slow = np.convolve(white, 0.9 ** np.arange(60), mode="same") * 4e-3
    outputs = {"roll": flight.outputs["roll"] + slow}
    disturbed = type(flight)(dt=flight.dt, inputs=flight.inputs, outputs=outputs)
    found = fit(Problem(models.roll_on_stand, vehicle(BENCH), [disturbed], FREE))
    assert found.coloured
    for c in found.verdict.combinations:
        name = c.name.removeprefix("a/")
        truth = BENCH["a"] / BENCH[name]
        assert c.lower95 < truth < c.upper95
        assert c.sd > 2.0 * resting[0].verdict.combinations[0].sd or name != "Ixx"
