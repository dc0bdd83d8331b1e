"""Design of a flight: the inputs within limits that determine the parameters best.

The candidates of the library are compared first. From the best of them, SciPy's SLSQP searches
over values of the inputs at nodes, with gradients in reverse mode. Limits of the motion hold along
the whole flight: the largest value over time is replaced by a smooth one that is never smaller
(Kreisselmeier and Steinhauser, 1979). Sources: Mehra (1974); Goodwin and Payne (1977) for the
criteria.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from heli_jax import naming
from heli_jax.errors import nearest
from heli_jax.identification.design.information import Experiment, Feedback, planned
from heli_jax.identification.design.library import manoeuvres
from heli_jax.identification.problem import Free, Problem
from heli_jax.identification.search import first_guess
from heli_jax.identification.unknowns import transforms

DETERMINED = 1.0
"""Relative sd below which a parameter is determined."""
_NODES = 160
"""Values of all inputs together that the search moves, at most."""
_SHARP = 300.0
"""Sharpness of the smooth maximum: it exceeds the maximum by log(values near it) / 300."""
CRITERIA = ("D", "A", "E")


class InputLimit(NamedTuple):
    """Limits of an input, in its SI unit."""

    amplitude: float
    rate: float = math.inf
    """Largest rate of change [1/s]; infinite: steps."""


@dataclass(frozen=True)
class Limits:
    """Limits of a flight.

    Attributes:
        inputs: inputs that are excited, by name.
        motion: largest absolute value of outputs and states by name, SI.
    """

    inputs: Mapping[str, InputLimit]
    motion: Mapping[str, float] = field(default_factory=dict)


class Rated(NamedTuple):
    """A manoeuvre with the accuracy that it gives."""

    words: str
    inputs: tuple[dict[str, np.ndarray], ...]
    """Excitations (N,) by flight and input, SI: without trim, and without feedback."""
    known: tuple[dict[str, float], ...]
    """Known differences of each flight."""
    value: float
    """Criterion, the logarithm of an sd; mean over the vehicles."""
    sd: dict[str, float]
    """Expected relative sd of each parameter (one over which it may be zero: in units of its
    start), the largest of all vehicles; infinite if it is not determined."""
    margins: dict[str, float]
    """1 - largest value over limit, by limit."""

    @property
    def undetermined(self) -> tuple[str, ...]:
        """Parameters that it does not determine."""
        return tuple(n for n, sd in self.sd.items() if not sd < DETERMINED)


class Design(NamedTuple):
    """The result of `design`."""

    criterion: str
    duration: float
    """Of all flights together [s]."""
    library: tuple[Rated, ...]
    """The best first."""
    optimum: Rated
    own: Rated | None
    """The inputs of the problem's flights, if they move."""
    converged: bool
    """True if the optimiser met its tolerance."""
    steps: int

    def needed(self, rated: Rated, wanted: Mapping[str, float]) -> float:
        """Return the duration [s] after which a manoeuvre, repeated, gives the wanted sds.

        Args:
            wanted: relative sds by parameter.

        Raises:
            ValueError: a parameter that is not free.
        """
        for name in wanted:
            if name not in rated.sd:
                raise ValueError(f"for {name}: it is not free{nearest(name, list(rated.sd))}")
        ratios = [rated.sd[n] / sd for n, sd in wanted.items()]
        # Repeated flights are independent: variances fall with their number.
        return self.duration * max(ratios) ** 2 if ratios else self.duration


def design(
    problem: Problem,
    limits: Limits,
    *,
    criterion: str = "D",
    differences: Mapping[str, tuple[float, float]] | None = None,
    feedback: Feedback | None = None,
    vehicles: int = 1,
    seed: int = 0,
    max_steps: int = 100,
    progress: Callable[[str], None] | None = None,
) -> Design:
    """Design the inputs of a problem's flights.

    Args:
        problem: output error or filter error. Its flights state the durations, the sample time, the
            measured outputs and their sd; their outputs may be zeros. Their inputs are rated too.
        limits: inputs to excite, and limits of the motion in calm air.
        criterion: "D", "A" or "E"; or a parameter, or a product such as "a/Ixx", whose sd is
            minimised.
        differences: known parameters of flights that the design chooses, with their lowest and
            highest values; for each flight that has the name in `known`.
        feedback: the loop that flies the vehicle, as in `simulate`. It receives the excitation as
            its inputs. The recorded inputs are those that act.
        vehicles: vehicles drawn from the priors or bounds of the free parameters; the design is for
            all of them. 1: the start values.
        seed: seed of the draw.
        max_steps: limit of the optimiser.

    Raises:
        ValueError: an unknown name, a limit that is not positive, or a method in frequency.
    """
    report = progress or (lambda _: None)
    _check(problem, limits, criterion, differences or {})
    guess = first_guess(problem)
    points = _points(problem, np.asarray(guess.z), vehicles, seed)
    experiment = planned(problem, guess.layout, guess.data, guess.noise, points, feedback)
    search = _Search(experiment, limits, criterion, differences or {})
    report("rating the library of inputs")
    rated = sorted(search.library(), key=lambda r: r.value)
    report(f"optimising {search.size} values from {rated[0].words}")
    optimum, converged, steps = search.optimise(rated[0], max_steps)
    moves = any(np.ptp(u) > 0 for f in problem.training for u in f.inputs.values())
    return Design(
        criterion=criterion,
        duration=sum(f.duration for f in problem.training),
        library=tuple(rated),
        optimum=optimum,
        own=search.own() if moves else None,
        converged=converged,
        steps=steps,
    )


