"""One sample at a time: recursive least squares, and Fourier sums of consecutive blocks.

The sums of a block of N samples at its own Fourier frequencies z = exp(i 2 pi k / N) are all that
`estimates.py` needs: X = (zI - Ad)^-1 [B U + z (x_0 - x_N)] is exact within each block, so nothing
is kept of the samples themselves but a few inputs at the ends of the blocks, for delays.

Sources: Morelli (2000) for the recursive transform; `identification/estimation/frequency_error.py`
for the estimate.
"""

import dataclasses
import math
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float, Int

from heli_jax import naming
from heli_jax.identification.equation_error.rls import RLSState, rls_init, rls_step
from heli_jax.identification.problem import MAX_TIME_SHIFT, Problem

BLOCK = 20.0
"""Length of a block [s]: twice the slowest decay of the bench. With half of it the estimate of the
stand's stiffness was biased by 0.4 sd (experiments/stream.py)."""
BLOCKS = 64
"""Blocks that are kept; the oldest is replaced by the newest."""
LINES = 1000
"""Most frequencies of a block."""
_P0 = 1e12
"""Initial variance of every coefficient of RLS, for signals of unit rms."""
_BOUND = 100.0
"""Largest variance of a coefficient of RLS [initial variances]."""


class Sample(NamedTuple):
    """Samples at one instant of the uniform grid, SI; NaN if missing."""

    inputs: Float[Array, " m"] | np.ndarray
    """In the order of the model's Inputs."""
    outputs: Float[Array, " p"] | np.ndarray
    """Measured outputs, sorted by name."""


class Info(NamedTuple):
    """Results of a step."""

    error: Float[Array, ""]
    """One-step prediction error of RLS, in rms of its output; NaN until it has begun."""
    largest: Float[Array, ""]
    """Largest variance of a coefficient of RLS."""
    block: Bool[Array, ""]
    """True if this sample completed a block."""


class State(eqx.Module):
    """All that is kept of the samples. K lines, F blocks, r recent inputs, n order of RLS."""

    samples: Int[Array, ""]
    """Samples so far."""
    missing: Int[Array, ""]
    """Those with a missing value."""
    row: Int[Array, ""]
    """Consecutive samples without a missing value."""
    blocks: Int[Array, ""]
    """Completed blocks."""
    within: Int[Array, ""]
    """Samples of the block in progress."""
    sums: Complex[Array, "F K c"]
    """Sums of inputs and outputs by block; the one in progress replaces the oldest."""
    ends: Float[Array, "F 2 r m"]
    """Inputs about the first sample of each block, and of the next."""
    inputs: Float[Array, "r m"]
    """Recent inputs, the newest first."""
    outputs: Float[Array, "r p"]
    turns: Complex[Array, " N"]
    """exp(-i 2 pi j / N)."""
    rls: RLSState
    rls_past: Float[Array, "2 n"]
    """Last outputs and inputs of RLS over their rms, the newest first."""
    rls_size: Float[Array, " 2"]
    """rms of the output and of the input of RLS."""
    forgetting: Float[Array, ""]
    dt: float = eqx.field(static=True)
    ahead: int = eqx.field(static=True)
    """Samples by which the transform lags behind, for inputs that act before they are logged, and
    for lines to the next sample."""
    rls_pair: tuple[int, int] = eqx.field(static=True)
    """Indices of output and input of RLS."""

    @property
    def length(self) -> int:
        """Samples of a block, N."""
        return self.turns.shape[0]


