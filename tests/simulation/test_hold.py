"""Inputs that are linear between samples, against scipy with np.interp as the input."""

import functools
import itertools
from typing import NamedTuple

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import scipy.linalg
import scipy.signal

from heli_jax import Flight, Model, accumulate, simulate
from heli_jax.identification.estimation.kalman import innovations
from heli_jax.simulation.accumulate import accumulated

DT, N = 0.05, 41
RNG = np.random.default_rng(3)
DE, DR = RNG.standard_normal(N), np.repeat(RNG.standard_normal(N // 4 + 1), 4)[:N]
STICK = np.r_[np.repeat([0.0, 1.0, -1.0, 0.4], 5), 0.4 + 0.3 * np.sin(0.2 * np.arange(N - 20))]
STEPPED = np.arange(N) < 20
"""Held intervals of STICK."""
X0 = np.array([0.3, -0.5])
A = np.array([[-1.2, 20.0], [0.3, -3.7]])
B = np.array([[-2.0, 0.4], [-9.0, 1.5]])
D = np.array([0.7, -0.2])


class Params(NamedTuple):
    Mq: float = -3.7
    drag: float = 0.0


class State(NamedTuple):
    w: float
    q: float


class Inputs(NamedTuple):
    de: float
    dr: float


class Outputs(NamedTuple):
    q: float
    az: float
    """Model with direct feed-through."""


def field(p, s, u):
    return State(
        w=A[0, 0] * s.w + A[0, 1] * s.q + B[0, 0] * u.de + B[0, 1] * u.dr,
        q=A[1, 0] * s.w + p.Mq * s.q - p.drag * s.q**3 + B[1, 0] * u.de + B[1, 1] * u.dr,
    )


def output(p, s, u):
    return Outputs(q=s.q, az=s.w + D[0] * u.de + D[1] * u.dr)


LINEAR = Model("short period", field, output, Params, State, Inputs, Outputs, linear=True)
OTHER = Model("short period", field, output, Params, State, Inputs, Outputs)
MIXED = {"de": "linear", "dr": "zero-order"}


def acting(name, values, t, delay, hold):
    """Return an input at the time t by its hold; before the first sample the first."""
    at = int(np.clip(np.floor((t - delay) / DT + 1e-9), 0, N - 1))
    if hold == "linear" or (hold == "mixed" and not STEPPED[at]):
        return np.interp(t - delay, DT * np.arange(N), values)
    return values[at]


def integrated(delay=0.0, holds=("linear", "zero-order"), drag=0.0, x0=X0, de=DE):
    """Return states (N, 2) by solve_ivp, stopped at every corner or jump of an input."""
    knots = np.unique(np.round([*(DT * np.arange(N)), *(DT * np.arange(-N, 2 * N) + delay)], 12))
    knots = knots[(knots >= 0) & (knots <= DT * (N - 1) + 1e-9)]
    x, states = np.asarray(x0, float), {0.0: np.asarray(x0, float)}
    for a, b in itertools.pairwise(knots):
        middle = 0.5 * (a + b)

        def rates(t, x, middle=middle):
            # A held input has the interval's value, a linear one that of the time.
            u = [
                acting(n, v, middle if hold == "zero-order" else t, delay, hold)
                if hold != "mixed" or not STEPPED[int((middle - delay) // DT)]
                else acting(n, v, middle, delay, hold)
                for (n, v), hold in zip((("de", de), ("dr", DR)), holds, strict=True)
            ]
            return A @ x + B @ u - [0.0, drag * x[1] ** 3]

        how = {"method": "DOP853", "rtol": 1e-11, "atol": 1e-13}
        x = scipy.integrate.solve_ivp(rates, (a, b), x, **how).y[:, -1]
        states[b] = x
    return np.array([states[t] for t in np.round(DT * np.arange(N), 12)])


def inputs(de=DE, dr=DR):
    return Inputs(jnp.asarray(de), jnp.asarray(dr))


@functools.cache
def compiled(solver=None, delayed=False, block=1, substeps=4, hold="mixed", drag=0.0):
    jumps = {"de": "mixed", "dr": "zero-order"}
    how = {"mixed": MIXED, "linear": "linear", "none": None, "jumps": jumps}[hold]
    model = LINEAR if solver in (None, "exact") else OTHER
    given = {"tsit5": dfx.Tsit5(), "adaptive": dfx.Dopri8()}.get(solver, solver)
    controller = dfx.PIDController(rtol=1e-9, atol=1e-11) if solver == "adaptive" else None

    def run(u, delay, Mq=-3.7):
        return simulate(
            model, Params(Mq, drag), u, dt=DT, initial_state=State(*jnp.asarray(X0)),
            solver=given, substeps=substeps, delay=delay if delayed else None, block=block,
            hold=how, controller=controller, adjoint=dfx.ForwardMode(),
        )  # fmt: skip

    return jax.jit(run)


def states(found):
    return np.stack([found.states.w, found.states.q], axis=1)


def close(found, expected, tolerance):
    size = np.abs(expected).max(axis=0)
    np.testing.assert_allclose(found / size, expected / size, rtol=0, atol=tolerance)


def test_linear_inputs_are_scipys_first_order_hold():
    """Test against lsim, which interpolates: x' = A x + B u with both inputs linear."""
    _, _, x = scipy.signal.lsim((A, B, np.eye(2), np.zeros((2, 2))), np.stack([DE, DR], 1),
                                DT * np.arange(N), X0, interp=True)  # fmt: skip
    found = compiled(hold="linear")(inputs(), jnp.asarray(0.0))
    close(states(found), x, 1e-10)
    np.testing.assert_allclose(found.outputs.az, x[:, 0] + D[0] * DE + D[1] * DR, atol=1e-9)
    close(states(compiled(hold="linear", block=8)(inputs(), jnp.asarray(0.0))), x, 1e-10)


@pytest.mark.parametrize("delay", [None, 0.017, 0.05, 0.083, -0.021])
@pytest.mark.parametrize("block", [1, 8])
def test_a_linear_and_a_held_input_with_a_delay(delay, block):
    late = delay or 0.0
    found = compiled(delayed=delay is not None, block=block)(inputs(), jnp.asarray(late))
    close(states(found), integrated(late), 1e-9)
    t = DT * np.arange(N)
    held = DR[np.clip(np.floor((t - late) / DT + 1e-9).astype(int), 0, N - 1)]
    feed = D[0] * np.interp(t - late, t, DE) + D[1] * held
    np.testing.assert_allclose(found.outputs.az - found.states.w, feed, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("solver", "delay"), [("rk4", 0.017), ("tsit5", None), ("adaptive", 0.017)]
)
def test_other_solvers_follow_the_input_within_their_steps(solver, delay):
    found = compiled(solver, delay is not None, substeps=8, drag=0.4)(
        inputs(), jnp.asarray(delay or 0.0)
    )
    close(states(found), integrated(delay or 0.0, drag=0.4), 1e-6 if solver == "rk4" else 1e-8)


@pytest.mark.parametrize(
    ("solver", "block", "delay"), [("exact", 1, 0.083), ("exact", 8, None), ("rk4", 1, 0.017)]
)
def test_a_mixed_input_is_held_until_it_jumps(solver, block, delay):
    late, drag = delay or 0.0, 0.0 if solver == "exact" else 0.4
    u = inputs(de=STICK)
    go = compiled(solver, delay is not None, block, 8, "jumps", drag)
    expected = integrated(late, ("mixed", "zero-order"), drag, de=STICK)
    found = go(u, jnp.asarray(late))
    close(states(found), expected, 1e-9 if solver == "exact" else 1e-6)
    t = DT * np.arange(N)
    de = [acting("de", STICK, s, late, "mixed") for s in t]
    np.testing.assert_allclose(found.inputs.de, de, atol=1e-12)


@pytest.mark.parametrize("solver", ["exact", pytest.param("rk4", marks=pytest.mark.slow)])
def test_derivatives_by_delay_and_parameter(solver):
    go = compiled(solver, True, substeps=8)

    def seen(z):
        found = go(inputs(), z[0], z[1])
        return jnp.stack([found.states.q, found.outputs.az])

    jacobian, h = jax.jit(jax.jacfwd(seen)), 1e-6
    for delay in (0.017, -0.021):
        z = jnp.asarray([delay, -3.7])
        for i, e in enumerate(h * jnp.eye(2)):
            expected = np.asarray(seen(z + e) - seen(z - e)) / (2 * h)
            atol = 1e-4 * np.abs(expected).max()
            np.testing.assert_allclose(jacobian(z)[..., i], expected, atol=atol)


def test_derivative_by_delay_on_the_samples_is_continuous():
    """Test linear inputs, which have no jumps at delays of whole samples."""
    go = compiled(delayed=True, hold="linear")
    slope = jax.jit(jax.jacfwd(lambda d: go(inputs(), d).states.q))
    for delay in (0.0, DT):
        expected = [slope(jnp.asarray(delay + e)) for e in (-1e-9, 1e-9)]
        np.testing.assert_allclose(*expected, atol=1e-5)
        np.testing.assert_allclose(slope(jnp.asarray(delay)), expected[0], atol=1e-5)


def test_a_flight_says_how_its_inputs_move():
    flight = Flight(dt=DT, inputs={"de": DE, "dr": DR}, outputs={}, hold={"de": "linear"})
    assert flight.hold == MIXED
    start = State(*jnp.asarray(X0))

    def flown(p, **how):
        return simulate(LINEAR, p, flight, initial_state=start, **how)

    close(states(jax.jit(flown)(Params())), integrated(), 1e-9)
    other = jax.jit(lambda p: flown(p, hold={"de": "zero-order"}))(Params())
    close(states(other), integrated(holds=("zero-order", "zero-order")), 1e-9)


@pytest.mark.parametrize(("block", "n"), [(1, N), (4, N), (4, N - 2)])
def test_accumulated_is_what_simulate_gives(block, n):
    u = inputs(DE[:n], DR[:n])

    @jax.jit
    def reduced(u):
        found = accumulated(
            LINEAR, Params(), u, lambda s, y, d: s + d * (y.az + y.q**2), jnp.asarray(0.0),
            data=jnp.arange(1.0, n + 1), dt=DT, initial_state=State(*jnp.asarray(X0)),
            block=block, hold=MIXED,
        )  # fmt: skip
        return found.value, found.state

    value, state = reduced(u)
    run = compiled()(inputs(), jnp.asarray(0.0))
    total = np.sum(np.arange(1, n + 1) * np.asarray(run.outputs.az + run.outputs.q**2)[:n])
    assert float(value) == pytest.approx(total, rel=1e-10)
    np.testing.assert_allclose(state.w, run.states.w[n - 1], rtol=1e-9)
    np.testing.assert_allclose(state.q, run.states.q[n - 1], rtol=1e-9)


def test_accumulate_with_other_solvers():
    def run(u):
        return accumulate(
            OTHER, Params(drag=0.4), u, lambda s, y, d: s + y.q**2, jnp.asarray(0.0), dt=DT,
            initial_state=State(*jnp.asarray(X0)), hold=MIXED, substeps=8,
        )[0]  # fmt: skip

    expected = np.sum(integrated(drag=0.4)[:, 1] ** 2)
    assert float(jax.jit(run)(inputs())) == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("model", [LINEAR, OTHER], ids=["linear", "other"])
def test_filters_predict_with_mixed_and_linear_inputs(model):
    """Test that without process noise the innovations are the simulation's error."""
    measured, delay = {"q": jnp.zeros(N), "az": jnp.zeros(N)}, jnp.asarray(0.083)

    @jax.jit
    def filtered(u, delay):
        return innovations(
            model, Params(), u, measured, {"q": 0.1, "az": 0.2}, dt=DT,
            initial_state=State(*jnp.asarray(X0)), delay=delay,
            hold={"de": "mixed", "dr": "zero-order"},
        ).error  # fmt: skip

    error = filtered(inputs(de=STICK), delay)
    found = compiled("exact", True, 1, 8, "jumps", 0.0)(inputs(de=STICK), delay)
    np.testing.assert_allclose(error["q"], -found.states.q, atol=1e-9)
    np.testing.assert_allclose(error["az"], -found.outputs.az, atol=1e-9)


def test_an_event_is_found_where_the_moving_input_brings_it():
    """Test an event: u rises through 0.55 in mid-sample, which a held input shows later."""
    u = Inputs(jnp.arange(10.0) / 10, jnp.zeros(10))
    events = {"full": lambda p, s, u: 0.55 - u.de}
    found = jax.jit(lambda u: simulate(OTHER, Params(), u, dt=DT, hold="linear", events=events))(u)
    assert float(found.ended) == pytest.approx(5.5 * DT, abs=1e-9)


@pytest.mark.parametrize(
    "how",
    [
        {"hold": "foh"},
        {"hold": {"de": "cubic"}},
        {"hold": {"da": "linear"}},
        {"hold": "linear", "feedback": lambda s, u: u},
    ],
)
def test_what_cannot_be_is_refused(how):
    with pytest.raises(ValueError, match=r"hold|feedback"):
        simulate(LINEAR, Params(), inputs(), dt=DT, **how)
