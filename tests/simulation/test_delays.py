"""Inputs with separate delays, against an integration of the delayed equations."""

import itertools
from typing import Annotated, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from heli_jax import Flight, Free, Model, Nuisance, Problem, accumulate, fit, simulate
from heli_jax.dynamics.disturbance import with_disturbance
from heli_jax.dynamics.model import Axis
from heli_jax.identification.estimation.kalman import innovations
from heli_jax.naming import Scalar

DT, N = 0.05, 60
HOLDS = {"held": "zero-order", "linear": "linear", "mixed": {"elevator": "linear"}}


class Params(NamedTuple):
    k: Annotated[Scalar, "1/s^2", "stiffness"] = 4.0
    c: Annotated[Scalar, "1/s", "damping"] = 0.7
    late: Annotated[Scalar, "s", "delay of the elevator"] = 0.0
    later: Annotated[Scalar, "s", "delay of the flap"] = 0.0


class State(NamedTuple):
    theta: Annotated[Scalar, "rad", "angle"]
    q: Annotated[Scalar, "rad/s", "rate"]


class Inputs(NamedTuple):
    elevator: Scalar
    flap: Scalar
    thrust: Scalar


class Outputs(NamedTuple):
    theta: Annotated[Scalar, "rad", "angle"]
    felt: Scalar


def field(p, x, u):
    return State(x.q, -p.k * x.theta - p.c * x.q + 2.0 * u.elevator + u.flap - 0.5 * u.thrust)


def bent(p, x, u):
    q = -p.k * jnp.sin(x.theta) - p.c * x.q + 2.0 * u.elevator + u.flap - 0.5 * u.thrust
    return State(x.q, q)


def output(p, x, u):
    return Outputs(x.theta, x.q + u.elevator - u.flap + u.thrust)


DELAYS = (("elevator", "late"), ("flap", "later"))
AXES = (Axis("pitch", rate="q", angle="theta"),)


def model(linear):
    return Model(
        "delayed", field if linear else bent, output, Params, State, Inputs, Outputs,
        linear=linear, delays=DELAYS, axes=AXES,
    )  # fmt: skip


LINEAR, NONLINEAR = model(True), model(False)


def sticks(seed=0):
    return np.random.default_rng(seed).standard_normal((3, N))


def read(u, t, hold):
    """Return an input at a time, which may be between samples or before the first."""
    place = np.clip(t / DT, 0.0, N - 1.0)
    if hold == "linear":
        return np.interp(place, np.arange(N), u)
    return u[int(np.floor(place + 1e-9))]


def by_hand(u, delays, hold, linear, upto=N):
    """Return theta and felt acceleration (N,), integrated between corners of the inputs."""
    holds = [hold.get(n, "zero-order") if isinstance(hold, dict) else hold for n in Inputs._fields]
    late = (*delays, 0.0)

    def acting(t):
        return [read(v, t - d, h) for v, d, h in zip(u, late, holds, strict=True)]

    def rates(t, x, middle):
        # Within a part every input is constant or one line, and is read inside it.
        lo, hi = middle
        e, f, w = (
            (read(v, lo - d, h) + (read(v, hi - d, h) - read(v, lo - d, h)) * (t - lo) / (hi - lo))
            if h == "linear" else read(v, 0.5 * (lo + hi) - d, h)
            for v, d, h in zip(u, late, holds, strict=True)
        )  # fmt: skip
        pull = x[0] if linear else np.sin(x[0])
        return [x[1], -4.0 * pull - 0.7 * x[1] + 2.0 * e + f - 0.5 * w]

    x, out = np.zeros(2), []
    for k in range(upto):
        e, f, w = acting(k * DT + (0.0 if isinstance(hold, dict) or hold == "linear" else 1e-12))
        # A held input late by a fractional number of samples jumps within the interval.
        out.append((x[0], x[1] + e - f + w))
        corners = sorted({0.0, *((d / DT) % 1.0 for d in late), 1.0})
        for lo, hi in itertools.pairwise(corners):
            span = (k + lo) * DT, (k + hi) * DT
            x = solve_ivp(rates, span, x, args=(span,), rtol=1e-10, atol=1e-12).y[:, -1]
    return np.array(out).T


@pytest.fixture(scope="module")
def run():
    """Return theta and felt acceleration of a delayed model, compiled once per model and hold."""
    compiled = {}

    def go(machine, u, delays, hold, **keywords):
        key = (machine.name, machine.linear, str(hold), str(keywords))
        if key not in compiled:
            compiled[key] = jax.jit(
                lambda p, u: simulate(machine, p, u, dt=DT, hold=hold, **keywords).outputs
            )
        p = Params(late=jnp.asarray(delays[0]), later=jnp.asarray(delays[1]))
        out = compiled[key](p, Inputs(*jnp.asarray(u)))
        return np.array([out.theta, out.felt])

    return go


@pytest.mark.parametrize("hold", HOLDS)
@pytest.mark.parametrize("delays", [(0.012, 0.17), (0.07, 0.07)])
def test_two_delays_of_a_linear_model(run, hold, delays):
    u = sticks()
    expected = by_hand(u, delays, HOLDS[hold], True, 25)
    np.testing.assert_allclose(
        run(LINEAR, u, delays, HOLDS[hold])[:, :25], expected, rtol=0, atol=1e-8
    )


