r"""The whole helicopter: eqs 2-20 as printed, and with each correction that makes them physics.

Frames: x forward, y right, z up; phi is positive right side down, theta nose up, psi nose right:
the ordinary yaw-pitch-roll angles of a body with axes forward, right and down. The states dphi,
dtheta and dpsi are the angles' derivatives, in every variant. The rotor turns in -psi: counter-
clockwise seen from above.

`helicopter("paper")` is the paper to the letter; `helicopter("consistent")` has all corrections,
and `helicopter("paper", tail=True)` one of them. `Corrections` says what each is. Drag is a
disturbance in the paper, so the paper variant has none.
"""

import functools
from typing import Annotated, Any, Literal, NamedTuple

import jax
import jax.numpy as jnp

from heli_jax import naming
from heli_jax.dynamics import aerodynamics as aero
from heli_jax.dynamics import flybar
from heli_jax.dynamics.helicopter_equations import (
    accelerations,
    angular_accelerations,
    flow,
    main_rotor,
    moments,
    motion,
    once,
    rotor_acceleration,
)
from heli_jax.dynamics.helicopter_records import (
    Corrections,
    HelicopterInputs,
    HelicopterOutputs,
    HelicopterState,
    Motion,
)
from heli_jax.dynamics.inflow import vortex_ring
from heli_jax.dynamics.model import PITCH, ROLL, YAW, Axis, Model, SteadyFlight
from heli_jax.naming import Record, Scalar
from heli_jax.vehicle import Helicopter

# Dynamic inflow is an extension, not a correction: eqs 8-10 have inflow in equilibrium, and a state
# more makes a record harder to fit.
_ALL = Corrections(*[True] * len(Corrections._fields))._replace(dynamic_inflow=False)
_VARIANTS = {"paper": Corrections(), "consistent": _ALL}


# Cached, since a model is static to jit: a second one of the same switches has other partials, and
# would be compiled again.
@functools.cache
def helicopter(
    variant: Literal["paper", "consistent"] = "consistent", *, wind: bool = False, **switches: bool
) -> Model:
    """The nonlinear helicopter with flybar, rotor speed and tail rotor, eqs 2-20.

    `switches` are those of `Corrections`. `wind` adds the inputs wind_x, wind_y, wind_z [m/s],
    the velocity of the air over the ground.

    Raises:
        ValueError: no such variant or switch.
    """
    if variant not in _VARIANTS:
        raise ValueError(f"variant: expected one of {', '.join(_VARIANTS)}, got {variant!r}")
    unknown = [n for n in switches if n not in Corrections._fields]
    if unknown:
        raise ValueError(
            f"corrections: expected some of {', '.join(Corrections._fields)}, got {unknown[0]!r}"
        )
    corrections = _VARIANTS[variant]._replace(**switches)
    State = _state_class(corrections)
    Inputs = HelicopterInputs
    if wind:
        air = {
            f"wind_{axis}": (Annotated[Scalar, "m/s", f"wind along {axis}"], None) for axis in "xyz"
        }
        Inputs = naming.extended(HelicopterInputs, "HelicopterWindInputs", air)
    # The name says what differs from its variant: fit.json and figures know a model by it.
    changed = [
        f"{'+' if on else '-'}{n}"
        for n, on in corrections._asdict().items()
        if on != getattr(_VARIANTS[variant], n)
    ]
    return Model(
        ("helicopter" if variant == "consistent" else "helicopter-paper")
        + "".join(changed)
        + ("+wind" if wind else ""),
        functools.partial(_field, corrections, State),
        functools.partial(_output, corrections),
        Helicopter,
        State,
        Inputs,
        HelicopterOutputs,
        start=functools.partial(_start, State),
        limits=functools.partial(_limits, corrections),
        axes=_axes(corrections),
        steady_flight=_steady_flight(corrections),
    )


def _axes(corrections: Corrections) -> tuple[Axis, ...]:
    """A flybar averaged over a turn has no rate among the states."""
    if not corrections.first_order_bar:
        return (ROLL, PITCH, YAW)
    return (ROLL._replace(flybar=("beta_roll",)), PITCH._replace(flybar=("beta_pitch",)), YAW)


def _steady_flight(corrections: Corrections) -> SteadyFlight:
    """Attitude, rotor speed, inflow, flybar and sticks, of which none is chosen in a steady flight;
    position, heading and velocity are given, and the angles do not turn."""
    inflow = ("vi",) if corrections.dynamic_inflow else ()
    bar = ("beta_roll", "beta_pitch")
    turning = bar if corrections.first_order_bar else ("dbeta_roll", "dbeta_pitch")
    return SteadyFlight(
        ("phi", "theta", "Omega", *inflow, *bar, *HelicopterInputs._fields),
        ("dx", "dy", "dz", "dphi", "dtheta", "dpsi", *turning, "Omega", *inflow),
    )


