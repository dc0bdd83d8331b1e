"""Pilot: slow motion is fed back, with little stick."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

from heli_jax import load_vehicle, models, naming
from heli_jax.analysis.trim import trim
from heli_jax.control import pilot as piloting
from heli_jax.simulation.simulate import simulate

STATES = ("phi", "theta", "psi", "dphi", "dtheta", "dpsi", "beta_roll", "beta_pitch")
STICKS = ("x_roll", "x_pitch", "x_yaw")


@pytest.fixture(scope="module")
def hover(vehicles_folder):
    vehicle = load_vehicle(vehicles_folder / "x-cell-60.yaml")
    model = models.by_name("helicopter-consistent")
    found = trim(model, vehicle)
    return model, vehicle, found, piloting.attitude_hold(model, vehicle, found)


def differences(f, at, names, steps):
    """Return central differences of the attitude's rates by the named fields of a record."""
    columns = []
    for name, h in zip(names, steps, strict=True):
        x = getattr(at, name)
        up, down = (f(naming.replace(at, **{name: x + s * h})) for s in (1.0, -1.0))
        columns.append([(getattr(up, n) - getattr(down, n)) / (2 * h) for n in STATES])
    return np.array(columns).T


def test_slow_modes_are_mirrored_with_the_least_stick(hover):
    model, vehicle, found, pilot = hover
    rates = jax.jit(lambda s, u: model.vector_field(vehicle, s, u))
    A = differences(lambda s: rates(s, found.inputs), found.state, STATES, [1e-5] * 8)
    B = differences(lambda u: rates(found.state, u), found.inputs, STICKS, [1e-8, 1e-8, 1e-5])
    K = np.array([[float(pilot.gains[s][n]) for n in STATES] for s in STICKS])
    before, after = np.linalg.eigvals(A), np.linalg.eigvals(A - B @ K)
    slow = before.real > -piloting.PACE
    assert slow.sum() == 4  # roll and pitch angles, heading and yaw rate
    kept = before[~slow]
    wanted = np.concatenate([-2 * piloting.PACE - before[slow], kept])
    np.testing.assert_allclose(np.sort_complex(after), np.sort_complex(wanted), atol=2e-3)
    # The regulator of an independent solver, for a vanishing cost of the state.
    size = np.linalg.norm(B, axis=0)
    b, shifted = B / size, A + piloting.PACE * np.eye(8)
    P = scipy.linalg.solve_continuous_are(shifted, b, 1e-7 * np.eye(8), np.eye(3))
    np.testing.assert_allclose(K * size[:, None], b.T @ P, rtol=0.02, atol=0.02)


def test_the_attitude_comes_back(hover):
    model, vehicle, found, pilot = hover
    held = jax.tree.map(lambda u: jnp.full(300, u), found.inputs)

    @jax.jit
    def fly(pilot, **off):
        start = naming.replace(found.state, **off)
        how = {"dt": 0.02, "initial_state": start, "feedback": pilot}
        return simulate(model, vehicle, held, **how).states

    rolled = fly(pilot, phi=jnp.asarray(0.3), psi=jnp.asarray(0.0))
    assert abs(rolled.phi[-1]) < 0.01
    turned = fly(pilot, phi=jnp.asarray(0.0), psi=jnp.asarray(-0.5))
    assert abs(turned.psi[-1]) < 0.01
    idle = piloting.Pilot(jax.tree.map(jnp.zeros_like, pilot.gains), pilot.trimmed)
    assert abs(fly(idle, phi=jnp.asarray(0.0), psi=jnp.asarray(-0.5)).psi[-1]) > 0.4


def test_a_stick_without_effect(hover):
    model, vehicle, found, _ = hover
    with pytest.raises(ValueError, match="do not move all of its attitude"):
        piloting.attitude_hold(model, naming.replace(vehicle, a_T=jnp.asarray(0.0)), found)
