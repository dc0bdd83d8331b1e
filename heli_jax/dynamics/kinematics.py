r"""Rigid-body kinematics from logged rates and specific forces, to check a log's sensors.

Inputs are the readings of gyros and accelerometers; outputs are angles, velocities and positions.
Parameters are the sensors' errors. Without mass and thrust, any misfit comes from the sensors
(Klein and Morelli, Aircraft System Identification, 2006, chapter 10). Each sensor reads

$$z = (1 + \lambda)\,y + b + noise$$

Two choices differ from the book's equations, with the same trajectories. Velocities are along
north, east and down, so gyro noise enters only through the angles. Velocities are those of the IMU,
so its lever arm appears in the outputs as $\omega \times r$, without the angular acceleration.
"""

from typing import Annotated, Any, NamedTuple

import jax.numpy as jnp

from heli_jax import naming
from heli_jax.dynamics.model import Model
from heli_jax.naming import Record, Scalar

type Vector = tuple[Any, Any, Any]

RATES, FORCES, ANGLES = ("p", "q", "r"), ("ax", "ay", "az"), ("phi", "theta", "psi")
GROUND, BODY, POSITION = ("vn", "ve", "vd"), ("u", "v", "w"), ("N", "E", "D")
STEEPEST = 1.4
"""Pitch angle beyond which roll and yaw coincide and Euler angles fail [rad]."""


class AttitudeErrors(NamedTuple):
    """Gyro errors, for logs with only angles besides."""

    b_p: Annotated[Scalar, "rad/s", "bias, gyro roll"] = 0.0
    b_q: Annotated[Scalar, "rad/s", "bias, gyro pitch"] = 0.0
    b_r: Annotated[Scalar, "rad/s", "bias, gyro yaw"] = 0.0
    lambda_p: Annotated[Scalar, "1", "scale, gyro roll"] = 0.0
    lambda_q: Annotated[Scalar, "1", "scale, gyro pitch"] = 0.0
    lambda_r: Annotated[Scalar, "1", "scale, gyro yaw"] = 0.0
    delay_gyro: Annotated[Scalar, "s", "outputs behind the gyros"] = 0.0
    noise_gyro: Annotated[Scalar, "rad", "sd of an angle after 1 s by the gyros' noise"] = 0.0


class KinematicErrors(NamedTuple):
    """Errors of gyros and accelerometers, and the wind if an airspeed is measured."""

    b_p: Annotated[Scalar, "rad/s", "bias, gyro roll"] = 0.0
    b_q: Annotated[Scalar, "rad/s", "bias, gyro pitch"] = 0.0
    b_r: Annotated[Scalar, "rad/s", "bias, gyro yaw"] = 0.0
    lambda_p: Annotated[Scalar, "1", "scale, gyro roll"] = 0.0
    lambda_q: Annotated[Scalar, "1", "scale, gyro pitch"] = 0.0
    lambda_r: Annotated[Scalar, "1", "scale, gyro yaw"] = 0.0
    delay_gyro: Annotated[Scalar, "s", "outputs behind the gyros"] = 0.0
    noise_gyro: Annotated[Scalar, "rad", "sd of an angle after 1 s by the gyros' noise"] = 0.0
    b_ax: Annotated[Scalar, "m/s^2", "bias, accelerometer forward"] = 0.0
    b_ay: Annotated[Scalar, "m/s^2", "bias, accelerometer right"] = 0.0
    b_az: Annotated[Scalar, "m/s^2", "bias, accelerometer down"] = 0.0
    lambda_ax: Annotated[Scalar, "1", "scale, accelerometer forward"] = 0.0
    lambda_ay: Annotated[Scalar, "1", "scale, accelerometer right"] = 0.0
    lambda_az: Annotated[Scalar, "1", "scale, accelerometer down"] = 0.0
    x_imu: Annotated[Scalar, "m", "IMU ahead of the velocity sensor"] = 0.0
    y_imu: Annotated[Scalar, "m", "IMU to the right of the velocity sensor"] = 0.0
    z_imu: Annotated[Scalar, "m", "IMU below it"] = 0.0
    delay_accel: Annotated[Scalar, "s", "outputs behind accelerometers"] = 0.0
    noise_accel: Annotated[
        Scalar, "m/s", "sd of a velocity after 1 s by the accelerometers' noise"
    ] = 0.0
    wind_n: Annotated[Scalar, "m/s", "steady wind's velocity to the north"] = 0.0
    wind_e: Annotated[Scalar, "m/s", "steady wind's velocity to the east"] = 0.0
    wind_d: Annotated[Scalar, "m/s", "steady wind's velocity down"] = 0.0
    g: Annotated[Scalar, "m/s^2", "gravitational acceleration"] = 9.80665


