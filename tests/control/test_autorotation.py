"""Landings without the engine against finite differences, energy and SciPy's integration."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate

import heli_jax
from heli_jax import naming
from heli_jax.control import autorotation as ar
from heli_jax.dynamics import aerodynamics as aero

GRID = ar.Grid(2, 8, 9)


@pytest.fixture(scope="module")
def model():
    return heli_jax.models.helicopter(wind=True)


@pytest.fixture(scope="module")
def params(vehicles_folder):
    return heli_jax.load_vehicle(vehicles_folder / "x-cell-60.yaml")


@pytest.fixture(scope="module")
def entry(model, params):
    return ar.engine_failure(model, params, 30.0, 8.0)


@pytest.fixture(scope="module")
def flight(model, params, entry):
    return jax.device_get(ar.fly(model, params, ar.Gains(), entry.state, ar.calm(model, 14.0)))


def test_the_feedback_lands_and_no_energy_appears(params, flight):
    assert np.isfinite(flight.ended)
    assert bool(ar.touchdown(params, flight).good())
    s, u = flight.states, flight.inputs
    assert np.all(u.x_throttle == 0)
    potential = float(params.m * params.g) * s.z
    kinetic = 0.5 * float(params.m) * (s.dx**2 + s.dy**2 + s.dz**2)
    energy = potential + kinetic + 0.5 * float(params.Ir) * s.Omega**2
    assert np.all(np.diff(energy[flight.times < flight.ended]) < 0)


@pytest.mark.slow
@pytest.mark.slow
def test_the_programme_has_the_derivatives_of_finite_differences(model, params, entry, flight):
    problem = ar.LandingProblem(model, params, entry, ar.Limits(), ar.CALM, GRID)
    rng = np.random.default_rng(0)
    z = problem.sampled(flight)
    direction = 1e-3 * rng.standard_normal(z.size) * problem.free
    plus, minus = (problem._evaluated(z + h * direction) for h in (1e-3, -1e-3))
    for (a, _), (b, _), (_, J) in zip(plus, minus, problem.evaluated(z), strict=True):
        np.testing.assert_allclose((a - b) / 2e-3, J @ direction, atol=1e-9)


@pytest.mark.slow
def test_the_optimum_lands_in_scipy_too(model, params, entry, flight):
    landing = ar.land(model, params, entry, start=flight, grid=GRID)
    assert landing.converged
    run = landing.trajectory
    end = jax.tree.map(lambda v: float(v[-1]), run.states)
    assert abs(end.dz) < 0.1
    assert np.hypot(end.dx, end.dy) < 0.2
    # Between the nodes the pitch angle may exceed its limit a little.
    assert min(landing.margins[n] for n in ("slow rotor", "fast rotor", "lift", "ground")) > -0.01
    # The same sticks, held at the same samples, without our solver.
    rates = jax.jit(
        lambda x, u: naming.ravel(
            model.vector_field(
                params, naming.unravel(model.State, x), naming.unravel(model.Inputs, u)
            )
        )
    )
    x, u = (np.stack([np.asarray(v) for v in tree], 1) for tree in (run.states, run.inputs))
    y = x[0]
    for k, h in enumerate(np.diff(run.times)):
        y = scipy.integrate.solve_ivp(
            lambda t, y, k=k: np.asarray(rates(y, u[k])), (0.0, h), y, rtol=1e-6, atol=1e-9
        ).y[:, -1]
    names = naming.names(model.State)
    for name in ("dx", "dz", "z", "theta"):
        assert y[names.index(name)] == pytest.approx(getattr(end, name), abs=0.02)


def test_the_collective_is_the_inverse_of_the_thrust(model, params, entry):
    s = naming.replace(entry.state, dz=jnp.asarray(-4.0), Omega=jnp.asarray(140.0))
    stick = ar._collective(params, s, jnp.asarray(90.0))
    forward, down = float(s.dx), -4.0
    sine, cosine = np.sin(float(s.theta)), np.cos(float(s.theta))
    air = aero.Flow((forward * cosine + down * sine) ** 2, down * cosine - forward * sine, 0.0)
    force = aero.thrust(params, s.Omega, params.K_theta0 * stick, air)
    assert float(force.T) == pytest.approx(90.0, rel=1e-9)
