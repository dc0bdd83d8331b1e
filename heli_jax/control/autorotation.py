r"""Landing of a helicopter without its engine: open-loop optimum, and feedback on energy.

A helicopter without power has three stores of energy: height, speed and rotor. In the glide the
height drives the rotor; in the flare speed and rotor stop the descent. Everything here flies the
full nonlinear model with throttle zero. Roll and yaw are held by feedback, so that the landing is
a problem of two sticks: collective and longitudinal cyclic.

`land` finds the sticks that touch down gently, by direct multiple shooting. `energy_law` is a
feedback with the gains `Gains`, and `tune` improves them over a set of engine failures.
"""

import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from heli_jax import naming
from heli_jax.analysis.trim import Condition, Trim, equilibrium
from heli_jax.dynamics import aerodynamics as aero
from heli_jax.dynamics.model import Model
from heli_jax.naming import Record, Scalar
from heli_jax.simulation.events import ground
from heli_jax.simulation.simulate import simulate
from heli_jax.simulation.trajectory import Trajectory

# Params, State and Inputs are the classes of the full helicopter, hence `Any` and `Record` below.

type Wind = tuple[Any, Any, Any]
CALM: Wind = (0.0, 0.0, 0.0)
DT = 0.02
"""Sample time of the feedback [s]."""
_CYCLIC_GAINS, _YAW_GAINS = (0.015, 0.0015), (1.0, 0.4)
"""Sticks per angle [m/rad, 1/rad] and rate [m s/rad, s/rad]."""
_LAG = 0.3
"""Time in which the attitude follows [s]."""
_LATERAL = 0.12
"""Bank angle per lateral speed [rad s/m]."""
_TAIL = 0.1
"""Height of the tail above the ground if the vehicle stands on it [m]."""


class Limits(NamedTuple):
    """Limits of a flight and of its touchdown."""

    vertical: float = 0.5
    """Speeds at touchdown [m/s]."""
    horizontal: float = 1.0
    rotor: tuple[float, float] = (0.7, 1.15)
    """Rotor speed over the vehicle's."""
    lift: float = 1.0
    """Mean lift coefficient of the blades, 6 C_T / sigma, since the model has no stall."""
    pitch: float = 0.6
    """Pitch angle [rad]."""
    collective: tuple[float, float] = (-0.15, 0.9)
    collective_rate: float = 2.0
    """Largest rate [1/s]."""
    cyclic: float = 0.006
    """Largest stick [m]."""
    cyclic_rate: float = 0.05
    """Largest rate [m/s]."""


def engine_failure(
    model: Model,
    params: Any,
    height: Scalar,
    speed: Scalar,
    wind: Wind = CALM,
    reaction: float = 0.0,
) -> Trim:
    """Return state and sticks at which a landing begins: after a failure in trimmed level flight.

    Args:
        height: height of the failure [m].
        speed: forward speed over the ground [m/s].
        wind: velocity of the air [m/s], for a model with wind.
        reaction: time with the collective of the powered flight after the failure [s].

    Check `residual`: if it is not small (such as 1e-8), there is no such powered flight.
    """
    flight = equilibrium(model, params, Condition(forward_speed=speed), wind)
    before = flight.state
    state = naming.replace(before, z=before.z + height)
    if reaction > 0:

        def held(s: Record, u: Record) -> Record:
            return naming.replace(u, **attitude_sticks(s, before.phi, before.theta, math.inf))

        n = max(2, round(reaction / DT) + 1)
        off = naming.replace(flight.inputs, x_throttle=0.0 * flight.inputs.x_throttle)
        given = jax.tree.map(lambda v: jnp.full(n, v), off)
        dt = reaction / (n - 1)
        run = simulate(model, params, given, dt=dt, initial_state=state, feedback=held)
        state = jax.tree.map(lambda v: v[-1], run.states)
    return flight._replace(state=state)