class Attitude(NamedTuple):
    phi: Annotated[Scalar, "rad", "roll angle"]
    theta: Annotated[Scalar, "rad", "pitch angle"]
    psi: Annotated[Scalar, "rad", "yaw angle"]


class VelocityState(NamedTuple):
    phi: Annotated[Scalar, "rad", "roll angle"]
    theta: Annotated[Scalar, "rad", "pitch angle"]
    psi: Annotated[Scalar, "rad", "yaw angle"]
    vn: Annotated[Scalar, "m/s", "velocity of the IMU to the north"]
    ve: Annotated[Scalar, "m/s", "velocity of the IMU to the east"]
    vd: Annotated[Scalar, "m/s", "velocity of the IMU down"]


class PositionState(NamedTuple):
    phi: Annotated[Scalar, "rad", "roll angle"]
    theta: Annotated[Scalar, "rad", "pitch angle"]
    psi: Annotated[Scalar, "rad", "yaw angle"]
    vn: Annotated[Scalar, "m/s", "velocity of the IMU to the north"]
    ve: Annotated[Scalar, "m/s", "velocity of the IMU to the east"]
    vd: Annotated[Scalar, "m/s", "velocity of the IMU down"]
    N: Annotated[Scalar, "m", "position of the IMU to the north"]
    E: Annotated[Scalar, "m", "position of the IMU to the east"]
    D: Annotated[Scalar, "m", "position of the IMU down"]


class Rates(NamedTuple):
    p: Annotated[Scalar, "rad/s", "roll rate as the gyro showed it"]
    q: Annotated[Scalar, "rad/s", "pitch rate as the gyro showed it"]
    r: Annotated[Scalar, "rad/s", "yaw rate as the gyro showed it"]


class RatesAndForces(NamedTuple):
    p: Annotated[Scalar, "rad/s", "roll rate as the gyro showed it"]
    q: Annotated[Scalar, "rad/s", "pitch rate as the gyro showed it"]
    r: Annotated[Scalar, "rad/s", "yaw rate as the gyro showed it"]
    ax: Annotated[Scalar, "m/s^2", "specific force forward as the accelerometer showed it"]
    ay: Annotated[Scalar, "m/s^2", "specific force to the right as the accelerometer showed it"]
    az: Annotated[Scalar, "m/s^2", "specific force down as the accelerometer showed it"]


class Velocities(NamedTuple):
    phi: Annotated[Scalar, "rad", "roll angle"]
    theta: Annotated[Scalar, "rad", "pitch angle"]
    psi: Annotated[Scalar, "rad", "yaw angle"]
    vn: Annotated[Scalar, "m/s", "velocity to the north"]
    ve: Annotated[Scalar, "m/s", "velocity to the east"]
    vd: Annotated[Scalar, "m/s", "velocity down"]
    u: Annotated[Scalar, "m/s", "velocity along the body, forward"]
    v: Annotated[Scalar, "m/s", "velocity along the body, to the right"]
    w: Annotated[Scalar, "m/s", "velocity along the body, down"]
    V: Annotated[Scalar, "m/s", "airspeed"]


class Positions(NamedTuple):
    phi: Annotated[Scalar, "rad", "roll angle"]
    theta: Annotated[Scalar, "rad", "pitch angle"]
    psi: Annotated[Scalar, "rad", "yaw angle"]
    vn: Annotated[Scalar, "m/s", "velocity to the north"]
    ve: Annotated[Scalar, "m/s", "velocity to the east"]
    vd: Annotated[Scalar, "m/s", "velocity down"]
    u: Annotated[Scalar, "m/s", "velocity along the body, forward"]
    v: Annotated[Scalar, "m/s", "velocity along the body, to the right"]
    w: Annotated[Scalar, "m/s", "velocity along the body, down"]
    V: Annotated[Scalar, "m/s", "airspeed"]
    N: Annotated[Scalar, "m", "position to the north"]
    E: Annotated[Scalar, "m", "position to the east"]
    D: Annotated[Scalar, "m", "position down"]


