"""Closed loops against recursions in NumPy, Riccati equations and python-control."""

import warnings

import control
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

from heli_jax import (
    Flight,
    Free,
    Nuisance,
    Problem,
    fit,
    linear_model,
    load_vehicle,
    naming,
    sweep,
)
from heli_jax.analysis.linear import linearize, modes
from heli_jax.analysis.trim import Condition, trim
from heli_jax.control.controller import (
    Controller,
    begin,
    commands,
    gains_of,
    in_loop,
    with_controller,
    with_gains,
)
from heli_jax.control.laws import Cascade, Loop, StateFeedback
from heli_jax.control.loops import (
    SampledLoop,
    controller_responses,
    growth,
    linear_step,
    loop_margins,
    plant_of,
    plant_responses,
    sampled_loop,
    sensitivity,
)
from heli_jax.control.posterior import SteadyFlights
from heli_jax.control.regulators import lqg, lqr, pid
from heli_jax.dynamics.helicopter import helicopter
from heli_jax.dynamics.model import zeros
from heli_jax.simulation.simulate import simulate
from heli_jax.sweeps import Reduce, grid

DT = 0.02


@pytest.fixture(scope="module")
def roll():
    found = linear_model("roll-flybarless")
    return found.model, found.vehicle().params


@pytest.fixture(scope="module")
def r50():
    found = linear_model("r50-hover")
    model = in_loop(found.model, naming.names(found.model.Inputs))
    return model, found.vehicle().params


@pytest.fixture(scope="module")
def helicopter_with_hold():
    model = helicopter()
    hold = StateFeedback(
        gains={"x_pitch": {"dx": -1e-4, "theta": -1e-3}}, integral={}, dt=DT,
        references=("dx", "theta"),
    )  # fmt: skip
    closed = with_controller(model, hold)
    vehicle = load_vehicle("configs/vehicles/x-cell-60.yaml")
    return closed, closed.Params(**naming.asdict(vehicle))


def at_rest(model):
    return SteadyFlights(zeros(model.State), zeros(model.Inputs))


def matrices(model, params):
    return tuple(np.asarray(M) for M in linearize(model, params).matrices)


def discrete(A, B, dt=DT):
    n, m = B.shape
    Phi = scipy.linalg.expm(dt * np.block([[A, B], [np.zeros((m, n + m))]]))
    return Phi[:n, :n], Phi[:n, n:]


def one(tree):
    return jax.tree.map(lambda v: v[None], tree)


MOST = {"phi": 0.2, "theta": 0.2, "u": 1.0, "v": 1.0, "w": 1.0, "r": 0.3,
        "lat": 0.05, "lon": 0.05, "col": 0.05, "ped": 0.05}  # fmt: skip


def test_a_closed_loop_is_the_recursion_of_plant_and_pid(roll):
    model, params = roll
    name, signal = "lat", "p"
    kp, ki, kd, lag, most = 0.05, 0.2, 0.001, 0.03, 0.02
    law = Cascade(loops={name: (Loop(kp, ki, kd, signal, most, lag),)}, dt=DT, references=(signal,))
    closed = with_controller(model, law)
    p = closed.Params(**naming.asdict(params))
    state, inputs = begin(closed, p, at_rest(model), 200)
    steps = np.where(np.arange(200) % 80 < 40, 0.4, -0.2)
    added = 0.01 * np.sin(np.arange(200))
    inputs = naming.replace(
        inputs, **{f"set_{signal}": jnp.asarray(steps), name: jnp.asarray(added)}
    )
    run = simulate(closed, p, inputs, dt=DT, initial_state=state, substeps=8)

    A, B, C, _ = matrices(model, params)
    Ad, Bd = discrete(A, B)
    x, integral, before, rate = np.zeros(len(A)), 0.0, 0.0, 0.0
    y, u = [], []
    for r, extra in zip(steps, added, strict=True):
        now = float((C @ x)[naming.names(model.Outputs).index("p")])
        rate += DT / (DT + lag) * ((now - before) / DT - rate)
        value = kp * (r - now) + ki * integral - kd * rate
        if abs(value) < most:
            integral += DT * (r - now)
        command, before = float(np.clip(value, -most, most)), now
        y.append(now)
        u.append(command)
        x = Ad @ x + Bd[:, 0] * (command + extra)
    np.testing.assert_allclose(getattr(run.outputs, signal), y, atol=1e-6)
    np.testing.assert_allclose(commands(closed, p, run)[name], u, atol=1e-6)
    assert np.max(np.abs(u)) == pytest.approx(most)


