"""A rotor's line in stick and gyro is told from a closed loop."""

import numpy as np
import pytest
from scipy.signal import lfilter

from heli_jax.flights.flight import Flight
from heli_jax.identification.validation.follows_response import feedback

DT, N = 0.01, 4000
T = np.arange(N) * DT


def record(loop, shared):
    """Roll by a chirp, with a line at 24 Hz in the rate, or in the stick too, or with a pilot."""
    rng = np.random.default_rng(4)
    wander = lfilter([0.02], [1, -0.98], rng.standard_normal(N))
    turned = np.cumsum(48 * np.pi * (1 + 0.01 * wander)) * DT
    gust = lfilter([0.01], [1, -0.97], rng.standard_normal(N))
    stick, rate = 0.4 * np.sin(0.5 * T + 0.25 * T**2), np.zeros(N)
    for k in range(1, N):
        stick[k] -= loop * rate[k - 1]
        rate[k] = 0.9 * rate[k - 1] + 0.2 * stick[k - 1] + gust[k] * bool(loop)
    rate = rate + 0.01 * rng.standard_normal(N) + 0.2 * np.sin(turned)
    stick = stick + shared * np.sin(turned + 1) + 1e-4 * rng.standard_normal(N)
    return Flight(dt=DT, inputs={"lat": stick}, outputs={"p": rate})


@pytest.mark.parametrize(("loop", "shared"), [(0.0, 0.02), (0.0, 0.1), (0.05, 0.0), (0.0, 0.0)])
def test_a_line_in_stick_and_gyro_is_no_feedback(loop, shared):
    (found,) = feedback(record(loop, shared))
    assert found.present == bool(loop)
