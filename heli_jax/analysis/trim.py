"""Trim: the state and sticks of a helicopter in steady flight.

The search starts from momentum theory in hover.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float

from heli_jax import naming
from heli_jax.dynamics.check_model import check_model
from heli_jax.dynamics.model import Model, Sampled, SteadyFlight, require_constants
from heli_jax.vehicle import of_helicopter

STICKS = {"x_throttle": (0.0, 1.0), "x_yaw": (-1.0, 1.0), "x_collective": (-1.0, 1.0)}
"""Default limits of the sticks. Cyclic sticks are lengths without limits."""

# Params, State and Inputs are the user's classes of numbers, arrays or tracers, hence `Any` below.

_TOLERANCE = 1e-10
"""Largest residual acceleration of a steady flight [m/s^2 or rad/s^2]."""
_POLISH = 3
"""Steps of Newton's method; each doubles the correct digits."""
_TRIES = 12
"""Number of starts: the first from momentum theory, the others around it."""
_ROUNDING = 1e-9
_TRIMMED = 1e-6
"""Largest residual [SI] of a steady flight in a batch, which has one start and may end slightly
above `_TOLERANCE`."""
_LOWEST = -0.3
"""Lowest collective stick of an upright vehicle."""
_UPRIGHT = 1.5
"""Largest roll and pitch of a vehicle that is not inverted [rad]."""


class Condition(NamedTuple):
    """A steady flight."""

    forward_speed: Any = 0.0
    """Speed over the ground along the heading [m/s]."""
    lateral_speed: Any = 0.0
    """Speed over the ground to the right of the heading [m/s]."""
    climb: Any = 0.0
    """Climb speed [m/s]."""
    heading: Any = 0.0
    """Heading psi [rad]."""


class Trim(NamedTuple):
    """A steady flight that the vehicle can fly."""

    state: Any
    """The model's State; x, y and z are zero."""
    inputs: Any
    """The model's Inputs."""
    residual: Any
    """Largest residual acceleration [m/s^2 or rad/s^2]."""


HOVER = Condition()


def trim(
    model: Model,
    params: Any,
    condition: Condition = HOVER,
    *,
    wind: tuple[float, float, float] = (0.0, 0.0, 0.0),
    sticks: Mapping[str, tuple[float, float]] | None = None,
    power_off: bool = False,
) -> Trim:
    """Return the trim of a helicopter model: hover, climb, forward and sideward flight.

    The unknowns are sticks, attitude, tip-path plane, flybar and rotor speed. With a collective
    stick in addition to the throttle, the rotor turns at the vehicle's Omega. Parameters must be
    concrete (`equilibrium` is differentiable).

    Args:
        wind: velocity of the air along x, y and z [m/s], for a model with wind.
        sticks: limits of the sticks by name; default: `STICKS`.
        power_off: True for autorotation: throttle zero, climb unknown; needs a collective stick.

    Raises:
        ValueError: no such flight exists, a stick would exceed its limits, or the flight is outside
            the model's range.
    """
    steady = _require(model, power_off)
    if model.sampled is not None:
        at = trim(
            model.sampled.plant, params, condition, wind=wind, sticks=sticks, power_off=power_off
        )
        return _held(model.sampled, params, at)
    if sticks is None:
        sticks = {n: ends for n, ends in STICKS.items() if n in naming.names(model.Inputs)}
    require_constants(model, params)
    best: Trim | None = None
    # Arrays of one type, so that one compiled program serves all vehicles.
    params, condition, air = jax.tree.map(
        lambda v: jnp.asarray(v, jnp.result_type(float)), (params, condition, tuple(wind))
    )
    # A fixed seed makes the trim a function of its arguments.
    rng = np.random.default_rng(0)
    offset = np.zeros(len(steady.unknowns))
    # A search may end at a local minimum near its start, so several starts are tried.
    for _ in range(_TRIES):
        result = jax.device_get(
            _equilibrium(model, params, condition, air, jnp.asarray(offset), power_off)
        )
        # The equations have other roots, such as inverted flight or downward lift.
        sound = plausible(result) and np.isfinite(result.residual)
        if sound and (best is None or result.residual < best.residual):
            best = result
        if best is not None and best.residual < _TOLERANCE:
            _check_sticks(model, params, best, condition, sticks)
            _check_range(model, params, best, condition)
            return best
        offset = rng.standard_normal(offset.size)
    left = (
        ""
        if best is None
        else (f": the best attempt leaves an acceleration of {best.residual:.3g}")
    )
    if "governor" in naming.names(model.State):
        left += "; its governor has a throttle of 0 to 1 to hold Omega, and no brake"
    raise ValueError(f"no trim of {_words(condition)} exists for this vehicle{left}")


