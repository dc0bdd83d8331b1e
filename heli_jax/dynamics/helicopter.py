r"""The whole helicopter: eqs 2-20 as printed, with physical corrections and extensions.

Frames: x forward, y right, z up; positive phi is right side down, theta nose up, psi nose right.
These are the usual yaw-pitch-roll angles of a body with axes forward, right and down. The states
dphi, dtheta and dpsi are the angles' derivatives, in every variant. The rotor turns in -psi:
anticlockwise seen from above.

`helicopter("paper")` has the paper's equations; `helicopter("consistent")` adds all corrections.
`helicopter()`, the variant "full", adds a flapping rotor, a tail rotor with side force and power,
and a governor. `helicopter("paper", tail=True)` has a single correction. `Corrections` describes
each. Drag is a disturbance in the paper, so the paper variant has none.
"""

import functools
from typing import Annotated, Any, Literal, NamedTuple

import jax
import jax.numpy as jnp

from heli_jax import naming
from heli_jax.dynamics import aerodynamics as aero
from heli_jax.dynamics import flybar
from heli_jax.dynamics.aerodynamics import mass_flow
from heli_jax.dynamics.helicopter_equations import (
    COLLECTIVE,
    GOVERNOR,
    INFLOW,
    ROTOR_SPEED,
    TILT,
    Corrections,
    HelicopterInputs,
    HelicopterOutputs,
    HelicopterState,
    Moments,
    Motion,
    accelerations,
    angular_accelerations,
    body_rates,
    flow,
    main_rotor,
    motion,
    once,
)
from heli_jax.dynamics.loads import Rotors, drive, flapping, moments, rigid_hub_moments, tail_rotor
from heli_jax.dynamics.model import PITCH, ROLL, YAW, Axis, Model, SteadyFlight
from heli_jax.dynamics.tip_path_plane import Tilt, hub_loads
from heli_jax.naming import Record, Scalar
from heli_jax.pickled import by_value
from heli_jax.vehicle import Helicopter

_BEYOND = ("flapping", "speed_stability", "tip_loss", "tail_force", "tail_power")
_OWN_MOTOR = ("collective", "governor")
# Dynamic inflow is off in all variants, since eqs 8-10 have inflow in equilibrium, and another
# state makes a fit harder. A flybar and a measured rotor speed depend on the vehicle.
_CHOICES = ("dynamic_inflow", "measured_speed", "flybarless")
_FULL = Corrections(*[True] * len(Corrections._fields))._replace(**dict.fromkeys(_CHOICES, False))
_VARIANTS = {
    "paper": Corrections(),
    "consistent": _FULL._replace(**dict.fromkeys((*_BEYOND, *_OWN_MOTOR), False)),
    "full": _FULL,
}


# Cached, since a model is static to jit. A second one with the same switches would be compiled
# again.
@functools.cache
def helicopter(
    variant: Literal["paper", "consistent", "full"] = "full",
    *,
    wind: bool = False,
    **switches: bool,
) -> Model:
    """Return the nonlinear helicopter with flybar, rotor speed and tail rotor, eqs 2-20 and
    extensions.

    Args:
        variant: active switches: none, the corrections of the paper, or all.
        wind: adds the inputs wind_x, wind_y, wind_z [m/s], the velocity of the air over the ground.
        switches: fields of `Corrections` by name, which override the variant's. With a measured
            rotor speed the governor is off.

    Raises:
        ValueError: unknown variant or switch.
    """
    if variant not in _VARIANTS:
        raise ValueError(f"variant: expected one of {', '.join(_VARIANTS)}, got {variant!r}")
    unknown = [n for n in switches if n not in Corrections._fields]
    if unknown:
        raise ValueError(
            f"corrections: expected some of {', '.join(Corrections._fields)}, got {unknown[0]!r}"
        )
    corrections = _VARIANTS[variant]._replace(**switches)
    if corrections.measured_speed:
        if switches.get("governor"):
            raise ValueError(
                "corrections: expected governor or measured_speed, got both: a measured rotor "
                "speed has no governor"
            )
        corrections = corrections._replace(governor=False)
    State, Inputs = _state_class(corrections), _inputs_class(corrections, wind)
    # The name shows differences from the variant, since fit.json and figures identify a model by
    # it.
    changed = [
        f"{'+' if on else '-'}{n}"
        for n, on in corrections._asdict().items()
        if on != getattr(_VARIANTS[variant], n)
    ]
    return Model(
        ("helicopter" if variant == "full" else f"helicopter-{variant}")
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
        steady_flight=_steady_flight(corrections, Inputs),
        body_rates=body_rates if corrections.rigid_body else None,
    )


