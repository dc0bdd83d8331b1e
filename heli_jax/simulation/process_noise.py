"""Process noise in a run: drawn once a sample, with the covariance that a sample adds."""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from heli_jax import naming
from heli_jax.dynamics.model import Model
from heli_jax.naming import Record, Scalar
from heli_jax.numerics.matrix_exponential import van_loan
from heli_jax.simulation.discretize import Discrete, process_noise, square_root
from heli_jax.simulation.hold import delayed
from heli_jax.simulation.options import SimulationOptions
from heli_jax.simulation.solvers import Exact, ZeroOrderHoldArgs
from heli_jax.simulation.wrappers import StateFeedback, WithProcessNoise


def with_process_noise(
    model: Model,
    args: ZeroOrderHoldArgs,
    method: dfx.AbstractSolver,
    options: SimulationOptions,
    linear: tuple[bool, ...],
) -> tuple[dfx.AbstractSolver, ZeroOrderHoldArgs]:
    """Standard normal numbers as further inputs, multiplied by a root of the process noise.

    Args:
        model: one with a noise intensity, n states.
        args: of the run without noise.
        options: of which dt, delay and key count.
        linear: of each input whether it moves between samples; () holds all.

    Raises:
        ValueError: the model has no noise, or the options a delay.
    """
    assert options.key is not None
    if model.noise_intensity is None:
        raise ValueError(
            f"key: expected a model with process noise, as with_disturbance makes one, got "
            f"{model.name!r}"
        )
    # A delay of all inputs is for records: nothing is drawn for them.
    if options.delay is not None:
        raise ValueError(
            "key: expected a run without a delay to draw noise for, got one with delay"
        )
    n = jax.tree.leaves(args.inputs)[0].shape[0]
    dtype, states = jax.tree.leaves(args.inputs)[0].dtype, len(naming.names(model.State))
    # Drawn for all samples at once: the same key gives the same record, whatever the solver does.
    if not isinstance(method, Exact) or args.discrete is None:
        feedback = method.feedback if isinstance(method, StateFeedback) else None
        draws = jax.random.normal(options.key, (n, states), dtype)
        acting = args.inputs
        if args.delays is not None:
            # The model is linearised about the inputs as they act, which are read from here.
            acting = delayed(args.inputs, args.delays, jnp.arange(n), linear)
        args = args._replace(inputs=(args.inputs, acting, tuple(draws.T)))
        return WithProcessNoise(
            method, functools.partial(add_process_noise, model, args, feedback)
        ), args
    # The recurrence of a linear model takes draws as it takes inputs: L beside Bd, no step more.
    L = square_root(process_noise(model, args.params, options.dt))
    draws = jax.random.normal(options.key, (n, L.shape[0]), L.dtype)
    # The draws are no inputs: nothing of them comes late or from the next sample.
    none, discrete = jnp.zeros_like(L), args.discrete
    discrete = Discrete(
        discrete.Ad,
        jnp.concatenate([discrete.Bd, L], axis=1),
        None if discrete.Bp is None else jnp.concatenate([discrete.Bp, none], axis=1),
        None if discrete.Bn is None else jnp.concatenate([discrete.Bn, none], axis=1),
    )
    return method, args._replace(inputs=(args.inputs, tuple(draws.T)), discrete=discrete)


def add_process_noise(
    model: Model,
    args: ZeroOrderHoldArgs,
    feedback: Callable[..., Any] | None,
    state: Record,
    inputs: Record,
    draws: Sequence[Scalar],
) -> Record:
    """The state after a sample with the noise of that sample, of the model linearised there.

    Args:
        model: one with a noise intensity, n states.
        args: of which the parameters and dt count.
        feedback: None, or what makes the acting inputs of the given ones.
        state: before the noise is added.
    """
    params, dt = args.params, args.dt
    # The linearisation is at the inputs that acted, which the solver within keeps to itself.
    if feedback is not None:
        inputs = feedback(state, inputs)
    x = naming.ravel(state)

    # The model itself filters the drive of a sample: its covariance is not g g^T dt, in which
    # states without a drive of their own would get none.
    def rates(x: Array) -> Array:
        derivatives = model.vector_field(params, naming.unravel(model.State, x), inputs)
        return naming.ravel(derivatives, x.dtype, naming.names(model.State))

    assert model.noise_intensity is not None
    g = naming.ravel(model.noise_intensity(params), x.dtype, naming.names(model.State))
    L = square_root(van_loan(jax.jacfwd(rates)(x), jnp.zeros_like(g), g, dt).Q)
    return naming.unravel(model.State, x + L @ jnp.stack(draws))
