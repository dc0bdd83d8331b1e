"""How long the relaxation of a noise that is a spectrum goes on."""

from types import SimpleNamespace
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

from heli_jax.identification.estimation.estimator import Nearing
from heli_jax.identification.estimation.levenberg_marquardt import Optimum
from heli_jax.identification.estimation.noise_covariance import (
    RelaxedOptimum,
    relax_noise_covariance,
)
from heli_jax.identification.unknowns.layout import Noise


class Slowly:
    """An estimator with one unknown, whose optimum moves by a fifth less from round to round."""

    relaxes_rows, nuisances_in_rows, nearing = False, True, Nearing(0.3)

    def __init__(self, moves: list[float]) -> None:
        self.moves, self.searches = iter(moves), 0

    def whole(self, noise: Noise) -> Noise:
        return noise if noise.part == 1.0 else noise._replace(part=1.0)

    def relax(self, layout: Any, data: Any, e: Any, noise: Noise, z: Any) -> Any:
        return z, noise._replace(log_variance_ratio=noise.log_variance_ratio + 0.01)

    def noise_matters(self, *_: Any) -> bool:
        return True

    def with_nuisances(self, layout: Any, data: Any, noise: Noise, z: Any) -> Any:
        return z

    def run(self, noise: Noise, points: Any, *, nearing: Nearing) -> list[Optimum]:
        self.searches += 1
        z = points[0] + next(self.moves)
        moved = np.sum((z - points[0]) ** 2)
        return [Optimum(z, jnp.ones(()), np.asarray(1), np.asarray(True), moved)]


def optimum_of(estimator: Slowly, part: float) -> RelaxedOptimum:
    search: Any = SimpleNamespace(
        layout=SimpleNamespace(estimator=estimator), data=None, problem=None, run=estimator.run
    )
    noise = Noise(({"p": np.ones(())},), np.zeros(()), part=part)
    begun = Optimum(jnp.zeros(1), jnp.ones(()), np.asarray(1), np.asarray(True))
    return relax_noise_covariance(search, noise, begun)


def relaxed(estimator: Slowly, part: float) -> float:
    return float(optimum_of(estimator, part).best.z[0])


def test_a_spectrum_that_settles_slowly_is_relaxed_until_it_has():
    # Moves of 1, 0.8, 0.64, ... add up to 5 joint standard deviations.
    assert relaxed(Slowly([0.8**k for k in range(100)]), 1.0) == pytest.approx(5.0, abs=0.3)


def test_a_search_by_a_part_that_finds_no_step_is_followed_by_one_by_all_lines():
    estimator = Slowly([0.0, 0.5, 0.01])
    assert relaxed(estimator, 0.25) == pytest.approx(0.5, abs=0.02)
    assert estimator.searches >= 2


def test_rounds_that_run_out_before_a_spectrum_settles_are_said():
    (said,) = optimum_of(Slowly([0.95**k for k in range(100)]), 1.0).notes
    assert (said.code, said.severity) == ("search.noise-not-settled", "doubt")
    assert said.value == pytest.approx(0.23, abs=0.005)
    assert optimum_of(Slowly([0.8**k for k in range(100)]), 1.0).notes == ()
