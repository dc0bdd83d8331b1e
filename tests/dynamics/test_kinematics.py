"""Rigid-body kinematics against a motion in closed form, and the effects of sensor errors."""

import runpy
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from heli_jax import models, simulate
from heli_jax.config.kinematics import (
    between_samples,
    completed,
    errors_of,
    noise_of,
    prepared,
    sharpened,
)
from heli_jax.dynamics import kinematics
from heli_jax.errors import InputError
from heli_jax.flights.flight import Flight, Signal

RATE, DURATION, WIND = 50.0, 6.0, np.array([3.0, -2.0, 0.5])
ERRORS = {
    "b_p": 0.03, "b_q": -0.02, "b_r": 0.01, "lambda_p": 0.05, "lambda_q": -0.04, "lambda_r": 0.02,
    "b_ax": 0.3, "b_ay": -0.2, "b_az": 0.4, "lambda_ax": -0.02, "lambda_ay": 0.03,
    "lambda_az": 0.01, "x_imu": 0.3, "y_imu": -0.2, "z_imu": 0.15,
    "delay_gyro": -0.03, "delay_accel": -0.03,
}  # fmt: skip


@pytest.fixture(scope="module")
def truth():
    """A motion in closed form; its rates are differences of the rotation matrix."""
    path = Path(__file__).parents[2] / "experiments" / "data_compatibility.py"
    return runpy.run_path(str(path))["Motion"](np.random.default_rng(3))


def test_errors_of_every_kind_are_undone(truth):
    t = np.arange(round(DURATION * RATE)) / RATE
    late = t - ERRORS["delay_gyro"]
    arm = np.array([ERRORS[f"{axis}_imu"] for axis in "xyz"])
    sensors = np.hstack([truth.omega(t), truth.force(t, arm)])
    inputs = {
        n: jnp.asarray((1 + ERRORS[f"lambda_{n}"]) * sensors[:, i] + ERRORS[f"b_{n}"])
        for i, n in enumerate(("p", "q", "r", "ax", "ay", "az"))
    }
    # The states are those of the IMU, at its arm from the measured velocities.
    R, w = truth.attitude(late), truth.omega(late)
    first = np.concatenate(
        [
            truth.angles(late)[0],
            truth.velocity(late)[0] + R[0] @ np.cross(w[0], arm),
            truth.position(late)[0] + R[0] @ arm,
        ]
    )
    model = kinematics.position
    wind = dict(zip(("wind_n", "wind_e", "wind_d"), WIND, strict=True))
    run = simulate(
        model,
        model.Params(**{n: jnp.asarray(v) for n, v in {**ERRORS, **wind}.items()}),
        model.Inputs(**inputs),
        dt=1 / RATE,
        initial_state=model.State(*map(jnp.asarray, first)),
        hold=dict.fromkeys(inputs, "linear"),
    )
    velocity = truth.velocity(late)
    expected = np.column_stack(
        [
            truth.angles(late),
            velocity,
            np.einsum("kji,kj->ki", R, velocity),
            np.linalg.norm(velocity - WIND, axis=1),
            truth.position(late),
        ]
    )
    found = np.column_stack([np.asarray(getattr(run.outputs, n)) for n in model.Outputs._fields])
    # Straight lines between samples of 20 ms. The IMU is late, so its values after the record are
    # unknown.
    error = np.abs(found - expected)[:-2].max(axis=0)
    np.testing.assert_array_less(error, [1e-3] * 3 + [0.02] * 7 + [0.05] * 3)
    # Without the lever arm velocities would be off by omega times it.
    assert np.abs(np.cross(w, arm)).max() > 0.2


def test_the_model_is_the_one_that_the_signals_allow():
    rates, angles = {"p", "q", "r"}, {"phi", "theta", "psi"}
    imu = rates | {"ax", "ay", "az"}
    assert kinematics.kinematics(rates, angles) is kinematics.attitude
    assert kinematics.kinematics(imu, angles | {"vn"}) is kinematics.velocity
    assert kinematics.kinematics(imu, {"N"}) is kinematics.position
    with pytest.raises(ValueError, match="ax is logged, expected a velocity"):
        kinematics.kinematics(imu, angles)
    with pytest.raises(ValueError, match="vn is an output, expected the specific forces"):
        kinematics.kinematics(rates, angles | {"vn"})


def test_wind_is_free_where_airspeed_and_speed_over_ground_are_measured():
    both = errors_of(kinematics.velocity, ["V", "vn"])
    assert {"wind_n", "x_imu", "delay_accel"} <= both.keys()
    assert "wind_n" not in errors_of(kinematics.velocity, ["V"])
    assert errors_of(kinematics.attitude, ["phi"]).keys() == {
        *("b_p", "b_q", "b_r", "lambda_p", "lambda_q", "lambda_r", "delay_gyro")
    }


def a_configuration(**more):
    named = {"inputs": {n: {"signal": n} for n in "pqr"}, "outputs": {"phi": {"signal": "phi"}}}
    return {"model": "kinematics", "flights": [{"log": "a.csv", "signals": named}], **more}


