"""Fits in gusts whose response to the inputs implies other values; records by SciPy alone."""

from pathlib import Path

import numpy as np
import pytest
import scipy.linalg
import scipy.signal
import scipy.stats

from heli_jax import Flight, Free, Problem, fit, linear_model
from heli_jax.dynamics.disturbance import with_disturbance
from heli_jax.identification.validation.score_test import lines_of, pulled_away

ASKS_OTHERWISE = "agreement.inputs-ask-otherwise"
TRUTH = {"Nr": -2.92, "Nped": 20.8, "Kr": 1.376, "Krfb": -5.625}
YAW = """
name: yaw
states: {r: rad/s, rfb: rad/s, psi: rad}
inputs: {ped: "1"}
outputs: {r: rad/s, psi: rad}
parameters:
  Nr: {value: -2.92, unit: 1/s}
  Nped: {value: 20.8, unit: rad/s^2}
  Kr: {value: 1.376, unit: 1/s}
  Krfb: {value: -5.625, unit: 1/s}
A: {r: {r: Nr, rfb: -20}, rfb: {r: Kr, rfb: Krfb}, psi: {r: 1}}
B: {r: {ped: Nped}}
"""
DT = 0.02


def _record(gust: float, seed: int = 4) -> Flight:
    """Return 15 s of a pedal chirp, with gusts as an acceleration with 1 s correlation time."""
    rng = np.random.default_rng(seed)
    t = np.arange(750) * DT
    growth = np.log(40.0) / 15.0
    ped = 0.1 * np.sin(2 * np.pi * 0.1 / growth * np.expm1(growth * t))
    # States are r, rfb, psi and the gust; white noise drives it.
    A = np.array(
        [
            [TRUTH["Nr"], -20.0, 0.0, 1.0],
            [TRUTH["Kr"], TRUTH["Krfb"], 0.0, 0.0],
            [1.0, 0.0, 0.0, 0.0],
            [0.0, 0.0, 0.0, -1.0],
        ]
    )
    B = np.array([TRUTH["Nped"], 0.0, 0.0, 0.0])
    steps = scipy.linalg.expm(DT * np.vstack([np.column_stack([A, B]), np.zeros(5)]))
    Q = np.zeros((4, 4))
    Q[3, 3] = 2.0 * gust**2
    van_loan = scipy.linalg.expm(DT * np.block([[-A, Q], [np.zeros((4, 4)), A.T]]))
    added = van_loan[4:, 4:].T @ van_loan[:4, 4:]
    root = np.linalg.cholesky(added + 1e-18 * np.eye(4))
    x, rows = np.array([0.0, 0.0, 0.0, gust * rng.standard_normal()]), []
    for u in ped:
        rows.append(x)
        x = steps[:4, :4] @ x + steps[:4, 4] * u + root @ rng.standard_normal(4)
    X = np.array(rows)
    noise = 0.02 * np.std(X, axis=0) * rng.standard_normal(X.shape)
    return Flight(
        dt=DT,
        inputs={"ped": ped},
        outputs={"r": (X + noise)[:, 0], "psi": (X + noise)[:, 2]},
    )


def _problem(folder: Path, gust: float, method: str, seed: int = 4) -> Problem:
    (folder / "yaw.yaml").write_text(YAW)
    yaw = linear_model(folder / "yaw.yaml")
    free = {n: Free(v * f) for (n, v), f in zip(TRUTH.items(), (1.5, 0.7, 0.7, 1.5), strict=True)}
    return Problem(yaw.model, yaw.vehicle({}).params, [_record(gust, seed)], free, method=method)


ROTOR = {"tau_f": 0.09, "Lb": 95.0, "Blat": 0.12}
ROLL = """
name: rotor-roll
states: {p: rad/s, b: rad}
inputs: {lat: "1"}
outputs: {p: rad/s}
parameters:
  tau_f: {value: 0.09, unit: s, positive: true}
  Lb: {value: 95, unit: 1/s^2}
  Blat: {value: 0.12, unit: rad}
A: {p: {b: Lb}, b: {p: -1, b: -1/tau_f}}
B: {b: {lat: Blat/tau_f}}
"""


