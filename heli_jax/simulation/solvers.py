"""Solver classes of our own: one step a sample, named scalar leaves.

A Runge-Kutta method that reads a held input by time sees the next sample in its last stage, an
error of first order. Here the input of an interval is picked once and held while the step is made;
one that is linear between samples is followed along its line by every stage.
"""

import abc
from collections.abc import Callable, Sequence
from typing import Any, ClassVar, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int, PyTree, Real

from heli_jax.errors import nearest
from heli_jax.naming import Record, Scalar
from heli_jax.simulation.discretize import Discrete
from heli_jax.simulation.hold import Delays, at, delayed, segments

type Time = Real[Array, ""] | Real[np.ndarray, ""] | int | float
"""as diffrax takes it, which has no NumPy scalars among its types"""


class ZeroOrderHoldArgs(NamedTuple):
    """Arguments of a step: the parameters, and the inputs sample by sample.

    `inputs` holds arrays (N,). `delays` is None, or by how many samples each of them acts later
    than given. `dt` [s] is the sample time.
    """

    params: Record
    inputs: Record
    dt: Array
    delays: Delays | None
    discrete: Discrete | None

    def in_scalars(self) -> "ZeroOrderHoldArgs":
        """Return the arguments as a solver steps with them."""
        if self.discrete is None:
            return self
        return self._replace(discrete=self.discrete.in_scalars())


def acting_at(args: ZeroOrderHoldArgs, k: Int[Array, ""] | int, linear: tuple[bool, ...]) -> Record:
    """The inputs as they act at sample k."""
    if args.delays is None:
        return at(args.inputs, k)
    return delayed(args.inputs, args.delays, k, linear)


class IntervalArgs(NamedTuple):
    """The arguments of a vector field within one interval: parameters and the held inputs."""

    params: Record
    inputs: Record


class RampArgs(NamedTuple):
    """Arguments as `IntervalArgs`, for inputs that move: at the begin of a step, and their slope
    per second."""

    params: Record
    inputs: Record
    slope: Record

    def after(self, t: Time) -> "RampArgs":
        """Return the arguments t [s] later."""
        inputs = jax.tree.map(lambda u, slope: u + slope * t, self.inputs, self.slope)
        return self._replace(inputs=inputs)


def sample_index(t: Time) -> Int[Array, ""]:
    """The sample that an interval begins with, from its time in samples."""
    # Time is counted in samples, and a step begins at one of them but for rounding: in float32 that
    # is more than a thousandth of a sample from 16,000 on.
    return jnp.round(t).astype(int)


# The arguments of `init`, `func` and `step` are those of diffrax.AbstractSolver: terms, times, the
# state y0 and `args`. Time is counted in samples in the solvers of a whole sample, in seconds from
# the begin of a step within it.


type Stepped = tuple[PyTree, dfx.RESULTS]


class _Stateless(dfx.AbstractSolver):
    """Base of the solvers here: straight lines between samples, nothing kept between steps."""

    term_structure: ClassVar = dfx.AbstractTerm
    interpolation_cls: ClassVar[Callable[..., dfx.LocalLinearInterpolation]] = (
        dfx.LocalLinearInterpolation
    )

    def init(self, terms: dfx.AbstractTerm, t0: Time, t1: Time, y0: PyTree, args: PyTree) -> None:
        return None

    def step(
        self,
        terms: dfx.AbstractTerm,
        t0: Time,
        t1: Time,
        y0: PyTree,
        args: PyTree,
        solver_state: PyTree,
        made_jump: bool | Bool[Array, ""],
    ) -> Any:
        """One step, in the five parts that diffrax asks for."""
        y1, result = self.stepped(terms, t0, t1, y0, args)
        return y1, None, {"y0": y0, "y1": y1}, None, result

    @abc.abstractmethod
    def stepped(
        self, terms: dfx.AbstractTerm, t0: Time, t1: Time, y0: PyTree, args: PyTree
    ) -> Stepped:
        """The state at t1 and diffrax's result."""


class SolverWrapper(_Stateless):
    """A solver of whole samples around another (see also `heli_jax.simulation.simulate`)."""

    solver: Any
    """one of ours; that of `PerSample` any of diffrax's"""

    def order(self, terms: dfx.AbstractTerm) -> int | None:
        return self.solver.order(terms)

    def func(self, terms: dfx.AbstractTerm, t0: Time, y0: PyTree, args: PyTree) -> Any:
        return y0


