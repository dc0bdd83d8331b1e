"""The tip-path plane against blade elements of a teetering rotor in the rotating frame."""

from typing import NamedTuple

import jax
import numpy as np
import pytest

from heli_jax import models
from heli_jax.dynamics import tip_path_plane
from heli_jax.dynamics.tip_path_plane import Tilt
from tests.dynamics import blade_element
from tests.dynamics import teetering_rotor as rotating
from tests.dynamics.full_helicopter import FULL

B, OMEGA = 0.97, FULL["Omega"]


def vehicle(**changes):
    return models.helicopter().Params(**(FULL | changes))


class Rates(NamedTuple):
    p: float = 0.0
    q: float = 0.0


def settled(p, driven, rates):
    """Return the equilibrium of flapping_rates, which is linear in the tilt."""

    def field(a1, b1):
        return np.array(
            tip_path_plane.flapping_rates(p, OMEGA, Tilt(a1, b1), driven, rates, B), float
        )

    zero = field(0.0, 0.0)
    A = np.stack([field(1.0, 0.0) - zero, field(0.0, 1.0) - zero], axis=1)
    return np.linalg.solve(A, -zero)


@pytest.mark.parametrize("k_beta", [0.0, 54.0])
@pytest.mark.parametrize("axis", ["pitch", "roll"])
def test_cyclic_pitch_tilts_the_rotor_as_its_blades_do(k_beta, axis):
    v = FULL | {"k_beta": k_beta}
    driven = Tilt(0.05, 0.0) if axis == "pitch" else Tilt(0.0, 0.05)
    wanted = rotating.simulate(v, 12, **{axis: 0.05})[-1]
    found = settled(vehicle(k_beta=k_beta), driven, Rates())
    np.testing.assert_allclose(found, wanted, atol=0.03 * 0.05)


def test_the_time_constant_is_that_of_the_blades():
    p = vehicle()
    for k_beta in (0.0, 54.0):
        free = rotating.simulate(FULL | {"k_beta": k_beta}, 7, tilt=(0.05, 0.0))
        size = np.hypot(*free.T)
        decay = np.log(size[2] / size[6]) / (4 * 2 * np.pi / OMEGA)
        assert float(tip_path_plane.flapping_rate_constant(p, OMEGA, B)) == pytest.approx(
            decay, rel=0.03
        )
    gamma = FULL["rho"] * FULL["a"] * FULL["c"] * FULL["R"] ** 4 / FULL["I_beta"]
    assert float(tip_path_plane.flapping_rate_constant(p, OMEGA, 1.0)) == pytest.approx(
        gamma * OMEGA / 16
    )


@pytest.mark.parametrize("axis", ["p", "q"])
def test_the_rotor_stays_behind_a_body_that_turns(axis):
    """Test the tilt about the turn's axis; across it a tilt of rate over Omega is neglected."""
    v = FULL | {"k_beta": 0.0}
    wanted = rotating.simulate(v, 12, **{axis: 0.5})[-1]
    found = settled(vehicle(k_beta=0.0), Tilt(0.0, 0.0), Rates(**{axis: 0.5}))
    on = 0 if axis == "q" else 1
    assert found[on] == pytest.approx(wanted[on], rel=0.03)
    assert abs(wanted[1 - on]) == pytest.approx(0.5 / OMEGA, rel=0.03)


@pytest.mark.parametrize(("forward", "right"), [(6.0, 0.0), (0.0, 6.0)])
def test_the_rotor_tilts_back_from_where_it_flies_to(forward, right):
    theta0, inflow = 0.15, 4.9
    p = vehicle(k_beta=0.0)
    flight = {"theta0": theta0, "inflow": inflow, "forward": forward, "right": right}
    wanted = rotating.simulate(FULL | {"k_beta": 0.0}, 12, **flight)[-1]
    lift = tip_path_plane.speed_lift(p, OMEGA, theta0, inflow, B)
    back = float(tip_path_plane.flap_back(p, OMEGA, lift, B))
    found = settled(p, Tilt(back * forward, -back * right), Rates())
    np.testing.assert_allclose(found, wanted, atol=0.03 * float(np.hypot(*wanted)))
    assert forward * found[0] - right * found[1] > 0


def test_the_first_harmonic_of_a_rigid_hub_is_that_of_quadrature():
    p, theta0, lam, V = vehicle(), 0.15, 0.045, 5.0
    tip = FULL["R"] * OMEGA
    mu = V / tip

    def excess(r, psi):
        # Two blades: terms even in psi cancel and have no first harmonic.
        flow = r + mu * np.sin(psi)
        return 2 * r * (flow**2 * theta0 - flow * lam) * np.sin(psi)

    wanted = blade_element._mean(excess, B) * FULL["rho"] * FULL["a"] * FULL["c"] / 2
    wanted *= tip**2 * FULL["R"] ** 2
    lift = tip_path_plane.speed_lift(p, OMEGA, theta0, lam * tip, B)
    found = float(tip_path_plane.first_harmonic_moment(p, lift)) * V
    assert found == pytest.approx(wanted, rel=1e-6)


def test_a_stopped_rotor_has_finite_rates_and_slopes():
    p = vehicle()

    def rates(Omega):
        lift = tip_path_plane.speed_lift(p, Omega, 0.1, 0.0, B)
        back = tip_path_plane.flap_back(p, Omega, lift, B)
        return tip_path_plane.flapping_rates(p, Omega, Tilt(0.0, 0.0), Tilt(back, 0.0), Rates(), B)

    for value in (*rates(0.0), *jax.jacfwd(rates)(0.0)):
        assert np.isfinite(float(value))
