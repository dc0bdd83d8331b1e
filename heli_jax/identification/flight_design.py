"""Design of a flight: the inputs within limits that determine the parameters best.

The candidates of the library are compared first. From the best two, SciPy's L-BFGS-B searches over
values of the inputs at nodes, with gradients in reverse mode. Limits of deflections are bounds.
Limits of rates and of the motion hold along the whole flight, by an augmented Lagrangian: the
largest value over time is replaced by a smooth one that is never smaller (Kreisselmeier and
Steinhauser, 1979).
Sources: Mehra (1974); Goodwin and Payne (1977) for the criteria.
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
from heli_jax.identification.design.accuracy import DETERMINES, unstated_gusts
from heli_jax.identification.design.information import Experiment, Feedback, Outcome, planned
from heli_jax.identification.design.library import Manoeuvre, manoeuvres
from heli_jax.identification.estimation.data import data_of, start_vector
from heli_jax.identification.estimation.noise_covariance import first_noise, likely_gusts
from heli_jax.identification.identifiability.verdict import exponents
from heli_jax.identification.problem import Free, Problem
from heli_jax.identification.unknowns import transforms
from heli_jax.identification.unknowns.layout import Solution, layout_of
from heli_jax.numerics.constrained import lagrangian, minimise

_NODES = 2000
"""Values of all inputs together that the search moves, at most."""
_STARTS = 2
"""Inputs of the library from which the search starts, the best first."""
_SHARP = 300.0
"""Sharpness of the smooth maximum: it exceeds the maximum by log(values near it) / 300."""
_MOST_TIMES = 1e4
"""Repetitions after which more do not help."""
_GROWTH = 10.0
"""Length of a flight over the time constant of a growing mode, at most: a deviation grows by
exp(10)."""
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
        motion: largest absolute value of outputs, states and acting inputs by name, SI.
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
    """Expected sd of each parameter relative to its value, or to its start if it may be zero: the
    largest of all vehicles, infinite for a motion that diverges."""
    margins: dict[str, float]
    """1 - largest value over limit, by limit."""
    covariance: Float[np.ndarray, "v p p"]
    """Covariance of the parameters in relative coordinates, for each vehicle."""
    motion: tuple[dict[str, np.ndarray], ...]
    """Outputs and states (N,) of the first vehicle in calm air, by flight, SI."""
    manoeuvre: Manoeuvre | None = None
    """Manoeuvre of the library that it is, if any."""

    @property
    def undetermined(self) -> tuple[str, ...]:
        """Parameters that it does not determine."""
        return tuple(n for n, sd in self.sd.items() if not sd < DETERMINES)


class Design(NamedTuple):
    """The result of `design`."""

    criterion: str
    duration: float
    """Duration of all flights together [s]."""
    library: tuple[Rated, ...]
    """The best first."""
    optimum: Rated
    own: Rated | None
    """The user's inputs, if any."""
    converged: bool
    """True if the optimiser met its tolerance."""
    steps: int

    priors: Float[np.ndarray, "v p p"]
    """Information of the priors, for each vehicle."""

    def sd_of(self, rated: Rated, product: str, times: float = 1.0) -> float:
        """Return the relative sd of a product such as `a/Ixx`, the largest of all vehicles.

        Args:
            product: free parameters with `*` and `/`.
            times: repetitions of the flights.

        Raises:
            ValueError: a factor is no free parameter.
        """
        powers = exponents(product, tuple(rated.sd))
        if not np.isfinite(rated.value):
            return math.inf
        # Repeated flights are independent, so their information adds up.
        data = np.linalg.inv(rated.covariance) - self.priors
        C = np.linalg.inv(times * data + self.priors)
        return float(np.sqrt(np.max(powers @ C @ powers)))

    def needed(self, rated: Rated, wanted: Mapping[str, float]) -> float:
        """Return the duration [s] after which a manoeuvre, repeated, gives the wanted sds: that of
        one run at least.

        It is infinite if no duration does, as for a parameter that only its prior determines.

        Args:
            wanted: relative sds by parameter or product.

        Raises:
            ValueError: a parameter that is not free.
        """

        def enough(times: float) -> bool:
            return all(self.sd_of(rated, n, times) <= sd for n, sd in wanted.items())

        if not enough(_MOST_TIMES):
            return math.inf
        if enough(1.0):
            return self.duration
        low, high = 0.0, math.log(_MOST_TIMES)
        for _ in range(40):
            middle = 0.5 * (low + high)
            low, high = (low, middle) if enough(math.exp(middle)) else (middle, high)
        return self.duration * math.exp(high)


