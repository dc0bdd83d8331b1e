"""The inputs of a run that the project makes itself, as a configuration describes them."""

import warnings

import numpy as np

from heli_jax import naming, units
from heli_jax.config import Experiment, SimulateConfig, StickConfig
from heli_jax.errors import InputError, nearest
from heli_jax.simulation import inputs as sticks


def stick_inputs(
    experiment: Experiment, settings: SimulateConfig, n: int, rng: np.random.Generator, where: str
) -> dict[str, np.ndarray]:
    """Every input of the model in SI; one that is not named stays at neutral.

    Args:
        experiment: of which the model's inputs count.
        settings: the configuration's `simulate`.
        n: samples.
        rng: what is random is drawn from it.
        where: what errors begin with.

    Raises:
        InputError: an input that the model lacks, or a unit of the wrong kind.
    """
    record = experiment.model.Inputs
    for name in settings.inputs:
        if name not in naming.names(record):
            raise InputError(
                f"{where}.inputs: model {experiment.model.name} has no input {name!r}"
                f"{nearest(name, naming.names(record))}"
            )
    out = {}
    # In the model's order, not the configuration's: the draws must not depend on how it is written.
    for name in naming.names(record):
        stick = settings.inputs.get(name)
        if stick is None:
            out[name] = np.zeros(n)
            continue
        si = naming.unit(record, name) or "1"
        scale = factor_to_si(stick.unit or si, si, f"{where}.inputs.{name}.unit")
        out[name] = stick.amplitude * scale * _stick(stick, n, 1.0 / settings.rate, rng)
    return out


def _stick(config: StickConfig, n: int, dt: float, rng: np.random.Generator) -> np.ndarray:
    if config.kind == "random-steps":
        return sticks.random_steps(n, dt, rng, config.hold)
    if config.kind == "3-2-1-1":
        return sticks.multistep_3211(n, dt, rng, config.step, config.pause)
    if config.kind == "sweep":
        # Now the word for a parameter sweep alconfig.
        warnings.warn("kind: sweep is deprecated, expected chirp", DeprecationWarning, stacklevel=2)
    if config.kind in ("chirp", "sweep"):
        return sticks.chirp(n, dt, *config.band)
    return np.zeros(n)


def factor_to_si(unit: str, si: str, where: str) -> float:
    """As `units.factor`, with a place.

    Args:
        unit: what a configuration says.
        si: the SI unit of what it is for.
        where: what errors begin with.

    Raises:
        InputError: the unit is unknown, or of another kind than `si`.
    """
    try:
        return units.factor(unit, si)
    except ValueError as e:
        raise InputError(f"{where}: {e}") from e
