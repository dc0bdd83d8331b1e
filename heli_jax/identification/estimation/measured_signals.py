"""What is measured: the signals of all flights one after another, and how many numbers they are."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from heli_jax.dynamics.disturbance import sensor_noise
from heli_jax.identification.unknowns.layout import Data, Layout, Noise, Unknowns

_BEHIND = 0.02
"""of the noise that came through filters, which is behind them at least: without any the first
innovation, which an initial state makes zero, would have no variance, and the likelihood no end"""


def signals(layout: Layout) -> list[tuple[int, str]]:
    """What is measured, as (flight, output), in the order of the rows."""
    return [(i, n) for i, names in enumerate(layout.outputs) for n in names]


def signal_numbers(layout: Layout, data: Data) -> np.ndarray:
    """Of every measured number its signal."""
    # From shapes alone: a constant to whatever is traced.
    sizes = [data.flights[i].outputs[n].shape[0] for i, n in signals(layout)]
    return np.repeat(np.arange(len(sizes)), sizes)


def measured_signals(layout: Layout, data: Data, noise: Noise) -> tuple[Array, Array]:
    """All that is measured, and its sd, each (n,).

    Args:
        layout: what the unknowns are.
        data: the numbers of the problem.
        noise: of the measurements, by flight and output.
    """
    # Joined, since XLA makes a kernel of every signal that is treated by itself.
    at = signals(layout)
    sd = jnp.stack([noise.sd[i][n] for i, n in at])
    y = jnp.concatenate([data.flights[i].outputs[n] for i, n in at])
    return y, sd[signal_numbers(layout, data)]


def measurement_sd(u: Unknowns, output: str, sd: Array) -> Array:
    """The sd of an output's white measurement noise.

    Args:
        u: the unknowns, in the units of the model.
        output: whose it is.
        sd: the guess of it, or what is stated.
    """
    sd = sd * u.scales[output] if output in u.scales else sd
    through = u.noise.get(sensor_noise(output))
    return sd if through is None else jnp.hypot(sd, _BEHIND * through)


def measured_count(data: Data) -> int:
    """How many measured numbers there are."""
    return int(measured_counts(data))


def measured_counts(data: Data) -> np.ndarray:
    """The same of each record, where all of `data` has leading axes of records."""
    # In NumPy, outside of what is compiled: the optimiser's program does not depend on it.
    return np.sum(
        [
            np.isfinite(np.asarray(y)).sum(axis=-1)
            for flight in data.flights
            for y in flight.outputs.values()
        ],
        axis=0,
    )


def least_noise(y: np.ndarray) -> float:
    """The sd, SI, below which what is left of an output (N,) is rounding; NaN is missing."""
    # A residual that is all rounding would make the next rows infinite; of an output that is
    # nothing at all even 1e-12 of its unit is plenty.
    rms = float(np.sqrt(np.mean(np.square(y[np.isfinite(y)]))))
    return 1e-12 * (rms if rms > 1e-100 else 1.0)
