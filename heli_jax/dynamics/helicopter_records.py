"""What the full nonlinear helicopter is made of: states, inputs, outputs, and its corrections."""

from typing import Annotated, NamedTuple

from heli_jax.naming import Scalar


class HelicopterState(NamedTuple):
    x: Annotated[Scalar, "m", "position forward of the origin"]
    y: Annotated[Scalar, "m", "position to the right"]
    z: Annotated[Scalar, "m", "height"]
    phi: Annotated[Scalar, "rad", "roll angle, right side down"]
    theta: Annotated[Scalar, "rad", "pitch angle, nose up"]
    psi: Annotated[Scalar, "rad", "yaw angle, nose right"]
    dx: Annotated[Scalar, "m/s", "velocity along x"]
    dy: Annotated[Scalar, "m/s", "velocity along y"]
    dz: Annotated[Scalar, "m/s", "velocity upwards"]
    dphi: Annotated[Scalar, "rad/s", "derivative of phi"]
    dtheta: Annotated[Scalar, "rad/s", "derivative of theta"]
    dpsi: Annotated[Scalar, "rad/s", "derivative of psi"]
    beta_roll: Annotated[Scalar, "rad", "flybar angle, roll"]
    dbeta_roll: Annotated[Scalar, "rad/s", "flybar rate, roll"]
    beta_pitch: Annotated[Scalar, "rad", "flybar angle, pitch"]
    dbeta_pitch: Annotated[Scalar, "rad/s", "flybar rate, pitch"]
    Omega: Annotated[Scalar, "rad/s", "rotor speed"]


class HelicopterInputs(NamedTuple):
    x_roll: Annotated[Scalar, "m", "cyclic input displacement, roll"]
    x_pitch: Annotated[Scalar, "m", "cyclic input displacement, pitch"]
    x_yaw: Annotated[Scalar, "1", "yaw stick"]
    x_throttle: Annotated[Scalar, "1", "throttle stick"]


# Beyond the paper, which has one stick for throttle and collective: fields that a variant adds are
# kept apart, so that its records have those of its equations and no others.
COLLECTIVE = Annotated[Scalar, "1", "collective stick"]
"""an input of its own where collective and throttle are apart"""
ROTOR_SPEED = Annotated[Scalar, "rad/s", "rotor speed, measured"]
"""an input where the rotor's speed is measured and no motor is modelled"""
TILT = {
    "a1": Annotated[Scalar, "rad", "tip-path plane, back"],
    "b1": Annotated[Scalar, "rad", "tip-path plane, right"],
}
"""the states of flapping"""
GOVERNOR = Annotated[Scalar, "1", "governor: integral part of the throttle"]
"""the state of the governor"""
INFLOW = Annotated[Scalar, "m/s", "induced velocity of the main rotor"]
"""the state of dynamic inflow"""


class HelicopterOutputs(NamedTuple):
    roll: Annotated[Scalar, "rad", "roll angle"]
    pitch: Annotated[Scalar, "rad", "pitch angle"]
    yaw: Annotated[Scalar, "rad", "yaw angle"]
    roll_rate: Annotated[Scalar, "rad/s", "roll rate"]
    pitch_rate: Annotated[Scalar, "rad/s", "pitch rate"]
    yaw_rate: Annotated[Scalar, "rad/s", "yaw rate"]
    x: Annotated[Scalar, "m", "position forward of the origin"]
    y: Annotated[Scalar, "m", "position to the right"]
    z: Annotated[Scalar, "m", "height"]
    dx: Annotated[Scalar, "m/s", "velocity along x"]
    dy: Annotated[Scalar, "m/s", "velocity along y"]
    dz: Annotated[Scalar, "m/s", "velocity upwards"]
    rotor_speed: Annotated[Scalar, "rad/s", "rotor speed"]


# Switches and not subclasses: each departure from the paper can be tried by itself, and its effect
# told from that of the others. A NamedTuple of booleans is static to jit, so a switch that is off
# costs nothing.
class Corrections(NamedTuple):
    """What of the paper is corrected or added; each for itself."""

    direction: bool = False
    """eqs 2-3: thrust along the mast at any heading (printed, they hold near psi = 0)"""
    rigid_body: bool = False
    """eqs 5-7: body rates, their kinematics and the inertia coupling"""
    reaction: bool = False
    """eq. 7: the motor's torque counts once (printed, T_m and -Ir dOmega both act)"""
    edgewise: bool = False
    """eq. 8: speed in the plane of the rotor as a norm, in the shaft's frame"""
    descent: bool = False
    """eq. 9: flow through the rotor by exact kinematics (printed, one sign is wrong)"""
    cyclic: bool = False
    """eqs 10, 13: the cyclic pitch of eq. 11 in place of (x_roll + x_pitch)/L1"""
    first_order_bar: bool = False
    """eq. 12: the flybar averaged over a turn; its state has no rate"""
    rotor_moment: bool = False
    """eqs 14-15: blade-element theory's 1/8, and damping by the body's rate"""
    tail: bool = False
    """eq. 16: inflow of the tail rotor, and with it yaw damping"""
    tied_torque: bool = False
    """eqs 18-19: K_Tm is Ir K_throttle, so that rotor and fuselage agree about the motor"""
    drag: bool = False
    """eqs 2-4: drag of the fuselage by its equivalent areas Sx, Sy, Sz"""
    dynamic_inflow: bool = False
    """momentum theory with the inertia of the air (Carpenter and Fridovich, 1953): a state vi"""
    flapping: bool = False
    """eqs 14-15: the rotor tilts first (states a1, b1); its stiffness and in-plane forces act; a
    seesaw, whose blades do not cone"""
    speed_stability: bool = False
    """the first harmonic of the lift in a speed: the rotor tilts back from where it flies to"""
    tip_loss: bool = False
    """eqs 14-15: the lift ends at B R, as in eqs 10 and 13"""
    tail_force: bool = False
    """eqs 2-3, 5: the tail rotor's thrust is a force at its place, not a moment alone"""
    tail_power: bool = False
    """eqs 7, 10: the tail rotor takes its power from the main rotor's shaft"""
    collective: bool = False
    """eqs 18-19: an input x_collective for the pitch; x_throttle is left with the motor"""
    governor: bool = False
    """eq. 10: the throttle is a governor's, which holds the speed that x_throttle asks for"""
    measured_speed: bool = False
    """in place of eq. 10: the rotor's speed is an input Omega, and no motor is modelled"""
    flybarless: bool = False
    """eqs 11-12: no flybar; all of the cyclic stick goes to the blades"""


class Attitude(NamedTuple):
    """Sines and cosines of the angles."""

    sphi: Scalar
    cphi: Scalar
    sth: Scalar
    cth: Scalar
    spsi: Scalar
    cpsi: Scalar


class Motion(NamedTuple):
    """How the body turns and meets the air; body axes are forward, right, down."""

    at: Attitude
    dx: Scalar
    """velocity relative to the air along x, y and z (up) [m/s]"""
    dy: Scalar
    dz: Scalar
    u: Scalar
    """the same in body axes [m/s]"""
    v: Scalar
    w: Scalar
    p: Scalar
    """rates of roll, pitch and yaw [rad/s]"""
    q: Scalar
    r: Scalar


class Moments(NamedTuple):
    """About the centre of gravity [N m]: roll right, nose up, nose right."""

    roll: Scalar
    pitch: Scalar
    yaw: Scalar