def test_lqr_gains_solve_the_riccati_equation(r50):
    model, params = r50
    law = lqr(model, params, at_rest(model), most=MOST, dt=DT)
    A, B, *_ = matrices(model, params)
    states = naming.names(model.State)
    Q = np.diag([1.0 / MOST[n] ** 2 if n in MOST else 0.0 for n in states])
    inputs = naming.names(model.Inputs)
    R = np.diag([1.0 / MOST[n] ** 2 for n in inputs])
    K = np.linalg.solve(R, B.T @ scipy.linalg.solve_continuous_are(A, B, Q, R))
    ours = np.array([[float(law.gains[n][s]) for s in states] for n in inputs])
    np.testing.assert_allclose(ours, K, rtol=1e-8, atol=1e-10)


@pytest.mark.slow
def test_a_set_point_of_an_output_is_that_of_its_state():
    model = helicopter()
    params = load_vehicle("configs/vehicles/x-cell-60.yaml")
    most = {"phi": 0.2, "theta": 0.2, "psi": 0.3, "x_roll": 4e-3, "x_pitch": 4e-3, "x_yaw": 0.5}
    by_state = lqr(
        model, params, hover := trim(model, params), most=most, dt=DT, references=("phi",)
    )
    by_output = lqr(model, params, hover, most=most, dt=DT, references=("roll",))
    assert by_output.gains["x_roll"]["roll"] == by_state.gains["x_roll"]["phi"]
    with pytest.raises(ValueError, match="state"):
        lqr(model, params, hover, most=most, dt=DT, references=("x",))


def test_a_slow_growth_beside_a_pole_near_half_the_sample_rate():
    loop = SampledLoop(
        *(np.array([M]) for M in (np.diag([1.004, -0.9998]), [[0.0], [1.0]], [[0.0, -1e-3]]))
    )  # fmt: skip
    (found,) = loop_margins(loop, DT)
    assert not found.stable[0]


def test_an_integral_removes_the_steady_error(r50):
    model, params = r50
    law = lqr(
        model, params, at_rest(model), most=MOST, dt=DT, integral={"w": 0.5}, references=("w",)
    )
    closed = with_controller(model, law)
    p = closed.Params(**naming.asdict(params))
    state, inputs = begin(closed, p, at_rest(model), 1500)
    inputs = naming.replace(inputs, set_w=jnp.full(1500, 0.5))
    run = simulate(closed, p, inputs, dt=DT, initial_state=state)
    assert float(run.states.w[-1]) == pytest.approx(0.5, abs=1e-3)


def test_modes_of_the_sampled_loop_are_those_of_a_simulation(r50):
    model, params = r50
    law = lqr(model, params, at_rest(model), most=MOST, dt=DT)
    plant = plant_of(model, params, zeros(model.State), zeros(model.Inputs), DT)
    loop = sampled_loop(model, plant, law)
    A, B, *_ = matrices(model, params)
    Ad, Bd = discrete(A, B)
    K = np.array(
        [[law.gains[n][s] for s in naming.names(model.State)] for n in naming.names(model.Inputs)]
    )
    wanted = np.linalg.eigvals(Ad - Bd @ K)
    found = np.linalg.eigvals(np.asarray(loop.A + loop.B @ loop.C))
    found = found[np.abs(found) > 1e-9]  # the held commands have no memory
    np.testing.assert_allclose(np.sort_complex(found), np.sort_complex(wanted), atol=1e-8)


def test_margins_are_those_of_gains_and_responses_in_numpy(r50):
    model, params = r50
    law = lqr(model, params, at_rest(model), most=MOST, dt=DT)
    plant = plant_of(model, params, zeros(model.State), zeros(model.Inputs), DT)
    found = loop_margins(one(sampled_loop(model, plant, law)), DT)
    A, B, *_ = matrices(model, params)
    Ad, Bd = discrete(A, B)
    inputs = naming.names(model.Inputs)
    K = np.array([[law.gains[n][s] for s in naming.names(model.State)] for n in inputs])
    for i, ours in enumerate(found):
        others = [j for j in range(len(inputs)) if j != i]
        inner = Ad - Bd[:, others] @ K[others]
        assert bool(ours.stable[0])
        wanted = 20 * np.log10(least_gain(inner, Bd[:, i], K[i]))
        assert float(ours.gain[0]) == pytest.approx(wanted, rel=1e-3)
        assert float(ours.phase[0]) == pytest.approx(least_phase(inner, Bd[:, i], K[i]), rel=1e-4)