def attitude_sticks(s: Record, phi: Scalar, theta: Scalar, most: float) -> dict[str, Any]:
    """Return the sticks that turn the vehicle to roll phi and pitch theta [rad], with heading zero.

    The largest cyclic stick is `most` [m].
    """
    k, r = _CYCLIC_GAINS
    return {
        "x_roll": jnp.clip(k * (phi - s.phi) - r * s.dphi, -most, most),
        "x_pitch": jnp.clip(k * (theta - s.theta) - r * s.dtheta, -most, most),
        "x_yaw": jnp.clip(-_YAW_GAINS[0] * s.psi - _YAW_GAINS[1] * s.dpsi, -1.0, 1.0),
    }


def along_heading(s: Record) -> tuple[Scalar, Scalar]:
    """Return the speeds over the ground forward and to the right [m/s]."""
    c, sn = jnp.cos(s.psi), jnp.sin(s.psi)
    return s.dx * c + s.dy * sn, s.dy * c - s.dx * sn


def _most_tilt(s: Record) -> Scalar:
    """Return the largest roll and pitch angle [rad], smaller near the ground."""
    # The height is that after the lag of the attitude.
    return jnp.minimum(0.5, _TAIL + jnp.maximum(s.z + _LAG * s.dz, 0.0))


def _bank(s: Record) -> Scalar:
    """Return the bank angle that stops a drift [rad]."""
    most = _most_tilt(s)
    return jnp.clip(-_LATERAL * along_heading(s)[1], -most, most)


def _most_thrust(p: Any, Omega: Scalar, limits: Limits) -> Scalar:
    """Return the thrust at the limit of the lift coefficient [N]."""
    scale = p.rho * math.pi * p.R**4 * Omega**2 * aero.solidity(p.R, p.c)
    return limits.lift / 6.0 * scale


# The feedback on energy.


class Gains(NamedTuple):
    """Gains of the feedback on energy, all above zero; the defaults are tuned for the X-Cell 60."""

    speed: Any = 4.67
    """Forward speed over the ground in the glide [m/s]."""
    sink: Any = 11.2
    """Sink rate in the glide [m/s]."""
    deceleration: Any = 22.1
    """Vertical deceleration in the flare [m/s^2]."""
    settling: Any = 0.224
    """Time constant of the last descent [s]."""
    slowing: Any = 0.409
    """Forward speed over the sink rate in the flare [1]."""
    k_speed: Any = 0.685
    """Pitch angle per error of the speed [rad s/m]."""
    k_sink: Any = 7.9
    """Vertical acceleration per error of the sink rate in the flare [1/s]."""
    k_glide: Any = 0.902
    """The same in the glide [1/s]."""
    k_rotor: Any = 6.7
    """Vertical acceleration per relative lack of rotor energy [m/s^2]."""
    k_energy: Any = 0.64
    """Relative reduction of the deceleration per relative lack of energy [1]."""


_SINK = 0.3
"""Sink rate at touchdown [m/s]."""


