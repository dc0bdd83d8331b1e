"""Where a prior makes a fit well-posed, the data alone determine ratios: value, sd, interval."""

import numpy as np
import pytest

from heli_jax import Free, Prior, Problem, fit, models, numbers, output
from heli_jax.report import tables
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
    assert {row[0] for row in tables.combinations(found).rows} == set(ratios)
    text = output._determined(ratios["a/Ixx"])
    assert text.startswith("determined: a/Ixx = 212.")
    assert ", sd 0." in text
    assert "95 % interval 21" in text


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


def test_an_interval_over_powers_of_ten_has_three_digits(resting):
    one = (
        resting[0]
        .estimates["Ixx"]
        ._replace(value=0.0229, sd=6.0, lower95=1.5e-119, upper95=3.49730554978e118)
    )
    assert output._row("Ixx", one, stopped=False)[3] == "1.5e-119 to 3.5e+118"
    assert len(numbers.measured(one.sd, one.value, one.lower95, one.upper95)[2]) < 12
    narrow = one._replace(value=0.024, sd=2.1e-5, lower95=0.023959, upper95=0.024041)
    assert output._row("Ixx", narrow, stopped=False)[3] == "0.023959 to 0.024041"