def corrected(p: Record, u: Record, names: tuple[str, str, str]) -> Vector:
    r"""Return the true value of three sensors: $y = (z - b)/(1 + \lambda)$.

    Args:
        p: the errors, SI.
        u: the readings, SI.
    """
    first, second, third = (
        (getattr(u, n) - getattr(p, f"b_{n}")) / (1.0 + getattr(p, f"lambda_{n}")) for n in names
    )
    return first, second, third


def euler_rates(s: Record, omega: Vector) -> dict[str, Any]:
    """Return the derivatives of the Euler angles [rad/s] (Klein and Morelli, 2006, eqs 3.20).

    Args:
        s: state with phi, theta [rad].
        omega: rates about the body's axes [rad/s].
    """
    p, q, r = omega
    about = q * jnp.sin(s.phi) + r * jnp.cos(s.phi)
    return {
        "phi": p + about * jnp.tan(s.theta),
        "theta": q * jnp.cos(s.phi) - r * jnp.sin(s.phi),
        "psi": about / jnp.cos(s.theta),
    }


def to_ground(s: Record, body: Vector) -> Vector:
    """Convert a vector from body axes to north, east and down: roll, pitch, then yaw.

    Args:
        s: state with phi, theta, psi [rad].
    """
    x, y, z = body
    y, z = jnp.cos(s.phi) * y - jnp.sin(s.phi) * z, jnp.sin(s.phi) * y + jnp.cos(s.phi) * z
    x, z = jnp.cos(s.theta) * x + jnp.sin(s.theta) * z, jnp.cos(s.theta) * z - jnp.sin(s.theta) * x
    return (
        jnp.cos(s.psi) * x - jnp.sin(s.psi) * y,
        jnp.sin(s.psi) * x + jnp.cos(s.psi) * y,
        z,
    )


def to_body(s: Record, ground: Vector) -> Vector:
    """Convert a vector to body axes; the inverse of `to_ground`.

    Args:
        s: state with phi, theta, psi [rad].
    """
    x, y, z = ground
    x, y = jnp.cos(s.psi) * x + jnp.sin(s.psi) * y, jnp.cos(s.psi) * y - jnp.sin(s.psi) * x
    x, z = jnp.cos(s.theta) * x - jnp.sin(s.theta) * z, jnp.sin(s.theta) * x + jnp.cos(s.theta) * z
    return x, jnp.cos(s.phi) * y + jnp.sin(s.phi) * z, jnp.cos(s.phi) * z - jnp.sin(s.phi) * y


def _attitude_field(p: AttitudeErrors, s: Attitude, u: Rates) -> Attitude:
    return Attitude(**euler_rates(s, corrected(p, u, RATES)))


def _attitude_output(p: AttitudeErrors, s: Attitude, u: Rates) -> Attitude:
    return s


def _velocity_rates(p: KinematicErrors, s: Record, u: RatesAndForces) -> dict[str, Any]:
    """Return the rates of angles and velocities; an accelerometer measures all forces except
    weight.
    """
    north, east, down = to_ground(s, corrected(p, u, FORCES))
    angles = euler_rates(s, corrected(p, u, RATES))
    return {**angles, "vn": north, "ve": east, "vd": down + p.g}


def _velocity_field(p: KinematicErrors, s: VelocityState, u: RatesAndForces) -> VelocityState:
    return VelocityState(**_velocity_rates(p, s, u))


def _position_field(p: KinematicErrors, s: PositionState, u: RatesAndForces) -> PositionState:
    return PositionState(**_velocity_rates(p, s, u), N=s.vn, E=s.ve, D=s.vd)


def _arm(p: KinematicErrors) -> Vector:
    """Return the vector from the IMU to the point of velocities and positions, in body axes [m]."""
    return -p.x_imu, -p.y_imu, -p.z_imu


def _velocities(p: KinematicErrors, s: Record, u: RatesAndForces) -> dict[str, Any]:
    (wx, wy, wz), (x, y, z) = corrected(p, u, RATES), _arm(p)
    # omega x r with logged rates: their noise times a lever arm is far below that of any velocity
    # sensor.
    turning = to_ground(s, (wy * z - wz * y, wz * x - wx * z, wx * y - wy * x))
    vn, ve, vd = s.vn + turning[0], s.ve + turning[1], s.vd + turning[2]
    ahead, right, below = to_body(s, (vn, ve, vd))
    squares = (vn - p.wind_n) ** 2 + (ve - p.wind_e) ** 2 + (vd - p.wind_d) ** 2
    # The root has no derivative at zero, and a flight may start at rest.
    airspeed = jnp.sqrt(squares + 1e-12)
    angles = {"phi": s.phi, "theta": s.theta, "psi": s.psi}
    return {**angles, "vn": vn, "ve": ve, "vd": vd, "u": ahead, "v": right, "w": below} | {
        "V": airspeed
    }