def _axes(corrections: Corrections) -> tuple[Axis, ...]:
    """Return the axes, with the states of flybar and tip-path plane that the model has."""

    def with_rotor(axis: Axis) -> Axis:
        bar = () if corrections.flybarless else axis.flybar
        # A flybar averaged over a turn has no rate state.
        bar = bar[:1] if corrections.first_order_bar else bar
        return axis._replace(flybar=bar, tilt=axis.tilt if corrections.flapping else ())

    return (with_rotor(ROLL), with_rotor(PITCH), YAW)


def _steady_flight(corrections: Corrections, Inputs: type) -> SteadyFlight:
    """Return the unknowns of trim: attitude, rotor, inflow, flybar and sticks.

    Position, heading and velocity are given, and the angles are constant. With a separate motor,
    the rotor speed is the vehicle's and is also given.
    """
    bar = () if corrections.flybarless else ("beta_roll", "beta_pitch")
    turning = bar if corrections.first_order_bar else tuple(f"d{n}" for n in bar)
    further = [*(TILT if corrections.flapping else ())]
    further += ["governor"] if corrections.governor else []
    further += ["vi"] if corrections.dynamic_inflow else []
    sticks = [n for n in naming.names(Inputs) if n.startswith("x_")]
    # A separate throttle stick, or a speed that is no state.
    speed_given = corrections.collective or corrections.measured_speed
    speed = () if speed_given else ("Omega",)
    rotor = () if corrections.measured_speed else ("Omega",)
    return SteadyFlight(
        ("phi", "theta", *speed, *further, *bar, *sticks),
        ("dx", "dy", "dz", "dphi", "dtheta", "dpsi", *turning, *rotor, *further),
    )


def _inputs_class(corrections: Corrections, wind: bool) -> type:
    sticks = naming.fields(HelicopterInputs)
    if corrections.collective:
        throttle = sticks.pop("x_throttle")
        sticks |= {"x_collective": COLLECTIVE, "x_throttle": throttle}
    if corrections.measured_speed:
        # A throttle separate from the collective pitch is not used.
        if corrections.collective:
            del sticks["x_throttle"]
        sticks["Omega"] = ROTOR_SPEED
    if wind:
        for axis in "xyz":
            sticks[f"wind_{axis}"] = Annotated[Scalar, "m/s", f"wind along {axis}"]
    # Return the class itself if nothing differs. Classes are static to jit, so another class with
    # the same fields would be another program.
    if tuple(sticks) == HelicopterInputs._fields:
        return HelicopterInputs
    made: Any = NamedTuple("HelicopterInputs", list(sticks.items()))  # type: ignore[misc]
    made.__reduce__ = by_value
    return made


def _state_class(corrections: Corrections) -> type:
    # A state without an equation would stay zero, and make A singular for trim and modes.
    hints = naming.fields(HelicopterState)
    if corrections.first_order_bar:
        hints = {n: h for n, h in hints.items() if not n.startswith("dbeta")}
    if corrections.flybarless:
        hints = {n: h for n, h in hints.items() if "beta_" not in n}
    if corrections.measured_speed:
        del hints["Omega"]
    if corrections.flapping:
        hints |= TILT
    if corrections.governor:
        hints["governor"] = GOVERNOR
    if corrections.dynamic_inflow:
        hints["vi"] = INFLOW
    if tuple(hints) == HelicopterState._fields:
        return HelicopterState
    made: Any = NamedTuple("HelicopterState", list(hints.items()))  # type: ignore[misc]
    made.__reduce__ = by_value
    return made


def _start(State: type, p: Helicopter) -> Record:
    """Return the state at rest at the origin, with the rotor at the vehicle's speed."""
    # Zeros computed from a parameter have its type and batch axis.
    zero = 0.0 * p.Omega
    state = State(**dict.fromkeys(naming.names(State), zero))
    return naming.replace(state, Omega=p.Omega) if hasattr(state, "Omega") else state


class _WithSpeed(NamedTuple):
    """A state with the rotor speed from an input."""

    state: Record
    Omega: Scalar

    def __getattr__(self, name: str) -> Scalar:
        return getattr(self.state, name)


def _turning(corrections: Corrections, s: Record, u: Record) -> Record:
    """Return the state with the rotor speed, from state or input."""
    return _WithSpeed(s, u.Omega) if corrections.measured_speed else s


