"""Gains tuned by gradients through the nonlinear closed loop, for many vehicles at once."""

import functools
import itertools
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from heli_jax import naming
from heli_jax.analysis.margins import Margins
from heli_jax.control.controller import (
    COMMAND,
    NOISE,
    SET,
    STATE,
    Controller,
    begin,
    commanded,
    gains_of,
    in_loop,
    measured,
    signals_of,
    with_controller,
    with_gains,
)
from heli_jax.control.loops import (
    Plant,
    SampledLoop,
    all_stable,
    controller_responses,
    frequencies,
    growth,
    linear_step,
    loop_margins,
    loop_responses,
    plant_of,
    plant_responses,
    sampled_loop,
    sensitivity,
)
from heli_jax.control.posterior import SteadyFlights
from heli_jax.dynamics.model import Model
from heli_jax.errors import require_known
from heli_jax.numerics.constrained import lagrangian, minimise
from heli_jax.simulation.options import Scan
from heli_jax.simulation.simulate import simulate, substeps_for

_SHARP = 100.0
"""Sharpness of the smooth minimum of |1 + L| over frequencies."""
_CONTROLLED, _DRIFTING = -0.02, 0.05
"""Growth of the law's loop below which all its modes decay, and largest growth of a tuned loop with
positions or headings that drift [1/s]."""
_DIVERGED = 1e12
"""Square of a deviation over its largest acceptable value that counts as diverged."""
_LATE = 0.75 * np.pi
"""Lag of a response at its bandwidth [rad]."""
_MOVING = 1e-4
"""Rate at which a signal moves in steady flight [largest acceptable deviation a second]."""
_SHOWN = 25
"""Evaluations between two messages of progress."""
_TOLERANCE = 1e-5
"""Relative change of the cost in a step at which a round of the tuning ends."""
_WIDEST = 3.0
"""Largest change of a gain's logarithm."""


class Scenario(NamedTuple):
    """Flight for which gains are tuned, in deviations from steady flight."""

    inputs: Mapping[str, Any]
    """Inputs (N,) that no controller commands, such as wind, SI."""
    set_points: Mapping[str, Any]
    """Changes of set points (N,) by signal, SI."""
    samples: int
    noise: Mapping[str, Any] = {}
    """Noise (N,) of the signals that the controller reads, SI."""


def gusts(sd: float, tau: float, n: int, dt: float, rng: np.random.Generator) -> np.ndarray:
    """Return a stationary first-order Gauss-Markov process (n,)."""
    kept = np.exp(-dt / tau)
    w, drawn = np.empty(n), rng.standard_normal(n)
    w[0] = sd * drawn[0]
    for k in range(1, n):
        w[k] = kept * w[k - 1] + sd * np.sqrt(1.0 - kept**2) * drawn[k]
    return w


class Flown(NamedTuple):
    """A flight in closed loop; arrays (N,), vmap adds vehicles."""

    deviations: dict[str, Any]
    """Signals less their set points, or less their values in steady flight."""
    commands: dict[str, Any]
    """Commands as held before each sample."""
    status: Any
    """Index in `simulation.trajectory.STATUS`."""


class Tuned(NamedTuple):
    """Gains after the optimisation."""

    controller: Any
    converged: bool
    """True if the optimiser converged, and all vehicles are stable with the wanted distance."""
    cost: tuple[float, float]
    """Cost before and after: mean over vehicles of log(1 + mean square of deviations and commands
    over their largest acceptable values)."""
    distance: tuple[float, float]
    """Least distance |1 + L| before and after, over vehicles, commands and frequencies."""
    stable: tuple[float, float]
    """Share of stable vehicles before and after."""