def design(
    problem: Problem,
    limits: Limits,
    *,
    criterion: str = "D",
    own: Sequence[Mapping[str, np.ndarray]] | None = None,
    rest: Mapping[str, float] | None = None,
    differences: Sequence[Mapping[str, tuple[float, float]]] | None = None,
    feedback: Feedback | None = None,
    chirps: Sequence[str] = ("chirp",),
    vehicles: int = 1,
    seed: int = 0,
    max_steps: int = 400,
    progress: Callable[[str], None] | None = None,
) -> Design:
    """Design the inputs of a problem's flights.

    Args:
        problem: output error or filter error. Its flights state the durations, the sample time, the
            measured outputs and their sd.
        limits: inputs to excite, and limits of the motion in calm air.
        criterion: "D", "A" or "E"; or a parameter, or a product such as "a/Ixx", whose sd is
            minimised.
        own: excitations (N,) of the user by flight and input, SI, which are rated too.
        rest: values of the inputs about which the excitations move, SI; default: zero for a linear
            model, else the first sample.
        differences: for each flight, known parameters that the design chooses, with their lowest
            and highest values.
        feedback: the loop that flies the vehicle, as in `simulate`. It receives the excitation as
            its inputs. The recorded inputs are those that act.
        chirps: kinds of chirps in the library, such as those that autopilots play.
        vehicles: vehicles drawn from the priors or bounds of the free parameters; the design is for
            all of them. 1: the start values.
        seed: seed of the draw.
        max_steps: limit of the optimiser from each start; 0: only the library is rated.

    Raises:
        ValueError: an unknown name, a limit that is not positive or that the vehicle exceeds
            without excitation, a vehicle that diverges, or a method in frequency.
    """
    report = progress or (lambda _: None)
    if problem.noise_model == "spectrum" or problem.window is not None:
        raise ValueError(
            "method: expected output-error or filter-error without windows, got "
            f"{problem.method}{' with windows' if problem.window else ''}"
        )
    chosen = [{} for _ in problem.training] if differences is None else differences
    _check(problem, limits, criterion, chosen)
    layout = layout_of(problem, problem.training)
    data = data_of(problem, problem.training, layout)
    noise = first_noise(problem, problem.training)
    z = start_vector(layout, data, problem)
    if unstated_gusts(problem):
        z, _ = likely_gusts(Solution(layout, data, noise, z))
    points = _points(problem, np.asarray(z), vehicles, seed)
    experiment = planned(problem, layout, data, noise, points, feedback)
    search = _Search(experiment, limits, criterion, chosen, rest or {})
    search.check()
    report("rating the library of inputs")
    rated = sorted(search.library(chirps), key=lambda r: r.value)
    optimum, converged, steps = rated[0], True, 0
    if max_steps:
        found = []
        for start in rated[:_STARTS]:
            report(f"optimising {search.size} values from {start.words}")
            found.append(search.optimise(start, max_steps))
        optimum, converged, steps = min(found, key=lambda one: one[0].value)
    return Design(
        criterion=criterion,
        duration=sum(f.duration for f in problem.training),
        library=tuple(rated),
        optimum=optimum,
        own=None if own is None else search.own(own),
        converged=converged,
        steps=steps,
        priors=search.priors,
    )


