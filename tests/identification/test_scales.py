"""Unknowns of very different size, or without effect, at the start or at all.

Each moves to the data's value, or is marked as not identifiable.
"""

from typing import NamedTuple

import numpy as np
import pytest
import scipy.signal

from heli_jax import Flight, Free, Model, Nuisance, Problem, fit

N, DT = 200, 0.05
NOTHING = Nuisance(initial_state=False, bias=False)
rng = np.random.default_rng(3)
NOISE = rng.standard_normal(N)


class Params(NamedTuple):
    K: float
    tau: float
    a: float
    b: float
    c: float


class State(NamedTuple):
    x: float


class Inputs(NamedTuple):
    u: float
    v: float
    w: float


class Outputs(NamedTuple):
    y: float


# A lag whose time constant has no effect at zero gain, two direct inputs, and an unused parameter.
model = Model(
    "scales",
    lambda p, s, u: State(x=(p.K * u.u - s.x) / p.tau + 0.0 * p.c),
    lambda p, s, u: Outputs(y=s.x + p.a * u.v + p.b * u.w),
    Params, State, Inputs, Outputs, linear=True, positive=("tau",),
)  # fmt: skip
U = np.repeat(rng.uniform(-1.0, 1.0, N // 10), 10)
V, W = 1e8 * rng.uniform(-1.0, 1.0, N), 1e-6 * rng.uniform(-1.0, 1.0, N)


def fitted(y, free, **inputs):
    flight = Flight(dt=DT, inputs=inputs, outputs={"y": y})
    start = Params(K=0.0, tau=0.2, a=0.0, b=0.0, c=1.0)
    return fit(Problem(model, start, [flight], free, NOTHING))


@pytest.mark.parametrize("start", [(0.0, 0.0), (3e-8, -1e5)])
def test_parameters_of_1e_minus_8_and_1e6_are_found_together(start):
    y = 2e-8 * V + 3e6 * W + 0.1 * NOISE
    free = {"a": Free(start[0], sign="any"), "b": Free(start[1], sign="any")}
    found = fitted(y, free, u=np.zeros(N), v=V, w=W)
    exact, *_ = np.linalg.lstsq(np.stack([V, 1e12 * W], axis=1), y, rcond=None)
    assert found.status == "converged"
    # Cramér-Rao bound of each, by hand; a search ends within a hundredth of it.
    sd = np.std(y - V * exact[0] - 1e12 * W * exact[1])
    assert found.estimates["a"].value == pytest.approx(exact[0], abs=0.02 * found.estimates["a"].sd)
    b = 1e12 * exact[1]
    assert found.estimates["b"].value == pytest.approx(b, abs=0.02 * sd / np.linalg.norm(W))
    assert found.estimates["b"].sd == pytest.approx(sd / np.linalg.norm(W), rel=0.02)


def test_what_has_no_effect_at_the_start_alone_moves():
    pole = np.exp(-DT / 0.5)
    y = scipy.signal.lfilter([0.0, 2.0 * (1.0 - pole)], [1.0, -pole], U) + 0.01 * NOISE
    free = {"K": Free(0.0, sign="any"), "tau": Free(0.2), "c": Free(1.0)}
    found = fitted(y, free, u=U, v=np.zeros(N), w=np.zeros(N))
    for name, truth in (("K", 2.0), ("tau", 0.5)):
        e = found.estimates[name]
        assert abs(e.value - truth) < 4.0 * e.sd < 0.1
    # A parameter without effect stays at its start, and a finding states this.
    assert found.status == "not-identifiable"
    assert found.verdict.without_effect == ("c",)
    assert found.estimates["c"].value == 1.0
    assert found.estimates["c"].sd is None