def energy_law(p: Any, gains: Gains, limits: Limits) -> Callable[[Record, Record], Record]:
    r"""Return the feedback of `simulate` that lands without power.

    With the rotor's energy above that of its lowest speed, $E_r$, relative to that of full speed,
    $E_0$, and the kinetic energy $E_k$, the flare begins where the sink rate reaches
    $w^2 = w_0^2 + 2 a (1 - k_E (1 - (E_r + E_k)/E_0)) z$.
    """

    def feedback(s: Record, u: Record) -> Record:
        forward, _ = along_heading(s)
        full = 0.5 * p.Ir * p.Omega**2 * (1.0 - limits.rotor[0] ** 2)
        rotor = 0.5 * p.Ir * (s.Omega**2 - (limits.rotor[0] * p.Omega) ** 2) / full
        kinetic = 0.5 * p.m * (s.dx**2 + s.dy**2) / full
        lack = jnp.clip(1.0 - rotor - kinetic, 0.0, 1.0)
        a = gains.deceleration * (1.0 - gains.k_energy * lack)
        # The sink rate falls with the deceleration a, and exponentially near the ground.
        root = jnp.sqrt((a * gains.settling) ** 2 + 2.0 * a * jnp.maximum(s.z, 0.0))
        sink = root - a * gains.settling
        slower = a * (sink + _SINK) / root
        # Forward speed and sink rate reach zero together.
        ahead = gains.slowing * sink
        tilt = jnp.where(ahead < gains.speed, gains.slowing * slower / p.g, 0.0)
        tilt = tilt + gains.k_speed * (forward - jnp.minimum(gains.speed, ahead))
        most = _most_tilt(s)
        theta, phi = jnp.clip(tilt, -most, most), _bank(s)
        glide = gains.k_rotor * (rotor - 1.0) + gains.k_glide * (-s.dz - gains.sink)
        flare = slower + gains.k_sink * (-s.dz - sink - _SINK)
        up = jnp.maximum(jnp.maximum(glide, flare), -0.8 * p.g)
        T = p.m * (p.g + up) / (jnp.cos(theta) * jnp.cos(phi))
        T = jnp.minimum(T, _most_thrust(p, s.Omega, limits))
        x = jnp.clip(_collective(p, s, T), *limits.collective)
        sticks = attitude_sticks(s, phi, theta, limits.cyclic)
        return naming.replace(u, x_collective=x, x_throttle=0.0 * x, **sticks)

    return feedback


def _collective(p: Any, s: Record, T: Scalar) -> Scalar:
    """Return the collective stick for the thrust T [N] in calm air: `aero.thrust` inverted."""
    sth, cth = jnp.sin(s.theta), jnp.cos(s.theta)
    forward, lateral = along_heading(s)
    W = s.dz * cth - forward * sth
    V2 = (forward * cth + s.dz * sth) ** 2 + lateral**2
    T0 = T / (p.rho * math.pi * p.R**2)
    inflow = W + aero.induced_velocity(V2, W, T0, 0.0 * T0)
    half = 0.5 * p.a * aero.solidity(p.R, p.c)
    lifting = T0 + half * 0.5 * p.B**2 * p.R * s.Omega * inflow
    return lifting / (half * p.B**3 / 3.0 * p.R**2 * s.Omega**2 * p.K_theta0)


def _calm(model: Model, wind: Wind) -> Record:
    """Return the model's Inputs without sticks."""
    air: dict[str, Any] = {f"wind_{a}": w for a, w in zip("xyz", wind, strict=True)}
    return model.Inputs(**{n: air.get(n, 0.0) for n in naming.names(model.Inputs)})


def calm(model: Model, duration: float, wind: Wind = CALM) -> Record:
    """Return the inputs (N,) of a flight with `energy_law` in steady wind [m/s]."""
    zero = jnp.zeros(round(duration / DT) + 1)
    return jax.tree.map(lambda w: zero + w, _calm(model, wind))


@functools.partial(jax.jit, static_argnums=(0, 5))
def fly(
    model: Model, params: Any, gains: Gains, state: Record, inputs: Record,
    limits: Limits = Limits(),
) -> Trajectory:  # fmt: skip
    """Return the flight with `energy_law` to the ground.

    Args:
        inputs: the model's Inputs (N,) at `DT`, of which only wind acts: `calm`.
    """
    return simulate(
        model, params, inputs, dt=DT, substeps=2, initial_state=state,
        feedback=energy_law(params, gains, limits), events={"ground": ground()},
    )  # fmt: skip