class Exact(_Stateless):
    """Exact for linear models, held inputs or linear ones: a recurrence of scalar coefficients."""

    def order(self, terms: dfx.AbstractTerm) -> None:
        # No error to have an order: diffrax takes None where nobody asks for one.
        return None

    def func(self, terms: dfx.AbstractTerm, t0: Time, y0: PyTree, args: PyTree) -> Any:
        return terms.vf(t0, y0, IntervalArgs(args.params, at(args.inputs, sample_index(t0))))

    def stepped(
        self, terms: dfx.AbstractTerm, t0: Time, t1: Time, y0: PyTree, args: ZeroOrderHoldArgs
    ) -> Stepped:
        """One sample of the recurrence."""
        assert args.discrete is not None
        # Whole samples of a delay shift the inputs; the rest of it is in Bd and Bp.
        k, late = sample_index(t0), args.delays
        ahead = args.discrete.Bn is not None
        before = None if late is None else jax.tree.leaves(at(args.inputs, k - 1, late))
        after = jax.tree.leaves(at(args.inputs, k + 1, late)) if ahead else None
        u = jax.tree.leaves(at(args.inputs, k, late))
        new = advance(args.discrete, jax.tree.leaves(y0), u, before, after)
        y1 = jax.tree.unflatten(jax.tree.structure(y0), new)
        return y1, dfx.RESULTS.successful


def advance(
    discrete: Discrete,
    x: Sequence[Scalar],
    u: Sequence[Scalar],
    before: Sequence[Scalar] | None = None,
    after: Sequence[Scalar] | None = None,
) -> list[Scalar]:
    """x[k+1] from x[k] and the inputs.

    Args:
        before: those of the sample before, where the recurrence has a Bp.
        after: those of the next sample, where it has a Bn.
    """
    # Sums of scalars and not a matrix product: under vmap each is a vector over the batch, which
    # XLA fuses into one loop. A product of many 4x4 matrices calls a routine for each of them.
    new = [dot(a, x) + dot(b, u) for a, b in zip(discrete.Ad, discrete.Bd, strict=True)]
    if discrete.Bp is not None:
        assert before is not None
        new = [v + dot(b, before) for v, b in zip(new, discrete.Bp, strict=True)]
    if discrete.Bn is not None:
        assert after is not None
        new = [v + dot(b, after) for v, b in zip(new, discrete.Bn, strict=True)]
    return new


def dot(coefficients: Sequence[Scalar], values: Sequence[Scalar]) -> Scalar:
    """The sum of products of two lists of scalars, term by term from the first."""
    # Not sum(): that begins with a 0, and an addition more at each step.
    total = coefficients[0] * values[0]
    for c, v in zip(coefficients[1:], values[1:], strict=True):
        total = total + c * v
    return total


class RK4(_Stateless):
    """The classical Runge-Kutta method of fourth order on named scalar leaves.

    `rolled` makes the four stages a loop: a quarter of the code to compile, and somewhat slower.
    """

    rolled: bool = eqx.field(static=True, default=False)

    def order(self, terms: dfx.AbstractTerm) -> int:
        return 4

    def func(self, terms: dfx.AbstractTerm, t0: Time, y0: PyTree, args: PyTree) -> Any:
        return terms.vf(t0, y0, args)

    def stepped(
        self, terms: dfx.AbstractTerm, t0: Time, t1: Time, y0: PyTree, args: PyTree
    ) -> Stepped:
        """One step of the method."""
        h: Any = t1 - t0

        # Written here although diffrax has Runge-Kutta methods: those stack the stages into arrays,
        # which XLA does not fuse into one loop over a batch of vehicles.
        def f(t: Time, y: PyTree) -> Any:
            # Behind a barrier each slope is computed once: without it XLA computes all of them
            # again for every state variable.
            return jax.lax.optimization_barrier(terms.vf(t, y, args))

        def along(y: PyTree, slope: PyTree, step: Time) -> PyTree:
            return jax.tree.map(lambda a, b: a + step * b, y, slope)

        # The slopes at t0, twice halfway and at t1; weights 1, 2, 2, 1 over 6.
        if self.rolled:
            y1 = self._rolled(f, along, t0, h, y0)
            return y1, dfx.RESULTS.successful
        k1 = f(t0, y0)
        k2 = f(t0 + 0.5 * h, along(y0, k1, 0.5 * h))
        k3 = f(t0 + 0.5 * h, along(y0, k2, 0.5 * h))
        k4 = f(t1, along(y0, k3, h))
        y1 = jax.tree.map(
            lambda y, a, b, c, d: y + (h / 6.0) * (a + 2.0 * (b + c) + d), y0, k1, k2, k3, k4
        )
        return y1, dfx.RESULTS.successful

    @staticmethod
    def _rolled(
        f: Callable[..., Any], along: Callable[..., Any], t0: Time, h: Array, y0: PyTree
    ) -> PyTree:
        # Stage i stands on the slope of stage i - 1 alone, so a loop can carry it; the first has a
        # reach of zero, and any slope will do.
        def stage(carry: PyTree, node: tuple[Array, Array]) -> tuple[PyTree, None]:
            total, slope = carry
            reach, weight = node
            slope = f(t0 + reach * h, along(y0, slope, reach * h))
            return (along(total, slope, weight * h), slope), None

        reach = jnp.asarray([0.0, 0.5, 0.5, 1.0], h.dtype)
        weight = jnp.asarray([1.0, 2.0, 2.0, 1.0], h.dtype) / 6.0
        nothing = jax.tree.map(jnp.zeros_like, y0)
        (y1, _), _ = jax.lax.scan(stage, (y0, nothing), (reach, weight))
        return y1


