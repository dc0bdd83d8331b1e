r"""The whole helicopter: eqs 2-20 as printed, with each correction that makes them physics, and
with what a helicopter has beyond them.

Frames: x forward, y right, z up; phi is positive right side down, theta nose up, psi nose right:
the ordinary yaw-pitch-roll angles of a body with axes forward, right and down. The states dphi,
dtheta and dpsi are the angles' derivatives, in every variant. The rotor turns in -psi: counter-
clockwise seen from above.

`helicopter("paper")` is the paper to the letter; `helicopter("consistent")` has its equations with
all corrections, and `helicopter()`, the variant "full", a rotor that flaps, a tail rotor with side
force and power, and a governor as well. `helicopter("paper", tail=True)` has
one of them. `Corrections` says what each is. Drag is a disturbance in the paper, so the paper
variant has none.
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
# Dynamic inflow has a variant of its own: eqs 8-10 have inflow in equilibrium, and a state more
# makes a record harder to fit. A bar and a measured rotor speed a vehicle has or has not.
_CHOICES = ("dynamic_inflow", "measured_speed", "flybarless")
_FULL = Corrections(*[True] * len(Corrections._fields))._replace(**dict.fromkeys(_CHOICES, False))
_VARIANTS = {
    "paper": Corrections(),
    "consistent": _FULL._replace(**dict.fromkeys((*_BEYOND, *_OWN_MOTOR), False)),
    "full": _FULL,
}


# Cached, since a model is static to jit: a second one of the same switches has other partials, and
# would be compiled again.
@functools.cache
def helicopter(
    variant: Literal["paper", "consistent", "full"] = "full",
    *,
    wind: bool = False,
    **switches: bool,
) -> Model:
    """The nonlinear helicopter with flybar, rotor speed and tail rotor, eqs 2-20 and beyond.

    Args:
        variant: which switches are on: none, the corrections of the paper, or all.
        wind: adds the inputs wind_x, wind_y, wind_z [m/s], the velocity of the air over the ground.
        switches: those of `Corrections` by name, on or off in place of the variant's. A governor is
            off where the rotor's speed is measured.

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
    if corrections.measured_speed:
        if switches.get("governor"):
            raise ValueError(
                "corrections: expected governor or measured_speed, got both: a rotor speed that is "
                "measured has no governor"
            )
        corrections = corrections._replace(governor=False)
    State, Inputs = _state_class(corrections), _inputs_class(corrections, wind)
    # The name says what differs from its variant: fit.json and figures know a model by it.
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
        # A flybar averaged over a turn has no rate among the states.
        bar = bar[:1] if corrections.first_order_bar else bar
        return axis._replace(flybar=bar, tilt=axis.tilt if corrections.flapping else ())

    return (with_rotor(ROLL), with_rotor(PITCH), YAW)


def _steady_flight(corrections: Corrections, Inputs: type) -> SteadyFlight:
    """Attitude, rotor, inflow, flybar and sticks, of which none is chosen in a steady flight;
    position, heading and velocity are given, and the angles do not turn.

    A rotor that has a motor of its own turns at the vehicle's speed, which is given too.
    """
    bar = () if corrections.flybarless else ("beta_roll", "beta_pitch")
    turning = bar if corrections.first_order_bar else tuple(f"d{n}" for n in bar)
    further = [*(TILT if corrections.flapping else ())]
    further += ["governor"] if corrections.governor else []
    further += ["vi"] if corrections.dynamic_inflow else []
    sticks = [n for n in naming.names(Inputs) if n.startswith("x_")]
    # A stick more, for the throttle alone, or a speed that is no state.
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
        # Nothing reads a throttle that is apart from the collective pitch.
        if corrections.collective:
            del sticks["x_throttle"]
        sticks["Omega"] = ROTOR_SPEED
    if wind:
        for axis in "xyz":
            sticks[f"wind_{axis}"] = Annotated[Scalar, "m/s", f"wind along {axis}"]
    # The class itself where nothing differs: a model's classes are static to jit, and equal fields
    # in another class would be another program.
    if tuple(sticks) == HelicopterInputs._fields:
        return HelicopterInputs
    made: Any = NamedTuple("HelicopterInputs", list(sticks.items()))  # type: ignore[misc]
    made.__reduce__ = by_value
    return made


def _state_class(corrections: Corrections) -> type:
    # A state that no equation drives would stay zero, and make A singular for trim and modes.
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
    """At rest at the origin, the rotor at the speed of the vehicle file."""
    # Zeros made of a parameter have its type and its batch axis.
    zero = 0.0 * p.Omega
    state = State(**dict.fromkeys(naming.names(State), zero))
    return naming.replace(state, Omega=p.Omega) if hasattr(state, "Omega") else state


class _WithSpeed(NamedTuple):
    """A state whose rotor speed is an input."""

    state: Record
    Omega: Scalar

    def __getattr__(self, name: str) -> Scalar:
        return getattr(self.state, name)


def _turning(corrections: Corrections, s: Record, u: Record) -> Record:
    """The state with the rotor's speed in it, wherever that comes from."""
    return _WithSpeed(s, u.Omega) if corrections.measured_speed else s


# A solver asks for the rates some twenty times: under jit they are traced once.
@functools.partial(jax.jit, static_argnums=(0, 1))
def _field(corrections: Corrections, State: type, p: Helicopter, s: Record, u: Record) -> Record:
    # In the order of what needs what: the motion gives the flow, the flow the thrust with its
    # inflow, and these the torque, the forces and the moments. The only loop among them, thrust and
    # inflow, is closed in `aero.thrust`.
    s = _turning(corrections, s, u)
    m = motion(corrections, s, u)
    # The flow is that of the body's motion alone, without the rotor's own induced velocity: this
    # comes with the thrust, which depends on it.
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
    """The moments of the main rotor, and the rotors' forces forward and to the right [N]; None
    where there are none but the thrust along the mast."""
    left = rotors.tail.T if corrections.tail_force else None
    if corrections.flapping:
        # A rotor that flaps acts on the body by its tilt alone: eqs 14-15, which let the cyclic
        # pitch turn the body at once, are replaced and not added to.
        loads = hub_loads(p, rotors.main.T, Tilt(s.a1, s.b1))
        right = loads.right if left is None else loads.right - left
        return Moments(loads.roll, loads.pitch, loads.yaw), (loads.forward, right)
    hub = rigid_hub_moments(corrections, p, s, u, m, rotors.main)
    return hub, None if left is None else (0.0 * left, -left)


def _bar(
    corrections: Corrections, p: Helicopter, s: Record, u: Record, m: Motion
) -> dict[str, Scalar]:
    """The flybar's rates, eq. 12 or the first-order bar."""
    if corrections.flybarless:
        return {}
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
    s = _turning(corrections, s, u)
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
    """Return the limits of the model's range, by name; True if one is exceeded."""
    s = _turning(corrections, s, u)
    air = flow(corrections, p, s, u, motion(corrections, s, u))
    outside = {
        # Limits are told and not enforced: a solver that steps across one goes on smoothly, and the
        # run is marked from there.
        "slow rotor": s.Omega < _SLOWEST * p.Omega,
        # The advance ratio without the division: at rest a rotor has none, and V2 needs no root.
        "fast flight": (_FASTEST * p.R * s.Omega) ** 2 < air.V2,
    }
    # Without `rigid_body` nothing is divided by cos theta.
    if corrections.rigid_body:
        outside["nose up or down"] = jnp.abs(jnp.cos(s.theta)) < _UPRIGHT
    return outside
