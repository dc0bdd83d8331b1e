"""Experiment configurations: validated YAML, and the problems that they describe."""

from heli_jax.config.experiment import Experiment, in_wind, load, resolved
from heli_jax.config.logs import first_signals, read_flights, signals
from heli_jax.config.problems import (
    by_method,
    by_other_methods,
    candidate_models,
    disturbed,
    problem,
)
from heli_jax.config.run_sections import SimulateConfig, StickConfig
from heli_jax.config.schema import Config

__all__ = [
    "Config",
    "Experiment",
    "SimulateConfig",
    "StickConfig",
    "by_method",
    "by_other_methods",
    "candidate_models",
    "disturbed",
    "first_signals",
    "in_wind",
    "load",
    "problem",
    "read_flights",
    "resolved",
    "signals",
]
