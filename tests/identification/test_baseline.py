"""The paper's method on SciPy's records: correct without noise, and doubtful with it."""

import numpy as np
import pytest
import scipy.signal

from heli_jax import Flight, Helicopter, models
from heli_jax.identification.equation_error.rls import baseline
from tests.dynamics.paper import BENCH, matrices

DT, N = 0.02, 4000
V = {**BENCH, "Omega": 120.0}  # below Nyquist (157 rad/s), so that the logarithm finds it


def record(v, noise=0.0, stand=True, seed=0, **more):
    rng = np.random.default_rng(seed)
    u = 1e-6 * np.repeat(rng.uniform(-1.0, 1.0, N // 5), 5)
    A, B = matrices({**v, **more.get("known", {})}, stand)
    Ad, Bd, *_ = scipy.signal.cont2discrete((A, B, np.eye(4), np.zeros((4, 1))), DT)
    x = np.zeros((N, 4))
    for k in range(N - 1):
        x[k + 1] = Ad @ x[k] + Bd[:, 0] * u[k]
    y = x[:, 0]
    y = y + noise * y.std() * rng.standard_normal(N)
    return Flight(dt=DT, inputs={"x_roll": u}, outputs={"roll": y}, **more)


@pytest.fixture(scope="module")
def clean():
    return baseline(models.roll_on_stand, Helicopter(**V), record(V))


def test_without_noise_it_finds_ratios_and_poles(clean):
    assert clean.combinations["a/Ixx"] == pytest.approx(V["a"] / V["Ixx"], rel=0.01)
    assert clean.combinations["a/If"] == pytest.approx(V["a"] / V["If"], rel=0.01)
    assert clean.exact
    assert clean.metrics.rmse < 1e-3 * np.std(record(V).outputs["roll"])

    A, _ = matrices(V, True)
    wanted = np.exp(np.linalg.eigvals(A) * DT)
    np.testing.assert_allclose(np.sort_complex(clean.poles), np.sort_complex(wanted), atol=2e-3)
    np.testing.assert_allclose(clean.continuous_den[:4], np.poly(A)[:4], rtol=0.02)
    assert (clean.output, clean.input, clean.order) == ("roll", "x_roll", 4)
    assert clean.history.shape == (N, 9)


def test_units_do_not_matter(clean):
    flight = record(V)
    scaled = Flight(
        dt=DT,
        inputs={"x_roll": 1e6 * flight.inputs["x_roll"]},
        outputs={"roll": 1e-3 * flight.outputs["roll"]},
    )
    found = baseline(models.roll_on_stand, Helicopter(**V), scaled)
    np.testing.assert_allclose(found.theta[:4], clean.theta[:4], rtol=1e-6)
    np.testing.assert_allclose(found.theta[4:], 1e-9 * clean.theta[4:], rtol=1e-4, atol=1e-15)


def test_added_inertia_is_taken_into_account():
    flight = record(V, known={"Ixx_added": 0.012})
    found = baseline(models.roll_on_stand, Helicopter(**V), flight)
    assert found.combinations["a/Ixx"] == pytest.approx(V["a"] / V["Ixx"], rel=0.01)
    assert found.combinations["a/If"] == pytest.approx(V["a"] / V["If"], rel=0.01)


def test_with_noise_it_says_that_it_cannot_be_trusted():
    found = baseline(models.roll_on_stand, Helicopter(**V), record(V, 0.1))
    assert not found.trusted
    wrong = [
        abs(found.combinations.get(n, np.nan) / truth - 1.0)
        for n, truth in (("a/Ixx", V["a"] / V["Ixx"]), ("a/If", V["a"] / V["If"]))
    ]
    assert not np.all(np.array(wrong) < 0.05)  # correctly


def test_the_papers_rate_and_rotor_alias_and_it_says_so():
    # 199 rad/s at 50 Hz: above Nyquist the flybar's mode folds, and k1 and k2 with it.
    v = {**BENCH, "Omega": 199.0, "L4": 0.004}
    found = baseline(models.roll_on_stand, Helicopter(**v), record(v, 1e-3))
    assert not found.trusted


def test_an_unstable_estimate_is_said():
    # A drifting free vehicle: y grows like an unstable pole.
    n = 400
    rng = np.random.default_rng(3)
    u = rng.uniform(-1.0, 1.0, n)
    y = scipy.signal.lfilter([0.0, 0.1], [1.0, -1.05], u)
    flight = Flight(dt=DT, inputs={"x_roll": u}, outputs={"roll": y})
    found = baseline(models.roll_on_stand, Helicopter(**V), flight, order=1)
    assert np.abs(found.poles).max() == pytest.approx(1.05, rel=1e-3)
    assert not found.trusted


def test_another_order_gives_no_physics():
    found = baseline(models.roll_on_stand, Helicopter(**V), record(V), order=2)
    assert found.combinations == {}


def test_a_rate_alone_gives_no_physics():
    flight = record(V)
    flight = Flight(
        dt=DT, inputs=flight.inputs, outputs={"roll_rate": np.gradient(flight.outputs["roll"], DT)}
    )
    found = baseline(models.roll_on_stand, Helicopter(**V), flight)
    assert found.output == "roll_rate"
    assert found.combinations == {}
    assert not found.trusted


def test_a_silent_record_breaks_nothing():
    flight = Flight(dt=DT, inputs={"x_roll": np.zeros(100)}, outputs={"roll": np.zeros(100)})
    found = baseline(models.roll_on_stand, Helicopter(**V), flight)
    assert not found.trusted
    assert np.isfinite(found.theta).all()
