"""Frequency error by instrument: equations, closed loops and findings."""

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

from heli_jax import Flight, Free, Nuisance, Problem, fit, linear_model
from heli_jax.analysis.spectra import ResponseOptions
from heli_jax.identification.diagnostics.loop import inputs_follow_response
from heli_jax.identification.diagnostics.search import band_unused
from heli_jax.identification.estimation.data import data_of
from heli_jax.identification.estimation.frequency_instrument import (
    as_instruments_have_it,
    following,
)
from heli_jax.identification.estimation.frequency_lines import orthonormal, projection
from heli_jax.identification.estimation.frequency_noise import smoothed
from heli_jax.identification.estimation.levenberg_marquardt import (
    optimise,
    residual_and_jacobian,
)
from heli_jax.identification.fit import context_of
from heli_jax.identification.result import Fit
from heli_jax.identification.validation.excitation import _sums_over_bands
from heli_jax.identification.validation.follows_response import feedback_of

DT = 0.04
LEANING = """
name: leaning
states: {p: rad/s, phi: rad}
inputs: {lat: "1"}
outputs: {p: rad/s, phi: rad}
parameters:
  Lphi: {value: 0.4, unit: 1/s^2, source: none}
  Lp: {value: -2.0, unit: 1/s, source: none}
  Llat: {value: 10.0, unit: rad/s^2, source: none}
A: {p: {p: Lp, phi: Lphi}, phi: {p: 1}}
B: {p: {lat: Llat}}
C: {p: {p: 1}, phi: {phi: 1}}
"""
TRUTH = {"Lphi": 0.4, "Lp": -2.0, "Llat": 10.0}