def init(
    problem: Problem, *, block: float = BLOCK, order: int = 4, forgetting: float = 1.0
) -> State:
    """Return the state before the first sample.

    Args:
        problem: its first flight, such as the first seconds received, gives sample time, holds,
            outputs and the sizes of the signals; no sample of it is used.
        block: length of a block [s]; modes slower than that are hardly seen.
        order: n of Hd(z) in RLS; 4 in the paper.
        forgetting: of RLS, in (0, 1].

    Raises:
        ValueError: the model is not linear, an input is mixed between samples, or a block is too
            short.
    """
    flight, model = problem.training[0], problem.model
    names, outputs = naming.names(model.Inputs), sorted(flight.outputs)
    if not model.linear:
        raise ValueError(f"model {model.name} is not linear, expected a linear one on line")
    if mixed := [n for n in names if flight.hold[n] == "mixed"]:
        raise ValueError(f"hold: {mixed[0]} is mixed, expected zero-order or linear on line")
    N = round(block / flight.dt)
    if N < 50:
        raise ValueError(f"block: expected at least {50 * flight.dt:g} s, got {block:g}")
    early, late = _delays(problem)
    ahead = math.ceil(early / flight.dt) + any(flight.hold[n] == "linear" for n in names)
    recent = ahead + math.ceil(late / flight.dt) + 2
    # As the batch: an angle before its rate.
    angle = [naming.unit(model.Outputs, n) == "rad" for n in outputs]
    pair = (angle.index(True) if any(angle) else 0, 0)
    rms = [
        float(np.sqrt(np.nanmean(np.square(v)))) or 1.0
        for v in (flight.outputs[outputs[pair[0]]], flight.inputs[names[0]])
    ]
    kind = jnp.result_type(float)
    # Separate arrays, because a donated array may be given once only.
    K = min((N - 1) // 2, LINES)
    shape, wide = (BLOCKS, K, len(names) + len(outputs)), np.result_type(kind, np.complex64)
    return State(
        samples=jnp.zeros((), int),
        missing=jnp.zeros((), int),
        row=jnp.zeros((), int),
        blocks=jnp.zeros((), int),
        within=jnp.zeros((), int),
        sums=jnp.zeros(shape, wide),
        ends=jnp.zeros((BLOCKS, 2, recent, len(names)), kind),
        inputs=jnp.zeros((recent, len(names)), kind),
        outputs=jnp.zeros((ahead + 1, len(outputs)), kind),
        turns=jnp.asarray(np.exp(-2j * np.pi * np.arange(N) / N), wide),
        rls=rls_init(2 * order + 1, jnp.asarray(_P0, kind)),
        rls_past=jnp.zeros((2, order), kind),
        rls_size=jnp.asarray(rms, kind),
        forgetting=jnp.asarray(forgetting, kind),
        dt=float(flight.dt),
        ahead=ahead,
        rls_pair=pair,
    )


def _delays(problem: Problem) -> tuple[float, float]:
    """Return how much earlier and later than logged an input may act [s]."""
    early = late = MAX_TIME_SHIFT if problem.nuisance.time_shift else 0.0
    values = naming.asdict(problem.start_params(problem.training[0].known))
    for _, name in problem.model.delays:
        free, start = problem.free.get(name), float(values[name])
        low = high = start
        if free is not None:
            # Without a bound a free delay may double.
            low = min(0.0, 2.0 * start) if free.lower is None else free.lower
            high = max(0.0, 2.0 * start) if free.upper is None else free.upper
        early, late = max(early, -low), max(late, high)
    return early, late


def step(state: State, sample: Sample) -> tuple[State, Info]:
    """Take one sample. Both jitted and under `jax.lax.scan`, states may be donated.

    A missing value ends the block in progress and the row of RLS.
    """
    seen = jnp.all(jnp.isfinite(sample.inputs)) & jnp.all(jnp.isfinite(sample.outputs))
    row = jnp.where(seen, state.row + 1, 0)
    rls, past, error, largest = _rls(state, sample, row)
    u = jnp.concatenate([sample.inputs[None], state.inputs[:-1]])
    y = jnp.concatenate([sample.outputs[None], state.outputs[:-1]])
    # The inputs about a sample are at hand `ahead` samples later.
    whole = row >= u.shape[0]
    F, K, _ = state.sums.shape
    full = whole & (state.within == state.length)
    ends = state.ends.at[state.blocks % F, 1].set(
        jnp.where(full, u, state.ends[state.blocks % F, 1])
    )
    blocks = state.blocks + full.astype(int)
    slot, within = blocks % F, jnp.where(full, 0, state.within)
    first = whole & (within == 0)
    ends = ends.at[slot, 0].set(jnp.where(first, u, ends[slot, 0]))
    turn = state.turns[(jnp.arange(1, K + 1) * within) % state.length]
    now = jnp.where(whole, jnp.concatenate([u[state.ahead], y[state.ahead]]), 0.0)
    before = jnp.where(first, 0.0, state.sums[slot])
    added = before + turn[:, None] * now.astype(turn.dtype)[None, :]
    made = dataclasses.replace(
        state,
        samples=state.samples + 1,
        missing=state.missing + (~seen).astype(int),
        row=row,
        blocks=blocks,
        within=jnp.where(whole, within + 1, 0),
        sums=state.sums.at[slot].set(added),
        ends=ends,
        inputs=u,
        outputs=y,
        rls=rls,
        rls_past=past,
    )
    return made, Info(error, largest, full)


def _rls(state: State, sample: Sample, row: Array) -> tuple[RLSState, Array, Array, Array]:
    """Return RLS after a sample, its past, its error and largest variance."""
    out, into = state.rls_pair
    y, u = sample.outputs[out] / state.rls_size[0], sample.inputs[into] / state.rls_size[1]
    past, order = state.rls_past, state.rls_past.shape[1]
    phi = jnp.concatenate([past[0], u[None], past[1]])
    bound = jnp.asarray(_BOUND * _P0, phi.dtype)
    after, info = rls_step(state.rls, phi, y, state.forgetting, bound)
    ready = row > order
    kept = jax.tree.map(lambda new, old: jnp.where(ready, new, old), after, state.rls)
    past = jnp.concatenate([jnp.stack([y, u])[:, None], past[:, :-1]], axis=1)
    error, largest = (jnp.where(ready, v, jnp.nan) for v in info)
    return kept, past, error, largest


def follow(state: State, samples: Sample) -> tuple[State, Info]:
    """Take consecutive samples, with a leading axis."""
    return jax.lax.scan(step, state, samples)


class Blocks(NamedTuple):
    """Transforms of the completed blocks over sqrt(N); zero for blocks not yet completed."""

    lines: Complex[np.ndarray, "K c F"]
    ends: Float[np.ndarray, "r m F"]
    """Inputs about the first sample of each block, less those about the next one's."""
    count: int


def blocks_of(state: State) -> Blocks:
    """Return the completed blocks, the first `count` of F, which is 4, 16 or 64."""
    F, done = state.sums.shape[0], int(state.blocks)
    # The block in progress has replaced the oldest.
    order = np.arange(max(0, done - F + 1), done) % F
    sums, ends = np.asarray(state.sums)[order], np.asarray(state.ends)[order]
    # Few sizes, because each is a program of its own.
    padding = [
        (0, next(4**k for k in (1, 2, 3) if len(order) <= 4**k) - len(order)),
        (0, 0),
        (0, 0),
    ]
    lines = np.pad(sums, padding) / math.sqrt(state.length)
    difference = np.pad(ends[:, 0] - ends[:, 1], padding)
    return Blocks(np.moveaxis(lines, 0, -1), np.moveaxis(difference, 0, -1), len(order))
