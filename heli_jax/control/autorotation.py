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

DT = 0.02
"""Sample time of the feedback [s]."""
_ATTITUDE, _RATE = 0.015, 0.0015
"""Cyclic stick per angle [m/rad] and rate [m s/rad]: attitude follows within 0.3 s."""
_LAG = 0.3
_HEADING, _YAW_RATE = 1.0, 0.4
"""Yaw stick per heading [1/rad] and yaw rate [s/rad]."""
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
    *,
    wind: tuple[Any, Any, Any] = (0.0, 0.0, 0.0),
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
    state = naming.replace(flight.state, z=flight.state.z + height)
    if reaction > 0:

        def held(s: Record, u: Record) -> Record:
            return naming.replace(u, **attitude_sticks(s, flight.state.phi, flight.state.theta))

        n = max(2, round(reaction / DT) + 1)
        off = naming.replace(flight.inputs, x_throttle=0.0 * flight.inputs.x_throttle)
        given = jax.tree.map(lambda v: jnp.full(n, v), off)
        run = simulate(
            model, params, given, dt=reaction / (n - 1), initial_state=state, feedback=held
        )
        state = jax.tree.map(lambda v: v[-1], run.states)
    return flight._replace(state=state)


def attitude_sticks(
    s: Record, phi: Scalar, theta: Scalar, most: float = math.inf
) -> dict[str, Any]:
    """Return the sticks that turn the vehicle to roll phi and pitch theta [rad], with heading zero.

    Args:
        most: largest cyclic stick [m].
    """
    roll = _ATTITUDE * (phi - s.phi) - _RATE * s.dphi
    pitch = _ATTITUDE * (theta - s.theta) - _RATE * s.dtheta
    yaw = -_HEADING * s.psi - _YAW_RATE * s.dpsi
    return {
        "x_roll": jnp.clip(roll, -most, most),
        "x_pitch": jnp.clip(pitch, -most, most),
        "x_yaw": jnp.clip(yaw, -1.0, 1.0),
    }


def along_heading(s: Record) -> tuple[Scalar, Scalar]:
    """Return the speeds over the ground forward and to the right [m/s]."""
    c, sn = jnp.cos(s.psi), jnp.sin(s.psi)
    return s.dx * c + s.dy * sn, s.dy * c - s.dx * sn


def _bank(s: Record) -> Scalar:
    """Return the bank angle that stops a drift [rad]."""
    most = _most_tilt(s)
    return jnp.clip(-_LATERAL * along_heading(s)[1], -most, most)


def _most_tilt(s: Record) -> Scalar:
    """Return the largest roll and pitch angle [rad], smaller near the ground."""
    # Attitude follows with a lag, so the height is that after the lag.
    return jnp.minimum(0.5, _TAIL + jnp.maximum(s.z + _LAG * s.dz, 0.0))


def lift_coefficient(model: Model, p: Any, s: Record, u: Record) -> Scalar:
    """Return the mean lift coefficient of the blades [1], 6 C_T / sigma.

    The thrust is mass times specific force, so that fuselage drag counts as thrust.
    """
    rates = model.vector_field(p, s, u)
    force = p.m * jnp.sqrt(rates.dx**2 + rates.dy**2 + (rates.dz + p.g) ** 2)
    return 6.0 * force / _lift_scale(p, s.Omega)


def _lift_scale(p: Any, Omega: Scalar) -> Scalar:
    """Return rho pi R^4 Omega^2 sigma [N]."""
    return p.rho * math.pi * p.R**4 * Omega**2 * aero.solidity(p.R, p.c)


# The open-loop optimum.


class Grid(NamedTuple):
    """Discretisation of a landing in time."""

    segments: int = 4
    """Segments of the multiple shooting, each with its own initial state."""
    nodes: int = 12
    """Intervals of the sticks in a segment, linear in each."""
    samples: int = 5
    """Samples in such an interval."""

    @property
    def intervals(self) -> int:
        return self.segments * self.nodes


class Landing(NamedTuple):
    """The result of `land`."""

    trajectory: Trajectory
    """The flight with the optimal sticks in one run, without shooting."""
    cost: float
    touchdown: dict[str, float]
    """State at touchdown by name, SI."""
    margins: dict[str, float]
    """Distance to each limit over its size, at all samples; negative if exceeded."""
    defect: float
    """Largest difference between the end of a segment and the start of the next, scaled."""
    converged: bool
    """True if the optimiser met its tolerance, and constraints hold within 1e-4."""
    message: str
    """The optimiser's message."""
    steps: int


