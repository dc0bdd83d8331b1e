"""Accelerometers, angular accelerations and airspeed against a rigid body's positions.

The second program uses no forces. It integrates the states in small steps, computes the sensor's
position in earth axes, and takes its differences.
"""

import numpy as np
import pytest

from heli_jax import linear_model, models, naming
from heli_jax.dynamics.disturbance import with_disturbance
from tests.dynamics.test_full_helicopter import scattered

STEP = 1e-3
# Central differences of eighth order (Fornberg, 1988), for the points from -4 to 4.
FIRST = np.array([1 / 280, -4 / 105, 1 / 5, -4 / 5, 0, 4 / 5, -1 / 5, 4 / 105, -1 / 280])
SECOND = np.array([-1 / 560, 8 / 315, -1 / 5, 8 / 5, -205 / 72, 8 / 5, -1 / 5, 8 / 315, -1 / 560])
PLACES = {"imu": np.array([0.3, -0.2, 0.15]), "air": np.array([0.8, 0.1, -0.05])}


def followed(model, p, u, state):
    """Return states (9, n) from four steps before to four after, by Runge-Kutta with NumPy."""
    names = naming.names(model.State)

    def field(x):
        rates = model.vector_field(p, model.State(*x), u)
        return np.array([float(getattr(rates, n)) for n in names])

    def moved(x, h):
        k1 = field(x)
        k2 = field(x + h / 2 * k1)
        k3 = field(x + h / 2 * k2)
        return x + h / 6 * (k1 + 2 * k2 + 2 * k3 + field(x + h * k3))

    rows = {0: np.array([state[n] for n in names])}
    for sign in (1, -1):
        for k in range(1, 5):
            x = rows[sign * (k - 1)]
            for _ in range(4):
                x = moved(x, sign * STEP / 4)
            rows[sign * k] = x
    return np.array([rows[k] for k in range(-4, 5)])


def to_earth(phi, theta, psi):
    """Return the rotation from body to earth axes, both forward, right, down."""
    c, s = np.cos, np.sin
    yaw = np.array([[c(psi), -s(psi), 0], [s(psi), c(psi), 0], [0, 0, 1]])
    pitch = np.array([[c(theta), 0, s(theta)], [0, 1, 0], [-s(theta), 0, c(theta)]])
    roll = np.array([[1, 0, 0], [0, c(phi), -s(phi)], [0, s(phi), c(phi)]])
    return yaw @ pitch @ roll


@pytest.mark.parametrize("variant", ["full", "paper"])
def test_the_helicopters_sensors_are_where_a_rigid_body_carries_them(variant):
    bare = models.helicopter(variant, wind=variant == "full")
    model = models.with_sensors(bare, imu=True, angular_acceleration=True, airspeed=True)
    v, s, u = scattered(np.random.default_rng(3), models.helicopter())
    u |= {"wind_x": 3.0, "wind_y": -2.0, "wind_z": 1.0}
    s |= {"Omega": v["Omega"], "dbeta_roll": 0.3, "dbeta_pitch": -0.2}
    places = {f"{a}_{n}": x for n, at in PLACES.items() for a, x in zip("xyz", at, strict=True)}
    p = model.Params(**v, **places)
    inputs = model.Inputs(**{n: u[n] for n in naming.names(model.Inputs)})
    rows = followed(model, p, inputs, s)
    columns = dict(zip(naming.names(model.State), rows.T, strict=True))
    turns = np.array(
        [to_earth(*a) for a in zip(*(columns[n] for n in ("phi", "theta", "psi")), strict=True)]
    )
    centre = np.array([columns["x"], columns["y"], -columns["z"]]).T
    shown = model.output(p, model.State(*rows[4]), inputs)
    into_body = turns[4].T

    acceleration = SECOND @ (centre + turns @ PLACES["imu"]) / STEP**2
    force = into_body @ (acceleration - [0, 0, v["g"]])
    np.testing.assert_allclose([shown.ax, shown.ay, shown.az], force, rtol=1e-6, atol=1e-6)

    wind = np.array([3.0, -2.0, -1.0]) if variant == "full" else np.zeros(3)
    air = into_body @ (FIRST @ (centre + turns @ PLACES["air"]) / STEP - wind)
    np.testing.assert_allclose([shown.u_air, shown.v_air, shown.w_air], air, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(shown.airspeed, np.linalg.norm(air), rtol=1e-6)

    # omega x is R' dR/dt. The paper uses the angles' derivatives as body rates.
    first = np.einsum("k,kij->ij", FIRST, turns) / STEP
    second = np.einsum("k,kij->ij", SECOND, turns) / STEP**2
    turning = first.T @ first + into_body @ second
    alpha = np.array([turning[2, 1], turning[0, 2], turning[1, 0]])
    if variant == "paper":
        alpha = SECOND @ np.array([columns[n] for n in ("phi", "theta", "psi")]).T / STEP**2
    np.testing.assert_allclose([shown.pdot, shown.qdot, shown.rdot], alpha, rtol=1e-6, atol=1e-5)


def test_a_linear_model_shows_what_it_knows():
    roll = linear_model("roll-flybarless")
    model = models.with_sensors(roll.model, angular_acceleration=True)
    assert model.linear
    assert naming.names(model.Outputs)[-1] == "pdot"
    assert naming.unit(model.Outputs, "pdot") == "rad/s^2"
    hover = linear_model("r50-hover")
    probed = models.with_sensors(hover.model, airspeed=True)
    state = {n: 0.1 * i for i, n in enumerate(naming.names(probed.State))}
    p = probed.Params(**naming.asdict(hover.vehicle().params), x_air=0.5)
    still = probed.Inputs(**dict.fromkeys(naming.names(probed.Inputs), 0.0))
    y = probed.output(p, probed.State(**state), still)
    assert float(y.v_air) == pytest.approx(state["v"] + 0.5 * state["r"])
    assert float(y.w_air) == pytest.approx(state["w"] - 0.5 * state["q"])
    assert "airspeed" not in naming.names(probed.Outputs)


def test_an_accelerometer_feels_what_disturbs():
    """Test a disturbance of w', which is a force: az and pdot show it, also after a low-pass."""
    hover = linear_model("r50-hover")
    sensed = models.with_sensors(hover.model, ["ay"], imu=True, angular_acceleration=True)
    model = with_disturbance(sensed, ["w", "p"])
    assert [d.sigma for d in model.disturbances] == ["sigma_w_w", "sigma_w_p"]
    p = model.Params(**naming.asdict(hover.vehicle().params), tau_lowpass_ay=0.1, z_imu=0.2)
    state = dict.fromkeys(naming.names(model.State), 0.0)
    still = model.Inputs(**dict.fromkeys(naming.names(model.Inputs), 0.0))
    s = model.State(**{**state, "w1_w": 0.7, "w1_p": 0.4})
    y = model.output(p, s, still)
    assert float(y.az) == pytest.approx(0.7)
    assert float(y.pdot) == pytest.approx(0.4)
    rates = model.vector_field(p, s, still)
    assert float(rates.w) == pytest.approx(0.7)
    assert float(rates.ay_lowpass) == pytest.approx(-0.4 * 0.2 / 0.1)
