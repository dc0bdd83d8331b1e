"""Stopping of the relaxation of a noise spectrum."""

from types import SimpleNamespace
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

from heli_jax.identification.estimation.levenberg_marquardt import Optimum
from heli_jax.identification.estimation.noise_covariance import (
    RelaxedOptimum,
    relax_noise_covariance,
)
from heli_jax.identification.unknowns.layout import Noise


class Slowly:
    """A method with one unknown, whose optimum moves less in each round."""

    def __init__(self, moves: list[float]) -> None:
        self.moves = iter(moves)

    def relax(self, layout: Any, data: Any, noise: Noise, z: Any) -> Any:
        return z, noise._replace(log_determinant=noise.log_determinant + 0.01)

    def noise_matters(self, *_: Any) -> bool:
        return True

    def finish(self, layout: Any, data: Any, noise: Noise, z: Any) -> Any:
        return z

    def run(self, noise: Noise, points: Any) -> list[Optimum]:
        z = points[0] + next(self.moves)
        moved = np.sum((z - points[0]) ** 2)
        return [Optimum(z, 1.0, 1, True, float(moved))]


def optimum_of(falls: float) -> RelaxedOptimum:
    objective = Slowly([falls**k for k in range(100)])
    layout = SimpleNamespace(objective=objective, noise_model="white")
    search: Any = SimpleNamespace(layout=layout, data=None, problem=None, run=objective.run)
    noise = Noise(({"p": np.ones(())},), np.zeros(()))
    begun = Optimum(jnp.zeros(1), 1.0, 1, True)
    return relax_noise_covariance(search, noise, begun)


def test_a_spectrum_that_settles_slowly_is_relaxed_until_it_has():
    # Moves of 1, 0.8, 0.64, ... add up to 5 joint standard deviations.
    assert float(optimum_of(0.8).best.z[0]) == pytest.approx(5.0, abs=0.05)


def test_rounds_that_run_out_before_a_spectrum_settles_are_said():
    (said,) = optimum_of(0.95).notes
    assert (said.code, said.severity) == ("search.noise-not-settled", "doubt")
    assert said.value == pytest.approx(0.95**29, rel=1e-6)
    assert optimum_of(0.8).notes == ()
