"""simulate against scipy.signal, scipy.integrate and finite differences."""

import dataclasses
import functools
import itertools

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import scipy.linalg
import scipy.signal

from heli_jax import Flight, Helicopter, Model, accumulate, models, naming, simulate
from heli_jax.dynamics.disturbance import with_disturbance
from tests.dynamics.paper import BENCH, matrices, scattered

DT, N = 0.02, 60
STAND = models.roll_on_stand
X0 = np.array([0.05, -0.2, 0.01, 1.0])


def stick(n=N, seed=0, hold=4):
    levels = np.random.default_rng(seed).uniform(-1.0, 1.0, n // hold + 1)
    return 2e-6 * np.repeat(levels, hold)[:n]


U = stick()


def recurrence(v, u, x0, dt=DT):
    """Return states (N, 4) by SciPy's zero-order hold."""
    A, B = matrices(v, True)
    Ad, Bd, *_ = scipy.signal.cont2discrete((A, B, np.eye(4), np.zeros((4, 1))), dt)
    x = [np.asarray(x0, float)]
    for one in u[:-1]:
        x.append(Ad @ x[-1] + Bd[:, 0] * one)
    return np.array(x)


def switching(v, u, x0, delay, dt=DT):
    """Return states (N, 4) by solve_ivp, stopped at every sample and change of a delayed input."""
    A, B = matrices(v, True)
    n = len(u)
    ends = np.unique(np.round([*(np.arange(n) * dt), *(np.arange(n) * dt + delay)], 12))
    ends = ends[(ends >= 0) & (ends <= (n - 1) * dt + 1e-9)]
    x, states = np.asarray(x0, float), {0.0: np.asarray(x0, float)}
    for a, b in itertools.pairwise(ends):
        k = int(np.floor((0.5 * (a + b) - delay) / dt))
        now = u[min(max(k, 0), n - 1)]
        x = scipy.integrate.solve_ivp(
            lambda t, y, now=now: A @ y + B[:, 0] * now, (a, b), x,
            method="DOP853", rtol=1e-11, atol=1e-13,
        ).y[:, -1]  # fmt: skip
        states[b] = x
    return np.array([states[t] for t in np.round(np.arange(n) * dt, 12)])


def start(x=X0):
    return models.roll.State(*(jnp.asarray(s) for s in x))


@functools.cache
def compiled(solver="exact", delayed=False, substeps=4, adjoint=None, block=1):
    made = {"exact": "exact", "rk4": "rk4", "tsit5": dfx.Tsit5(), "heun": dfx.Heun()}[solver]

    def run(p, u, x0, delay):
        return simulate(
            STAND, p, models.roll.Inputs(u), dt=DT, initial_state=x0, solver=made,
            substeps=substeps, delay=delay if delayed else None, adjoint=adjoint, block=block,
        )  # fmt: skip

    return jax.jit(run)


def run(v, u=U, x0=X0, delay=None, **how):
    go = compiled(delayed=delay is not None, **how)
    return go(Helicopter(**v), jnp.asarray(u), start(x0), jnp.asarray(delay or 0.0))


def table(trajectory):
    return np.stack([np.asarray(x) for x in trajectory.states], axis=1)


def close(found, wanted, rtol):
    """Assert each column within rtol of its largest value."""
    size = np.abs(wanted).max(axis=0)
    np.testing.assert_allclose(np.asarray(found) / size, wanted / size, rtol=0, atol=rtol)


@pytest.mark.parametrize("seed", range(5))
def test_exact_is_scipys_zero_order_hold(seed):
    v = scattered(seed)
    found = run(v)
    close(table(found), recurrence(v, U, X0), 1e-10)
    np.testing.assert_array_equal(found.outputs.roll, found.states.phi)
    np.testing.assert_array_equal(found.outputs.roll_rate, found.states.dphi)
    np.testing.assert_allclose(found.times, DT * np.arange(N), rtol=1e-15)
    assert bool(found.finite)
    assert bool(found.result == dfx.RESULTS.successful)


@pytest.mark.parametrize(("block", "delay"), [(7, None), (7, 0.033), (3 * N, None)])
def test_blocks_of_any_size_give_the_same(block, delay):
    wanted = recurrence(BENCH, U, X0) if delay is None else switching(BENCH, U, X0, delay)
    close(table(run(BENCH, block=block, delay=delay)), wanted, 1e-9)


def test_rk4_converges_with_order_four():
    exact = recurrence(BENCH, U, X0)
    coarse, fine = (
        np.abs(table(run(BENCH, solver="rk4", substeps=s)) - exact)[:, 0].max() for s in (16, 32)
    )
    assert np.log2(coarse / fine) == pytest.approx(4.0, abs=0.2)


def test_the_input_is_held_to_the_end_of_its_interval():
    # Reading the next sample in the last stage would be a first-order error: 1e-2.
    close(table(run(BENCH, solver="rk4", substeps=32)), recurrence(BENCH, U, X0), 1e-5)
    close(table(run(BENCH, solver="tsit5", substeps=32)), recurrence(BENCH, U, X0), 1e-7)


@pytest.mark.parametrize("samples", [0, 1, 3, -1, -2])
@pytest.mark.parametrize("solver", ["exact", "rk4"])
def test_whole_samples_of_delay_shift_the_input(solver, samples):
    shifted = U[np.clip(np.arange(N) - samples, 0, N - 1)]
    how = {"solver": solver, "substeps": 4 if solver == "exact" else 16}
    found = run(BENCH, delay=samples * DT, **how)
    close(table(found), table(run(BENCH, shifted, **how)), 1e-9)


@pytest.mark.parametrize("delay", [0.004, 0.0199, 0.033, -0.007, -0.05])
def test_part_of_a_sample_of_delay(delay):
    wanted = switching(BENCH, U, X0, delay)
    close(table(run(BENCH, delay=delay)), wanted, 1e-9)
    close(table(run(BENCH, delay=delay, solver="rk4", substeps=16)), wanted, 1e-4)


NAMES = ("Ixx", "If", "a", "kappa", "L3", "Omega")


@pytest.fixture(scope="module")
def slopes():
    """Return (weights, logs, d cost / d logs by finite differences of SciPy's simulation)."""
    weights = np.random.default_rng(5).standard_normal(N)

    def cost(logs):
        v = {**BENCH, **dict(zip(NAMES, np.exp(logs), strict=True))}
        return np.sum(weights * recurrence(v, U, X0)[:, 0])

    logs, h = np.log([BENCH[n] for n in NAMES]), 1e-5
    wanted = [(cost(logs + e) - cost(logs - e)) / (2.0 * h) for e in np.eye(len(logs)) * h]
    return weights, logs, np.array(wanted)


def cost_of(weights, **how):
    def cost(logs):
        p = Helicopter(**{**BENCH, **dict(zip(NAMES, jnp.exp(logs), strict=True))})
        roll = compiled(**how)(p, jnp.asarray(U), start(), jnp.asarray(0.0)).states.phi
        return jnp.sum(weights * roll)

    return cost


def test_forward_reverse_and_finite_differences_agree(slopes):
    weights, logs, wanted = slopes
    forward = np.asarray(jax.jit(jax.jacfwd(cost_of(weights)))(jnp.asarray(logs)))
    reverse = np.asarray(jax.jit(jax.grad(cost_of(weights)))(jnp.asarray(logs)))
    size = np.abs(wanted).max()
    np.testing.assert_allclose(forward, reverse, rtol=1e-9, atol=1e-11 * size)
    np.testing.assert_allclose(forward, wanted, rtol=1e-6, atol=1e-6 * size)


@pytest.mark.slow
def test_checkpointed_reverse_mode_through_rk4(slopes):
    weights, logs, wanted = slopes
    how = {"solver": "rk4", "substeps": 16, "adjoint": dfx.RecursiveCheckpointAdjoint()}
    reverse = np.asarray(jax.jit(jax.grad(cost_of(weights, **how)))(jnp.asarray(logs)))
    np.testing.assert_allclose(reverse, wanted, rtol=1e-3, atol=1e-3 * np.abs(wanted).max())


@pytest.fixture(scope="module")
def fleet():
    """Test six vehicles in one batch: four sound, one NaN, one that diverges."""
    machines = [scattered(k) for k in range(4)]
    machines.insert(1, {**BENCH, "Ixx": np.nan, "Ixx_added": 0.0})
    machines.insert(3, {**BENCH, "Ixx": 1e-7, "Ixx_added": 0.0})
    batch = {n: jnp.asarray([v[n] for v in machines]) for n in machines[0]}
    return machines, Helicopter(**{n: batch[n] for n in batch})


def test_many_equal_one_by_one_and_the_broken_break_alone(fleet):
    machines, batch = fleet
    axes = jax.tree.map(lambda x: 0 if jnp.ndim(x) else None, batch)
    go, u = compiled(), jnp.asarray(U)
    many = jax.jit(jax.vmap(go, in_axes=(axes, None, None, None)))(
        batch, u, start(), jnp.asarray(0.0)
    )
    np.testing.assert_array_equal(many.finite, [True, False, True, False, True, True])
    for k, v in enumerate(machines):
        if k in (1, 3):
            continue
        close(np.asarray(many.states.phi[k]), recurrence(v, U, X0)[:, 0], 1e-9)


@pytest.mark.slow
def test_adaptive_steps_in_a_batch_with_a_broken_machine(fleet):
    machines, batch = fleet
    batch = jax.tree.map(lambda x: x[:3] if jnp.ndim(x) else x, batch)
    axes = jax.tree.map(lambda x: 0 if jnp.ndim(x) else None, batch)
    u = U[:12]

    def go(p):
        return simulate(
            STAND, p, models.roll.Inputs(u), dt=DT, initial_state=start(), max_steps=2000,
            solver=dfx.Tsit5(), controller=dfx.PIDController(rtol=1e-10, atol=1e-13),
        )  # fmt: skip

    many = jax.jit(jax.vmap(go, in_axes=(axes,)))(batch)
    np.testing.assert_array_equal(many.finite, [True, False, True])
    np.testing.assert_array_equal(many.result == dfx.RESULTS.successful, [True, False, True])
    for k in (0, 2):
        found = np.stack([np.asarray(x[k]) for x in many.states], axis=1)
        close(found, recurrence(machines[k], u, X0), 1e-8)


def test_accumulate_is_the_sum_over_simulate(bench30):
    measured = np.random.default_rng(2).standard_normal(N)

    def square(total, outputs, data):
        return total + (outputs.roll - data) ** 2

    inputs = models.roll.Inputs(U)

    @jax.jit
    def reduced(p):
        return accumulate(
            STAND, p, inputs, square, jnp.asarray(0.0), data=jnp.asarray(measured), dt=DT,
            initial_state=start(),
        )  # fmt: skip

    total, result = reduced(bench30)
    roll = np.asarray(run(BENCH).outputs.roll)
    assert float(total) == pytest.approx(np.sum((roll - measured) ** 2), rel=1e-12)
    assert bool(result == dfx.RESULTS.successful)


def test_accumulate_sees_every_sample_once_and_in_order(bench30):
    def update(value, outputs, k):
        return 10.0 * value + k

    total, _ = accumulate(
        STAND, bench30, models.roll.Inputs(U[:6]), update, jnp.asarray(0.0),
        data=jnp.arange(1.0, 7.0), dt=DT,
    )  # fmt: skip
    assert float(total) == 123456.0


def test_accumulate_has_a_derivative(bench30):
    def cost(Ixx):
        p = naming.replace(bench30, Ixx=Ixx)
        inputs = models.roll.Inputs(U[:20])
        return accumulate(
            STAND, p, inputs, lambda s, y, d: s + y.roll**2, jnp.asarray(0.0), dt=DT,
            adjoint=dfx.ForwardMode(),
        )[0]  # fmt: skip

    def by_scipy(Ixx):
        return np.sum(recurrence({**BENCH, "Ixx": Ixx}, U[:20], np.zeros(4))[:, 0] ** 2)

    wanted = (by_scipy(0.024 + 1e-7) - by_scipy(0.024 - 1e-7)) / 2e-7
    assert float(jax.jit(jax.jacfwd(cost))(jnp.asarray(0.024))) == pytest.approx(wanted, rel=1e-6)


def test_single_precision_stays_single_and_close(bench30):
    p = jax.tree.map(lambda x: x.astype(jnp.float32), bench30)
    u = models.roll.Inputs(jnp.asarray(U, jnp.float32))
    found = jax.jit(lambda p: simulate(STAND, p, u, dt=DT))(p)
    for leaf in (*found.states, *found.outputs):
        assert leaf.dtype == jnp.float32
    wanted = recurrence(BENCH, U, np.zeros(4))
    close(found.states.phi, wanted[:, 0], 1e-3)


bent = Model(
    "bent", lambda p, s, u: models.roll.State(*jax.tree.map(lambda x: -(x**3), tuple(s))),
    models.roll.output, Helicopter, models.roll.State, models.roll.Inputs, models.roll.Outputs,
)  # fmt: skip
GUSTY = with_disturbance(STAND, "roll")


@pytest.mark.parametrize(
    ("model", "inputs", "how"),
    [
        (bent, U, {"solver": "exact"}),
        (STAND, U, {"solver": "euler"}),
        (STAND, U, {"solver": "rk4", "substeps": 0}),
        (STAND, U, {"block": 0}),
        (STAND, U, {"solver": "rk4", "block": 4}),
        (STAND, U, {"dt": None}),
        (STAND, U[:1], {}),
        (STAND, U[None], {}),
        (STAND, U, {"key": jax.random.key(0)}),
        (STAND, U, {"solver": "rk4", "controller": dfx.PIDController(rtol=1e-6, atol=1e-6)}),
        (GUSTY, U, {"key": jax.random.key(0), "delay": 0.01}),
    ],
)
def test_wrong_arguments(bench30, model, inputs, how):
    params = model.Params(**naming.asdict(bench30))
    with pytest.raises(ValueError):  # noqa: PT011
        simulate(model, params, models.roll.Inputs(inputs), **{"dt": DT, **how})


@pytest.mark.slow
def test_noise_of_a_nonlinear_model_is_that_of_its_linearisation(bench30):
    """Test that on a linear model it equals the exact one, draw by draw."""
    model = with_disturbance(STAND, "roll")
    p = model.Params(**naming.asdict(bench30), sigma_w=jnp.asarray(1.0), tau_w=jnp.asarray(0.5))
    key, inputs = jax.random.key(3), models.roll.Inputs(U)
    other = dataclasses.replace(model, linear=False)
    exact = jax.jit(lambda p: simulate(model, p, inputs, dt=DT, key=key))(p)
    stepped = jax.jit(lambda p: simulate(other, p, inputs, dt=DT, key=key, substeps=16))(p)
    assert float(np.std(np.asarray(exact.states.w1_roll))) > 0.1
    for name in ("phi", "dphi", "w1_roll"):
        a = np.asarray(getattr(exact.states, name))
        b = np.asarray(getattr(stepped.states, name))
        np.testing.assert_allclose(b, a, rtol=0, atol=1e-6 * np.std(a))


@pytest.mark.parametrize("solver", ["exact", dfx.Tsit5()])
def test_a_second_run_compiles_nothing(bench30, solver):
    inputs = STAND.Inputs(x_roll=jnp.asarray(U))
    lighter = naming.replace(bench30, Ixx=0.9 * bench30.Ixx)
    for vehicle in (bench30, lighter):
        simulate(STAND, vehicle, inputs, dt=DT, solver=solver)
    compiled = []

    def note(event: str, _: float, **more: object) -> None:
        compiled.extend([more] * ("compile" in event))

    jax.monitoring.register_event_duration_secs_listener(note)
    try:
        simulate(STAND, bench30, inputs, dt=DT, solver=solver)
    finally:
        jax.monitoring.unregister_event_duration_listener(note)
    assert not compiled


def test_missing_input_of_a_flight_is_named(bench30):
    flight = Flight(dt=DT, inputs={"x_pitch": U}, outputs={})
    with pytest.raises(ValueError, match="no input 'x_roll', which roll-on-stand needs"):
        simulate(STAND, bench30, flight)