def equilibrium(
    model: Model,
    params: Any,
    condition: Condition = HOVER,
    wind: tuple[Any, Any, Any] = (0.0, 0.0, 0.0),
) -> Trim:
    """Return the trim from one start, without the errors of `trim`: for jit, vmap and derivatives.

    Args:
        params: its constants, concrete or traced.
        wind: velocity of the air along x, y and z [m/s], for a model with wind.

    Check `residual`: if it is not small (such as 1e-10), there is no trim.
    """
    steady = _require(model)
    if model.sampled is not None:
        at = equilibrium(model.sampled.plant, params, condition, wind)
        return _held(model.sampled, params, at)
    offset = jnp.zeros(len(steady.unknowns))
    return _equilibrium(model, params, condition, wind, offset, power_off=False)


def _held(sampled: Sampled, params: Any, at: Trim) -> Trim:
    """Return a closed loop in the steady flight of its plant: its controller acts on deviations."""
    return Trim(*sampled.hold(params, at.state, at.inputs), at.residual)


@eqx.filter_jit
def _equilibrium(
    model: Model,
    params: Any,
    condition: Condition,
    wind: tuple[Any, Any, Any],
    offset: Float[Array, " k"],
    power_off: bool,
) -> Trim:
    """Solve from the guess plus half of `offset`, in scaled unknowns."""
    names, rates = _require(model, power_off)
    dtype = offset.dtype
    # Unknowns are scaled, since a rotor speed is a thousand times a flapping angle.
    guess, scale = first_guess(model, params, condition.climb, power_off)
    start = jnp.stack([jnp.asarray(guess.get(n, 0.0), dtype) for n in names])
    scales = jnp.stack([jnp.asarray(scale.get(n, 0.1), dtype) for n in names])
    ground = _along_the_ground(condition)

    def point(z: Array, parameters: Any) -> tuple[Any, Any]:
        values = dict(zip(names, z, strict=True))
        # Unknowns replace given values: the climb in autorotation, else the rotor speed.
        fixed = {
            **ground,
            "dz": values.get("climb", condition.climb),
            # Unknown only if one stick serves as collective and throttle.
            "Omega": parameters.Omega,
            "x_throttle": 0.0,
        }
        air = {f"wind_{a}": w for a, w in zip("xyz", wind, strict=True)}
        values = {**fixed, **air, **values}
        state = {n: values.get(n, 0.0) for n in naming.names(model.State)}
        inputs = {n: values[n] for n in naming.names(model.Inputs)}
        return (
            model.State(**{n: jnp.asarray(v, dtype) for n, v in state.items()}),
            model.Inputs(**{n: jnp.asarray(v, dtype) for n, v in inputs.items()}),
        )

    def fn(xi: Array, parameters: Any) -> Array:
        state, inputs = point(scales * xi, parameters)
        return naming.ravel(model.vector_field(parameters, state, inputs), only=rates)

    solution = optx.root_find(
        fn,
        optx.LevenbergMarquardt(1e-12, 1e-12),
        start / scales + 0.5 * offset,
        # Derivatives through the iterations would be those of the path, not of the root.
        args=jax.lax.stop_gradient(params),
        max_steps=200,
        throw=False,  # one failure must not stop a batch; see `residual`
    )
    # Newton's method refines the root to the last digit and gives its derivatives.
    xi = jax.lax.stop_gradient(solution.value)

    # Model and derivatives appear once, so that they are compiled once. Each step returns the
    # residual at its start, so the last step returns that of the root.
    def polish(z: Array, _: Any) -> tuple[Array, tuple[Array, Array]]:
        # `params` is not stopped here: a Newton step from a root has the root's derivative by the
        # parameters (implicit function theorem).
        slopes, left = jax.jacfwd(lambda z: (fn(z, params),) * 2, has_aux=True)(z)
        return z - jnp.linalg.solve(slopes, left), (z, left)

    _, (roots, left) = jax.lax.scan(polish, xi, None, length=_POLISH + 1)
    state, inputs = point(scales * roots[-1], params)
    return Trim(state, inputs, jnp.max(jnp.abs(left[-1])))