def _turned_by_gusts(seed: int) -> Flight:
    """Return a minute of doublets, with gusts as strong as the response to them."""
    rng, n = np.random.default_rng(seed), 3000
    lat, k = np.zeros(n), 25
    while k < n:
        half = int(rng.uniform(10, 50))
        lat[k : k + half], lat[k + half : k + 2 * half] = 0.5, -0.5
        k += 3 * half
    A = np.array([[0.0, ROTOR["Lb"]], [-1.0, -1.0 / ROTOR["tau_f"]]])
    B = np.array([[0.0], [ROTOR["Blat"] / ROTOR["tau_f"]]])
    system = (A, B, np.array([[1.0, 0.0]]), np.zeros((1, 1)))
    answer = scipy.signal.lsim(system, lat, np.arange(n) * DT, interp=False)[1]
    # Ten steps per sample make the gust nearly continuous.
    forget = np.exp(-0.1 * DT / 0.7)
    drive = np.sqrt(1.0 - forget**2) * rng.standard_normal(10 * n)
    gust = scipy.signal.lfilter([1.0], [1.0, -forget], drive)
    pushed = (A, np.array([[1.0], [0.0]]), system[2], system[3])
    by_gusts = scipy.signal.lsim(pushed, gust, np.arange(10 * n) * 0.1 * DT)[1][::10]
    by_gusts *= 1.5 * np.std(answer) / np.std(by_gusts)
    p = answer + by_gusts + 0.03 * np.std(answer) * rng.standard_normal(n)
    return Flight(dt=DT, inputs={"lat": lat}, outputs={"p": p}, hold={"lat": "zero-order"})


@pytest.mark.slow
def test_a_disturbance_in_the_wrong_place_is_told_by_the_inputs(tmp_path):
    # Taken for a force on the rotor they pass another lag, which the parameters compensate.
    (tmp_path / "roll.yaml").write_text(ROLL)
    roll = linear_model(tmp_path / "roll.yaml")
    free = {n: Free(1.2 * v) for n, v in ROTOR.items()}
    model = with_disturbance(roll.model, ("b",))
    params = model.Params(**roll.vehicle({}).params._asdict())
    found = fit(Problem(model, params, [_turned_by_gusts(1)], free, method="filter-error"))
    z = {n: (e.value - ROTOR[n]) / (e.sd or np.inf) for n, e in found.estimates.items()}
    assert max(abs(v) for v in z.values()) > 4.0
    [asks] = [f for f in found.findings if f.code == ASKS_OTHERWISE]
    assert asks.value < 1e-3
    # Towards the truth.
    assert asks.shifts["tau_f"] > 0.0
    assert "tau_f" in found.untrusted
    assert found.exit_code == 3


def test_what_the_inputs_ask_for_is_told_in_any_colour():
    rng, n = np.random.default_rng(7), 2000
    answers = scipy.signal.lfilter([0.1], [1.0, -0.9], rng.standard_normal((n, 3)), axis=0)
    chances = []
    for _ in range(60):
        noise = scipy.signal.lfilter([1.0], [1.0, -1.9, 0.95], rng.standard_normal(n))
        lines = lines_of(noise, answers, np.zeros((n, 0)))
        chances.append(pulled_away([lines], 2))
    # Uniform if the values agree with the inputs.
    assert scipy.stats.kstest(chances, "uniform").pvalue > 0.01
    off = lines_of(noise + 2.0 * answers[:, 0], answers, np.zeros((n, 0)))
    aside = lines_of(noise + 2.0 * answers[:, 2], answers, np.zeros((n, 0)))
    assert pulled_away([off], 2) < 1e-4
    # Effects that the nuisances absorb do not affect the parameters.
    assert pulled_away([aside], 2) > 1e-3


def test_what_goes_along_with_an_open_parameter_has_the_interval_of_both(tmp_path):
    # A chance optimum near Kr = 0, where the lag Krfb has no effect: slopes there bound both.
    found = fit(_problem(tmp_path, 1.5, "frequency-error", seed=3))
    assert {"Kr", "Krfb"} <= {n for n, e in found.estimates.items() if e.sd is None}
    assert found.estimates["Nped"].sd is not None
    for name, e in found.estimates.items():
        if e.sd is not None:
            assert e.lower95 < TRUTH[name] < e.upper95, name


def test_without_gusts_nothing_is_found(tmp_path):
    found = fit(_problem(tmp_path, 0.0, "output-error"))
    assert found.exit_code == 0
    for name, e in found.estimates.items():
        assert e.value == pytest.approx(TRUTH[name], abs=4.0 * e.sd)
