"""Effects of a record's ends at all frequencies, from states and slow gusts."""

import numpy as np
import pytest

from heli_jax import Flight, Free, Problem, fit, linear_model

DT, N = 0.05, 1200
ZW, ZCOL = -0.6, -14.0


def record(seed: int, push: np.ndarray) -> Flight:
    """Return heave by collective steps and a push (N,) [m/s^2] held over each sample."""
    rng = np.random.default_rng(seed)
    col = np.repeat(rng.uniform(-0.05, 0.05, N // 15), 15)
    decay = np.exp(ZW * DT)
    w = np.zeros(N)
    for k in range(N - 1):
        w[k + 1] = decay * w[k] + (decay - 1.0) / ZW * (ZCOL * col[k] + push[k])
    return Flight(dt=DT, inputs={"col": col}, outputs={"w": w + 0.02 * rng.standard_normal(N)})


def heave(*flights: Flight):
    model = linear_model("heave")
    free = {"Zw": Free(-0.3), "Zcol": Free(-8.0)}
    vehicle = model.vehicle().params
    return fit(Problem(model.model, vehicle, flights, free, method="frequency-error"))


@pytest.mark.slow
def test_a_push_that_drifts_over_the_record_moves_no_estimate():
    calm = heave(record(0, np.zeros(N)))
    drifting = heave(record(0, np.linspace(0.0, 3.0, N)))
    for name, truth in (("Zw", ZW), ("Zcol", ZCOL)):
        one, other = drifting.estimates[name], calm.estimates[name]
        assert one.value == pytest.approx(truth, abs=4.0 * one.sd)
        assert one.sd == pytest.approx(other.sd, rel=0.3)


def test_gusts_nearly_as_slow_as_the_record_are_allowed_for():
    errors = []
    for seed in range(12):
        rng = np.random.default_rng(100 + seed)
        kept = np.exp(-DT / 5.0)
        push = np.zeros(N)
        push[0] = 0.6 * rng.standard_normal()
        for k in range(N - 1):
            push[k + 1] = kept * push[k] + 0.6 * np.sqrt(1.0 - kept**2) * rng.standard_normal()
        zw = heave(record(seed, push)).estimates["Zw"]
        errors.append((zw.value - ZW) / zw.sd)
    assert np.sqrt(np.mean(np.square(errors))) < 1.4