def test_margins_of_a_rate_loop_are_those_of_python_control(roll):
    # A small loop: python-control's margins of the R-50's loops in z differ from its responses.
    model, params = roll
    law = Cascade(loops={"lat": (Loop(0.5, signal="p"),)}, dt=DT, references=("p",))
    plant = plant_of(model, params, zeros(model.State), zeros(model.Inputs), DT)
    (found,) = loop_margins(one(sampled_loop(model, plant, law)), DT)
    A, B, *_ = matrices(model, params)
    kept = [naming.names(model.State).index(n) for n in ("p", "b")]
    Ad, Bd = discrete(A[np.ix_(kept, kept)], B[np.ix_(kept, [0])])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        s = control.ss(Ad, Bd, 0.5 * np.eye(2)[:1], 0.0, DT)
        gm, pm, *_ = control.stability_margins(s, returnall=True)
    assert float(found.gain[0]) == pytest.approx(np.min(np.abs(20 * np.log10(gm))), rel=1e-4)
    assert float(found.phase[0]) == pytest.approx(np.min(np.abs(pm)), rel=1e-4)


def test_growth_is_that_of_the_slowest_mode(roll):
    model, params = roll
    plant = plant_of(model, params, zeros(model.State), zeros(model.Inputs), DT)
    for gain in (0.5, 5.0, 60.0):
        law = Cascade(
            loops={"lat": (Loop(2.0, signal="phi"), Loop(gain, signal="p"))}, dt=DT,
            references=("phi",),
        )  # fmt: skip
        loop = sampled_loop(model, plant, law)
        modes = np.linalg.eigvals(np.asarray(loop.A + loop.B @ loop.C))
        wanted = np.log(np.max(np.abs(modes))) / DT
        assert float(growth(loop, DT)) == pytest.approx(wanted, abs=0.02)


def least_phase(A, b, k):
    """Return the least phase of -L [deg] where |L| is one, on a dense grid."""
    omega = np.geomspace(1e-3, np.pi / DT, 200_000)
    size, vectors = np.linalg.eig(A)
    terms = (k @ vectors) * np.linalg.solve(vectors, b)
    L = (terms / (np.exp(1j * omega * DT)[:, None] - size)).sum(1)
    at = np.flatnonzero(np.diff(np.sign(np.abs(L) - 1.0)))
    return np.min(np.abs(np.degrees(np.angle(-L[at]))), initial=np.inf)


def least_gain(A, b, k):
    """Return the smallest factor of a loop's gain, above or below one, that makes it unstable."""

    def stable(gain):
        return np.max(np.abs(np.linalg.eigvals(A - gain * np.outer(b, k)))) < 1.0

    factors = np.geomspace(1.0, 1000.0, 4000)
    for up, down in zip(factors, 1.0 / factors, strict=True):
        if not (stable(up) and stable(down)):
            return up
    return np.inf