def _check(
    problem: Problem,
    limits: Limits,
    criterion: str,
    differences: Mapping[str, tuple[float, float]],
) -> None:
    model = problem.model
    known = {
        "inputs": naming.names(model.Inputs),
        "motion": (*naming.names(model.Outputs), *naming.names(model.State)),
    }
    for kind, names in known.items():
        for name in getattr(limits, kind):
            if name not in names:
                raise ValueError(
                    f"limits.{kind}: model {model.name} has no {name!r}{nearest(name, names)}"
                )
    if not limits.inputs:
        raise ValueError("limits.inputs: expected an input to excite, got none")
    sizes = {n: v for n, limit in limits.inputs.items() for v in limit}
    for name, value in (*sizes.items(), *limits.motion.items()):
        if not value > 0:
            raise ValueError(f"limits: {name}: expected more than zero, got {value:g}")
    exponents(criterion, tuple(problem.free))
    for name, (low, high) in differences.items():
        if not any(name in f.known for f in problem.training):
            raise ValueError(f"differences: expected {name} among a flight's known, got none")
        if not low < high:
            raise ValueError(f"differences.{name}: expected low below high, got {low:g}, {high:g}")


def exponents(criterion: str, free: Sequence[str]) -> Float[np.ndarray, " p"] | None:
    """Return the exponents of a product such as `a/Ixx`; None for a criterion by letter.

    Raises:
        ValueError: a factor is no free parameter.
    """
    if criterion in CRITERIA:
        return None
    powers = np.zeros(len(free))
    for i, part in enumerate(criterion.split("/")):
        for name in part.split("*"):
            if name.strip() == "1" and i == 0:
                continue
            if name.strip() not in free:
                raise ValueError(
                    f"criterion: expected D, A, E or a product of {', '.join(free)}, such as "
                    f"{'/'.join(free[:2])}, got {criterion!r}"
                )
            powers[free.index(name.strip())] += -1.0 if i else 1.0
    return powers


def _points(problem: Problem, z: np.ndarray, vehicles: int, seed: int) -> Float[np.ndarray, "v q"]:
    """Return the unknowns of each vehicle; the first has the start values."""
    if vehicles < 1:
        raise ValueError(f"vehicles: expected 1 or more, got {vehicles}")
    points, rng = np.tile(z, (vehicles, 1)), np.random.default_rng(seed)
    for i, free in enumerate(problem.free.values()):
        for point in points[1:]:
            if (value := _drawn(free, rng)) is not None:
                at = transforms.coordinate(free, transforms.kind(free), value)
                point[i] = point[i] if at is None else at
    return points


def _drawn(free: Free, rng: np.random.Generator) -> float | None:
    """Return a value drawn from the prior, or between the bounds; None without both."""
    if free.prior is not None:
        return float(rng.normal(free.prior.mean, free.prior.sd))
    if free.lower is None or free.upper is None:
        return None
    if free.lower > 0:
        return float(np.exp(rng.uniform(np.log(free.lower), np.log(free.upper))))
    return float(rng.uniform(free.lower, free.upper))


