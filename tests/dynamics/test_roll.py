"""The reduced models against a second program of the equations and python-control."""

import control
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from heli_jax import Helicopter, Model, models, naming
from heli_jax.analysis.linear import modes
from heli_jax.dynamics.jacobians import jacobians
from heli_jax.dynamics.roll import ratios_from_denominator, roll_transfer_function
from tests.dynamics.paper import BENCH, matrices, rates, scattered
from tests.responses import polynomials

SEEDS = range(3)


@jax.jit
def free_and_stand(p, state, inputs):
    return models.roll.vector_field(p, state, inputs), models.roll_on_stand.vector_field(
        p, state, inputs
    )


@pytest.mark.parametrize("seed", SEEDS)
def test_equations_21_and_22(seed):
    rng = np.random.default_rng(1000 + seed)
    v = scattered(seed)
    for _ in range(8):
        x, u = rng.standard_normal(4) * [0.3, 2.0, 0.1, 10.0], 1e-3 * rng.standard_normal()
        state = models.roll.State(*(jnp.asarray(s) for s in x))
        found = free_and_stand(Helicopter(**v), state, models.roll.Inputs(jnp.asarray(u)))
        for stand, one in zip((False, True), found, strict=True):
            wanted = rates(v, x, u, stand)
            scale = np.abs(rates(v, np.abs(x), 0.0, stand)) + np.abs(rates(v, 0 * x, u, stand))
            assert np.all(np.abs(np.array(one) - wanted) <= 1e-12 * (scale + np.abs(wanted)))


@pytest.mark.parametrize("stand", [False, True], ids=["free", "stand"])
@pytest.mark.parametrize("seed", SEEDS)
def test_equation_23_is_the_linearisation(seed, stand):
    p = Helicopter(**scattered(seed))
    model = models.roll_on_stand if stand else models.roll
    closed = roll_transfer_function(p, stand=stand)
    num, den = polynomials(model, p)
    np.testing.assert_allclose(den, closed.den, rtol=1e-9, atol=1e-9 * np.abs(den).max())
    np.testing.assert_allclose(num[1:], closed.num, rtol=1e-9)
    assert abs(num[0]) < 1e-9 * abs(closed.num[0])
    assert float(closed.den[4]) == 0.0 or stand


@pytest.mark.parametrize("stand", [False, True], ids=["free", "stand"])
@pytest.mark.parametrize("seed", SEEDS)
def test_equation_23_against_python_control(seed, stand):
    v = scattered(seed)
    A, B = matrices(v, stand)
    other = control.ss2tf(control.ss(A, B, np.eye(4)[:1], np.zeros((1, 1))))
    closed = roll_transfer_function(Helicopter(**v), stand=stand)
    ours = control.tf(np.array(closed.num), np.array(closed.den))
    s = 1j * np.geomspace(0.3, 600.0, 25)
    np.testing.assert_allclose(ours(s), other(s), rtol=1e-7)
    den = np.ravel(other.den[0][0])
    np.testing.assert_allclose(closed.den, den / den[0], rtol=1e-8, atol=1e-8 * np.abs(den).max())


def test_equation_23_letter_by_letter():
    v = BENCH
    q = v["rho"] * v["Omega"] ** 2 * v["a"] * v["c"]
    k1 = q * (v["R2"] ** 4 - v["R1"] ** 4) / (8 * v["If"])
    k2 = q * v["R"] ** 4 / (2 * v["Ixx"] * v["L1"] * (v["L2"] + v["L3"]))
    num, den = roll_transfer_function(Helicopter(**v))
    Om, L24 = v["Omega"], v["L2"] * v["L4"]
    np.testing.assert_allclose(den, [1, k1 / Om, Om**2, k1 * k2 * L24 / Om, 0], rtol=1e-13)
    d3 = k2 * (v["L3"] * Om**2 + L24 * k1 / v["L5"])
    np.testing.assert_allclose(num, [k2 * v["L3"], k1 * k2 * v["L3"] / Om, d3], rtol=1e-13)


@pytest.mark.parametrize("side", [0.9, 0.99, 1.01, 1.1])
@pytest.mark.parametrize("seed", SEEDS)
def test_stable_if_and_only_if(seed, side):
    v = {**scattered(seed), "Ixx_added": 0.0}
    k2 = v["rho"] * v["Omega"] ** 2 * v["a"] * v["c"] * v["R"] ** 4
    k2 /= 2 * v["Ixx"] * v["L1"] * (v["L2"] + v["L3"])
    v["L4"] = side * v["Omega"] ** 2 / (k2 * v["L2"])  # Omega^2 > k2 L2 L4 where side < 1
    found = modes(models.roll, Helicopter(**v))
    assert abs(found[0]) < 1e-6 * abs(found[-1])  # the pole at the origin
    assert (found[1:].real.max() < 0) == (side < 1)