def test_poles_of_lqg_are_those_of_regulator_and_filter(r50):
    """Separation: an independent Kalman filter and the regulator give the poles."""
    model, params = r50
    sd = {"u": 0.1, "v": 0.1, "w": 0.1, "p": 0.01, "q": 0.01, "r": 0.01, "phi": 0.01, "theta": 0.01}
    noise = {"u": 0.5, "v": 0.5, "w": 0.5, "p": 0.2, "q": 0.2, "r": 0.2}
    law = lqg(model, params, at_rest(model), most=MOST, sd=sd, noise=noise, dt=DT)
    plant = plant_of(model, params, zeros(model.State), zeros(model.Inputs), DT)
    loop = sampled_loop(model, plant, law)
    states = naming.names(model.State)
    A, B, *_ = matrices(model, params)
    Ad, Bd = discrete(A, B)
    K = np.array([[law.gains[n][s] for s in states] for n in naming.names(model.Inputs)])
    C = np.array([[float(s == n) for s in states] for n in sd])
    W = np.diag([noise.get(s, 0.0) ** 2 for s in states])
    # The integral of the noise over a sample, by the trapezoidal rule.
    grid = np.linspace(0.0, DT, 401)
    terms = np.array([scipy.linalg.expm(A * t) @ W @ scipy.linalg.expm(A * t).T for t in grid])
    Q, R = np.trapezoid(terms, grid, axis=0), np.diag(np.square(list(sd.values())))
    P = np.eye(len(A))
    for _ in range(20000):  # the filter's recursion, until it is stationary
        M = P @ C.T @ np.linalg.inv(C @ P @ C.T + R)
        P = Ad @ (P - M @ C @ P) @ Ad.T + Q
    wanted = np.concatenate([np.linalg.eigvals(Ad - Bd @ K), np.linalg.eigvals(Ad - Ad @ M @ C)])
    found = np.linalg.eigvals(np.asarray(loop.A + loop.B @ loop.C))
    largest = np.sort(np.abs(found))[::-1][: len(wanted)]
    np.testing.assert_allclose(largest, np.sort(np.abs(wanted))[::-1], atol=2e-4)


def test_a_filter_in_the_loop_is_the_recursion_in_numpy(r50):
    model, params = r50
    sd = {"u": 0.1, "v": 0.1, "w": 0.1, "p": 0.01, "q": 0.01, "r": 0.01, "phi": 0.01, "theta": 0.01}
    noise = {"u": 0.5, "v": 0.5, "w": 0.5, "p": 0.2, "q": 0.2, "r": 0.2}
    law = lqg(
        model, params, at_rest(model), most=MOST, sd=sd, noise=noise, dt=DT, references=("phi",)
    )
    closed = with_controller(model, law)
    p = closed.Params(**naming.asdict(params))
    state, inputs = begin(closed, p, at_rest(model), 100)
    inputs = naming.replace(inputs, set_phi=jnp.full(100, 0.1), lat=jnp.full(100, 0.01))
    run = simulate(closed, p, inputs, dt=DT, initial_state=state, substeps=16)
    A, B, *_ = matrices(model, params)
    Ad, Bd = discrete(A, B)
    states, driven = naming.names(model.State), naming.names(model.Inputs)
    K = np.array([[law.gains[n][s] for s in states] for n in driven])
    C = np.array([[float(s == n) for s in states] for n in sd])
    target = np.array([0.1 * (s == "phi") for s in states])
    added = np.array([0.01 * (n == "lat") for n in driven])
    x, e, phi = np.zeros(len(A)), np.zeros(len(A)), []
    for _ in range(100):
        phi.append(x[states.index("phi")])
        e = e + np.asarray(law.M) @ (C @ x - C @ e)
        u = K @ (target - e)
        e, x = Ad @ e + Bd @ u, Ad @ x + Bd @ (u + added)
    np.testing.assert_allclose(run.states.phi, phi, atol=1e-5)


def test_loops_of_a_cascade_cross_where_they_should(r50):
    model, params = r50
    wanted = {"lat": {"phi": 2.0, "p": 8.0}, "lon": {"theta": 2.0, "q": 8.0}}
    law = pid(model, params, at_rest(model), loops=wanted, dt=DT)
    plant = plant_of(model, params, zeros(model.State), zeros(model.Inputs), DT)
    # The rate of the first axis alone: its response to the command, in NumPy.
    A, B, *_ = matrices(model, params)
    Ad, Bd = discrete(A, B)
    states = naming.names(model.State)
    z = np.exp(1j * 8.0 * DT)
    H = np.linalg.solve(z * np.eye(len(A)) - Ad, Bd[:, naming.names(model.Inputs).index("lat")])
    rate = law.loops["lat"][1]
    assert float(rate.p) * abs(H[states.index("p")]) == pytest.approx(1.0, rel=1e-6)
    loop = sampled_loop(model, plant, law)
    closed = np.asarray(loop.A + loop.B @ loop.C)
    assert np.max(np.abs(np.linalg.eigvals(closed))) < 1.02  # the speeds are not controlled
    row = [*states].index("phi")
    omega = np.array([0.5, 20.0])
    P = plant_responses(model, plant, law, DT, omega)
    K, R = controller_responses(linear_step(model, plant, law), DT, omega)
    H = np.asarray(P @ sensitivity(K, P) @ R)[:, row, 0]
    assert abs(H[0]) > 3 * abs(H[1])
    b = Bd[:, [naming.names(model.Inputs).index(n) for n in wanted]]
    k = np.zeros((2, len(A)))
    for i, (angle, of_angle) in enumerate(by for by in law.loops.values()):
        k[i, states.index(angle.signal)] = float(of_angle.p) * float(angle.p)
        k[i, states.index(of_angle.signal)] = float(of_angle.p)
    z = np.exp(1j * omega[0] * DT)
    x = np.linalg.solve(z * np.eye(len(A)) - Ad + b @ k, b[:, 0] * k[0, row])
    assert H[0] == pytest.approx(x[row], rel=1e-8)


