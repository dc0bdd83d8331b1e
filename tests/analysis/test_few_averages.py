"""Intervals of responses and transfer functions from few averages: Student's t."""

import numpy as np
import pytest
import scipy.signal

from heli_jax import Flight
from heli_jax.analysis.flight_responses import Settings, TransferRequest, flight_responses
from heli_jax.analysis.responses import averaged, student95
from heli_jax.analysis.transfer_fit import TransferFit

DT, TRUTH = 0.05, (80.0, 5.0, 40.0)  # 80 / (s^2 + 5 s + 40)


def test_the_reach_of_an_interval_is_that_of_tables():
    found = student95(np.array([2.0, 10.0, np.inf]))
    assert found == pytest.approx([4.303, 2.228, 1.960], abs=6e-4)


@pytest.mark.parametrize("averages", [1.0, 3.0])
def test_a_mean_over_frequencies_is_as_certain_as_it_says(averages):
    k = 4000
    drawn = np.random.default_rng(0).gamma(averages, 1.0 / averages, k)
    mean, freedom = averaged(drawn, np.ones(k), averages)
    # A variance with f degrees of freedom has a relative variance of 2 / f.
    assert 2.0 / np.var(mean) == pytest.approx(freedom, rel=0.15)
    assert np.mean(mean) == pytest.approx(1.0, abs=0.05)
    # Four frequencies give at most 2 x 4 degrees of freedom.
    assert averaged(drawn[:4], np.ones(4), 1.0)[1] == pytest.approx(8.0)


def record(seed: int) -> Flight:
    """Return a record of 30 s, without its transient."""
    rng = np.random.default_rng(seed)
    u = scipy.signal.lfilter(*scipy.signal.butter(1, 0.3), rng.standard_normal(800))
    b, a, _ = scipy.signal.cont2discrete(([TRUTH[0]], [1.0, *TRUTH[1:]]), DT)
    y = scipy.signal.lfilter(b.ravel(), a, u) + 0.1 * rng.standard_normal(800)
    inputs, outputs = {"lat": u[200:]}, {"p": y[200:]}
    return Flight(dt=DT, inputs=inputs, outputs=outputs, hold={"lat": "zero-order"})


def test_of_little_more_than_two_averages_intervals_hold_the_truth():
    """Test coverage; with 1.96 and each frequency's own error it was 92 % of bins."""
    wanted = TransferRequest("lat", "p", zeros=0, poles=2, delay=False)
    settings = Settings((0.4, 4.0), 18.0, points=30, transfer_functions=(wanted,))
    b, a, _ = scipy.signal.cont2discrete(([TRUTH[0]], [1.0, *TRUTH[1:]]), DT)
    bins, numbers = [], []
    for seed in range(30):
        found = flight_responses([record(seed)], settings)
        assert found.outputs["p"].averages < 2.5
        pair, [(_, fit)] = found.outputs["p"].pairs["lat"], found.fits
        assert isinstance(fit, TransferFit)
        off = pair.H - scipy.signal.freqz(b.ravel(), a, found.omega * DT)[1]
        bins.append(np.abs(np.stack([off.real, off.imag])) < pair.half95 * pair.sd)
        each = (*fit.numerator, *fit.denominator)
        numbers.append([c.lower95 <= v <= c.upper95 for c, v in zip(each, TRUTH, strict=True)])
    assert np.mean(bins) > 0.94
    assert np.mean(numbers) > 0.93