type _Part = tuple[Array, IntervalArgs | RampArgs]


class PerSample(SolverWrapper):
    """Any solver inside one sample: `substeps` equal steps.

    With a delayed input the interval has two parts, before and after the change of the input,
    with `substeps` steps each.
    """

    substeps: int = eqx.field(static=True)
    linear: tuple[bool, ...] = eqx.field(static=True, default=(), kw_only=True)
    """of each input whether it is linear between samples; () holds all"""

    def func(self, terms: dfx.AbstractTerm, t0: Time, y0: PyTree, args: PyTree) -> Any:
        return self.solver.func(
            terms, t0, y0, IntervalArgs(args.params, at(args.inputs, sample_index(t0)))
        )

    def stepped(
        self, terms: dfx.AbstractTerm, t0: Time, t1: Time, y0: PyTree, args: ZeroOrderHoldArgs
    ) -> Stepped:
        """One sample in its parts."""
        # The first failure counts: what comes after it is no news.
        y, result = y0, dfx.RESULTS.successful
        for length, now in self._parts(args, sample_index(t0)):
            y, part = self._steps(terms, length / self.substeps, y, now)
            result = dfx.RESULTS.where(result == dfx.RESULTS.successful, part, result)
        return y, result

    def _parts(self, args: ZeroOrderHoldArgs, k: Int[Array, ""]) -> list[_Part]:
        """The parts of the interval from sample k on: how long [s], and with which inputs."""
        # A line across a sample is one part; late by a fraction, it bends within the interval. Each
        # part has its own steps and ends where an input jumps: a step across the jump would be of
        # first order, whatever the method's.
        parts = segments(args.inputs, args.dt, args.delays, k, self.linear)
        if self.linear:
            return [(p.length, RampArgs(args.params, p.inputs, p.slope)) for p in parts]
        return [(p.length, IntervalArgs(args.params, p.inputs)) for p in parts]

    def _steps(
        self, terms: dfx.AbstractTerm, h: Array, y0: PyTree, now: IntervalArgs | RampArgs
    ) -> Any:
        """`substeps` steps of h [s]. Nothing depends on time while the input is held, and where it
        moves it is counted from the step's begin, so each begins at 0: a step length that is the
        same number in all steps makes the code faster.
        """
        begin = jnp.zeros_like(h)

        def body(carry: PyTree, j: Any) -> tuple[PyTree, None]:
            y, result = carry
            here = now.after(j * h) if isinstance(now, RampArgs) else now
            state = self.solver.init(terms, begin, h, y, here)
            y, _, _, _, part = self.solver.step(terms, begin, h, y, here, state, False)
            return (y, dfx.RESULTS.where(result == dfx.RESULTS.successful, part, result)), None

        carry = (y0, dfx.RESULTS.successful)
        steps = jnp.arange(self.substeps, dtype=h.dtype) if isinstance(now, RampArgs) else None
        (y, result), _ = jax.lax.scan(body, carry, steps, length=self.substeps)
        return y, result


class Adaptive(PerSample):
    """A diffrax solver with a step-size controller inside one sample."""

    controller: dfx.AbstractStepSizeController
    adjoint: dfx.AbstractAdjoint
    max_steps: int = eqx.field(static=True)

    def _steps(
        self, terms: dfx.AbstractTerm, h: Array, y0: PyTree, now: IntervalArgs | RampArgs
    ) -> Any:
        sol = dfx.diffeqsolve(
            terms,
            self.solver,
            t0=jnp.zeros_like(h),
            t1=self.substeps * h,
            dt0=None,  # the controller chooses a first step anew in each interval: inputs jump
            y0=y0,
            args=now,
            saveat=dfx.SaveAt(t1=True),
            stepsize_controller=self.controller,
            max_steps=self.max_steps,
            adjoint=self.adjoint,
            throw=False,
        )
        # A sample cut short by a delay may have no length at all, and then nothing happens.
        reached = jax.tree.map(lambda a, b: jnp.where(h > 0, a[-1], b), sol.ys, y0)
        fine = dfx.RESULTS.where(h > 0, sol.result, dfx.RESULTS.successful)
        return reached, fine


# An implicit one needs a root finder with tolerances, which a name cannot give.
NAMED = ("Euler", "Midpoint", "Heun", "Ralston", "Bosh3", "Tsit5", "Dopri5", "Dopri8")
"""Solvers of diffrax that have a name here: explicit ones, of fixed steps."""


def solver_named(name: str) -> str | dfx.AbstractSolver:
    """ "exact", "rk4", or a diffrax solver of fixed steps by its name there, such as "Tsit5".

    Raises:
        ValueError: there is none of that name.
    """
    if name in ("exact", "rk4"):
        return name
    if name in NAMED:
        return getattr(dfx, name)()
    known = ("exact", "rk4", *NAMED)
    raise ValueError(f"solver: unknown solver {name!r}{nearest(name, known)}")
