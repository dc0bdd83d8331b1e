"""A yaw axis that runs away, held by a late pilot in gusts: each method, and what it says of it.

The record is made in NumPy by small Euler steps; exp(0.8 1/s * 60 s) is 7e20.
"""

import numpy as np
import pytest

from heli_jax import Flight, Free, Nuisance, Problem, fit, linear_model
from heli_jax.dynamics.disturbance import with_disturbance

TRUTH = {"Nr": 0.8, "Nped": 6.0}
STEP, SUB, SECONDS, LATE = 0.002, 10, 60.0, 60
YAW = """name: yaw
states: {psi: {unit: rad}, r: {unit: rad/s}}
inputs: {ped: '1'}
outputs: {psi: rad, r: rad/s}
parameters: {Nr: {value: -0.5, unit: 1/s}, Nped: {value: 3.0, unit: 1/s^2}}
A: {psi: {r: 1}, r: {r: Nr}}
B: {r: {ped: Nped}}
axes: {yaw: {rate: r, angle: psi, stick: ped}}
"""


def record(seed):
    rng = np.random.default_rng(seed)
    N = round(SECONDS / STEP / SUB)
    test = np.repeat(0.2 * rng.choice([-1.0, 0.0, 1.0], N // 25), 25)
    psi = r = w = 0.0
    past, rows = np.zeros((LATE, 2)), np.zeros((N, 3))
    gust = 0.35 * np.sqrt(2.0 / STEP) * rng.standard_normal(N * SUB)
    for k in range(N * SUB):
        if k % SUB == 0:
            ped = test[k // SUB] - past[k % LATE] @ [0.25, 0.35]
            rows[k // SUB] = ped, psi, r
        past[k % LATE] = psi, r
        rate = 0.8 * r + 6.0 * ped + w
        psi, r, w = psi + STEP * r, r + STEP * rate, w + STEP * (gust[k] - w)
    noise = rng.standard_normal((N, 2)) * np.deg2rad([0.5, 1.0])
    measured = {"psi": rows[:, 1] + noise[:, 0], "r": rows[:, 2] + noise[:, 1]}
    return Flight(dt=STEP * SUB, inputs={"ped": rows[:, 0]}, outputs=measured)


def fitted(tmp_path, start, *, disturbed=False, **how):
    (tmp_path / "yaw.yaml").write_text(YAW)
    bare = linear_model(tmp_path / "yaw.yaml")
    model = with_disturbance(bare.model, "yaw", 1) if disturbed else bare.model
    values = dict(zip(TRUTH, start, strict=True))
    known = values | ({"sigma_w": 0.1, "tau_w": 1.0} if disturbed else {})
    free = {n: Free(v) for n, v in values.items()}
    return fit(Problem(model, model.Params(**known), [record(1)], free, **how))


@pytest.mark.slow
@pytest.mark.parametrize("start", [(-0.5, 3.0), (0.8, 6.0)], ids=["stable start", "at the truth"])
def test_filter_error_finds_it_and_is_judged_by_predictions(tmp_path, start):
    found = fitted(tmp_path, start, disturbed=True, method="filter-error")
    assert found.status == "converged"
    for name, truth in TRUTH.items():
        estimate = found.estimates[name]
        assert abs(estimate.value - truth) < 3.0 * estimate.sd
    assert found.estimates["Nr"].sd < 0.1
    assert found.adequate
    assert found.adequacy.ahead == 2.0


@pytest.mark.slow
def test_frequency_error_and_windows_say_that_feedback_moved_them(tmp_path):
    direct = fitted(tmp_path, (-0.5, 3.0), method="frequency-error")
    assert direct.untrusted == ("Nr",)
    windows = fitted(tmp_path, (-0.5, 3.0), window=2.0, nuisance=Nuisance(initial_state=True))
    assert windows.untrusted == ("Nr", "Nped")
    assert {d.code for d in windows.distrusts.values()} == {"loop.feedback"}
