"""The Kalman filter against a dense Gaussian likelihood, built with scipy without a filter."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import scipy.linalg
import scipy.stats

from heli_jax import linear_model, models, simulate
from heli_jax.dynamics import kinematics
from heli_jax.dynamics.disturbance import with_disturbance
from heli_jax.dynamics.jacobians import jacobians
from heli_jax.identification.estimation.filter_error import errors_ahead
from heli_jax.identification.estimation.kalman import innovations
from heli_jax.naming import asdict, names, replace
from heli_jax.simulation.options import SimulationOptions

N, DT = 40, 0.02
SD = {"roll": 2e-3, "roll_rate": 0.03}


def case(bench30, poles, **values):
    model = with_disturbance(models.roll_on_stand, "roll", poles)
    given = {"kappa": 4.0, "zeta": 0.2, "sigma_w": 1.04, "tau_w": 0.7, **values}
    params = model.Params(
        **{**asdict(bench30), **{n: jnp.asarray(float(v)) for n, v in given.items()}}
    )
    rng = np.random.default_rng(5)
    u = 3e-6 * np.repeat(rng.uniform(-1, 1, N // 8), 8)
    y = {n: 5 * sd * rng.standard_normal(N) for n, sd in SD.items()}
    return model, params, u, y


def dense(model, params, u, y, x0):
    """Return log p(all measurements) from the full mean and covariance."""
    A, B, C, D = (np.asarray(m) for m in jacobians(model, params))
    n = A.shape[0]
    held = scipy.linalg.expm(np.block([[A, B], [np.zeros((1, n + 1))]]) * DT)
    Ad, Bd = held[:n, :n], held[:n, n:]
    G = np.diag([float(g) for g in asdict(model.noise_intensity(params)).values()])
    nodes, weights = np.polynomial.legendre.leggauss(30)
    Q = sum(
        0.5 * DT * w * F @ G @ G @ F.T
        for w, F in (
            (w, scipy.linalg.expm(A * 0.5 * DT * (s + 1)))
            for s, w in zip(nodes, weights, strict=True)
        )
    )
    random = np.ix_(*2 * [[i for i, k in enumerate(names(model.State)) if k.startswith("w")]])
    P = np.zeros_like(A)
    # Stationary: the disturbance began before the record.
    P[random] = scipy.linalg.solve_continuous_lyapunov(A[random], -(G @ G)[random])
    x, means, S = np.array(x0), [], [[None] * N for _ in range(N)]
    covariances = []
    for k in range(N):
        means.append(C @ x + D @ [u[k]])
        covariances.append(P)
        x, P = Ad @ x + Bd @ [u[k]], Ad @ P @ Ad.T + Q
    for i in range(N):
        for j in range(i, N):
            S[j][i] = np.linalg.matrix_power(Ad, j - i) @ covariances[i]
            S[i][j] = S[j][i].T
    full = np.block([[C @ S[i][j] @ C.T for j in range(N)] for i in range(N)])
    order = names(model.Outputs)
    full += np.kron(np.eye(N), np.diag([SD[n] ** 2 for n in order]))
    stacked = np.stack([y[n] for n in order], axis=1).ravel()
    seen = np.isfinite(stacked)
    return scipy.stats.multivariate_normal(np.ravel(means)[seen], full[np.ix_(seen, seen)]).logpdf(
        stacked[seen]
    )


def likelihood(model, params, u, y, x0, **how):
    found = innovations(
        model,
        params,
        model.Inputs(x_roll=jnp.asarray(u)),
        {n: jnp.asarray(v) for n, v in y.items()},
        SD,
        dt=DT,
        initial_state=model.State(*jnp.asarray(x0)),
        **how,
    )
    total = 0.0
    for n, e in found.error.items():
        seen = jnp.isfinite(e)
        s = jnp.where(seen, found.variance[n], 1.0)
        term = jnp.log(2 * jnp.pi * s) + jnp.where(seen, e, 0.0) ** 2 / s
        total -= 0.5 * jnp.sum(jnp.where(seen, term, 0.0))
    return total


@pytest.mark.parametrize("poles", [1, 2])
def test_log_likelihood_is_that_of_the_dense_gaussian(bench30, poles):
    model, params, u, y = case(bench30, poles)
    y["roll"][[0, 7, 8]] = np.nan
    y["roll_rate"][8:20] = np.nan
    x0 = [0.01, -0.2, 1e-5, 1e-3, *[0.0] * poles]
    wanted = dense(model, params, u, y, x0)
    assert float(likelihood(model, params, u, y, x0)) == pytest.approx(wanted, rel=1e-8)


def test_gradient_is_that_of_finite_differences(bench30):
    model, params, u, y = case(bench30, 1)
    x0 = [0.01, -0.2, 1e-5, 1e-3, 0.0]
    moved = ("Ixx", "If", "sigma_w", "tau_w")

    @jax.jit
    def at(z):
        values = dict(zip(moved, jnp.exp(z), strict=True))
        return likelihood(model, replace(params, **values), u, y, x0)

    z = np.log([float(getattr(params, n)) for n in moved])
    steps = 1e-5 * np.eye(4)
    wanted = [(at(jnp.asarray(z + h)) - at(jnp.asarray(z - h))) / 2e-5 for h in steps]
    np.testing.assert_allclose(jax.jacfwd(at)(jnp.asarray(z)), wanted, rtol=1e-5)


def test_without_a_disturbance_the_innovations_are_the_simulation_error(bench30):
    model, params, u, y = case(bench30, 1, sigma_w=0.0)
    x0 = model.initial_state(params)
    inputs = model.Inputs(x_roll=jnp.asarray(u))
    found = innovations(model, params, inputs, {"roll": jnp.asarray(y["roll"])}, SD, dt=DT)
    run = simulate(model, params, inputs, dt=DT, initial_state=x0)
    np.testing.assert_allclose(found.error["roll"], y["roll"] - run.outputs.roll, atol=1e-14)
    np.testing.assert_allclose(found.variance["roll"], SD["roll"] ** 2, rtol=1e-12)


def test_a_late_input_acts_late(bench30):
    model, params, u, y = case(bench30, 1)
    x0 = [0.0] * 5
    late = np.concatenate([np.full(3, u[0]), u[:-3]])
    a = likelihood(model, params, u, y, x0, delay=jnp.asarray(3 * DT))
    b = likelihood(model, params, late, y, x0)
    assert float(a) == pytest.approx(float(b), rel=1e-9)


def test_the_extended_filter_of_a_linear_model_is_the_linear_one(bench30):
    model, params, u, y = case(bench30, 2)
    y["roll"][[0, 7, 8]] = np.nan
    delay = jnp.asarray(0.033)

    def run(model):
        inputs = model.Inputs(x_roll=jnp.asarray(u))
        measured = {n: jnp.asarray(v) for n, v in y.items()}
        return innovations(model, params, inputs, measured, SD, dt=DT, delay=delay)

    exact, extended = run(model), run(dataclasses.replace(model, linear=False))
    for n, sd in SD.items():
        np.testing.assert_allclose(extended.error[n], exact.error[n], rtol=1e-10, atol=1e-10 * sd)
        np.testing.assert_allclose(extended.variance[n], exact.variance[n], rtol=1e-10)


@pytest.mark.parametrize("hold", ["linear", "zero-order"])
def test_explicit_steps_follow_the_moments_of_the_kinematics(hold):
    model, noise, dt, count = kinematics.attitude, 0.02, 0.02, 31
    t = np.arange(count) * dt
    rates = np.array([1.5 * np.cos(5 * t), 1.2 * np.sin(7 * t), 0.8 * np.cos(3 * t)])
    begin = np.array([0.4, -0.5, 1.0])
    # Measured at the end only: nothing is corrected before it.
    measured = np.full(count, np.nan)
    measured[-1] = 0.0
    found = innovations(
        model,
        model.Params(noise_gyro=noise),
        model.Inputs(*map(jnp.asarray, rates)),
        dict.fromkeys(("phi", "theta"), jnp.asarray(measured)),
        {"phi": 1e-9, "theta": 1.0},
        dt=dt,
        initial_state=model.State(*map(jnp.asarray, begin)),
        hold=dict.fromkeys("pqr", hold),
    )

    def field(x, u):
        (p, q, r), (phi, theta) = u, x[:2]
        about = q * np.sin(phi) + r * np.cos(phi)
        return np.array(
            [p + about * np.tan(theta), q * np.cos(phi) - r * np.sin(phi), about / np.cos(theta)]
        )

    def slope(now, moments, k):
        x, P = moments[:3], moments[3:].reshape(3, 3)
        share = (now / dt - k) if hold == "linear" else 0.0
        u = rates[:, k] + share * (rates[:, k + 1] - rates[:, k])
        steps = 1e-6 * np.eye(3)
        A = np.column_stack([(field(x + e, u) - field(x - e, u)) / 2e-6 for e in steps])
        return np.concatenate([field(x, u), (A @ P + P @ A.T + noise**2 * np.eye(3)).ravel()])

    moments = np.concatenate([begin, np.zeros(9)])
    for k in range(count - 1):
        moments = scipy.integrate.solve_ivp(
            slope, (k * dt, (k + 1) * dt), moments, args=(k,), rtol=1e-10, atol=1e-13
        ).y[:, -1]
    x, P = moments[:3], moments[3:].reshape(3, 3)
    assert np.asarray(found.error["phi"])[-1] == pytest.approx(-x[0], abs=1e-7)
    assert np.asarray(found.variance["phi"])[-1] == pytest.approx(P[0, 0], rel=1e-6)
    # The roll angle is now known almost exactly, and pitch as far as it is correlated.
    assert np.asarray(found.variance["theta"])[-1] - 1.0 == pytest.approx(
        P[1, 1] - P[0, 1] ** 2 / P[0, 0], rel=1e-6
    )


YAW = """name: yaw
states: {psi: {unit: rad}, r: {unit: rad/s}}
inputs: {ped: '1'}
outputs: {psi: rad, r: rad/s}
parameters: {Nr: {value: 0.8, unit: 1/s}, Nped: {value: 6.0, unit: 1/s^2}}
A: {psi: {r: 1}, r: {r: Nr}}
B: {r: {ped: Nped}}
axes: {yaw: {rate: r, angle: psi, stick: ped}}
"""


YAW_SD = {"psi": 0.009, "r": 0.017}


def unstable_yaw(tmp_path, Nr):
    (tmp_path / "yaw.yaml").write_text(YAW)
    model = with_disturbance(linear_model(tmp_path / "yaw.yaml").model, "yaw", 1)
    params = model.Params(Nr=Nr, Nped=6.0, sigma_w=0.35, tau_w=1.0)
    return model, jax.tree.map(jnp.asarray, params)


def joint_filter(y, u, Nr, Nped, sigma, tau, sd):
    """Return -log-likelihood up to a constant: both outputs corrected together, P symmetrised."""
    A = np.array([[0, 1, 0], [0, Nr, 1], [0, 0, -1 / tau]])
    B, Q = np.array([[0.0], [Nped], [0.0]]), np.diag([0, 0, 2 * sigma**2 / tau])
    held = scipy.linalg.expm(np.block([[A, B], [np.zeros((1, 4))]]) * DT)
    loan = scipy.linalg.expm(np.block([[-A, Q], [np.zeros((3, 3)), A.T]]) * DT)
    Ad, Bd = held[:3, :3], held[:3, 3]
    added, C, R = Ad @ loan[:3, 3:], np.eye(2, 3), np.diag(np.square(sd))
    x, P, total = np.zeros(3), np.diag([0, 0, sigma**2]), 0.0
    for yk, uk in zip(y, u, strict=True):
        e, S = yk - C @ x, C @ P @ C.T + R
        total += 0.5 * (e @ np.linalg.solve(S, e) + np.log(np.linalg.det(S)))
        K = P @ C.T @ np.linalg.inv(S)
        x, P = Ad @ (x + K @ e) + Bd * uk, Ad @ (P - K @ C @ P) @ Ad.T + added
        P = 0.5 * (P + P.T)
    return total


@pytest.mark.parametrize("Nr", [-0.5, 2.0])
def test_an_unstable_machine_over_a_long_record(tmp_path, Nr):
    # exp(2.0 * 60 s) is 1e52: rounding that no correction sees grows by this.
    model, params = unstable_yaw(tmp_path, Nr)
    rng = np.random.default_rng(3)
    u, y = rng.standard_normal(3000) * 0.1, rng.standard_normal((3000, 2)) * 0.02
    inputs, measured = model.Inputs(ped=jnp.asarray(u)), {"psi": y[:, 0], "r": y[:, 1]}
    measured = {n: jnp.asarray(v) for n, v in measured.items()}
    found = innovations(model, params, inputs, measured, YAW_SD, dt=DT)
    total = sum(
        0.5 * float(jnp.sum(e**2 / found.variance[n] + jnp.log(found.variance[n])))
        for n, e in found.error.items()
    )
    wanted = joint_filter(y, u, Nr, 6.0, 0.35, 1.0, tuple(YAW_SD.values()))
    assert total == pytest.approx(wanted, rel=1e-8)


def test_predictions_ahead_lie_between_one_step_and_a_simulation(tmp_path):
    model, params = unstable_yaw(tmp_path, 0.8)
    rng = np.random.default_rng(3)
    u, y = rng.standard_normal(200) * 0.1, rng.standard_normal((200, 2)) * 0.02
    y[7, 1] = np.nan
    inputs, measured = model.Inputs(ped=jnp.asarray(u)), {"psi": y[:, 0], "r": y[:, 1]}
    asked = (model, params, inputs, {n: jnp.asarray(v) for n, v in measured.items()}, YAW_SD)
    one = errors_ahead(asked, SimulationOptions(dt=DT), 1)
    wanted = innovations(*asked, dt=DT)
    # The first output of a sample is corrected first, with equal information in both.
    np.testing.assert_allclose(one.error["psi"], wanted.error["psi"], rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose(one.variance["psi"], wanted.variance["psi"], rtol=1e-9)
    run = simulate(model, params, inputs, dt=DT).outputs
    whole = errors_ahead(asked, SimulationOptions(dt=DT), 200)
    np.testing.assert_allclose(whole.error["r"], y[:, 1] - run.r, rtol=1e-9, atol=1e-12)
    some = errors_ahead(asked, SimulationOptions(dt=DT), 50)
    for n in YAW_SD:
        by = [float(np.nanmax(found.variance[n])) for found in (one, some, whole)]
        assert by == sorted(by)
        assert by[0] < by[1] < by[2]
