"""Devices around a model against transfer functions and simulations by hand."""

import math
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.signal

from heli_jax import linear_model, models, naming, simulate
from heli_jax.dynamics.jacobians import jacobians
from heli_jax.dynamics.model import Model, linear_misfit
from heli_jax.naming import Scalar

ROLL = linear_model("roll-flybarless")
SERVO: dict[str, Any] = {"omega_servo": 2 * math.pi * 8, "zeta_servo": 0.7}


def params(model, base=ROLL, **more: Any):
    return model.Params(**{**naming.asdict(base.vehicle().params), **more})


def transfer(model, p, frequencies, output, stick):
    """Return y/u at frequencies [rad/s] from the model's matrices."""
    A, B, C, D = (np.asarray(M) for M in jacobians(model, p))
    i = naming.names(model.Outputs).index(output)
    j = naming.names(model.Inputs).index(stick)
    eye = np.eye(len(A))
    return np.array(
        [C[i] @ np.linalg.solve(1j * w * eye - A, B[:, j]) + D[i, j] for w in frequencies]
    )


def by_hand(frequencies):
    """Return p/lat of the flybarless roll: Lb Blat/tau_f / (s (s + 1/tau_f) + Lb)."""
    s = 1j * np.asarray(frequencies)
    return 166.1 * 0.1398 / 0.04631 / (s * (s + 1 / 0.04631) + 166.1)


W = np.array([0.5, 3.0, 12.0, 40.0])


def test_a_servo_is_a_second_order_lag():
    model = models.with_servos(ROLL.model, ["lat"])
    assert model.linear
    p = params(model, **SERVO)
    assert linear_misfit(model, p) < 1e-12
    omega, zeta = SERVO.values()
    _, servo = scipy.signal.freqs([omega**2], [1, 2 * zeta * omega, omega**2], W)
    np.testing.assert_allclose(transfer(model, p, W, "p", "lat"), servo * by_hand(W), rtol=1e-10)


class Params(NamedTuple):
    k: Annotated[Scalar, "1/s", "gain"]


class State(NamedTuple):
    x: Annotated[Scalar, "rad", "angle"]


class Inputs(NamedTuple):
    u: Annotated[Scalar, "rad", "command"]


INTEGRATOR = Model(
    "integrator",
    lambda p, s, u: State(x=p.k * u.u),
    lambda p, s, u: State(x=s.x),
    Params,
    State,
    Inputs,
    State,
    linear=True,
)


def test_a_servo_is_limited_in_rate_as_simulated_by_hand():
    model = models.with_servos(INTEGRATOR, ["u"], rate_limit=True)
    assert not model.linear
    p = model.Params(k=1.0, rate_servo=2.0, **SERVO)
    assert naming.unit(model.Params, "rate_servo") == "rad/s"
    u = np.repeat([0.0, 1.0, -1.0], 50)
    run = simulate(model, p, model.Inputs(u=u), dt=0.01, substeps=10)
    omega, zeta, most = *SERVO.values(), 2.0
    x = v = 0.0
    positions, speeds = [], []
    # Euler in steps of 10 microseconds.
    for command in u:
        positions.append(x)
        speeds.append(v)
        for _ in range(1000):
            asked = min(max(omega / (2 * zeta) * (command - x), -most), most)
            x, v = x + 1e-5 * v, v + 1e-5 * 2 * zeta * omega * (asked - v)
    np.testing.assert_allclose(run.states.u_servo, positions, atol=2e-3)
    assert np.max(np.abs(run.states.u_servo_rate)) <= 2.0 + 1e-9
    assert max(speeds) > 1.9  # the limit is reached
    # Far from the limit the numbers equal those of the linear servo.
    faint = simulate(model, p, model.Inputs(u=1e-3 * u), dt=0.01, substeps=10).states.x
    linear = models.with_servos(INTEGRATOR, ["u"])
    same = simulate(linear, linear.Params(k=1.0, **SERVO), linear.Inputs(u=1e-3 * u), dt=0.01)
    np.testing.assert_allclose(faint, same.states.x, atol=1e-8)


