"""Filter error on records of four outputs, each with its noise, and without a disturbance."""

from dataclasses import replace
from typing import Annotated, NamedTuple

import numpy as np
import pytest
import scipy.signal

from heli_jax import Flight, Free, Nuisance, Problem, fit
from heli_jax.dynamics.disturbance import with_disturbance
from heli_jax.dynamics.model import Axis
from heli_jax.naming import Scalar
from heli_jax.simulation.inputs import random_steps
from tests.identification.lag import LAG

N, DT = 200, 0.04
NOISE = {"p": 0.02, "gyro": 0.05, "arm": 0.1, "slow": 0.01}
"""Standard deviation of each output's measurement noise."""


class Outputs(NamedTuple):
    p: Annotated[Scalar, "rad/s", "rate"]
    gyro: Annotated[Scalar, "rad/s", "the same by another sensor"]
    arm: Annotated[Scalar, "m/s", "of a sensor two metres out"]
    slow: Annotated[Scalar, "rad/s", "a third of the rate"]


MODEL = with_disturbance(
    replace(
        LAG,
        output=lambda p, s, u: Outputs(p=s.p, gyro=s.p, arm=2.0 * s.p, slow=s.p / 3.0),
        Outputs=Outputs,
        axes=(Axis("roll", rate="p"),),
    ),
    "roll",
)


def fitted(seed: int, disturbance: float = 0.0):
    """Fit a record of SciPy's whose disturbance is white noise through a lag of 0.5 s."""
    rng = np.random.default_rng(seed)
    u = random_steps(N, DT, rng, (0.2, 1.0))
    held = scipy.signal.cont2discrete(([3.0], [1.0, 2.0]), DT)
    p = scipy.signal.lfilter(np.ravel(held[0]), held[1], u)
    lag = np.exp(-DT / 0.5)
    drive = disturbance * np.sqrt(1 - lag**2) * rng.standard_normal(N)
    w = scipy.signal.lfilter([1.0], [1.0, -lag], drive)
    p = p + scipy.signal.lfilter(np.ravel(held[0]) / 3.0, held[1], w)
    clean = {"p": p, "gyro": p, "arm": 2.0 * p, "slow": p / 3.0}
    outputs = {n: y + NOISE[n] * rng.standard_normal(N) for n, y in clean.items()}
    params = MODEL.Params(Lp=-2.0, Ld=3.0, sigma_w=0.0, tau_w=1.0)
    flight = Flight(dt=DT, inputs={"d": u}, outputs=outputs)
    free = {"Lp": Free(-1.5), "Ld": Free(2.0)}
    # From rest and without biases, as in the record: fewer unknowns compile faster.
    none = Nuisance(initial_state=False, bias=False, input_offset=False)
    return fit(Problem(MODEL, params, [flight], free, none, method="filter-error"))


def test_white_noise_of_four_outputs_has_no_disturbance():
    found = fitted(0)
    assert "noise.no-disturbance" in {f.code for f in found.findings}
    assert found.nuisance["sigma_w"].value == 0.0
    assert found.status == "converged"
    for name, true in (("Lp", -2.0), ("Ld", 3.0)):
        assert abs(found.estimates[name].value - true) < 4 * found.estimates[name].sd


def test_a_disturbance_that_four_outputs_show_is_found():
    found = fitted(0, disturbance=0.5)
    assert "noise.no-disturbance" not in {f.code for f in found.findings}
    assert found.nuisance["sigma_w"].value == pytest.approx(0.5, rel=0.4)
