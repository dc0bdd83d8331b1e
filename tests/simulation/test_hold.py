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

from heli_jax import Flight, Model, accumulate, models, simulate
from heli_jax.dynamics.disturbance import with_disturbance
from heli_jax.identification.estimation.kalman import innovations
from heli_jax.simulation.accumulate import accumulated
from tests.dynamics.paper import BENCH

DT, N = 0.05, 41
RNG = np.random.default_rng(3)
DE, DR = RNG.standard_normal(N), np.repeat(RNG.standard_normal(N // 4 + 1), 4)[:N]
STICK = np.r_[np.repeat([0.0, 1.0, -1.0, 0.4], 5), 0.4 + 0.3 * np.sin(0.2 * np.arange(N - 20))]
STEPPED = np.arange(N) < 20
"""the intervals of STICK that are held"""
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
    """with direct feed-through"""


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
    """One input at the time t, by its hold; before the first sample the first, and so on."""
    at = int(np.clip(np.floor((t - delay) / DT + 1e-9), 0, N - 1))
    if hold == "linear" or (hold == "mixed" and not STEPPED[at]):
        return np.interp(t - delay, DT * np.arange(N), values)
    return values[at]


def integrated(delay=0.0, holds=("linear", "zero-order"), drag=0.0, x0=X0, de=DE):
    """States (N, 2) by solve_ivp, stopped wherever an input has a corner or a jump."""
    knots = np.unique(np.round([*(DT * np.arange(N)), *(DT * np.arange(-N, 2 * N) + delay)], 12))
    knots = knots[(knots >= 0) & (knots <= DT * (N - 1) + 1e-9)]
    x, states = np.asarray(x0, float), {0.0: np.asarray(x0, float)}
    for a, b in itertools.pairwise(knots):
        middle = 0.5 * (a + b)

        def rates(t, x, middle=middle):
            # A held input is that of the interval, a linear one that of the moment.
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
    """lsim interpolates; its states are those of x' = A x + B u with both inputs linear."""
    _, _, x = scipy.signal.lsim((A, B, np.eye(2), np.zeros((2, 2))), np.stack([DE, DR], 1),
                                DT * np.arange(N), X0, interp=True)  # fmt: skip
    found = compiled(hold="linear")(inputs(), jnp.asarray(0.0))
    close(states(found), x, 1e-10)
    np.testing.assert_allclose(found.outputs.az, x[:, 0] + D[0] * DE + D[1] * DR, atol=1e-9)
    close(states(compiled(hold="linear", block=8)(inputs(), jnp.asarray(0.0))), x, 1e-10)


@pytest.mark.parametrize("delay", [None, 0.0, 0.017, 0.05, 0.083, -0.021])
@pytest.mark.parametrize("block", [1, 8])
def test_a_linear_and_a_held_input_with_a_delay(delay, block):
    late = delay or 0.0
    found = compiled(delayed=delay is not None, block=block)(inputs(), jnp.asarray(late))
    close(states(found), integrated(late), 1e-9)
    t = DT * np.arange(N)
    held = DR[np.clip(np.floor((t - late) / DT + 1e-9).astype(int), 0, N - 1)]
    feed = D[0] * np.interp(t - late, t, DE) + D[1] * held
    np.testing.assert_allclose(found.outputs.az - found.states.w, feed, atol=1e-9)


@pytest.mark.parametrize("solver", ["rk4", "tsit5", "adaptive"])
@pytest.mark.parametrize("delay", [None, 0.017])
def test_other_solvers_follow_the_input_within_their_steps(solver, delay):
    found = compiled(solver, delay is not None, substeps=8, drag=0.4)(
        inputs(), jnp.asarray(delay or 0.0)
    )
    close(states(found), integrated(delay or 0.0, drag=0.4), 1e-6 if solver == "rk4" else 1e-8)


@pytest.mark.parametrize("delay", [None, 0.017, 0.083])
@pytest.mark.parametrize(("solver", "block"), [("exact", 1), ("exact", 8), ("rk4", 1)])
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
    if solver == "exact":
        how = {"dt": DT, "initial_state": State(*jnp.asarray(X0)), "delay": delay}
        measured, sd = {"q": jnp.zeros(N)}, {"q": 0.1}
        for model in (LINEAR, OTHER):
            error = innovations(model, Params(), u, measured, sd, **how, hold={"de": "mixed"}).error
            np.testing.assert_allclose(error["q"], -expected[:, 1], atol=1e-9)


@pytest.mark.parametrize("solver", ["exact", "rk4"])
@pytest.mark.parametrize("delay", [0.0, 0.017, -0.021])
def test_derivatives_by_delay_and_parameter(solver, delay):
    go = compiled(solver, True, substeps=8)

    def seen(z):
        found = go(inputs(), z[0], z[1])
        return jnp.stack([found.states.q, found.outputs.az])

    z, h = jnp.asarray([delay, -3.7]), 1e-6
    slopes = jax.jit(jax.jacfwd(seen))(z)
    for i in range(2):
        if i == 0 and delay == 0.0:
            continue  # a held input has a kink there
        e = h * jnp.eye(2)[i]
        expected = np.asarray(seen(z + e) - seen(z - e)) / (2 * h)
        np.testing.assert_allclose(slopes[..., i], expected, atol=1e-4 * np.abs(expected).max())


def test_derivative_by_delay_on_the_samples_is_continuous():
    """Linear inputs have no jump that a delay of a whole sample could meet."""
    go = compiled(delayed=True, hold="linear")
    slope = jax.jit(jax.jacfwd(lambda d: go(inputs(), d).states.q))
    for delay in (0.0, DT):
        expected = [slope(jnp.asarray(delay + e)) for e in (-1e-9, 1e-9)]
        np.testing.assert_allclose(*expected, atol=1e-5)
        np.testing.assert_allclose(slope(jnp.asarray(delay)), expected[0], atol=1e-5)


def test_held_inputs_are_what_they_were():
    """A hold that says so, for all or by name, changes no digit."""
    plain = compiled(hold="none")(inputs(), jnp.asarray(0.0))
    for hold in ("zero-order", {"de": "zero-order"}):
        found = jax.jit(
            lambda u, hold=hold: simulate(
                LINEAR, Params(), u, dt=DT, initial_state=State(*jnp.asarray(X0)), hold=hold
            )
        )(inputs())
        np.testing.assert_array_equal(found.states.w, plain.states.w)


def test_a_flight_says_how_its_inputs_move():
    flight = Flight(dt=DT, inputs={"de": DE, "dr": DR}, outputs={}, hold={"de": "linear"})
    assert flight.hold == MIXED
    start = State(*jnp.asarray(X0))
    found = simulate(LINEAR, Params(), flight, initial_state=start)
    close(states(found), integrated(), 1e-9)
    other = simulate(LINEAR, Params(), flight, initial_state=start, hold={"de": "zero-order"})
    plain = compiled(hold="none")(inputs(), jnp.asarray(0.0))
    close(states(other), states(plain), 1e-12)


@pytest.mark.parametrize(("block", "n"), [(1, N), (4, N), (4, N - 1), (4, N - 2)])
def test_accumulated_is_what_simulate_gives(block, n):
    u = inputs(DE[:n], DR[:n])
    found = accumulated(
        LINEAR, Params(), u, lambda s, y, d: s + d * (y.az + y.q**2), jnp.asarray(0.0),
        data=jnp.arange(1.0, n + 1), dt=DT, initial_state=State(*jnp.asarray(X0)), block=block,
        hold=MIXED,
    )  # fmt: skip
    run = simulate(LINEAR, Params(), u, dt=DT, initial_state=State(*jnp.asarray(X0)), hold=MIXED)
    total = np.sum(np.arange(1, n + 1) * np.asarray(run.outputs.az + run.outputs.q**2))
    assert float(found.value) == pytest.approx(total, rel=1e-10)
    np.testing.assert_allclose(found.state.w, run.states.w[-1], rtol=1e-9)
    np.testing.assert_allclose(found.state.q, run.states.q[-1], rtol=1e-9)


def test_accumulate_with_other_solvers():
    def run(u):
        return accumulate(
            OTHER, Params(drag=0.4), u, lambda s, y, d: s + y.q**2, jnp.asarray(0.0), dt=DT,
            initial_state=State(*jnp.asarray(X0)), hold=MIXED, substeps=8,
        )[0]  # fmt: skip

    expected = np.sum(integrated(drag=0.4)[:, 1] ** 2)
    assert float(jax.jit(run)(inputs())) == pytest.approx(expected, rel=1e-6)


@pytest.mark.slow
def test_noise_is_drawn_as_with_held_inputs():
    """The disturbance does not care what the inputs do: the difference is that without noise."""
    model = with_disturbance(models.roll_on_stand, "roll")
    p = model.Params(**BENCH, sigma_w=1.0, tau_w=0.5)
    u = model.Inputs(jnp.asarray(2e-6 * DE))

    def roll(**how):
        return simulate(model, p, u, dt=DT, **how).outputs.roll

    @jax.jit
    def differences(key):
        return roll(hold="linear", key=key) - roll(key=key), roll(hold="linear") - roll()

    drawn, plain = differences(jax.random.key(1))
    np.testing.assert_allclose(drawn, plain, atol=1e-12)
    assert np.abs(drawn).max() > 1e-4


@pytest.mark.parametrize("delay", [None, 0.017])
def test_filters_predict_with_linear_inputs(delay):
    """Without noise of the process the innovations are the simulation's error."""
    late = None if delay is None else jnp.asarray(delay)
    measured = {"q": jnp.zeros(N), "az": jnp.zeros(N)}

    def run(model):
        return innovations(
            model, Params(), inputs(), measured, {"q": 0.1, "az": 0.2}, dt=DT,
            initial_state=State(*jnp.asarray(X0)), delay=late, hold=MIXED,
        ).error  # fmt: skip

    found = compiled(delayed=delay is not None)(inputs(), jnp.asarray(delay or 0.0))
    for model in (LINEAR, OTHER):
        error = run(model)
        np.testing.assert_allclose(error["q"], -found.states.q, atol=1e-9)
        np.testing.assert_allclose(error["az"], -found.outputs.az, atol=1e-9)


def test_an_event_is_found_where_the_moving_input_brings_it():
    """u rises through 0.55 in the middle of a sample: a held one shows that later."""
    u = Inputs(jnp.arange(10.0) / 10, jnp.zeros(10))
    found = simulate(
        OTHER, Params(), u, dt=DT, hold="linear",
        events={"full": lambda p, s, u: 0.55 - u.de},
    )  # fmt: skip
    assert float(found.ended) == pytest.approx(5.5 * DT, abs=1e-9)


@pytest.mark.parametrize(
    ("how", "words"),
    [
        ({"hold": "foh"}, "zero-order, linear, mixed, got 'foh'"),
        ({"hold": {"de": "cubic"}}, "got 'cubic'"),
        ({"hold": {"da": "linear"}}, "no input 'da'"),
        ({"hold": "linear", "feedback": lambda s, u: u}, "feedback .* hold='zero-order'"),
    ],
)
def test_what_cannot_be_is_said(how, words):
    with pytest.raises(ValueError, match=words):
        simulate(LINEAR, Params(), inputs(), dt=DT, **how)
