"""Noise of sensors before an on-board low-pass: not white in the log, but white on its state."""

import dataclasses
import functools
from typing import Annotated, NamedTuple

from heli_jax import naming
from heli_jax.dynamics.model import LowPass, Model
from heli_jax.naming import Record, Scalar


def sensor_noise(output: str) -> str:
    """The parameter that is the sd of an output's noise from before its filters, as it is behind
    them."""
    return f"sigma_n_{output}"


@functools.cache
def with_sensor_noise(model: Model, outputs: tuple[str, ...]) -> Model:
    """The model with white noise of the sensors of some outputs before their low-passes.

    Each brings a parameter `sigma_n_OUTPUT`, the standard deviation behind the filters, in the
    output's unit. Noise that is white at the filter's input is process noise on the filter's state.

    Args:
        model: with `Model.low_passes` for these outputs.
        outputs: names; none: the model itself.
    """
    if not outputs:
        return model
    added = tuple(p for p in model.low_passes if p.output in outputs)
    more = {}
    for p in added:
        unit = naming.unit(model.Outputs, p.output) or "1"
        meaning = f"sd of the noise of {p.output} that came through its filters"
        more[sensor_noise(p.output)] = (Annotated[Scalar, unit, meaning], 0.0)
    noisy = _Noisy(model, added)
    return dataclasses.replace(
        model,
        Params=naming.extended(model.Params, f"{model.Params.__name__}SensorNoise", more),
        noise_intensity=noisy.noise_intensity,
    )


class _Noisy(NamedTuple):
    """A model with the noise of sensors beside its own process noise."""

    model: Model
    added: tuple[LowPass, ...]

    def noise_intensity(self, p: Record) -> Record:
        own = self.model.noise_intensity
        # Zeros made of a parameter have its type and its batch axis.
        zero = 0.0 * getattr(p, sensor_noise(self.added[0].output))
        intensity = dict.fromkeys(naming.names(self.model.State), zero)
        intensity |= naming.asdict(own(p)) if own is not None else {}
        for low_pass in self.added:
            sd = getattr(p, sensor_noise(low_pass.output))
            intensity[low_pass.state] = low_pass.intensity * sd
        return self.model.State(**intensity)
