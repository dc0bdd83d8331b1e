"""Solvers with one step a sample and named scalar leaves.

A Runge-Kutta method that reads a held input by time uses the next sample in its last stage, a
first-order error. Here the input is read once for an interval and held during the step. For an
input that is linear between samples, every stage uses the value on the line.
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

from heli_jax.dynamics.model import Sampled
from heli_jax.errors import nearest
from heli_jax.naming import Record, Scalar
from heli_jax.simulation.discretize import Discrete
from heli_jax.simulation.hold import Delays, at, delayed, segments

type Time = Real[Array, ""] | Real[np.ndarray, ""] | int | float
"""Time as diffrax accepts it, which excludes NumPy scalars."""


class ZeroOrderHoldArgs(NamedTuple):
    """Arguments of a step: the parameters, and the inputs sample by sample.

    `inputs` holds arrays (N,). `delays` is None, or the delay of each input in samples. `dt` [s] is
    the sample time.
    """

    params: Record
    inputs: Record
    dt: Array
    delays: Delays | None
    discrete: Discrete | None

    def in_scalars(self) -> "ZeroOrderHoldArgs":
        """Return the arguments with scalar coefficients, as a solver uses them."""
        if self.discrete is None:
            return self
        return self._replace(discrete=self.discrete.in_scalars())


def acting_at(args: ZeroOrderHoldArgs, k: Int[Array, ""] | int, linear: tuple[bool, ...]) -> Record:
    """Return the acting inputs at sample k."""
    if args.delays is None:
        return at(args.inputs, k)
    return delayed(args.inputs, args.delays, k, linear)


class IntervalArgs(NamedTuple):
    """Arguments of a vector field within one interval: parameters and held inputs."""

    params: Record
    inputs: Record


class RampArgs(NamedTuple):
    """Arguments like `IntervalArgs` for moving inputs: values at the start of a step, and slopes
    per second.
    """

    params: Record
    inputs: Record
    slope: Record

    def after(self, t: Time) -> "RampArgs":
        """Return the arguments t [s] later."""
        inputs = jax.tree.map(lambda u, slope: u + slope * t, self.inputs, self.slope)
        return self._replace(inputs=inputs)


def sample_index(t: Time) -> Int[Array, ""]:
    """Return the first sample of an interval, from its time in samples."""
    # A step starts at a sample except for rounding, which in float32 exceeds a thousandth of a
    # sample from 16,000 on.
    return jnp.round(t).astype(int)


# Arguments of `init`, `func` and `step` are those of diffrax.AbstractSolver: terms, times, state y0
# and `args`. Solvers of a whole sample count time in samples, those within it in seconds from the
# start of the step.


type Stepped = tuple[PyTree, dfx.RESULTS]


class _Stateless(dfx.AbstractSolver):
    """Base class of the solvers: linear interpolation, no state between steps."""

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
        """Return one step in the five parts that diffrax expects."""
        y1, result = self.stepped(terms, t0, t1, y0, args)
        return y1, None, {"y0": y0, "y1": y1}, None, result

    @abc.abstractmethod
    def stepped(
        self, terms: dfx.AbstractTerm, t0: Time, t1: Time, y0: PyTree, args: PyTree
    ) -> Stepped:
        """Return the state at t1 and diffrax's result."""


class SolverWrapper(_Stateless):
    """A solver of whole samples that wraps another (see also `heli_jax.simulation.simulate`)."""

    solver: Any
    """Inner solver: one of this module's; for `PerSample` any of diffrax's."""

    def order(self, terms: dfx.AbstractTerm) -> int | None:
        return self.solver.order(terms)

    def func(self, terms: dfx.AbstractTerm, t0: Time, y0: PyTree, args: PyTree) -> Any:
        return y0


class Exact(_Stateless):
    """Exact solver for linear models with held or linear inputs: a recurrence with scalar
    coefficients.
    """

    def order(self, terms: dfx.AbstractTerm) -> None:
        # An exact solver has no order; diffrax accepts None.
        return None

    def func(self, terms: dfx.AbstractTerm, t0: Time, y0: PyTree, args: PyTree) -> Any:
        return terms.vf(t0, y0, IntervalArgs(args.params, at(args.inputs, sample_index(t0))))

    def stepped(
        self, terms: dfx.AbstractTerm, t0: Time, t1: Time, y0: PyTree, args: ZeroOrderHoldArgs
    ) -> Stepped:
        """Advance the recurrence by one sample."""
        assert args.discrete is not None
        # Whole samples of a delay shift the inputs; the remainder is in Bd and Bp.
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
    """Return x[k+1] from x[k] and the inputs.

    Args:
        before: inputs of the previous sample, if the recurrence has Bp.
        after: inputs of the next sample, if the recurrence has Bn.
    """
    # Scalar sums instead of a matrix product: under vmap each is a vector over the batch, which XLA
    # fuses into one loop. A product of many 4x4 matrices calls a routine for each.
    new = [dot(a, x) + dot(b, u) for a, b in zip(discrete.Ad, discrete.Bd, strict=True)]
    if discrete.Bp is not None:
        assert before is not None
        new = [v + dot(b, before) for v, b in zip(new, discrete.Bp, strict=True)]
    if discrete.Bn is not None:
        assert after is not None
        new = [v + dot(b, after) for v, b in zip(new, discrete.Bn, strict=True)]
    return new


def dot(coefficients: Sequence[Scalar], values: Sequence[Scalar]) -> Scalar:
    """Return the sum of products of two lists of scalars, in order."""
    # sum() would start with 0 and add one operation to each step.
    total = coefficients[0] * values[0]
    for c, v in zip(coefficients[1:], values[1:], strict=True):
        total = total + c * v
    return total