def _check(
    problem: Problem,
    limits: Limits,
    criterion: str,
    differences: Sequence[Mapping[str, tuple[float, float]]],
) -> None:
    model = problem.model
    known = {
        "inputs": naming.names(model.Inputs),
        "motion": sum(map(naming.names, (model.Outputs, model.State, model.Inputs)), ()),
    }
    for kind, names in known.items():
        for name in getattr(limits, kind):
            if name not in names:
                raise ValueError(
                    f"limits.{kind}: model {model.name} has no {name!r}{nearest(name, names)}"
                )
    if not limits.inputs:
        raise ValueError("limits.inputs: expected an input to excite, got none")
    sizes = [(n, v) for n, limit in limits.inputs.items() for v in limit]
    for name, value in (*sizes, *limits.motion.items()):
        if not value > 0:
            raise ValueError(f"limits: {name}: expected more than zero, got {value:g}")
    if criterion not in CRITERIA:
        try:
            exponents(criterion, tuple(problem.free))
        except ValueError as e:
            raise ValueError(f"criterion: expected D, A, E, or a product; {e}") from e
    if len(differences) != len(problem.training):
        raise ValueError(
            f"differences: expected one for each of {len(problem.training)} flights, got "
            f"{len(differences)}"
        )
    for own, flight in zip(differences, problem.training, strict=True):
        for name, (low, high) in own.items():
            if name not in flight.known:
                raise ValueError(f"differences: expected {name} among the flight's known, got none")
            if not low < high:
                raise ValueError(
                    f"differences: {name}: expected the lowest value first, got {low:g}, {high:g}"
                )


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
        differences: Sequence[Mapping[str, tuple[float, float]]],
        rest: Mapping[str, float],
    ) -> None:
        self.experiment, self.limits, self.criterion = experiment, limits, criterion
        problem = experiment.problem
        self.powers = None if criterion in CRITERIA else exponents(criterion, experiment.parameters)
        p = len(experiment.parameters)
        self.priors = np.square(np.asarray(experiment.vehicles.rows)[:, :p, :p])
        self.flights = problem.training
        # A linear model begins at rest with neutral inputs, a nonlinear one as the flight does.
        linear = problem.model.linear
        self.base = [
            {n: rest.get(n, 0.0 if linear else float(u[0])) for n, u in f.inputs.items()}
            for f in self.flights
        ]
        self.varied = [
            (i, n, low, high) for i, own in enumerate(differences) for n, (low, high) in own.items()
        ]
        self.rates = {n: u.rate for n, u in limits.inputs.items() if u.rate < math.inf}
        inputs = len(self.flights) * len(limits.inputs)
        self.places, at = [], 0
        for flight in self.flights:
            by_input = {}
            for name in limits.inputs:
                spacing = max(flight.dt, 0.1, flight.duration * inputs / _NODES)
                per_node = math.ceil(spacing / flight.dt - 1e-9)
                count = -(-(flight.n_samples - 1) // per_node)
                by_input[name] = (slice(at, at + count), per_node)
                at += count
            self.places.append(by_input)
        self.nodes, self.size = at, at + len(self.varied)
        self.rated = jax.jit(self._rated)
        self.augmented = jax.jit(jax.value_and_grad(self._augmented, has_aux=True))

    def excitations(self, x: Any) -> tuple[dict[str, Any], ...]:
        """Return the excitations (N,) by flight and input, SI. They begin at zero, as before the
        flight."""
        found = []
        for flight, places in zip(self.flights, self.places, strict=True):
            by_input, k = {}, np.arange(flight.n_samples)
            for name, (at, per_node) in places.items():
                limit, nodes = self.limits.inputs[name], jnp.concatenate([jnp.zeros(1), x[at]])
                u = nodes[-(-k // per_node)]
                if name in self.rates:
                    share = (-k % per_node) / per_node
                    u = (1.0 - share) * u + share * nodes[k // per_node]
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

    def _rated(
        self, inputs: Any, known: Any, largest: Callable[[Array], Array] = jnp.max
    ) -> tuple[Array, Outcome, Float[Array, " m"]]:
        """Return the criterion, what the vehicles do, and the largest |motion| over its limit, over
        all flights and vehicles."""
        outcome = self.experiment.outcome(inputs, known)
        value = jnp.mean(jax.vmap(self._of_covariance)(outcome.covariance))
        parts = (*outcome.motion, *outcome.before)
        ratios = [
            largest(jnp.concatenate([jnp.abs(m[n]).ravel() for m in parts if n in m]) / limit)
            for n, limit in self.limits.motion.items()
        ]
        return value, outcome, jnp.array(ratios, value.dtype)

    def _augmented(self, x: Array, multipliers: Array, penalty: Array) -> tuple[Array, Array]:
        """Return the criterion with an augmented Lagrangian of the limits, and their excess."""

        def smooth(ratios: Array) -> Array:
            return jax.scipy.special.logsumexp(_SHARP * ratios) / _SHARP

        excitations = self.excitations(x)
        value, _, ratios = self._rated(self.inputs(excitations), self.known(x), smooth)
        rates = []
        for name, rate in self.rates.items():
            each = zip(self.flights, excitations, strict=True)
            slopes = [jnp.diff(own[name], prepend=0.0) / flight.dt for flight, own in each]
            rates.append(smooth(jnp.abs(jnp.concatenate(slopes)) / rate))
        ratios = jnp.concatenate([ratios, jnp.array(rates, ratios.dtype)])
        return lagrangian(value, ratios - 1.0, multipliers, penalty), ratios - 1.0

    def rate(self, words: str, excitations: tuple[dict[str, np.ndarray], ...], known: Any) -> Rated:
        """Return a manoeuvre, made smaller until its motion is within the limits."""
        for _ in range(30):
            rated = self._as_rated(words, excitations, known)
            worst = 1.0 - float(np.min(list(rated.margins.values())))
            if worst <= 1.0:
                break
            # A diverged motion has no size.
            factor = 0.999999 / worst if np.isfinite(worst) else 0.1
            excitations = tuple({n: factor * u for n, u in own.items()} for own in excitations)
        return rated

    def _as_rated(
        self, words: str, excitations: tuple[dict[str, np.ndarray], ...], known: Any
    ) -> Rated:
        """Return excitations with the accuracy they give, and their margins."""
        value, (C, motion, _), ratios = jax.device_get(self.rated(self.inputs(excitations), known))
        if not np.isfinite(C).all():
            value, C = np.inf, np.full(C.shape, np.inf)
        sd = np.sqrt(np.max(C.diagonal(axis1=1, axis2=2), axis=0))
        sd = {n: float(v) for n, v in zip(self.experiment.parameters, sd, strict=True)}
        margins = {n: 1.0 - float(v) for n, v in zip(self.limits.motion, ratios, strict=True)}
        margins |= self._input_margins(excitations)
        known = tuple({n: float(v) for n, v in own.items()} for own in known)
        first = tuple({n: v[0] for n, v in of_flight.items()} for of_flight in motion)
        return Rated(words, excitations, known, float(value), sd, margins, C, first)

    def _input_margins(self, excitations: tuple[dict[str, np.ndarray], ...]) -> dict[str, float]:
        margins = {}
        for name, limit in self.limits.inputs.items():
            sizes, rates = [0.0], [0.0]
            for flight, own in zip(self.flights, excitations, strict=True):
                u = own.get(name, np.zeros(1))
                sizes.append(float(np.max(np.abs(u))))
                rates.append(float(np.max(np.abs(np.diff(u, prepend=0.0)))) / flight.dt)
            key = f"excitation of {name}" if name in self.limits.motion else name
            margins[key] = 1.0 - max(sizes) / limit.amplitude
            if name in self.rates:
                margins[f"rate of {name}"] = 1.0 - max(rates) / limit.rate
        return margins

    def check(self) -> None:
        """Refuse a vehicle that exceeds a limit or diverges without excitation.

        Raises:
            ValueError: names the state, its value and the limit, or the time constant.
        """
        from scipy.linalg import eigvals

        experiment, duration = self.experiment, max(f.duration for f in self.flights)
        growing = max(float(np.max(eigvals(A).real)) for A in experiment.state_matrices())
        if growing * duration > _GROWTH:
            raise ValueError(
                f"the vehicle diverges: a mode grows with a time constant of {1.0 / growing:.3g} s "
                f"in a flight of {duration:.4g} s, expected a feedback or at most "
                f"{_GROWTH / growing:.3g} s"
            )
        none = tuple(dict[str, np.ndarray]() for _ in self.flights)
        at_rest = self._as_rated("", none, self.known(np.full(self.size, 0.5)))
        for name, limit in self.limits.motion.items():
            if not at_rest.margins[name] > 0.0:
                reached = (1.0 - at_rest.margins[name]) * limit
                raise ValueError(
                    f"limits.motion: {name} reaches {reached:.4g} without any excitation, expected "
                    f"less than its limit of {limit:.4g}"
                )

    def library(self, chirps: Sequence[str]) -> list[Rated]:
        """Return the manoeuvres of the library within the limits."""
        names, found = list(self.limits.inputs), []
        middle = self.known(np.full(self.size, 0.5))
        least = min(f.duration for f in self.flights)
        dt = max(f.dt for f in self.flights)
        rates = [limit.rate / limit.amplitude for limit in self.limits.inputs.values()]
        for manoeuvre in manoeuvres(len(names), least, dt, chirps):
            each = [manoeuvre.samples(f.n_samples, f.dt, rates) for f in self.flights]
            by_flight = tuple(
                {n: self.limits.inputs[n].amplitude * row for n, row in zip(names, u, strict=True)}
                for u in each
            )
            rated = self.rate(manoeuvre.words, by_flight, middle)
            found.append(rated._replace(manoeuvre=manoeuvre))
        return found

    def own(self, excitations: Sequence[Mapping[str, np.ndarray]]) -> Rated:
        """Return the user's excitations, as they are."""
        given = tuple(dict(own) for own in excitations)
        known = self.known(np.full(self.size, 0.5))
        return self._as_rated("your own inputs", given, known)

    def optimise(self, start: Rated, max_steps: int) -> tuple[Rated, bool, int]:
        """Return the optimum, whether the search converged, and its steps."""
        x = np.full(self.size, 0.5)
        for flight, places, own in zip(self.flights, self.places, start.inputs, strict=True):
            for name, (at, per_node) in places.items():
                k = np.arange(1, at.stop - at.start + 1) * per_node
                k = np.minimum(k, flight.n_samples - 1)
                # All values at their bounds may be a corner from which no step leads.
                x[at] = 0.5 * own[name][k] / self.limits.inputs[name].amplitude
        bounds = [(-1.0, 1.0)] * self.nodes + [(0.0, 1.0)] * len(self.varied)
        limits = len(self.limits.motion) + len(self.rates)
        best, converged, steps = minimise(self.augmented, x, limits, bounds, max_steps)
        inputs = tuple({n: np.asarray(u) for n, u in own.items()} for own in self.excitations(best))
        rated = self.rate("optimised input", inputs, self.known(best))
        # The library's best may be sharper than the nodes allow.
        if not rated.value <= start.value:
            rated = start
        return rated, converged, steps