def test_a_configuration_may_leave_out_what_follows_from_its_signals():
    full = completed(a_configuration(vehicle={"b_r": 0.0}), "a.yaml")
    assert full["model"] == "kinematics-attitude"
    # A stated value is a known error.
    assert "b_q" in full["fit"]["free"]
    assert "b_r" not in full["fit"]["free"]
    assert full["fit"]["nuisance"] == {"bias": False, "input_offset": False}
    stated = completed(a_configuration(fit={"free": {"b_p": {"start": 0.0}}}), "a.yaml")
    assert list(stated["fit"]["free"]) == ["b_p"]
    other = {"model": "roll"}
    assert completed(other, "a.yaml") is other
    for wrong in ({"flights": 3}, {"flights": [3]}, {"fit": [1]}, {"fit": {"nuisance": 3}}):
        completed(a_configuration(**wrong), "a.yaml")  # validation refuses it


def test_rates_move_between_samples_unless_the_configuration_says_otherwise():
    stated = {"p": Signal("a", "1", "1"), "q": Signal("b", "1", "1", hold="zero-order")}
    found = between_samples(kinematics.attitude, stated)
    assert [found[n].hold for n in "pq"] == ["linear", "zero-order"]
    assert between_samples(models.roll, stated) == stated


@pytest.mark.parametrize("delay", [0.0, 0.013])
def test_lines_between_sharpened_samples_have_the_area_of_the_motion(delay):
    dt, omega = 0.05, 2 * np.pi * 1.0
    t = np.arange(400) * dt
    held = {"p": "linear", "q": "linear", "r": "zero-order"}
    flight = Flight(dt=dt, inputs=dict.fromkeys("pqr", np.cos(omega * t)), outputs={}, hold=held)
    inputs = sharpened(kinematics.attitude, flight).inputs
    np.testing.assert_array_equal(inputs["r"], flight.inputs["r"])
    # The delayed lines may start anywhere in an interval.
    fine = np.arange(5.0, 15.0, dt / 200)

    def amplitude(u):
        angle = np.cumsum(np.interp(fine - delay, t, u)) * dt / 200
        return 2 * abs(np.mean((angle - angle.mean()) * np.exp(-1j * omega * fine))) * omega

    lost = (omega * dt) ** 2 / 12
    assert amplitude(flight.inputs["p"]) == pytest.approx(1 - lost, abs=0.05 * lost)
    assert amplitude(inputs["p"]) == pytest.approx(1.0, abs=0.05 * lost)
    assert sharpened(models.roll, flight) is flight


def test_yaw_is_unwrapped_and_steep_flight_refused():
    yaw = np.linspace(0.0, 12.0, 50)
    wrapped = (yaw + np.pi) % (2 * np.pi) - np.pi
    wrapped[20] = np.nan
    flight = Flight(dt=0.1, inputs={}, outputs={"psi": wrapped, "theta": 0.1 * yaw})
    y = prepared(kinematics.attitude, flight, "a").outputs["psi"]
    assert np.isnan(y[20])
    np.testing.assert_allclose(np.delete(y, 20), np.delete(yaw, 20), atol=1e-12)
    steep = Flight(dt=0.1, inputs={}, outputs={"theta": np.linspace(0, 1.5, 50)})
    with pytest.raises(InputError, match=r"a: theta reaches 86 deg, expected at most 80 deg"):
        prepared(kinematics.attitude, steep, "a")


def test_noise_of_the_gyros_is_a_random_walk_of_the_angle():
    rng, dt, sd = np.random.default_rng(0), 0.01, 0.02
    rates = {n: np.sin(0.01 * np.arange(5000)) + sd * rng.standard_normal(5000) for n in "pqr"}
    flight = Flight(dt=dt, inputs=rates, outputs={"phi": np.zeros(5000)})
    # An independent result: the scatter of many angles after a second of such noise.
    drift = np.std(dt * sd * rng.standard_normal((4000, 100)).sum(axis=1))
    assert noise_of(kinematics.attitude, [flight])["noise_gyro"] == pytest.approx(drift, rel=0.05)


def test_what_no_sensor_shows_is_refused():
    rates = dict.fromkeys("pqr", np.linspace(-100.0, 80.0, 50))
    flight = Flight(dt=0.1, inputs=rates, outputs={"phi": np.zeros(50)})
    with pytest.raises(InputError, match=r"a: p reaches 100 rad/s, .*: check its unit"):
        prepared(kinematics.attitude, flight, "a")
    dead = Flight(dt=0.1, inputs={}, outputs={"psi": np.full(50, 0.5)})
    with pytest.raises(InputError, match=r"a: psi is 0\.5 in all samples"):
        prepared(kinematics.attitude, dead, "a")
    far = Flight(dt=0.1, inputs={}, outputs={"theta": np.linspace(0, 30, 50)})
    with pytest.raises(InputError, match=r"theta reaches 1719 deg, "):
        prepared(kinematics.attitude, far, "a")