class RK4(_Stateless):
    """The classical Runge-Kutta method of fourth order on named scalar leaves.

    `rolled` makes the four stages a loop: a quarter of the code to compile, but slightly slower.
    """

    rolled: bool = eqx.field(static=True, default=False)

    def order(self, terms: dfx.AbstractTerm) -> int:
        return 4

    def func(self, terms: dfx.AbstractTerm, t0: Time, y0: PyTree, args: PyTree) -> Any:
        return terms.vf(t0, y0, args)

    def stepped(
        self, terms: dfx.AbstractTerm, t0: Time, t1: Time, y0: PyTree, args: PyTree
    ) -> Stepped:
        """Make one step of the method."""
        h: Any = t1 - t0

        # diffrax's Runge-Kutta methods stack the stages into arrays, which XLA does not fuse into
        # one loop over a batch.
        def f(t: Time, y: PyTree) -> Any:
            # The barrier makes XLA compute each slope once, instead of once for every state
            # variable.
            return jax.lax.optimization_barrier(terms.vf(t, y, args))

        def along(y: PyTree, slope: PyTree, step: Time) -> PyTree:
            return jax.tree.map(lambda a, b: a + step * b, y, slope)

        # Slopes at t0, twice at mid-step and at t1; weights 1, 2, 2, 1 over 6.
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
        # Each stage needs only the previous slope, so a loop can carry it. The first stage has zero
        # reach, so any slope works.
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
    """Any solver inside one sample, with `substeps` equal steps.

    With a delayed input the interval has two parts, before and after the input changes, with
    `substeps` steps each.
    """

    substeps: int = eqx.field(static=True)
    linear: tuple[bool, ...] = eqx.field(static=True, default=(), kw_only=True)
    """True for each input that is linear between samples; () holds all."""

    def func(self, terms: dfx.AbstractTerm, t0: Time, y0: PyTree, args: PyTree) -> Any:
        return self.solver.func(
            terms, t0, y0, IntervalArgs(args.params, at(args.inputs, sample_index(t0)))
        )

    def stepped(
        self, terms: dfx.AbstractTerm, t0: Time, t1: Time, y0: PyTree, args: ZeroOrderHoldArgs
    ) -> Stepped:
        """Integrate one sample in its parts."""
        # Return the first failure; later ones follow from it.
        y, result = y0, dfx.RESULTS.successful
        for length, now in self._parts(args, sample_index(t0)):
            y, part = self._steps(terms, length / self.substeps, y, now)
            result = dfx.RESULTS.where(result == dfx.RESULTS.successful, part, result)
        return y, result

    def _parts(self, args: ZeroOrderHoldArgs, k: Int[Array, ""]) -> list[_Part]:
        """Return the parts of the interval after sample k: length [s], and arguments with the
        inputs.
        """
        # A line across a sample is one part; with a fractional delay it bends within the interval.
        # Each part ends where an input jumps, since a step across a jump would be of first order
        # with any method.
        parts = segments(args.inputs, args.dt, args.delays, k, self.linear)
        if self.linear:
            return [(p.length, RampArgs(args.params, p.inputs, p.slope)) for p in parts]
        return [(p.length, IntervalArgs(args.params, p.inputs)) for p in parts]

    def _steps(
        self, terms: dfx.AbstractTerm, h: Array, y0: PyTree, now: IntervalArgs | RampArgs
    ) -> Any:
        """Make `substeps` steps of h [s].

        Held inputs do not depend on time, and moving ones count it from the start of the step. Each
        step therefore starts at 0, and a constant step length makes the code faster.
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
            dt0=None,  # inputs jump, so the controller chooses a first step in each interval
            y0=y0,
            args=now,
            saveat=dfx.SaveAt(t1=True),
            stepsize_controller=self.controller,
            max_steps=self.max_steps,
            adjoint=self.adjoint,
            throw=False,
        )
        # A part cut off by a delay may have zero length; then the state stays unchanged.
        reached = jax.tree.map(lambda a, b: jnp.where(h > 0, a[-1], b), sol.ys, y0)
        fine = dfx.RESULTS.where(h > 0, sol.result, dfx.RESULTS.successful)
        return reached, fine


class AtSamples(SolverWrapper):
    """A per-sample solver of a model with a controller, which acts before each step."""

    sampled: Sampled = eqx.field(static=True)
    linear: tuple[bool, ...] = eqx.field(static=True, default=())

    def stepped(
        self, terms: dfx.AbstractTerm, t0: Time, t1: Time, y0: PyTree, args: ZeroOrderHoldArgs
    ) -> Stepped:
        """Integrate one sample from the state after the controller's step."""
        now = acting_at(args, sample_index(t0), self.linear)
        y0 = self.sampled.update(args.params, y0, now)
        return self.solver.stepped(terms, t0, t1, y0, args)


# Implicit solvers need a root finder with tolerances, which a name cannot give.
NAMED = ("Euler", "Midpoint", "Heun", "Ralston", "Bosh3", "Tsit5", "Dopri5", "Dopri8")
"""Names of available diffrax solvers: explicit, with fixed steps."""


def solver_named(name: str) -> str | dfx.AbstractSolver:
    """Return "exact", "rk4", or diffrax's fixed-step solver of that name, such as "Tsit5".

    Raises:
        ValueError: the name is unknown.
    """
    if name in ("exact", "rk4"):
        return name
    if name in NAMED:
        return getattr(dfx, name)()
    known = ("exact", "rk4", *NAMED)
    raise ValueError(f"solver: unknown solver {name!r}{nearest(name, known)}")