class Touchdown(NamedTuple):
    """End of a flight: speeds [m/s], angles [rad], and extremes of the relative rotor speed."""

    up: Scalar
    forward: Scalar
    right: Scalar
    roll: Scalar
    pitch: Scalar
    slowest: Scalar
    fastest: Scalar
    height: Scalar
    """Zero on the ground [m]."""

    def good(self, limits: Limits = Limits()) -> Bool[Array, "..."]:
        """True if the vehicle is on the ground, with all within limits and a tilt below 0.2 rad."""
        speeds = (abs(self.up) < limits.vertical) & (
            jnp.hypot(self.forward, self.right) < limits.horizontal
        )
        level = (jnp.hypot(self.roll, self.pitch) < 0.2) & (abs(self.height) < 1e-3)
        low, high = limits.rotor
        return speeds & level & (self.slowest > low) & (self.fastest < high)

    def misses(self, limits: Limits) -> Float[Array, " 7"]:
        """Return errors for `tune`: 1 is half of a limit. The rotor has a margin."""
        speeds = self.up / limits.vertical, *(v / limits.horizontal for v in self[1:3])
        slow = jnp.maximum(limits.rotor[0] + 0.03 - self.slowest, 0.0) / 0.03
        fast = jnp.maximum(self.fastest - limits.rotor[1] + 0.02, 0.0) / 0.02
        errors = 2.0 * jnp.stack([*speeds, self.pitch / 0.2, slow, fast, self.height / 0.4])
        # A lost flight must not outweigh many that nearly land (Geman and McClure's estimator).
        return errors / jnp.sqrt(1.0 + (errors / 4.0) ** 2)


def touchdown(params: Any, run: Trajectory) -> Touchdown:
    """Return the end of a flight with `fly`."""
    end = jax.tree.map(lambda v: v[-1], run.states)
    ratio = run.states.Omega / params.Omega
    extremes = jnp.min(ratio), jnp.max(ratio)
    return Touchdown(end.dz, *along_heading(end), end.phi, end.theta, *extremes, end.z)


def tune(
    model: Model, params: Any, gains: Gains, states: Record, inputs: Record,
    limits: Limits = Limits(), max_steps: int = 20,
) -> Gains:  # fmt: skip
    """Return gains with a smaller sum of squares of `misses`, by SciPy's `least_squares`.

    Args:
        states: states (k,) of the entries.
        inputs: inputs (k, N) at `DT` with the wind of each.
    """
    import scipy.optimize  # flights need not wait for it

    start = np.array([float(g) for g in gains])

    @jax.jit
    def residuals(z: Array) -> Array:
        changed = Gains(*(start * jnp.exp(z)))

        def one(state: Record, u: Record) -> Array:
            run = fly(model, params, changed, state, u, limits)
            return touchdown(params, run).misses(limits)

        return jax.vmap(one)(states, inputs).ravel()

    jacobian = jax.jit(jax.jacfwd(residuals))
    slopes: Any = lambda z: np.asarray(jacobian(z))  # noqa: E731 (SciPy's stubs know no function)
    result = scipy.optimize.least_squares(
        lambda z: np.asarray(residuals(z)), np.zeros(start.size), slopes, max_nfev=max_steps,
        ftol=1e-3,
    )  # fmt: skip
    return Gains(*(start * np.exp(result.x)).tolist())


# The open-loop optimum.


class Grid(NamedTuple):
    """Segments with their own initial state, their intervals with linear sticks, samples of
    these.
    """

    segments: int = 4
    intervals: int = 12
    samples: int = 5


class Landing(NamedTuple):
    """The result of `land`."""

    trajectory: Trajectory
    """The flight with the optimal sticks in one run, without shooting."""
    cost: float
    margins: dict[str, float]
    """Smallest scaled distance to each limit of the motion in that run; negative: exceeded."""
    violation: float
    """Largest violation of a scaled constraint at the optimum."""
    converged: bool
    """True if the optimiser met its tolerance and the constraints hold."""
    message: str
    """The optimiser's message."""
    steps: int


