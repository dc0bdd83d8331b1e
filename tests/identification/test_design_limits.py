"""Designs with delays, nonlinear models and limits: against NumPy and SciPy."""

import dataclasses
import re
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

from heli_jax import Flight, Free, Nuisance, Problem, linear_model
from heli_jax.dynamics.disturbance import with_disturbance
from heli_jax.identification.flight_design import InputLimit, Limits, design
from heli_jax.naming import asdict
from heli_jax.report.design import summary
from tests.identification.test_enough import SWING
from tests.identification.test_flight_design import DT, LIMITS, TRUTH, problem

FILE = """
name: late
states: {p: rad/s}
inputs: {da: "1"}
outputs: {p: rad/s}
parameters:
  d: {value: 4.0, unit: 1/s}
  M: {value: 20.0, unit: rad/s^2}
  tau: {value: 0.05, unit: s}
A: {p: {p: -d}}
B: {p: {da: M}}
delays: {da: tau}
"""
NO_NUISANCE = Nuisance(bias=False, initial_state=False)


def late(tmp_path, tau, free, method="output-error", n=200, dt=0.04):
    """Return a problem with the delayed model."""
    (tmp_path / "late.yaml").write_text(FILE)
    file = linear_model(tmp_path / "late.yaml")
    model, params = file.model, file.vehicle({"tau": tau}).params
    if method == "filter-error":
        model = with_disturbance(model, ["p"])
        gusts = {"sigma_w": jnp.asarray(0.5), "tau_w": jnp.asarray(1.0)}
        params = model.Params(**asdict(params), **gusts)
    flight = Flight(dt, {"da": np.zeros(n)}, {"p": np.zeros(n)}, sd={"p": 0.01})
    start = {"d": 4.0, "M": 20.0, "tau": tau}
    free = {name: Free(start[name]) for name in free}
    return Problem(model, params, [flight], free, NO_NUISANCE, method=method)


def rates_of(values, u, dt):
    """Return p for an input that acts later, zero before the record: superposed step responses."""
    d, M, tau = values
    t, p = np.arange(u.size) * dt, np.zeros(u.size)
    for k, rise in enumerate(np.diff(u, prepend=0.0)):
        since = np.maximum(t - k * dt - tau, 0.0)
        p += rise * M / d * (1.0 - np.exp(-d * since))
    return p


def test_a_delay_is_applied_once(tmp_path):
    of = late(tmp_path, 0.05, ["d", "M", "tau"])
    found = design(of, Limits({"da": InputLimit(0.1)}), max_steps=0)
    theta = np.array([4.0, 20.0, 0.05])
    for rated in found.library:
        u = rated.inputs[0]["da"]
        assert u[0] == 0.0
        columns = [
            (rates_of(theta * (1 + h), u, 0.04) - rates_of(theta * (1 - h), u, 0.04)) / 2e-5
            for h in 1e-5 * np.eye(3)
        ]
        J = np.column_stack(columns) / 0.01
        expected = np.sqrt(np.diag(np.linalg.inv(J.T @ J)))
        assert list(rated.sd.values()) == pytest.approx(expected, rel=2e-3), rated.words
        # The motion is that of the delayed input.
        np.testing.assert_allclose(rated.motion[0]["p"], rates_of(theta, u, 0.04), atol=1e-9)


def gaussian_moments(theta, u, n, dt, delay):
    """Return mean (n,) and covariance (n, n) of the record: gusts of first order, white noise."""
    d, M, sigma, tau_w, sd = theta
    A = np.array([[-d, 1.0], [0.0, -1.0 / tau_w]])
    Q = np.diag([0.0, 2.0 * sigma**2 / tau_w])
    E = scipy.linalg.expm(np.block([[-A, Q], [np.zeros((2, 2)), A.T]]) * dt)
    Ad = E[2:, 2:].T
    P, Qd = np.diag([0.0, sigma**2]), Ad @ E[:2, 2:]
    S = np.zeros((n, n))
    for k in range(n):
        column = P[:, 0]
        for j in range(k, n):
            S[j, k] = S[k, j] = column[0]
            column = Ad @ column
        P = Ad @ P @ Ad.T + Qd
    return rates_of((d, M, delay), u, dt), S + sd**2 * np.eye(n)


@pytest.mark.slow
def test_a_delay_is_applied_once_with_gusts(tmp_path):
    n, dt, delay = 100, 0.04, 0.12
    of = late(tmp_path, delay, ["d", "M"], "filter-error", n)
    found = design(of, Limits({"da": InputLimit(0.1)}), max_steps=0)
    rated = found.library[0]
    u, theta = rated.inputs[0]["da"], np.array([4.0, 20.0, 0.5, 1.0, 0.01])
    at = [[gaussian_moments(theta * (1 + s * h), u, n, dt, delay) for s in (1, -1)]
          for h in 1e-5 * np.eye(5)]  # fmt: skip
    inverse = np.linalg.inv(gaussian_moments(theta, u, n, dt, delay)[1])
    means = np.array([(up[0] - down[0]) / 2e-5 for up, down in at])
    spreads = [inverse @ (up[1] - down[1]) / 2e-5 for up, down in at]
    F = means @ inverse @ means.T
    F += 0.5 * np.array([[np.trace(a @ b) for b in spreads] for a in spreads])
    expected = np.sqrt(np.diag(np.linalg.inv(F)))[:2]
    # The information of gusts is averaged over few records.
    assert list(rated.sd.values()) == pytest.approx(expected, rel=0.05)


