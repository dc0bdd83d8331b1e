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
    """x' = A x + B v, w = C x: v the commands that act, w the computed ones, and v = w closed.

    States are those of the plant, the controller's and the held commands. vmap adds batch
    dimensions.
    """

    A: Float[Array, "n n"]
    B: Float[Array, "n m"]
    C: Float[Array, "m n"]


class LinearStep(NamedTuple):
    """A controller's step: x' = A x + B y + E r, w = C x + D y + F r.

    x are its states, y the plant's signals, r set points, w commands; deviations.
    """

    A: Float[Array, "c c"]
    B: Float[Array, "c p"]
    E: Float[Array, "c r"]
    C: Float[Array, "m c"]
    D: Float[Array, "m p"]
    F: Float[Array, "m r"]


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


def linear_step(model: Model, plant: Plant, controller: Controller) -> LinearStep:
    """Return the step of a controller, linearised at the plant's steady flight.

    Args:
        model: the plant's.
    """
    signals, sets = signals_of(model), controller.references
    at = dict(zip(signals, plant.at, strict=True))
    first, driven = controller.init(), commanded(model, controller)

    def step(own: Array, y: Array, r: Array) -> tuple[Array, Array]:
        state, command = controller.step(
            dict(zip(first, own, strict=True)),
            dict(zip(signals, plant.at + y, strict=True)),
            dict(zip(sets, r, strict=True)),
        )
        return _vector(state, first), _vector(command, driven)

    start = _vector(first, first), jnp.zeros_like(plant.at), _vector(at, sets)
    (A, B, E), (C, D, F) = jax.jacfwd(step, argnums=(0, 1, 2))(*start)
    return LinearStep(A, B, E, C, D, F)


@eqx.filter_jit
def sampled_loop(model: Model, plant: Plant, controller: Controller) -> SampledLoop:
    """Return the loop of a plant and a controller.

    Args:
        model: the plant's.
    """
    Ac, Bc, _, Cc, Dc, _ = linear_step(model, plant, controller)
    columns = _columns(model, controller)
    B, D = plant.B[:, columns], plant.D[:, columns]
    (n, m), c = B.shape, len(Ac)
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
    )


def _columns(model: Model, controller: Controller) -> Array:
    """Return the places of the commanded inputs among the model's."""
    inputs = naming.names(model.Inputs)
    return jnp.asarray([inputs.index(n) for n in commanded(model, controller)])


def _vector(values: Mapping[str, Any], names: Iterable[str]) -> Array:
    listed = [jnp.asarray(values[n], float) for n in names]
    return jnp.stack(listed) if listed else jnp.zeros(0)


def _opened(loop: SampledLoop, i: int) -> tuple[np.ndarray, ...]:
    """Return A, b, c of L = c (z - A)^-1 b with negative feedback, opened at one command.

    The other commands are closed. Leading batch dimensions are kept.
    """
    A, B, C = map(np.asarray, loop)
    others = np.arange(B.shape[-1]) != i
    return A + B[..., others] @ C[..., others, :], B[..., i], -C[..., i, :]


_GROWS = 1e-5
"""Growth of a sample above which a loop is unstable; positions without control drift by rounding.
"""


def loop_margins(loop: SampledLoop, dt: float) -> tuple[Margins, ...]:
    """Return the margins of loops (batch,), one for each command.

    Tustin's map takes the unit circle to the imaginary axis, with the same values of L.

    Raises:
        ValueError: a loop has a pole at half the sample rate, which the map takes to infinity.
    """
    loop = jax.device_get(loop)
    size = np.abs(np.linalg.eigvals(loop.A + loop.B @ loop.C)).max(axis=-1)
    # Next to a pole near half the sample rate a slow growth is small.
    grows = size > 1.0 + _GROWS
    found = []
    for i in range(loop.B.shape[-1]):
        A, b, c = _opened(loop, i)
        try:
            m = margins(*_tustin(A, b, c, dt))
        except np.linalg.LinAlgError as e:
            raise ValueError("the controller has a pole at half the sample rate") from e
        lost = np.where(grows, np.nan, 0.0)
        found.append(Margins(m.gain + lost, m.phase + lost, m.stable & ~grows))
    return tuple(found)


