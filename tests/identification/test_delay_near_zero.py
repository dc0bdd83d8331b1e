"""A free delay that is none: the record bounds it, whatever the coordinate it is searched in."""

from dataclasses import replace
from typing import Annotated, NamedTuple

import numpy as np
import pytest

from heli_jax import Flight, Free, Nuisance, Problem, fit
from heli_jax.identification.result import Estimate
from heli_jax.identification.uncertainty.estimates import delay_findings
from heli_jax.naming import Scalar
from heli_jax.simulation.inputs import random_steps
from tests.identification.lag import LAG, response

N, DT, FINE, SD = 400, 0.02, 20, 0.02


class Params(NamedTuple):
    Lp: Annotated[Scalar, "1/s", "damping"]
    Ld: Annotated[Scalar, "1/s^2", "effectiveness"]
    tau: Annotated[Scalar, "s", "delay"]


MODEL = replace(LAG, Params=Params, delays=(("d", "tau"),), positive=("tau",))
START = Params(-2.0, 20.0, 0.03)
STICK = random_steps(N, DT, np.random.default_rng(0), (0.2, 0.6)) * 0.1


def late(L: float, B: float, steps: int) -> np.ndarray:
    """SciPy's response (N,) to the stick, late by so many twentieths of a sample."""
    u = np.repeat(STICK, FINE)
    u = np.concatenate([np.full(max(steps, 0), STICK[0]), u])[: u.size]
    # The same start for all, so that the delay alone differs.
    return response(L, B, u, DT / FINE)[::FINE]


def sd_of_delay() -> float:
    """Cramér-Rao's by differences of SciPy's responses."""
    base, rise = late(-4.0, 25.0, 0), 1e-4
    columns = [
        (late(-4.0 + rise, 25.0, 0) - base) / rise,
        (late(-4.0, 25.0 + rise, 0) - base) / rise,
        (late(-4.0, 25.0, 1) - base) / (DT / FINE),
    ]
    J = np.stack(columns, axis=1)
    return SD * float(np.sqrt(np.linalg.inv(J.T @ J)[2, 2]))


@pytest.mark.parametrize("seed", range(2))
def test_a_positive_delay_that_is_none_has_an_upper_limit(seed):
    y = late(-4.0, 25.0, 0) + SD * np.random.default_rng(seed).standard_normal(N)
    flight = Flight(dt=DT, inputs={"d": STICK}, outputs={"p": y})
    free = {"Lp": Free(-3.0), "Ld": Free(20.0), "tau": Free(0.03)}
    nuisance = Nuisance(initial_state=False, bias=False, input_offset=False)
    found = fit(Problem(MODEL, START, [flight], free, nuisance), starts=1)
    tau, sd = found.estimates["tau"], sd_of_delay()
    assert found.status == "converged"
    assert 0 < tau.value < 4 * sd
    assert tau.sd == pytest.approx(sd, rel=0.2)
    assert tau.upper95 == pytest.approx(tau.value + 1.96 * sd, rel=0.2)
    assert tau.upper95 < DT
    told = [f for f in found.findings if f.code == "timing.delay-near-zero"]
    assert bool(told) == (tau.lower95 == 0.0)
    assert abs(found.estimates["Lp"].value + 4.0) < 4 * found.estimates["Lp"].sd


def test_a_delay_below_zero_is_told():
    flight = Flight(dt=DT, inputs={"d": STICK}, outputs={"p": STICK})
    problem = Problem(MODEL, START, [flight], {"tau": Free(0.03)})
    for low, high, codes in (
        (-0.05, -0.03, ["timing.delay-negative"]),
        (-0.01, 0.002, ["timing.delay-near-zero"]),
        (0.08, 0.12, []),
    ):
        estimate = Estimate(0.5 * (low + high), 0.005, low, high, "s", 0.03, 0.0, False)
        found = delay_findings(problem, {"tau": estimate})
        # Two logs whose clocks differ look like it, and then the other estimates are right.
        assert [(f.code, f.severity, f.value) for f in found] == [
            (code, "note", estimate.value) for code in codes
        ]