def test_ramps_begin_at_zero():
    limits = Limits({"u": InputLimit(0.2, rate=2.0)}, {"phi": 0.1})
    found = design(problem(), limits, max_steps=5)
    for rated in (found.optimum, *found.library):
        u = rated.inputs[0]["u"]
        assert np.max(np.abs(np.diff(u, prepend=0.0))) <= 2.0 * DT * (1 + 1e-9), rated.words


def test_a_nonlinear_model_is_optimised():
    # A pendulum: the oscillator for small angles.
    def field(p, x, u):
        rates = SWING.vector_field(p, x, u)
        return rates._replace(p=rates.p - p.k * (jnp.sin(x.phi) - x.phi))

    model = dataclasses.replace(SWING, name="pendulum", vector_field=field, linear=False)
    of = dataclasses.replace(problem(), model=model)
    limits = Limits({"u": InputLimit(0.2)}, {"phi": 0.05})
    found = design(of, limits, rest={"u": 0.0}, max_steps=10)
    assert found.optimum.value < found.library[0].value
    assert np.max(np.abs(found.optimum.motion[0]["phi"])) <= 0.05
    # At small angles it is the linear one.
    linear = design(problem(), limits, max_steps=0)
    sds = {r.words: r.sd for r in linear.library}
    for rated in found.library:
        for name, sd in rated.sd.items():
            assert sd == pytest.approx(sds[rated.words][name], rel=0.02)


def test_the_acting_input_is_limited():
    def loop(state, inputs):
        return inputs._replace(u=inputs.u - 3.0 * state.phi)

    limits = Limits({"u": InputLimit(0.2)}, {"u": 0.2})
    found = design(problem(), limits, feedback=loop, max_steps=5)
    for rated in (found.optimum, *found.library):
        acting = rated.inputs[0]["u"] - 3.0 * rated.motion[0]["phi"]
        assert np.max(np.abs(acting)) <= 0.2 * (1 + 1e-9), rated.words


def test_a_start_beyond_a_limit_is_refused():
    of = problem()
    start = {"u": 0.5}
    # A constant input moves the oscillator to b u / k, and beyond.
    with pytest.raises(ValueError, match=r"phi reaches 0\.[0-9]+ without any excitation"):
        design(of, LIMITS, rest=start, max_steps=0)


def test_an_unstable_vehicle_needs_feedback():
    of = dataclasses.replace(problem(), vehicle=TRUTH._replace(d=jnp.asarray(-5.0)))
    of = dataclasses.replace(of, free={"k": Free(36.0), "b": Free(20.0)})
    # Damping -5: the real part of the eigenvalue is 2.5, in 8 s.
    with pytest.raises(ValueError, match=r"time constant of 0\.4 s"):
        design(of, LIMITS, max_steps=0)
    design(of, LIMITS, feedback=lambda x, u: u._replace(u=u.u - 0.5 * x.p), max_steps=0)


def test_less_than_a_run_is_one_run():
    found = design(problem(), LIMITS, max_steps=0)
    once = found.sd_of(found.library[0], "d")
    assert found.needed(found.library[0], {"d": 2.0 * once}) == found.duration


@pytest.mark.parametrize(
    ("criterion", "size"),
    [
        ("D", lambda sd: np.prod(sd) ** (1 / 3)),
        pytest.param("A", lambda sd: np.sqrt(np.mean(sd**2)), marks=pytest.mark.slow),
        pytest.param("E", np.max, marks=pytest.mark.slow),
        pytest.param("d", lambda sd: sd[1], marks=pytest.mark.slow),
    ],
)
def test_the_headline_compares_printed_sds_with_the_best_row(criterion, size):
    found = design(problem(), LIMITS, criterion=criterion, max_steps=5)
    sizes = {r.words: size(np.array(list(r.sd.values()))) for r in found.library}
    best = min(sizes, key=lambda words: sizes[words])
    after = size(np.array(list(found.optimum.sd.values())))
    words = summary(SimpleNamespace(design=found))
    assert words.rstrip(".").endswith(best)
    if found_gain := re.search(r"by ([0-9.]+) %", words):
        gain = 100.0 * (1.0 - after / sizes[best])
        assert float(found_gain[1]) == pytest.approx(gain, rel=0.06)
    else:
        assert after >= sizes[best] * (1 - 1.1e-3)


def test_an_output_that_jumps_at_a_sample_is_limited_before_it_too():
    # The output p + 50 u jumps with u; just before a step it has the earlier u.
    def output(q, x, i):
        return x._replace(p=x.p + 50.0 * i.u)

    of = dataclasses.replace(problem(), model=dataclasses.replace(SWING, output=output))
    found = design(of, Limits({"u": InputLimit(0.2)}, {"p": 2.0}), max_steps=0)
    k, d, b = 36.0, 2.0, 20.0
    E = scipy.linalg.expm(np.block([[-d, -k, b], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]]) * DT)
    for rated in found.library:
        x, before, most = np.zeros(2), 0.0, 0.0
        for u in rated.inputs[0]["u"]:
            most = max(most, abs(x[0] + 50.0 * before), abs(x[0] + 50.0 * u))
            x, before = E[:2, :2] @ x + E[:2, 2] * u, u
        assert rated.margins["p"] == pytest.approx(1.0 - most / 2.0, abs=1e-6), rated.words
        assert most <= 2.0 * (1.0 + 1e-9), rated.words