def _state_class(corrections: Corrections) -> type:
    # A state that no equation drives would stay zero, and make A singular for trim and modes.
    hints = naming.fields(HelicopterState)
    if corrections.first_order_bar:
        hints = {n: h for n, h in hints.items() if not n.startswith("dbeta")}
    if corrections.dynamic_inflow:
        hints["vi"] = Annotated[Scalar, "m/s", "induced velocity of the main rotor"]
    if tuple(hints) == HelicopterState._fields:
        return HelicopterState
    return NamedTuple("HelicopterState", list(hints.items()))  # type: ignore[misc]


def _start(State: type, p: Helicopter) -> Record:
    """At rest at the origin, the rotor at the speed of the vehicle file."""
    # Zeros made of a parameter have its type and its batch axis.
    zero = 0.0 * p.Omega
    return State(**{**dict.fromkeys(naming.names(State), zero), "Omega": p.Omega})


# A solver asks for the rates some twenty times: under jit they are traced once.
@functools.partial(jax.jit, static_argnums=(0, 1))
def _field(corrections: Corrections, State: type, p: Helicopter, s: Record, u: Record) -> Record:
    # In the order of what needs what: the motion gives the flow, the flow the thrust with its
    # inflow, and these the torque, the forces and the moments. The only loop among them, thrust and
    # inflow, is closed in `aero.thrust`.
    m = motion(corrections, s, u)
    air = once(flow(corrections, p, s, u, m))
    force = main_rotor(p, s, u, air)
    dOmega = rotor_acceleration(p, s, u, air, force)
    ddx, ddy, ddz = accelerations(corrections, p, m, force.T)
    M = moments(corrections, p, s, u, m, force.T, dOmega)
    ddphi, ddtheta, ddpsi = angular_accelerations(corrections, p, s, m, M)
    rates = {
        "x": s.dx, "y": s.dy, "z": s.dz,
        "phi": s.dphi, "theta": s.dtheta, "psi": s.dpsi,
        "dx": ddx, "dy": ddy, "dz": ddz,
        "dphi": ddphi, "dtheta": ddtheta, "dpsi": ddpsi,
        "Omega": dOmega,
        **_bar(corrections, p, s, u, m),
    }  # fmt: skip
    if corrections.dynamic_inflow:
        rates["vi"] = aero.inflow_rate(p, force, air.V2)
    return State(**rates)


def _bar(
    corrections: Corrections, p: Helicopter, s: Record, u: Record, m: Motion
) -> dict[str, Scalar]:
    """The flybar's rates, eq. 12 or the first-order bar."""
    # One bar for roll and one for pitch, each with the body's rate about its own axis.
    if corrections.first_order_bar:
        return {
            "beta_roll": flybar.flybar_rate(p, s.Omega, u.x_roll, s.beta_roll, m.p),
            "beta_pitch": flybar.flybar_rate(p, s.Omega, u.x_pitch, s.beta_pitch, m.q),
        }
    roll = (u.x_roll, s.beta_roll, s.dbeta_roll, m.p)
    pitch = (u.x_pitch, s.beta_pitch, s.dbeta_pitch, m.q)
    return {
        "beta_roll": s.dbeta_roll,
        "dbeta_roll": flybar.flapping_acceleration(p, s.Omega, *roll),
        "beta_pitch": s.dbeta_pitch,
        "dbeta_pitch": flybar.flapping_acceleration(p, s.Omega, *pitch),
    }


def _output(corrections: Corrections, p: Helicopter, s: Record, u: Record) -> HelicopterOutputs:
    """Angles, body rates (as gyros measure them), position and velocity, rotor speed."""
    m = motion(corrections, s, u)
    rates, place = (m.p, m.q, m.r), (s.x, s.y, s.z, s.dx, s.dy, s.dz)
    return HelicopterOutputs(s.phi, s.theta, s.psi, *rates, *place, s.Omega)


_SLOWEST = 0.2
"""of the vehicle's rotor speed"""
_FASTEST = 0.5
"""advance ratio: above, reversed flow and stall, of which eq. 13's bracket knows nothing"""
_UPRIGHT = 0.1
"""cosine of the pitch angle: the yaw rate is divided by it"""


def _limits(corrections: Corrections, p: Helicopter, s: Record, u: Record) -> dict[str, Any]:
    """Where the model's range ends, by name; True where it has been left."""
    air = flow(corrections, p, s, u, motion(corrections, s, u))
    force = main_rotor(p, s, u, air)
    outside = {
        "vortex ring": vortex_ring(air.V2, air.W, force.T0, force.vi),
        "slow rotor": s.Omega < _SLOWEST * p.Omega,
        "fast flight": (_FASTEST * p.R * s.Omega) ** 2 < air.V2,
    }
    # Without `rigid_body` nothing is divided by cos theta.
    if corrections.rigid_body:
        outside["nose up or down"] = jnp.abs(jnp.cos(s.theta)) < _UPRIGHT
    return outside
