r"""Sampled loops: a linearised model with its controller, opened at every command.

The model between samples is exact for held commands, and the controller is the derivative of its
own `step`. Margins therefore contain the delay of sampling and holding.
"""

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from heli_jax import naming
from heli_jax.analysis.margins import Margins, margins
from heli_jax.control.controller import Controller, commanded, measured, signals_of
from heli_jax.dynamics.model import Model
from heli_jax.naming import Record
from heli_jax.numerics.jitted import jitted
from heli_jax.numerics.matrix_exponential import expm


class Plant(NamedTuple):
    """A model in steady flight, linearised and sampled with held inputs; deviations.

    x' = A x + B u and y = C x + D u, with all inputs of the model, and with y all signals that a
    controller may read, in the order of `signals_of`. vmap adds batch dimensions.
    """

    A: Float[Array, "n n"]
    B: Float[Array, "n m"]
    C: Float[Array, "p n"]
    D: Float[Array, "p m"]
    at: Float[Array, " p"]
    """Values of the signals in steady flight."""


class SampledLoop(NamedTuple):
    """x' = A x + B v, w = C x + F r, y = G x: v the commands that act, w the computed ones.

    States are those of the plant, the controller's and the held commands. The loop is closed by v =
    w; r are set points, which also act by x' = ... + E r; y are the plant's signals. vmap adds
    batch dimensions.
    """

    A: Float[Array, "n n"]
    B: Float[Array, "n m"]
    C: Float[Array, "m n"]
    E: Float[Array, "n r"]
    F: Float[Array, "m r"]
    G: Float[Array, "p n"]


@jitted
def plant_of(model: Model, params: Record, state: Record, inputs: Record, dt: Any) -> Plant:
    """Return a model without controller, linearised at a steady flight and sampled.

    Args:
        inputs: the model's Inputs, scalars.
        dt: sample time [s].
    """
    x0, u0 = naming.ravel(state), naming.ravel(inputs)

    def both(x: Array, u: Array) -> tuple[Array, Array]:
        s, v = naming.unravel(model.State, x), naming.unravel(model.Inputs, u)
        signals = measured(model, params, s, v)
        rates = naming.ravel(model.vector_field(params, s, v), x.dtype, naming.names(model.State))
        return rates, jnp.stack([signals[n] for n in signals_of(model)])

    (A, B), (C, D) = jax.jacfwd(both, argnums=(0, 1))(x0, u0)
    n, m = B.shape
    Phi = expm(dt * jnp.block([[A, B], [jnp.zeros((m, n + m), A.dtype)]]))
    return Plant(Phi[:n, :n], Phi[:n, n:], C, D, both(x0, u0)[1])


@eqx.filter_jit
def sampled_loop(model: Model, plant: Plant, controller: Controller) -> SampledLoop:
    """Return the loop of a plant and a controller.

    Args:
        model: the plant's.
    """
    signals, inputs = signals_of(model), naming.names(model.Inputs)
    at = dict(zip(signals, plant.at, strict=True))
    first, driven = controller.init(), commanded(model, controller)
    sets = controller.references

    def step(own: Array, y: Array, r: Array) -> tuple[Array, Array]:
        state, command = controller.step(
            dict(zip(first, own, strict=True)),
            dict(zip(signals, plant.at + y, strict=True)),
            dict(zip(sets, r, strict=True)),
        )
        return _vector(state, first), _vector(command, driven)

    zero = jnp.zeros_like(plant.at)
    r = _vector(at, sets)
    own = _vector(first, first)
    (Ac, Bc, Ec), (Cc, Dc, Fc) = jax.jacfwd(step, argnums=(0, 1, 2))(own, zero, r)
    columns = jnp.asarray([inputs.index(n) for n in driven])
    B, D = plant.B[:, columns], plant.D[:, columns]
    (n, m), c = B.shape, len(first)
    A = jnp.block(
        [
            [plant.A, jnp.zeros((n, c + m))],
            [Bc @ plant.C, Ac, Bc @ D],
            [jnp.zeros((m, n + c + m))],
        ]
    )
    return SampledLoop(
        A,
        jnp.concatenate([B, jnp.zeros((c, m)), jnp.eye(m)]),
        jnp.concatenate([Dc @ plant.C, Cc, Dc @ D], axis=1),
        jnp.concatenate([jnp.zeros((n, len(sets))), Ec, jnp.zeros((m, len(sets)))]),
        Fc,
        jnp.concatenate([plant.C, jnp.zeros((plant.C.shape[0], c)), D], axis=1),
    )