_SCALES = {
    "x": 10.0, "z": 10.0, "dx": 5.0, "dz": 5.0, "Omega": 100.0, "phi": 0.1, "theta": 0.3,
    "beta_roll": 0.1, "beta_pitch": 0.1, "a1": 0.05, "b1": 0.05,
}  # fmt: skip
_CYCLIC = 0.005
"""Scales of the states and of the cyclic stick."""
_TOUCHDOWN = {"phi": 0.1, "theta": 0.1, "dphi": 0.3, "dtheta": 0.3}
"""Angles [rad] and rates [rad/s] at touchdown that cost as much as the speeds of `Limits`."""
_EFFORT = 0.1
"""Cost of a second with a stick at its largest rate. It makes the optimum unique."""
_FEASIBLE = 1e-4


class LandingProblem:
    """The nonlinear programme of a landing by direct multiple shooting.

    The unknowns z are the duration [s], the scaled state at the start of each segment, and both
    sticks at the nodes. The first state and the first sticks are given. The cost is a sum of
    squares.
    """

    def __init__(
        self,
        model: Model,
        params: Any,
        entry: Trim,
        limits: Limits = Limits(),
        wind: tuple[float, float, float] = (0.0, 0.0, 0.0),
        grid: Grid = Grid(),
    ) -> None:
        self.model, self.params, self.limits, self.grid = model, params, limits, grid
        self.air = {n: w for n, w in zip(("wind_x", "wind_y", "wind_z"), wind, strict=True)}
        self.names = naming.names(model.State)
        n, S, K, q = len(self.names), grid.segments, grid.nodes, grid.intervals + 1
        self.scale = np.array([_SCALES.get(name, 1.0) for name in self.names])
        self.sticks = 1 + S * n
        """Place of the first stick in z."""
        self.size = self.sticks + 2 * q
        # Places in z of what a segment depends on: duration, state, sticks at its nodes.
        states = 1 + np.arange(S * n).reshape(S, n)
        nodes = self.sticks + K * np.arange(S)[:, None] + np.arange(K + 1)
        self.index = np.hstack([np.zeros((S, 1), int), states, nodes, q + nodes])
        self.low, self.high = self._bounds(entry)
        self.free = self.low < self.high
        self._last: tuple[bytes, Any] = (b"", None)

    def _bounds(self, entry: Trim) -> tuple[np.ndarray, np.ndarray]:
        q, at, limits = self.grid.intervals + 1, self.sticks, self.limits
        low, high = np.full(self.size, -np.inf), np.full(self.size, np.inf)
        low[0], high[0] = 0.3, 100.0
        low[at : at + q], high[at : at + q] = limits.collective
        high[at + q :] = limits.cyclic / _CYCLIC
        low[at + q :] = -high[at + q :]
        given = np.asarray(naming.ravel(entry.state)) / self.scale
        low[self.index[0, 1 : 1 + given.size]] = high[self.index[0, 1 : 1 + given.size]] = given
        for place, value in (
            (at, entry.inputs.x_collective),
            (at + q, entry.inputs.x_pitch / _CYCLIC),
        ):
            low[place] = high[place] = np.clip(float(value), low[place], high[place])
        return low, high

    def sampled(self, run: Trajectory) -> Float[np.ndarray, " k"]:
        """Return the unknowns of a flight, such as one with `energy_law`: an initial guess."""
        t = np.asarray(run.times)
        end = float(min(run.ended, t[-1]))
        columns = [np.asarray(v) / s for v, s in zip(run.states, self.scale, strict=True)]
        starts = end * np.arange(self.grid.segments) / self.grid.segments
        nodes = np.linspace(0.0, end, self.grid.intervals + 1)
        states = np.stack([np.interp(starts, t, v) for v in columns], 1)
        sticks = [
            np.interp(nodes, t, v) for v in (run.inputs.x_collective, run.inputs.x_pitch / _CYCLIC)
        ]
        return np.clip(np.concatenate([[end], states.ravel(), *sticks]), self.low, self.high)

    def evaluated(self, z: np.ndarray) -> Any:
        """Return values and Jacobians of residuals, equations and inequalities, cached for one z."""
        key = z.tobytes()
        if self._last[0] != key:
            self._last = (key, self._evaluated(z))
        return self._last[1]

    def _evaluated(self, z: np.ndarray) -> Any:
        n, S = len(self.names), self.grid.segments
        local = z[self.index]
        slopes, values = jax.device_get(
            _segments(self.model, self.limits, self.grid, self.params, self.air, self.scale, local)
        )
        J = np.zeros((S, values.shape[1], self.size))
        for j in range(S):
            J[j][:, self.index[j]] = slopes[j]
        ends, paths, dends = values[:, :n], values[:, n:], J[:, :n]
        starts = self.index[1:, 1 : 1 + n]
        defects, ddefects = (ends[:-1] - z[starts]).ravel(), dends[:-1].reshape(-1, self.size)
        ddefects[np.arange(starts.size), starts.ravel()] -= 1.0
        down = self.names.index("z")
        equations = np.append(defects, ends[-1, down]), np.vstack([ddefects, dends[-1, down]])
        rates = self.rates()
        inequalities = (
            np.concatenate([paths.ravel(), rates @ z]),
            np.vstack([J[:, n:].reshape(-1, self.size), rates]),
        )
        return self._residuals(z, ends[-1], dends[-1]), equations, inequalities

    def _residuals(
        self, z: np.ndarray, end: np.ndarray, slopes: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        limits, q = self.limits, self.grid.intervals + 1
        weights = {"dz": limits.vertical, "dx": limits.horizontal, "dy": limits.horizontal}
        at = {self.names.index(n): w for n, w in (weights | _TOUCHDOWN).items()}
        factor = self.scale[[*at]] / np.array([*at.values()])
        rows, J = [factor * end[[*at]]], [factor[:, None] * slopes[[*at]]]
        # Steps of the sticks over sqrt(h): the sum of their squares is the integral of the rates'.
        h = z[0] / (q - 1)
        for place, rate in self._rated():
            step = np.zeros((q - 1, self.size))
            k = np.arange(q - 1)
            step[k, place + k + 1], step[k, place + k] = 1.0, -1.0
            step *= math.sqrt(_EFFORT / h) / rate
            rows.append(step @ z)
            step[:, 0] = -0.5 * rows[-1] / z[0]
            J.append(step)
        return np.concatenate(rows), np.vstack(J)

    def _rated(self) -> tuple[tuple[int, float], ...]:
        """Return the place of both sticks in z, and their largest rates [scaled, 1/s]."""
        q, limits = self.grid.intervals + 1, self.limits
        return (self.sticks, limits.collective_rate), (
            self.sticks + q,
            limits.cyclic_rate / _CYCLIC,
        )

    def rates(self) -> np.ndarray:
        """Return the matrix A of the limits of the sticks' rates, A z >= 0."""
        n = self.grid.intervals
        A = np.zeros((2, 2, n, self.size))
        k = np.arange(n)
        for (place, rate), both in zip(self._rated(), A, strict=True):
            for sign, rows in zip((1.0, -1.0), both, strict=True):
                rows[:, 0] = rate / n
                rows[k, place + k + 1], rows[k, place + k] = sign, -sign
        return A.reshape(-1, self.size)

    def minimised(self, z: np.ndarray, method: str, **options: Any) -> tuple[np.ndarray, Any]:
        """Return the optimum and SciPy's result, from the start z.

        Args:
            method: "SLSQP" or "trust-constr", with its options.
        """
        import scipy.optimize  # other functions need not wait for it

        z, free = z.copy(), self.free

        def at(x: np.ndarray) -> Any:
            z[free] = x
            return self.evaluated(z)

        def cost(x: np.ndarray) -> tuple[float, np.ndarray]:
            r, J = at(x)[0]
            return float(r @ r), 2.0 * (J.T @ r)[free]

        constraints = [
            {"type": "eq", "fun": lambda x: at(x)[1][0], "jac": lambda x: at(x)[1][1][:, free]},
            {"type": "ineq", "fun": lambda x: at(x)[2][0], "jac": lambda x: at(x)[2][1][:, free]},
        ]
        result = scipy.optimize.minimize(
            cost, z[free], jac=True, method=method, constraints=constraints, options=options,
            bounds=scipy.optimize.Bounds(self.low[free], self.high[free]),
        )  # fmt: skip
        z[free] = result.x
        return z, result

    def flown(self, z: np.ndarray) -> Trajectory:
        """Return the flight with the sticks of z in one run."""
        n, q = len(self.names), self.grid.intervals
        whole = self.grid._replace(segments=1, nodes=q)
        v = np.concatenate([z[: 1 + n], z[self.sticks :]])
        return _flown(self.model, self.limits, whole, self.params, self.air, self.scale, v)


def _run(
    model: Model, limits: Limits, grid: Grid, p: Any, air: Any, scale: Any, v: Any
) -> Trajectory:
    """Return the flight in a segment; v are its unknowns."""
    n, K, M = len(scale), grid.nodes, grid.samples
    k = np.arange(K * M + 1)
    i = np.minimum(k // M, K - 1)
    share = k / M - i
    nodes = v[1 + n : 2 + n + K], _CYCLIC * v[2 + n + K :]
    collective, pitch = ((1.0 - share) * u[i] + share * u[i + 1] for u in nodes)
    given = dict.fromkeys(naming.names(model.Inputs), 0.0 * collective)
    given |= {name: 0.0 * collective + w for name, w in air.items() if name in given}
    given |= {"x_collective": collective, "x_pitch": pitch}

    def held(s: Record, u: Record) -> Record:
        sticks = attitude_sticks(s, _bank(s), 0.0, limits.cyclic)
        return naming.replace(u, **(sticks | {"x_pitch": u.x_pitch}))

    return simulate(
        model, p, model.Inputs(**given), dt=v[0] / (grid.segments * K * M), substeps=2,
        initial_state=naming.unravel(model.State, scale * v[1 : 1 + n]), feedback=held,
    )  # fmt: skip


_flown = jax.jit(_run, static_argnums=(0, 1, 2))


def _inside(model: Model, limits: Limits, p: Any, s: Record, u: Record) -> dict[str, Any]:
    """Return the distances to the limits of the motion, scaled; above zero inside."""
    ratio, (low, high) = s.Omega / p.Omega, limits.rotor
    return {
        "slow rotor": ratio - low,
        "fast rotor": high - ratio,
        "lift": 1.0 - lift_coefficient(model, p, s, u) / limits.lift,
        "nose up": 1.0 - s.theta / limits.pitch,
        "nose down": 1.0 + s.theta / limits.pitch,
        "tail": s.z + _TAIL - p.L_T * jnp.sin(s.theta),
        # A tenth of a millimetre, since the last sample is on the ground.
        "ground": s.z + 1e-4,
    }


@functools.partial(jax.jit, static_argnums=(0, 1, 2))
def _segments(
    model: Model, limits: Limits, grid: Grid, p: Any, air: Any, scale: Any, local: Any
) -> tuple[Array, Array]:
    """Return Jacobian and values of all segments: the scaled state at the end, then `_inside` at
    the nodes.
    """

    def values(v: Array) -> tuple[Array, Array]:
        run = _run(model, limits, grid, p, air, scale, v)
        at = lambda tree: jax.tree.map(lambda a: a[grid.samples :: grid.samples], tree)
        inside = jax.vmap(lambda s, u: _inside(model, limits, p, s, u))(
            at(run.states), at(run.inputs)
        )
        end = jnp.stack([a[-1] for a in run.states]) / scale
        out = jnp.concatenate([end, *inside.values()])
        return out, out

    return jax.vmap(jax.jacfwd(values, has_aux=True))(local)


def land(
    model: Model,
    params: Any,
    entry: Trim,
    limits: Limits = Limits(),
    *,
    wind: tuple[float, float, float] = (0.0, 0.0, 0.0),
    start: Trajectory | None = None,
    grid: Grid = Grid(),
    max_steps: int = 300,
) -> Landing:
    """Find the collective and longitudinal cyclic with the gentlest touchdown, by SciPy's SLSQP.

    Args:
        entry: state and sticks from `engine_failure`.
        wind: velocity of the air [m/s], for a model with wind.
        start: flight of the initial guess; default: that of `energy_law`.
        max_steps: limit of the optimiser.
    """
    problem = LandingProblem(model, params, entry, limits, wind, grid)
    if start is None:
        start = fly(model, params, Gains(), entry.state, calm(model, 30.0, wind), limits)
    z, result = problem.minimised(problem.sampled(start), "SLSQP", maxiter=max_steps, ftol=1e-6)
    _, (equations, _), (inequalities, _) = problem.evaluated(z)
    defect = float(np.max(np.abs(equations)))
    run = jax.device_get(problem.flown(z))
    inside = jax.vmap(lambda s, u: _inside(model, limits, params, s, u))(run.states, run.inputs)
    return Landing(
        trajectory=run,
        cost=float(result.fun),
        touchdown={n: float(v[-1]) for n, v in zip(problem.names, run.states, strict=True)},
        margins={n: float(np.min(v)) for n, v in inside.items()},
        defect=defect,
        converged=bool(result.success and defect < _FEASIBLE and np.min(inequalities) > -_FEASIBLE),
        message=str(result.message),
        steps=int(result.nit),
    )


# The feedback on energy.


class Gains(NamedTuple):
    """Gains of the feedback on energy, all above zero."""

    speed: Any = 8.0
    """Forward speed over the ground in the glide [m/s]."""
    sink: Any = 6.0
    """Sink rate in the glide [m/s]."""
    deceleration: Any = 4.0
    """Vertical deceleration in the flare [m/s^2]."""
    settling: Any = 0.5
    """Time constant of the last descent [s]."""
    slowing: Any = 1.0
    """Forward speed over the sink rate in the flare [1]."""
    k_speed: Any = 0.12
    """Pitch angle per error of the speed [rad s/m]."""
    k_sink: Any = 4.0
    """Vertical acceleration per error of the sink rate in the flare [1/s]."""
    k_glide: Any = 1.0
    """The same in the glide [1/s]."""
    k_rotor: Any = 10.0
    """Vertical acceleration per relative lack of rotor energy [m/s^2]."""
    k_energy: Any = 0.3
    """Relative change of the deceleration per relative lack of energy [1]."""


_SINK = 0.2
"""Sink rate at touchdown [m/s]."""


def energy_law(p: Any, gains: Gains, limits: Limits) -> Callable[[Record, Record], Record]:
    r"""Return the feedback of `simulate` that lands without power.

    With the rotor's energy above that of its lowest speed, $E_r$, relative to that of full speed,
    $E_0$, and the kinetic energy $E_k$, the flare begins where the sink rate reaches
    $w^2 = w_0^2 + 2 a (1 + k_E (1 - (E_r + E_k)/E_0)) z$.
    """

    def feedback(s: Record, u: Record) -> Record:
        forward, _ = along_heading(s)
        full = 0.5 * p.Ir * p.Omega**2 * (1.0 - limits.rotor[0] ** 2)
        rotor = 0.5 * p.Ir * (s.Omega**2 - (limits.rotor[0] * p.Omega) ** 2) / full
        kinetic = 0.5 * p.m * (s.dx**2 + s.dy**2) / full
        lack = jnp.clip(1.0 - rotor - kinetic, 0.0, 1.0)
        a = gains.deceleration * (1.0 + gains.k_energy * lack)
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
        T = jnp.minimum(T, limits.lift / 6.0 * _lift_scale(p, s.Omega))
        return naming.replace(
            u,
            x_collective=jnp.clip(_collective(p, s, T), *limits.collective),
            x_throttle=0.0 * s.z,
            **attitude_sticks(s, phi, theta, limits.cyclic),
        )

    return feedback


def _collective(p: Any, s: Record, T: Scalar) -> Scalar:
    """Return the collective stick for the thrust T [N] in calm air, the inverse of `aero.thrust`."""
    sth, cth = jnp.sin(s.theta), jnp.cos(s.theta)
    forward, lateral = along_heading(s)
    W = s.dz * cth - forward * sth
    V2 = (forward * cth + s.dz * sth) ** 2 + lateral**2
    T0 = T / (p.rho * math.pi * p.R**2)
    inflow = W + aero.induced_velocity(V2, W, T0, 0.0 * T0)
    half = 0.5 * p.a * aero.solidity(p.R, p.c)
    lifting = T0 + half * 0.5 * p.B**2 * p.R * s.Omega * inflow
    return lifting / (half * p.B**3 / 3.0 * p.R**2 * s.Omega**2 * p.K_theta0)


def calm(model: Model, duration: float, wind: tuple[Any, Any, Any] = (0.0, 0.0, 0.0)) -> Record:
    """Return the inputs (N,) of a flight with `energy_law` in steady wind [m/s]."""
    air = dict(zip(("wind_x", "wind_y", "wind_z"), wind, strict=True))
    zero = jnp.zeros(round(duration / DT) + 1)
    return model.Inputs(**{n: zero + air.get(n, 0.0) for n in naming.names(model.Inputs)})


@functools.partial(jax.jit, static_argnums=(0, 5))
def fly(
    model: Model,
    params: Any,
    gains: Gains,
    state: Record,
    inputs: Record,
    limits: Limits = Limits(),
) -> Trajectory:
    """Return the flight with `energy_law` to the ground.

    Args:
        inputs: the model's Inputs (N,) at `DT`, of which only wind acts: `calm`.
    """
    return simulate(
        model, params, inputs, dt=DT, substeps=2, initial_state=state,
        feedback=energy_law(params, gains, limits), events={"ground": ground()},
    )  # fmt: skip


class Touchdown(NamedTuple):
    """End of a flight."""

    vertical: Array
    """Speed upwards [m/s]."""
    forward: Array
    lateral: Array
    roll: Array
    """Angle [rad]."""
    pitch: Array
    slowest: Array
    """Lowest and highest rotor speed of the flight over the vehicle's."""
    fastest: Array
    height: Array
    """Height at the end [m], zero on the ground."""

    def good(self, limits: Limits = Limits()) -> Bool[Array, "..."]:
        """True if speeds, attitude and rotor are within limits on the ground."""
        return (
            (abs(self.vertical) < limits.vertical)
            & (jnp.hypot(self.forward, self.lateral) < limits.horizontal)
            & (jnp.hypot(self.roll, self.pitch) < 0.2)
            & (self.slowest > limits.rotor[0])
            & (self.fastest < limits.rotor[1])
            & (abs(self.height) < 1e-3)
        )


def touchdown(params: Any, run: Trajectory) -> Touchdown:
    """Return the end of a flight with `fly`."""
    end = jax.tree.map(lambda v: v[-1], run.states)
    ratio = run.states.Omega / params.Omega
    return Touchdown(
        end.dz, *along_heading(end), end.phi, end.theta, jnp.min(ratio), jnp.max(ratio), end.z
    )


def misses(end: Touchdown, limits: Limits = Limits()) -> Float[Array, " 7"]:
    """Return the errors of a touchdown that `tune` squares and sums: 1 is half of a limit."""
    low, high = limits.rotor
    errors = jnp.stack(
        [
            2.0 * end.vertical / limits.vertical,
            2.0 * end.forward / limits.horizontal,
            2.0 * end.lateral / limits.horizontal,
            end.pitch / 0.1,
            jnp.maximum(low + 0.03 - end.slowest, 0.0) / 0.015,
            jnp.maximum(end.fastest - high + 0.02, 0.0) / 0.01,
            end.height / 0.2,
        ]
    )
    # A lost flight must not outweigh many that nearly land (Geman and McClure's estimator).
    return errors / jnp.sqrt(1.0 + (errors / 4.0) ** 2)


def tune(
    model: Model,
    params: Any,
    gains: Gains,
    states: Record,
    inputs: Record,
    limits: Limits = Limits(),
    *,
    max_steps: int = 30,
) -> Gains:
    """Return gains with a smaller sum of squares of `misses`, by SciPy's trust-region least squares.

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
            return misses(touchdown(params, fly(model, params, changed, state, u, limits)), limits)

        return jax.vmap(one)(states, inputs).ravel()

    slopes = jax.jit(jax.jacfwd(residuals))
    result = scipy.optimize.least_squares(
        lambda z: np.asarray(residuals(z)), np.zeros(start.size), lambda z: np.asarray(slopes(z)),
        max_nfev=max_steps, ftol=1e-3,
    )  # fmt: skip
    return Gains(*(start * np.exp(result.x)).tolist())