@pytest.mark.parametrize("factor", [0.1, 3.0, 17.0])
def test_ixx_if_a_times_one_number_change_nothing(bench30, factor):
    p = naming.replace(bench30, **{n: factor * getattr(bench30, n) for n in ("Ixx", "If", "a")})
    state = models.roll.State(*map(jnp.asarray, (0.1, -0.5, 0.02, 3.0)))
    inputs = models.roll.Inputs(jnp.asarray(1e-5))
    for one, two in zip(
        free_and_stand(p, state, inputs), free_and_stand(bench30, state, inputs), strict=True
    ):
        np.testing.assert_allclose(one, two, rtol=1e-13)


def test_two_parameters_not_three(bench30):
    """Test the sensitivity to log Ixx, log If, log a: rank 2, null vector (1, 1, 1)."""
    rng = np.random.default_rng(3)
    states = rng.standard_normal((6, 4))

    def field(logs):
        p = naming.replace(bench30, **dict(zip(("Ixx", "If", "a"), jnp.exp(logs), strict=True)))
        each = [
            jnp.stack(models.roll.vector_field(p, models.roll.State(*map(jnp.asarray, s)), inputs))
            for s in states
        ]
        return jnp.concatenate(each)

    inputs = models.roll.Inputs(jnp.asarray(1e-3))
    start = jnp.log(jnp.stack([bench30.Ixx, bench30.If, bench30.a]))
    _, sizes, rows = np.linalg.svd(np.asarray(jax.jacfwd(field)(start)), full_matrices=False)
    assert sizes[2] < 1e-12 * sizes[0]
    assert sizes[1] > 1e-4 * sizes[0]
    np.testing.assert_allclose(np.abs(rows[2]), 1.0 / np.sqrt(3.0), rtol=1e-6)


@pytest.mark.parametrize("added", [0.0, 0.006, 0.024, 1.0])
def test_the_stand_stays_what_it_is_when_inertia_is_added(bench30, added):
    p = naming.replace(bench30, Ixx_added=jnp.asarray(added))
    x = models.roll.State(*map(jnp.asarray, (0.1, 0.7, 0.0, 0.0)))
    still = models.roll.Inputs(jnp.asarray(0.0))
    free, stand = free_and_stand(p, x, still)
    torque = (0.024 + added) * (stand.dphi - free.dphi)
    # kappa Ixx = 0.096 N m/rad and zeta Ixx = 0.0048 N m s/rad, whatever is fixed to the fuselage.
    assert float(torque) == pytest.approx(-(0.096 * 0.1 + 0.0048 * 0.7), rel=1e-13)


def test_pitch_is_roll_with_the_other_inertia():
    v = scattered(5)
    p = Helicopter(**{**v, "Iyy": v["Ixx"], "Iyy_added": v["Ixx_added"]})
    for one, other in (
        (models.roll, models.pitch),
        (models.roll_on_stand, models.pitch_on_stand),
    ):
        for a, b in zip(jacobians(one, p), jacobians(other, p), strict=True):
            np.testing.assert_array_equal(a, b)
    q = naming.replace(p, Ixx=jnp.asarray(9.0), Ixx_added=jnp.asarray(9.0))
    np.testing.assert_array_equal(jacobians(models.pitch, q).A, jacobians(models.pitch, p).A)


def test_on_stand_needs_an_axis():
    bare = Model(
        "bare", lambda p, s, u: s, lambda p, s, u: s, Helicopter, models.roll.Inputs,
        models.roll.Inputs, models.roll.Inputs,
    )  # fmt: skip
    with pytest.raises(ValueError, match="'bare' has no roll or pitch axis"):
        models.on_stand(bare)


@pytest.mark.parametrize("stand", [False, True], ids=["free", "stand"])
@pytest.mark.parametrize("seed", SEEDS)
def test_ratios_from_a_denominator(seed, stand):
    v = scattered(seed)
    if not stand:
        v["zeta"] = 0.0
    A, _ = matrices(v, stand)
    found = ratios_from_denominator(Helicopter(**v), np.poly(A))
    assert float(found.values["a/Ixx"]) == pytest.approx(v["a"] / v["Ixx"], rel=1e-6)
    assert float(found.values["a/If"]) == pytest.approx(v["a"] / v["If"], rel=1e-6)
    assert float(found.p2) == pytest.approx(float(found.p2_expected), rel=1e-8)


def test_another_structure_is_seen_in_the_coefficient_left_over(bench30):
    found = ratios_from_denominator(bench30, [1.0, 44.83, 5648.0, 209600.0, 1012000.0])
    assert abs(float(found.p2) / float(found.p2_expected) - 1.0) > 0.5
