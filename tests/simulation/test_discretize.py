"""The matrix exponential and the discretisation, against SciPy and quadrature."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from hypothesis import given
from hypothesis import strategies as st

from heli_jax import Helicopter, models, naming
from heli_jax.dynamics.disturbance import with_disturbance
from heli_jax.numerics.matrix_exponential import expm, van_loan
from heli_jax.simulation.discretize import (
    discretize,
    process_noise,
    square_root,
)
from heli_jax.simulation.hold import Delays
from tests.dynamics.paper import BENCH, matrices, scattered

fast = jax.jit(expm)


def dense(seed, n=5):
    return np.random.default_rng(seed).standard_normal((n, n))


@given(
    st.integers(0, 10**6),
    st.floats(-12.0, 1.3),
    st.lists(st.integers(-25, 25), min_size=5, max_size=5),
)
def test_wild_scales_cost_no_digits(seed, size, powers):
    X = dense(seed) * 10.0**size / 5.0
    d = 2.0 ** np.array(powers)  # exact to the last bit: D e^X D^-1 = e^(D X D^-1)
    found = np.asarray(fast(jnp.asarray(X * d[:, None] / d[None, :])))
    found = found / d[:, None] * d[None, :]
    wanted = scipy.linalg.expm(X)
    assert np.abs(found - wanted).max() <= 1e-12 * max(1.0, np.linalg.norm(X)) * np.exp(
        np.linalg.norm(X, 2)
    )
    # The growth that the norm allows is rare; the typical error is far smaller.
    assert np.abs(found - wanted).max() <= 1e-10 * np.abs(wanted).max() + 1e-13


@given(st.lists(st.floats(-3e5, 2.0), min_size=5, max_size=5), st.integers(0, 10**6))
def test_stiff_and_stable(rates, seed):
    V, _ = np.linalg.qr(dense(seed))
    found = fast(jnp.asarray(V @ np.diag(rates) @ V.T))
    wanted = V @ np.diag(np.exp(rates)) @ V.T
    np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-14 * (10.0 + np.abs(rates).max()))


step = jax.jit(van_loan)


@given(st.integers(0, 10**6), st.floats(-6.0, 2.0), st.lists(st.integers(-9, 9), min_size=5))
def test_a_step_is_the_exponentials(seed, size, powers):
    """Test mean and covariance against augmented exponentials, also in extreme units."""
    rng = np.random.default_rng(seed)
    d = 2.0 ** np.resize(powers, 5)
    A = (dense(seed) * d[:, None] / d[None, :]) * 10.0**size
    f, g = d * rng.standard_normal(5), d * rng.standard_normal(5)
    h = 1.0 / np.linalg.norm(A / d[:, None] * d[None, :], 2) * rng.uniform(0.01, 3.0)
    found = step(*(jnp.asarray(v) for v in (A, f, g, h)))
    M = np.block([[A, f[:, None]], [np.zeros((1, 6))]])
    E = scipy.linalg.expm(M / np.append(d, 1.0)[:, None] * np.append(d, 1.0)[None, :] * h)
    np.testing.assert_allclose(
        found.Phi / d[:, None] * d[None, :], E[:5, :5], atol=1e-12 * np.abs(E).max()
    )
    np.testing.assert_allclose(found.shift / d, E[:5, 5], atol=1e-12 * np.abs(E[:5, 5]).max())
    G = np.diag(g / d) ** 2
    V = np.block([[-A / d[:, None] * d[None, :], G], [np.zeros((5, 5)), (A / d[:, None] * d).T]])
    F = scipy.linalg.expm(V * h)
    Q = F[5:, 5:].T @ F[:5, 5:]
    np.testing.assert_allclose(found.Q / d[:, None] / d[None, :], Q, atol=1e-11 * np.abs(Q).max())


@pytest.mark.parametrize(
    "M",
    [
        np.zeros((5, 5)),
        np.eye(5),
        np.triu(np.ones((5, 5)), 1),
        np.triu(np.full((5, 5), 1e6), 4),
        np.diag([0.0, 1.0, -1e5, 3.0, -7.0]),
        np.eye(5)[[1, 2, 3, 4, 0]] * 6.0,
        np.diag([1e-300] * 5),
    ],
    ids=["zero", "one", "nilpotent", "large corner", "diagonal", "cyclic", "tiny"],
)
def test_special_matrices(M):
    # Every squaring doubles the rounding error: 1e-16 times the norm.
    loss = 1e-12 + 3e-15 * np.abs(np.diag(M)).max()
    np.testing.assert_allclose(fast(jnp.asarray(M)), scipy.linalg.expm(M), rtol=loss, atol=1e-14)


def test_one_by_one_and_the_flybar():
    np.testing.assert_allclose(fast(jnp.array([[2.5]])), [[np.exp(2.5)]], rtol=1e-13)
    A, _ = matrices(BENCH, True)
    for dt in (1e-4, 0.02, 0.1, 1.0):
        wanted = scipy.linalg.expm(A * dt)
        found = np.asarray(fast(jnp.asarray(A * dt)))
        scale = np.array([1.0, 10.0, 1.0, 150.0])  # units of the state: angles and their rates
        error = np.abs(found - wanted) / scale[:, None] * scale[None, :]
        assert error.max() < 1e-11


def test_beyond_its_range_it_is_nan_not_wrong():
    M = -np.eye(5) * 0.3 * 2.0**24
    np.testing.assert_array_equal(np.asarray(fast(jnp.asarray(M * 0.99))), 0.0)
    assert np.isnan(np.asarray(fast(jnp.asarray(M * 1.01)))).any()
    assert np.isnan(np.asarray(fast(jnp.full((5, 5), jnp.nan)))).all()
    assert not np.isfinite(np.asarray(fast(jnp.full((5, 5), jnp.inf)))).any()


@pytest.fixture(scope="module")
def directional():
    forward = jax.jit(lambda M, E: jax.jvp(expm, (M,), (E,))[1])
    reverse = jax.jit(lambda M, W: jax.vjp(expm, M)[1](W)[0])
    return forward, reverse


@pytest.mark.parametrize("size", [0.0, 1e-6, 1.0, 20.0])
@pytest.mark.parametrize("spread", [0, 12])
def test_derivative_is_frechets(directional, size, spread):
    forward, reverse = directional
    d = 2.0 ** np.linspace(-spread, spread, 5).round()
    M = dense(1) * size / 3.0
    E, W = dense(2), dense(3)
    wanted = scipy.linalg.expm_frechet(M, E, compute_expm=False)
    scaled = M * d[:, None] / d[None, :], E * d[:, None] / d[None, :]
    found = np.asarray(forward(*map(jnp.asarray, scaled))) / d[:, None] * d[None, :]
    np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-11 * np.abs(wanted).max())
    # <W, L(M, E)> = <L*(M, W), E>
    back = np.asarray(reverse(jnp.asarray(M), jnp.asarray(W)))
    scale = np.linalg.norm(back) * np.linalg.norm(E)
    assert np.sum(back * E) == pytest.approx(np.sum(W * wanted), abs=1e-11 * scale)


@pytest.fixture(scope="module")
def stand_discrete():
    return jax.jit(
        lambda p, dt, rest: discretize(models.roll_on_stand, p, dt, Delays((0,), (0,), (rest,)))
    )


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("late", [0.0, 0.3, 0.999, 1.0])
def test_discretisation_with_a_late_input(stand_discrete, seed, late):
    v, dt = scattered(seed), 0.02
    A, B = matrices(v, True)
    found = stand_discrete(Helicopter(**v), jnp.asarray(dt), jnp.asarray(late))

    def held(t):
        M = np.zeros((5, 5))
        M[:4, :4], M[:4, 4:] = A * t, B * t
        E = scipy.linalg.expm(M)
        return E[:4, :4], E[:4, 4:]

    whole, rest = held(dt), held((1.0 - late) * dt)
    wanted = (
        whole[0],
        rest[1],
        whole[1] - rest[1],
    )  # the rest is u[k-1]'s
    assert found.Bn is None
    for one, other in zip(found[:3], wanted, strict=True):
        size = np.abs(other).max() + np.abs(whole[1]).max()
        np.testing.assert_allclose(np.array(one), other, rtol=1e-9, atol=1e-11 * size)


@pytest.fixture(scope="module", params=[1, 2], ids=["one pole", "two poles"])
def noise(request, bench30):
    model = with_disturbance(models.roll_on_stand, "roll", request.param)
    p = model.Params(**naming.asdict(bench30), sigma_w=jnp.asarray(1.04), tau_w=jnp.asarray(0.7))
    return request.param, jax.jit(lambda dt: process_noise(model, p, dt))


@pytest.mark.parametrize("dt", [1e-3, 0.02, 0.3])
def test_process_noise_against_quadrature(noise, dt):
    poles, go = noise
    sigma, tau, n = 1.04, 0.7, 4 + poles
    A = np.zeros((n, n))
    A[:4, :4] = matrices(BENCH, True)[0]
    A[1, -1] = 1.0
    A[4, 4] = -1.0 / tau
    if poles == 2:
        A[5, 4:] = np.sqrt(2.0) / tau, -1.0 / tau
    G = np.zeros(n)
    G[4] = sigma * np.sqrt(2.0 / tau)
    nodes, weights = np.polynomial.legendre.leggauss(12)
    wanted, parts = np.zeros((n, n)), max(1, round(dt / 0.02))
    for k in range(parts):
        for x, w in zip(nodes, weights, strict=True):
            g = scipy.linalg.expm(A * (k + 0.5 * (x + 1.0)) * dt / parts) @ G
            wanted += 0.5 * w * dt / parts * np.outer(g, g)
    found = np.asarray(go(jnp.asarray(dt)))
    np.testing.assert_array_equal(found, found.T)
    sd = np.sqrt(np.diag(wanted))
    np.testing.assert_allclose(found / np.outer(sd, sd), wanted / np.outer(sd, sd), atol=1e-8)


def test_no_noise_no_process_noise(bench30):
    np.testing.assert_array_equal(process_noise(models.roll, bench30, 0.02), np.zeros((4, 4)))


@pytest.mark.parametrize("rank", [0, 1, 3, 4])
def test_square_root_of_a_singular_covariance(rank):
    F = np.random.default_rng(rank).standard_normal((4, rank))
    L = np.asarray(square_root(jnp.asarray(F @ F.T)))
    np.testing.assert_allclose(L @ L.T, F @ F.T, atol=1e-13)
