"""Solvers around a per-sample solver: what happens to a run beside the integration of its model.

Each does one thing at a sample and leaves the step to the solver within: feedback, an event that
ends the run, process noise, a value that is carried along.
"""

from collections.abc import Callable
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, PyTree

from heli_jax.simulation.delays import at
from heli_jax.simulation.hold import at_end
from heli_jax.simulation.solvers import (
    SolverWrapper,
    Time,
    ZeroOrderHoldArgs,
    acting_at,
    sample_index,
)

# The arguments of `step` are diffrax's: terms, the interval [t0, t1] in samples, the state at its
# begin, and what is known beside it; none of the solvers here keeps a state between steps.


class StateFeedback(SolverWrapper):
    """A per-sample solver whose inputs are a function of the state at the sample.

    feedback(state, given inputs of that sample) gives the inputs that are held.
    """

    feedback: Callable[..., Any]

    def step(
        self,
        terms: dfx.AbstractTerm,
        t0: Time,
        t1: Time,
        y0: PyTree,
        args: ZeroOrderHoldArgs,
        solver_state: PyTree,
        made_jump: bool | Bool[Array, ""],
    ) -> Any:
        """A sample with the inputs that the feedback makes of the state at its begin."""
        # One sample, index 0, stands for all: `at` takes the last where the index is past the end.
        u = self.feedback(y0, at(args.inputs, sample_index(t0)))
        held = args._replace(inputs=jax.tree.map(lambda v: jnp.asarray(v)[None], u))
        return self.solver.step(terms, t0, t1, y0, held, solver_state, made_jump)


class Stopping(SolverWrapper):
    """A per-sample solver that stays where it is after the first sample at which `over` holds.

    y = (state, going), where going is 1 until then and 0 from there on.
    """

    # A number and not a truth value for `going`: diffrax takes derivatives of all that it carries.
    over: Callable[..., Any]
    linear: tuple[bool, ...] = eqx.field(static=True, default=())

    def step(
        self,
        terms: dfx.AbstractTerm,
        t0: Time,
        t1: Time,
        y0: PyTree,
        args: ZeroOrderHoldArgs,
        solver_state: PyTree,
        made_jump: bool | Bool[Array, ""],
    ) -> Any:
        """A sample, or none where the run is over."""
        # A batch cannot stop for one of its runs, so the step is made and its result not taken.
        state, going = y0
        new, _, _, _, result = self.solver.step(terms, t0, t1, state, args, None, made_jump)
        new = jax.tree.map(lambda a, b: jnp.where(going > 0, a, b), new, state)
        result = dfx.RESULTS.where(going > 0, result, dfx.RESULTS.successful)
        # The inputs at the end of the interval: those held since its begin, or the next ones.
        ended = self.over(new, at_end(args.inputs, sample_index(t0), self.linear))
        y1 = (new, jnp.where(ended, jnp.zeros_like(going), going))
        return y1, None, {"y0": y0, "y1": y1}, None, result


class WithProcessNoise(SolverWrapper):
    """A per-sample solver whose state gets its process noise after every sample.

    The inputs are (the model's, the same as they act, standard normal numbers); add_noise(state,
    acting inputs, numbers of that sample) gives the new state.
    """

    add_noise: Callable[..., Any]

    def step(
        self,
        terms: dfx.AbstractTerm,
        t0: Time,
        t1: Time,
        y0: PyTree,
        args: ZeroOrderHoldArgs,
        solver_state: PyTree,
        made_jump: bool | Bool[Array, ""],
    ) -> Any:
        """A sample, and the noise that comes in over it."""
        # The draws travel as inputs: they are samples too, and diffrax carries only y and args.
        inputs, acting, draws = args.inputs
        held = args._replace(inputs=inputs)
        y, _, _, _, result = self.solver.step(terms, t0, t1, y0, held, None, made_jump)
        k = sample_index(t0)
        y1 = self.add_noise(y, at(acting, k), at(draws, k))
        return y1, None, {"y0": y0, "y1": y1}, None, result


class Accumulating(SolverWrapper):
    """A per-sample solver that carries a running value beside the state.

    y = (state, value); at each sample, before the step, value = update(value, state, held inputs
    at that sample, k). Nothing else of the trajectory is kept.
    """

    update: Callable[..., Any] = eqx.field(static=True)
    linear: tuple[bool, ...] = eqx.field(static=True, default=())
    """of each input whether it moves between samples; () holds all"""

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
        """The value at a sample, then the step from it."""
        held, data = args
        state, value = y0
        # Before the step: the outputs of a sample belong to the state at its beginning. Whoever
        # runs this has to add the last sample, which no step begins with.
        k = sample_index(t0)
        value = self.update(value, state, acting_at(held, k, self.linear), at(data, k))
        state, _, _, _, result = self.solver.step(terms, t0, t1, state, held, None, made_jump)
        y1 = (state, value)
        return y1, None, {"y0": y0, "y1": y1}, None, result