def _vector(values: Mapping[str, Any], names: Iterable[str]) -> Array:
    listed = [jnp.asarray(values[n], float) for n in names]
    return jnp.stack(listed) if listed else jnp.zeros(0)


def opened(loop: SampledLoop, i: int) -> tuple[Array, Array, Array]:
    """Return A, b, c of L = c (z - A)^-1 b with negative feedback, opened at one command.

    The other commands are closed. Leading batch dimensions are kept.
    """
    A = loop.A + loop.B.at[..., i].set(0.0) @ loop.C
    return A, loop.B[..., i], -loop.C[..., i, :]


def loop_margins(loop: SampledLoop, dt: float) -> tuple[Margins, ...]:
    """Return the margins of loops (batch,), one for each command.

    Tustin's map takes the unit circle to the imaginary axis, with the same values of L.
    """
    loops = [jax.device_get(opened(loop, i)) for i in range(loop.B.shape[-1])]
    return tuple(margins(*_tustin(A, b, c, dt)) for A, b, c in loops)


def _tustin(A: np.ndarray, b: np.ndarray, c: np.ndarray, dt: float) -> tuple[np.ndarray, ...]:
    """Return A, b, c, d in s of loops (batch,) in z, with z = (1 + s dt/2) / (1 - s dt/2)."""
    n = A.shape[-1]
    back = np.linalg.inv(A + np.eye(n))
    x = np.einsum("kij,kj->ki", back, b)
    y = np.einsum("kj,kji->ki", c, back)
    gain = 2.0 / np.sqrt(dt)
    return (2.0 / dt) * (A - np.eye(n)) @ back, gain * x, gain * y, -np.einsum("ki,ki->k", c, x)


def frequencies(dt: float, count: int = 60, lowest: float = 0.1) -> np.ndarray:
    """Return a grid of frequencies up to half the sample rate [rad/s]."""
    return np.geomspace(lowest, 0.98 * np.pi / dt, count)


def loop_responses(loop: SampledLoop, dt: float, omega: np.ndarray) -> Complex[Array, "m k"]:
    """Return L of one loop at frequencies (k,) [rad/s], opened at each of the m commands."""
    loops = (opened(loop, i) for i in range(loop.B.shape[-1]))
    return jnp.stack([_at(A, b, c, dt, omega) for A, b, c in loops])


def response(
    loop: SampledLoop, dt: float, omega: np.ndarray, *, of: int, to: int, set_point: bool
) -> Complex[Array, " k"]:
    """Return the closed loop's response (k,) of a signal at frequencies (k,) [rad/s], complex.

    Args:
        of: row of the signal.
        to: number of the command that an excitation is added to, or of the set point.
        set_point: True for a set point.
    """
    A, B, C, E, F, G = loop
    b = E[:, to] + B @ F[:, to] if set_point else B[:, to]
    return _at(A + B @ C, b, G[of], dt, omega)


def _at(A: Array, b: Array, c: Array, dt: float, omega: np.ndarray) -> Complex[Array, " k"]:
    """Return c (z - A)^-1 b at frequencies (k,) [rad/s]."""
    z = jnp.asarray(np.exp(1j * dt * np.asarray(omega)))[:, None, None]
    eye = jnp.eye(A.shape[-1], dtype=z.dtype)[None]
    x = jnp.linalg.solve(z * eye - A.astype(z.dtype)[None], b.astype(z.dtype)[None, :, None])
    return x[:, :, 0] @ c.astype(z.dtype)


_SQUARINGS = 11
"""Squarings of a closed loop's matrix, 2048 samples."""


def growth(loop: SampledLoop, dt: float) -> Float[Array, ""]:
    """Return the growth of the closed loop's slowest motion [1/s], differentiable.

    It is the change of the norm of A^n from n = 2048 samples to twice as many. Uncontrolled
    positions and headings count as 0.
    """
    A = loop.A + loop.B @ loop.C

    def squared(carry: tuple[Array, Array], _: None) -> tuple[tuple[Array, Array], Array]:
        S, log = carry
        S = S @ S
        size = jnp.sqrt(jnp.sum(S**2) + 1e-300)
        log = 2.0 * log + jnp.log(size)
        return (S / size, log), log

    start = A, jnp.zeros((), A.dtype)
    _, logs = jax.lax.scan(squared, start, None, length=_SQUARINGS + 1)
    return (logs[-1] - logs[-2]) / (2**_SQUARINGS * dt)