_SCALES = {
    "x": 10.0, "z": 10.0, "dx": 5.0, "dz": 5.0, "Omega": 100.0, "phi": 0.1, "theta": 0.3,
    "beta_roll": 0.1, "beta_pitch": 0.1, "a1": 0.05, "b1": 0.05,
}  # fmt: skip
_CYCLIC = 0.005
"""Scales of the states, and of the cyclic stick [m]."""
_ANGLE, _RATE = 0.1, 0.3
"""Angle [rad] and rate [rad/s] at touchdown that cost as much as the speeds of `Limits`."""
_EFFORT = 0.1
"""Cost of a second with a stick at its largest rate. It makes the optimum unique."""
_FEASIBLE = 1e-4
"""Largest scaled violation of a constraint."""


class LandingProblem:
    """The nonlinear programme of a landing by direct multiple shooting.

    The unknowns z are the duration [s], the scaled state at the start of each segment, and both
    sticks at the ends of the intervals. The first state and the first sticks are given.
    """

    def __init__(
        self, model: Model, params: Any, entry: Trim, limits: Limits, wind: Wind, grid: Grid
    ) -> None:
        self.model, self.params, self.limits, self.grid = model, params, limits, grid
        self.wind, self.names = wind, naming.names(model.State)
        n, S, K = len(self.names), grid.segments, grid.intervals
        self.scale, q = np.array([_SCALES.get(name, 1.0) for name in self.names]), S * K + 1
        self.sticks, size = 1 + S * n, 1 + S * n + 2 * q
        # Places in z of what each segment depends on: duration, state, sticks.
        starts = 1 + np.arange(S * n).reshape(S, n)
        nodes = self.sticks + K * np.arange(S)[:, None] + np.arange(K + 1)
        self.index = np.hstack([np.zeros((S, 1), int), starts, nodes, q + nodes])
        self.low, self.high = np.full(size, -np.inf), np.full(size, np.inf)
        self.low[0], self.high[0] = 0.3, 100.0
        first, second = slice(self.sticks, self.sticks + q), slice(self.sticks + q, size)
        self.low[first], self.high[first] = limits.collective
        self.low[second], self.high[second] = np.array([-1.0, 1.0]) * limits.cyclic / _CYCLIC
        u = entry.inputs
        sticks = np.array([u.x_collective, u.x_pitch / _CYCLIC])
        given = np.concatenate([naming.ravel(entry.state) / self.scale, sticks])
        fixed = [*range(1, 1 + n), self.sticks, self.sticks + q]
        self.low[fixed] = self.high[fixed] = np.clip(given, self.low[fixed], self.high[fixed])
        self.free = self.low < self.high
        self._last: tuple[bytes, Any] = (b"", None)

    def sampled(self, run: Trajectory) -> Float[np.ndarray, " k"]:
        """Return the unknowns of a flight, as an initial guess."""
        t, S = np.asarray(run.times), self.grid.segments
        end = float(np.minimum(run.ended, t[-1]))
        starts = end * np.arange(S) / S
        states = [np.interp(starts, t, v) / s for v, s in zip(run.states, self.scale, strict=True)]
        nodes = np.linspace(0.0, end, S * self.grid.intervals + 1)
        u = run.inputs
        sticks = [np.interp(nodes, t, v) for v in (u.x_collective, u.x_pitch / _CYCLIC)]
        z = np.concatenate([[end], np.stack(states, 1).ravel(), *sticks])
        return np.clip(z, self.low, self.high)

    def evaluated(self, z: Float[np.ndarray, " k"]) -> Any:
        """Return values and Jacobians of residuals, equations and inequalities (above zero)."""
        # The optimiser calls for each of them at the same z.
        if self._last[0] != (key := z.tobytes()):
            self._last = (key, self._evaluated(z))
        return self._last[1]

    def _evaluated(self, z: np.ndarray) -> Any:
        n, S = len(self.names), self.grid.segments
        setting = self.model, self.limits, self.grid, self.params, self.wind, self.scale
        slopes, values = jax.device_get(_segments(*setting, z[self.index]))

        def rows(part: str, segments: slice) -> tuple[np.ndarray, np.ndarray]:
            J = np.zeros((*slopes[part].shape[:2], z.size))
            for j in range(S):
                J[j][:, self.index[j]] = slopes[part][j]
            return values[part][segments].ravel(), J[segments].reshape(-1, z.size)

        every, last = slice(None), slice(S - 1, S)
        ends, dends = rows("state", slice(0, S - 1))
        starts = self.index[1:, 1 : 1 + n].ravel()
        dends[np.arange(starts.size), starts] -= 1.0
        return tuple(
            (np.concatenate([a[0], b[0]]), np.vstack([a[1], b[1]]))
            for a, b in (
                (rows("touchdown", last), rows("effort", every)),
                ((ends - z[starts], dends), rows("height", last)),
                (rows("motion", every), rows("rates", every)),
            )
        )

    def minimised(self, z: np.ndarray, steps: int) -> tuple[np.ndarray, Any]:
        """Return the optimum and SciPy's result, from the start z in at most so many steps."""
        import scipy.optimize  # flights need not wait for it

        z, free = z.copy(), self.free

        def part(x: np.ndarray, i: int) -> tuple[np.ndarray, np.ndarray]:
            z[free] = x
            value, J = self.evaluated(z)[i]
            return value, J[:, free]

        def cost(x: np.ndarray) -> tuple[float, np.ndarray]:
            r, J = part(x, 0)
            return float(r @ r), 2.0 * (J.T @ r)

        constraints = [
            {"type": "eq", "fun": lambda x: part(x, 1)[0], "jac": lambda x: part(x, 1)[1]},
            {"type": "ineq", "fun": lambda x: part(x, 2)[0], "jac": lambda x: part(x, 2)[1]},
        ]
        bounds = [*zip(self.low[free], self.high[free], strict=True)]
        result = scipy.optimize.minimize(
            cost, z[free], jac=True, method="SLSQP", constraints=constraints, bounds=bounds,
            options={"maxiter": steps, "ftol": 1e-6},
        )  # fmt: skip
        z[free] = result.x
        return z, result

    def flown(self, z: np.ndarray) -> Trajectory:
        """Return the flight with the sticks of z in one run."""
        S, K, M = self.grid
        v = np.concatenate([z[: 1 + len(self.names)], z[self.sticks :]])
        setting = self.model, self.limits, Grid(1, S * K, M), self.params, self.wind, self.scale
        return jax.device_get(_run(*setting, v))