def test_gains_are_parameters_that_a_fit_estimates(roll):
    """A plant is identified through a controller, together with an unknown gain."""
    model, params = roll
    name, signal = "lat", "p"
    law = Cascade(loops={name: (Loop(0.05, signal=signal),)}, dt=DT, references=(signal,))
    closed = with_controller(model, law)
    (gain,) = gains_of(law)
    p = closed.Params(**naming.asdict(params))
    _, inputs = begin(closed, p, at_rest(model), 600)
    rng = np.random.default_rng(3)
    moves = np.repeat(rng.uniform(-0.5, 0.5, 60), 10)
    inputs = naming.replace(inputs, **{f"set_{signal}": jnp.asarray(moves)})
    run = simulate(closed, p, inputs, dt=DT)
    y = np.asarray(getattr(run.outputs, signal)) + 0.002 * rng.standard_normal(600)
    flight = Flight(
        DT, {n: np.asarray(v) for n, v in naming.asdict(inputs).items()}, {signal: y},
        sd={signal: 0.002},
    )  # fmt: skip
    free = {gain: Free(0.03)}
    found = fit(Problem(closed, p, [flight], free, Nuisance(bias=False, initial_state=False)))
    e = found.estimates[gain]
    assert found.status == "converged"
    assert e.sd is not None
    assert abs(e.value - 0.05) < 3 * e.sd < 0.01
    with pytest.raises(ValueError, match="output-error"):
        Problem(closed, p, [flight], free, method="frequency-error")
    slow = Flight(2 * DT, flight.inputs, flight.outputs, sd=flight.sd)
    with pytest.raises(ValueError, match="controller"):
        Problem(closed, p, [slow], free)


def test_noise_of_a_sensor_acts_as_the_opposite_set_point(roll):
    model, params = roll
    law = Cascade(loops={"lat": (Loop(0.05, 0.1, signal="p"),)}, dt=DT, references=("p",))
    closed = with_controller(model, law, noise=("p",))
    p = closed.Params(**naming.asdict(params))
    state, inputs = begin(closed, p, at_rest(model), 100)
    drawn = jnp.asarray(np.random.default_rng(1).standard_normal(100))

    def rates(**changes):
        run = simulate(closed, p, naming.replace(inputs, **changes), dt=DT, initial_state=state)
        return np.asarray(run.outputs.p)

    np.testing.assert_allclose(rates(noise_p=drawn), rates(set_p=-drawn), atol=1e-12)
    with pytest.raises(ValueError, match="nothing"):
        with_controller(model, law, noise=("nothing",))


@pytest.mark.slow
def test_a_closed_loop_is_steady_in_the_trim_of_its_helicopter(helicopter_with_hold):
    closed, params = helicopter_with_hold
    at = trim(closed, params, Condition(forward_speed=3.0))
    state, inputs = begin(closed, params, at, 50)
    assert float(inputs.set_dx[0]) == pytest.approx(3.0)
    run = simulate(closed, params, inputs, dt=DT, initial_state=state, substeps=4)
    assert np.ptp(np.asarray(run.states.dx)) < 1e-8
    assert np.max(np.abs(np.asarray(run.states.command_x_pitch))) < 1e-10


