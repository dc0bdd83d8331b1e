"""The whole helicopter in flight: invariants, order of the steps, feedback, events, status."""

import functools
from typing import NamedTuple

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate

from heli_jax import Model, load_vehicle, models, naming, simulate, trim
from heli_jax.simulation.events import ground, rotor_speed, stopped
from heli_jax.simulation.trajectory import STATUS
from tests.dynamics import whole_helicopter as oracle

DT = 0.02


@pytest.fixture(scope="module")
def xcell(vehicles_folder):
    p = load_vehicle(vehicles_folder / "x-cell-60.yaml")
    return naming.replace(p, Sx=jnp.asarray(0.1), Sy=jnp.asarray(0.22), Sz=jnp.asarray(0.15))


@pytest.fixture(scope="module")
def hover(xcell):
    return trim(models.helicopter("consistent"), xcell)


def sticks(found, n, *, roll=2e-4, pitch=-2e-4, yaw=0.05, throttle=0.01, seed=0):
    """Return small steps of all sticks about a trim, (N,)."""
    rng = np.random.default_rng(seed)
    sizes = {"x_roll": roll, "x_pitch": pitch, "x_yaw": yaw, "x_throttle": throttle}

    def one(name, value):
        steps = rng.uniform(-1, 1, n // 20 + 1) * sizes.get(name, 0.0)
        return jnp.asarray(float(value) + np.repeat(steps, 20)[:n])

    inputs = naming.asdict(found.inputs)
    return type(found.inputs)(**{k: one(k, v) for k, v in inputs.items()})


@pytest.fixture(scope="module")
def fleet():
    """Simulate three vehicles in the same flight of 50 samples, one program for several tests."""
    model = models.helicopter("consistent")

    @jax.jit
    def fleet(machines, state, inputs):
        machines = jax.tree.map(lambda *v: jnp.stack(v), *machines)
        one = lambda p: simulate(model, p, inputs, dt=DT, initial_state=state)  # noqa: E731
        return jax.vmap(one)(machines)

    return lambda machines, state, inputs: fleet(
        machines, jax.tree.map(jnp.asarray, state), jax.tree.map(jnp.asarray, inputs)
    )


@pytest.mark.slow
def test_free_fall_is_a_parabola(xcell, fleet):
    """Test without a rotor in the air and without drag."""
    model = models.helicopter("consistent")
    p = naming.replace(xcell, **{n: jnp.zeros(()) for n in ("a", "Cd0", "Sx", "Sy", "Sz")})
    s = naming.replace(model.initial_state(p), Omega=0.0, dx=3.0, dy=-1.0, dz=5.0, phi=0.3, psi=1.0)
    zero = jnp.zeros(50)
    run = jax.tree.map(lambda v: v[0], fleet([p, p, p], s, model.Inputs(zero, zero, zero, zero)))
    t = np.asarray(run.times)
    np.testing.assert_allclose(run.states.x, 3.0 * t, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(run.states.y, -1.0 * t, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(run.states.z, 5.0 * t - 0.5 * 9.80665 * t**2, rtol=1e-9, atol=1e-12)
    assert STATUS[int(run.status)] == "outside the model's range"  # the rotor is at rest
    assert set(np.flatnonzero(run.outside["slow rotor"])) == set(range(50))


def test_a_second_is_scipys_and_one_bad_element_leaves_the_others_alone(xcell, hover, fleet):
    """Test one flight against solve_ivp with the second program's derivatives."""
    n = 50
    u = sticks(hover, n)
    run = fleet([xcell, naming.replace(xcell, Ixx=jnp.asarray(jnp.nan)), xcell], hover.state, u)
    assert [STATUS[int(s)] for s in run.status] == ["ok", "not finite", "ok"]
    np.testing.assert_array_equal(run.states.phi[0], run.states.phi[2])
    names = oracle.STATES["consistent"]
    v = {**oracle.XCELL}
    x = np.array([float(getattr(hover.state, k)) for k in names])
    for k in range(n - 1):
        now = {m: float(a[k]) for m, a in naming.asdict(u).items()}

        def rates(t, y, now=now):
            d = oracle.consistent_rates(v, dict(zip(names, y, strict=True)), now)
            return [d[m] for m in names]

        x = scipy.integrate.solve_ivp(rates, (0, DT), x, rtol=1e-9, atol=1e-11).y[:, -1]
    for k, name in enumerate(names):
        assert float(getattr(run.states, name)[0, -1]) == pytest.approx(x[k], rel=1e-6, abs=1e-7)


def pilot(hover, gain=1.0):
    """Return an attitude feedback to hover, as a user would write it."""

    def feedback(s, u):
        return u._replace(
            x_roll=u.x_roll - gain * (4e-3 * s.phi + 1e-3 * s.dphi),
            x_pitch=u.x_pitch - gain * (4e-3 * s.theta + 1e-3 * s.dtheta),
            x_yaw=u.x_yaw - gain * (0.5 * s.psi + 0.2 * s.dpsi),
        )

    return feedback


@pytest.mark.slow
def test_feedback_is_applied_once_a_sample(xcell, hover):
    model, n = models.helicopter("consistent"), 30
    u = sticks(hover, n, roll=0.0, pitch=0.0, yaw=0.0, throttle=0.0)
    start = naming.replace(hover.state, phi=0.2, dtheta=0.1)
    law = pilot(hover)
    run = jax.jit(lambda s: simulate(model, xcell, u, dt=DT, initial_state=s, feedback=law))(start)
    two = jax.jit(lambda s, u: simulate(model, xcell, u, dt=DT, initial_state=s).states)
    # By hand: repeated runs of two samples.
    x = start
    for k in range(n - 1):
        now = law(x, jax.tree.map(lambda v, k=k: v[k], u))
        assert float(run.inputs.x_roll[k]) == pytest.approx(float(now.x_roll), rel=1e-12)
        pair = jax.tree.map(lambda v: jnp.stack([v, v]), now)
        x = jax.tree.map(lambda v: v[1], two(x, pair))
    for name in ("phi", "theta", "psi", "Omega"):
        assert float(getattr(run.states, name)[-1]) == pytest.approx(float(getattr(x, name)))
    adaptive = simulate(
        model, xcell, u, dt=DT, initial_state=start, feedback=law,
        controller=dfx.PIDController(rtol=1e-10, atol=1e-10),
    )  # fmt: skip
    np.testing.assert_allclose(adaptive.states.phi, run.states.phi, atol=1e-6)
    with pytest.raises(ValueError, match="feedback: expected a run without a delay"):
        simulate(model, xcell, u, dt=DT, feedback=law, delay=0.01)


class Gravity(NamedTuple):
    g: float


class Stone(NamedTuple):
    x: float
    z: float
    dx: float
    dz: float


class Nothing(NamedTuple):
    u: float


def falling(g, s, u):
    return Stone(s.dx, s.dz, 0.0 * u.u, -g.g + 0.0 * u.u)


STONE = Model("stone", falling, lambda g, s, u: s, Gravity, Stone, Nothing, Stone)


def test_the_ground_ends_a_run_at_its_moment():
    """Return a falling stone, since events do not depend on the helicopter."""
    p, u = Gravity(9.80665), Nothing(jnp.zeros(60))
    fall = Stone(x=0.0, z=2.0, dx=3.0, dz=0.0)

    def land(z, **how):
        start = naming.replace(fall, z=z)
        return simulate(STONE, p, u, dt=DT, initial_state=start, events={"ground": ground(0.3)},
                        **how)  # fmt: skip

    fixed = jax.jit(land)
    moment = np.sqrt(2 * 1.7 / 9.80665)
    controller = dfx.PIDController(rtol=1e-10, atol=1e-10)
    for run in (fixed(2.0), jax.jit(lambda z: land(z, controller=controller))(2.0)):
        assert int(run.event) == 0
        assert float(run.ended) == pytest.approx(moment, rel=1e-9)
        after = np.asarray(run.times) > moment
        np.testing.assert_allclose(np.asarray(run.states.z)[after], 0.3, atol=1e-9)
        np.testing.assert_allclose(np.asarray(run.states.x)[after], 3.0 * moment, rtol=1e-9)
    assert float(fixed(0.2).ended) == 0.0  # it started below
    aloft = fixed(200.0)
    assert int(aloft.event) == -1
    assert float(aloft.ended) == np.inf


def fallen(g, h):
    """Return a free fall from the height h over some samples, without an end."""
    t = DT * jnp.arange(60.0)
    return Stone(3.0 * t, h - 0.5 * g * t**2, 3.0 + 0.0 * t, -g * t)


def landed(g_and_h, states=None):
    """Return time and state of a stone that reaches 0.3 m; the time is 0 if it does not."""
    (g, h), events, u = g_and_h, {"ground": ground(0.3)}, Nothing(jnp.zeros(60))
    if states:
        at, (ended, event) = stopped(
            STONE, Gravity(g), events, DT * jnp.arange(60.0), states(g, h), u
        )
    else:
        start = Stone(x=0.0, z=h, dx=3.0, dz=0.0)
        run = simulate(STONE, Gravity(g), u, dt=DT, initial_state=start, events=events)
        at, ended, event = run.outputs, run.ended, run.event
    return jnp.stack([jnp.where(event < 0, 0.0, ended), at.x[-1], at.z[-1], at.dz[-1]])


@pytest.mark.parametrize(
    ("mode", "states"),
    [
        pytest.param(jax.jacrev, None, marks=pytest.mark.slow),
        (jax.jacfwd, fallen),
        (jax.jacrev, fallen),
    ],
)
def test_the_moment_of_an_event_has_the_derivatives_of_a_free_fall(mode, states):
    g, drop = 9.80665, 1.7
    t = np.sqrt(2 * drop / g)
    by_g, by_h = -t / (2 * g), 1 / (g * t)
    slopes = jax.jit(mode(functools.partial(landed, states=states)))
    # There x = 3 t and dz = -g t, and z is constant.
    wanted = [
        [by_g, by_h], [3 * by_g, 3 * by_h], [0.0, 0.0], [-t - g * by_g, -g * by_h]
    ]  # fmt: skip
    np.testing.assert_allclose(slopes(jnp.array([g, 0.3 + drop])), wanted, rtol=1e-9, atol=1e-9)
    # Without an event, or after one, nothing depends on its time.
    for h in (200.0, 0.2):
        found = np.asarray(slopes(jnp.array([g, h])))
        np.testing.assert_array_equal(found[0], 0.0)
        assert np.isfinite(found).all()
    if states:
        second = jax.jit(mode(mode(lambda z: landed(z, states)[0])))(jnp.array([g, 0.3 + drop]))
        mixed = -by_h / (2 * g)
        wanted = [[3 * t / (4 * g**2), mixed], [mixed, -by_h / (2 * drop)]]
        np.testing.assert_allclose(second, wanted, rtol=1e-7)


@pytest.mark.slow
def test_the_rotor_s_limits_end_a_run(xcell, hover):
    model = models.helicopter("consistent")
    u = sticks(hover, 60, roll=0.0, pitch=0.0, yaw=0.0, throttle=0.0)
    u = u._replace(x_throttle=0.8 * u.x_throttle)

    @jax.jit
    def flown(low, high):
        events = {"ground": ground(-1e3), "rotor speed": rotor_speed(low, high)}
        return simulate(model, xcell, u, dt=DT, initial_state=hover.state, events=events)

    Omega = np.asarray(flown(0.0, 1e3).states.Omega)
    farthest = Omega[np.argmax(np.abs(Omega - Omega[0]))]
    limit = 0.5 * (Omega[0] + farthest)
    run = flown(*((limit, 1e3) if farthest < Omega[0] else (0.0, limit)))
    assert int(run.event) == 1
    assert float(run.states.Omega[-1]) == pytest.approx(limit, abs=1e-6)
    assert STATUS[int(run.status)] == "ended by an event"