@functools.partial(jax.jit, static_argnums=(0, 1, 2))
def _run(
    model: Model, limits: Limits, grid: Grid, p: Any, wind: Any, scale: Any, v: Any
) -> Trajectory:
    """Return the flight in a segment with the unknowns v."""
    (S, K, M), n = grid, len(scale)
    k = np.arange(K * M + 1)
    i = np.minimum(k // M, K - 1)
    share = k / M - i
    nodes = v[1 + n :].reshape(2, K + 1)
    collective, pitch = ((1.0 - share) * u[i] + share * u[i + 1] for u in nodes)
    given = jax.tree.map(lambda w: w + 0.0 * collective, _calm(model, wind))
    given = naming.replace(given, x_collective=collective, x_pitch=_CYCLIC * pitch)

    def held(s: Record, u: Record) -> Record:
        sticks = attitude_sticks(s, _bank(s), 0.0, limits.cyclic)
        return naming.replace(u, **(sticks | {"x_pitch": u.x_pitch}))

    state = naming.unravel(model.State, scale * v[1 : 1 + n])
    dt = v[0] / (S * K * M)
    return simulate(model, p, given, dt=dt, substeps=2, initial_state=state, feedback=held)


def _margins(model: Model, limits: Limits, p: Any, s: Record, u: Record) -> dict[str, Any]:
    """Return the scaled distances to the limits of the motion, above zero inside."""
    rates, ratio = model.vector_field(p, s, u), s.Omega / p.Omega
    # Mass times specific force: drag of the fuselage counts as thrust.
    force = p.m * jnp.sqrt(rates.dx**2 + rates.dy**2 + (rates.dz + p.g) ** 2)
    return {
        "slow rotor": ratio - limits.rotor[0],
        "fast rotor": limits.rotor[1] - ratio,
        "lift": 1.0 - force / _most_thrust(p, s.Omega, limits),
        "nose up": 1.0 - s.theta / limits.pitch,
        "nose down": 1.0 + s.theta / limits.pitch,
        "tail": s.z + _TAIL - p.L_T * jnp.sin(s.theta),
        # A tenth of a millimetre, since the last sample is on the ground.
        "ground": s.z + 1e-4,
    }


@functools.partial(jax.jit, static_argnums=(0, 1, 2))
def _segments(
    model: Model, limits: Limits, grid: Grid, p: Any, wind: Any, scale: Any, local: Any
) -> tuple[dict[str, Array], dict[str, Array]]:
    """Return Jacobians and values (segments, ...) of the parts of cost and constraints."""
    n, (S, K, M) = len(scale), grid

    def parts(v: Array) -> tuple[dict[str, Array], dict[str, Array]]:
        run = _run(model, limits, grid, p, wind, scale, v)
        s, u = jax.tree.map(lambda a: a[M::M], (run.states, run.inputs))
        motion = jax.vmap(lambda s, u: _margins(model, limits, p, s, u))(s, u)
        end, h = jax.tree.map(lambda a: a[-1], run.states), v[0] / (S * K)
        speeds = end.dz / limits.vertical, end.dx / limits.horizontal, end.dy / limits.horizontal
        angles = end.phi / _ANGLE, end.theta / _ANGLE, end.dphi / _RATE, end.dtheta / _RATE
        most = limits.collective_rate, limits.cyclic_rate / _CYCLIC
        sticks = v[1 + n :].reshape(2, K + 1)
        steps = (jnp.diff(sticks) / jnp.array(most)[:, None]).ravel()
        out = {
            "state": naming.ravel(end) / scale,
            "height": jnp.stack([end.z]),
            "touchdown": jnp.stack([*speeds, *angles]),
            "motion": jnp.concatenate([*motion.values()]),
            "rates": jnp.concatenate([h - steps, h + steps]),
            # The sum of the squares is the integral of the rates'.
            "effort": jnp.sqrt(_EFFORT / h) * steps,
        }
        return out, out

    return jax.vmap(jax.jacfwd(parts, has_aux=True))(local)


def land(
    model: Model, params: Any, entry: Trim, limits: Limits = Limits(), *, wind: Wind = CALM,
    start: Trajectory | None = None, grid: Grid = Grid(), max_steps: int = 2000,
) -> Landing:  # fmt: skip
    """Find the collective and longitudinal cyclic with the gentlest touchdown, by SciPy's SLSQP.

    Args:
        entry: state and sticks from `engine_failure`.
        wind: velocity of the air [m/s], for a model with wind.
        start: flight of the initial guess; default: that of `energy_law`.
        max_steps: limit of the optimiser.
    """
    problem = LandingProblem(model, params, entry, limits, wind, grid)
    guess: Any = start
    if start is None:
        guess = fly(model, params, Gains(), entry.state, calm(model, 30.0, wind), limits)
    z, result = problem.minimised(problem.sampled(guess), max_steps)
    _, (equations, _), (inequalities, _) = problem.evaluated(z)
    violation = float(max(np.max(np.abs(equations)), -np.min(inequalities)))
    run = problem.flown(z)
    margins = jax.vmap(lambda s, u: _margins(model, limits, params, s, u))(run.states, run.inputs)
    return Landing(
        trajectory=run,
        cost=float(result.fun),
        margins={n: float(np.min(v)) for n, v in margins.items()},
        violation=violation,
        converged=bool(result.success) and violation < _FEASIBLE,
        message=str(result.message),
        steps=int(result.nit),
    )