def test_derivatives_by_gains_are_differences(roll):
    model, params = roll
    name, signal = "lat", "p"
    law = Cascade(loops={name: (Loop(0.05, 0.1, signal=signal),)}, dt=DT, references=(signal,))
    closed = with_controller(model, law)
    p = closed.Params(**naming.asdict(params))
    state, inputs = begin(closed, p, at_rest(model), 100)
    inputs = naming.replace(inputs, **{f"set_{signal}": jnp.ones(100)})

    @jax.jit
    def cost(gain):
        changed = naming.replace(p, **{f"controller_loops_{name}_{signal}_p": gain})
        run = simulate(closed, changed, inputs, dt=DT, initial_state=state)
        return jnp.sum(getattr(run.outputs, signal) ** 2)

    h = 1e-5
    wanted = (cost(0.05 + h) - cost(0.05 - h)) / (2 * h)
    assert float(jax.grad(cost)(0.05)) == pytest.approx(float(wanted), rel=1e-5)


@pytest.mark.parametrize("backend", ["xla", "fused"])
def test_gains_are_axes_of_sweeps(roll, backend):
    if backend == "fused":
        pytest.importorskip("llvmlite")
    model, params = roll
    law = Cascade(
        loops={"lat": (Loop(2.0, signal="phi"), Loop(0.02, signal="p"))}, dt=DT,
        references=("phi",),
    )  # fmt: skip
    closed = with_controller(model, law)
    p = closed.Params(**naming.asdict(params))
    state, inputs = begin(closed, p, at_rest(model), 100)
    inputs = naming.replace(inputs, set_phi=jnp.full(100, 0.2))
    given = {n: np.asarray(v) for n, v in naming.asdict(inputs).items()}
    flight = Flight(DT, given, {"phi": np.zeros(100)}, sd={"phi": 0.01})
    axis, gains = "controller_loops_lat_phi_p", np.array([0.5, 1.0, 3.0])
    swept = sweep(
        closed, p, flight, grid({axis: gains}), {"end": Reduce("final", "phi")}, backend=backend
    )
    wanted = [
        float(
            simulate(
                closed, naming.replace(p, **{axis: k}), inputs, dt=DT, initial_state=state
            ).outputs.phi[-1]
        )
        for k in gains
    ]
    np.testing.assert_allclose(swept["end"].values, wanted, rtol=1e-9)
    with pytest.raises(ValueError, match="controller"):
        sweep(closed, p, flight, grid({axis: gains}), {"modes": Reduce("modes")})
    slow = Flight(2 * DT, given, flight.outputs, sd=flight.sd)
    with pytest.raises(ValueError, match="controller"):
        sweep(closed, p, slow, grid({axis: gains}), {"end": Reduce("final", "phi")})


class Bad(Controller):
    """A controller that reads a signal no model has."""

    dt: float = eqx.field(static=True, default=DT)
    references: tuple[str, ...] = eqx.field(static=True, default=())
    reads: str = eqx.field(static=True, default="nothing")
    drives: str = eqx.field(static=True, default="lat")

    def init(self):
        return {}

    def step(self, state, measurement, reference):
        return {}, {self.drives: -measurement[self.reads]}


def test_wrong_controllers_are_refused(r50):
    model, params = r50
    for bad in (Bad(), Bad(reads="p", drives="x"), Bad(reads="p", references=("nothing",))):
        with pytest.raises(ValueError, match="model"):
            with_controller(model, bad)
    closed = with_controller(model, Bad(reads="p"))
    with pytest.raises(ValueError, match="controller"):
        with_controller(closed, Bad(reads="p"))
    p = closed.Params(**naming.asdict(params))
    state, inputs = begin(closed, p, at_rest(model), 10)
    with pytest.raises(ValueError, match=r"0\.02"):
        simulate(closed, p, inputs, dt=0.01, initial_state=state)
    for analysis in (linearize, modes):
        with pytest.raises(ValueError, match="controller"):
            analysis(closed, p)


def test_with_gains_changes_scalars_alone():
    law = StateFeedback(
        gains={"lat": {"p": 1.0}}, integral={"lat": {"phi": 2.0}}, dt=DT, references=("phi",)
    )
    names = list(gains_of(law))
    assert names == ["controller_gains_lat_p", "controller_integral_lat_phi"]
    changed = with_gains(law, dict(zip(names, (3.0, 4.0), strict=True)))
    assert list(gains_of(changed).values()) == [3.0, 4.0]
    assert changed.references == ("phi",)
