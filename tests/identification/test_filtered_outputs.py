"""A record behind a digital filter, fitted with the filter in the model and without."""

import numpy as np
import pytest
import scipy.signal

from heli_jax import Flight, Free, Problem, fit, linear_model, naming
from heli_jax.dynamics.disturbance import with_disturbance
from heli_jax.models import Filter, with_filters

ROLL = linear_model("roll-flybarless")
LB, TAU_F, BLAT = 166.1, 0.04631, 0.1398
DT, FINE = 0.02, 40


def record(n=400):
    """Roll by SciPy at 2 kHz; the gyro behind a digital Butterworth filter of 15 Hz, 6 ms late."""
    rng = np.random.default_rng(4)
    lat = np.repeat(rng.uniform(-0.3, 0.3, n), rng.integers(5, 25, n))[:n]
    roll = scipy.signal.cont2discrete(
        ([LB * BLAT / TAU_F], [1.0, 1.0 / TAU_F, LB]), DT / FINE, method="zoh"
    )
    p = scipy.signal.lfilter(roll[0].ravel(), roll[1], np.repeat(lat, FINE))
    gyro = scipy.signal.lfilter(*scipy.signal.butter(2, 15.0, fs=FINE / DT), p)
    late = np.concatenate([np.zeros(12), gyro])[: gyro.size : FINE]
    return Flight(dt=DT, inputs={"lat": lat}, outputs={"p": late + 0.005 * rng.standard_normal(n)})


def errors(model, method):
    """Error of Lb, tau_f and Blat in standard deviations."""
    model = with_disturbance(model, "roll") if method == "filter-error" else model
    free = {"Lb": Free(120.0), "tau_f": Free(0.07), "Blat": Free(0.1)}
    start = model.Params(
        **{**dict.fromkeys(naming.names(model.Params), 1.0), **naming.asdict(ROLL.vehicle().params)}
    )
    found = fit(Problem(model, start, [record()], free, method=method), starts=1)
    truth = {"Lb": LB, "tau_f": TAU_F, "Blat": BLAT}
    return [(e.value - truth[n]) / e.sd for n, e in found.estimates.items() if n in truth]


@pytest.mark.slow
@pytest.mark.parametrize("method", ["output-error", "filter-error"])
def test_a_filter_in_the_model_leaves_no_bias(method):
    model = with_filters(ROLL.model, {"p": [Filter("biquad", 15.0)]}, {"p": 0.006})
    assert np.max(np.abs(errors(model, method))) < 3.0


@pytest.mark.slow
def test_without_it_there_is_one():
    assert np.max(np.abs(errors(ROLL.model, "output-error"))) > 10.0
