"""Solver classes of our own: one step a sample, named scalar leaves.

A Runge-Kutta method that reads a held input by time sees the next sample in its last stage, an
error of first order. Here the input of an interval is picked once and held while the step is made;
one that is linear between samples is followed along its line by every stage.
"""

from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp

from heli_jax.errors import nearest
from heli_jax.simulation.discretize import Discrete
from heli_jax.simulation.hold import at, segments


class ZeroOrderHoldArgs(NamedTuple):
    """What a step needs to know: the parameters and the inputs, sample by sample.

    `inputs` holds arrays (N,). `delay` is None, or the whole samples (integer) and the rest
    (fraction of a sample in [0, 1)) by which the inputs act later than given. `dt` [s] is the
    sample time.
    """

    params: Any
    inputs: Any
    dt: Any
    delay: Any
    discrete: Discrete | None

    def in_scalars(self) -> "ZeroOrderHoldArgs":
        """As a solver steps with it."""
        if self.discrete is None:
            return self
        return self._replace(discrete=self.discrete.in_scalars())


class IntervalArgs(NamedTuple):
    """The arguments of a vector field within one interval: parameters and the held inputs."""

    params: Any
    inputs: Any


class RampArgs(NamedTuple):
    """As `IntervalArgs`, for inputs that move: those at the begin of a step, and their slope per
    second."""

    params: Any
    inputs: Any
    slope: Any

    def after(self, t: Any) -> "RampArgs":
        """As of t [s] later."""
        inputs = jax.tree.map(lambda u, slope: u + slope * t, self.inputs, self.slope)
        return self._replace(inputs=inputs)


def sample_index(t: Any) -> Any:
    return jnp.floor(t + 1e-3).astype(int)


class _Stateless(dfx.AbstractSolver):
    """What all solvers here share: straight lines between samples, nothing kept between steps."""

    term_structure: ClassVar = dfx.AbstractTerm
    interpolation_cls: ClassVar[Callable[..., dfx.LocalLinearInterpolation]] = (
        dfx.LocalLinearInterpolation
    )

    def init(self, terms: Any, t0: Any, t1: Any, y0: Any, args: Any) -> None:
        return None


class SolverWrapper(_Stateless):
    """A solver of whole samples around another (see also `heli_jax.simulation.wrappers`)."""

    solver: dfx.AbstractSolver

    def order(self, terms: Any) -> int | None:
        return self.solver.order(terms)

    def func(self, terms: Any, t0: Any, y0: Any, args: Any) -> Any:
        return y0


class Exact(_Stateless):
    """Exact for linear models, held inputs or linear ones: a recurrence of scalar coefficients."""

    def order(self, terms: Any) -> None:
        return None

    def func(self, terms: Any, t0: Any, y0: Any, args: Any) -> Any:
        return terms.vf(t0, y0, IntervalArgs(args.params, at(args.inputs, sample_index(t0))))

    def step(
        self,
        terms: Any,
        t0: Any,
        t1: Any,
        y0: Any,
        args: ZeroOrderHoldArgs,
        solver_state: Any,
        made_jump: Any,
    ) -> Any:
        assert args.discrete is not None
        k = sample_index(t0)
        if args.delay is not None:
            k = k - args.delay[0]
        before = None if args.delay is None else jax.tree.leaves(at(args.inputs, k - 1))
        after = None if args.discrete.Bn is None else jax.tree.leaves(at(args.inputs, k + 1))
        u = jax.tree.leaves(at(args.inputs, k))
        new = advance(args.discrete, jax.tree.leaves(y0), u, before, after)
        y1 = jax.tree.unflatten(jax.tree.structure(y0), new)
        return y1, None, {"y0": y0, "y1": y1}, None, dfx.RESULTS.successful


def advance(discrete: Discrete, x: Any, u: Any, before: Any = None, after: Any = None) -> list[Any]:
    """x[k+1] from lists of scalars; `before` and `after` are the inputs of the samples beside."""
    new = [dot(a, x) + dot(b, u) for a, b in zip(discrete.Ad, discrete.Bd, strict=True)]
    if discrete.Bp is not None:
        new = [v + dot(b, before) for v, b in zip(new, discrete.Bp, strict=True)]
    if discrete.Bn is not None:
        new = [v + dot(b, after) for v, b in zip(new, discrete.Bn, strict=True)]
    return new


def dot(coefficients: Any, values: Any) -> Any:
    """The sum of products of two lists of scalars, term by term from the first."""
    total = coefficients[0] * values[0]
    for c, v in zip(coefficients[1:], values[1:], strict=True):
        total = total + c * v
    return total