class _Search:
    """The search over node values in [-1, 1], then over differences in [0, 1]."""

    def __init__(
        self,
        experiment: Experiment,
        limits: Limits,
        criterion: str,
        differences: Mapping[str, tuple[float, float]],
    ) -> None:
        self.experiment, self.limits, self.criterion = experiment, limits, criterion
        problem = experiment.problem
        self.powers = exponents(criterion, experiment.parameters)
        self.flights = problem.training
        # A linear model begins at rest with neutral inputs, a nonlinear one as the flight does.
        linear = problem.model.linear
        self.base = [
            {n: 0.0 if linear else float(u[0]) for n, u in f.inputs.items()} for f in self.flights
        ]
        self.varied = [
            (i, n, low, high)
            for i, f in enumerate(self.flights)
            for n, (low, high) in differences.items()
            if n in f.known
        ]
        inputs = len(self.flights) * len(limits.inputs)
        self.places, at = [], 0
        for flight in self.flights:
            by_input = {}
            for name, limit in limits.inputs.items():
                # With this spacing no ramp between two nodes exceeds the rate.
                least = max(flight.dt, 2.0 * limit.amplitude / limit.rate)
                spacing = max(least, flight.duration * inputs / _NODES)
                per_node = math.ceil(spacing / flight.dt - 1e-9)
                count = -(-flight.n_samples // per_node) + (limit.rate < math.inf)
                by_input[name] = (slice(at, at + count), per_node)
                at += count
            self.places.append(by_input)
        self.nodes, self.size = at, at + len(self.varied)
        self.value = jax.jit(jax.value_and_grad(self._value))
        self.rated = jax.jit(self._rated)
        self.smooth = jax.jit(self._smooth_ratios)
        self.slopes = jax.jit(jax.jacrev(self._smooth_ratios))

    def excitations(self, x: Any) -> tuple[dict[str, Any], ...]:
        """Return the excitations (N,) by flight and input, SI."""
        found = []
        for flight, places in zip(self.flights, self.places, strict=True):
            by_input, k = {}, np.arange(flight.n_samples)
            for name, (at, per_node) in places.items():
                limit, nodes = self.limits.inputs[name], x[at]
                u = nodes[k // per_node]
                if limit.rate < math.inf:
                    share = (k % per_node) / per_node
                    u = (1.0 - share) * u + share * nodes[k // per_node + 1]
                by_input[name] = limit.amplitude * u
            found.append(by_input)
        return tuple(found)

    def known(self, x: Any) -> tuple[dict[str, Any], ...]:
        """Return the known differences by flight."""
        found = tuple(dict[str, Any]() for _ in self.flights)
        for (i, name, low, high), share in zip(self.varied, x[self.nodes :], strict=True):
            found[i][name] = low + (high - low) * share
        return found

    def inputs(self, excitations: tuple[dict[str, Any], ...]) -> tuple[Any, ...]:
        """Return the model's Inputs by flight: excitations on the base."""
        Inputs = self.experiment.problem.model.Inputs
        return tuple(
            Inputs(
                **{
                    n: jnp.full(flight.n_samples, base[n]) + own.get(n, 0.0)
                    for n in naming.names(Inputs)
                }
            )
            for flight, base, own in zip(self.flights, self.base, excitations, strict=True)
        )

    def _of_covariance(self, C: Float[Array, "p p"]) -> Array:
        """Return the criterion of a covariance: the logarithm of an sd."""
        p = C.shape[0]
        if self.powers is not None:
            return 0.5 * jnp.log(self.powers @ C @ self.powers)
        if self.criterion == "D":
            return 0.5 * jnp.linalg.slogdet(C)[1] / p
        if self.criterion == "A":
            return 0.5 * jnp.log(jnp.trace(C) / p)
        return 0.5 * jnp.log(jnp.linalg.eigvalsh(C)[-1])

    def _value(self, x: Array) -> Array:
        inputs, known = self.inputs(self.excitations(x)), self.known(x)
        return jnp.mean(jax.vmap(self._of_covariance)(self.experiment.covariances(inputs, known)))

    def _rated(self, inputs: Any, known: Any) -> tuple[Array, Array, dict[str, Array]]:
        """Return the criterion, the largest sd of all vehicles, and the largest motion."""
        C = self.experiment.covariances(inputs, known)
        value = jnp.mean(jax.vmap(self._of_covariance)(C))
        sd = jnp.sqrt(jnp.max(jax.vmap(jnp.diagonal)(C), axis=0))
        return value, sd, self._largest(inputs, known, jnp.max)

    def _largest(
        self, inputs: Any, known: Any, largest: Callable[[Array], Array]
    ) -> dict[str, Array]:
        """Return the largest |motion| over its limit, over all flights and vehicles."""
        if not self.limits.motion:
            return {}

        def of_one(vehicle: Any) -> Any:
            return self.experiment.flown(vehicle, inputs, known).motion

        motion = jax.vmap(of_one)(self.experiment.vehicles)
        return {
            n: largest(jnp.concatenate([jnp.abs(m[n]).ravel() for m in motion]) / limit)
            for n, limit in self.limits.motion.items()
        }

    def _smooth_ratios(self, x: Array) -> Array:
        inputs, known = self.inputs(self.excitations(x)), self.known(x)

        def smooth(ratios: Array) -> Array:
            return jax.scipy.special.logsumexp(_SHARP * ratios) / _SHARP

        return jnp.stack(list(self._largest(inputs, known, smooth).values()))

    def rate(
        self, words: str, excitations: tuple[dict[str, np.ndarray], ...], known: Any
    ) -> Rated:
        """Return a manoeuvre, made smaller until its motion is within the limits."""
        for _ in range(30):
            value, sd, ratios = jax.device_get(self.rated(self.inputs(excitations), known))
            worst = max(ratios.values(), default=0.0)
            if worst <= 1.0:
                break
            # A diverged motion has no size.
            factor = 0.999999 / worst if np.isfinite(worst) else 0.1
            excitations = tuple({n: factor * u for n, u in own.items()} for own in excitations)
        if not np.isfinite(value):
            value, sd = np.inf, np.full(len(sd), np.inf)
        sd = {n: float(v) for n, v in zip(self.experiment.parameters, sd, strict=True)}
        margins = {n: 1.0 - float(v) for n, v in ratios.items()} | self._input_margins(excitations)
        known = tuple({n: float(v) for n, v in own.items()} for own in known)
        return Rated(words, excitations, known, float(value), sd, margins)

    def _input_margins(self, excitations: tuple[dict[str, np.ndarray], ...]) -> dict[str, float]:
        margins = {}
        for name, limit in self.limits.inputs.items():
            sizes, rates = [0.0], [0.0]
            for flight, own in zip(self.flights, excitations, strict=True):
                u = own.get(name, np.zeros(1))
                sizes.append(float(np.max(np.abs(u))))
                rates.append(float(np.max(np.abs(np.diff(u)), initial=0.0)) / flight.dt)
            margins[name] = 1.0 - max(sizes) / limit.amplitude
            if limit.rate < math.inf:
                margins[f"rate of {name}"] = 1.0 - max(rates) / limit.rate
        return margins

    def library(self) -> list[Rated]:
        """Return the manoeuvres of the library within the limits."""
        names, found = list(self.limits.inputs), []
        middle = self.known(np.full(self.size, 0.5))
        least = min(f.duration for f in self.flights)
        dt = max(f.dt for f in self.flights)
        rates = [limit.rate / limit.amplitude for limit in self.limits.inputs.values()]
        for manoeuvre in manoeuvres(len(names), least, dt):
            each = [
                manoeuvre.samples(f.n_samples, f.dt, rates) for f in self.flights
            ]
            by_flight = tuple(
                {n: self.limits.inputs[n].amplitude * row for n, row in zip(names, u, strict=True)}
                for u in each
            )
            found.append(self.rate(manoeuvre.words, by_flight, middle))
        return found

    def own(self) -> Rated:
        """Return the inputs of the problem's flights, as they are."""
        inputs = tuple(
            {n: u - base[n] for n, u in f.inputs.items()}
            for f, base in zip(self.flights, self.base, strict=True)
        )
        known = tuple({n: f.known[n] for n in own} for f, own in zip(
            self.flights, self.known(np.full(self.size, 0.5)), strict=True))
        value, sd, ratios = jax.device_get(self.rated(self.inputs(inputs), known))
        sd = {n: float(v) for n, v in zip(self.experiment.parameters, sd, strict=True)}
        margins = {n: 1.0 - float(v) for n, v in ratios.items()} | self._input_margins(inputs)
        return Rated("the flight's own inputs", inputs, known, float(value), sd, margins)

    def optimise(self, start: Rated, max_steps: int) -> tuple[Rated, bool, int]:
        """Return the optimum, whether the search converged, and its steps."""
        from scipy.optimize import minimize

        x = np.full(self.size, 0.5)
        for flight, places, own in zip(self.flights, self.places, start.inputs, strict=True):
            for name, (at, per_node) in places.items():
                k = np.minimum(np.arange(at.stop - at.start) * per_node, flight.n_samples - 1)
                x[at] = own[name][k] / self.limits.inputs[name].amplitude
        bounds = [(-1.0, 1.0)] * self.nodes + [(0.0, 1.0)] * len(self.varied)
        constraints = []
        if self.limits.motion:
            constraints.append(
                {
                    "type": "ineq",
                    "fun": lambda x: 1.0 - np.asarray(self.smooth(x)),
                    "jac": lambda x: -np.asarray(self.slopes(x)),
                }
            )
        # SLSQP begins with the unit matrix for the Hessian, so the gradient must be of order one.
        unit = 1.0 / max(float(np.max(np.abs(self.value(x)[1]))), 1e-12)
        found = minimize(
            lambda x: tuple(unit * np.asarray(v, float) for v in self.value(x)),
            x,
            jac=True,
            method="SLSQP",
            bounds=bounds,
            constraints=constraints,
            options={"maxiter": max_steps, "ftol": 1e-4 * unit},
        )
        best = np.clip(found.x, *np.array(bounds).T)
        inputs = tuple(
            {n: np.asarray(u) for n, u in own.items()} for own in self.excitations(best)
        )
        rated = self.rate("optimised input", inputs, self.known(best))
        # The library's best may be sharper than the nodes allow.
        if not rated.value <= start.value:
            rated = start
        return rated, bool(found.success), int(found.nit)