# A solver calls the rates some twenty times; under jit they are traced once.
@functools.partial(jax.jit, static_argnums=(0, 1))
def _field(corrections: Corrections, State: type, p: Helicopter, s: Record, u: Record) -> Record:
    # In order of dependence: the motion gives the flow, the flow gives thrust and inflow, and these
    # give torque, forces and moments. The only loop, between thrust and inflow, is solved in
    # `aero.thrust`.
    s = _turning(corrections, s, u)
    m = motion(corrections, s, u)
    # The flow comes from the body's motion, without the induced velocity, which depends on the
    # thrust.
    air = once(flow(corrections, p, s, u, m))
    force = main_rotor(p, s, u, air)
    tail = tail_rotor(corrections, p, u, m, s.Omega)
    rotors = Rotors(force, tail)
    shaft = drive(corrections, p, s, u, air, rotors)
    hub, aside = _hub(corrections, p, s, u, m, rotors)
    ddx, ddy, ddz = accelerations(corrections, p, m, force.T, aside)
    M = moments(corrections, p, hub, rotors, shaft)
    ddphi, ddtheta, ddpsi = angular_accelerations(corrections, p, s, m, M)
    rates = {
        "x": s.dx, "y": s.dy, "z": s.dz,
        "phi": s.dphi, "theta": s.dtheta, "psi": s.dpsi,
        "dx": ddx, "dy": ddy, "dz": ddz,
        "dphi": ddphi, "dtheta": ddtheta, "dpsi": ddpsi,
        "Omega": shaft.dOmega,
        "governor": shaft.dgovernor,
        **_bar(corrections, p, s, u, m),
    }  # fmt: skip
    if corrections.flapping:
        rates |= flapping(corrections, p, s, u, m, force)._asdict()
    if corrections.dynamic_inflow:
        rates["vi"] = aero.inflow_rate(p, force, mass_flow(force.vi, air.V2, air.W))
    return State(**{n: rates[n] for n in naming.names(State)})


def _hub(
    corrections: Corrections, p: Helicopter, s: Record, u: Record, m: Motion, rotors: Rotors
) -> tuple[Moments, tuple[Scalar, Scalar] | None]:
    """Return the main rotor's moments, and the rotors' forces forward and to the right [N].

    The forces are None if there is only the thrust along the mast.
    """
    left = rotors.tail.T if corrections.tail_force else None
    if corrections.flapping:
        # A flapping rotor acts on the body only through its tilt. It replaces eqs 14-15, in which
        # cyclic pitch turns the body at once.
        loads = hub_loads(p, rotors.main.T, Tilt(s.a1, s.b1))
        right = loads.right if left is None else loads.right - left
        return Moments(loads.roll, loads.pitch, loads.yaw), (loads.forward, right)
    hub = rigid_hub_moments(corrections, p, s, u, m, rotors.main)
    return hub, None if left is None else (0.0 * left, -left)


def _bar(
    corrections: Corrections, p: Helicopter, s: Record, u: Record, m: Motion
) -> dict[str, Scalar]:
    """Return the flybar's rates, from eq. 12 or the first-order flybar."""
    if corrections.flybarless:
        return {}
    # One flybar state for roll and one for pitch, each with the body rate about its own axis.
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
    """Return angles, body rates (as gyros measure them), position, velocity and rotor speed."""
    s = _turning(corrections, s, u)
    m = motion(corrections, s, u)
    rates, place = (m.p, m.q, m.r), (s.x, s.y, s.z, s.dx, s.dy, s.dz)
    return HelicopterOutputs(s.phi, s.theta, s.psi, *rates, *place, s.Omega)


_SLOWEST = 0.2
"""Lowest rotor speed [fraction of the vehicle's]."""
_FASTEST = 0.5
"""Largest advance ratio; beyond it, reversed flow and stall are not in eq. 13's bracket."""
_UPRIGHT = 0.1
"""Smallest cosine of the pitch angle, by which the yaw rate is divided."""


def _limits(corrections: Corrections, p: Helicopter, s: Record, u: Record) -> dict[str, Any]:
    """Return the limits of the model's range, by name; True if one is exceeded."""
    s = _turning(corrections, s, u)
    air = flow(corrections, p, s, u, motion(corrections, s, u))
    outside = {
        # Limits are reported, not enforced. A solver that crosses one continues, and the run is
        # marked from there.
        "slow rotor": s.Omega < _SLOWEST * p.Omega,
        # Advance ratio without division: it is undefined for a rotor at rest, and V2 needs no root.
        "fast flight": (_FASTEST * p.R * s.Omega) ** 2 < air.V2,
    }
    # Without `rigid_body` there is no division by cos theta.
    if corrections.rigid_body:
        outside["nose up or down"] = jnp.abs(jnp.cos(s.theta)) < _UPRIGHT
    return outside
