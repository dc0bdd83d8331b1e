"""Disturbances against the theory of first- and second-order noise."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

from heli_jax import linear_model, models, naming, simulate
from heli_jax.dynamics.disturbance import disturbable_states, with_disturbance
from heli_jax.dynamics.model import correlation_of, initial_sd_of
from tests.dynamics.paper import BENCH, matrices

DT, N, SIGMA, TAU = 0.02, 60_000, 1.04, 0.1


@pytest.fixture(scope="module", params=[1, 2], ids=["one pole", "two poles"])
def go(request, bench30):
    """Return (poles, function that simulates with a given sigma and key)."""
    model = with_disturbance(models.roll_on_stand, "roll", request.param)
    still, known = model.Inputs(np.zeros(N)), naming.asdict(bench30)

    def run(sigma, key):
        p = model.Params(**known, sigma_w=sigma, tau_w=jnp.asarray(TAU))
        return simulate(model, p, still, dt=DT, key=key)

    return request.param, jax.jit(run)


@pytest.fixture(scope="module")
def run(go):
    poles, run = go
    return poles, run(jnp.asarray(SIGMA), jax.random.key(4))


def stationary(poles):
    """Return the covariance of (phi, dphi, beta, dbeta, w1 ...) from the Lyapunov equation."""
    n = 4 + poles
    A, G = np.zeros((n, n)), np.zeros((n, n))
    A[:4, :4] = matrices(BENCH, True)[0]
    A[1, n - 1] = 1.0
    for k in range(poles):
        A[4 + k, 4 + k] = -1.0 / TAU
        if k:
            A[4 + k, 3 + k] = np.sqrt(2.0) / TAU
    G[4, 4] = 2.0 * SIGMA**2 / TAU
    return scipy.linalg.solve_continuous_lyapunov(A, -G)


def test_standard_deviation_is_sigma(run):
    poles, found = run
    w = np.asarray(getattr(found.states, f"w{poles}_roll"))[500:]
    # sd of a variance estimate from N dt / (2 tau) independent samples: about 1 %
    assert np.var(w) == pytest.approx(SIGMA**2, rel=0.05)
    assert abs(np.mean(w)) < 5.0 * SIGMA * np.sqrt(2.0 * poles * TAU / (N * DT))
    assert stationary(poles)[-1, -1] == pytest.approx(SIGMA**2)


@pytest.mark.parametrize("poles", [1, 2])
def test_at_the_first_sample_the_disturbance_is_stationary(bench30, poles):
    model = with_disturbance(models.roll_on_stand, "roll", poles)
    p = model.Params(**naming.asdict(bench30), sigma_w=jnp.asarray(SIGMA), tau_w=jnp.asarray(TAU))
    dtype = jnp.result_type(float)
    sds = np.asarray(initial_sd_of(model, p, dtype))
    covariance = np.outer(sds, sds) * np.asarray(correlation_of(model, p, dtype))
    np.testing.assert_allclose(covariance[4:, 4:], stationary(poles)[4:, 4:], rtol=1e-12)
    np.testing.assert_array_equal(covariance[:4], 0.0)


def test_only_random_states_are_correlated(bench30):
    model = dataclasses.replace(
        with_disturbance(models.roll_on_stand, "roll"),
        correlation=lambda p: {("phi", "w1_roll"): 0.5},
    )
    p = model.Params(**naming.asdict(bench30))
    with pytest.raises(ValueError, match="phi"):
        correlation_of(model, p, jnp.result_type(float))


def test_autocorrelation_is_that_of_its_lags(run):
    poles, found = run
    w = np.asarray(getattr(found.states, f"w{poles}_roll"))[500:]
    for lag in (1, 3, 5, 10, 20):
        t = lag * DT / TAU
        theory = np.exp(-t) * (1.0 if poles == 1 else 1.0 + t)
        assert np.mean(w[:-lag] * w[lag:]) / np.mean(w**2) == pytest.approx(theory, abs=0.04)


def test_response_has_the_variance_that_lyapunov_gives(run):
    poles, found = run
    covariance = stationary(poles)
    # Roll is slow (0.2 s), so it has fewer independent samples and a wider limit.
    assert np.var(found.states.phi[500:]) == pytest.approx(covariance[0, 0], rel=0.15)
    assert np.var(found.states.dphi[500:]) == pytest.approx(covariance[1, 1], rel=0.1)


@pytest.mark.parametrize(("axis", "poles"), [("yaw", 1), ("roll", 0), ("roll", 3)])
def test_what_cannot_be_disturbed(axis, poles):
    with pytest.raises(ValueError):  # noqa: PT011
        with_disturbance(models.roll, axis, poles)


NUMBERS = """
name: numbers
states: {v: m/s, p: rad/s, phi: rad, y: m, z: m}
inputs: {da: "1"}
outputs: {v: m/s}
parameters: {Lda: {value: 20, unit: 1/s^2}}
A:
  v: {v: -0.4, phi: 9.81}
  p: {v: -0.5}
  phi: {p: 1}
  y: {v: 1}
  z: {y: -1}