def tune(
    model: Model,
    vehicles: Any,
    trimmed: Any,
    controller: Controller,
    scenario: Scenario,
    *,
    most: Mapping[str, float],
    distance: float = 0.5,
    bandwidth: Mapping[str, float] | None = None,
    max_steps: int = 50,
    progress: Callable[[str], None] = lambda _: None,
) -> Tuned:
    r"""Return the controller whose gains minimise deviations and effort over a set of vehicles.

    The cost is the mean over the vehicles of $\log(1 + \overline{\sum_j (e_j/m_j)^2 + \sum_i
    (u_i/m_i)^2})$ of the nonlinear closed loop, so that a diverging vehicle counts without drowning
    the others. Gains keep their signs. $|1 + L| \ge$ `distance` holds at every command, frequency
    and vehicle: gain margins of $-20\log_{10}(1-d)$ dB upwards and $20\log_{10}(1+d)$ dB
    downwards, and a phase margin of $2\arcsin(d/2)$.

    Args:
        vehicles: the model's Params with arrays (k,), such as draws of a posterior. All start in
            the steady flight of the first, and have its sticks.
        trimmed: steady flights with arrays (k,), see `vehicles_of`.
        controller: gains to begin with.
        most: largest acceptable deviation of signals and commands, SI.
        distance: least distance of L from -1.
        bandwidth: least bandwidth [rad/s] of the response to each set point, as ADS-33 defines it
            for attitude command: up to it the phase stays above -135 deg.
        max_steps: most steps of L-BFGS-B.

    Raises:
        ValueError: an unknown name, or a controller without gains.
    """
    problem = Tuning(model, vehicles, trimmed, controller, scenario, dict(most), bandwidth)
    names = list(gains_of(controller))
    start = np.asarray([float(v) for v in gains_of(controller).values()])
    moved = np.flatnonzero(start)
    if not moved.size:
        raise ValueError("expected a controller with gains, got none that is not zero")

    def gains(z: Array) -> dict[str, Array]:
        k = jnp.asarray(start).at[moved].set(start[moved] * jnp.exp(z))
        return dict(zip(names, k, strict=True))

    m, count = len(commanded(model, controller)), problem.plants.at.shape[0]
    limits = np.repeat([distance] * m + [0.0] * (1 + len(problem.bandwidth)), count)

    @jax.jit
    @functools.partial(jax.value_and_grad, has_aux=True)
    def augmented(z: Array, multipliers: Array, penalty: Array) -> tuple[Array, Array]:
        excess = jnp.asarray(limits) - problem.distances(gains(z))
        return lagrangian(problem.cost(gains(z)), excess, multipliers, penalty), excess

    tries = itertools.count()

    def told(*arguments: Any) -> Any:
        found = augmented(*arguments)
        if next(tries) % _SHOWN == 0:
            progress(f"tuning: cost with limits {float(found[0][0]):.4g}")
        return found

    bounds = [(-_WIDEST, _WIDEST)] * moved.size
    found = minimise(told, np.zeros(moved.size), limits.size, bounds, max_steps, _TOLERANCE)
    made = with_gains(controller, gains(jnp.asarray(found.x)))
    before, after = problem.judged(controller), problem.judged(made)
    if after[1] < before[1]:
        # Gains that lose vehicles are no improvement.
        made, after = controller, before
    reached = found.converged and after[1] == 1.0 and after[0] >= distance - 0.02
    costs = problem.cost_of(controller), problem.cost_of(made)
    return Tuned(made, reached, costs, (before[0], after[0]), (before[1], after[1]))


@jax.custom_vjp
def _with_finite_slopes(gains: Mapping[str, Array]) -> Mapping[str, Array]:
    """Return the gains, without the derivatives of a vehicle that left the range of floats.

    Its growth still has some.
    """
    return gains


_with_finite_slopes.defvjp(
    lambda gains: (gains, None),
    lambda _, slopes: (jax.tree.map(lambda g: jnp.where(jnp.isfinite(g), g, 0.0), slopes),),
)


def _phase(response: Complex[Array, " f"]) -> Float[Array, " f"]:
    return jnp.unwrap(jnp.angle(response))


