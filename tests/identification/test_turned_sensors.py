"""A gyro that is mounted askew against the attitude is told, one that is not is never."""

import numpy as np
import pytest

from heli_jax import Flight, Free, Problem, linear_model
from heli_jax.identification.validation.turned_sensors import turned_sensors

N, DT = 2000, 0.02


def turn(degrees, seed, *, size=0.4, noise=0.03):
    """Of a flight in roll, pitch and yaw by the kinematics of Euler angles alone."""
    rng = np.random.default_rng(seed)
    smooth = np.ones(40) / 40
    body = np.stack([np.convolve(rng.standard_normal(N + 39), smooth, "valid") for _ in range(3)])
    body *= size / np.std(body, axis=1, keepdims=True)
    angles = np.zeros((3, N))
    for k in range(N - 1):
        # A pilot who keeps the machine level.
        body[:2, k + 1] -= angles[:2, k]
        phi, theta, _ = angles[:, k]
        p, q, r = 0.5 * (body[:, k] + body[:, k + 1])
        yawing = q * np.sin(phi) + r * np.cos(phi)
        rates = (p + np.tan(theta) * yawing, q * np.cos(phi) - r * np.sin(phi), 0.0)
        angles[:, k + 1] = angles[:, k] + DT * np.array(rates)
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    p, q, r = body
    measured = {"p": c * p + s * q, "q": c * q - s * p, "r": r, "phi": angles[0]}
    measured["theta"] = angles[1]
    outputs = {n: v + noise * np.std(v) * rng.standard_normal(N) for n, v in measured.items()}
    outputs["phi"] += 0.05
    shipped = linear_model("hybrid-flybarless")
    inputs = {n: np.zeros(N) for n in ("lat", "lon", "ped", "col")}
    flight = Flight(dt=DT, inputs=inputs, outputs=outputs)
    problem = Problem(shipped.model, shipped.vehicle({}).params, [flight], {"Lb": Free(100.0)})
    found = turned_sensors(problem)
    assert all(f.code == "signs.sensors-askew" for f in found)
    return [f.value for f in found]


@pytest.mark.parametrize("degrees", [6.0, -10.0])
def test_a_gyro_that_is_mounted_askew_is_told(degrees):
    for seed in range(5):
        assert turn(degrees, seed) == [pytest.approx(degrees, abs=1.5)]


def test_one_that_is_straight_is_not():
    for seed in range(15):
        assert turn(0.0, seed) == []
        assert turn(1.0, seed, noise=0.2) == []