def _tustin(A: np.ndarray, b: np.ndarray, c: np.ndarray, dt: float) -> tuple[np.ndarray, ...]:
    """Return A, b, c, d in s of loops (batch,) in z, with z = (1 + s dt/2) / (1 - s dt/2)."""
    n = A.shape[-1]
    back = np.linalg.inv(A + np.eye(n))
    x = np.einsum("kij,kj->ki", back, b)
    y = np.einsum("kj,kji->ki", c, back)
    gain = 2.0 / np.sqrt(dt)
    return (2.0 / dt) * (A - np.eye(n)) @ back, gain * x, gain * y, -np.einsum("ki,ki->k", c, x)


def all_stable(margins: Iterable[Margins]) -> np.ndarray:
    """True (batch,) if the loops at all commands of a vehicle are stable."""
    return np.all([m.stable for m in margins], axis=0)


def frequencies(dt: float, count: int = 300, lowest: float = 0.003) -> np.ndarray:
    """Return a grid of frequencies up to half the sample rate [rad/s]."""
    return np.geomspace(lowest, 0.98 * np.pi / dt, count)


def plant_responses(
    model: Model, plant: Plant, controller: Controller, dt: float, omega: np.ndarray
) -> Complex[Array, "k p m"]:
    """Return the responses P of all signals to the commands, at frequencies (k,) [rad/s]."""
    columns, z = _columns(model, controller), _z(dt, omega)
    # Sensors show the command that was held before the sample.
    return _at(z, plant.A, plant.B[:, columns], plant.C) + _complex(plant.D[:, columns]) / z


def controller_responses(
    step: LinearStep, dt: float, omega: np.ndarray
) -> tuple[Complex[Array, "k m p"], Complex[Array, "k m r"]]:
    """Return the responses of the commands to signals and to set points."""
    A, B, E, C, D, F = step
    z, p, r = _z(dt, omega), D.shape[1], F.shape[1]
    both = jnp.broadcast_to(_complex(jnp.concatenate([D, F], axis=1)), (len(z), len(D), p + r))
    if A.size:
        both = both + _at(z, A, jnp.concatenate([B, E], axis=1), C)
    return both[..., :p], both[..., p:]


def sensitivity(K: Complex[Array, "k m p"], P: Complex[Array, "k p m"]) -> Complex[Array, "k m m"]:
    """Return the responses of acting commands to what is added to them, in closed loop.

    The diagonal is 1 / (1 + L), with L the loop opened at one command.
    """
    return jnp.linalg.inv(jnp.eye(K.shape[-2], dtype=K.dtype)[None] - K @ P)


def loop_responses(K: Complex[Array, "k m p"], P: Complex[Array, "k p m"]) -> Complex[Array, "m k"]:
    """Return the loops L opened at each of the m commands, while the others are closed."""
    return 1.0 / jnp.diagonal(sensitivity(K, P), axis1=-2, axis2=-1).T - 1.0


def _z(dt: float, omega: np.ndarray) -> Complex[Array, "k 1 1"]:
    return jnp.asarray(np.exp(1j * dt * np.asarray(omega)))[:, None, None]


def _complex(M: Array) -> Complex[Array, "1 p m"]:
    return jax.lax.complex(M, jnp.zeros_like(M))[None]


def _at(z: Complex[Array, "k 1 1"], A: Array, B: Array, C: Array) -> Complex[Array, "k p m"]:
    """Return C (z - A)^-1 B."""
    A, B, C = map(_complex, (A, B, C))
    right = jnp.broadcast_to(B, (len(z), *B.shape[1:]))
    return C @ jnp.linalg.solve(z * jnp.eye(A.shape[-1], dtype=z.dtype)[None] - A, right)


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
