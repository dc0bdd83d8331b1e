"""The whole helicopter against a second program of its equations, quadrature and a rotating bar."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from heli_jax import models, naming
from heli_jax.dynamics import aerodynamics
from heli_jax.dynamics.flybar import flybar_rate, flybar_time_constant
from heli_jax.dynamics.helicopter import helicopter
from heli_jax.dynamics.jacobians import jacobians
from heli_jax.dynamics.model import zeros as model_zeros
from tests.dynamics import blade_element, rotating_bar
from tests.dynamics import whole_helicopter as oracle

SCALES = {
    "phi": 0.4, "theta": 0.4, "psi": 2.0, "beta_roll": 0.2, "beta_pitch": 0.2,
    "dx": 6.0, "dy": 4.0, "dz": 2.0,
}  # fmt: skip


def scattered(rng):
    """Return a random vehicle, state and inputs."""
    v = {k: x * float(np.exp(0.2 * rng.standard_normal())) for k, x in oracle.XCELL.items()}
    v |= {"B": 0.97, "R2": v["R1"] * (1.1 + rng.random()), "Ixx_added": 0.1, "Iyy_added": 0.05}
    s = {n: SCALES.get(n, 1.0) * rng.standard_normal() for n in oracle.STATES["paper"]}
    s["Omega"] = 157.0 * float(np.exp(0.2 * rng.standard_normal()))
    u = {"x_roll": 2e-3, "x_pitch": -3e-3, "x_yaw": -0.3, "x_throttle": 0.5}
    return v, s, {n: x * float(np.exp(0.5 * rng.standard_normal())) for n, x in u.items()}


def params_of(v, Omega=157.1):
    return models.helicopter().Params(**{**v, "Omega": Omega})


def rates(model, v, s, u):
    state = model.State(**{n: jnp.asarray(s[n]) for n in naming.names(model.State)})
    inputs = model.Inputs(**{n: jnp.asarray(x) for n, x in u.items()})
    return jax.jit(model.vector_field)(params_of(v), state, inputs)


@pytest.mark.parametrize("variant", ["paper", "consistent"])
def test_every_derivative_is_the_second_program_s(variant):
    rng = np.random.default_rng(1)
    model = helicopter(variant)
    for _ in range(60):
        v, s, u = scattered(rng)
        wanted = oracle.RATES[variant](v, s, u)
        found = naming.asdict(rates(model, v, s, u))
        assert set(found) == set(wanted)
        for name, value in wanted.items():
            assert float(found[name]) == pytest.approx(value, rel=1e-9, abs=1e-9), name


def test_unknown_variants_and_switches_are_refused():
    with pytest.raises(ValueError, match="expected one of paper, consistent, full"):
        helicopter("physics")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"corrections: expected some of .*, got 'tails'"):
        helicopter("paper", tails=True)


def test_wind_is_the_airspeed_s_other_side():
    """Test that hover in wind equals flight through still air in the opposite direction."""
    rng = np.random.default_rng(3)
    v, s, u = scattered(rng)
    blown = helicopter("consistent", wind=True)
    s |= {"dx": 1.0, "dy": -2.0, "dz": 0.5}
    wind = {"wind_x": 3.0, "wind_y": 1.0, "wind_z": -1.0}
    found = naming.asdict(rates(blown, v, s, u | wind))
    wanted = oracle.consistent_rates(v, s, u, (3.0, 1.0, -1.0))
    for name, value in wanted.items():
        assert float(found[name]) == pytest.approx(value, rel=1e-9, abs=1e-9)


@pytest.mark.parametrize("chi", [0.0, 0.7, -1.57, 3.0])
def test_thrust_and_torque_are_those_of_blade_elements(chi):
    """Test all flight directions, without the term in mu^2 theta0 that eq. 13 neglects."""
    p = params_of(oracle.XCELL)
    Omega, theta0, lam, mu, by_pitch, by_roll = 157.0, 0.15, 0.04, 0.1, 0.03, -0.02
    tip = p.R * Omega
    along = np.cos(chi) * by_pitch + np.sin(chi) * by_roll  # flight to the right is chi = -90 deg
    air = aerodynamics.Flow((mu * tip) ** 2, lam * tip, mu * tip * along)
    force = aerodynamics.thrust(p, Omega, theta0, air, 0.0)
    sigma = aerodynamics.solidity(p.R, p.c)
    elements = {"theta_s": by_pitch, "theta_c": -by_roll, "chi": chi, "B": float(p.B)}
    wanted = blade_element.thrust_coefficient(p.a, sigma, theta0, lam, mu, **elements)
    dropped = 0.5 * p.a * sigma * p.B / 2 * mu**2 * theta0
    scale = p.rho * np.pi * p.R**2 * tip**2
    assert float(force.T / scale + dropped) == pytest.approx(float(wanted), rel=1e-12)
    Q = aerodynamics.torque(p, Omega, theta0, air, force.inflow) / (scale * p.R)
    induced = blade_element.induced_torque_coefficient(p.a, sigma, theta0, lam, mu, **elements)
    assert float(Q - sigma * p.Cd0 / 8) == pytest.approx(float(induced), rel=1e-12)


def test_hub_moment_is_that_of_blade_elements():
    p = params_of(oracle.XCELL)
    Omega = 157.0
    M = aerodynamics.hub_moment(p, Omega, 0.05, 0.01 * Omega)
    wanted = blade_element.rotor_moment_coefficient(0.05, 0.01)
    assert float(M / (p.rho * Omega**2 * p.a * p.c * p.R**4)) == pytest.approx(
        float(wanted), rel=1e-12
    )


def test_first_order_bar_is_the_rotating_bar():
    v = rotating_bar.XCELL
    p = params_of({**oracle.XCELL, **{n: v[n] for n in v if n != "Omega"}})
    tau = rotating_bar.time_constant(v)
    assert float(flybar_time_constant(p, v["Omega"])) == pytest.approx(tau, rel=0.02)
    right, up = rotating_bar.settled_tilt(v)
    assert right == pytest.approx(1.0, rel=0.02)  # per x/L5, as flybar_rate settles
    assert abs(up) < 0.02
    right, _ = rotating_bar.tilt_per_rate(v)
    x, rate = p.L5 * 1e-2, 0.1
    settled = 1e-2 + right * rate
    left = float(flybar_rate(p, v["Omega"], x, settled, rate))
    assert left == pytest.approx(0.0, abs=0.02 * rate)


def test_leaving_the_range_is_told():
    p, model = params_of(oracle.XCELL), helicopter("consistent")
    u = model.Inputs(0.0, 0.0, -0.5, 0.5)

    def limits(**changes):
        state = naming.replace(model.initial_state(p), **changes)
        return {n for n, out in model.limits(p, state, u).items() if bool(out)}

    assert limits() == set()
    assert limits(dz=-2.0) == set()
    assert limits(dz=-5.0) == set()
    assert "slow rotor" in limits(Omega=10.0)
    assert "fast flight" in limits(dx=60.0)
    assert limits(theta=1.5) >= {"nose up or down"}


@pytest.mark.parametrize("variant", ["paper", "consistent"])
def test_nothing_is_not_a_number_at_rest(variant):
    """Test a parked vehicle with its rotor stopped: finite derivatives, gravity alone."""
    model, p = helicopter(variant), params_of(oracle.XCELL)
    at = model_zeros(model.State)
    A, B, _, _ = jacobians(model, p, at)
    assert np.isfinite(np.asarray(A)).all()
    assert np.isfinite(np.asarray(B)).all()
    found = naming.asdict(model.vector_field(p, at, model.Inputs(0.0, 0.0, 0.0, 0.0)))
    assert {n for n, v in found.items() if float(v) != 0.0} == {"dz"}
    assert float(found["dz"]) == pytest.approx(-9.80665)


def test_dynamic_inflow_settles_where_momentum_theory_is():
    """Test that vi converges to the static one, at a rate limited by the inertia of the air."""
    model = helicopter("consistent", dynamic_inflow=True)
    u = model.Inputs(0.0, 0.0, -0.5, 0.5)
    _, s, _ = scattered(np.random.default_rng(5))
    s |= {"dz": 0.5, "Omega": 157.0}
    wanted = oracle.consistent_rotor(oracle.XCELL, s, naming.asdict(u))["vi"]
    for vi in (wanted - 1.0, wanted, wanted + 1.0):
        rate = rates(model, oracle.XCELL, {**s, "vi": vi}, naming.asdict(u)).vi
        assert np.sign(round(float(rate), 6)) == np.sign(round(wanted - vi, 6))