def flown(seed: int, n: int = 3000) -> Flight:
    """Return an unstable vehicle held upright by a pilot in gusts, with random steps added."""
    rng = np.random.default_rng(seed)
    M = np.zeros((4, 4))
    M[0], M[1, 0] = [TRUTH["Lp"], TRUTH["Lphi"], TRUTH["Llat"], 1.0], 1.0
    E, keeps = scipy.linalg.expm(M * DT), np.exp(-DT / 0.7)
    steps = np.repeat(rng.choice([-0.12, 0.12], n // 20), 20)
    x, gust, y, u = np.zeros(2), 0.0, np.zeros((n, 2)), np.zeros(n)
    for k in range(n):
        y[k] = x + rng.standard_normal(2) * [2e-3, 1e-3]
        u[k] = steps[k] - 0.05 * x[0] - 0.2 * x[1]
        x = E[:2, :2] @ x + E[:2, 2] * u[k] + E[:2, 3] * gust
        gust = keeps * gust + 0.25 * np.sqrt(1 - keeps**2) * rng.standard_normal()
    outputs = {"p": y[:, 0], "phi": y[:, 1]}
    return Flight(dt=DT, inputs={"lat": u}, outputs=outputs, instruments={"lat": steps})


@pytest.fixture(scope="module")
def leaning(tmp_path_factory):
    path = tmp_path_factory.mktemp("model") / "leaning.yaml"
    path.write_text(LEANING)
    return linear_model(path)


def problem(leaning, flights, **more):
    free = {n: Free(1.3 * v) for n, v in TRUTH.items()}
    off = Nuisance(initial_state=False, bias=False, input_offset=False)
    method = {"method": "frequency-error", **more}
    return Problem(leaning.model, leaning.vehicle().params, flights, free, off, **method)


def test_the_rows_solve_the_equations_and_have_their_covariance():
    rng = np.random.default_rng(0)
    J, Z = rng.standard_normal((2, 3, 50)) * np.array([1.0, 1e6, 1e-4])[None, :, None]
    e, Q = rng.standard_normal(50), np.linalg.qr(rng.standard_normal((50, 4)))[0]

    Q, _ = projection(jnp.asarray(Q * np.array([1.0, 1e3, 1e-3, 1.0])))
    e, J, F = (v - v @ np.asarray(Q @ Q.T) for v in (e, J, Z))

    def weighed(F):
        S = np.asarray(orthonormal(jnp.asarray(F @ F.T)))
        return S.T @ F @ e, S.T @ F @ J.T

    r, M = weighed(F)
    np.testing.assert_allclose(np.linalg.solve(M, r), np.linalg.solve(F @ J.T, F @ e), rtol=1e-8)
    inverse = np.linalg.inv(F @ J.T)
    covariance = inverse @ (F @ F.T) @ inverse.T
    np.testing.assert_allclose(np.linalg.inv(M.T @ M), covariance, rtol=1e-8)
    # An instrument that says what another says already makes no row, and not one of rounding.
    r, M = weighed(np.stack([F[0], F[1], 2.0 * F[0]]))
    assert np.linalg.matrix_rank(M) == 2
    assert np.count_nonzero(r) == 2


def test_a_smoothed_spectrum_is_the_mean_under_a_gaussian():
    rng = np.random.default_rng(1)
    records = [rng.standard_normal((k, 2)) + 1j * rng.standard_normal((k, 2)) for k in (400, 250)]
    S = smoothed(records)
    f = [np.arange(1, len(v) + 1) / (2 * len(v) + 1) for v in records]
    for i in (0, 1):
        for k in (0, 40, 200):
            widths = [max(6 * g[0], 0.08 * f[i][k]) for g in f]
            w = [np.exp(-0.5 * ((f[i][k] - g) / s) ** 2) for g, s in zip(f, widths, strict=True)]
            total = sum(
                np.einsum("g,gi,gj->ij", a, v, np.conj(v)) for a, v in zip(w, records, strict=True)
            )
            np.testing.assert_allclose(S[i][k], total / sum(a.sum() for a in w), atol=0.03)


def test_what_follows_an_excitation_is_found():
    rng = np.random.default_rng(2)
    flights, answers = [], []
    for n in (1500, 1100):
        r = np.convolve(rng.standard_normal(n), np.ones(5) / 5, "same")
        answer = np.convolve(r, [0.0, 0.5, 0.3, 0.2])[:n]
        u = answer + 0.5 * rng.standard_normal(n)
        y = rng.standard_normal(n)
        flights.append(Flight(dt=DT, inputs={"lat": u}, outputs={"p": y}, instruments={"lat": r}))
        answers.append(answer)
    inputs = [f.inputs["lat"][:, None] for f in flights]
    made = following(inputs, [f.instruments["lat"][:, None] for f in flights])
    for found, answer in zip(made, answers, strict=True):
        left = found[:, 0] - found.mean() - (answer - answer.mean())
        assert np.std(left) < 0.25 * np.std(answer)


def moved_if_gone_on_with(found: Fit) -> float:
    """Return the joint standard deviations by which estimates move in repeated relaxations.

    Each search runs to its end.
    """
    layout, data, noise, z = found.reached
    q = len(layout.of_interest)
    J = np.asarray(residual_and_jacobian(layout, data, noise, z).J)[:, :q]
    for _ in range(4):
        z, noise = layout.objective.relax(layout, data, noise, z)
        z = optimise(layout, data, noise, z).z
    return float(np.linalg.norm(J @ np.asarray(z - found.reached.z)[:q]))


def test_a_closed_loop_that_an_instrument_allows_for_is_not_called_open(leaning):
    by_instrument = problem(leaning, [flown(3)])
    found = feedback_of(by_instrument)
    assert found[0].present
    [line] = inputs_follow_response(context_of(by_instrument))
    assert (line.code, line.severity) == ("loop.excitation-logged", "ok")
    assert line.value == found[0].p_value


def test_by_instrument_feedback_moves_no_estimate_and_directly_it_is_said(leaning):
    flights = [flown(1), flown(2)]
    by = fit(problem(leaning, flights))
    assert by.status == "converged"
    assert by.method_label == "frequency error by instrument (lat)"
    assert np.isnan(by.log_likelihood)
    # Another round of the relaxation hardly moves the estimates.
    assert moved_if_gone_on_with(by) < 0.03
    for name, one in by.estimates.items():
        assert abs(one.value - TRUTH[name]) < 3.5 * one.sd
        assert one.sd < 0.5 * abs(TRUTH[name])
    direct = fit(problem(leaning, flights, instrument=()))
    assert moved_if_gone_on_with(direct) < 0.03
    off = {n: (e.value - TRUTH[n]) / e.sd for n, e in direct.estimates.items()}
    worst = max(off, key=lambda n: abs(off[n]))
    assert abs(off[worst]) > 4.0
    assert worst in direct.untrusted
    assert direct.distrusts[worst].code == "loop.no-instrument"
    assert direct.exit_code == 3


def test_a_band_that_the_fit_ignores_is_noted(leaning):
    band = ResponseOptions(band=(0.2, 5.0))
    for method, count in (("frequency-error", 1), ("frequency-response", 0), ("output-error", 0)):
        asked = problem(leaning, [flown(1, 1000)], method=method, frequency=band)
        assert len(list(band_unused(context_of(asked)))) == count
    assert list(band_unused(context_of(problem(leaning, [flown(1, 1000)])))) == []


def test_a_response_far_larger_than_the_measured_one_explains_nothing():
    rng = np.random.default_rng(5)
    X, noise = (rng.standard_normal((300, 1)) + 1j * rng.standard_normal((300, 1)) for _ in "ab")
    y = (X + 0.1 * noise)[:, 0]
    # For a response k X the residual's share of the measured power is (1 - k)^2.
    for k in (0.0, 0.9, 6.0):
        signals = np.stack([y - k * X[:, 0], y], axis=1)[:, None]
        [(statistic, freedom, left, answer, _)] = _sums_over_bands(signals, X, np.ones((300, 1)))
        assert left / answer == pytest.approx((1.0 - k) ** 2, rel=0.02, abs=0.02)
        assert statistic > 3.0 * freedom


def test_outputs_follow_the_instruments_and_nothing_that_is_fed_back(leaning):
    rng = np.random.default_rng(6)
    r = np.convolve(rng.standard_normal(1500), np.ones(5) / 5, "same")
    answer = np.convolve(r, [0.0, 0.5, 0.3, 0.2])[:1500]
    calm = np.convolve(answer, [0.0, 0.4, 0.4, 0.2])[:1500]
    gusts = rng.standard_normal(1500) * 0.5
    outputs = {"p": calm - gusts, "phi": 2.0 * calm + gusts}
    # A straight line replaces missing samples.
    outputs["phi"][1000:1003] = np.nan
    drive = {"inputs": {"lat": answer + gusts}, "instruments": {"lat": r}}
    given = problem(leaning, [Flight(dt=DT, outputs=outputs, **drive)])
    data = data_of(given, given.training)
    before, after = data.flights[0], as_instruments_have_it(data).flights[0]
    assert np.array_equal(after.inputs.lat, before.by_instrument.lat)
    for name, y in (("p", calm), ("phi", 2.0 * calm)):
        left = after.outputs[name] - np.mean(after.outputs[name]) - (y - y.mean())
        assert np.std(left) < 0.25 * np.std(y)