def _along_the_ground(condition: Condition) -> dict[str, Any]:
    """Return the heading and the velocities along the ground axes."""
    # A condition's speeds are along the heading.
    cpsi, spsi = jnp.cos(jnp.asarray(condition.heading)), jnp.sin(jnp.asarray(condition.heading))
    return {
        "psi": condition.heading,
        "dx": condition.forward_speed * cpsi - condition.lateral_speed * spsi,
        "dy": condition.forward_speed * spsi + condition.lateral_speed * cpsi,
    }


def steady_flight(model: Model) -> SteadyFlight | None:
    """Return the unknowns of trim; None if the model cannot be trimmed.

    They are those stated by the model, or found by names if these match the helicopter models here.
    """
    if model.steady_flight is not None:
        return model.steady_flight
    states, inputs = naming.names(model.State), naming.names(model.Inputs)
    if not {"phi", "theta", "psi", "dx", "dy", "dz", "Omega"} <= {*states, *inputs}:
        return None
    solved_for = ["phi", "theta", "vi", "a1", "b1", "governor"]
    solved_for += [] if "x_collective" in inputs else ["Omega"]
    unknowns = [n for n in states if n in solved_for]
    unknowns += [n for n in states if n.startswith("beta")]
    # Wind and a measured rotor speed are given, not solved for.
    unknowns += [n for n in inputs if not n.startswith("wind") and n != "Omega"]
    # If a state's derivative is another state, its equation is not set to zero.
    no_equation = {"x", "y", "z", "phi", "theta", "psi"}
    equations = [n for n in states if n not in no_equation and f"d{n}" not in states]
    # A different model may use the same names. Newton's method needs as many equations as unknowns.
    if len(unknowns) != len(equations):
        return None
    return SteadyFlight(tuple(unknowns), tuple(equations))


def is_full_nonlinear(model: Model) -> bool:
    """True if a model is the full nonlinear model of a helicopter, which can be trimmed."""
    return of_helicopter(model.Params) and steady_flight(model) is not None


def _require(model: Model, power_off: bool = False) -> SteadyFlight:
    """Return the unknowns of trim, or refuse the model.

    Raises:
        ValueError: the model is not the full nonlinear model of a helicopter, or lacks the
            collective stick that autorotation needs.
    """
    check_model(model)
    steady = steady_flight(model)
    if steady is None or not of_helicopter(model.Params):
        raise ValueError(
            "trim: expected the full nonlinear model, as models.helicopter(...) gives it, got "
            f"{model.name}"
        )
    if not power_off:
        return steady
    if "x_throttle" not in steady.unknowns or "x_collective" not in steady.unknowns:
        raise ValueError(
            "trim: power_off: expected a model with x_collective and x_throttle, as "
            f"models.helicopter() gives it, got {model.name}"
        )
    return steady._replace(
        unknowns=tuple("climb" if n == "x_throttle" else n for n in steady.unknowns)
    )


def plausible(result: Trim) -> Bool[Array, "..."] | np.bool_ | bool:
    """True if the rotor turns, the lift is upward, and the helicopter is not inverted."""
    state, inputs = result.state, result.inputs
    # abs and & replace `and`, so that the test serves numbers and batches of tracers.
    level = (abs(state.phi) < _UPRIGHT) & (abs(state.theta) < _UPRIGHT)
    Omega = state.Omega if hasattr(state, "Omega") else inputs.Omega
    if hasattr(inputs, "x_collective"):
        # In autorotation the collective pitch may be negative.
        return level & (Omega > 0) & (inputs.x_collective > _LOWEST)
    return level & (Omega > 0) & (inputs.x_throttle > 0)


def is_trimmed(trim: Trim) -> jax.Array:
    """True if it is a steady flight within the sticks' travel."""
    # `trim` raises without a solution; in a batch the element can only be flagged.
    sound = plausible(trim) & (trim.residual < _TRIMMED)
    for name, (low, high) in STICKS.items():
        if not hasattr(trim.inputs, name):
            continue
        stick = getattr(trim.inputs, name)
        # A governor's stick is at its end, which rounding may exceed.
        sound = sound & (stick >= low - _TRIMMED) & (stick <= high + _TRIMMED)
    return sound


