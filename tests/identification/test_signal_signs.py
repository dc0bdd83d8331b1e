"""Consistency of signs, units and clocks of signals."""

from types import SimpleNamespace

import numpy as np
import pytest

from heli_jax import Flight
from heli_jax.identification.diagnostics.units import rate_against_angle
from tests.identification.test_enough import DT, problem, response, steps

N = 1000
DEGREE = np.pi / 180.0


def moved(seed=0):
    """Return an oscillating angle by SciPy, and its rate, with sensor noise."""
    rng = np.random.default_rng(seed)
    u = steps(rng, N)
    phi, p = response(u, np.zeros(N))
    return u, phi + 0.003 * rng.standard_normal(N), p + 0.02 * rng.standard_normal(N)


def said(phi, p):
    u = np.zeros(N)
    flight = Flight(dt=DT, inputs={"u": u, "v": u}, outputs={"phi": phi, "p": p})
    asked = SimpleNamespace(
        flights=[("one", flight)], problem=problem(flight), status="not-converged", estimates={}
    )
    return list(rate_against_angle(asked))


def test_an_angle_that_moves_as_its_rate_says_nothing():
    for seed in range(20):
        _, phi, p = moved(seed)
        assert said(phi, p) == []
        # A bias, a gyro scale off by 1 %, and one in five samples of the angle.
        assert said(phi + 1.0, 1.01 * p - 0.3) == []
        assert said(np.where(np.arange(N) % 5 == 0, phi, np.nan), p) == []
        # Unrelated signals give no result.
        assert said(phi, moved(seed + 100)[2]) == []


@pytest.mark.parametrize(
    ("angle", "rate", "denies"),
    [
        (DEGREE, 1.0, True), (1.0, DEGREE, True), (-1.0, 1.0, True), (1.0, -DEGREE, True),
        (2.0, 1.0, False),
    ],
)  # fmt: skip
def test_a_wrong_sign_or_unit_of_an_angle_or_its_rate_is_said(angle, rate, denies):
    _, phi, p = moved()
    [found] = said(angle * phi, rate * p)
    assert (found.code, found.subjects) == ("signs.rate-against-angle", ("p", "phi"))
    assert found.value == pytest.approx(angle / rate, rel=0.05)
    # No model can follow reversed signs or other units, but it can absorb a scale.
    assert found.denies is denies


def test_a_rate_that_is_too_large_for_its_angle_is_said():
    for seed in range(5):
        _, phi, p = moved(seed)
        for scale in (1.25, 0.8, 0.93):
            [found] = said(phi, scale * p)
            assert (found.code, found.severity) == ("units.rate-scale", "doubt")
            assert found.value == pytest.approx(scale, rel=0.05)