def test_a_rate_loop_is_a_pi_controller_with_feedforward():
    servos = models.with_servos(ROLL.model, ["lat"])
    model = models.with_rate_loop(servos, ["lat"], lag=True)
    gains = {"Kp_lat": 0.05, "Ki_lat": 0.3, "Kff_lat": 0.4, "Kc_lat": 3.0, "tau_gyro_lat": 0.01}
    p = params(model, **SERVO, **gains)
    omega, zeta = SERVO.values()
    s = 1j * W
    plant = by_hand(W) * omega**2 / (s**2 + 2 * zeta * omega * s + omega**2)
    control, gyro = 0.05 + 0.3 / s, 1 / (1 + 0.01 * s)
    expected = plant * (0.4 + control) * 3.0 / (1 + plant * control * gyro)
    np.testing.assert_allclose(transfer(model, p, W, "p", "lat"), expected, rtol=1e-10)
    assert naming.unit(model.Params, "Kc_lat") == "rad/s"
    assert naming.unit(model.State, "lat_integral") == "rad"


class Tail(NamedTuple):
    Nr: Annotated[Scalar, "1/s", "damping"]
    Nped: Annotated[Scalar, "rad/s^2", "effect of the pedal"]


class Yaw(NamedTuple):
    r: Annotated[Scalar, "rad/s", "yaw rate"]


class Pedal(NamedTuple):
    ped: Annotated[Scalar, "1", "pedal"]


YAW = Model(
    "tail",
    lambda p, s, u: Yaw(r=p.Nr * s.r + p.Nped * u.ped),
    lambda p, s, u: s,
    Tail,
    Yaw,
    Pedal,
    Yaw,
    linear=True,
)


def test_a_damper_on_the_tail_is_the_published_yaw_gyro():
    # Mettler et al. 2000: r_fb' = 2.163 r - 8.258 r_fb and 33.07 (ped - r_fb).
    model = models.with_gyro(YAW, {"ped": "r"}, heading_hold=False)
    p = model.Params(Nr=-4.129, Nped=33.07, Kp_ped=2.163 / 8.258, tau_gyro_ped=1 / 8.258)
    poles = np.roots(np.poly(np.asarray(jacobians(model, p).A)))
    # Without the couplings to other axes, which change the fourth digit.
    np.testing.assert_allclose(sorted(poles.imag), [-8.1990, 8.1990], atol=5e-3)
    np.testing.assert_allclose(poles.real, -6.1966, atol=5e-3)
    np.testing.assert_allclose(np.prod(poles), 4.129 * 8.258 + 33.07 * 2.163, rtol=1e-12)
    hold = models.with_gyro(YAW, {"ped": "r"}, lag=False)
    p = hold.Params(Nr=-4.129, Nped=33.07, Kp_ped=0.2, Ki_ped=0.5, Kc_ped=2.0)
    s = 1j * W
    loop = 33.07 / (s + 4.129) * (0.2 + 0.5 / s)
    got = transfer(hold, p, W, "r", "ped")
    np.testing.assert_allclose(got, 2.0 * loop / (1 + loop), rtol=1e-10)


def test_an_output_is_late():
    model = models.with_delays(ROLL.model, outputs=["p"])
    assert model.linear
    p = params(model, delay_p=0.05)
    w = np.array([1.0, 10.0, 40.0])  # up to 2 / delay
    got = transfer(model, p, w, "p", "lat")
    np.testing.assert_allclose(got, by_hand(w) * np.exp(-0.05j * w), rtol=1e-3)
    np.testing.assert_allclose(
        transfer(model, p, w, "phi", "lat"), by_hand(w) / (1j * w), rtol=1e-10
    )
    # The delay line equals the Pade approximation [3/4].
    f = math.factorial
    num = [f(7 - k) * f(3) / (f(7) * f(k) * f(3 - k)) * (-1) ** k for k in range(4)]
    den = [f(7 - k) * f(4) / (f(7) * f(k) * f(4 - k)) for k in range(5)]
    x = 0.05j * w
    pade = np.polyval(num[::-1], x) / np.polyval(den[::-1], x)
    np.testing.assert_allclose(got, by_hand(w) * pade, rtol=1e-9)


