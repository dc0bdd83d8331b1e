"""Output error in gusts beside a method that weighs by their spectrum; records by SciPy alone."""

from pathlib import Path

import numpy as np
import pytest
import scipy.linalg

from heli_jax import Flight, Free, Problem, fit, linear_model
from heli_jax.identification.second_method import with_second_method

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
    """15 s of a chirp on the pedal; gusts as an acceleration with a memory of a second."""
    rng = np.random.default_rng(seed)
    t = np.arange(750) * DT
    growth = np.log(40.0) / 15.0
    ped = 0.1 * np.sin(2 * np.pi * 0.1 / growth * np.expm1(growth * t))
    # States r, rfb, psi and the gust; the drive is white noise.
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


def test_estimates_that_gusts_have_made_are_not_to_be_trusted(tmp_path):
    # As much gust as answer: slow drift is taken for a slow pole of the yaw gyro's feedback.
    problem = _problem(tmp_path, 1.5, "output-error")
    found = fit(problem)
    z = {n: (e.value - TRUTH[n]) / (e.sd or np.inf) for n, e in found.estimates.items()}
    assert max(abs(v) for v in z.values()) > 4.0  # or there is nothing to be said
    beside = with_second_method(problem, found)
    assert beside.not_borne_out
    assert beside.untrusted == tuple(TRUTH)
    assert "does not bear" in beside.distrust
    assert any("frequency-error, or filter-error" in note for note in beside.notes)


def test_what_goes_along_with_an_open_parameter_has_the_interval_of_both(tmp_path):
    # An optimum of chance beside Kr = 0, where the lag Krfb has no effect: slopes there bound both.
    found = fit(_problem(tmp_path, 1.5, "frequency-error", seed=3))
    assert {"Kr", "Krfb"} <= {n for n, e in found.estimates.items() if e.sd is None}
    assert found.estimates["Nr"].sd is not None
    for name, e in found.estimates.items():
        if e.sd is not None:
            assert e.lower95 is not None
            assert e.upper95 is not None
            assert e.lower95 < TRUTH[name] < e.upper95, name


def test_without_gusts_nothing_is_asked(tmp_path):
    problem = _problem(tmp_path, 0.0, "output-error")
    found = fit(problem)
    assert with_second_method(problem, found) is found
    for name, e in found.estimates.items():
        assert e.sd is not None
        assert e.value == pytest.approx(TRUTH[name], abs=4.0 * e.sd)
