"""A free delay: zero, with the record's bound, or far from its start value."""

from dataclasses import replace
from typing import Annotated, NamedTuple

import numpy as np
import pytest
import scipy.linalg

from heli_jax import Flight, Free, Nuisance, Problem, fit, linear_model
from heli_jax.dynamics.disturbance import with_disturbance
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
    """Return SciPy's response (N,) to the stick, late by a number of twentieths of a sample."""
    u = np.repeat(STICK, FINE)
    u = np.concatenate([np.full(max(steps, 0), STICK[0]), u])[: u.size]
    # All have the same start, so that only the delay differs.
    return response(L, B, u, DT / FINE)[::FINE]


def sd_of_delay() -> float:
    """Return the Cramér-Rao bound by differences of SciPy's responses."""
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
    assert abs(found.estimates["Lp"].value + 4.0) < 4 * found.estimates["Lp"].sd


def test_filter_error_finds_a_stick_that_is_late_by_ten_samples():
    count, dt, lateness = 1500, 0.01, 10
    rng = np.random.default_rng(0)
    stick, k = np.zeros(count), 100
    while k < count - 100:
        width = int(rng.uniform(15, 120))
        stick[k : k + width] = rng.choice([-1, 0, 1]) * rng.uniform(0.12, 0.3)
        k += width
    A, B = np.array([[0.0, 120.0], [-1.0, -1.0 / 0.06]]), np.array([[0.0], [0.1 / 0.06]])
    M = scipy.linalg.expm(np.block([[A, B], [np.zeros((1, 3))]]) * dt)
    x, p = np.zeros(2), []
    for u in stick:
        p.append(x[0])
        x = M[:2, :2] @ x + M[:2, 2] * u
    measured = np.array(p) + 0.01 * rng.standard_normal(count)
    logged = np.concatenate([np.full(lateness, stick[0]), stick])[:count]
    flight = Flight(dt=dt, inputs={"lat": logged}, outputs={"p": measured})
    loaded = linear_model("roll-flybarless")
    params = loaded.vehicle().params
    # From there a full Gauss-Newton step increases the cost for most of the tried delays.
    free = {"Lb": Free(166.1), "Blat": Free(0.1398), "tau_f": Free(0.04631)}
    model = with_disturbance(loaded.model, "p")
    vehicle = model.Params(**params._asdict(), sigma_w=3.0, tau_w=1.0)
    nuisance = Nuisance(time_shift=True)
    found = fit(Problem(model, vehicle, [flight], free, nuisance, method="filter-error"))
    shift = found.nuisance["time_shift"]
    assert found.exit_code == 0
    assert abs(shift.value + lateness * dt) < 3 * shift.sd < 0.005
    for name, true in (("Lb", 120.0), ("Blat", 0.1), ("tau_f", 0.06)):
        assert abs(found.estimates[name].value - true) < 3 * found.estimates[name].sd