class RK4(_Stateless):
    """The classical Runge-Kutta method of fourth order on named scalar leaves.

    `rolled` makes the four stages a loop: a quarter of the code to compile, and somewhat slower.
    """

    rolled: bool = eqx.field(static=True, default=False)

    def order(self, terms: Any) -> int:
        return 4

    def func(self, terms: Any, t0: Any, y0: Any, args: Any) -> Any:
        return terms.vf(t0, y0, args)

    def step(
        self, terms: Any, t0: Any, t1: Any, y0: Any, args: Any, solver_state: Any, made_jump: Any
    ) -> Any:
        h = t1 - t0

        def f(t: Any, y: Any) -> Any:
            # Behind a barrier each slope is computed once: without it XLA computes all of them
            # again for every state variable.
            return jax.lax.optimization_barrier(terms.vf(t, y, args))

        def along(y: Any, slope: Any, step: Any) -> Any:
            return jax.tree.map(lambda a, b: a + step * b, y, slope)

        if self.rolled:
            y1 = self._rolled(f, along, t0, h, y0)
            return y1, None, {"y0": y0, "y1": y1}, None, dfx.RESULTS.successful
        k1 = f(t0, y0)
        k2 = f(t0 + 0.5 * h, along(y0, k1, 0.5 * h))
        k3 = f(t0 + 0.5 * h, along(y0, k2, 0.5 * h))
        k4 = f(t1, along(y0, k3, h))
        y1 = jax.tree.map(
            lambda y, a, b, c, d: y + (h / 6.0) * (a + 2.0 * (b + c) + d), y0, k1, k2, k3, k4
        )
        return y1, None, {"y0": y0, "y1": y1}, None, dfx.RESULTS.successful

    @staticmethod
    def _rolled(f: Any, along: Any, t0: Any, h: Any, y0: Any) -> Any:
        def stage(carry: Any, node: Any) -> Any:
            total, slope = carry
            reach, weight = node
            slope = f(t0 + reach * h, along(y0, slope, reach * h))
            return (along(total, slope, weight * h), slope), None

        reach = jnp.asarray([0.0, 0.5, 0.5, 1.0], h.dtype)
        weight = jnp.asarray([1.0, 2.0, 2.0, 1.0], h.dtype) / 6.0
        nothing = jax.tree.map(jnp.zeros_like, y0)
        (y1, _), _ = jax.lax.scan(stage, (y0, nothing), (reach, weight))
        return y1


class PerSample(SolverWrapper):
    """Any solver inside one sample: `substeps` equal steps.

    With a delayed input the interval has two parts, before and after the change of the input,
    with `substeps` steps each.
    """

    substeps: int = eqx.field(static=True)
    linear: tuple[bool, ...] = eqx.field(static=True, default=(), kw_only=True)
    """of each input whether it is linear between samples; () holds all"""

    def func(self, terms: Any, t0: Any, y0: Any, args: Any) -> Any:
        return self.solver.func(
            terms, t0, y0, IntervalArgs(args.params, at(args.inputs, sample_index(t0)))
        )

    def step(
        self,
        terms: Any,
        t0: Any,
        t1: Any,
        y0: Any,
        args: ZeroOrderHoldArgs,
        solver_state: Any,
        made_jump: Any,
    ) -> Any:
        y, result = y0, dfx.RESULTS.successful
        for length, now in self._parts(args, sample_index(t0)):
            y, part = self._steps(terms, length / self.substeps, y, now)
            result = dfx.RESULTS.where(result == dfx.RESULTS.successful, part, result)
        return y, None, {"y0": y0, "y1": y}, None, result

    def _parts(self, args: ZeroOrderHoldArgs, k: Any) -> list[tuple[Any, IntervalArgs | RampArgs]]:
        """The parts of the interval from sample k on: how long [s], and with which inputs."""
        if self.linear:
            parts = segments(args.inputs, args.dt, args.delay, k, self.linear)
            return [(p.length, RampArgs(args.params, p.inputs, p.slope)) for p in parts]
        if args.delay is None:
            return [(args.dt, IntervalArgs(args.params, at(args.inputs, k)))]
        whole, rest = args.delay
        return [
            (rest * args.dt, IntervalArgs(args.params, at(args.inputs, k - whole - 1))),
            ((1.0 - rest) * args.dt, IntervalArgs(args.params, at(args.inputs, k - whole))),
        ]

    def _steps(self, terms: Any, h: Any, y0: Any, now: IntervalArgs | RampArgs) -> Any:
        """`substeps` steps of h [s]. Nothing depends on time while the input is held, and where it
        moves it is counted from the step's begin, so each begins at 0: a step length that is the
        same number in all steps makes the code faster.
        """
        begin = jnp.zeros_like(h)

        def body(carry: Any, j: Any) -> Any:
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

    def _steps(self, terms: Any, h: Any, y0: Any, now: IntervalArgs | RampArgs) -> Any:
        sol = dfx.diffeqsolve(
            terms,
            self.solver,
            t0=jnp.zeros_like(h),
            t1=self.substeps * h,
            dt0=None,
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