def _velocity_output(p: KinematicErrors, s: VelocityState, u: RatesAndForces) -> Velocities:
    return Velocities(**_velocities(p, s, u))


def _position_output(p: KinematicErrors, s: PositionState, u: RatesAndForces) -> Positions:
    north, east, down = to_ground(s, _arm(p))
    return Positions(**_velocities(p, s, u), N=s.N + north, E=s.E + east, D=s.D + down)


def _angle_noise(p: Record) -> Vector:
    # The sd of a random walk after one second equals the root of its spectral density. As in level
    # flight, where the angles turn about the gyros' axes. All three sensors have equal noise,
    # corrected like their readings.
    over = (1.0 + p.lambda_p, 1.0 + p.lambda_q, 1.0 + p.lambda_r)
    return p.noise_gyro / over[0], p.noise_gyro / over[1], p.noise_gyro / over[2]


def _attitude_noise(p: AttitudeErrors) -> Attitude:
    return Attitude(*_angle_noise(p))


def _velocity_noise(p: KinematicErrors) -> VelocityState:
    # Equal noise on all accelerometer axes is equal on the ground axes too, except for the scales.
    # Horizontal noise is equal at any heading.
    level = p.noise_accel / jnp.sqrt(jnp.abs((1.0 + p.lambda_ax) * (1.0 + p.lambda_ay)))
    return VelocityState(*_angle_noise(p), level, level, p.noise_accel / (1.0 + p.lambda_az))


def _position_noise(p: KinematicErrors) -> PositionState:
    none = jnp.zeros_like(jnp.asarray(p.noise_accel))
    return PositionState(*_velocity_noise(p), none, none, none)


_GYRO_SCALES = tuple(f"lambda_{n}" for n in RATES)
_IMU_SCALES = (*_GYRO_SCALES, *(f"lambda_{n}" for n in FORCES))
_GYRO = tuple((n, "delay_gyro") for n in RATES)
_IMU = (*_GYRO, *((n, "delay_accel") for n in FORCES))

attitude = Model(
    "kinematics-attitude",
    _attitude_field,
    _attitude_output,
    AttitudeErrors,
    Attitude,
    Rates,
    Attitude,
    noise_intensity=_attitude_noise,
    axes=(),
    delays=_GYRO,
    input_scales=_GYRO_SCALES,
    positive=("noise_gyro",),
    explicit=True,
)
"""Model of rates against angles."""

velocity = Model(
    "kinematics-velocity",
    _velocity_field,
    _velocity_output,
    KinematicErrors,
    VelocityState,
    RatesAndForces,
    Velocities,
    noise_intensity=_velocity_noise,
    axes=(),
    delays=_IMU,
    input_scales=_IMU_SCALES,
    positive=("noise_gyro", "noise_accel", "g"),
    explicit=True,
)
"""Model of rates and specific forces against angles, velocities and airspeed."""

position = Model(
    "kinematics-position",
    _position_field,
    _position_output,
    KinematicErrors,
    PositionState,
    RatesAndForces,
    Positions,
    noise_intensity=_position_noise,
    axes=(),
    delays=_IMU,
    input_scales=_IMU_SCALES,
    positive=("noise_gyro", "noise_accel", "g"),
    explicit=True,
)
"""The same against positions too."""


def kinematics(inputs: set[str], outputs: set[str]) -> Model:
    """Return the kinematic model for a log's signals.

    Raises:
        ValueError: accelerometers without a velocity or position, or the reverse.
    """
    moving = outputs & {*naming.names(Positions)} - {*ANGLES}
    forces = inputs & {*FORCES}
    if not moving and not forces:
        return attitude
    if not moving:
        raise ValueError(
            f"{min(forces)} is logged, expected a velocity (vn, ve, vd or u, v, w), an airspeed V "
            "or a position (N, E, D) for comparison, got none: leave the accelerometers out to "
            "compare only rates and angles"
        )
    if not forces:
        raise ValueError(
            f"{min(moving)} is an output, expected the specific forces ax, ay, az among the "
            "inputs, got none: leave it out to compare only rates and angles"
        )
    return position if outputs & {*POSITION} else velocity


def is_kinematic(model: Model) -> bool:
    """True if a model is kinematic, with or without devices around it."""
    return model.name.startswith("kinematics-")