class Tuning:
    """Cost and distances of a set of vehicles, as functions of the gains."""

    def __init__(
        self,
        model: Model,
        vehicles: Any,
        trimmed: Any,
        controller: Controller,
        scenario: Scenario,
        most: dict[str, float],
        bandwidth: Mapping[str, float] | None = None,
    ) -> None:
        model = in_loop(model, commanded(model, controller))
        known, words = (
            (*signals_of(model), *naming.names(model.Inputs)),
            f"model {model.name} has no",
        )
        require_known(most, known, "most", f"{words} signal or input")
        inputs = naming.names(model.Inputs)
        require_known(scenario.inputs, inputs, "scenario", f"{words} input")
        without = "the controller has no set point"
        require_known(scenario.set_points, controller.references, "scenario", without)
        self.bandwidth = dict(bandwidth or {})
        require_known(self.bandwidth, controller.references, "bandwidth", without)
        self.model, self.controller, self.dt = model, controller, controller.dt
        self.closed = with_controller(model, controller, scenario.noise)
        self.vehicles, self.most, self.scenario = vehicles, most, scenario
        self.plants: Plant = jax.vmap(lambda p, t: plant_of(model, p, t[0], t[1], self.dt))(
            vehicles, (trimmed.state, trimmed.inputs)
        )
        first = jax.tree.map(lambda v: v[0], (vehicles, trimmed.state, trimmed.inputs))
        state, inputs = begin(
            self.closed, self.params(first[0], {}), SteadyFlights(*first[1:]), scenario.samples
        )
        self._require_steady(self.params(first[0], {}), state, inputs)
        changed = {**scenario.inputs, **{SET + n: v for n, v in scenario.set_points.items()}}
        changed |= {NOISE + n: v for n, v in scenario.noise.items()}
        self.begun = state
        self.inputs = naming.replace(
            inputs, **{n: getattr(inputs, n) + jnp.asarray(v) for n, v in changed.items()}
        )
        self.omega = np.unique([*frequencies(self.dt), *self.bandwidth.values()])
        # These do not depend on the gains.
        self.responding = jax.jit(
            jax.vmap(lambda p: plant_responses(model, p, controller, self.dt, self.omega))
        )(self.plants)
        first = jax.tree.map(lambda v: v[0], self.plants)
        slowest = growth(sampled_loop(model, first, controller), self.dt)
        self.most_growth = slowest / 3.0 if slowest < _CONTROLLED else _DRIFTING

    def _require_steady(self, params: Any, state: Any, inputs: Any) -> None:
        """Refuse weighted signals that change in the steady flight.

        Raises:
            ValueError: a signal changes, such as a position in forward flight.
        """
        u = jax.tree.map(lambda v: v[0], inputs)
        rates = self.closed.vector_field(params, state, u)
        _, slopes = jax.jvp(lambda s: measured(self.closed, params, s, u), (state,), (rates,))
        for name in dict.fromkeys((*self.most, *self.controller.references)):
            if abs(slope := float(slopes.get(name, 0.0))) > _MOVING * self.most.get(name, 1.0):
                raise ValueError(
                    f"{name} changes by {slope:.3g} a second in this steady flight: expected "
                    "signals that stand still, or hover"
                )

    def params(self, vehicle: Any, gains: Mapping[str, Any]) -> Any:
        return self.closed.Params(**{**naming.asdict(vehicle), **gains})

    def run(self, vehicle: Any, gains: Mapping[str, Any], **options: Any) -> "Flown":
        """Return the flight of one vehicle."""
        params = self.params(vehicle, gains)
        run = simulate(
            self.closed, params, self.inputs, dt=self.dt, initial_state=self.begun,
            substeps=substeps_for(self.dt, self.closed.fastest), **options,
        )  # fmt: skip
        signals = jax.vmap(lambda s, u: measured(self.closed, params, s, u))(run.states, run.inputs)
        first = jax.tree.map(lambda v: v[0], self.inputs)
        at = measured(self.closed, params, self.begun, first)
        off = {
            n: v - getattr(run.inputs, SET + n, at[n])
            for n, v in signals.items()
            if not n.startswith((COMMAND, STATE))
        }
        held = {n: getattr(run.states, COMMAND + n) for n in commanded(self.model, self.controller)}
        return Flown(off, held, run.status)

    def cost(self, gains: Mapping[str, Array]) -> Float[Array, ""]:
        """Return the mean cost of the vehicles."""

        def of_one(vehicle: Any) -> Array:
            flown = self.run(vehicle, _with_finite_slopes(gains), adjoint=Scan())
            return self._cost({**flown.deviations, **flown.commands})

        return jnp.mean(jax.vmap(of_one)(self.vehicles))

    def _cost(self, flown: Mapping[str, Any]) -> Any:
        """Return the costs of flights with signals (..., N)."""
        total = sum((jnp.asarray(flown[n]) / size) ** 2 for n, size in self.most.items())
        # A vehicle that left the range of floats counts as a large cost.
        total = jnp.where(jnp.isfinite(total), total, _DIVERGED)
        return jnp.log1p(jnp.mean(jnp.minimum(total, _DIVERGED), axis=-1))

    def cost_of(self, controller: Controller) -> float:
        """Return the mean cost of the vehicles with a controller."""
        flown = self.flown(controller)
        return float(self._cost({**flown.deviations, **flown.commands}).mean())

    def flown(self, controller: Controller) -> "Flown":
        """Return the flights of all vehicles, NumPy arrays (k, N)."""
        gains = {n: jnp.asarray(v, float) for n, v in gains_of(controller).items()}
        return jax.device_get(jax.jit(jax.vmap(lambda p: self.run(p, gains)))(self.vehicles))

    def distances(self, gains: Mapping[str, Array]) -> Float[Array, " m"]:
        """Return smooth minima over frequencies: |1 + L| by command and vehicle, stability, phases.

        Stability is the limit of growth less the growth of the closed loop [1/s]. The distance
        alone does not see it, since an unstable loop may be far from -1. Phases are those of the
        responses to set points up to the wanted bandwidth, above -135 deg [rad].
        """
        controller = with_gains(self.controller, gains)

        def of_one(plant: Plant, P: Array) -> tuple[Array, ...]:
            step = linear_step(self.model, plant, controller)
            K, R = controller_responses(step, self.dt, self.omega)
            stable = self.most_growth - growth(sampled_loop(self.model, plant, controller), self.dt)
            ahead = [
                jnp.where(self.omega <= w, _phase(self._following(K, R, P, n)), 0.0) + _LATE
                for n, w in self.bandwidth.items()
            ]
            apart = [*jnp.abs(1.0 + loop_responses(K, P)), stable, *ahead]
            return tuple(-jax.nn.logsumexp(-_SHARP * v) / _SHARP for v in apart)

        return jnp.concatenate(jax.vmap(of_one)(self.plants, self.responding))

    def _following(self, K: Array, R: Array, P: Array, name: str) -> Complex[Array, " f"]:
        """Return a signal's response to its set point at every frequency."""
        row = signals_of(self.model).index(name)
        to = self.controller.references.index(name)
        return (P[:, [row]] @ sensitivity(K, P) @ R[..., [to]])[:, 0, 0]

    def followed(self, controller: Controller, name: str) -> Complex[np.ndarray, "k f"]:
        """Return all vehicles' responses of a signal to its set point, at every frequency."""
        return self._each(controller, lambda K, R, P: self._following(K, R, P, name))

    def responses(self, controller: Controller) -> Complex[np.ndarray, "k m f"]:
        """Return L of all vehicles at every command and frequency."""
        return self._each(controller, lambda K, R, P: loop_responses(K, P))

    def _each(self, controller: Controller, respond: Callable[..., Array]) -> np.ndarray:
        """Return a function of the responses of controller and plant for all vehicles."""

        def of_one(plant: Plant, P: Array) -> Array:
            step = linear_step(self.model, plant, controller)
            return respond(*controller_responses(step, self.dt, self.omega), P)

        return np.asarray(jax.jit(jax.vmap(of_one))(self.plants, self.responding))

    def margins(self, controller: Controller) -> tuple[Margins, ...]:
        """Return the margins (k,) of the loop at each command."""
        return loop_margins(self._loops(controller), self.dt)

    def _loops(self, controller: Controller) -> SampledLoop:
        return jax.vmap(lambda plant: sampled_loop(self.model, plant, controller))(self.plants)

    def closed_matrix(self, controller: Controller, k: int) -> np.ndarray:
        """Return the closed loop's matrix (n, n) of vehicle k, its states first."""
        loop = self._loops(controller)
        return np.asarray(loop.A[k] + loop.B[k] @ loop.C[k])

    def judged(self, controller: Controller) -> tuple[float, float]:
        """Return the least distance and the share of stable vehicles."""
        stable = all_stable(self.margins(controller))
        return float(np.min(np.abs(1.0 + self.responses(controller)))), float(np.mean(stable))