def _check_sticks(
    model: Model,
    params: Any,
    result: Trim,
    condition: Condition,
    sticks: Mapping[str, tuple[float, float]],
) -> None:
    for name, (low, high) in sticks.items():
        if name not in naming.names(model.Inputs):
            raise ValueError(
                f"trim: model {model.name} has no stick {name!r}: expected one of "
                f"{', '.join(naming.names(model.Inputs))}"
            )
        value = float(getattr(result.inputs, name))
        # The governor's stick is at its limit, which rounding may exceed.
        if low - _ROUNDING <= value <= high + _ROUNDING:
            continue
        why = _why_heavy(model, params, result, name) if value > high else ""
        raise ValueError(
            f"no trim of {_words(condition)}: expected {name} within {low:g} to {high:g}, got "
            f"{value:.3g}{why}"
        )


def _why_heavy(model: Model, params: Any, result: Trim, stick: str) -> str:
    """Return the reason why the stick that carries the weight exceeds its limit; empty for other
    sticks.
    """
    if stick not in ("x_throttle", "x_collective"):
        return ""
    weight = float(params.m * params.g)
    if "x_collective" in naming.names(model.Inputs):
        gain = "K_throttle" if stick == "x_throttle" else "K_theta0, Omega"
        return f"; its weight of {weight:.3g} N is too much for motor or rotor ({gain})"
    return (
        f"; to carry its weight of {weight:.3g} N the rotor would have to turn at "
        f"{float(result.state.Omega):.4g} rad/s: the vehicle is too heavy, or the rotor too slow "
        "(K_throttle, K_theta0)"
    )


def _check_range(model: Model, params: Any, result: Trim, condition: Condition) -> None:
    if model.limits is None:
        return
    # A root outside the range of the equations is not physical, such as reversed flow over half the
    # rotor.
    limits = model.limits(params, result.state, result.inputs)
    outside = [name for name, out in limits.items() if bool(out)]
    if outside:
        raise ValueError(
            f"no trim of {_words(condition)} within the model's range: {', '.join(outside)}"
        )


def _words(condition: Condition) -> str:
    named = (
        ("forward", condition.forward_speed),
        ("to the right", condition.lateral_speed),
        ("climb", condition.climb),
    )
    speeds = {f"{float(v):g} m/s {n}" for n, v in named if float(v) != 0.0}
    return " and ".join(sorted(speeds)) or "hover"


# The constants are a user's class of numbers, arrays or tracers, hence `Any` below.


def first_guess(
    model: Model, p: Any, climb: Any, power_off: bool
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return initial guess and scale of the unknowns: the rotor at nominal speed carries the
    weight.

    Args:
        climb: climb speed [m/s].
    """
    # Momentum theory in hover, then collective pitch from blade-element theory.
    area = jnp.pi * p.R**2
    vi = jnp.sqrt(p.m * p.g / (2.0 * p.rho * area))
    tip = p.R * p.Omega
    sigma = 2.0 * p.c / (jnp.pi * p.R)
    loading = 2.0 * p.m * p.g / (p.rho * area * tip**2 * p.a * sigma)
    # In autorotation almost no air flows through the rotor.
    inflow = 0.0 * tip if power_off else (vi + climb) / tip
    theta0 = 3.0 / p.B**3 * (loading + 0.5 * p.B**2 * inflow)
    stick = theta0 / p.K_theta0
    guess = {
        "Omega": p.Omega, "vi": vi, "climb": -1.7 * vi,
        "x_collective": stick, "x_throttle": stick, "x_yaw": -0.5 * stick,
    }  # fmt: skip
    sizes = {
        "Omega": p.Omega, "vi": vi, "climb": vi, "governor": 0.5,
        "x_collective": stick, "x_throttle": stick, "x_yaw": stick,
        "x_roll": 0.1 * p.L1, "x_pitch": 0.1 * p.L1,
    }  # fmt: skip
    if "x_collective" in naming.names(model.Inputs):
        # Throttle for induced power plus half as much other power; the governor's stick commands
        # full speed.
        power = 1.5 * p.m * p.g * vi / (p.Ir * p.K_throttle * p.Omega)
        governed = "governor" in naming.names(model.State)
        guess |= {"x_throttle": 1.0 if governed else power, "governor": power}
        guess["governor"] = 0.0 if power_off else power
        sizes |= {"x_throttle": 0.5}
    return guess, sizes