def test_a_late_output_has_the_derivative_of_its_delay():
    model = models.with_delays(ROLL.model, outputs=["p"])

    def response(delay, w):
        A, B, C, D = jacobians(model, params(model, delay_p=delay))
        n, eye = len(A), jnp.eye(len(A))
        # Real and imaginary part separately: (i w - A) x = B.
        both = jnp.block([[-A, -w * eye], [w * eye, -A]])
        x = jnp.linalg.solve(both, jnp.concatenate([B[:, 0], jnp.zeros(n)]))
        return jnp.stack([C[1] @ x[:n] + D[1, 0], C[1] @ x[n:]])

    _, slope = jax.jvp(lambda delay: response(delay, 10.0), (0.06,), (1.0,))
    expected = -10j * np.exp(-0.6j) * by_hand([10.0])[0]
    np.testing.assert_allclose(slope, [expected.real, expected.imag], rtol=1e-4)


def test_an_input_is_late_in_front_and_within_a_loop():
    servos = models.with_servos(ROLL.model, ["lat"], delay=True)
    assert servos.delays == (("lat", "delay_servo"),)
    loop = models.with_rate_loop(servos, ["lat"], feedforward=False, integral=False)
    assert loop.delays == ()
    assert loop.delay_parameters == ("delay_servo",)
    model = models.with_delays(loop, inputs={"lat": "tau_radio"})
    assert model.delays == (("lat", "tau_radio"),)
    p = params(model, **SERVO, Kp_lat=0.05, Kc_lat=3.0, delay_servo=0.02, tau_radio=0.04)
    omega, zeta = SERVO.values()
    s = 1j * W
    plant = by_hand(W) * omega**2 / (s**2 + 2 * zeta * omega * s + omega**2) * np.exp(-0.02 * s)
    expected = plant * 0.15 / (1 + plant * 0.05)  # matrices do not contain the radio's delay
    np.testing.assert_allclose(transfer(model, p, W, "p", "lat"), expected, rtol=2e-3)


def test_sensors_lag_and_feel():
    hover = linear_model("r50-hover")
    model = models.with_sensors(hover.model, ["p", "ay"], {"phi": "tau_ahrs"}, imu=True)
    assert model.linear
    p = params(model, hover, tau_lowpass_p=0.03, tau_lowpass_ay=0.02, tau_ahrs=0.05)
    p = p._replace(x_imu=0.1, y_imu=-0.2, z_imu=0.3)
    bare = hover.vehicle().params
    plain = {n: transfer(hover.model, bare, W, n, "lat") for n in "uvwpqr"}
    angle = {n: transfer(hover.model, bare, W, n, "lat") for n in ("phi", "theta")}
    s, g = 1j * W, 32.2 * 0.3048
    lag = 1 / (1 + 0.03 * s)
    np.testing.assert_allclose(transfer(model, p, W, "p", "lat"), lag * plain["p"], rtol=1e-9)
    ax = s * plain["u"] + g * angle["theta"] + s * (0.3 * plain["q"] + 0.2 * plain["r"])
    np.testing.assert_allclose(transfer(model, p, W, "ax", "lat"), ax, rtol=1e-6)
    ay = s * plain["v"] - g * angle["phi"] + s * (0.1 * plain["r"] - 0.3 * plain["p"])
    np.testing.assert_allclose(transfer(model, p, W, "ay", "lat"), ay / (1 + 0.02 * s), rtol=1e-6)
    az = s * plain["w"] + s * (-0.2 * plain["p"] - 0.1 * plain["q"])
    np.testing.assert_allclose(transfer(model, p, W, "az", "lat"), az, rtol=1e-6)
    assert naming.unit(model.Outputs, "ax") == "m/s^2"


