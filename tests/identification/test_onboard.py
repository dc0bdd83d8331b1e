"""Servo and delays of a simulated record, and findings of a fit without the servo."""

import math

import numpy as np
import pytest
import scipy.signal

from heli_jax import Flight, Free, Problem, fit, linear_model, models, naming

ROLL = linear_model("roll-flybarless")
LB, TAU_F, BLAT = 166.1, 0.04631, 0.1398
OMEGA, ZETA = 2.0 * math.pi * 8.0, 0.7
DT, FINE = 0.02, 20
DELAY_LAT, DELAY_PHI = 0.034, 0.051


def record(seed, n=300):
    """Return a roll through an 8 Hz servo, by scipy at 1 kHz, with delays of whole milliseconds."""
    rng = np.random.default_rng(seed)
    lat = np.repeat(rng.uniform(-0.3, 0.3, n), rng.integers(5, 25, n))[:n]
    den = np.polymul([1.0, 1.0 / TAU_F, LB], [1.0, 2.0 * ZETA * OMEGA, OMEGA**2])
    p_of, phi_of = (
        scipy.signal.cont2discrete(([LB * BLAT / TAU_F * OMEGA**2], d), DT / FINE, method="zoh")
        for d in (den, np.polymul(den, [1.0, 0.0]))
    )

    def response(system, delay):
        # At rest before the record, and read with the log's delay.
        lead = 200
        u = np.concatenate([np.zeros(lead), np.repeat(lat, FINE)])
        y = scipy.signal.lfilter(system[0].ravel(), system[1], u)
        return y[lead + FINE * np.arange(n) - round(1000 * delay)]

    p = response(p_of, DELAY_LAT) + 0.004 * rng.standard_normal(n)
    phi = response(phi_of, DELAY_LAT + DELAY_PHI) + 0.001 * rng.standard_normal(n)
    return Flight(dt=DT, inputs={"lat": lat}, outputs={"p": p, "phi": phi})


def params(model, **more):
    return model.Params(**{**naming.asdict(ROLL.vehicle().params), **more})


@pytest.mark.slow
def test_a_servo_and_two_delays_are_recovered():
    model = models.with_servos(ROLL.model, ["lat"])
    model = models.with_delays(model, ["lat"], ["phi"], order=3)
    start = params(model, omega_servo=1.0, zeta_servo=ZETA, delay_lat=0.0, delay_phi=0.1)
    free = {
        "Lb": Free(120.0),
        "omega_servo": Free(80.0),
        "delay_lat": Free(0.01),
        "delay_phi": Free(0.08),
    }
    found = fit(Problem(model, start, [record(1)], free), starts=1)
    assert found.status == "converged"
    truth = {"Lb": LB, "omega_servo": OMEGA, "delay_lat": DELAY_LAT, "delay_phi": DELAY_PHI}
    for name, value in truth.items():
        estimate = found.estimates[name]
        assert estimate.lower95 < value < estimate.upper95, name
    # Accurate enough to exclude a servo twice as fast.
    assert found.estimates["omega_servo"].sd < 0.15 * OMEGA
    assert not [f for f in found.findings if f.code.startswith("dynamics.")]
