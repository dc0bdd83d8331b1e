"""The variant `full` against forces and moments on a rigid body, and its switches one by one."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from heli_jax import load_vehicle, models, naming
from heli_jax.dynamics.helicopter import helicopter
from heli_jax.dynamics.jacobians import jacobians
from heli_jax.dynamics.loads import throttle
from heli_jax.dynamics.model import zeros
from tests.dynamics import full_helicopter as oracle

SCALES = {
    "phi": 0.4, "theta": 0.4, "psi": 2.0, "beta_roll": 0.2, "beta_pitch": 0.2,
    "dx": 6.0, "dy": 4.0, "dz": 4.0, "a1": 0.1, "b1": 0.1, "governor": 0.5,
}  # fmt: skip
STICKS = {
    "x_roll": 2e-3, "x_pitch": -3e-3, "x_yaw": -0.3, "x_collective": 0.5, "x_throttle": 1.0,
    "Omega": 157.0,
}  # fmt: skip


def scattered(rng, model):
    """Return a random vehicle, state and inputs."""
    v = {k: x * float(np.exp(0.2 * rng.standard_normal())) for k, x in oracle.FULL.items()}
    v |= {"B": 0.97, "R2": v["R1"] * (1.1 + rng.random()), "Ixx_added": 0.1, "Iyy_added": 0.05}
    s = {n: SCALES.get(n, 1.0) * rng.standard_normal() for n in naming.names(model.State)}
    s |= {"Omega": 157.0 * float(np.exp(0.2 * rng.standard_normal()))}
    u = {n: STICKS[n] for n in naming.names(model.Inputs)}
    return v, s, {n: x * float(np.exp(0.3 * rng.standard_normal())) for n, x in u.items()}


def rates(model, v, s, u):
    state = model.State(**{n: jnp.asarray(s[n]) for n in naming.names(model.State)})
    inputs = model.Inputs(**{n: jnp.asarray(u[n]) for n in naming.names(model.Inputs)})
    return naming.asdict(jax.jit(model.vector_field)(model.Params(**v), state, inputs))


def test_newton_and_euler_are_those_of_the_second_program():
    rng, model = np.random.default_rng(1), helicopter()
    limited = 0
    for _ in range(60):
        v, s, u = scattered(rng, model)
        wanted, found = oracle.rates(v, s, u), rates(model, v, s, u)
        assert set(found) == set(wanted)
        for name, value in wanted.items():
            assert float(found[name]) == pytest.approx(value, rel=1e-9, abs=1e-9), name
        free = v["K_P"] * (u["x_throttle"] * v["Omega"] - s["Omega"]) + s["governor"]
        limited += not 0 < free < 1
    assert 10 < limited < 50


MOVED = {
    "flapping": {"dx", "dy", "dz", "Omega", "dphi", "dtheta", "dpsi"},
    "speed_stability": {"dphi", "dtheta", "dpsi"},
    "tip_loss": {"dphi", "dtheta", "dpsi"},
    "tail_force": {"dx", "dy", "dz", "dphi", "dtheta", "dpsi"},
    "tail_power": {"Omega", "dphi", "dtheta", "dpsi"},
    "collective": {"dx", "dy", "dz", "Omega", "dphi", "dtheta", "dpsi"},
    "governor": {"Omega", "dphi", "dtheta", "dpsi"},
    "measured_speed": {"dphi", "dtheta", "dpsi"},
    "flybarless": {"dx", "dy", "dz", "Omega", "dphi", "dtheta", "dpsi"},
}


@pytest.mark.parametrize("switch", MOVED)
def test_each_switch_acts_alone_on_what_it_is_about(switch):
    """Test the additional states and inputs, compared with the consistent variant."""
    plain, model = helicopter("consistent"), helicopter("consistent", **{switch: True})
    assert model.name == f"helicopter-consistent+{switch}"
    rng = np.random.default_rng(2)
    v, s, u = scattered(rng, helicopter())
    s |= {"dx": 2.0, "dy": 1.0, "dz": -7.0, "phi": 0.1, "theta": -0.1, "Omega": 157.0}
    u |= {"x_throttle": 0.4, "x_collective": 0.5, "Omega": 157.0}
    before, after = rates(plain, v, s, u), rates(model, v, s, u)
    same = before.keys() & after.keys()
    assert {n for n in same if float(before[n]) != float(after[n])} == MOVED[switch]
    assert all(np.isfinite(float(x)) for x in after.values())


def test_a_measured_rotor_speed_is_that_of_the_rotor():
    """Test everything but the motor, whose torque on the fuselage equals the rotor's."""
    rng = np.random.default_rng(4)
    v, s, u = scattered(rng, helicopter())
    steady = s | {"governor": 0.0}
    found = rates(helicopter(measured_speed=True), v, s, u | {"Omega": s["Omega"]})
    whole = rates(helicopter(governor=False), v, steady, u)
    for name in ("dx", "dy", "dz", "a1", "b1", "beta_roll"):
        assert float(found[name]) == pytest.approx(float(whole[name]), rel=1e-12)
    # The throttle that keeps the rotor speed gives the same turn.
    keeps = u["x_throttle"] - float(whole["Omega"]) / v["K_throttle"]
    kept = rates(helicopter(governor=False), v, s, u | {"x_throttle": keeps})
    assert float(kept["Omega"]) == pytest.approx(0.0, abs=1e-9)
    assert float(found["dpsi"]) == pytest.approx(float(kept["dpsi"]), rel=1e-9)


def test_a_machine_without_a_flybar_needs_none(vehicles_folder):
    trex = load_vehicle(vehicles_folder / "t-rex-550.yaml")
    assert np.isnan(float(trex.If))
    model = helicopter(flybarless=True)
    at, u = naming.asdict(model.initial_state(trex)), STICKS | {"x_roll": 1e-3, "x_pitch": 0.0}
    moved = rates(model, naming.asdict(trex), at, u)
    assert all(np.isfinite(float(x)) for x in moved.values())
    # The whole stick: eq. 11 with L2 = 0.
    gamma = trex.rho * trex.a * trex.c * trex.R**4 / trex.I_beta
    k = gamma * trex.B**4 * trex.Omega / 16
    assert float(moved["b1"]) == pytest.approx(float(k * 1e-3 / trex.L1), rel=1e-12)


def test_the_governor_is_a_pi_with_limits():
    p = models.helicopter().Params(**oracle.FULL)
    for error, integral in ((2.0, 0.4), (-3.0, 0.5), (100.0, 0.2), (-157.1, 0.3)):
        held, slope = throttle(p, 157.1, 157.1 - error, integral)
        free = 0.01 * error + integral
        assert float(held) == pytest.approx(np.clip(free, 0.0, 1.0))
        if 0 < free < 1:
            assert float(slope) == pytest.approx(0.02 * error)
    # Switched off, the governor rests at zero throttle and a zero integral.
    held, slope = throttle(p, 0.0, 157.1, 0.0)
    assert float(held) == 0.0
    assert float(slope) == pytest.approx(0.0, abs=1e-12)


def test_nothing_is_not_a_number_at_rest():
    model, p = helicopter(), models.helicopter().Params(**oracle.FULL)
    at = zeros(model.State)
    still = model.Inputs(0.0, 0.0, 0.0, 0.0, 0.0)
    found = naming.asdict(model.vector_field(p, at, still))
    assert {n for n, v in found.items() if float(v) != 0.0} == {"dz"}
    for slopes in jacobians(model, p, at, still):
        assert np.isfinite(np.asarray(slopes)).all()