B:
  p: {da: Lda}
"""


def test_a_force_with_its_coefficients_in_numbers_is_no_kinematics(tmp_path):
    (tmp_path / "numbers.yaml").write_text(NUMBERS)
    model = linear_model(tmp_path / "numbers.yaml").model
    assert disturbable_states(model) == ("v", "p")
    assert with_disturbance(model, "v").disturbances[0].state == "v"
    for name in ("phi", "y", "z"):
        with pytest.raises(ValueError, match=name):
            with_disturbance(model, name)


HEAVE = """
name: heave
states: {w: m/s, nu: m/s}
inputs: {col: "1"}
outputs: {az: m/s^2, up: m/s^2, w: m/s, lift: m/s^2}
parameters: {Zw: {value: -0.5, unit: 1/s}, Zc: {value: -28, unit: m/s^2}}
A: {w: {w: Zw, nu: 6}, nu: {nu: -9}}
B: {w: {col: Zc}, nu: {col: 10}}
C: {az: {w: Zw, nu: 6}, up: {w: -Zw, nu: -6}, lift: {w: Zw, nu: 6}}
D: {az: {col: Zc}, up: {col: -Zc}}
"""


@pytest.mark.slow
def test_an_output_that_is_the_pushed_derivative_has_the_push(tmp_path):
    """Test outputs that equal a disturbed derivative.

    az is w' and up is -w'. lift lacks the control, and w is a state, so they show the motion alone.
    The reference is the difference of a run's w.
    """
    path = tmp_path / "heave.yaml"
    path.write_text(HEAVE)
    file = linear_model(path)
    model = with_disturbance(file.model, "w")
    known = naming.asdict(file.vehicle().params)
    n, dt = 2000, 1e-3
    col = np.repeat(np.random.default_rng(0).choice([-0.05, 0.05], n // 100), 100)
    p = model.Params(**known, sigma_w=0.4, tau_w=0.5)
    run = simulate(model, p, model.Inputs(col), dt=dt, key=jax.random.key(1))
    az, up, lift = (np.asarray(getattr(run.outputs, k)) for k in ("az", "up", "lift"))
    slope = np.diff(np.asarray(run.states.w)) / dt
    steady = np.diff(col) == 0
    # The effect of the disturbance within a sample has at most the rms sigma sqrt(2 dt/(3 tau)).
    within = 0.4 * np.sqrt(2.0 * dt / (3.0 * 0.5))
    assert np.std((0.5 * (az[1:] + az[:-1]) - slope)[steady]) < within
    push = np.asarray(run.states.w1_w)
    assert np.std(push) > 5.0 * within
    np.testing.assert_allclose(up, -az, rtol=1e-5, atol=1e-5)
    known_motion = az + 28.0 * col - push
    np.testing.assert_allclose(lift, known_motion, rtol=1e-5, atol=1e-4)