@pytest.mark.slow
@pytest.mark.parametrize("hold", HOLDS)
def test_two_delays_of_a_model_that_is_not_linear(run, hold):
    u, delays = sticks(1), (0.17, 0.012)
    expected = by_hand(u, delays, HOLDS[hold], False, 25)
    actual = run(NONLINEAR, u, delays, HOLDS[hold], substeps=8)[:, :25]
    np.testing.assert_allclose(actual, expected, rtol=0, atol=2e-7)


@pytest.mark.slow
def test_in_blocks_and_reduced_it_is_the_same_run(run):
    u, delays, hold = sticks(2), (0.03, 0.11), "mixed"
    stepwise = run(LINEAR, u, delays, HOLDS[hold])
    blocks = run(LINEAR, u, delays, HOLDS[hold], block=16)
    np.testing.assert_allclose(blocks, stepwise, rtol=0, atol=1e-12)
    p = Params(late=jnp.asarray(0.03), later=jnp.asarray(0.11))

    def update(value, outputs, _):
        return value + outputs.theta * outputs.felt

    @jax.jit
    def reduced(p):
        u_ = Inputs(*jnp.asarray(u))
        how = {"dt": DT, "hold": HOLDS[hold], "block": 4}
        return accumulate(LINEAR, p, u_, update, jnp.zeros(()), **how)[0]

    assert float(reduced(p)) == pytest.approx(np.sum(stepwise[0] * stepwise[1]), rel=1e-10)


@pytest.mark.parametrize(
    "machine",
    [
        pytest.param(LINEAR, id="linear"),
        pytest.param(NONLINEAR, id="nonlinear", marks=pytest.mark.slow),
    ],
)
def test_derivatives_by_each_delay(machine):
    u = Inputs(*jnp.asarray(sticks(3)))

    def theta(d):
        p = Params(late=d[0], later=d[1])
        # Mixed contains held and linear intervals.
        return simulate(machine, p, u, dt=DT, hold=HOLDS["mixed"]).outputs.theta

    d, h = jnp.asarray([0.031, 0.116]), 1e-5
    J = np.asarray(jax.jit(jax.jacfwd(theta))(d))
    theta = jax.jit(theta)
    for i in range(2):
        step = h * jnp.eye(2)[i]
        central = (np.asarray(theta(d + step)) - np.asarray(theta(d - step))) / (2 * h)
        np.testing.assert_allclose(J[:, i], central, rtol=0, atol=1e-6 * np.abs(central).max())


@pytest.mark.parametrize("machine", [LINEAR, NONLINEAR], ids=["linear", "nonlinear"])
def test_the_filter_without_noise_predicts_the_simulation(run, machine):
    """Test a filter without randomness: its innovations are y - simulation."""
    u, delays = sticks(5), (0.031, 0.116)
    disturbed = with_disturbance(machine, "pitch")
    assert disturbed.delays == machine.delays
    p = disturbed.Params(
        late=jnp.asarray(0.031), later=jnp.asarray(0.116), sigma_w=jnp.asarray(1e-9)
    )
    y = np.random.default_rng(6).standard_normal(N)
    found = jax.jit(
        lambda p: innovations(
            disturbed, p, Inputs(*jnp.asarray(u)), {"theta": jnp.asarray(y)}, {"theta": 1.0},
            dt=DT, hold="linear", substeps=8,
        )
    )(p)  # fmt: skip
    expected = y - run(machine, u, delays, "linear", substeps=8)[0]
    atol = 1e-9 if machine.linear else 1e-5  # two ways to integrate
    np.testing.assert_allclose(found.error["theta"], expected, rtol=0, atol=atol)


def test_noise_is_drawn_beside_delays():
    """Test that noise adds the same to a linear model's run as without any input."""
    disturbed = with_disturbance(LINEAR, "pitch")
    p = disturbed.Params(
        late=jnp.asarray(0.031), later=jnp.asarray(0.116), sigma_w=jnp.asarray(0.3)
    )
    u, key = sticks(7), jax.random.key(1)

    @jax.jit
    def runs(u):
        def theta(u, key=None):
            found = simulate(disturbed, p, Inputs(*u), dt=DT, hold="linear", key=key)
            return found.outputs.theta

        return theta(u, key) - theta(u), theta(0.0 * u, key)

    moved, still = runs(jnp.asarray(u))
    assert np.std(still) > 0.01
    np.testing.assert_allclose(moved, still, rtol=0, atol=1e-12)


@pytest.mark.slow
def test_delays_are_found_beside_the_parameters(run):
    """Test windows, whose inputs begin before them."""
    u = sticks(8)
    rng = np.random.default_rng(9)
    y = run(LINEAR, u, (0.031, 0.116), "linear")[0] + 1e-3 * rng.standard_normal(N)
    flight = Flight(
        dt=DT, inputs=dict(zip(Inputs._fields, u, strict=True)), outputs={"theta": y},
        hold=dict.fromkeys(Inputs._fields, "linear"),
    )  # fmt: skip
    free = {n: Free(v) for n, v in {"k": 3.0, "c": 1.0, "late": 0.06, "later": 0.06}.items()}
    problem = Problem(LINEAR, Params(), [flight], free, Nuisance(bias=False), window=1.0)
    found = fit(problem)
    assert found.status == "converged"
    for name, true in {"k": 4.0, "c": 0.7, "late": 0.031, "later": 0.116}.items():
        estimate = found.estimates[name]
        assert abs(estimate.value - true) < 4 * estimate.sd, name
    assert found.estimates["late"].sd < 2e-3