@pytest.mark.parametrize(
    "make",
    [
        lambda m: models.with_servos(m, ["lot"]),
        lambda m: models.with_servos(m, []),
        lambda m: models.with_servos(m, ["lat", "lat"]),
        lambda m: models.with_servos(models.with_servos(m, ["lat"]), ["lat"]),
        lambda m: models.with_delays(models.with_servos(m, ["lat"], delay=True), ["lat"]),
        lambda m: models.with_delays(m),
        lambda m: models.with_delays(m, outputs=["p"], order=9),
        lambda m: models.with_delays(m, {"lat": "Lb"}),
        lambda m: models.with_rate_loop(m, {"lat": "r"}),
        lambda m: models.with_gyro(m),
        lambda m: models.with_gyro(models.with_rate_loop(m, ["lat"]), {"lat": "p"}),
        lambda m: models.with_sensors(m, imu=True),
        lambda m: models.with_sensors(m),
        lambda m: models.with_sensors(m, ["r"]),
        lambda m: models.with_sensors(m, airspeed=True),
        lambda m: models.with_sensors(linear_model("heave").model, angular_acceleration=True),
    ],
)
def test_what_a_model_has_no_place_for_is_refused(make):
    with pytest.raises(ValueError):  # noqa: PT011
        make(ROLL.model)


class Body(NamedTuple):
    u: Annotated[Scalar, "m/s", "speed forward"]
    v: Annotated[Scalar, "m/s", "speed to the right"]
    w: Annotated[Scalar, "m/s", "speed downwards"]
    p: Annotated[Scalar, "rad/s", "roll rate"]
    q: Annotated[Scalar, "rad/s", "pitch rate"]
    r: Annotated[Scalar, "rad/s", "yaw rate"]
    phi: Annotated[Scalar, "rad", "roll angle"]
    theta: Annotated[Scalar, "rad", "pitch angle"]


class Gravity(NamedTuple):
    g: Annotated[Scalar, "m/s^2", "gravity"]


def test_an_accelerometer_in_a_body_that_turns():
    """Test a body under a known force: the sensor shows force over mass and the lever's part."""
    force, turning = np.array([1.0, 2.0, -9.5]), np.array([0.3, -0.2, 0.1])

    def field(p, s, u):
        gravity = p.g * jnp.stack(
            [
                -jnp.sin(s.theta),
                jnp.cos(s.theta) * jnp.sin(s.phi),
                jnp.cos(s.theta) * jnp.cos(s.phi),
            ]
        )
        omega, speed = jnp.stack([s.p, s.q, s.r]), jnp.stack([s.u, s.v, s.w])
        du, dv, dw = force + gravity - jnp.cross(omega, speed)
        return Body(du, dv, dw, *turning, phi=s.p, theta=s.q)

    body = Model("body", field, lambda p, s, u: s, Gravity, Body, Inputs, Body)
    model = models.with_sensors(body, imu=True)
    at = np.array([0.1, -0.2, 0.3])
    p = model.Params(g=9.81, x_imu=at[0], y_imu=at[1], z_imu=at[2])
    state = model.State(*np.array([5.0, -1.0, 2.0, 0.5, -1.5, 2.0, 0.4, -0.3]))
    y = model.output(p, state, model.Inputs(u=0.0))
    omega = np.array([0.5, -1.5, 2.0])
    expected = force + np.cross(turning, at) + np.cross(omega, np.cross(omega, at))
    np.testing.assert_allclose([y.ax, y.ay, y.az], expected, rtol=1e-12)
